"""Worlds from files: floor plans as images, ROS maps, and how folders of them are split."""
