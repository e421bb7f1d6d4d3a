"""PettingZoo's own suite over a table of configurations, with warnings as errors.

Left out: `bombardment_test`, which fails upstream on every environment; `performance_benchmark`, which tests nothing;
`test_save_obs` and `manual_control_test`, which are about observations that are one picture, and about keyboards.
"""

import inspect
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, room
from pettingzoo.utils.conversions import aec_to_parallel

from vslam_env import World, vslam_v0, vslam_v1

pytestmark = [
    # pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
    pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning"),
    # the suite remarks that named observations are no plain arrays
    pytest.mark.filterwarnings("ignore:Observation is not a NumPy array"),
    pytest.mark.filterwarnings("ignore:Observation space for each agent probably should be"),
    # a state holds places in the world, and worlds may be of any size
    pytest.mark.filterwarnings("ignore:Environment's (min|max)imum state space value is"),
]

BASE: dict[str, Any] = {"world": room(), "num_robots": 2, "num_particles": 5, "max_cycles": 6}
TABLE: dict[str, dict[str, Any]] = {
    "continuous": {},
    "discrete, flat": {"action_type": "discrete", "observation_type": "flat"},
    "goals": {"action_type": "goal"},
    "goals, flat, two ticks": {"action_type": "goal", "observation_type": "flat", "decision_ticks": 2},
    "one robot": {"num_robots": 1},
    "meeting": {"world": World("room", room().walls, start_poses=MEETING), "oracle_merge": True},
    "oracles": {"oracle_pose": True, "oracle_association": True},
    "hard": {"preset": "hard"},
    "ends by recall": {"stop_at_recall": 0.01},
    "shared rewards": {"reward": {"map_error": 1.0, "coverage": 0.5, "collisions": 0.1}, "shared_reward": True},
    "a family": {"world": "fig5"},
    "rendered eyes": {"sensor": "stereo"},
    "version 1": {"version": vslam_v1},
    "version 1, goals, flat": {"version": vslam_v1, "action_type": "goal", "observation_type": "flat"},
    "two keys": {"observation_keys": ("scan", "pose")},
}


@pytest.fixture
def suite() -> Any:
    """PettingZoo's tests, imported where the warning of their import is looked away from."""
    import pettingzoo.test

    return pettingzoo.test


def _parallel(version: Any = vslam_v0, **kwargs: Any) -> Any:
    return version.parallel_env(**BASE | kwargs)


def _turns(version: Any = vslam_v0, **kwargs: Any) -> Any:
    return version.env(**BASE | kwargs)


@pytest.mark.parametrize("options", TABLE.values(), ids=TABLE)
def test_parallel_environments(suite: Any, options: dict[str, Any]) -> None:
    """`parallel_api_test` and `parallel_seed_test` pass."""
    suite.parallel_api_test(_parallel(**options), num_cycles=8)
    suite.parallel_seed_test(partial(_parallel, **options), num_cycles=3)


@pytest.mark.parametrize("options", TABLE.values(), ids=TABLE)
def test_turn_based_environments(suite: Any, options: dict[str, Any]) -> None:
    """`api_test` and `seed_test` pass."""
    suite.api_test(_turns(**options), num_cycles=8)
    suite.seed_test(partial(_turns, **options), num_cycles=3)


@pytest.mark.parametrize("options", [TABLE["continuous"], TABLE["goals"]], ids=["continuous", "goals"])
def test_state(suite: Any, options: dict[str, Any]) -> None:
    """`state_test` passes."""
    suite.state_test(_turns(**options), _parallel(**options), num_cycles=3)


@pytest.mark.parametrize("options", [TABLE["continuous"], TABLE["goals"]], ids=["continuous", "goals"])
def test_episodes_are_as_long_as_asked(suite: Any, options: dict[str, Any]) -> None:
    """`max_cycles_test` passes for both kinds of environment."""
    made = {name: partial(make, **options) for name, make in (("parallel_env", _parallel), ("env", _turns))}
    suite.max_cycles_test(SimpleNamespace(**made))


@pytest.mark.filterwarnings("ignore:render_mode='human' shows nothing")
def test_rendering(suite: Any) -> None:
    """`render_test` passes: pictures are pictures, and `human` returns nothing, with a screen or without."""
    suite.render_test(_turns)


def test_aec_and_parallel_conversions_agree() -> None:
    """The turn-based environment made parallel again gives what the parallel one gives."""
    there, back = _parallel(), aec_to_parallel(vslam_v0.raw_env(**BASE))
    seen, also = there.reset(seed=4)[0], back.reset(seed=4)[0]
    for _ in range(3):
        actions = {agent: np.array([0.5, 0.2], np.float32) for agent in there.agents}
        for agent in there.agents:
            for name in seen[agent]:
                np.testing.assert_array_equal(seen[agent][name], also[agent][name])
        seen, also = there.step(actions)[0], back.step(actions)[0]


def test_the_whole_pettingzoo_suite_is_used(suite: Any) -> None:
    """What `pettingzoo.test` offers is either used above or left out for the reason at the top."""
    offered = {name for name, _ in inspect.getmembers(suite, inspect.isfunction) if name.endswith("_test")}
    used = {"api_test", "parallel_api_test", "seed_test", "parallel_seed_test", "state_test", "max_cycles_test"}
    assert offered - used - {"render_test"} <= {"bombardment_test", "manual_control_test"}
