"""Compilation of the kernels of an environment before its first episode."""

from collections.abc import Collection

import numpy as np

from slam_backend.core.compilation.compiler import (
    Progress,
    compile_kernels,
    exempt_from_collection,
    recorded_signatures,
)
from slam_backend.core.compilation.messages import watch_compilation
from slam_backend.core.jit import IS_PLAIN
from slam_backend.warm_up import EXTRAS, extras_of, needed, run_all_paths
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.navigation import cells_of, distance_map, lengths_between, open_tour, sees, share_places, tour_length
from vslam_env.sensors import LandmarkSensorConfig
from vslam_env.world import World

WALLS = np.array([[0.0, 0.0, 9.0, 0.0], [9.0, 0.0, 9.0, 9.0], [9.0, 9.0, 0.0, 9.0], [0.0, 9.0, 0.0, 0.0]])
STARTS = np.array([[3.0, 4.0, 0.0], [3.0, 5.0, 0.1]])  # side by side, facing the same wall
STEPS = 3


def warm_up(
    config: EnvConfig | None = None,
    *,
    everything: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
    costs: dict[str, float] | None = None,
) -> float:
    """Compile the kernels that an environment needs, or load them from the cache; see `slam_backend.warm_up`.

    Args:
        config: Configuration of the environment; None: the default one.
        everything: Whether to compile also the kernels that this configuration does not need. Otherwise these are
            compiled at their first call.
        workers: Number of processes that compile; None: one per core.
        progress: Callback that receives the number of compiled kernels, their total and the estimated time left [s].
        costs: Processor time [s] of each kernel compiled, by dotted name, is added to this dict.

    Returns:
        Time spent compiling [s]; 0 if all kernels came from the cache, or numba's compiler is switched off.
    """
    if IS_PLAIN:
        return 0.0
    chosen = EnvConfig() if config is None else config
    extras = set(EXTRAS) if everything else _extras_of(chosen)
    signatures = needed(recorded_signatures("slam_backend", "vslam_env"), extras)
    seconds = compile_kernels(signatures, workers, progress, costs)
    with watch_compilation(lambda name: None) as watch:
        _run_all_paths(extras)
    exempt_from_collection()
    return seconds + watch.seconds


def signatures_of(config: EnvConfig) -> dict[str, list[str]]:
    """Return the signatures of the kernels that an environment needs, by dotted name."""
    return needed(recorded_signatures("slam_backend", "vslam_env"), _extras_of(config))


def _extras_of(config: EnvConfig) -> set[str]:
    """Return the keys of `EXTRAS` that an environment needs."""
    return extras_of(config.belief.filter) | ({"images"} if config.sensor == "stereo" else set())


def _run_all_paths(extras: Collection[str]) -> None:
    """Run a tiny environment along all paths that end in a kernel."""
    run_all_paths(extras)
    sensor = LandmarkSensorConfig(false_points=2.0)
    config = EnvConfig(num_robots=2, action_type="goal", oracle_merge=True, landmark_sensor=sensor)
    env = ExplorationEnv(config, World("room", WALLS))
    env.reset(seed=0)  # drawn starts; given ones in the next line
    env.reset(seed=0, options={"start_poses": STARTS})
    for _ in range(STEPS):
        valid = {agent: env.belief(agent).candidates.valid for agent in env.agents}
        env.step({agent: 1 + int(slots.argmax()) if slots.any() else 0 for agent, slots in valid.items()})
    if "planners" in extras:
        belief = env.belief("robot_0")
        ways, places = distance_map(belief.grid.cells, belief.pose[:2]), np.zeros((2, 2))
        between = lengths_between(ways, places, places)
        tour_length(open_tour(between[0], between), between[0], between)
        share_places(between, between)
        sees(ways, places, cells_of(ways, places), 1.0)
