"""The graphs of two groups become one where particles say that they lie."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam_backend import _kernels
from slam_backend.errors import FloatArray, IntArray
from slam_backend.geometry import compose, inverse, rotate_covariances
from slam_backend.smoothing.coarsening import coarsened
from slam_backend.smoothing.graph import PathGraph, mean_pose, scattered
from slam_backend.smoothing.joining import joined
from slam_backend.smoothing.options import SmoothingOptions


def joint_graph(
    own: PathGraph, other: PathGraph, starts: Sequence[FloatArray], frames: tuple[FloatArray, FloatArray],
    renamed: IntArray, camera: FloatArray, options: SmoothingOptions,
) -> tuple[PathGraph, FloatArray]:  # fmt: skip
    """Return the graph of both groups' robots, and the motion (3,) [m, m, rad] from b's frame to a's.

    Args:
        own, other: Graphs of groups a and b, in their frames.
        starts: Three arrays (K, 3, M): where the robots of a, of b, and of both, a's first, started; in a's frame, in
            b's, in a's.
        frames: Two covariances (3, 3) of what a's and b's particles do not show of their maps' frames.
        renamed: (n, 2) rows (name in b, name in the joint map).
        camera: (7,) as kernels take it.
        options: How many keys; in slices either graph is first thinned to its share where both have too many.
    """
    robots = len(starts[2])
    if options.slice_steps is not None and own.num_keys + other.num_keys > options.most_keys(robots):
        own, other = (_thinned(graph, robots, camera, options) for graph in (own, other))
    robot = int(np.flatnonzero(other.previous[other.heads] < 0)[0])  # one that defines b's frame
    start = starts[2][len(starts[0]) + robot]
    began = other.poses[other.heads[robot]].copy()  # can be written: `add_share` is compiled for such arrays alone
    motion = compose(mean_pose(start), inverse(began))
    spreads = scattered(start)[None], np.zeros((1, 3, 3))
    for frame, pose, spread in zip(frames, (mean_pose(start), began), spreads, strict=True):
        _kernels.add_share(frame, pose[None], spread)
    spread = spreads[0][0] + rotate_covariances(float(motion[2]), spreads[1][0])
    return joined(own, other, motion, renamed, spread), motion


def _thinned(graph: PathGraph, robots: int, camera: FloatArray, options: SmoothingOptions) -> PathGraph:
    """Return a graph with no more than its share of all robots' keys."""
    share = len(graph.tips) / robots
    keys, fresh = max(2, int(share * options.most_keys(robots))), max(1, int(share * options.fresh_keys))
    return coarsened(graph, camera, replace(options, max_keys=keys, further_keys=0, fresh_keys=fresh))
