"""Maps of two independent robots in one office at several stages, with the true data associations."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between
from slam_backend.maps.landmark_map import LandmarkMap
from training.stereo_runs.runs import FALSE_POINT, STEP, RunSpec, StereoRun, simulate_run

ROBOTS = 2
MEASUREMENTS = 16  # per step, of both robots together
# As in the simulation's unknown association: groups of three similar landmarks, false points, wrong descriptors.
LOOK_ALIKES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Maps of both robots after a certain path length."""

    length: float  # Path length of each robot [m]
    # Map of each robot, start frame; mixture covariances, which include the uncertainty of the path
    maps: tuple[LandmarkMap, LandmarkMap]
    # True landmark of each landmark in each map, (N,) int64; `FALSE_POINT`: none
    true_ids: tuple[IntArray, IntArray]

    @property
    def shared(self) -> int:
        """Number of true landmarks that both maps contain."""
        held = [set(ids[ids != FALSE_POINT].tolist()) for ids in self.true_ids]
        return len(held[0] & held[1])


def simulate_pair(seed: int, length: float, landmarks: int) -> StereoRun:
    """Sample an office and the paths of two robots through it, from different crossings."""
    return simulate_run(
        RunSpec(
            robots=ROBOTS, length=length, measurements=MEASUREMENTS, landmarks=landmarks, association="unknown",
            look_alikes=LOOK_ALIKES,
        ),
        seed,
    )  # fmt: skip


def true_motion(run: StereoRun) -> FloatArray:
    """Return the transform (3,) from the second robot's start frame to the first one's [m, m, rad]."""
    return between(run.true_paths[0, 0], run.true_paths[1, 0])


def map_alone(run: StereoRun, particles: int, seed: int, every: float) -> Iterator[Stage]:
    """Let each robot map on its own, with its start as the origin.

    Yields:
        Stages; the last one is at the end of the run.
    """
    noise = run.spec.noise
    streams = np.random.SeedSequence(seed).spawn(ROBOTS)
    filters = [
        FastSlam(
            1, num_particles=particles, camera=noise.camera, motion=noise.motion, rejuvenate_every=None, seed=stream
        )
        for stream in streams
    ]
    behind: list[dict[int, int]] = [{} for _ in range(ROBOTS)]
    stride = max(round(every / STEP), 1)
    for step, (frames, names) in enumerate(zip(run.frames, run.names, strict=True)):
        for robot, slam in enumerate(filters):
            odometry = run.odometry[step, robot] if step else None
            created = slam.step([odometry], [frames[robot]]).created[0]
            made = created >= 0
            behind[robot].update(zip(created[made].tolist(), names[robot][made].tolist(), strict=True))
        last = step == run.num_steps - 1
        if last or (step and step % stride == 0):
            maps = [slam.map("mixture") for slam in filters]
            true_ids = [
                np.array([behind[robot].get(name, FALSE_POINT) for name in held.ids.tolist()], dtype=np.int64)
                for robot, held in enumerate(maps)
            ]
            yield Stage(step * STEP, (maps[0], maps[1]), (true_ids[0], true_ids[1]))
