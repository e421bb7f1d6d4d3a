"""A map of landmarks: positions with covariances, descriptors, counts and ids, in one frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import checked_path, write_file
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_int
from slam_backend.geometry import rotate_covariances, transform_points

FORMAT = "vslam landmark map"
FORMAT_VERSION = 1
FIELDS = ("means", "covariances", "descriptors", "counts", "ids")


class MapSummary(NamedTuple):
    """What can be asked of a map at every step, for it costs microseconds: no descriptors, no whole covariances.

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
    """Outlines of one map or several, one after the other, in as few arrays as can be: kernels pay for each.

    Attributes:
        positions: (N, 4) float64 [m, m, m, m^2]. `means` and `variances`.
        counts_and_ids: (N, 2) int64. `counts` and `ids`.
    """

    positions: FloatArray
    counts_and_ids: IntArray

    @classmethod
    def allocate(cls, room: int) -> Self:
        """Return room for so many landmarks."""
        return cls(np.empty((room, 4)), np.empty((room, 2), np.int64))

    @classmethod
    def of(cls, outlines: Sequence[MapSummary]) -> Self:
        """Return these behind one another."""
        means, variances, counts, ids = map(np.concatenate, zip(*outlines, strict=True))
        return cls(np.column_stack([means, variances]), np.column_stack([counts, ids]))

    def part(self, first: int, last: int) -> MapSummary:
        """Return the outline of these landmarks; it shares memory with this."""
        places, names = self.positions[first:last], self.counts_and_ids[first:last]
        return MapSummary(places[:, :3], places[:, 3], names[:, 0], names[:, 1])


class TeamMapSummaries(NamedTuple):
    """The outlines of the maps that the robots of a team go by.

    Attributes:
        rows: The landmarks of all maps; those in no part mean nothing.
        parts: (K, 2) int64. Where each robot's map begins in `rows`, and where it ends; robots of one filter share one.
    """

    rows: MapSummaryRows
    parts: IntArray

    @classmethod
    def allocate(cls, num_robots: int, room: int) -> Self:
        """Return room for the maps of K robots with so many landmarks in all."""
        return cls(MapSummaryRows.allocate(room), np.empty((num_robots, 2), np.int64))

    @classmethod
    def from_maps(cls, outlines: Sequence[MapSummary]) -> Self:
        """Return these, one for each robot, behind one another."""
        ends = np.cumsum([len(outline.ids) for outline in outlines])
        parts = np.column_stack([np.concatenate([[0], ends[:-1]]), ends])
        return cls(MapSummaryRows.of(outlines), parts.astype(np.int64))

    def of(self, robot: int) -> MapSummary:
        """Return that of one robot; it shares memory with this."""
        return self.rows.part(*self.parts[robot])


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """The landmarks l_k = (mu_k, Sigma_k, d_k) of one map (Sec. 3.2), all in the same frame.

    The arrays are read-only copies of what was given.

    Attributes:
        means: (N, 3) float64 [m]. Positions (mu).
        covariances: (N, 3, 3) float64 [m^2]. Symmetric, positive semi-definite (Sigma).
        descriptors: (N, d) float32 [-]. Appearance vectors (d_k), of unit length if matches are gated by distance.
        counts: (N,) int64. How many measurements each landmark is made of; by default one each.
        ids: (N,) int64. Stable names, unique and >= 0; by default 0 .. N - 1.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, a covariance is not symmetric positive semi-definite,
            a count is below 1, or ids repeat.

    >>> len(LandmarkMap([[1.0, 2.0, 0.0]], [np.eye(3)], [[1.0, 0.0]]))
    1
    """

    means: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]
    counts: IntArray = None  # type: ignore[assignment]   # replaced by ones
    ids: IntArray = None  # type: ignore[assignment]   # replaced by 0 .. N - 1

    def __post_init__(self) -> None:
        cure = "Give one row per landmark."
        means = check_array("means", self.means, (None, 3), cure + " Drop landmarks that are not finite.")
        n = len(means)
        fields: dict[str, NDArray[Any]] = {
            "means": means,
            "covariances": _checked_covariances(self.covariances, n),
            "descriptors": check_array("descriptors", self.descriptors, (n, None), cure, dtype=np.float32),
            "counts": np.ones(n, np.int64) if self.counts is None else _checked_integers("counts", self.counts, n, 1),
            "ids": np.arange(n) if self.ids is None else _checked_integers("ids", self.ids, n, 0),
        }
        values, repeats = np.unique(fields["ids"], return_counts=True)
        if n and repeats.max() > 1:
            raise argument_error(
                "ids", "unique ids", f"a repeated id {int(values[repeats.argmax()])}", "Give each its own name."
            )
        for name, array in fields.items():
            object.__setattr__(self, name, as_read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too; the constructor might change covariances by rounding."""
        return unchecked_map, tuple(getattr(self, name) for name in FIELDS)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def summary(self) -> MapSummary:
        """Its places, spreads, counts and names, in the map's order."""
        spread = self.covariances
        return MapSummary(self.means, spread[:, 0, 0] + spread[:, 1, 1] + spread[:, 2, 2], self.counts, self.ids)

    @classmethod
    def empty(cls, descriptor_size: int = 64) -> Self:
        """Return a map without landmarks."""
        check_int("descriptor_size", descriptor_size, 0, "Give the length of a descriptor.")
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, descriptor_size), np.float32))

    def moved(self, a_from_b: ArrayLike) -> "LandmarkMap":
        """Express this map, given in frame b, in frame a; the motion is taken as exact.

        Args:
            a_from_b: (3,) float64 [m, m, rad]. Pose of frame b in frame a. `fusion.move_covariances` adds the
                uncertainty of a motion that was estimated.

        Returns:
            A new map: means R mu + t, covariances R Sigma R^T, the rest shared with this one.

        Raises:
            ValueError: If `a_from_b` is no pose.
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
        """Return some of the landmarks, in the order asked for.

        Args:
            indices: (k,) integers, each at most once, or (N,) bool, a mask.

        Raises:
            ValueError: If they are neither, or name a landmark twice or one that is not there.
        """
        chosen = np.asarray(indices)
        if chosen.dtype == np.bool_ and chosen.shape == (len(self),):
            return unchecked_map(*(getattr(self, name)[chosen] for name in FIELDS))
        cure = f"Give integers from 0 to {len(self) - 1}, or a mask of shape ({len(self)},)."
        if chosen.ndim != 1 or not (chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)):
            raise argument_error("indices", "(k,) integers or a mask", f"an array {chosen.dtype} {chosen.shape}", cure)
        rows = chosen.astype(np.int64)
        if rows.size and (rows.min() < 0 or rows.max() >= len(self) or len(np.unique(rows)) < len(rows)):
            raise argument_error("indices", "rows of the map, each at most once", rows.tolist(), cure)
        return unchecked_map(*(getattr(self, name)[rows] for name in FIELDS))

    def save(self, path: str | Path) -> None:
        """Write the map to `path`, exactly as named, as a numpy archive that `load` reads back bit for bit.

        Raises:
            ValueError: If the file cannot be written; an old one of that name is then unchanged.
        """
        arrays: dict[str, Any] = {name: getattr(self, name) for name in FIELDS}
        packed = BytesIO()
        np.savez(packed, format=np.array(FORMAT), version=np.array(FORMAT_VERSION), **arrays)
        write_file(path, packed.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a map that `save` wrote; nothing of the file is run.

        Raises:
            ValueError: If the file is missing, broken, of another kind or of another format version.
        """
        path, expected = checked_path(path), "a file written by LandmarkMap.save"
        if not Path(path).is_file():
            raise argument_error("path", expected, "no such file", f"Check the path {str(path)!r}.")
        cure = f"Save the map again; {str(path)!r} cannot be used."
        try:
            found = read_arrays(Path(path))
            kind, version = str(found["format"]), int(found["version"])
            arrays = {name: found[name] for name in FIELDS} if version == FORMAT_VERSION else {}
        except (ValueError, KeyError, TypeError) as error:
            raise argument_error("path", expected, "a broken file", cure) from error
        if kind != FORMAT or version != FORMAT_VERSION:
            raise argument_error("path", f"{FORMAT!r} version {FORMAT_VERSION}", f"{kind!r} version {version}", cure)
        return cls(**arrays)  # type: ignore[arg-type]


def _checked_covariances(value: Any, n: int) -> FloatArray:
    """Return `value` as fresh (n, 3, 3) covariances, exactly symmetric, or raise."""
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
    """Return `value` as fresh (n,) integers >= `minimum`, or raise; whole numbers in floats are accepted."""
    cure = f"Give one integer >= {minimum} per landmark."
    as_float = check_array(name, value, (n,), cure)
    if n and (as_float.min() < minimum or (as_float != np.round(as_float)).any()):
        raise argument_error(name, f"integers >= {minimum}", as_float.tolist(), cure)
    array: IntArray = check_array(name, value, (n,), cure, dtype=np.int64)
    return array


def unchecked_map(
    means: FloatArray, covariances: FloatArray, descriptors: NDArray[np.float32], counts: IntArray, ids: IntArray
) -> LandmarkMap:
    """Build a map in a hot loop: no copies, no checks. The caller must not write to the arrays afterwards."""
    result = object.__new__(LandmarkMap)
    arrays: tuple[NDArray[Any], ...] = (means, covariances, descriptors, counts, ids)
    for name, array in zip(FIELDS, arrays, strict=True):
        object.__setattr__(result, name, as_read_only(array))
    return result
