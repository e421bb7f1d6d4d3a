"""Compilation of kernels that only other kernels call: these optimise the code, and make machine code of it."""

from typing import Any, cast

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

ENVIRONMENT = "_ZN08NumbaEnv"  # start of the names of the variables in which numba keeps what a kernel needs of Python


class DeviceLibrary(JITCodeLibrary):
    """Code of a device kernel, which is linked into its callers and never runs by itself."""

    def _optimize_final_module(self) -> None:
        """Leave the code as it is: it is optimised as a part of its callers, once for each kernel that Python calls."""

    def _finalize_final_module(self) -> None:
        """Make room for the environments alone, which numba sets next."""
        module, codegen = self._final_module, cast(Any, self._codegen)
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        room: Any = codegen._create_empty_module("environments")
        for name in [variable.name for variable in module.global_variables if variable.name.startswith(ENVIRONMENT)]:
            place: Any = ir.GlobalVariable(room, cgutils.voidptr_t, name)
            place.linkage, place.initializer = "common", ir.Constant(cgutils.voidptr_t, None)
        codegen._add_module(llvm.parse_assembly(str(room)))
        codegen._engine.finalize_object()
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        """Return the code for the cache: there is no machine code."""
        return self.serialize_using_bitcode()  # type: ignore[no-untyped-call]


class DeviceCompiler(Compiler):
    """Compiler of device kernels.

    Args:
        typing_context, target_context, library, *others: Arguments of numba's compiler; no library is given.
    """

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any) -> None:
        own = DeviceLibrary(target_context.codegen(), "device")  # type: ignore[no-untyped-call]
        super().__init__(typing_context, target_context, own, *others)  # type: ignore[no-untyped-call]
