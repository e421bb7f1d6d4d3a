"""Policies of the user, found by the name of their module."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents import make_policy
from agents.own import is_own
from agents.registry import action_types

MODULE = """
class Still:
    action_type = "continuous"

    def reset(self):
        pass

    def act(self, observation, belief, rng):
        return [0.0, 0.0]


def first_goal():
    policy = Still()
    policy.act = lambda observation, belief, rng: 1
    return policy


class Mute:
    def reset(self):
        pass


class Odd(Still):
    action_type = "flight"


NUMBER = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module in the current folder, which is not among those that Python looks into by itself."""
    name = "policies_of_a_user"
    (tmp_path / f"{name}.py").write_text(MODULE)
    (tmp_path / "asks_for_more.py").write_text("import a_module_that_nobody_has\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    yield name
    assert sys.path == path
    for loaded in (name, "asks_for_more"):
        sys.modules.pop(loaded, None)


def test_a_policy_is_found_in_the_current_folder(module: str) -> None:
    """A class or a function is called for each robot; it says for which actions it is, or is for goals."""
    one, other = (make_policy(f"{module}:Still", "continuous") for _ in range(2))
    assert type(one).__name__ == "Still"
    assert one is not other
    assert action_types(f"{module}:Still") == ("continuous",)
    assert action_types(f"{module}:first_goal") == ("goal",)
    assert make_policy(f"{module}:first_goal", "goal").act(None, None, None) == 1  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "action_type", "says"),
    [
        ("nowhere_at_all:Still", "goal", "policy: expected MODULE:NAME of a policy, got no module 'nowhere_at_all'"),
        ("nowhere.at_all:Still", "goal", "policy: expected MODULE:NAME of a policy, got no module 'nowhere.at_all'"),
        ("{}:Moving", "goal", "policy: expected MODULE:NAME of a policy, got no class or function 'Moving' in"),
        ("{}:NUMBER", "goal", "policy: expected MODULE:NAME of a policy, got no class or function 'NUMBER' in"),
        ("{}:Mute", "goal", "policy: expected MODULE:NAME of a policy, got a Mute without act. A policy has"),
        (
            "os:system",
            "goal",
            "policy: expected MODULE:NAME of a policy, got no maker of policies: os:system. A policy has",
        ),
        (
            "os:abort",
            "goal",
            "policy: expected MODULE:NAME of a policy, got no maker of policies: os:abort. A policy has",
        ),
        (
            "builtins:int",
            "goal",
            "policy: expected MODULE:NAME .* got no maker of policies: builtins:int. A policy has",
        ),
        ("numpy:sin", "goal", "policy: expected MODULE:NAME of a policy, got no maker of policies: numpy:sin"),
        ("shutil:rmtree", "goal", "policy: expected MODULE:NAME of a policy, got no maker of policies: shutil:rmtree"),
        ("{}:Odd", "goal", "policies_of_a_user:Odd.action_type: expected one of 'continuous', .* got 'flight'"),
        ("{}:Still", "goal", "action_type: expected 'continuous' for policy 'policies_of_a_user:Still', got 'goal'"),
    ],
)
def test_what_is_no_policy_is_named(module: str, name: str, action_type: str, says: str) -> None:
    """Missing modules and names, what lacks a method, and actions that it is not for: each is told as such."""
    with pytest.raises(ValueError, match=says):
        make_policy(name.format(module), action_type)


def test_a_module_that_fails_tells_why_itself(module: str) -> None:
    """A module that is there but asks for one that is not keeps its own error."""
    with pytest.raises(ModuleNotFoundError, match="a_module_that_nobody_has"):
        make_policy("asks_for_more:Still", "goal")


def test_paths_are_not_taken_for_modules() -> None:
    """Drives, names with slashes and plain names are left to the registry."""
    assert is_own("package.module:Name")
    assert not any(map(is_own, ("C:\\models\\best.npz", "runs/train-0-1", "frontier", "module:", ":Name", "a:b.c")))
