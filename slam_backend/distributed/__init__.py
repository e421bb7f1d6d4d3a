"""Robots of a team in processes of their own, which exchange maps and graphs; see docs/explanation/distributed.md."""

from slam_backend.distributed.robot_slam import LinkEvent, RobotSlam

__all__ = ["LinkEvent", "RobotSlam"]
