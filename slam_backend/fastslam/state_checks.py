"""Validation of a `FastSlam` state before a filter continues from it, as kernels check nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from slam_backend.core import state_checks as check
from slam_backend.core.jit import in_place, jit
from slam_backend.core.read_only import as_read_only
from slam_backend.core.state import MAX_DESCRIPTOR
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.consistency import LISTS, RENEWED, SIGN_OF, SIGNS, SUMS, WEIGHTS
from slam_backend.fastslam.existence import ExistenceUpdate
from slam_backend.fastslam.options import MAX_ROBOTS, FilterOptions, kernel_options
from slam_backend.fastslam.particle_maps import MAPS_KEPT
from slam_backend.fastslam.rejuvenation import SCHEDULE
from slam_backend.fastslam.reports import PoseEstimates
from slam_backend.fastslam.run_log import ROWS
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother._kernels import BIAS
from slam_backend.smoother.graph import NONE, SlamGraph
from slam_backend.smoother.log_arrays import EXACT, REJECTED, STATIONARY, LogArrays, has_been_checked, note_checked
from slam_backend.smoother.reassociation import RejectedMeasurements

POSE_FIELDS = ("poses", "starts", "means", "biases", "covariances")  # (K, 3 or 6, P)
KEPT = (
    *POSE_FIELDS,
    "gauge_covariance",
    "start_covariances",
    "bias_covariances",
    "propagated_only",
    "log_weights",
    "path_log_weights",
    "weights",
)
OTHERS_KEPT = ("steps", "estimates", "maps", "logs", "consistency", "options", "rng")
LONGEST_DESCRIPTOR = 1 << 16
LEAST = float(np.finfo(np.float64).min)  # lower limit of log-weights
GRAPH_COLUMNS = frozenset(field.name for field in fields(SlamGraph))


# ---------------------------------------------------------------------- the filter


def check_filter(name: str, state: Any, known: Sequence[FilterOptions] = ()) -> None:
    """Refuse a value that is not a valid state of `FastSlam`.

    Args:
        name: Name of the part.
        state: The value to check.
        known: Options known to be valid.

    Raises:
        ValueError: If a part is wrong; the text names it.
    """
    check.keys(name, state, (*KEPT, *OTHERS_KEPT))
    options = state["options"]
    check.options(f"{name}['options']", options, FilterOptions, known)
    if not any(options is other or options == other for other in known):
        _check_fit(f"{name}['options']", options)
    m = check.floats(f"{name}['weights']", state["weights"], (None,), 0.0, 1.0)
    padded = -(-m // LANES) * LANES
    k = check.array(f"{name}['poses']", state["poses"], check.FLOAT64, (None, 3, padded))
    if not 1 <= k <= MAX_ROBOTS or m < 1 or not abs(float(state["weights"].sum()) - 1.0) < 1e-6:
        check.refuse(name, "robots, particles, and weights that sum to 1", f"{k} robots, weights of {m} particles")
    for part in POSE_FIELDS[:4]:
        check.positions(f"{name}[{part!r}]", state[part], (k, 3, padded), m)
    check.floats(f"{name}['covariances']", state["covariances"], (k, 6, padded), columns=m)
    check.floats(f"{name}['gauge_covariance']", state["gauge_covariance"], (3, 3))
    check.floats(f"{name}['start_covariances']", state["start_covariances"], (k, 3, 3))
    check.floats(f"{name}['bias_covariances']", state["bias_covariances"], (2, k, 3, 3))
    check.indices(f"{name}['propagated_only']", state["propagated_only"], (k,), 0, 1)
    for part in ("log_weights", "path_log_weights"):
        check.floats(f"{name}[{part!r}]", state[part], (m,), LEAST)
    check.integer(f"{name}['steps']", state["steps"])
    estimates = state["estimates"]
    check.instance(f"{name}['estimates']", estimates, PoseEstimates)
    check.positions(f"{name}['estimates'].means", estimates.means, (k, 3))
    check.floats(f"{name}['estimates'].covariances", estimates.covariances, (k, 3, 3))
    check_maps(f"{name}['maps']", state["maps"], m, options)
    for where, log in check.named_items(f"{name}['logs']", state["logs"], k):
        check_log(where, log)
    if options.rejuvenate_every is not None:
        check.keys(name, state, ("rejuvenation",))
        size = state["maps"]["descriptors"].shape[1]
        check_rejuvenation(f"{name}['rejuvenation']", state["rejuvenation"], state["logs"], size)
    check_consistency(f"{name}['consistency']", state["consistency"])
    check.generator(f"{name}['rng']", state["rng"])


def check_consistency(name: str, state: Any) -> None:
    """Refuse a value that is not the state of a consistency test."""
    check.keys(name, state, (*SUMS, *LISTS))
    for sum_, most in (
        ("frames", check.MAX_INT),
        ("begun", state["frames"]),
        ("quiet", RENEWED),
        ("matched", check.MAX_INT),
    ):
        check.integer(f"{name}[{sum_!r}]", state[sum_], 0, most)
    check.number(f"{name}['nis']", state["nis"], 0.0)
    for part, count in (("counts", len(SIGN_OF)), ("since", len(SIGNS))):
        for where, number in check.named_items(f"{name}[{part!r}]", state[part], count):
            check.integer(where, number, -1)
    for where, number in check.named_items(f"{name}['evidence']", state["evidence"], len(WEIGHTS)):
        check.number(where, number, 0.0)


def _check_fit(name: str, options: FilterOptions) -> None:
    """Refuse options that are valid one by one, but not together."""
    try:
        kernel_options(options)
        if options.existence is not None:
            ExistenceUpdate(options.existence, options.camera)
    except Exception as error:  # of any kind: numbers too large for floats, or unfit for the camera
        raise argument_error(name, "options that fit together", f"'{error}'", check.HINT) from error


# ---------------------------------------------------------------------- maps


@in_place
def count_bad_values(values: FloatArray, counts: Any, num_particles: int, farthest: float, largest: float) -> int:
    """Return how many landmarks of particles have no valid Gaussian within limits.

    Args:
        values: (n, 9 P) float64 [m, m^2], read-only. Blocks of lanes, as in `MapStore`.
        counts: (n, P) int32, read-only. 0 where the particle lacks the landmark.
        num_particles: M.
        farthest: Limit of coordinates [m].
        largest: Limit of covariances [m^2].
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
    """Refuse a value that is not a state of the maps of m particles."""
    check.keys(name, maps, MAPS_KEPT)
    if maps["num_particles"] != m:
        check.refuse(f"{name}['num_particles']", f"{m}, the number of weights", maps["num_particles"])
    check.integer(f"{name}['num_particles']", maps["num_particles"])
    padded = -(-m // LANES) * LANES
    check.integer(f"{name}['next_id']", maps["next_id"], *check.LANDMARK)
    n = check.indices(f"{name}['ids']", maps["ids"], (None,), 0, maps["next_id"] - 1)
    check.ascending(f"{name}['ids']", maps["ids"])
    check.indices(f"{name}['counts']", maps["counts"], (n, padded), *check.LANDMARK, m, check.INT32)
    check.array(f"{name}['values']", maps["values"], check.FLOAT64, (n, 9 * padded))
    held = as_read_only(maps["values"]), as_read_only(maps["counts"])
    if n and count_bad_values(*held, m, check.MAX_DISTANCE, check.LARGEST):
        check.refuse(f"{name}['values']", "finite means and positive variances", "a Gaussian out of range")
    check.indices(f"{name}['maps']", maps["maps"], (None, padded), 0, m - 1, m, check.INT32)
    check.indices(f"{name}['maps']", maps["maps"], (None, padded), 0, padded - 1, dtype=check.INT32)  # all lanes
    check.indices(f"{name}['map_of']", maps["map_of"], (n,), 0, len(maps["maps"]))
    check.indices(f"{name}['identities']", maps["identities"], (n,), -1)
    check.indices(f"{name}['last_seen']", maps["last_seen"], (n,))
    check_descriptors(f"{name}['descriptors']", maps["descriptors"], n)
    if options.existence is None:
        if maps["odds"] is not None:
            check.refuse(f"{name}['odds']", "None without an existence model", "an array")
    else:
        check.floats(f"{name}['odds']", maps["odds"], (n, padded), columns=m)


def check_landmarks(name: str, landmarks: Any) -> None:
    """Refuse a value that is not a landmark map."""
    check.instance(name, landmarks, LandmarkMap)
    n = check.positions(f"{name}.means", landmarks.means, (None, 3))
    check.floats(f"{name}.covariances", landmarks.covariances, (n, 3, 3))
    check_descriptors(f"{name}.descriptors", landmarks.descriptors, n)
    check.array(f"{name}.counts", landmarks.counts, landmarks.counts.dtype if n == 0 else check.INT64, (n,))
    check.indices(f"{name}.ids", landmarks.ids, (n,), *check.LANDMARK)
    check.unique(f"{name}.ids", landmarks.ids)


def check_descriptors(name: str, value: Any, n: int, size: int | None = None) -> int:
    """Return the length d of n descriptors, or refuse a wrong array or length."""
    largest = float(MAX_DESCRIPTOR)
    check.floats(name, value, (n, size), -largest, largest, dtype=check.FLOAT32)
    if value.shape[1] > LONGEST_DESCRIPTOR:
        check.refuse(name, f"at most {LONGEST_DESCRIPTOR} columns", value.shape[1])
    return int(value.shape[1])


# ---------------------------------------------------------------------- logs


def check_log(name: str, log: Any) -> None:
    """Refuse a value that is not a state of a `RobotLog`; each immutable chunk is checked once."""
    check.keys(name, log, ("chunks", "unfinished"))
    check.sequence(f"{name}['chunks']", log["chunks"])
    last = -1
    for chunk in log["chunks"]:
        if not has_been_checked(chunk):
            check_steps(f"{name}['chunks']", chunk)
            if not len(chunk):
                check.refuse(f"{name}['chunks']", "non-empty chunks", "an empty chunk")
            note_checked(chunk)
        if chunk.steps[0] <= last:
            check.refuse(f"{name}['chunks']", "steps in order", "a step out of order")
        last = chunk.steps[-1]
    unfinished = log["unfinished"]
    check_steps(f"{name}['unfinished']", unfinished)
    if len(unfinished) > ROWS or (len(unfinished) and unfinished.steps[0] <= last):
        check.refuse(f"{name}['unfinished']", f"at most {ROWS} steps after the chunks", len(unfinished))


def last_step(log: Mapping[str, Any]) -> int:
    """Return the last step of the state of a log, -1 if there is none."""
    for part in (log["unfinished"], *reversed(log["chunks"])):
        if len(part):
            return int(part.steps[-1])
    return -1


def check_steps(name: str, rows: Any) -> None:
    """Refuse a value that is not a valid `LogArrays`."""
    check.instance(name, rows, LogArrays)
    starts, t = rows.starts, check.indices(f"{name}.steps", rows.steps, (None,))
    check.ascending(f"{name}.steps", rows.steps)
    check.array(f"{name}.kinds", rows.kinds, check.INT8, (t,))
    if t and not STATIONARY <= rows.kinds.min() <= rows.kinds.max() <= EXACT:
        check.refuse(f"{name}.kinds", f"kinds from {STATIONARY} to {EXACT}", "a value out of range")
    check.positions(f"{name}.motions", rows.motions, (t, 3))
    check.array(f"{name}.given", rows.given, check.BOOL, (t,))
    n = check.positions(f"{name}.points", rows.points, (None, 3))
    check.array(f"{name}.starts", starts, check.INT64, (t + 1,))
    if starts[0] != 0 or starts[-1] != n or (starts[1:] < starts[:-1]).any():
        check.refuse(f"{name}.starts", f"ascending rows from 0 to {n}", "a row out of order")
    check.indices(f"{name}.ids", rows.ids, (n,), REJECTED, check.MAX_LANDMARKS)
    if rows.covariances is not None:
        check.array(f"{name}.covariances", rows.covariances, check.FLOAT64, (n, 6))
        given = rows.covariances[np.repeat(rows.given, np.diff(starts))]
        check.floats(f"{name}.covariances", given, (len(given), 6))
    elif rows.given.any():
        check.refuse(f"{name}.given", "no given covariances", "an array with some")


# ---------------------------------------------------------------------- the smoother


@jit
def are_linked(previous: IntArray, robots: IntArray) -> bool:
    """Return whether each key (k,) leads back to a start, with the keys of one robot in order of time."""
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
    """Refuse a value that is not the columns of a `SlamGraph` of k robots."""
    check.keys(name, graph, GRAPH_COLUMNS)
    if len(graph) != len(GRAPH_COLUMNS):
        check.refuse(name, "the columns of a graph", "a dict with others")
    where = {column: f"{name}[{column!r}]" for column in graph}

    def indices(column: str, rows: int | None, last: int, low: int = 0) -> int:
        return check.indices(where[column], graph[column], (rows,), low, last)

    keys, robots = indices("robots", None, k - 1, BIAS), graph["robots"]
    indices("parents", keys, keys - 1, NONE)
    check.floats(where["odometry_covariances"], graph["odometry_covariances"], (keys, 3, 3))
    check.floats(where["bias_jacobians"], graph["bias_jacobians"], (keys, 3, 3))
    for column in ("transition_variances", "rigid_variances"):
        check.floats(where[column], graph[column], (keys,), 0.0)
    frames, landmarks = indices("frame_keys", None, keys - 1), indices("landmark_ids", None, check.MAX_LANDMARKS)
    check.unique(where["landmark_ids"], graph["landmark_ids"])
    n = check.positions(where["points"], graph["points"], (None, 3))
    for column, rows in (("poses", keys), ("odometry", keys), ("frame_offsets", frames), ("landmarks", landmarks)):
        check.positions(where[column], graph[column], (rows, 3))
    check.array(where["has_covariance"], graph["has_covariance"], check.BOOL, (n,))
    check.array(where["point_noises"], graph["point_noises"], check.FLOAT64, (n, 6))
    check.floats(where["point_noises"], graph["point_noises"][graph["has_covariance"]], (None, 6))
    indices("point_frames", n, frames - 1), indices("point_landmarks", n, landmarks - 1)
    frozen = indices("condensed_keys", None, keys - 1)
    indices("condensed_landmarks", frozen, landmarks - 1), indices("counts", frozen, check.MAX_LANDMARKS)
    for column, width in (("linearisation_points", 3), ("information", 6), ("gradients", 3)):
        check.floats(where[column], graph[column], (frozen, width))
    check.indices(where["merged_ids"], graph["merged_ids"], (None, 2), *check.LANDMARK)
    for column in ("first_keys", "last_keys"):
        indices(column, k, keys - 1)
        if (robots[graph[column]] != np.arange(k)).any():
            check.refuse(where[column], "a key of each robot", "a key of another robot")
    indices("bias_keys", k, keys - 1, NONE)
    held = graph["bias_keys"][graph["bias_keys"] >= 0]
    if len(held) not in (0, k) or sorted(held) != np.flatnonzero(robots == BIAS).tolist():
        check.refuse(where["bias_keys"], "each key of a bias once, or no keys", "other keys")
    if (graph["parents"][held] < 0).any() or (robots[graph["parents"][held]] != NONE).any():
        check.refuse(where["parents"], "the origin before each bias", "another key")
    indices("latest", k, check.MAX_INT, -1)
    if not are_linked(graph["parents"], robots):
        check.refuse(where["parents"], "keys that lead back to a start", "a key that does not")


def check_rejuvenation(name: str, state: Any, logs: Sequence[Mapping[str, Any]], size: int) -> None:
    """Refuse a value that is not a smoother state of a filter with these logs and this descriptor length."""
    check.keys(name, state, ("graph", "draft", "schedule", "guesses", "refused"))
    k, schedule = len(logs), state["schedule"]
    check.keys(f"{name}['schedule']", schedule, SCHEDULE)
    for part in SCHEDULE:
        is_flag = part in ("_asked", "_closed", "_exact")
        (check.boolean if is_flag else check.integer)(f"{name}['schedule'][{part!r}]", schedule[part])
    if state["graph"] is not None:
        check_graph(f"{name}['graph']", state["graph"], k)
    if state["draft"] is not None:
        check.sequence(f"{name}['draft']", state["draft"], 3)
        graph, damping, steps = state["draft"]
        if state["graph"] is None:
            check.refuse(f"{name}['draft']", "None without a graph", "a draft")
        check_graph(f"{name}['draft'][0]", graph, k)
        check.number(f"{name}['draft'][1]", damping, 0.0)
        check.integer(f"{name}['draft'][2]", steps)
    for where, guesses in check.named_items(f"{name}['guesses']", state["guesses"], k):
        check.sequence(where, guesses, 2)
        count = check.indices(f"{where}[0]", guesses[0], (None,))
        check.ascending(f"{where}[0]", guesses[0])
        check.positions(f"{where}[1]", guesses[1], (count, 3))
    for (where, refused), log in zip(check.named_items(f"{name}['refused']", state["refused"], k), logs, strict=True):
        _check_refused(where, refused, log, size)


def _check_refused(name: str, refused: Any, log: Mapping[str, Any], size: int) -> None:
    """Refuse a value that is not the rejected measurements of a log, by step."""
    check.instance(name, refused, dict)
    if not refused:
        return
    counts: dict[int, int] = {}
    for part in reversed((*log["chunks"], log["unfinished"])):
        if len(part):
            counts |= dict(zip(part.steps.tolist(), np.diff(part.starts).tolist(), strict=True))
            if part.steps[0] <= min((step for step in refused if type(step) is int), default=0):
                break
    for step, (rows, descriptors) in refused.items():
        check.instance(name, refused[step], RejectedMeasurements)
        check.integer(f"{name}: step", step)
        n = check.indices(f"{name}[{step}].rows", rows, (None,), 0, counts.get(step, check.MAX_INT) - 1)
        check.ascending(f"{name}[{step}].rows", rows)
        check_descriptors(f"{name}[{step}].descriptors", descriptors, n, size)
