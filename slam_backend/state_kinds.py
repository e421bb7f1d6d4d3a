"""Classes whose objects states of filters and teams may contain when saved to files."""

from slam_backend.core.state_codec import SEEDS, StateTypes
from slam_backend.fastslam import reports
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.particle_maps import CompactMaps
from slam_backend.fastslam.step_input import StepInput
from slam_backend.maps.alignment_types import Alignment, AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.reassociation import RejectedMeasurements
from slam_backend.smoother.rejuvenation import Draft
from slam_backend.team import reports as team_reports
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.group_merging import JoinedGroups
from slam_backend.team.merge_scheduler import AttemptOptions, AttemptRecord
from slam_backend.team.options import MergeOptions

CONFIGURATIONS = (
    AlignmentOptions, AttemptOptions, ExistenceModel, FilterOptions, MergeOptions, OdometryModel,
    SmoothingOptions, StereoCamera,
)  # fmt: skip
RECORDS = (
    Alignment, AttemptRecord, CompactMaps, Draft, InitialPoses, LandmarkMap, LogArrays, Measurements,
    RejectedMeasurements, ReplayedStep, SlamGraph, StepInput, TeamMeasurements, JoinedGroups, reports.Associations,
    reports.RejuvenationReport, reports.StepReport, team_reports.LandmarkIdMap, team_reports.LandmarksCreated,
    team_reports.MapForked, team_reports.MapReleased, team_reports.MergeEvent, team_reports.MergeUndone,
)  # fmt: skip

BACKEND_KINDS = StateTypes((*CONFIGURATIONS, *RECORDS)).with_others(SEEDS)
"""All classes of this package whose objects the states of `FastSlam` and `TeamSlam` may contain."""
