"""Import of a module at its first use."""

from importlib import import_module
from typing import Any


class LazyModule:
    """Stand-in for a module that takes long to import and that most programs do not use.

    Args:
        name: Name of the module. An error of its import is raised at the first use.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._module: Any = None

    def __getattr__(self, attribute: str) -> Any:
        """Return an attribute of the module, which is imported if it is not yet."""
        if self._module is None:
            self._module = import_module(self._name)
        return getattr(self._module, attribute)
