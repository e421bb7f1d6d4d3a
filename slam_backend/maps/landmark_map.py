"""Landmark maps: positions with covariances, descriptors, counts and ids in one frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.array_files import OtherKindError, read_arrays
from slam_backend.core.files import checked_path, write_file
from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import existing_file
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_int
from slam_backend.geometry import rotate_covariances, transform_points
from slam_backend.maps.map_files import to_csv, to_ply
from slam_backend.state import (
    FLOAT32,
    FLOAT64,
    INT64,
    MAX_DESCRIPTOR,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Sizes,
    State,
)

FORMAT = "vslam landmark map"
FORMAT_VERSION = 1
FIELDS = ("means", "covariances", "descriptors", "counts", "ids")
OTHER_FORMATS: dict[str, Callable[["LandmarkMap"], str | bytes]] = {".csv": to_csv, ".ply": to_ply}


@short_repr
class MapSummary(NamedTuple):
    """Summary of a map without descriptors and full covariances, cheap enough for every step.

    Attributes:
        means: (N, 3) float64 [m].
        variances: (N,) float64 [m^2]. Traces of the covariances.
        counts: (N,) int64.
        ids: (N,) int64.
    """

    means: FloatArray
    variances: FloatArray
    counts: IntArray
    ids: IntArray


class MapSummaryRows(NamedTuple):
    """Concatenated summaries of one or more maps in two arrays, because each array argument of a kernel costs time.

    Attributes:
        positions: (N, 4) float64 [m, m, m, m^2]. Columns `means` and `variances` of `MapSummary`.
        counts_and_ids: (N, 2) int64. Columns `counts` and `ids` of `MapSummary`.
    """

    positions: FloatArray
    counts_and_ids: IntArray

    @classmethod
    def allocate(cls, size: int) -> Self:
        """Return uninitialised rows for `size` landmarks."""
        return cls(np.empty((size, 4)), np.empty((size, 2), np.int64))

    @classmethod
    def of(cls, summaries: Sequence[MapSummary]) -> Self:
        """Return the concatenated summaries."""
        means, variances, counts, ids = map(np.concatenate, zip(*summaries, strict=True))
        return cls(np.column_stack([means, variances]), np.column_stack([counts, ids]))

    def part(self, first: int, last: int) -> MapSummary:
        """Return the summary of rows `first` to `last`, as views."""
        positions, integers = self.positions[first:last], self.counts_and_ids[first:last]
        return MapSummary(positions[:, :3], positions[:, 3], integers[:, 0], integers[:, 1])


class TeamMapSummaries(NamedTuple):
    """Summaries of the maps that the robots of a team use.

    Attributes:
        rows: Landmarks of all maps; rows outside all parts are undefined.
        parts: (K, 2) int64. First row and end of each robot's map in `rows`; robots of one filter share a map.
    """

    rows: MapSummaryRows
    parts: IntArray

    @classmethod
    def allocate(cls, num_robots: int, size: int) -> Self:
        """Return uninitialised summaries for K robots with `size` landmarks in all."""
        return cls(MapSummaryRows.allocate(size), np.empty((num_robots, 2), np.int64))

    @classmethod
    def from_maps(cls, summaries: Sequence[MapSummary]) -> Self:
        """Return the summaries of a team from one for each robot."""
        ends = np.cumsum([len(summary.ids) for summary in summaries])
        parts = np.column_stack([np.concatenate([[0], ends[:-1]]), ends])
        return cls(MapSummaryRows.of(summaries), parts.astype(np.int64))

    def of(self, robot: int) -> MapSummary:
        """Return the summary of one robot's map, as views."""
        return self.rows.part(*self.parts[robot])


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """The landmarks l_k = (mu_k, Sigma_k, d_k) of one map (Sec. 3.2), all in the same frame.

    The arrays are read-only copies of the arguments.

    Attributes:
        means: (N, 3) float64 [m]. Positions (mu).
        covariances: (N, 3, 3) float64 [m^2]. Symmetric, positive semi-definite (Sigma).
        descriptors: (N, d) float32 [-]. Appearance vectors (d_k), of unit length if matches are gated by distance.
        counts: (N,) int64. Number of measurements of each landmark; by default 1.
        ids: (N,) int64. Stable ids, unique and >= 0; by default 0 .. N - 1.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, a covariance is not symmetric positive semi-definite,
            a count is below 1, or ids repeat.

    >>> len(LandmarkMap([[1.0, 2.0, 0.0]], [np.eye(3)], [[1.0, 0.0]]))
    1
    """

    STATE = State(
        means=Array(FLOAT64, "n 3", -MAX_DISTANCE, MAX_DISTANCE),
        covariances=Array(FLOAT64, "n 3 3"),
        descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR),
        counts=Array(INT64, "n"),
        ids=Array(INT64, "n", 0, MAX_LANDMARKS),
    )
    means: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]
    counts: IntArray = None  # type: ignore[assignment]   # replaced by ones
    ids: IntArray = None  # type: ignore[assignment]   # replaced by 0 .. N - 1

    def __post_init__(self) -> None:
        hint = "Give one row per landmark."
        means = check_array("means", self.means, (None, 3), hint + " Drop landmarks that are not finite.")
        n = len(means)
        fields: dict[str, NDArray[Any]] = {
            "means": means,
            "covariances": _checked_covariances(self.covariances, n),
            "descriptors": check_array("descriptors", self.descriptors, (n, None), hint, dtype=np.float32),
            "counts": np.ones(n, np.int64) if self.counts is None else _checked_integers("counts", self.counts, n, 1),
            "ids": np.arange(n) if self.ids is None else _checked_integers("ids", self.ids, n, 0),
        }
        values, repeats = np.unique(fields["ids"], return_counts=True)
        if n and repeats.max() > 1:
            raise argument_error(
                "ids", "unique ids", f"a repeated id {int(values[repeats.argmax()])}", "Give each landmark its own id."
            )
        for name, array in fields.items():
            object.__setattr__(self, name, as_read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled maps read-only, without the constructor, which may round covariances."""
        return unchecked_map, tuple(getattr(self, name) for name in FIELDS)

    @staticmethod
    def from_parts(**arrays: Any) -> "LandmarkMap":
        """Return the map with these parts of a state, without the constructor, which may round covariances."""
        return unchecked_map(**arrays)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse a state with a repeated id."""
        if len(np.unique(parts["ids"])) < len(parts["ids"]):
            raise ValueError("a repeated id")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def summary(self) -> MapSummary:
        """Positions, variances, counts and ids, in the map's order."""
        sigma = self.covariances
        return MapSummary(self.means, sigma[:, 0, 0] + sigma[:, 1, 1] + sigma[:, 2, 2], self.counts, self.ids)

    @classmethod
    def empty(cls, descriptor_size: int = 64) -> Self:
        """Return a map without landmarks."""
        check_int("descriptor_size", descriptor_size, 0, "Give the length of a descriptor.")
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, descriptor_size), np.float32))

    def moved(self, a_from_b: ArrayLike) -> "LandmarkMap":
        """Return this map, given in frame b, in frame a; the motion is assumed exact.

        Args:
            a_from_b: (3,) float64 [m, m, rad]. Pose of frame b in frame a. `fusion.move_covariances` adds the
                uncertainty of an estimated motion.

        Returns:
            A new map with means R mu + t and covariances R Sigma R^T; other arrays are shared.

        Raises:
            ValueError: If `a_from_b` is not a pose.
        """
        pose = check_array("a_from_b", a_from_b, (3,), "Give a pose (x, y, theta).")
        return unchecked_map(
            transform_points(pose, self.means),
            rotate_covariances(float(pose[2]), self.covariances),
            self.descriptors,
            self.counts,
            self.ids,
        )

    def subset(self, indices: ArrayLike) -> "LandmarkMap":
        """Return a map of some of the landmarks, in the order of the indices.

        Args:
            indices: (k,) integers without repetition, or a mask (N,) bool.

        Raises:
            ValueError: If they are neither, or an index is repeated or out of range.
        """
        chosen = np.asarray(indices)
        if chosen.dtype == np.bool_ and chosen.shape == (len(self),):
            return unchecked_map(*(getattr(self, name)[chosen] for name in FIELDS))
        hint = f"Give integers from 0 to {len(self) - 1}, or a mask of shape ({len(self)},)."
        if chosen.ndim != 1 or not (chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)):
            raise argument_error("indices", "(k,) integers or a mask", f"an array {chosen.dtype} {chosen.shape}", hint)
        rows = chosen.astype(np.int64)
        if rows.size and (rows.min() < 0 or rows.max() >= len(self) or len(np.unique(rows)) < len(rows)):
            raise argument_error("indices", "rows of the map, each at most once", rows.tolist(), hint)
        return unchecked_map(*(getattr(self, name)[rows] for name in FIELDS))

    def save(self, path: str | Path) -> None:
        """Write the map to `path`, with no suffix added, in the format that its suffix names.

        - `.npz` or none: a numpy archive that `load` reads back bit for bit.
        - `.csv`: a table of ids, counts, positions and covariances, see `map_files.to_csv`.
        - `.ply`: a cloud of points for MeshLab, CloudCompare or Open3D, see `map_files.to_ply`.

        Raises:
            ValueError: If the suffix is another one, or the file cannot be written; an existing file is then unchanged.
        """
        suffix = check_suffix(path)
        if suffix in OTHER_FORMATS:
            write_file(path, OTHER_FORMATS[suffix](self))
            return
        arrays: dict[str, Any] = {name: getattr(self, name) for name in FIELDS}
        packed = BytesIO()
        np.savez(packed, format=np.array(FORMAT), version=np.array(FORMAT_VERSION), **arrays)
        write_file(path, packed.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a map that `save` wrote; no code in the file is run.

        Raises:
            ValueError: If the file is missing, broken, of another kind or of another format version.
        """
        expected = "a map (.npz) that LandmarkMap.save wrote"
        path = existing_file(path, kind=expected)
        hint = f"Save the map again; {str(path)!r} cannot be used."
        try:
            found = read_arrays(path)
            kind, version = str(found["format"]), int(found["version"])
            arrays = {name: found[name] for name in FIELDS} if version == FORMAT_VERSION else {}
        except (OtherKindError, KeyError) as error:
            hint = f"Check {str(path)!r}{'' if path.suffix == '.npz' else ': only .npz is read back'}."
            raise argument_error("path", expected, "a file of another kind", hint) from error
        except (ValueError, TypeError, OverflowError) as error:
            raise argument_error("path", expected, "a broken file", hint) from error
        if kind != FORMAT or version != FORMAT_VERSION:
            raise argument_error("path", f"{FORMAT!r} version {FORMAT_VERSION}", f"{kind!r} version {version}", hint)
        return cls(**arrays)  # type: ignore[arg-type]


def check_suffix(path: str | Path, name: str = "path") -> str:
    """Return the suffix of a file of a map, in lower case.

    Args:
        path: Path of the file.
        name: Name of the argument in the error.

    Raises:
        ValueError: If `LandmarkMap.save` writes no such files.
    """
    suffix = checked_path(path, name).suffix.lower()
    if suffix not in ("", ".npz", *OTHER_FORMATS):
        hint = "Only .npz is read back; .csv and .ply are for other programs."
        raise argument_error(name, "a name that ends in .npz, .csv or .ply", path, hint)
    return suffix


def _checked_covariances(value: Any, n: int) -> FloatArray:
    """Return `value` as new (n, 3, 3) covariances, exactly symmetric, or raise."""
    array: FloatArray = check_array("covariances", value, (n, 3, 3), "Give one 3x3 matrix per landmark.")
    transposed = array.transpose(0, 2, 1)
    if not np.allclose(array, transposed, rtol=1e-6, atol=1e-12):
        raise argument_error("covariances", "symmetric matrices", "an asymmetric one", "Symmetrise them first.")
    array = 0.5 * (array + transposed)
    # A rank-deficient matrix has eigenvalues of either sign at the rounding error of its size.
    if n and (np.linalg.eigvalsh(array)[:, 0] < -1e-9 * np.abs(array).max(axis=(1, 2))).any():
        raise argument_error(
            "covariances",
            "positive semi-definite matrices",
            "a negative eigenvalue",
            "A variance cannot be negative: check how they were computed.",
        )
    return array


def _checked_integers(name: str, value: Any, n: int, minimum: int) -> IntArray:
    """Return `value` as new (n,) integers >= `minimum`, or raise; whole numbers in floats are accepted."""
    hint = f"Give one integer >= {minimum} per landmark."
    as_float = check_array(name, value, (n,), hint)
    if n and (as_float.min() < minimum or (as_float != np.round(as_float)).any()):
        raise argument_error(name, f"integers >= {minimum}", as_float.tolist(), hint)
    array: IntArray = check_array(name, value, (n,), hint, dtype=np.int64)
    return array


def unchecked_map(
    means: FloatArray, covariances: FloatArray, descriptors: NDArray[np.float32], counts: IntArray, ids: IntArray
) -> LandmarkMap:
    """Build a map without copies and checks. The caller must not write to the arrays afterwards."""
    result = object.__new__(LandmarkMap)
    arrays: tuple[NDArray[Any], ...] = (means, covariances, descriptors, counts, ids)
    for name, array in zip(FIELDS, arrays, strict=True):
        object.__setattr__(result, name, as_read_only(array))
    return result
