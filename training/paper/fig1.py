"""The paper's Fig. 1: clouds of particles along the paths of a few robots, by odometry alone and with what they see."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, check_float, check_int
from training.bench.accuracy.batch_problem import BatchProblem
from training.bench.accuracy.runs import STEP, StereoRun, simulate_run
from training.bench.accuracy.world import start_crossings
from training.experiments.config import PlainConfig
from training.paper.fig6.noise_regimes import FILTER_OPTIONS, REGIMES

COMMAND = "paper fig1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fig1Config(PlainConfig):
    """All that decides the figure.

    Attributes:
        robots: K.
        particles: M.
        length: Of each robot's path [m].
        every: Distance along the path between two clouds [m].
        seed: Of the run, and of the filters' draws.
    """

    robots: int = 3
    particles: int = 400
    length: float = 30.0
    every: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("particles", self.particles, 1, "Use at least one particle; 400 make a cloud.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        check_float("every", self.every, "A cloud can be drawn after each step.", at_least=STEP)
        REGIMES["paper"].spec(self.robots, self.length)  # refuses the rest
        start_crossings(self.robots, np.random.default_rng(0))  # each robot starts at one of its own


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """Particles along the paths of K robots.

    Attributes:
        steps: (n,) int64. When they were taken, the start first.
        poses: (n, K, M, 3) float64 [m, m, rad], world frame. All particles, after resampling.
        paths: (K, T, 3) float64 [m, m, rad], world frame. Without measurements: of the odometry as it was read; with
            them: the filter's estimate of each pose at its own step.
        landmarks: (N, 3) float64 [m], world frame. The map at the end, empty without measurements.
    """

    steps: IntArray
    poses: FloatArray
    paths: FloatArray
    landmarks: FloatArray

    def spreads(self) -> FloatArray:
        """Return the RMS distance (n, K) [m] of the particles of each cloud from its mean."""
        apart = self.poses[..., :2] - self.poses[..., :2].mean(axis=2, keepdims=True)
        return np.asarray(np.sqrt((apart**2).sum(axis=3).mean(axis=2)))


def simulate_fig1(config: Fig1Config) -> StereoRun:
    """Return the run that the figure shows: the robots of Fig. 6's own regime."""
    return simulate_run(REGIMES["paper"].spec(config.robots, config.length), config.seed)


def draw_clouds(run: StereoRun, config: Fig1Config, measured: bool) -> Clouds:
    """Let the particles of `fastslam1` follow the robots.

    Args:
        run: What the robots do and read.
        config: Of the figure.
        measured: Whether they weigh and learn from what the robots see; otherwise the motion model alone moves them
            (Eq. 4).
    """
    slam = run.build_filter(config.particles, "fastslam1", seed=config.seed, **FILTER_OPTIONS["fastslam1"])
    robots = range(config.robots)
    stride = max(round(config.every / STEP), 1)
    steps, poses, paths = [], [], []
    for step, reading in enumerate(run.readings()):
        slam.step(**(reading if measured else reading | {"measurements": [None] * config.robots, "identities": None}))
        if step % stride == 0:
            steps.append(step)
            poses.append([slam.particles(robot)[0] for robot in robots])
        paths.append([slam.pose(robot).mean for robot in robots])
    reckoned = BatchProblem.of_run(run).dead_reckoning().paths
    return Clouds(
        steps=np.array(steps),
        poses=np.array(poses),
        paths=np.array(paths).transpose(1, 0, 2) if measured else reckoned,
        landmarks=slam.map().means if measured else np.zeros((0, 3)),
    )


def figures_of(run: StereoRun, clouds: Clouds) -> list[dict[str, float]]:
    """Return for each robot how far path and last cloud are off.

    Returns:
        `path_rms_m` of the dashed path, `end_error_m` of it at the last cloud, and `end_spread_m` of that cloud.
    """
    errors = np.linalg.norm((clouds.paths - run.true_paths)[..., :2], axis=2)
    spreads = clouds.spreads()[-1]
    return [
        {
            "path_rms_m": float(np.sqrt((own**2).mean())),
            "end_error_m": float(own[clouds.steps[-1]]),
            "end_spread_m": float(spread),
        }
        for own, spread in zip(errors, spreads, strict=True)
    ]
