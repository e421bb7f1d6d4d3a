"""Custom policies, imported by module and name: `my_module:Careful`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from inspect import signature
from pathlib import Path
from traceback import extract_tb
from typing import Any

from agents.policy import Policy
from slam_backend.core.validation import argument_error, check_choice, did_you_mean, is_built_in

ACTION_TYPES = ("continuous", "discrete", "goal")
EXPECTED = "MODULE:NAME of a policy"
METHODS = ("reset", "act")
NEEDED = (
    "A policy has the methods reset() and act(observation, belief, rng). Name its class or a factory function "
    "without arguments."
)


def is_plugin(name: str) -> bool:
    """Return whether a name has the form `MODULE:NAME` rather than being a path."""
    module, colon, factory = name.partition(":")
    return bool(colon) and factory.isidentifier() and all(part.isidentifier() for part in module.split("."))


def plugin_action_type(name: str) -> str:
    """Return the action type of a policy: its attribute `action_type`, or `"goal"` if it has none.

    Raises:
        ValueError: If there is no such policy, or the attribute is not an action type.
    """
    return check_choice(f"{name}.action_type", getattr(_find(name), "action_type", "goal"), ACTION_TYPES)


def load_plugin(name: str) -> Policy:
    """Make a policy for one robot by calling the named class or function without arguments.

    The current folder is searched first, then Python's import path.

    Args:
        name: Module and name, e.g. `"my_module:Careful"`.

    Raises:
        ValueError: If the module or the name does not exist, the call raises, or the result is not a policy.
    """
    maker = _find(name)
    with _one_line(name):
        policy = maker()
    missing = [method for method in METHODS if not callable(getattr(policy, method, None))]
    if missing:
        got = f"a {type(policy).__name__} without {missing[0]}"
        raise argument_error("policy", EXPECTED, got, NEEDED)
    made: Policy = policy
    return made


def plugin_file(name: str) -> Path:
    """Return the file of a policy's module, `"my_module:Careful"`.

    Raises:
        ValueError: If there is no such policy, or its module has no file.
    """
    _find(name)
    file = sys.modules[name.partition(":")[0]].__file__
    if file is None:
        raise argument_error("policy", EXPECTED, f"a module without a file: {name}", "Write it into a file.")
    return Path(file)


def _find(name: str) -> Any:
    """Return the class or function that makes the policy."""
    module, _, factory = name.partition(":")
    try:
        with _current_folder_first(), _one_line(module):
            imported = import_module(module)
    except ModuleNotFoundError as error:
        hint = "Name an installed module, or change into the folder that contains it."
        raise argument_error("policy", EXPECTED, f"no module {module!r}", hint) from error
    made = getattr(imported, factory, None)
    if not callable(made):
        hint = did_you_mean(factory, vars(imported)) + "Check the name."
        raise argument_error("policy", EXPECTED, f"no class or function {factory!r} in {module}", hint)
    if not _may_make_policies(made):
        raise argument_error("policy", EXPECTED, f"no policy factory: {name}", NEEDED)
    return made


def _may_make_policies(maker: Any) -> bool:
    """Return whether it is safe to call it for inspection: it is written in Python and takes no arguments."""
    if is_built_in(maker):
        return False
    try:
        signature(maker).bind()
    except (TypeError, ValueError):  # ValueError: no signature is available
        return False
    return True


@contextmanager
def _one_line(name: str) -> Iterator[None]:
    """Turn what a custom module raises within the block into an error of one line, unless the module is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise
        raise _raised(name, error) from error  # one of its own imports is missing
    except Exception as error:
        raise _raised(name, error) from error


def _raised(name: str, error: Exception) -> ValueError:
    """Return an error of one line that says what a custom module raised, and where."""
    last = extract_tb(error.__traceback__)[-1]
    what = " ".join(f"{type(error).__name__}: {error}".split())
    return ValueError(
        f"policy {name!r}: expected it to be imported and made, got {what} ({Path(last.filename).name}, line "
        f"{last.lineno}). Correct the policy."
    )


@contextmanager
def _current_folder_first() -> Iterator[None]:
    """Put the current folder first on the import path, as `python -m` does and an installed command does not."""
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
