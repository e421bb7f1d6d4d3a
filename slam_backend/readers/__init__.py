"""Readers of real robots' logs, from files to odometry and `Measurements`.

For other logs, `read_csv` reads named columns, and `range_bearing_steps` converts velocities, ranges and bearings to
steps of a filter, with the help of `integrate_commands` and `points_from_polar`. `read_graph` and `write_graph` take
pose graphs.
"""

from slam_backend.readers.conversions import integrate_commands, points_from_polar
from slam_backend.readers.pose_graphs import read_graph, write_graph
from slam_backend.readers.range_bearing import RangeBearingSteps, range_bearing_steps
from slam_backend.readers.tables import CsvTable, read_csv

__all__ = [
    "CsvTable",
    "RangeBearingSteps",
    "integrate_commands",
    "points_from_polar",
    "range_bearing_steps",
    "read_csv",
    "read_graph",
    "write_graph",
]
