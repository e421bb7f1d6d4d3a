"""What the robots' sensors report of the world: measured landmarks and scans, with the true noise."""

from vslam_env.sensors.landmark_sensor import Frame, Frames, LandmarkSensor, LandmarkSensorConfig
from vslam_env.sensors.range_finder import Scan, ScanConfig
from vslam_env.sensors.stereo.sensor import EyeFrame, EyeFrames, StereoSensor, StereoSensorConfig

__all__ = [
    "EyeFrame",
    "EyeFrames",
    "Frame",
    "Frames",
    "LandmarkSensor",
    "LandmarkSensorConfig",
    "Scan",
    "ScanConfig",
    "StereoSensor",
    "StereoSensorConfig",
]
