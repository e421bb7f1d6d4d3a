"""Simulated sensors with true noise: landmark sensor, rendered stereo cameras and range finder."""

from vslam_env.sensors.landmark_sensor import LandmarkSensor, LandmarkSensorConfig, SensorFrame, TeamSensorFrames
from vslam_env.sensors.range_finder import RangeFinder, ScanConfig
from vslam_env.sensors.stereo.sensor import RenderedFrame, StereoSensor, StereoSensorConfig, TeamRenderedFrames

__all__ = [
    "LandmarkSensor",
    "LandmarkSensorConfig",
    "RangeFinder",
    "RenderedFrame",
    "ScanConfig",
    "SensorFrame",
    "StereoSensor",
    "StereoSensorConfig",
    "TeamRenderedFrames",
    "TeamSensorFrames",
]
