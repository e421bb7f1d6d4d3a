"""Estimates from the readings of an episode, from batch maximum likelihood with all information to the filter's own.

Each of `LADDER` differs from the one before in one thing. Positions of paths are in the robots' own start frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam_backend.core.validation import MOST, FloatArray, IntArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.models.odometry import OdometryModel
from studies.bounds.episodes import NONE, FilterTrack, RecordedEpisode, components
from studies.bounds.online import Fusions, ideal_online
from training.stereo_runs.batch_ml import most_likely, robust_weights
from training.stereo_runs.batch_problem import BatchProblem, Estimate, diagonal
from vslam_env.world import OdometryNoise

TRUE_FLOOR = 2e-5  # [m, rad] of true odometry noise in a tick, which is 0 for robots at rest
ASSUMED_FLOOR = 1e-5  # [m, rad] of assumed odometry noise, as in the smoother
# Estimates from the readings of an episode. Each of `LADDER` after the first differs from the one before by the loss
# that is named with it.
LADDER = (
    ("batch", "information"),  # batch ML; true associations, noise and prior of the odometry biases
    ("noise_as_assumed", "assumed noise"),  # the same, with the noise and the prior that the filter assumes
    ("own_associations", "association"),  # the same, with the associations that the filter made
    ("online", "online"),  # each pose of it from the readings up to its own tick, linearised at the batch estimate
    ("all_keyframes", "particles"),  # the filter, rejuvenated with every tick as a keyframe
    ("filter", "keyframe reduction"),  # the filter
)


@dataclass(frozen=True, slots=True, eq=False)
class Associations:
    """Landmark labels (n,) int64 of all measurements by tick and robot, `NONE` for those without a landmark."""

    labels: Sequence[Sequence[IntArray]]
    merges: Sequence[tuple[int, Sequence[int], Sequence[int]]]  # Tick and groups of merges


def with_all_keyframes(options: FilterOptions) -> FilterOptions:
    """Return filter options with each tick with measurements as a keyframe, without slices or limits of effort."""
    whole = replace(
        options.smoothing, max_keys=MOST, further_keys=0, recent_keys=MOST, rigid_within=0.0, incremental=False,
        free_sightings=MOST,
    )  # fmt: skip
    return replace(options, smoothing=whole)


def estimates(episode: RecordedEpisode, track: FilterTrack) -> dict[str, Any]:
    """Return the paths (K, T, 3) [m, m, rad], own start frames, of all estimates but `all_keyframes`.

    Also `ideal_covariances` (K, T, 3, 3), and under `batch_estimate` and `batch_names` the batch estimate with the true
    landmarks of its rows.
    """
    noise, camera = episode.config.odometry, episode.config.landmark_sensor.camera
    options = episode.config.belief.filter
    true, own = Associations(episode.true_ids, track.merges), Associations(track.labels, track.merges)
    true_bias = noise.bias_distance, noise.bias_heading_per_metre, 0.0
    true_noise = true_covariances(episode.odometry, noise)
    problem, fusions = build_problem(episode, true, camera, true_noise, true_bias)
    at = true_start(episode, problem)
    batch = most_likely(problem, at)
    ideal = ideal_online(problem, batch, fusions=fusions)
    motion = options.motion
    assumed = replace(
        problem, camera=replace(options.camera, max_range=camera.max_range),
        odometry_covariances=assumed_covariances(episode.odometry, motion),
        bias_sigmas=(motion.bias_scale, motion.bias_heading, motion.bias_turn),
    )  # fmt: skip
    robust = float(np.sqrt(options.smoothing.kernel)) or None
    matched, own_fusions = build_problem(
        episode, own, assumed.camera, assumed.odometry_covariances, assumed.bias_sigmas
    )
    in_batch = most_likely(matched, true_start(episode, matched), robust)
    squares = np.einsum("ni,ni->n", *[matched.sights(in_batch).residuals] * 2)
    online = ideal_online(matched, in_batch, robust_weights(squares, robust), own_fusions)
    return {
        "odometry": episode.dead_reckoning(), "ideal_online": ideal.paths, "batch": batch.paths,
        "noise_as_assumed": most_likely(assumed, true_start(episode, assumed)).paths,
        "own_associations": in_batch.paths, "online": online.paths, "filter": track.paths,
        "ideal_covariances": ideal.covariances, "batch_estimate": batch, "batch_names": problem.names,
    }  # fmt: skip


def true_covariances(odometry: FloatArray, noise: OdometryNoise) -> FloatArray:
    """Return the covariances (K, T - 1, 3, 3) of true odometry noise, see `vslam_env.world.odometry`, without bias.

    The distance of the reading stands for the true one. Half of a turn's error also turns the translation.

    Args:
        odometry: (K, T - 1, 3) float64 [m, m, rad]. Readings.
    """
    distance = np.hypot(odometry[..., 0], odometry[..., 1])
    heading = np.arctan2(odometry[..., 1], odometry[..., 0])
    c, s = np.cos(heading), np.sin(heading)
    causes = np.zeros((*odometry.shape, 3))  # of errors along, across and of the turn
    causes[..., 0, 0], causes[..., 0, 1], causes[..., 0, 2] = c, -s, -0.5 * distance * s
    causes[..., 1, 0], causes[..., 1, 1], causes[..., 1, 2] = s, c, 0.5 * distance * c
    causes[..., 2, 2] = 1.0
    sigmas = np.stack(
        [noise.sigma_distance * distance, np.zeros_like(distance), noise.sigma_heading_per_metre * distance], axis=-1
    )  # fmt: skip
    return causes @ diagonal(sigmas**2 + TRUE_FLOOR**2) @ causes.swapaxes(-1, -2)


def assumed_covariances(odometry: FloatArray, motion: OdometryModel) -> FloatArray:
    """Return the covariances (K, T - 1, 3, 3) of readings (K, T - 1, 3) that a filter assumes."""
    return diagonal([motion.variances(own) + ASSUMED_FLOOR**2 for own in odometry])


def build_problem(
    episode: RecordedEpisode,
    found: Associations,
    camera: Any,
    covariances: FloatArray,
    bias: tuple[float, float, float],
) -> tuple[BatchProblem, Fusions]:
    """Return the least-squares problem of an episode with given associations, and its landmarks that merges fuse.

    Robots that merged share landmarks; the start of each but the first is then unknown. Landmarks that were measured
    once carry no information and are left out.
    """
    count = len(episode.true_paths)
    first = components(count, found.merges)
    points, robots, steps, labels = [], [], [], []
    for step, (tick, named) in enumerate(zip(episode.readings, found.labels, strict=True)):
        for robot, (own, label) in enumerate(zip(tick, named, strict=True)):
            used = label != NONE
            points.append(own.measurements.points[used])
            labels.append(label[used] * count + first[robot])
            robots.append(np.full(used.sum(), robot))
            steps.append(np.full(used.sum(), step))
    every = np.concatenate(labels)
    _, rows, counts = np.unique(every, return_inverse=True, return_counts=True)
    kept = counts[rows] > 1
    names, landmarks = _by_first(every[kept])
    of_robot, of_step = np.concatenate(robots)[kept], np.concatenate(steps)[kept]
    problem = BatchProblem(
        starts=np.zeros((count, 3)), odometry=episode.odometry, odometry_covariances=covariances, camera=camera,
        points=np.concatenate(points)[kept], robots=of_robot, steps=of_step, landmarks=landmarks, names=names // count,
        bases=episode.true_paths[:, 0].copy(), loose=first != np.arange(count), bias_sigmas=bias,
    )  # fmt: skip
    return problem, fusions_of_merges(problem, found.merges)


def _by_first(labels: IntArray) -> tuple[IntArray, IntArray]:
    """Return the distinct labels (k,) by first occurrence, and the row (n,) of each label."""
    values, firsts, rows = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(firsts)
    return values[order], np.argsort(order)[rows]


def fusions_of_merges(problem: BatchProblem, merges: Sequence[tuple[int, Sequence[int], Sequence[int]]]) -> Fusions:
    """Return the copies of landmarks that groups hold apart until they merge."""
    group = np.arange(len(problem.starts))
    held: list[dict[int, int]] = [{} for _ in group]  # copy of each landmark, by the first robot of the group
    copies, pairs, count, begin = np.empty(len(problem.points), dtype=np.int64), [], 0, 0
    for tick, a, b in [*sorted(merges, key=lambda merge: merge[0]), (problem.num_steps, (), ())]:
        end = int(np.searchsorted(problem.steps, tick, side="right"))
        for row in range(begin, end):
            own, landmark = held[group[problem.robots[row]]], int(problem.landmarks[row])
            if landmark not in own:
                own[landmark] = count
                count += 1
            copies[row] = own[landmark]
        begin = end
        if len(a):
            kept, other = group[a[0]], group[b[0]]
            pairs += [
                (tick, held[kept][k], c) for k, c in held[other].items() if k in held[kept] and held[kept][k] != c
            ]
            held[kept] = held[other] | held[kept]
            group[group == other] = kept
    return Fusions(copies, np.array(pairs, dtype=np.int64).reshape(-1, 3))


def true_start(episode: RecordedEpisode, problem: BatchProblem) -> Estimate:
    """Return the true paths, so that the descent finds the minimum next to the truth, and landmarks as mostly seen."""
    return problem.with_landmarks_at(episode.own_true_paths)
