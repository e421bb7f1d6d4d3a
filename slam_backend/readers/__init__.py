"""Readers of real robots' logs: each turns its files into odometry and `Measurements`."""
