"""Landmarks of random maps: how they look, and how uncertain they are."""

import numpy as np

D = 32  # size of a descriptor


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw n unit descriptors."""
    d = rng.standard_normal((n, D))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def blurred(rng: np.random.Generator, descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors with a noise of 0.17 in L2, of unit length again."""
    d = descriptors + rng.standard_normal(descriptors.shape) * 0.17 / np.sqrt(D)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def covariances(rng: np.random.Generator, n: int, low: float = 0.1, high: float = 1.0) -> np.ndarray:
    """Draw n covariances whose axes have standard deviations between `low` and `high` [m]."""
    axes = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    return np.einsum("nij,nj,nkj->nik", axes, rng.uniform(low, high, (n, 3)) ** 2, axes)
