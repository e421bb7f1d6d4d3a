"""Of which classes objects may stand in states of filters and teams that are kept in files."""

from typing import Any

from slam_backend.alignment_types import Alignment, AlignmentOptions
from slam_backend.attempts import AttemptOptions, AttemptRecord, Straightening
from slam_backend.branches import ReplayedStep
from slam_backend.camera import StereoCamera
from slam_backend.existence import ExistenceModel
from slam_backend.filter_options import FilterOptions
from slam_backend.findings import Findings
from slam_backend.input_log import StepInput
from slam_backend.landmark_map import FIELDS, LandmarkMap
from slam_backend.log_arrays import LogArrays
from slam_backend.measurements import Measurements, TeamMeasurements
from slam_backend.merge_options import MergeOptions
from slam_backend.motion import OdometryModel
from slam_backend.reports import (
    LandmarksCreated,
    MapCopied,
    MapDropped,
    MergeEvent,
    MergeUndone,
    PoseEstimates,
    RejuvenationReport,
    Renaming,
    StepReport,
)
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.reassociation import Refused
from slam_backend.state_codec import SEEDS, Kind, Kinds
from slam_backend.watching import Side, Watch

CONFIGURATIONS = (
    AlignmentOptions, AttemptOptions, ExistenceModel, FilterOptions, MergeOptions, OdometryModel,
    SmoothingOptions, StereoCamera,
)  # fmt: skip
RECORDS = (
    Alignment, AttemptRecord, Findings, LandmarksCreated, LogArrays, MapCopied, MapDropped, Measurements, MergeEvent,
    MergeUndone, PoseEstimates, Refused, RejuvenationReport, Renaming, ReplayedStep, Side, StepInput, StepReport,
    Straightening, TeamMeasurements, Watch,
)  # fmt: skip


def _parts_of_map(landmarks: LandmarkMap) -> list[Any]:
    return [getattr(landmarks, name) for name in FIELDS]


BACKEND_KINDS = Kinds(
    (*CONFIGURATIONS, *RECORDS),
    # A mixture's covariances are symmetric but for rounding: the constructor would change them.
    {LandmarkMap: Kind("LandmarkMap", _parts_of_map, LandmarkMap._trusted)},
).with_others(SEEDS)
"""All classes of this package whose objects may stand in the states of `FastSlam` and `TeamSlam`."""
