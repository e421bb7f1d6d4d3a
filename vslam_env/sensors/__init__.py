"""What the robots' sensors report of the world: measured landmarks and scans, with the true noise."""

from vslam_env.sensors.landmark_sensor import Frame, LandmarkSensor, LandmarkSensorConfig
from vslam_env.sensors.scan import Scan, ScanConfig
from vslam_env.sensors.stereo_sensor import EyeFrame, StereoSensor, StereoSensorConfig

__all__ = [
    "EyeFrame",
    "Frame",
    "LandmarkSensor",
    "LandmarkSensorConfig",
    "Scan",
    "ScanConfig",
    "StereoSensor",
    "StereoSensorConfig",
]
