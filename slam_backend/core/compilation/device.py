"""Compilation of kernels that only other kernels call: optimised code, of which only the callers make machine code."""

from typing import Any, cast

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

ENVIRONMENT = "_ZN08NumbaEnv"  # start of the names of the variables in which numba keeps what a kernel needs of Python


class DeviceLibrary(JITCodeLibrary):
    """Code of a device kernel, which is linked into its callers and never runs by itself."""

    def _finalize_final_module(self) -> None:
        """Make room for the environments alone, which numba sets next."""
        module, codegen = self._final_module, cast(Any, self._codegen)
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        names = [variable.name for variable in module.global_variables if variable.name.startswith(ENVIRONMENT)]
        room = llvm.parse_assembly("\n".join(f"@{name} = common global ptr null" for name in names))
        codegen._add_module(room)
        codegen._engine.finalize_object()
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        """Return the optimised code for the cache: there is no machine code."""
        return self.serialize_using_bitcode()  # type: ignore[no-untyped-call]


class DeviceCompiler(Compiler):
    """Compiler of device kernels.

    Args:
        typing_context, target_context, library, *others: Arguments of numba's compiler; no library is given.
    """

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any) -> None:
        own = DeviceLibrary(target_context.codegen(), "device")  # type: ignore[no-untyped-call]
        super().__init__(typing_context, target_context, own, *others)  # type: ignore[no-untyped-call]
