"""All that some robots observe, written in one call."""

from typing import Any

from slam_backend.core.jit import in_place
from vslam_env._observation_kernels.numbers import clip_candidates, write_map_stats, write_pose, write_teammates
from vslam_env._observation_kernels.pictures import paint


@in_place
def observe_team(
    robots: Any, poses: Any, beliefs: Any, places: Any, names: Any, parts: Any, cells: Any, scans: Any,
    clipped: Any, deviations: Any, stats: Any, ranges: Any, candidates: Any, teammates: Any, present: Any,
    pictures: Any,
) -> None:  # fmt: skip
    """Write what robots observe.

    Args:
        robots: As in `View`.
        poses, beliefs: (n, K, 3), (n, 16 + K). Of its points.
        places, names, parts: (N, 4), (N, 2) int64, (n, 2) int64. Of its outlines.
        cells: Of the view.
        scans: (n, R) float64 [m].
        clipped, deviations, stats: (n, 3), (n, 3), (n, 6) float32: `pose`, `pose_std`, `map_stats`. Written to, as all
            that follow.
        ranges: (n, R) float32: `scan`.
        candidates: (n, 16, 5) float32, as they are without bounds.
        teammates: (n, 7, 5) float32.
        present: (n, 7) int8: `teammates_mask`.
        pictures: (n, 3, 48, 48) uint8: `local_grid`.
    """
    for k in range(len(robots)):
        for r in range(scans.shape[1]):
            ranges[k, r] = scans[k, r]
        held = slice(parts[k, 0], parts[k, 1])
        known = write_teammates(robots[k], poses[k], beliefs[k], teammates[k], present[k])
        write_pose(beliefs[k], clipped[k], deviations[k])
        write_map_stats(places[held], names[held], beliefs[k], 1 + known, stats[k])
        clip_candidates(candidates[k])
        paint(cells[k], beliefs[k], places[held], pictures[k])
