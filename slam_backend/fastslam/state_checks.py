"""What a state of `FastSlam` must be so that a filter can go on from it: its kernels check nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place, jit
from slam_backend.core.read_only import as_read_only
from slam_backend.core.state_checks import (
    BOOL,
    CURE,
    FARTHEST,
    FLOAT32,
    FLOAT64,
    INT8,
    INT32,
    INT64,
    LARGEST,
    MOST,
    check_ascending,
    check_each,
    check_flag,
    check_floats,
    check_generator,
    check_indices,
    check_kept,
    check_keys,
    check_kind,
    check_length,
    check_number,
    check_options,
    check_whole,
    refuse,
)
from slam_backend.core.validation import FloatArray, IntArray, bad_argument
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.consistency import LISTS, RENEWED, SIGN_OF, SIGNS, SUMS, WEIGHTS
from slam_backend.fastslam.existence import ExistenceStep
from slam_backend.fastslam.options import MOST_ROBOTS, FilterOptions, assumed
from slam_backend.fastslam.particle_maps import MAPS_KEPT
from slam_backend.fastslam.rejuvenation import SCHEDULE
from slam_backend.fastslam.reports import PoseEstimates
from slam_backend.fastslam.run_log import ROWS
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import LARGEST_DESCRIPTOR
from slam_backend.smoother.graph import NONE, PathGraph
from slam_backend.smoother.log_arrays import EXACT, REJECTED, STOOD, LogArrays, has_been_checked, note_checked
from slam_backend.smoother.reassociation import Refused

POSE_FIELDS = ("poses", "starts", "means", "covariances")  # (K, 3 or 6, P), of each robot
KEPT = (
    *POSE_FIELDS,
    "gauge_covariance",
    "start_covariances",
    "propagated_only",
    "log_weights",
    "path_log_weights",
    "weights",
)
OTHERS_KEPT = ("steps", "estimates", "maps", "logs", "consistency", "options", "rng")
LONGEST_DESCRIPTOR = 1 << 16
MOST_LANDMARKS = 1 << 30  # names of landmarks: tables are as long as the largest of them
LEAST = float(np.finfo(np.float64).min)  # of log-weights
GRAPH_COLUMNS = frozenset(field.name for field in fields(PathGraph))


# ---------------------------------------------------------------------- the filter


def check_filter(name: str, state: Any, known: Sequence[FilterOptions] = ()) -> None:
    """Refuse what is no state from which `FastSlam` can go on.

    Args:
        name: Name of the part.
        state: The value to check.
        known: Options that were checked before.

    Raises:
        ValueError: By name of the part that is wrong.
    """
    check_keys(name, state, (*KEPT, *OTHERS_KEPT))
    options = state["options"]
    check_options(f"{name}['options']", options, FilterOptions, known)
    if not any(options is other or options == other for other in known):
        _check_fit(f"{name}['options']", options)
    weights = state["weights"]
    check_floats(f"{name}['weights']", weights, (None,), 0.0, 1.0)
    m = len(weights)
    poses = state["poses"]
    check_kept(f"{name}['poses']", poses, FLOAT64, (None, 3, -(-m // LANES) * LANES))
    k, _, padded = poses.shape
    if not 1 <= k <= MOST_ROBOTS or m < 1 or not abs(float(weights.sum()) - 1.0) < 1e-6:
        refuse(name, "robots, particles, and weights that sum to 1", f"{k} robots, weights of {m} particles")
    for part in POSE_FIELDS[:3]:
        check_floats(f"{name}[{part!r}]", state[part], (k, 3, padded), -FARTHEST, FARTHEST, m)
    check_floats(f"{name}['covariances']", state["covariances"], (k, 6, padded), -LARGEST, LARGEST, m)
    check_floats(f"{name}['gauge_covariance']", state["gauge_covariance"], (3, 3))
    check_floats(f"{name}['start_covariances']", state["start_covariances"], (k, 3, 3))
    check_indices(f"{name}['propagated_only']", state["propagated_only"], (k,), 0, 1)
    for part in ("log_weights", "path_log_weights"):
        check_floats(f"{name}[{part!r}]", state[part], (m,), LEAST, LARGEST)
    check_whole(f"{name}['steps']", state["steps"])
    check_estimates(f"{name}['estimates']", state["estimates"], k)
    check_maps(f"{name}['maps']", state["maps"], m, options)
    for where, log in check_each(f"{name}['logs']", state["logs"], k):
        check_log(where, log)
    if options.rejuvenate_every is not None:
        check_keys(name, state, ("rejuvenation",))
        size = state["maps"]["descriptors"].shape[1]
        check_rejuvenation(f"{name}['rejuvenation']", state["rejuvenation"], state["logs"], size)
    check_consistency(f"{name}['consistency']", state["consistency"])
    check_generator(f"{name}['rng']", state["rng"])


def check_consistency(name: str, state: Any) -> None:
    """Refuse what are not the running sums of a consistency test."""
    check_keys(name, state, (*SUMS, *LISTS))
    check_whole(f"{name}['frames']", state["frames"])
    check_whole(f"{name}['begun']", state["begun"], 0, state["frames"])
    check_whole(f"{name}['quiet']", state["quiet"], 0, RENEWED)
    check_whole(f"{name}['matched']", state["matched"])
    check_number(f"{name}['nis']", state["nis"], 0.0)
    for part, count in (("counts", len(SIGN_OF)), ("since", len(SIGNS))):
        for where, number in check_each(f"{name}[{part!r}]", state[part], count):
            check_whole(where, number, -1)
    for where, number in check_each(f"{name}['evidence']", state["evidence"], len(WEIGHTS)):
        check_number(where, number, 0.0)


def _check_fit(name: str, options: FilterOptions) -> None:
    """Refuse options that are fine one by one, but with which no filter can be built."""
    try:
        assumed(options)
        if options.existence is not None:
            ExistenceStep(options.existence, options.camera)
    except Exception as error:  # of whatever kind: of numbers that are too large for floats, or not fit for the camera
        raise bad_argument(name, "options that fit together", f"'{error}'", CURE) from error


def check_estimates(name: str, estimates: Any, k: int) -> None:
    """Refuse what are no estimates of the poses of k robots."""
    check_kind(name, estimates, PoseEstimates)
    check_floats(f"{name}.means", estimates.means, (k, 3), -FARTHEST, FARTHEST)
    check_floats(f"{name}.covariances", estimates.covariances, (k, 3, 3))


# ---------------------------------------------------------------------- maps


@in_place
def count_bad_values(values: FloatArray, counts: Any, num_particles: int, farthest: float, largest: float) -> int:
    """Return how many landmarks that particles hold are no Gaussians in the world.

    Args:
        values: (n, 9 P) float64 [m, m^2], read-only. Blocks of lanes, as in `MapStore`.
        counts: (n, P) int32, read-only. 0 where the particle lacks the landmark.
        num_particles: M.
        farthest: [m].
        largest: [m^2].
    """
    bad = 0
    for i in range(len(counts)):
        for m in range(num_particles):
            if counts[i, m] > 0:
                first = m // LANES * 9 * LANES + m % LANES
                fine = True
                for part in range(3):
                    fine &= -farthest <= values[i, first + part * LANES] <= farthest
                for part in range(3, 9):
                    fine &= -largest <= values[i, first + part * LANES] <= largest
                for part in (3, 6, 8):
                    fine &= values[i, first + part * LANES] > 0.0
                bad += not fine
    return bad


def check_maps(name: str, maps: Any, m: int, options: FilterOptions) -> None:
    """Refuse what are no maps of m particles."""
    check_keys(name, maps, MAPS_KEPT)
    if maps["num_particles"] != m:
        refuse(f"{name}['num_particles']", f"{m}, the number of weights", maps["num_particles"])
    check_whole(f"{name}['num_particles']", maps["num_particles"])
    padded = -(-m // LANES) * LANES
    check_whole(f"{name}['next_id']", maps["next_id"], 0, MOST_LANDMARKS)
    ids = maps["ids"]
    check_indices(f"{name}['ids']", ids, (None,), 0, maps["next_id"] - 1)
    check_ascending(f"{name}['ids']", ids)
    n = len(ids)
    check_indices(f"{name}['counts']", maps["counts"], (n, padded), 0, MOST_LANDMARKS, m, INT32)
    check_kept(f"{name}['values']", maps["values"], FLOAT64, (n, 9 * padded))
    if n and count_bad_values(as_read_only(maps["values"]), as_read_only(maps["counts"]), m, FARTHEST, LARGEST):
        refuse(f"{name}['values']", "means and positive variances", "others")
    check_indices(f"{name}['maps']", maps["maps"], (None, padded), 0, m - 1, m, INT32)
    check_indices(f"{name}['maps']", maps["maps"], (None, padded), 0, padded - 1, dtype=INT32)  # of lanes beyond M, too
    check_indices(f"{name}['map_of']", maps["map_of"], (n,), 0, len(maps["maps"]))
    check_indices(f"{name}['identities']", maps["identities"], (n,), -1, MOST)
    check_indices(f"{name}['last_seen']", maps["last_seen"], (n,), 0, MOST)
    largest = float(LARGEST_DESCRIPTOR)
    check_floats(f"{name}['descriptors']", maps["descriptors"], (n, None), -largest, largest, dtype=FLOAT32)
    if maps["descriptors"].shape[1] > LONGEST_DESCRIPTOR:
        refuse(f"{name}['descriptors']", f"at most {LONGEST_DESCRIPTOR} columns", maps["descriptors"].shape[1])
    if options.existence is None:
        if maps["odds"] is not None:
            refuse(f"{name}['odds']", "None where existence is not kept", "an array")
    else:
        check_floats(f"{name}['odds']", maps["odds"], (n, padded), -LARGEST, LARGEST, m)


def check_landmarks(name: str, landmarks: Any) -> None:
    """Refuse what is no map of landmarks."""
    check_kind(name, landmarks, LandmarkMap)
    means = landmarks.means
    check_floats(f"{name}.means", means, (None, 3), -FARTHEST, FARTHEST)
    n = len(means)
    check_floats(f"{name}.covariances", landmarks.covariances, (n, 3, 3))
    largest = float(LARGEST_DESCRIPTOR)
    check_floats(f"{name}.descriptors", landmarks.descriptors, (n, None), -largest, largest, dtype=FLOAT32)
    check_kept(f"{name}.counts", landmarks.counts, landmarks.counts.dtype if n == 0 else INT64, (n,))
    check_indices(f"{name}.ids", landmarks.ids, (n,), 0, MOST_LANDMARKS)
    if len(np.unique(landmarks.ids)) < n:
        refuse(f"{name}.ids", "each id once", "one that repeats")


# ---------------------------------------------------------------------- logs


def check_log(name: str, log: Any) -> None:
    """Refuse what is no state of a `RobotLog`; chunks that never change are looked at once."""
    check_keys(name, log, ("chunks", "unfinished"))
    check_length(f"{name}['chunks']", log["chunks"])
    last = -1
    for chunk in log["chunks"]:
        if not has_been_checked(chunk):
            check_steps(f"{name}['chunks']", chunk)
            if not len(chunk):
                refuse(f"{name}['chunks']", "chunks of some steps", "none")
            note_checked(chunk)
        if chunk.steps[0] <= last:
            refuse(f"{name}['chunks']", "steps in order", "others")
        last = chunk.steps[-1]
    unfinished = log["unfinished"]
    check_steps(f"{name}['unfinished']", unfinished)
    if len(unfinished) > ROWS or (len(unfinished) and unfinished.steps[0] <= last):
        refuse(f"{name}['unfinished']", f"at most {ROWS} steps after the others", len(unfinished))


def last_step(log: Mapping[str, Any]) -> int:
    """Return the last step of the state of a log, -1 if there is none."""
    for part in (log["unfinished"], *reversed(log["chunks"])):
        if len(part):
            return int(part.steps[-1])
    return -1


def check_steps(name: str, rows: Any) -> None:
    """Refuse what are no `LogArrays`."""
    check_kind(name, rows, LogArrays)
    steps = rows.steps
    check_indices(f"{name}.steps", steps, (None,), 0, MOST)
    check_ascending(f"{name}.steps", steps)
    t, starts = len(steps), rows.starts
    check_kept(f"{name}.kinds", rows.kinds, INT8, (t,))
    if t and not STOOD <= rows.kinds.min() <= rows.kinds.max() <= EXACT:
        refuse(f"{name}.kinds", f"kinds from {STOOD} to {EXACT}", "others")
    check_floats(f"{name}.motions", rows.motions, (t, 3), -FARTHEST, FARTHEST)
    check_kept(f"{name}.given", rows.given, BOOL, (t,))
    check_floats(f"{name}.points", rows.points, (None, 3), -FARTHEST, FARTHEST)
    n = len(rows.points)
    check_kept(f"{name}.starts", starts, INT64, (t + 1,))
    if starts[0] != 0 or starts[-1] != n or (t and (starts[1:] < starts[:-1]).any()):
        refuse(f"{name}.starts", f"rows that rise from 0 to {n}", "others")
    check_indices(f"{name}.ids", rows.ids, (n,), REJECTED, MOST_LANDMARKS)
    if rows.covariances is not None:
        check_kept(f"{name}.covariances", rows.covariances, FLOAT64, (n, 6))
        own = rows.covariances[np.repeat(rows.given, np.diff(starts))]
        check_floats(f"{name}.covariances", own, (len(own), 6))
    elif rows.given.any():
        refuse(f"{name}.given", "none without covariances", "some")


# ---------------------------------------------------------------------- the smoother


@jit
def are_linked(previous: IntArray, robots: IntArray) -> bool:
    """Tell whether each key (k,) leads back to one that is given, those of one robot in the order of time."""
    known = np.zeros(len(previous), np.bool_)
    for b in range(len(previous)):
        a, length = b, 0
        while a >= 0 and not known[a]:
            if previous[a] >= a and robots[previous[a]] == robots[a]:
                return False
            a = previous[a]
            length += 1
            if length > len(previous):
                return False
        a = b
        while a >= 0 and not known[a]:
            known[a] = True
            a = previous[a]
    return True


def check_graph(name: str, graph: Any, k: int) -> None:
    """Refuse what are no columns of a `PathGraph` of k robots."""
    check_keys(name, graph, GRAPH_COLUMNS)
    if len(graph) != len(GRAPH_COLUMNS):
        refuse(name, "the columns of a graph", "others")
    robots = graph["robots"]
    check_indices(f"{name}['robots']", robots, (None,), NONE, k - 1)
    keys = len(robots)
    check_floats(f"{name}['poses']", graph["poses"], (keys, 3), -FARTHEST, FARTHEST)
    check_indices(f"{name}['previous']", graph["previous"], (keys,), NONE, keys - 1)
    check_floats(f"{name}['motions']", graph["motions"], (keys, 3), -FARTHEST, FARTHEST)
    check_floats(f"{name}['noises']", graph["noises"], (keys, 3, 3))
    for column in ("spreads", "slack"):
        check_floats(f"{name}[{column!r}]", graph[column], (keys,), 0.0)
    check_indices(f"{name}['frame_keys']", graph["frame_keys"], (None,), 0, keys - 1)
    frames = len(graph["frame_keys"])
    check_floats(f"{name}['frame_offsets']", graph["frame_offsets"], (frames, 3), -FARTHEST, FARTHEST)
    ids = graph["landmark_ids"]
    check_indices(f"{name}['landmark_ids']", ids, (None,), 0, MOST_LANDMARKS)
    landmarks = len(ids)
    if len(np.unique(ids)) < landmarks:
        refuse(f"{name}['landmark_ids']", "each name once", "one that repeats")
    check_floats(f"{name}['landmarks']", graph["landmarks"], (landmarks, 3), -FARTHEST, FARTHEST)
    check_floats(f"{name}['points']", graph["points"], (None, 3), -FARTHEST, FARTHEST)
    n = len(graph["points"])
    check_kept(f"{name}['given']", graph["given"], BOOL, (n,))
    check_kept(f"{name}['point_noises']", graph["point_noises"], FLOAT64, (n, 6))
    if graph["given"].any():
        own = graph["point_noises"][graph["given"]]
        check_floats(f"{name}['point_noises']", own, (len(own), 6))
    check_indices(f"{name}['point_frames']", graph["point_frames"], (n,), 0, frames - 1)
    check_indices(f"{name}['point_landmarks']", graph["point_landmarks"], (n,), 0, landmarks - 1)
    check_indices(f"{name}['frozen_keys']", graph["frozen_keys"], (None,), 0, keys - 1)
    frozen = len(graph["frozen_keys"])
    check_indices(f"{name}['frozen_landmarks']", graph["frozen_landmarks"], (frozen,), 0, landmarks - 1)
    for column, width in (("centres", 3), ("infos", 6), ("slopes", 3)):
        check_floats(f"{name}[{column!r}]", graph[column], (frozen, width))
    check_indices(f"{name}['counts']", graph["counts"], (frozen,), 0, MOST_LANDMARKS)
    check_indices(f"{name}['aliases']", graph["aliases"], (None, 2), 0, MOST_LANDMARKS)
    for column in ("heads", "tips"):
        check_indices(f"{name}[{column!r}]", graph[column], (k,), 0, keys - 1)
        if (robots[graph[column]] != np.arange(k)).any():
            refuse(f"{name}[{column!r}]", "a key of each robot", "others")
    check_indices(f"{name}['latest']", graph["latest"], (k,), -1, MOST)
    if not are_linked(graph["previous"], robots):
        refuse(f"{name}['previous']", "keys that lead back to a start", "others")


def check_rejuvenation(name: str, state: Any, logs: Sequence[Mapping[str, Any]], size: int) -> None:
    """Refuse what is no state of the smoother of a filter with these logs, whose descriptors have this size."""
    check_keys(name, state, ("graph", "draft", "schedule", "guesses", "refused"))
    k, schedule = len(logs), state["schedule"]
    check_keys(f"{name}['schedule']", schedule, SCHEDULE)
    for part in SCHEDULE:
        if part in ("_asked", "_closed", "_exact"):
            check_flag(f"{name}['schedule'][{part!r}]", schedule[part])
        else:
            check_whole(f"{name}['schedule'][{part!r}]", schedule[part])
    if state["graph"] is not None:
        check_graph(f"{name}['graph']", state["graph"], k)
    if state["draft"] is not None:
        check_length(f"{name}['draft']", state["draft"], 3)
        graph, damping, steps = state["draft"]
        if state["graph"] is None:
            refuse(f"{name}['draft']", "none without a graph", "one")
        check_graph(f"{name}['draft'][0]", graph, k)
        check_number(f"{name}['draft'][1]", damping, 0.0)
        check_whole(f"{name}['draft'][2]", steps)
    for where, guesses in check_each(f"{name}['guesses']", state["guesses"], k):
        check_length(where, guesses, 2)
        steps, poses = guesses
        check_indices(f"{where}[0]", steps, (None,), 0, MOST)
        check_ascending(f"{where}[0]", steps)
        check_floats(f"{where}[1]", poses, (len(steps), 3), -FARTHEST, FARTHEST)
    for (where, refused), log in zip(check_each(f"{name}['refused']", state["refused"], k), logs, strict=True):
        _check_refused(where, refused, log, size)


def _check_refused(name: str, refused: Any, log: Mapping[str, Any], size: int) -> None:
    """Refuse what are no refused measurements of a log, by step."""
    check_kind(name, refused, dict)
    if not refused:
        return
    counts: dict[int, int] = {}
    for part in reversed((*log["chunks"], log["unfinished"])):
        if len(part):
            counts |= dict(zip(part.steps.tolist(), np.diff(part.starts).tolist(), strict=True))
            if part.steps[0] <= min((step for step in refused if type(step) is int), default=0):
                break
    for step, (rows, looks) in refused.items():
        check_kind(name, refused[step], Refused)
        check_whole(f"{name}: step", step)
        check_indices(f"{name}[{step}].rows", rows, (None,), 0, counts.get(step, MOST) - 1)
        check_ascending(f"{name}[{step}].rows", rows)
        largest = float(LARGEST_DESCRIPTOR)
        check_floats(f"{name}[{step}].descriptors", looks, (len(rows), size), -largest, largest, dtype=FLOAT32)
