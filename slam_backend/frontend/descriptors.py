"""Upright image descriptors of unit length: u-SURF, SIFT and ORB."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.validation import Float32Array, FloatArray, IntArray
from slam_backend.frontend.images import Image
from slam_backend.frontend.usurf import SIZE, describe, integral_of

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

DESCRIPTORS = ("usurf", "sift", "orb")
SIFT_DIAMETER = 5.0  # of a SIFT keypoint per scale [px]; its 16 cells cover about the window of u-SURF, 21 s
ORB_BITS = 256


class DescriptorType(NamedTuple):
    """Size and gates of a descriptor type.

    Attributes:
        size: Length d of a descriptor.
        gate: Largest L2 distance of descriptors of one point; a filter's `descriptor_gate`.
        stereo_gate: Largest L2 distance between the two images of a pair.
    """

    size: int
    gate: float
    stereo_gate: float


DESCRIPTOR_TYPES = {
    "usurf": DescriptorType(SIZE, 0.45, 0.45),
    "sift": DescriptorType(128, 0.6, 0.6),
    "orb": DescriptorType(ORB_BITS, 0.8, 0.8),  # unit vectors that differ in 64 of 256 signs are 1.0 apart
}


def describe_points(image: Image, points: FloatArray, scales: FloatArray, kind: str) -> Float32Array:
    """Return descriptors of points of a checked image.

    SIFT and ORB are OpenCV's, with upright keypoints. Points without a descriptor, near the border, have the zero
    vector. ORB has one scale; its bits become signs of 1/16, so that the L2 distance is the square root of the number
    of different bits, over 8.

    Args:
        image: (H, W) uint8.
        points: (n, 2) float64 [px].
        scales: (n,) float64 [px].
        kind: Key of `DESCRIPTOR_TYPES`.

    Returns:
        (n, d) float32.
    """
    if kind == "usurf":
        return describe(integral_of(image), points, scales)
    size = DESCRIPTOR_TYPES[kind].size
    described = np.zeros((len(points), size), dtype=np.float32)
    if not len(points):
        return described
    diameters = np.full(len(points), 31.0) if kind == "orb" else SIFT_DIAMETER * scales
    keypoints = [
        cv2.KeyPoint(float(x), float(y), float(diameter), 0.0, 1.0, 0, row)
        for row, ((x, y), diameter) in enumerate(zip(points, diameters, strict=True))
    ]
    kept, found = _extractor(kind).compute(image, keypoints)
    if found is None:
        return described
    rows = np.array([keypoint.class_id for keypoint in kept])
    if kind == "orb":
        described[rows] = (2.0 * np.unpackbits(found, axis=1) - 1.0) / np.sqrt(ORB_BITS)
    else:
        described[rows] = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)
    return described


_EXTRACTORS: dict[str, Any] = {}


def _extractor(kind: str) -> Any:
    """Return OpenCV's extractor, cached."""
    if kind not in _EXTRACTORS:
        _EXTRACTORS[kind] = cv2.SIFT.create() if kind == "sift" else cv2.ORB.create(nlevels=1, edgeThreshold=16)
    return _EXTRACTORS[kind]


def nearest(ours: Float32Array, theirs: Float32Array) -> tuple[IntArray, Float32Array]:
    """Return for each of (n, d) the nearest of (m, d), and its squared L2 distance, by one matrix product."""
    squares = (ours * ours).sum(axis=1)[:, None] + (theirs * theirs).sum(axis=1)[None] - 2.0 * ours @ theirs.T
    best = squares.argmin(axis=1)
    return best, np.maximum(squares[np.arange(len(ours)), best], 0.0)
