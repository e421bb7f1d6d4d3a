"""Readers of real robots' logs: each turns its files into odometry and `Measurements`.

For a log of your own: `read_csv` reads columns by their names, and `range_bearing_steps` turns velocities, ranges and
bearings into steps of a filter. `integrate_commands` and `points_from_polar` are what that is made of.
"""

from slam_backend.readers.conversions import integrate_commands, points_from_polar
from slam_backend.readers.range_bearing import RangeBearingSteps, range_bearing_steps
from slam_backend.readers.tables import CsvTable, read_csv

__all__ = [
    "CsvTable",
    "RangeBearingSteps",
    "integrate_commands",
    "points_from_polar",
    "range_bearing_steps",
    "read_csv",
]
