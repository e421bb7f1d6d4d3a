"""Visual FastSLAM for one robot or a team, independent of simulators and learners.

`FastSlam` is the filter, `TeamSlam` a team of filters that merges maps; `align_maps` and `fuse_maps` take any two maps.
"""

from slam_backend.core.compilation.messages import log_compilation
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import (
    Associations,
    BiasEstimate,
    PoseEstimate,
    RejuvenationReport,
    Relocalisation,
    StepReport,
)
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.maps.fusion import fuse_landmarks, fuse_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.pose_graph import PoseGraph
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarkIdMap, MergeEvent, TeamReport
from slam_backend.team.team import TeamSlam
from slam_backend.trajectory import Trajectory
from slam_backend.warm_up import warm_up

__all__ = [
    "Alignment",
    "AlignmentOptions",
    "Associations",
    "AttemptOptions",
    "BiasEstimate",
    "Consistency",
    "ExistenceModel",
    "FastSlam",
    "FilterOptions",
    "LandmarkIdMap",
    "LandmarkMap",
    "Measurements",
    "MergeEvent",
    "MergeOptions",
    "OdometryModel",
    "PoseEstimate",
    "PoseGraph",
    "RejuvenationReport",
    "Relocalisation",
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
