"""Digest of an episode: two episodes with the same digest are the same, bit for bit."""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from training.episodes.runner import EpisodeRecord


def episode_digest(record: EpisodeRecord) -> str:
    """Return 32 hexadecimal digits of SHA-256 over the true and estimated paths, scores, merges and final maps.

    The last bits of floating-point numbers depend on the processor and on the versions of the libraries, and so does
    the digest.
    """
    digest = hashlib.sha256()

    def add(values: ArrayLike, kind: type) -> None:
        array: NDArray[Any] = np.ascontiguousarray(values, kind)
        digest.update(repr(array.shape).encode() + array.tobytes())

    for values in (record.times, record.true_poses, record.estimated, record.map_errors, record.coverage):
        add(values, np.float64)
    for merge in record.merges:
        add([merge.tick, merge.landmarks], np.int64)
        add(merge.robots_a, np.int64)
        add(merge.robots_b, np.int64)
        add([merge.error_m, merge.error_deg, -1.0 if merge.undone is None else merge.undone], np.float64)
    for landmark_map, claims in zip(record.maps, record.map_claims, strict=True):
        add(landmark_map.means, np.float64)
        add(landmark_map.covariances, np.float64)
        add(claims, np.int64)
    return digest.hexdigest()[:32]
