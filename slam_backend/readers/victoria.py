"""Reader of the Victoria Park log: controls, trees and GPS fixes of a car-like vehicle.

J. Guivant and E. Nebot, Australian Centre for Field Robotics, University of Sydney; the data set's `info.txt` describes
the files.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from slam_backend.core.files import checked_path
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error, check_float
from slam_backend.models.measurements import Measurements
from slam_backend.readers.conversions import HOLD, integrate_commands, points_from_polar
from slam_backend.readers.range_bearing import motions
from slam_backend.readers.tables import MOST_JITTER, sorted_note, steps_back, time_order

CONTROLS_FILE = "aa3_dr.mat"
TREES_FILE = "VictoriaParkSinSincronizar.mat"
GPS_FILE = "aa3_gpsx.mat"
MAX_STEERING = 1.0  # [rad], beyond the steering angle of any car
MILLISECONDS = 1000.0  # milliseconds per second, for the files of controls and GPS


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class VictoriaLog:
    """Log of a car-like vehicle among trees. The arrays are read-only, in order of time, with a common clock.

    Attributes:
        controls: (n, 3) float64 [s, m/s, rad]. Time, speed of the rear left wheel, steering angle (positive left).
        scan_times: (T,) float64 [s]. Times of the laser scans.
        scans: T arrays (k, 3) float64 [m, rad, m]. Range, bearing and diameter of each detected tree; bearings are
            positive to the left of straight ahead.
        gps: (g, 3) float64 [s, m, m]. Time, east, north of each fix, with gaps; None without a file of fixes.
        notes: Lines about files that were sorted by time.
    """

    controls: FloatArray
    scan_times: FloatArray
    scans: tuple[FloatArray, ...]
    gps: FloatArray | None
    notes: tuple[str, ...] = ()


def load_victoria(path: str | Path, duration: float | None = None) -> VictoriaLog:
    """Read a folder such as that of the Victoria Park data set.

    Entries up to `MOST_JITTER` back in time are sorted, with a remark in the notes of the log. At equal times the last
    control and the first scan of the file apply.

    Args:
        path: Folder with `aa3_dr.mat` (`time` [ms], `speed`, `steering`), `VictoriaParkSinSincronizar.mat` (`TLsr` [s],
            `zt`: per scan rows of range, bearing from the right hand side, diameter) and optionally `aa3_gpsx.mat`
            (`timeGps` [ms], `Lo_m`, `La_m`).
        duration: Length of the log from the first control [s]. None: the whole log.

    Raises:
        ValueError: If the folder, a file or a variable is missing, a file cannot be read, numbers are not finite or
            impossible, lengths disagree, no scan lies among the controls, or a time lies more than
            `MOST_JITTER` back; the message names the file.
    """
    folder = checked_path(path)
    if not folder.is_dir():
        raise argument_error("path", "a folder of the Victoria Park log", "no such folder", f"Check {str(path)!r}.")
    end = np.inf
    driven = _read(folder / CONTROLS_FILE, ("time", "speed", "steering"))
    controls, words = _sorted(CONTROLS_FILE, _table(folder / CONTROLS_FILE, driven, tuple(driven), MILLISECONDS))
    if np.abs(controls[:, 2]).max() > MAX_STEERING:
        raise _bad(folder / CONTROLS_FILE, f"steering angles within +-{MAX_STEERING:g} rad", "a larger one")
    if duration is not None:
        end = controls[0, 0] + check_float("duration", duration, "Give seconds, or None for the whole log.", above=0.0)
    found = _read(folder / TREES_FILE, ("TLsr", "zt"))
    times = _table(folder / TREES_FILE, found, ("TLsr",), 1.0)[:, 0]
    cells = found["zt"].ravel()
    if found["zt"].dtype != object or len(cells) != len(times):
        expected = f"a cell array zt with one cell for each of {len(times)} times"
        raise _bad(folder / TREES_FILE, expected, "a different one")
    scans = [_trees(folder / TREES_FILE, number, cell) for number, cell in enumerate(cells)]
    if not ((times >= controls[0, 0]) & (times <= controls[-1, 0] + HOLD)).any():
        expected = f"times TLsr in seconds among those of the controls, {controls[0, 0]:.1f} to {controls[-1, 0]:.1f} s"
        raise _bad(folder / TREES_FILE, expected, f"a log of scans from {times[0]:.1f} to {times[-1]:.1f} s")
    order, trees_words = time_order(TREES_FILE, times)
    _, first = np.unique(times[order], return_index=True)
    times, scans = times[order[first]], [scans[number] for number in order[first]]
    gps, gps_words = None, ""
    if (folder / GPS_FILE).exists():
        fixes = _read(folder / GPS_FILE, ("timeGps", "Lo_m", "La_m"))
        gps, gps_words = _sorted(GPS_FILE, _table(folder / GPS_FILE, fixes, tuple(fixes), MILLISECONDS))
    kept = int(np.searchsorted(times, end, side="right"))
    if not kept:
        raise argument_error("duration", "long enough for a scan", duration, f"The first one is at {times[0]:.1f} s.")
    controls, times = controls[controls[:, 0] <= end], times[:kept]
    for array in (controls, times, *scans, *([] if gps is None else [gps])):
        array.setflags(write=False)
    return VictoriaLog(controls, times, tuple(scans[:kept]), gps, sorted_note([words, trees_words, gps_words]))


def _sorted(name: str, table: FloatArray) -> tuple[FloatArray, str]:
    """Return rows (n, columns), time first, in order of time, and the remark of `time_order` about the file `name`."""
    order, words = time_order(name, table[:, 0])
    return table[order], words


def _read(file: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the named variables of a MATLAB file."""
    if not file.is_file():
        raise argument_error("path", f"a folder with {file.name}", "no such file", f"Check {str(file)!r}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # scipy warns of contents that it cannot read
            content = loadmat(file, variable_names=names)
    except Exception as error:  # any type, for truncated, damaged or HDF5 files
        raise _bad(file, "a MATLAB file of version 5 to 7.2", "a broken file") from error
    missing = [name for name in names if name not in content]
    if missing:
        raise _bad(file, "variables " + ", ".join(names), f"no variable {missing[0]!r}")
    return {name: content[name] for name in names}


def _table(file: Path, content: dict[str, Any], names: tuple[str, ...], unit: float) -> FloatArray:
    """Return variables as columns (n, names); the first one holds times with `unit` ticks per second."""
    columns = []
    for name in names:
        values = content[name]
        if values.dtype.kind not in "iuf" or values.size != max(values.shape) or not values.size:
            raise _bad(file, f"a row or column of numbers {name}", f"an array {values.dtype} {values.shape}")
        columns.append(values.ravel().astype(np.float64))
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(f"{len(column)} {name}" for name, column in zip(names, columns, strict=True))
        raise _bad(file, "as many values of each variable", f"'{lengths}'")
    table = np.stack(columns, axis=-1)
    if not np.isfinite(table).all():
        raise _bad(file, "finite numbers", f"NaN or infinity in {names[int(np.argwhere(~np.isfinite(table))[0][1])]}")
    table[:, 0] /= unit
    backwards = np.flatnonzero(steps_back(table[:, 0]) > MOST_JITTER)
    if len(backwards):
        later = int(backwards[0])
        got = f"a time {table[later, 0]:.3f} s after {table[:later, 0].max():.3f} s at index {later}"
        raise _bad(file, f"times {names[0]} that go back by at most {MOST_JITTER:g} s", got)
    return table


def _trees(file: Path, number: int, cell: Any) -> FloatArray:
    """Return the trees (k, 3) of a scan, bearings positive to the left of straight ahead."""
    if cell.size == 0:
        return np.empty((0, 3))
    if cell.ndim != 2 or cell.shape[0] != 3 or cell.dtype.kind not in "iuf":
        got = f"an array {cell.dtype} {cell.shape} in cell {number}"
        raise _bad(file, "rows of range, bearing and diameter in each cell of zt", got)
    trees: FloatArray = cell.T.astype(np.float64)
    if not np.isfinite(trees).all() or (trees[:, 0] <= 0.0).any() or (trees[:, 2] < 0.0).any():
        raise _bad(file, "finite numbers, ranges > 0 and diameters >= 0 in zt", f"a row that is not in cell {number}")
    if (trees[:, 1] < 0.0).any() or (trees[:, 1] > np.pi).any():
        raise _bad(file, "bearings from 0 to pi in zt", f"a bearing outside in cell {number}")
    trees[:, 1] -= 0.5 * np.pi
    return trees


def _bad(file: Path, expected: str, got: str) -> ValueError:
    """Return the error of an invalid file."""
    return argument_error("path", f"{file.name} with {expected}", got, f"Get {str(file)!r} again.")


# Positions of laser and encoder relative to the middle of the rear axle [m], from the vehicle model that E. Nebot
# publishes with the data (acfr.usyd.edu.au, "Ute modeling info"): L = 2.83, H = 0.76, b = 0.5, a = L + 0.95.
WHEELBASE = 2.83  # L
ENCODER = 0.76  # H, distance of the rear left wheel from the middle of the axle
SENSOR = (3.78, 0.5, 0.0)  # (a, b) and height, which is arbitrary for a planar sensor


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class TreeNoise:
    """Assumed errors of one reading of a tree.

    Between consecutive scans, readings of a tree vary by 0.03 m in range near the laser and 0.06 m at 60 m, and by
    0.003 and 0.0015 rad in bearing. The errors that a filter must assume are larger: readings of a trunk depend on the
    side from which it is seen, and their errors are correlated from scan to scan. The defaults are half of the median
    trunk's diameter (0.42 m) and two of the laser's rays (half a degree each).

    Attributes:
        range: Standard deviation of a range [m].
        bearing: Standard deviation of a bearing [rad].
        height: Standard deviation of the height [m].
    """

    range: float = 0.2
    bearing: float = 0.02
    height: float = 0.1

    def __post_init__(self) -> None:
        for name in ("range", "bearing", "height"):
            check_float(f"sensor.{name}", getattr(self, name), "Give a standard deviation.", above=0.0)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class VictoriaSteps:
    """Log as steps at the times of its scans.

    Attributes:
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad]. Motion of the rear axle since the previous step; the first is zero.
        measurements: T entries; None for a scan without trees. Points are relative to the laser at `SENSOR`; all
            descriptors are equal.
    """

    times: FloatArray
    odometry: FloatArray
    measurements: tuple[Measurements | None, ...]


def to_filter_steps(log: VictoriaLog, noise: TreeNoise | None = None) -> VictoriaSteps:
    """Convert a log to odometry and measurements.

    Args:
        log: Log from `load_victoria`.
        noise: Assumed errors of each tree. None: `TreeNoise()`.
    """
    noise = TreeNoise() if noise is None else noise
    path = integrate_commands(axle_velocities(log.controls), log.scan_times)
    path.setflags(write=False)
    return VictoriaSteps(log.scan_times, motions(path), tuple(_frame(trees, noise) for trees in log.scans))


def axle_velocities(controls: FloatArray) -> FloatArray:
    """Return the velocities (n, 3) [s, m/s, rad/s] of the middle of the rear axle under controls (n, 3) [s, m/s, rad].

    v_c = v_e / (1 - tan(alpha) H / L), omega = v_c tan(alpha) / L: the encoder measures the left wheel, which is slower
    than the middle of the axle in a left turn.

    >>> axle_velocities(np.array([[0.0, 2.0, 0.0]])).tolist()
    [[0.0, 2.0, 0.0]]
    """
    slope = np.tan(controls[:, 2])
    speed = controls[:, 1] / (1.0 - slope * ENCODER / WHEELBASE)
    return np.stack([controls[:, 0], speed, speed * slope / WHEELBASE], axis=-1)


def _frame(trees: FloatArray, noise: TreeNoise) -> Measurements | None:
    """Return the trees (n, 3) of a scan as measurements with equal descriptors; None if there are none."""
    if not len(trees):
        return None
    variances = np.tile([noise.range**2, noise.bearing**2, noise.height**2], (len(trees), 1))
    points, covariances = points_from_polar(trees[:, 0], trees[:, 1], variances)
    return Measurements(points, np.ones((len(trees), 1), dtype=np.float32), covariances)
