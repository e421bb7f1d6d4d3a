"""Robots of a team in processes of their own, which tell each other their maps (`docs/explanation/distributed.md`)."""

from slam_backend.distributed.robot_slam import LinkEvent, RobotSlam

__all__ = ["LinkEvent", "RobotSlam"]
