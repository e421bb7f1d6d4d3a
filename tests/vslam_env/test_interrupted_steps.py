"""Steps cut short by an exception: an environment does not go on from a state between two steps."""

import pickle
import sys
from collections.abc import Callable
from copy import deepcopy
from types import FrameType
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, room, small_env, turning

from vslam_env import ExplorationEnv, World, vslam_v0
from vslam_env.solo import SoloExplorationEnv

HALF = r"expected a whole state, got that of a step cut short by an exception\. Call reset\(\) or set_state\(\)\."
Call = Callable[[], Any]


def _interrupted(call: Call, after: int) -> bool:
    """Call a function with a KeyboardInterrupt before one of its lines; return whether it has so many lines."""
    try:
        _traced(call, after)
    except KeyboardInterrupt:
        return True
    return False


def _traced(call: Call, interrupt: int = 0) -> int:
    """Return the number of lines that a call runs, except where native code calls Python, which loses exceptions."""
    lines = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal lines
        code = frame.f_code
        file = code.co_filename
        others = ("pymunk", "numba", "hypothesis")  # hypothesis times garbage collections, which may come at any line
        if any(name in file for name in others) or file.endswith("weakref.py") or code.co_name == "close":
            return None
        lines += event == "line"
        if event == "line" and lines == interrupt:
            raise KeyboardInterrupt
        return trace

    former = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(former)
    return lines


def _places(lines: int) -> list[int]:
    """Return lines at which to interrupt: the first and last of them, and some of the others."""
    return sorted({*range(1, 20), *range(20, lines, max(1, lines // 25)), *range(lines - 25, lines + 1)})


def _rolled(env: ExplorationEnv, steps: int) -> list[bytes]:
    """Return the states after each of some steps."""
    found = []
    for _ in range(steps):
        env.step(turning(env.agents))
        found.append(pickle.dumps(env.state()))
    return found


def _meeting(**options: Any) -> ExplorationEnv:
    return small_env(world=World("room", room().walls, start_poses=MEETING), **options)


@pytest.mark.parametrize("cure", ["reset", "set_state"])
def test_an_interrupted_step_is_not_continued(cure: str) -> None:
    """After an interrupt at any line the state is whole, or steps and copies are refused; numbers never change."""
    env = _meeting()
    env.reset(seed=1)
    begin = env.get_state()
    expected = _rolled(env, 4)
    env.set_state(begin)
    _rolled(env, 1)
    lines, refused = _traced(lambda: env.step(turning(env.agents))), 0
    for place in _places(lines):
        env.set_state(begin) if cure == "set_state" else env.reset(seed=1)
        _rolled(env, 1)
        _interrupted(lambda: env.step(turning(env.agents)), place)
        if env._is_whole:
            done = env.get_state()["cycle"]
            assert pickle.dumps(env.state()) == expected[done - 1]
            assert _rolled(env, 4 - done) == expected[done:]
        else:
            refused += 1
            for refuses in (lambda: env.step(turning(env.agents)), env.get_state, env.clone, lambda: deepcopy(env)):
                with pytest.raises(RuntimeError, match=HALF):
                    refuses()
    assert refused > len(_places(lines)) / 3
    env.set_state(begin) if cure == "set_state" else env.reset(seed=1)
    assert _rolled(env, 4) == expected


def test_a_restored_state_takes_nothing_from_a_step_cut_short() -> None:
    """Bodies that were left in contact do not touch what follows a restored state."""
    env = small_env(world=World("room", room().walls, start_poses=np.array([[0.5, 0.5, -0.3], [0.9, 0.7, 3.0]])))
    ahead = {agent: np.array([1.0, 0.1]) for agent in env.possible_agents}
    env.reset(seed=3)
    begin = env.get_state()
    env.step(ahead)
    expected = env.state()
    for place in range(30, 300, 15):
        env.set_state(begin)
        _interrupted(lambda: env.step(ahead), place)
        env.set_state(begin)
        env.step(ahead)
        np.testing.assert_array_equal(env.state(), expected)


def test_errors_within_a_step_leave_no_state_but_refused_actions_do() -> None:
    """An error of a recorder amid a step is met like an interrupt; actions outside their space change nothing."""
    env = small_env()
    env.reset(seed=1)
    with pytest.raises(ValueError, match="robot_0"):
        env.step({agent: np.array([9.0, 0.0]) for agent in env.agents})
    _rolled(env, 1)

    def fail(readings: object) -> None:
        raise OSError("disk full")

    env.recorder = fail
    with pytest.raises(OSError, match="disk full"):
        env.step(turning(env.agents))
    env.recorder = None
    with pytest.raises(RuntimeError, match=HALF):
        env.step(turning(env.agents))
    with pytest.raises(ValueError, match="seed"):
        env.reset(seed=-1)
    with pytest.raises(RuntimeError, match=HALF):
        env.step(turning(env.agents))


def test_interrupts_of_a_reset_and_of_a_restore_are_met_alike() -> None:
    """A reset or a restore that was cut short leaves the episode before it, or no state."""
    env = _meeting()
    env.reset(seed=1)
    begin = env.get_state()
    expected = _rolled(env, 3)
    other = small_env(world=World("room", room().walls, start_poses=MEETING))
    other.reset(seed=2)
    begin_of_other = other.get_state()
    expected_of_other = _rolled(other, 2)
    for call in (lambda: env.reset(seed=2), lambda: env.set_state(begin_of_other)):
        lines = _traced(call)
        for place in _places(lines):
            env.set_state(begin)
            _rolled(env, 1)
            _interrupted(call, place)
            if env._is_whole:
                assert _rolled(env, 2) in (expected[1:], expected_of_other)
            else:
                with pytest.raises(RuntimeError, match=HALF):
                    env.step(turning(env.agents))


@pytest.mark.parametrize("kind", ["solo", "turns"])
def test_other_forms_of_the_environment_refuse_too(kind: str) -> None:
    """The Gymnasium and the turn-based environment go on right, or ask for a reset."""
    env: Any = (
        SoloExplorationEnv(world=room(), num_particles=10)
        if kind == "solo"
        else vslam_v0.env(world=room(), num_robots=2, num_particles=10)
    )
    parallel: ExplorationEnv = env.unwrapped.parallel if kind == "solo" else env.unwrapped

    def step() -> None:
        for _ in range(1 if kind == "solo" else 2):
            env.step(np.array([0.25, 0.4], np.float32))

    def reset() -> None:
        env.reset(seed=1)

    reset()
    expected = []
    for _ in range(3):
        step()
        expected.append(parallel.state().tobytes())
    reset()
    step()
    lines, refused = _traced(step), 0
    for place in _places(lines):
        reset()
        step()
        _interrupted(step, place)
        if parallel._is_whole:
            step()
            assert parallel.state().tobytes() in expected
        else:
            with pytest.raises(RuntimeError, match=HALF):
                step()
            refused += 1
    assert refused > len(_places(lines)) / 5
    reset()
    step()
    assert parallel.state().tobytes() == expected[0]
