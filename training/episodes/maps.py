"""The maps of a run as data: archives that `LandmarkMap.load` reads, and the same as CSV."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from slam_backend.maps.landmark_map import LandmarkMap
    from training.experiments.run_folder import RunFolder

UPPER = ("xx", "xy", "xz", "yy", "yz", "zz")
COLUMNS = ("id", "count", "x_m", "y_m", "z_m", *(f"cov_{pair}_m2" for pair in UPPER))


def group_name(robots: Sequence[int]) -> str:
    """Return the name of a group in file names.

    >>> group_name((2, 5))
    '2-5'
    """
    return "-".join(map(str, robots))


def write_maps(folder: "RunFolder", maps: "Mapping[str, LandmarkMap]") -> str:
    """Write each map as `map_<group>.npz` and `map_<group>.csv`, and return a line that says so.

    Args:
        folder: Folder of the run.
        maps: By the name of the group, each in the start frame of the group's first robot.
    """
    for name, landmarks in maps.items():
        landmarks.save(folder.path / f"map_{name}.npz")
        folder.write_text(f"map_{name}.csv", to_csv(landmarks))
    names = ", ".join(f"map_{name}" for name in maps)
    return f"Maps as data: {names} (.npz for LandmarkMap.load, .csv)."


def to_csv(landmarks: "LandmarkMap") -> str:
    """Return a map as CSV text, every number in the shortest form that reads back bit for bit; no descriptors."""
    upper = landmarks.covariances[:, *np.triu_indices(3)]
    rows = zip(landmarks.ids, landmarks.counts, landmarks.means, upper, strict=True)
    lines = [
        ",".join(map(repr, [int(name), int(count), *mean.tolist(), *own.tolist()])) for name, count, mean, own in rows
    ]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"
