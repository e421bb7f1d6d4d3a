"""Visual FastSLAM for one robot or a team, without any simulator or learner.

`FastSlam` is the filter, `TeamSlam` a team of them that merges maps; `align_maps` and `fuse_maps` work on any two maps.
"""

from slam_backend.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.attempts import AttemptOptions
from slam_backend.camera import StereoCamera
from slam_backend.compilation import log_compilation
from slam_backend.consistency import Consistency
from slam_backend.existence import ExistenceModel
from slam_backend.filter import FastSlam
from slam_backend.filter_options import FilterOptions
from slam_backend.findings import Findings
from slam_backend.fusion import fuse_landmarks, fuse_maps
from slam_backend.landmark_map import LandmarkMap
from slam_backend.measurements import Measurements
from slam_backend.merge_options import MergeOptions
from slam_backend.motion import OdometryModel
from slam_backend.reports import MergeEvent, PoseEstimate, RejuvenationReport, Renaming, StepReport, TeamReport
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.team import TeamSlam
from slam_backend.trajectory import Trajectory
from slam_backend.warming import warm_up

__all__ = [
    "Alignment",
    "AlignmentOptions",
    "AttemptOptions",
    "Consistency",
    "ExistenceModel",
    "FastSlam",
    "FilterOptions",
    "Findings",
    "LandmarkMap",
    "Measurements",
    "MergeEvent",
    "MergeOptions",
    "OdometryModel",
    "PoseEstimate",
    "RejuvenationReport",
    "Renaming",
    "SmoothingOptions",
    "StepReport",
    "StereoCamera",
    "TeamReport",
    "TeamSlam",
    "Trajectory",
    "align_maps",
    "fuse_landmarks",
    "fuse_maps",
    "warm_up",
]

log_compilation()
