"""Custom policies, and other parts of users, imported by module and name: `my_module:Careful`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from inspect import signature
from pathlib import Path
from traceback import extract_tb
from typing import Any

from agents.policy import Policy
from slam_backend.core.validation import argument_error, check_choice, did_you_mean, is_argument_error, is_built_in

ACTION_TYPES = ("continuous", "discrete", "goal")
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
    with one_line(name):
        policy = maker()
    missing = [method for method in METHODS if not callable(getattr(policy, method, None))]
    if missing:
        got = f"a {type(policy).__name__} without {missing[0]}"
        raise argument_error("policy", _expected("policy"), got, NEEDED)
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
        raise argument_error("policy", _expected("policy"), f"a module without a file: {name}", "Write it into a file.")
    return Path(file)


def find_plugin(name: str, what: str = "policy") -> Any:
    """Return the class or function of a name `MODULE:NAME`; the current folder is searched first.

    Args:
        what: Kind of the part, for errors.

    Raises:
        ValueError: If the module or the name does not exist, or the module raises.
    """
    module, _, factory = name.partition(":")
    try:
        with _current_folder_first(), one_line(module, what):
            imported = import_module(module)
    except ModuleNotFoundError as error:
        hint = "Name an installed module, or change into the folder that contains it."
        raise argument_error(what, _expected(what), f"no module {module!r}", hint) from error
    made = getattr(imported, factory, None)
    if not callable(made):
        hint = did_you_mean(factory, vars(imported)) + "Check the name."
        raise argument_error(what, _expected(what), f"no class or function {factory!r} in {module}", hint)
    return made


def _find(name: str) -> Any:
    """Return the class or function that makes a policy."""
    made = find_plugin(name)
    if not _may_make_policies(made):
        raise argument_error("policy", _expected("policy"), f"no policy factory: {name}", NEEDED)
    return made


def _expected(what: str) -> str:
    return f"MODULE:NAME of a {what}"


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
def one_line(name: str, what: str = "policy") -> Iterator[None]:
    """Turn what a custom module raises within the block into an error of one line, unless the module is missing.

    Errors of arguments, which are such lines, are passed on for all but policies.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise
        raise _raised(name, what, error) from error  # one of its own imports is missing
    except Exception as error:
        if what != "policy" and is_argument_error(error):
            raise
        raise _raised(name, what, error) from error


def _raised(name: str, what: str, error: Exception) -> ValueError:
    """Return an error of one line that says what a custom module raised, and where."""
    last = extract_tb(error.__traceback__)[-1]
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return ValueError(
        f"{what} {name!r}: expected it to be imported and {'made' if what == 'policy' else 'called'}, got {text} "
        f"({Path(last.filename).name}, line {last.lineno}). Correct the {what}."
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
