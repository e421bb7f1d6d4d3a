"""The replay of a KITTI drive: tracked stereo features, whose tracks are the landmarks, in the plane."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import FloatArray, check_float
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import between, compose
from slam_backend.readers.kitti import KittiLog, make_camera, motion_noise, steps
from training.experiments.config import PlainConfig
from training.replay.config import REJUVENATE_EVERY, check_common
from training.replay.single_robot import (
    PLANAR_GATE,
    OneReplay,
    PositionScore,
    end_errors,
    metrics_of,
    path_length,
    replay_one,
    score_paths,
)

# A track has its number for a descriptor, so that none is taken for another, and unlike a given identity leaves the
# gate in force: tracks on other cars are refused, and a refused track never starts a second landmark.
OWN_TRACK = 0.5
DEAD_ZONE = 1e9
# Other cars can outvote what stands: the pose is not widened because most tracks contradict it.
RECOVERY_POSITION = 0.0
LOOP_AFTER = 100.0  # [m] driven before a place counts as seen again
LOOP_WITHIN = 10.0  # [m] between two poses of one place
SEGMENTS = range(100, 801, 100)  # [m] over which KITTI compares motions, from every `SEGMENT_EVERY`th pose
SEGMENT_EVERY = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class KittiConfig(PlainConfig):
    """All that decides a replay of such a drive; the noise of its velocities is read off the log itself.

    Attributes:
        path: The archive, or the folder with it.
        truth: File of the true poses, or None for that beside the archive.
        duration: Seconds to replay [s], or None for all.
        particles: Of the filter.
        estimator: Its proposal.
        rejuvenate_every: Steps of the log after which particles are drawn anew from smoothed paths, as `FilterOptions`
            has it; 0: never.
        seed: Of all random draws.
        sigma_px: Assumed standard deviation of a feature's column [px]: features creep along while they are tracked.
        sigma_disparity_px: Assumed standard deviation of its disparity [px]. The rows of both images, which should
            agree, differ by 0.38 px in `0027.npz`.
    """

    path: str
    truth: str | None = None
    duration: float | None = None
    particles: int = 100
    estimator: Literal["fastslam2", "fastslam1"] = "fastslam2"
    rejuvenate_every: int = REJUVENATE_EVERY
    seed: int = 0
    sigma_px: float = 1.0
    sigma_disparity_px: float = 0.5

    def __post_init__(self) -> None:
        check_common(self.particles, self.estimator, self.seed, self.duration, self.rejuvenate_every)
        for name in ("sigma_px", "sigma_disparity_px"):
            check_float(name, getattr(self, name), "Give pixels.", above=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class KittiScore:
    """Paths of the left camera against the true one, in the plane.

    Attributes:
        truth: (n, 3) float64 [m, m, rad]. At the first n steps.
        path: (T, 3) float64 [m, m, rad], start frame. Where the estimate puts the camera at each step.
        reckoned: (T, 3) float64 [m, m, rad], start frame. Likewise dead reckoning.
        estimate: Score of the estimate.
        odometry: Score of dead reckoning.
        loop: Steps (earlier, later) at which the car was at one place again, nearest of all; None if it never was.
        loop_error: Error [m] of the estimated motion between these two steps; NaN if there are none.
        drifts: Mean errors of the motions over segments, of the estimate and of dead reckoning; see `mean_drift`.
        ends: Errors at the last true pose, from the true start, no fit [m], of the estimate and of dead reckoning.
    """

    truth: FloatArray
    path: FloatArray
    reckoned: FloatArray
    estimate: PositionScore
    odometry: PositionScore
    loop: tuple[int, int] | None
    loop_error: float
    drifts: tuple[float, float]
    ends: tuple[float, float]


def replay(log: KittiLog, config: KittiConfig, on_step: Callable[[float], None] = lambda done: None) -> OneReplay:
    """Let a filter live through a drive; poses are those of the inertial unit.

    Args:
        log: What `load_kitti` returned.
        config: Assumptions and sizes.
        on_step: Called after each step with the share of the drive that is done, in (0, 1].
    """
    camera = make_camera(log, config.sigma_px, config.sigma_disparity_px)
    readings = steps(log, camera)
    options = FilterOptions(
        num_particles=config.particles,
        camera=camera,
        motion=motion_noise(log),
        proposal=config.estimator,
        rejuvenate_every=config.rejuvenate_every or None,
        position_gate=PLANAR_GATE,
        dead_zone=DEAD_ZONE,
        recovery_position=RECOVERY_POSITION,
        descriptor_gate=OWN_TRACK,
    )
    slam = FastSlam.from_options(1, options, config.seed)
    read = zip(readings.odometry, readings.measurements, strict=True)
    return replay_one(slam, readings.times, read, on_step)


def score(result: OneReplay, log: KittiLog) -> KittiScore | None:
    """Score a replay against the true path of the camera; None if that is not known."""
    if log.truth is None:
        return None
    truth = log.truth.poses[: len(result.times)]
    paths = [compose(poses, np.array([*log.mount[:2], 0.0])) for poses in (result.path, result.reckoned)]
    scores = score_paths(paths, truth)
    loop = find_loop(truth)
    error = float("nan")
    if loop is not None:
        motions = [between(path[loop[0]], path[loop[1]]) for path in (paths[0], truth)]
        error = float(np.hypot(*(motions[0] - motions[1])[:2]))
    drifts = (mean_drift(paths[0], truth), mean_drift(paths[1], truth))
    ends = end_errors(paths, truth)
    return KittiScore(truth, paths[0], paths[1], scores[0], scores[1], loop, error, drifts, (ends[0], ends[1]))


def mean_drift(path: FloatArray, truth: FloatArray) -> float:
    """Return the mean error of the estimated motion over segments of the true path, as a share of their lengths.

    Segments are of 100, 200, ..., 800 m, and weigh alike (Geiger, Lenz, Urtasun, CVPR 2012).

    Args:
        path: (T, 3) float64 [m, m, rad]. Estimate, any frame.
        truth: (n, 3) float64 [m, m, rad]. At the first n <= T steps, any frame.

    Returns:
        The share; NaN if the true path is shorter than 100 m.
    """
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    errors = [np.empty(0)]
    for length in SEGMENTS:
        first = np.arange(0, len(truth), SEGMENT_EVERY)
        last = np.searchsorted(driven, driven[first] + length)
        first, last = first[last < len(truth)], last[last < len(truth)]
        off = between(between(truth[first], truth[last]), between(path[first], path[last]))
        errors.append(np.hypot(off[:, 0], off[:, 1]) / length)
    found = np.concatenate(errors)
    return float(found.mean()) if len(found) else float("nan")


def find_loop(truth: FloatArray) -> tuple[int, int] | None:
    """Return the two nearest poses among (n, 3), a way apart, as (earlier, later); None if the car never came back."""
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    apart = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1))
    apart[driven[None, :] - driven[:, None] < LOOP_AFTER] = np.inf
    earlier, later = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return (int(earlier), int(later)) if apart[earlier, later] <= LOOP_WITHIN else None


def summarise(result: OneReplay, scored: KittiScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; what cannot be known is NaN, as are errors of the map."""
    length = path_length(scored.truth) if scored else float("nan")
    own = {
        "true_path_m": length,
        "end_error_m": scored.ends[0] if scored else float("nan"),
        "end_error_percent": 100.0 * scored.ends[0] / length if scored else float("nan"),
        "dead_reckoning_end_error_m": scored.ends[1] if scored else float("nan"),
        "loop_error_m": scored.loop_error if scored else float("nan"),
        "mean_drift": scored.drifts[0] if scored else float("nan"),
        "dead_reckoning_mean_drift": scored.drifts[1] if scored else float("nan"),
    }
    return metrics_of(result, (scored.estimate, scored.odometry) if scored else None, own)
