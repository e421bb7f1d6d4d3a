"""Registry of the classes whose instances may occur in saved environment states."""

from slam_backend.core.state_codec import StateType, StateTypes
from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrame
from slam_backend.frontend.stereo import StereoMatches
from slam_backend.state_kinds import BACKEND_KINDS
from vslam_env.belief.belief import BeliefConfig
from vslam_env.belief.readings import TeamReadings
from vslam_env.belief.shared_grids import GridSnapshot, GridUpdate
from vslam_env.config import EnvConfig
from vslam_env.evaluation.team_metrics import BeliefSummary, RobotCounts, RobotMetrics, TeamMetrics
from vslam_env.sensors import LandmarkSensorConfig, ScanConfig, StereoSensorConfig, TeamRenderedFrames, TeamSensorFrames
from vslam_env.sensors.stereo.cameras import ImagingConfig
from vslam_env.sensors.stereo.textures import TextureConfig, WallTextures
from vslam_env.simulation.scenario import Scenario
from vslam_env.world import LandmarkConfig, Landmarks, OdometryNoise, World

CONFIGURATIONS = (
    BeliefConfig, CornerOptions, EnvConfig, FrontEndOptions, ImagingConfig, LandmarkConfig, LandmarkSensorConfig,
    OdometryNoise, ScanConfig, StereoSensorConfig, TextureConfig,
)  # fmt: skip
RECORDS = (
    BeliefSummary, RobotCounts, RobotMetrics, GridSnapshot, GridUpdate, Landmarks, StereoFrame, StereoMatches,
    TeamMetrics, TeamReadings, TeamRenderedFrames, TeamSensorFrames, WallTextures, World,
)  # fmt: skip


ENV_KINDS = StateTypes(
    (*CONFIGURATIONS, *RECORDS), {Scenario: StateType("Scenario", Scenario.to_parts, Scenario.from_parts)}
).with_others(BACKEND_KINDS)
"""All classes whose instances may occur in the state of an environment."""
