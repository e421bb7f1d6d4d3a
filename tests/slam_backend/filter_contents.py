"""What a filter holds, told apart from where in memory it lies."""

from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import ParticleMaps


def dense(slam: FastSlam) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return ids (n,), means (n, 3, M) [m], covariances (n, 6, M) [m^2] and counts (n, M), 0 where one lacks it."""
    maps = slam.state.maps
    slots = maps.used_slots()
    values, counts = maps.dense(slots)
    return maps.ids[slots], values[:, :3], values[:, 3:], counts.astype(np.int64)


def contents(slam: FastSlam) -> dict[str, Any]:
    """Return all of a snapshot, landmarks by ascending id, each at its particle's own place, zeros where it is lacking.

    Places beyond the last particle, which mean nothing, are left out.
    """
    ids, means, covariances, counts = dense(slam)  # brings all landmarks to their places
    state, count, held = slam.get_state(), slam.num_particles, counts > 0
    maps = state["maps"]
    np.testing.assert_array_equal(maps["ids"], ids)
    np.testing.assert_array_equal(maps["map_of"], 0)
    for name in ("values", "map_of", "maps"):
        del maps[name]
    maps["counts"] = counts
    maps["means"], maps["covariances"] = (np.where(held[:, None], values, 0.0) for values in (means, covariances))
    if maps.get("odds") is not None:
        maps["odds"] = np.where(held, maps["odds"][:, :count], 0.0)
    for name in ("poses", "starts", "means", "covariances"):
        state[name] = state[name][:, :, :count]
    return state


def map_of(slam: FastSlam, particle: int) -> FloatArray:
    """Return (n, 10) what one particle knows of the landmarks it holds: mean, covariance (upper triangle) and count."""
    _, means, covariances, counts = dense(slam)
    held = counts[:, particle] > 0
    columns = (means[held, :, particle], covariances[held, :, particle], counts[held, particle, None])
    return np.concatenate(columns, axis=1)


def load_landmarks(maps: ParticleMaps, values: FloatArray, *names: Any) -> None:
    """Replace all landmarks by these: `values` (n, 9, M) as `dense` gives them, the rest as `load_names` takes it."""
    maps.load_names(*names)
    padded = np.zeros((len(values), 9, maps.padded))
    padded[:, :, : maps.num_particles] = values
    maps.blocks[: len(values)] = padded.reshape(len(values), 9, -1, LANES).transpose(0, 2, 1, 3)


def arrays_of(slam: FastSlam) -> dict[str, Any]:
    """Return all arrays that a filter works with, by owner and name: not copies."""
    owners = {"filter": slam.state, "maps": slam.state.maps}
    return {
        f"{owner}.{name}": value
        for owner, holder in owners.items()
        for name, value in vars(holder).items()
        if isinstance(value, np.ndarray)
    }
