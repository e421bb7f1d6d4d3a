"""Trial of `vslam bench accuracy --world`: an episode, and the losses between its information and the filter's error.

Each loss is the factor between the position errors of two estimates from the same readings, which differ in one thing;
`LADDER` lists them from batch maximum likelihood, which has all information, to the filter.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import MOST, BoolArray, FloatArray, IntArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import inverse, transform_points, wrap_angle
from slam_backend.metrics import map_rmse, nees
from slam_backend.models.odometry import OdometryModel
from training.bench.accuracy.batch_ml import most_likely, robust_weights
from training.bench.accuracy.batch_problem import BatchProblem, Estimate, diagonal
from training.bench.accuracy.episodes import NONE, FilterTrack, RecordedEpisode, components, record_episode, replay
from training.bench.accuracy.online_bound import Fusions, ideal_online
from training.bench.config import AccuracyConfig, EpisodeTrial
from training.bench.exploration.players import parted
from training.episodes.guard import PolicyError
from training.experiments.trial_store import FAILED
from vslam_env import vslam_v1
from vslam_env.world import OdometryNoise

EPISODES_FILE = "episodes.jsonl"
LONG_UNSEEN = 100  # ticks without a measurement after which a landmark is seen again
LONGEST_DECISION = 600.0  # [s]
LEAST_SIGMA = 1e-4  # [m, rad]; lower limit of claimed standard deviations: robots at their start know their pose
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
ESTIMATES = ("odometry", "ideal_online", *(name for name, _ in LADDER))
LOSSES = tuple(loss for _, loss in LADDER[1:])


@dataclass(frozen=True, slots=True, eq=False)
class Associations:
    """Landmark labels (n,) int64 of all measurements by tick and robot, `NONE` for those without a landmark."""

    labels: Sequence[Sequence[IntArray]]
    merges: Sequence[tuple[int, Sequence[int], Sequence[int]]]  # Tick and groups of merges


@single_threaded_blas
def play(config: AccuracyConfig, trial: EpisodeTrial) -> dict[str, Any]:
    """Run an episode and return the trial with the errors of all estimates from its readings.

    - `position_rms_m`: for each of `ESTIMATES` the RMS position error [m] over robots and ticks, in start frames and
      without a fit; `heading_rms_deg` and `end_error_m` (mean over robots) in the same way.
    - `nees_median` (ideal 2.4), `nees_mean` (ideal 3): of the poses (3-D) by `ideal_online` and by `filter`.
    - `map_rms_m`: RMS error of the filter's landmarks at the end, `batch_map_rms_m`: of the same landmarks in the batch
      estimate, both in start frames, means over robots; `map_recall`, `map_precision`.
    - `wrong_match_share`: of the filter's matches, those with another true landmark than the landmark's first
      measurement; `unused_share`: of the measurements of true landmarks, those without a landmark;
      `copies_per_landmark`: landmarks of the filter for each true one.
    - `revisits`: number of times that a robot sees a landmark again which it did not see for `LONG_UNSEEN` ticks, and
      `missed_revisits`: those in which none of its measurements is associated with what it was before.
    - `merges`: merges that were not undone; `groups`: groups at the end; `way_m`, `duration_s`, `landmarks`,
      `num_measurements`, `seconds`.

    If the policy fails, the trial is returned with the error as `failed`, and no metrics.
    """
    begin = time.perf_counter()
    env = vslam_v1.parallel_env(config=config.environment(trial))
    try:
        episode = record_episode(env, parted(trial.policy).make(env, LONGEST_DECISION), trial.seed)
    except PolicyError as error:
        return {**asdict(trial), FAILED: str(error)}
    finally:
        env.close()
    options = episode.config.belief.filter
    track = replay(episode, options)
    found = estimates(episode, track)
    found["all_keyframes"] = replay(episode, with_all_keyframes(options)).paths
    record = episode.record
    return {
        **asdict(trial), **score_paths(episode, found),
        **_consistency(episode, {"ideal_online": found["ideal_covariances"], "filter": track.covariances}, found),
        **_maps(episode, found), **_matches(episode, track), **count_revisits(episode.true_ids, track.labels),
        "merges": len(track.merges), "groups": len(record.groups),
        "way_m": float(np.mean([float(info["distance"]) for info in record.infos])),
        "duration_s": float(record.times[-1]),
        "num_measurements": sum(len(ids) for tick in episode.true_ids for ids in tick),
        "seconds": time.perf_counter() - begin,
    }  # fmt: skip


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
    """Return the true paths, so that the descent finds the minimum next to the truth, and landmarks as first seen."""
    return problem.with_first_sights(episode.own_true_paths)


def score_paths(episode: RecordedEpisode, found: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Return the errors of the paths of all estimates, by name; see `play`."""
    rows: dict[str, dict[str, float]] = {"position_rms_m": {}, "heading_rms_deg": {}, "end_error_m": {}}
    for name in ESTIMATES:
        errors = _errors(found[name], episode)
        rows["position_rms_m"][name] = float(np.sqrt((errors[..., :2] ** 2).sum(axis=-1).mean()))
        rows["heading_rms_deg"][name] = float(np.degrees(np.sqrt((errors[..., 2] ** 2).mean())))
        rows["end_error_m"][name] = float(np.hypot(errors[:, -1, 0], errors[:, -1, 1]).mean())
    return rows


def _errors(paths: FloatArray, episode: RecordedEpisode) -> FloatArray:
    """Return estimate minus truth (K, T, 3) of paths in start frames."""
    errors = paths - episode.own_true_paths
    errors[..., 2] = wrap_angle(errors[..., 2])
    return np.asarray(errors)


def _consistency(
    episode: RecordedEpisode, claimed: dict[str, FloatArray], found: dict[str, Any]
) -> dict[str, dict[str, float]]:
    """Return median and mean NEES of the poses after the first tick."""
    rows: dict[str, dict[str, float]] = {"nees_median": {}, "nees_mean": {}}
    for name, covariances in claimed.items():
        errors = _errors(found[name], episode)[:, 1:].reshape(-1, 3)
        values = nees(errors, covariances[:, 1:].reshape(-1, 3, 3) + LEAST_SIGMA**2 * np.eye(3))
        rows["nees_median"][name], rows["nees_mean"][name] = float(np.median(values)), float(values.mean())
    return rows


def _maps(episode: RecordedEpisode, found: dict[str, Any]) -> dict[str, float]:
    """Return the errors of the maps at the end, of the filter and of the batch estimate on the same landmarks."""
    record, batch = episode.record, found["batch_estimate"]
    row_of = {int(name): row for row, name in enumerate(found["batch_names"])}
    own, peer = [], []
    for robot, (held, claims) in enumerate(zip(record.maps, record.map_claims, strict=True)):
        start = episode.true_paths[robot, 0]
        truths = transform_points(inverse(start), episode.landmarks)
        matched = map_rmse(held.means, truths[episode.observable], claims=claims).matched
        pairs = [(i, int(episode.observable[j])) for i, j in matched.tolist()]
        both = [(i, name) for i, name in pairs if name in row_of]
        if not both:
            continue
        estimates, names = np.array(both).T
        rows = [row_of[name] for name in names.tolist()]
        in_batch = transform_points(inverse(batch.bases[robot]), batch.landmarks[rows])
        own.append(np.sqrt(((held.means[estimates] - truths[names]) ** 2).sum(axis=1).mean()))
        peer.append(np.sqrt(((in_batch - truths[names]) ** 2).sum(axis=1).mean()))
    infos = record.infos
    return {
        "map_rms_m": float(np.mean(own)) if own else float("nan"),
        "batch_map_rms_m": float(np.mean(peer)) if peer else float("nan"),
        "map_recall": float(np.mean([float(info["map_recall"]) for info in infos])),
        "map_precision": float(np.mean([float(info["map_precision"]) for info in infos])),
        "landmarks": float(np.mean([len(held.means) for held in record.maps])),
    }  # fmt: skip


def _matches(episode: RecordedEpisode, track: FilterTrack) -> dict[str, float]:
    """Return how often the filter's associations are wrong, missing, or with a copy of a landmark."""
    labels = np.concatenate([own for tick in track.labels for own in tick])
    truths = np.concatenate([own for tick in episode.true_ids for own in tick])
    used, real = labels != NONE, truths != NONE
    _, firsts, rows = np.unique(labels[used], return_index=True, return_inverse=True)
    claims = truths[used][firsts]
    wrong: BoolArray = claims[rows] != truths[used]
    true_claims = claims[claims != NONE]
    return {
        "wrong_match_share": float(wrong.mean()) if len(wrong) else 0.0,
        "unused_share": float((real & ~used).sum() / max(real.sum(), 1)),
        "copies_per_landmark": len(true_claims) / max(len(np.unique(true_claims)), 1),
    }  # fmt: skip


def count_revisits(
    true_ids: Sequence[Sequence[IntArray]], labels: Sequence[Sequence[IntArray]]
) -> dict[str, int]:  # fmt: skip
    """Return the number of revisits of landmarks, and of those that the filter missed; see `play`.

    Args:
        true_ids: True landmarks (n,) of the measurements, by tick and robot; `NONE`: of no landmark.
        labels: Labels (n,) of the filter's landmarks; `NONE`: rejected.
    """
    visits: dict[tuple[int, int], list[tuple[int, set[int]]]] = {}  # last tick and labels of each visit
    for tick, (named, labelled) in enumerate(zip(true_ids, labels, strict=True)):
        for robot, (truths, own) in enumerate(zip(named, labelled, strict=True)):
            for truth, label in zip(truths.tolist(), own.tolist(), strict=True):
                if truth == NONE:
                    continue
                of_landmark = visits.setdefault((robot, truth), [])
                if not of_landmark or tick - of_landmark[-1][0] > LONG_UNSEEN:
                    of_landmark.append((tick, set()))
                of_landmark[-1] = (tick, of_landmark[-1][1] | ({label} - {NONE}))
    count = missed = 0
    for of_landmark in visits.values():
        known: set[int] = set()
        for _, seen in of_landmark:
            count += bool(known)
            missed += bool(known) and not known & seen
            known |= seen
    return {"revisits": count, "missed_revisits": missed}
