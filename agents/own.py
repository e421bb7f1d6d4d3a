"""Policies of the user, by the name of their module: `my_module:Careful`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from agents.policy import Policy
from slam_backend.core.validation import argument_error, check_choice, is_built_in

ACTION_TYPES = ("continuous", "discrete", "goal")
EXPECTED = "MODULE:NAME of a policy"
METHODS = ("reset", "act")
NEEDED = (
    "A policy has the methods reset() and act(observation, belief, rng); name its class, or a function that makes it, "
    "which take no arguments."
)


def is_plugin(name: str) -> bool:
    """Tell whether a name is meant as a module and what makes a policy in it, not as a path."""
    module, colon, factory = name.partition(":")
    return bool(colon) and factory.isidentifier() and all(part.isidentifier() for part in module.split("."))


def plugin_action_type(name: str) -> str:
    """Return the type of action that a policy is for: its attribute `action_type`, or `"goal"` if it has none.

    Raises:
        ValueError: If there is no such policy, or that attribute is no type of action.
    """
    return check_choice(f"{name}.action_type", getattr(_find(name), "action_type", "goal"), ACTION_TYPES)


def load_plugin(name: str) -> Policy:
    """Make a policy for one robot by calling what the name stands for, without arguments.

    Modules are looked for as usual, and first in the current folder.

    Args:
        name: Such as `"my_module:Careful"`.

    Raises:
        ValueError: If the module or the name in it is not there, or what it makes is no policy.
    """
    policy = _find(name)()
    missing = [method for method in METHODS if not callable(getattr(policy, method, None))]
    if missing:
        got = f"a {type(policy).__name__} without {missing[0]}"
        raise argument_error("policy", EXPECTED, got, NEEDED)
    made: Policy = policy
    return made


def _find(name: str) -> Any:
    """Return what makes the policy."""
    module, _, factory = name.partition(":")
    try:
        with _current_folder_first():
            found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and asks for one that is not
        cure = "Name a module that is installed, or work in the folder that holds it."
        raise argument_error("policy", EXPECTED, f"no module {module!r}", cure) from error
    made = getattr(found, factory, None)
    if not callable(made):
        raise argument_error("policy", EXPECTED, f"no class or function {factory!r} in {module}", "Check the name.")
    if not _may_make_policies(made):
        raise argument_error("policy", EXPECTED, f"no maker of policies: {name}", NEEDED)
    return made


def _may_make_policies(maker: Any) -> bool:
    """Tell whether it is safe to call it to see what it makes: it is written in Python and asks for no arguments."""
    if is_built_in(maker):
        return False
    try:
        signature(maker).bind()
    except (TypeError, ValueError):  # the latter: it does not tell
        return False
    return True


@contextmanager
def _current_folder_first() -> Iterator[None]:
    """Let imports look into the current folder, as `python -m` does and an installed command does not."""
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
