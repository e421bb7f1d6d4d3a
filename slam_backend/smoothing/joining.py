"""Two graphs become one, as their groups do at a merge: nothing of what either has smoothed is done again."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, compose, rotation
from slam_backend.smoothing.graph import NONE, OF_FROZEN, OF_POINTS, RIGID, VAGUE, PathGraph

FIXES = 3  # landmarks in common from which measurements alone say how two groups lie


def joined(
    a: PathGraph, b: PathGraph, motion: FloatArray, renamed: IntArray, uncertainty: FloatArray | None = None
) -> PathGraph:
    """Return the graph of both groups' robots, a's first, in a's frame.

    Measurements and odometry are seen from key poses, so that they stay as they are. All keys and landmarks of b are
    moved; what was given in b's frame is now sought, rigid among itself: its first start with a vague prior about where
    the move puts it, the other starts by links to that one. So only landmarks in common say how the groups lie. Where
    there are fewer than `FIXES` of them the motion is all that does, and counts as certain as it is.

    Args:
        a: Whose frame, robots and landmark names stay.
        b: The other.
        motion: (3,) [m, m, rad] from b's frame to a's; a guess, from which the next descent starts.
        renamed: (n, 2) int64 rows (name in b, name in the joint map), each name in b once. What else b saw is left out.
        uncertainty: (3, 3) covariance of where b's first robot started [m, m, rad], a's frame. None: nothing is known.
    """
    names = dict(zip(renamed[:, 0].tolist(), a.known_as(renamed[:, 1]).tolist(), strict=True))
    b = _named(_moved(b, motion), names)
    fixed = uncertainty is None or len(np.intersect1d(a.landmark_ids, b.landmark_ids)) >= FIXES
    loose, b = _unpinned(b, np.diag(VAGUE) if fixed else np.asarray(uncertainty))
    origin = np.flatnonzero(a.robots == NONE)
    if not len(origin):
        a, origin = _with_origin(a), np.array([a.num_keys])
    keys, frames = a.num_keys, len(a.frame_keys)
    previous = np.where(b.previous >= 0, b.previous + keys, NONE)
    previous[loose] = origin[0]
    ids, rows = np.unique(np.concatenate([a.landmark_ids, b.landmark_ids]), return_inverse=True)
    landmarks = np.empty((len(ids), 3))
    of_b = rows[len(a.landmark_ids) :]
    landmarks[of_b], landmarks[rows[: len(a.landmark_ids)]] = b.landmarks, a.landmarks
    shifted = {
        "robots": b.robots + len(a.tips),
        "previous": previous,
        "frame_keys": b.frame_keys + keys,
        "point_frames": b.point_frames + frames,
        "point_landmarks": of_b[b.point_landmarks],
        "frozen_keys": b.frozen_keys + keys,
        "frozen_landmarks": of_b[b.frozen_landmarks],
        "heads": b.heads + keys,
        "tips": b.tips + keys,
    }
    both = {
        name: np.concatenate([getattr(a, name), shifted.get(name, getattr(b, name))])
        for name in a.__dataclass_fields__
        if name not in ("landmark_ids", "landmarks")
    }
    for name in ("point_landmarks", "frozen_landmarks"):
        own = len(getattr(a, name))
        both[name][:own] = rows[: len(a.landmark_ids)][both[name][:own]]
    return PathGraph(**both, landmark_ids=ids, landmarks=landmarks)


def _moved(graph: PathGraph, motion: FloatArray) -> PathGraph:
    """Return the graph with poses and landmarks in another frame; links from the origin are as they were."""
    landmarks = graph.landmarks.copy()
    landmarks[:, :2] = landmarks[:, :2] @ rotation(motion[2]).T + motion[:2]
    return graph.with_columns(poses=compose(motion, graph.poses), landmarks=landmarks)


def _named(graph: PathGraph, names: Mapping[int, int]) -> PathGraph:
    """Return the graph with its landmarks under new names; those that have none, and what was seen of them, go."""
    new = np.array([names.get(name, NONE) for name in graph.landmark_ids.tolist()], dtype=np.int64)
    kept = new >= 0
    row = np.cumsum(kept) - 1
    aliases = [(names[old], names[by]) for old, by in graph.aliases.tolist() if old in names and by in names]
    return graph.with_columns(
        **_rows(graph, OF_POINTS, kept[graph.point_landmarks], row),
        **_rows(graph, OF_FROZEN, kept[graph.frozen_landmarks], row),
        landmark_ids=new[kept],
        landmarks=graph.landmarks[kept],
        aliases=np.array(aliases, dtype=np.int64).reshape(-1, 2),
    )


def _rows(graph: PathGraph, names: tuple[str, ...], kept: BoolArray, row: IntArray) -> dict[str, Any]:
    """Return some rows of columns; landmarks are counted anew."""
    columns = {name: getattr(graph, name)[kept] for name in names}
    return columns | {name: row[column] for name, column in columns.items() if name.endswith("_landmarks")}


def _unpinned(graph: PathGraph, prior: FloatArray) -> tuple[IntArray, PathGraph]:
    """Return the starts that hang on nothing of the group (n,), and the group without an origin, none of it given.

    These starts are where they are but for a prior covariance (3, 3).
    """
    origin = np.flatnonzero(graph.robots == NONE)
    given = np.flatnonzero((graph.previous == NONE) & (graph.robots >= 0))
    loose = np.flatnonzero(np.isin(graph.previous, origin) & (graph.robots >= 0))
    previous, motions, noises = graph.previous.copy(), graph.motions.copy(), graph.noises.copy()
    free = np.concatenate([given[:1], loose]).astype(np.int64)
    previous[given], motions[given], noises[given] = given[:1], 0.0, RIGID**2 * np.eye(3)
    if len(given):
        motions[given] = between(graph.poses[given[0]], graph.poses[given])
    previous[free], motions[free], noises[free] = NONE, graph.poses[free], prior
    graph = graph.with_columns(previous=previous, motions=motions, noises=noises)
    if not len(origin):
        return free, graph
    kept = graph.robots >= 0
    number = np.cumsum(kept) - 1
    per_key = ("robots", "poses", "motions", "noises", "spreads", "slack")
    return number[free], graph.with_columns(
        **{name: getattr(graph, name)[kept] for name in per_key},
        previous=np.where(previous >= 0, number[previous], NONE)[kept],
        **{name: number[getattr(graph, name)] for name in ("frame_keys", "frozen_keys", "heads", "tips")},
    )


def _with_origin(graph: PathGraph) -> PathGraph:
    """Return the graph with a key at the origin of its frame."""
    return graph.with_columns(
        robots=np.append(graph.robots, NONE),
        poses=np.concatenate([graph.poses, np.zeros((1, 3))]),
        previous=np.append(graph.previous, NONE),
        motions=np.concatenate([graph.motions, np.zeros((1, 3))]),
        noises=np.concatenate([graph.noises, np.zeros((1, 3, 3))]),
        spreads=np.append(graph.spreads, 0.0),
        slack=np.append(graph.slack, 0.0),
    )
