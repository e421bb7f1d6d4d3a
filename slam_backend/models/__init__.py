"""Sensor and motion models: stereo camera, odometry and measurements."""
