"""Sensor and motion models: stereo camera, odometry, and what one camera measures in a step."""
