"""Measurements of one robot's camera in one step: points, descriptors and optional covariances."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array
from slam_backend.fastslam import _kernels
from slam_backend.state import FLOAT32, FLOAT64, INT64, MAX_DESCRIPTOR, Array, Maybe, Sizes, State, with_state

LEAST_VARIANCE, LARGEST_VARIANCE = 1e-14, 1e12  # [m^2]; keeps differences of log-weights representable in float64
LARGEST_CONDITION = 1e8  # about 1 / sqrt(machine epsilon); beyond it float64 updates lose positive definiteness


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """The measurements z_t = (v_t, d_t) of one frame (Sec. 2.2).

    Attributes:
        points: (n, 3) float64 [m], camera frame (X right, Y down, Z ahead). Measured landmark positions (v_t).
        descriptors: (n, d) float32 [-]. Appearance vectors (d_t); d is the same in all frames of a run.
        covariances: None, or (n, 3, 3) float64 [m^2], camera frame. None: the camera model, evaluated at the predicted
            point.
        extent: Smallest depth Z and largest magnitude of a coordinate of all points [m].

    Raises:
        ValueError: If a shape is wrong, a number is not finite, a descriptor is too large, or a covariance is not
            positive definite or too ill-conditioned or small for float64.
    """

    STATE: ClassVar[State] = State(
        points=Array(FLOAT64, "n 3", constant=True),
        descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR, constant=True),
        covariances=Maybe(Array(FLOAT64, "n 3 3", constant=True)),
    )

    points: FloatArray
    descriptors: NDArray[np.float32]
    covariances: FloatArray | None = field(default=None)
    extent: tuple[float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        hint = "Give one row per measured point."
        points: Any = check_array("points", self.points, (None, 3), hint + " Drop points that are not finite.")
        descriptors: Any = check_array("descriptors", self.descriptors, (len(points), None), hint, dtype=np.float32)
        if descriptors.size and np.abs(descriptors).max() > MAX_DESCRIPTOR:
            largest = float(np.abs(descriptors).max())
            expected = f"numbers within +-{MAX_DESCRIPTOR:g}"
            raise argument_error("descriptors", expected, largest, "Scale them, best to unit length.")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "descriptors", descriptors)
        if self.covariances is not None:
            covariances: Any = check_array("covariances", self.covariances, (len(points), 3, 3), hint)
            _check_covariances(covariances)
            object.__setattr__(self, "covariances", covariances)
        for name in ("points", "descriptors", "covariances"):
            if (array := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_read_only(array))
        object.__setattr__(self, "extent", _kernels.extent(self.points))

    def __len__(self) -> int:
        return len(self.points)

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled frames read-only, so that the extent remains valid."""
        return _restored, (self.points, self.descriptors, self.covariances, self.extent)

    @classmethod
    def empty(cls, descriptor_size: int = 64) -> "Measurements":
        """Return a frame without points."""
        return cls(np.empty((0, 3)), np.empty((0, descriptor_size), dtype=np.float32))


@short_repr
@with_state(
    points=Array(FLOAT64, "n 3", constant=True),
    descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR, constant=True),
    offsets=Array(INT64, "K", constant=True),
)
class TeamMeasurements(NamedTuple):
    """Concatenated frames of several robots, without covariances.

    A filter checks them at its next step.

    Attributes:
        points: (n, 3) float64 [m]. Points of all robots in turn, each in its camera's frame.
        descriptors: (n, d) float32. Descriptors of the points.
        offsets: (K,) int64. End of each robot's points, the start of the next robot's.
    """

    points: FloatArray
    descriptors: NDArray[np.float32]
    offsets: IntArray

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless the offsets ascend to the number of points."""
        offsets = parts["offsets"]
        if (np.diff(offsets) < 0).any() or offsets[-1] != sizes["n"]:
            raise ValueError(f"offsets that do not ascend to {sizes['n']}")

    def per_robot(self) -> list[Measurements]:
        """Return the frame of each robot, as read-only views; the caller must not write to the arrays afterwards."""
        ends = self.offsets.tolist()
        points, descriptors = as_read_only(self.points), as_read_only(self.descriptors)
        parts = [(points[a:b], descriptors[a:b]) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        return [_restored(seen, described, None, _kernels.extent(seen)) for seen, described in parts]


def _restored(
    points: FloatArray, descriptors: NDArray[np.float32], covariances: FloatArray | None, extent: tuple[float, float]
) -> Measurements:
    """Return a frame of arrays that were checked before and have no other writer."""
    frame, assign = object.__new__(Measurements), object.__setattr__
    for name, value in zip(Measurements.__slots__, (points, descriptors, covariances, extent), strict=True):
        assign(frame, name, as_read_only(value) if isinstance(value, np.ndarray) and value.flags.writeable else value)
    return frame


def _check_covariances(covariances: FloatArray) -> None:
    """Raise unless covariances (n, 3, 3) are symmetric and positive definite with a margin for rounding."""
    if not len(covariances):
        return
    scale = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    if (np.abs(covariances - covariances.transpose(0, 2, 1)) > 1e-6 * scale).any():
        raise argument_error("covariances", "symmetric matrices", "a different transpose", "Symmetrise them first.")
    eigenvalues = np.linalg.eigvalsh(covariances)
    least, largest = eigenvalues[:, 0], eigenvalues[:, 2]
    if least.min() <= 0.0:
        raise argument_error(
            "covariances",
            "positive definite matrices",
            "a smallest eigenvalue <= 0",
            "Give every direction some noise, or pass None to use the camera model.",
        )
    if least.min() < LEAST_VARIANCE or largest.max() > LARGEST_VARIANCE:
        got = float(least.min() if least.min() < LEAST_VARIANCE else largest.max())
        expected = f"eigenvalues from {LEAST_VARIANCE:g} to {LARGEST_VARIANCE:g} m^2"
        raise argument_error("covariances", expected, got, "Check the units: metres squared.")
    if (largest > LARGEST_CONDITION * least).any():
        got = float((largest / least).max())
        hint = "Raise the smallest variance: updates in float64 would lose positive definiteness."
        raise argument_error("covariances", f"ratios of eigenvalues up to {LARGEST_CONDITION:g}", got, hint)
