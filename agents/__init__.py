"""Exploration policies that see only what a robot can know."""

from agents.policy import Policy
from agents.registry import POLICIES, make_policy

__all__ = ["POLICIES", "Policy", "make_policy"]
