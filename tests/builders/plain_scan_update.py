"""A range scan written into a grid as it is defined: pair of rays by pair of rays, over all cells at once."""

import numpy as np

from vslam_env.navigation import centre_of

PLAIN_SIZE = 600  # cells along a side
INDICES = np.stack(np.meshgrid(np.arange(PLAIN_SIZE), np.arange(PLAIN_SIZE), indexing="ij"), axis=-1)
CENTRES = centre_of(INDICES, PLAIN_SIZE)


def plain_scan_update(
    evidence: np.ndarray, pose: np.ndarray, ranges: np.ndarray, angles: np.ndarray, max_range: float
) -> np.ndarray:
    """Return the evidence (600, 600) int8 of a grid after a scan; arguments as in `OccupancyGrid.update_from_scan`."""
    u, v = CENTRES[..., 0] - pose[0], CENTRES[..., 1] - pose[1]
    rays = np.stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)], axis=1)
    left = [c * v >= s * u for c, s in rays]  # of a ray or on it
    reach, is_hit = np.minimum(ranges, max_range), ranges < max_range
    hits = reach[:, None] * rays
    pairs = range(len(angles) - 1)

    def lines_up(i: int) -> bool:
        if not (0 < i < len(angles) - 1 and is_hit[i - 1 : i + 2].all()):
            return False
        (ax, ay), (bx, by) = hits[i + 1] - hits[i - 1], hits[i] - hits[i - 1]
        return bool(abs(ax * by - ay * bx) <= 0.1 * np.hypot(ax, ay))

    gaps = np.hypot(*np.diff(hits, axis=0).T)
    both, joined = is_hit[:-1] & is_hit[1:], np.array([lines_up(i) or lines_up(i + 1) for i in pairs])
    solid = both & ((gaps <= 0.4) | (joined & (gaps <= 0.8)))
    surface = solid | (both & joined)
    jump = ~surface & (is_hit[:-1] | is_hit[1:])
    across = np.diff(hits, axis=0)
    before = [
        (across[k, 0] * v - across[k, 1] * u + across[k, 1] * hits[k, 0] - across[k, 0] * hits[k, 1])
        / max(gaps[k], 1e-9)
        for k in pairs
    ]
    change = np.zeros(u.shape, np.int64)
    for k in pairs:
        inside = left[0] & ~left[-1] & left[k] & ~left[k + 1] & (np.hypot(u, v) < max_range + 1.0)
        if surface[k]:
            change[inside & (before[k] > 0.12)] = -1
            if solid[k]:
                change[inside & (np.abs(before[k]) < 0.12)] = 3
            continue
        near = np.hypot(u, v) < max(min(reach[k], reach[k + 1]) - (0.12 if jump[k] else 0.0), 0.0)
        goes_on = np.zeros(u.shape, bool)
        on_hit = np.zeros(u.shape, bool)
        if jump[k]:
            for other in (k - 1, k + 1):
                if other in pairs and surface[other]:
                    goes_on |= np.abs(before[other]) < 0.12
            for ray in (k, k + 1):
                if is_hit[ray]:
                    on_hit |= np.maximum(np.abs(u - hits[ray, 0]), np.abs(v - hits[ray, 1])) <= 0.1
        change[inside & near & ~goes_on] = -1
        change[inside & ~near & on_hit] = 3
    after = np.clip(evidence + change, -8, 12)
    after[(after == 0) & (change != 0)] = -1
    return after.astype(np.int8)
