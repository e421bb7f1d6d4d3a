"""Joint graphs of two groups, and what they claim about the relative start of the groups."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import compose, inverse
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import merge_graphs
from slam_backend.smoother.graph_reduction import reduce_keyframes
from slam_backend.smoother.optimizer import optimize
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit
from slam_backend.smoother.rejuvenation import DRAFT_TOLERANCE


class RelativeStart(NamedTuple):
    """Where a group starts in the map frame of another, by their joint graph.

    Attributes:
        motion: (3,) float64 [m, m, rad]. Motion from the frame of b to that of a.
        covariance: (3, 3) float64 [m, m, rad]. Covariance of the motion under the Gaussian about the mode.
    """

    motion: FloatArray
    covariance: FloatArray


def relative_start(
    graph_a: SlamGraph, graph_b: SlamGraph, motion: FloatArray, renamed: IntArray, camera: FloatArray,
    options: SmoothingOptions,
) -> RelativeStart | None:  # fmt: skip
    """Return where b starts in a's frame at the mode of their joint graph; no particles are drawn.

    Args:
        graph_a, graph_b: Graphs of groups a and b, in their frames; the first robot of b defines its frame.
        motion: (3,) [m, m, rad]. Motion from b's frame to a's, the initial estimate.
        renamed, camera, options: See `merge_thinned`.

    Returns:
        None where no mode is found.
    """
    graph = merge_thinned(graph_a, graph_b, motion, renamed, None, camera, options)
    mode = optimize(graph, camera, options, looseness=DRAFT_TOLERANCE)
    if mode.reason:
        return None
    key, began = graph.first_keys[len(graph_a.first_keys)], graph_b.poses[graph_b.first_keys[0]]
    return RelativeStart(compose(mode.poses[key], inverse(began)), mode.covariance(np.array([key])))


def merge_thinned(
    graph_a: SlamGraph, graph_b: SlamGraph, motion: FloatArray, renamed: IntArray, uncertainty: FloatArray | None,
    camera: FloatArray, options: SmoothingOptions,
) -> SlamGraph:  # fmt: skip
    """Return the result of `merge_graphs`, whose slices of work are bounded.

    Args:
        graph_a, graph_b, motion, renamed, uncertainty: Arguments of `merge_graphs`.
        camera: (7,) as kernels take it.
        options: Options of the smoother. With too many keyframes, each graph is first reduced to its share.
    """
    landmarks, latest = _joint_size(graph_a, graph_b, renamed)
    most_keys = keyframe_limit(options, landmarks, latest)
    num_keys = sum(graph.num_keys - graph.num_biases for graph in (graph_a, graph_b))
    if num_keys > most_keys:
        graph_a, graph_b = (_thinned(graph, most_keys, len(latest), camera, options) for graph in (graph_a, graph_b))
    return merge_graphs(graph_a, graph_b, motion, renamed, uncertainty)


def _joint_size(graph_a: SlamGraph, graph_b: SlamGraph, renamed: IntArray) -> tuple[int, IntArray]:
    """Return the number of landmarks of a joint graph, and the newest step of each robot."""
    of_b = renamed[np.isin(renamed[:, 0], graph_b.landmark_ids), 1]
    return len(np.union1d(graph_a.landmark_ids, of_b)), np.concatenate([graph_a.latest, graph_b.latest])


def _thinned(graph: SlamGraph, most_keys: int, robots: int, camera: FloatArray, options: SmoothingOptions) -> SlamGraph:
    """Return a graph reduced to its share of the keyframes of all robots."""
    share = len(graph.last_keys) / robots
    keys, fresh = max(2, int(share * most_keys)), max(1, int(share * options.recent_keys))
    return reduce_keyframes(graph, camera, replace(options, recent_keys=fresh), most_keys=keys)
