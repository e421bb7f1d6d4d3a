"""What the robots' sensors report of the world: measured landmarks and scans, with the true noise."""

from vslam_env.sensors.landmark_sensor import Frame, LandmarkSensor, LandmarkSensorConfig
from vslam_env.sensors.scan import Scan, ScanConfig

__all__ = ["Frame", "LandmarkSensor", "LandmarkSensorConfig", "Scan", "ScanConfig"]
