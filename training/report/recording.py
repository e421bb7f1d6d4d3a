"""Recording of an episode at some of its steps, for playback: `recording.npz` of a run folder."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import check_writable, write_file
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import compose, rotate_covariances
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.reports import MergeEvent
from training.episodes.runner import EpisodeRecord, MergeRecord, Progress, describe_event
from training.experiments.output.plotting import CHI_SQUARE_95
from training.experiments.run_folder import plain
from vslam_env.belief.team_belief import Belief
from vslam_env.config import TICK
from vslam_env.environment import ExplorationEnv
from vslam_env.navigation import CandidateKind
from vslam_env.navigation.occupancy_grid import CELL, centre_of
from vslam_env.rendering.palette import shared_by

RECORDING_FILE = "recording.npz"
FORMAT = 1
MOST_FRAMES = 600  # recorded steps of an episode
MOST_KEYFRAMES = 75  # those of them with maps, grids and candidates
SAME_PLACE = 0.2  # a goal nearer to a candidate than this is that candidate [m]
FRAME_S, KEYFRAME_S = 0.2, 1.0  # shortest times between them [s]
Array = NDArray[Any]
SCORES = ("map_error", "map_recall", "map_precision", "map_rmse")  # columns of `Recording.scores`


def _empty(*shape: int) -> Callable[[], Array]:
    return partial(np.zeros, shape)


@short_repr
@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """F recorded steps of K robots, J of them with maps, grids and candidates; all in the world frame.

    Estimates are placed by the true start poses without a fit, unless `about["placed"]` says otherwise. Rows of ragged
    arrays are concatenated; `*_ends` (J, K) or (F, K) are the ends of each part, in the order of steps and robots. A
    map or grid that robots share is stored once, with the first of them.
    """

    about: Mapping[str, Any]  # Plain values: `names` of the robots, `events`, `cutoff` of E [m], `placed`
    times: Array  # (F,) float64 [s]
    estimate: Array  # (F, K, 3) float64 [m, m, rad]
    truth: Array  # (F, K, 3) float64 [m, m, rad]; NaN: not known
    reckoned: Array = field(default_factory=_empty(0, 0, 3))  # (F, K, 3) float64 [m, m, rad]. Dead reckoning.
    covariances: Array = field(default_factory=_empty(0, 0, 3))  # (F, K, 3) float64 [m^2]. xx, xy, yy of the position.
    frames: Array = field(default_factory=_empty(0, 0))  # (F, K) First robot of each robot's group
    scores: Array = field(default_factory=_empty(0, 0, 4))  # (F, K, 4) `SCORES`
    coverage: Array = field(default_factory=_empty(0))  # (F,)
    sights: Array = field(
        default_factory=_empty(0, 2)
    )  # (n, 2) float64 [m]. Landmarks seen in the last tick of each step.
    sight_ends: Array = field(default_factory=_empty(0, 0))  # (F, K)
    walls: Array = field(default_factory=_empty(0, 4))  # (S, 4) float64 [m]. True wall segments x1, y1, x2, y2.
    landmarks: Array = field(default_factory=_empty(0, 2))  # (N, 2) float64 [m]. True landmarks.
    keyframes: Array = field(default_factory=_empty(0))  # (J,) Steps with maps, grids and candidates, ascending
    map_points: Array = field(
        default_factory=_empty(0, 5)
    )  # (n, 5) x, y [m]; semi-axes [m] and angle [rad] of the 95 % ellipse
    map_ends: Array = field(default_factory=_empty(0, 0))  # (J, K)
    grid_values: Array = field(
        default_factory=_empty(0)
    )  # (n,) Values of the runs of equal cells, row by row, within the known box
    grid_runs: Array = field(default_factory=_empty(0))  # (n,) Their lengths
    grid_ends: Array = field(default_factory=_empty(0, 0))  # (J, K)
    grid_boxes: Array = field(
        default_factory=_empty(0, 0, 4)
    )  # (J, K, 4) Corner x, y [m] of the box, start frame; rows, columns
    starts: Array = field(
        default_factory=_empty(0, 3)
    )  # (K, 3) float64 [m, m, rad]. Start frames, in which the grids lie.
    candidates: Array = field(
        default_factory=_empty(0, 4)
    )  # (n, 4) x, y [m], `CandidateKind` (NONE: a goal that is no candidate), whether it is the robot's goal
    candidate_ends: Array = field(default_factory=_empty(0, 0))  # (J, K)

    def save(self, folder: Path) -> Path:
        """Write the recording into a run folder."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "about"}
        text = json.dumps(plain({"format": FORMAT, **self.about}), allow_nan=False)
        whole = BytesIO()
        packed: dict[str, Any] = {"about": np.frombuffer(text.encode(), np.uint8)}
        for name, array in arrays.items():
            packed[name] = array.astype(np.float32) if array.dtype.kind == "f" else array
        np.savez_compressed(whole, **packed)
        return write_file(folder / RECORDING_FILE, whole.getvalue(), "out")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the recording of a run folder.

        Raises:
            ValueError: If the file is damaged, or of another format.
        """
        file = folder / RECORDING_FILE
        hint = f"Remove {str(file)!r}, or repeat the run."
        try:
            arrays: dict[str, NDArray[Any]] = dict(read_arrays(file))
            about = json.loads(arrays.pop("about").tobytes().decode())
            if about["format"] == FORMAT:
                return cls(about=about, **arrays)._checked()
        except Exception as error:
            raise argument_error("folder", "a recording of an episode", "a broken file", hint) from error
        raise argument_error(
            "folder", f"a recording of format {FORMAT}", f"a recording of format {about['format']}", hint
        )

    def _checked(self) -> Self:
        """Return the recording, or raise a `ValueError` if its parts do not fit together."""
        names, events = self.about.get("names"), self.about.get("events", [])
        is_named = isinstance(names, list) and all(isinstance(name, str) for name in names)
        if not is_named or not isinstance(events, list) or not all(isinstance(event, dict) for event in events):
            raise ValueError("names or events are missing")
        sizes = {"F": len(self.times), "K": len(names or ()), "J": len(self.keyframes)}
        if not len(self.times) or not sizes["K"]:
            raise ValueError("it has no step or no robot")
        for name, letters in LAYOUT.items():
            array = getattr(self, name)
            if array.dtype.kind not in "biuf" or array.ndim != len(letters):
                raise ValueError(f"{name} is no array of {len(letters)} axes")
            for letter, size in zip(letters, array.shape, strict=True):
                if len(array) and size != (int(letter) if letter.isdigit() else sizes.setdefault(letter, size)):
                    raise ValueError(f"{name} has another shape")
            if np.isinf(array).any() or (name in KNOWN and np.isnan(array).any()):
                raise ValueError(f"{name} is not finite")
            if (name in WHOLE_NUMBERS or name in PARTS) and ((array < 0).any() or (array != np.floor(array)).any()):
                raise ValueError(f"{name} are no counts")
        for name, rows in PARTS.items():
            ends = getattr(self, name).ravel()
            if (np.diff(ends) < 0).any() or (ends[-1] if len(ends) else 0) != len(getattr(self, rows)):
                raise ValueError(f"{name} do not divide {rows}")
        if (np.diff(self.times) < 0.0).any() or (np.diff(self.keyframes) <= 0).any():
            raise ValueError("steps are out of order")
        if (self.keyframes >= sizes["F"]).any() or (self.frames >= sizes["K"]).any():
            raise ValueError("steps or robots do not exist")
        cells, ends = np.prod(self.grid_boxes[..., 2:], axis=-1).ravel(), self.grid_ends.ravel().astype(np.int64)
        runs = np.concatenate([[0], np.cumsum(self.grid_runs.astype(np.int64))])[np.concatenate([[0], ends])]
        if len(ends) and not np.array_equal(np.diff(runs), cells):
            raise ValueError("grids do not fill their boxes")
        return self


# Shapes of the arrays, by their sizes: F, K and J as in `Recording`, other letters of one array each. An array that is
# not recorded has no rows. Those of `KNOWN` hold finite numbers, the others also NaN for what is not known.
LAYOUT = {
    "times": "F", "estimate": "FK3", "truth": "FK3", "reckoned": "FK3", "covariances": "FK3", "frames": "FK",
    "scores": "FK4", "coverage": "F", "sights": "n2", "sight_ends": "FK", "walls": "s4", "landmarks": "l2",
    "keyframes": "J", "map_points": "m5", "map_ends": "JK", "grid_values": "g", "grid_runs": "g", "grid_ends": "JK",
    "grid_boxes": "JK4", "starts": "K3", "candidates": "c4", "candidate_ends": "JK",
}  # fmt: skip
KNOWN = ("times", "walls", "starts", "grid_boxes")
WHOLE_NUMBERS = ("frames", "keyframes", "grid_runs", "grid_values")
PARTS = {"sight_ends": "sights", "map_ends": "map_points", "grid_ends": "grid_runs", "candidate_ends": "candidates"}


def _end_of(arrays: Sequence[NDArray[Any]], shape: tuple[int, int]) -> IntArray:
    return np.cumsum([len(array) for array in arrays]).reshape(shape)


def check_export(file: Path, option: str, module: str, package: str, suffix: str) -> None:
    """Check that a recording can be written as the file of a viewer.

    Args:
        file: The file.
        option: The option that names it, for errors.
        module: Module that writes such files.
        package: Package of this module.
        suffix: Suffix of such files.

    Raises:
        ValueError: If the package is not installed, the name has another suffix, or the file cannot be written.
    """
    if find_spec(module) is None:
        raise argument_error(option, f"the package {package}", "no such package", f"Install it: pip install {package}.")
    if file.suffix.lower() != suffix:
        raise argument_error(option, f"a name that ends in {suffix}", file, "Viewers know their files by this ending.")
    check_writable(file, option)


def part_of(ends: Array, row: int, robot: int) -> slice:
    """Return the part of concatenated rows that belongs to a step and a robot.

    Args:
        ends: (J, K) or (F, K) ends of all parts.
        row: Index of the step.
        robot: Index of the robot.

    >>> part_of(np.array([[2, 5], [5, 6]]), 1, 1)
    slice(5, 6, None)
    """
    index = row * ends.shape[1] + robot
    flat = ends.ravel()
    return slice(int(flat[index - 1]) if index else 0, int(flat[index]))


def ellipses(landmarks: LandmarkMap) -> FloatArray:
    """Return x, y [m], and semi-axes [m] and angle [rad] of the 95 % ellipse of each landmark, (n, 5)."""
    return np.column_stack([landmarks.means[:, :2], axes_95(landmarks.covariances[:, [0, 0, 1], [0, 1, 1]])])


def axes_95(covariances: FloatArray) -> FloatArray:
    """Return semi-axes, the larger first [m], and angle [rad] of the 95 % ellipses of covariances xx, xy, yy (..., 3).

    >>> axes_95(np.array([1.0, 0.0, 4.0]) / CHI_SQUARE_95).round(3).tolist()
    [2.0, 1.0, 1.571]
    """
    xx, xy, yy = np.moveaxis(np.asarray(covariances, np.float64), -1, 0)
    middle, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    ends = np.sqrt(CHI_SQUARE_95 * np.maximum(np.stack([middle + spread, middle - spread]), 0.0))
    return np.stack([*ends, 0.5 * np.arctan2(2.0 * xy, xx - yy)], axis=-1)


def run_lengths(cells: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], IntArray]:
    """Return the values and lengths of the runs of equal cells, row by row.

    >>> [part.tolist() for part in run_lengths(np.array([[1, 1, 2], [2, 2, 0]], np.uint8))]
    [[1, 2, 0], [2, 3, 1]]
    """
    flat = cells.ravel()
    if not len(flat):
        return flat, np.zeros(0, np.int64)
    begins = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
    return flat[begins], np.diff(np.append(begins, len(flat)))


class EpisodeRecorder:
    """Collector of a recording while an episode runs; it reads the environment and changes nothing.

    Args:
        env: Environment of the episode.
        num_steps: Number of steps of the episode.
        step_s: Duration of a step [s].
        goals: Function that returns the place (2,) [m] to which each robot drives, start frame, or None, where these
            are not the candidates that the environment drives to.
    """

    def __init__(
        self, env: ExplorationEnv, num_steps: int, step_s: float,
        goals: Callable[[], Mapping[str, FloatArray | None]] = dict,
    ) -> None:  # fmt: skip
        self._env, self._agents, self._goals = env, list(env.possible_agents), goals
        self._stride = max(math.ceil((num_steps + 1) / MOST_FRAMES), round(FRAME_S / step_s))
        most = math.ceil((num_steps + 1) / self._stride / MOST_KEYFRAMES)
        self._key_stride = max(most, round(KEYFRAME_S / (self._stride * step_s)))
        self._steps: list[int] = []
        self._rows: dict[str, list[Any]] = {}
        self._last = Progress(0, 0.0, {}, ())
        self._merges: list[MergeRecord] = []

    def on_step(self, progress: Progress) -> None:
        """Record a step, if it is one of those to record."""
        self._last = progress
        self._merges.extend(progress.new_merges)
        if progress.step % self._stride == 0:
            self._record(progress, len(self._steps) % self._key_stride == 0)

    def finish(self, record: EpisodeRecord) -> Recording:
        """Record the last step, and return the recording."""
        if self._steps[-1] != self._last.step or self._rows["keyframes"][-1] != len(self._steps) - 1:
            if self._steps[-1] == self._last.step:
                self._forget_last()
            self._record(self._last, True)
        starts = self._env.true_start_poses
        reckoned = [compose(start, path[self._steps]) for start, path in zip(starts, record.reckoned, strict=True)]
        return replace(self.so_far(), reckoned=np.stack(reckoned, axis=1))

    def so_far(self) -> Recording:
        """Return the recording up to the last recorded step, without dead reckoning."""
        rows, starts = self._rows, self._env.true_start_poses
        robots = len(self._agents)
        frames, keys = (len(self._steps), robots), (len(rows["keyframes"]), robots)
        merges = {(merge.tick, merge.robots_a, merge.robots_b): merge for merge in self._merges}
        events = []
        for event in self._env.events:
            entry = event_entry(event, event.step * TICK)
            if event.kind == "merge":
                merge = merges[event.step, event.robots_a, event.robots_b]
                entry |= {"error_m": merge.error_m, "error_deg": merge.error_deg, "false": merge.is_false}
            events.append(entry)
        return Recording(
            about={
                "names": [f"robot {robot}" for robot in range(robots)], "events": events,
                "cutoff": self._env.config.map_error_cutoff, "placed": "by the true start poses, without a fit",
            },
            times=np.array(rows["times"]), estimate=np.array(rows["estimate"]), truth=np.array(rows["truth"]),
            covariances=np.array(rows["covariances"]),
            frames=np.array(rows["frames"]), scores=np.array(rows["scores"]), coverage=np.array(rows["coverage"]),
            sights=np.concatenate(rows["sights"]), sight_ends=_end_of(rows["sights"], frames),
            walls=self._env.world.walls, landmarks=self._env.true_landmarks[:, :2],
            keyframes=np.array(rows["keyframes"]), map_points=np.concatenate(rows["maps"]),
            map_ends=_end_of(rows["maps"], keys), grid_values=np.concatenate(rows["grid_values"]),
            grid_runs=np.concatenate(rows["grid_runs"]), grid_ends=_end_of(rows["grid_runs"], keys),
            grid_boxes=np.array(rows["grid_boxes"]).reshape(*keys, 4), starts=starts,
            candidates=np.concatenate(rows["candidates"]), candidate_ends=_end_of(rows["candidates"], keys),
        )  # fmt: skip

    def _enter(self, **values: Any) -> None:
        for name, value in values.items():
            self._rows.setdefault(name, []).append(value)

    def _forget_last(self) -> None:
        """Remove the last step, which has no map and is recorded again."""
        self._steps.pop()
        for name in ("times", "estimate", "truth", "covariances", "frames", "scores", "coverage"):
            self._rows[name].pop()
        del self._rows["sights"][-len(self._agents) :]

    def _record(self, progress: Progress, with_maps: bool) -> None:
        env = self._env
        starts, positions = env.true_start_poses, env.episode.world.landmarks
        assert positions is not None
        beliefs = [env.belief(agent) for agent in self._agents]
        infos = [progress.infos[agent] for agent in self._agents]
        covariances = np.stack([rotate_covariances(s[2], b.covariance) for s, b in zip(starts, beliefs, strict=True)])
        self._steps.append(progress.step)
        self._enter(
            times=progress.time, estimate=compose(starts, np.stack([belief.pose for belief in beliefs])),
            truth=env.true_poses,
            covariances=covariances[:, [0, 0, 1], [0, 1, 1]], frames=[belief.frame for belief in beliefs],
            scores=[[float(info[name]) for name in SCORES] for info in infos], coverage=float(infos[0]["coverage"]),
        )  # fmt: skip
        for frame in env.episode.frames:
            self._enter(sights=positions.positions[frame.true_ids[frame.true_ids >= 0], :2])
        if with_maps:
            self._enter(keyframes=len(self._steps) - 1)
            goals = self._goals()
            owners = shared_by([belief.frame for belief in beliefs])
            for robot, (start, belief) in enumerate(zip(starts, beliefs, strict=True)):
                self._record_map(start, belief, owners[robot] == robot, goals.get(self._agents[robot]))

    def _record_map(self, start: FloatArray, belief: Belief, is_owner: bool, goal: FloatArray | None) -> None:
        """Record the map and grid of a robot, unless another robot has them, its candidates and its goal."""
        row, column, last_row, last_column = belief.grid.bounds.tolist() if is_owner else (0, 0, 0, 0)
        cells = belief.grid.cells[row:last_row, column:last_column]
        values, lengths = run_lengths(cells)
        corner = centre_of([row, column], len(belief.grid.cells)) - 0.5 * CELL
        shown = belief.candidates
        frame = compose(start, belief.start_from_group)
        places, kinds, is_goal = shown.goals[shown.valid], shown.kinds[shown.valid], shown.own_goal[shown.valid]
        if goal is not None:
            is_goal = np.linalg.norm(places - goal, axis=1) < SAME_PLACE
            if not is_goal.any():  # no candidate
                places, kinds = np.vstack([places, goal]), np.append(kinds, CandidateKind.NONE)
                is_goal = np.append(is_goal, True)
        goals = compose(start, np.column_stack([places, np.zeros(len(places))]))
        self._enter(
            maps=ellipses(belief.group_map.moved(frame)) if is_owner else np.zeros((0, 5)),
            grid_values=values, grid_runs=lengths.astype(np.int32), grid_boxes=[*corner.tolist(), *cells.shape],
            candidates=np.column_stack([goals[:, :2], kinds, is_goal]),
        )  # fmt: skip


def event_entry(event: MergeEvent, time: float, numbers: Sequence[int] | None = None) -> dict[str, Any]:
    """Return an event of the team as plain values.

    Args:
        time: Time of the event [s].
        numbers: Numbers of the robots; None: their indices.
    """
    return {
        "time": round(time, 3), "kind": event.kind, "a": list(event.robots_a), "b": list(event.robots_b),
        "success": event.kind != "attempt" or event.alignment.success, "text": describe_event(event, numbers),
    }  # fmt: skip
