"""Loaders of worlds from files: floor plans, ROS maps, JSON, and splits of folders."""
