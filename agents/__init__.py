"""Exploration policies; they use only observations and beliefs of the robots."""

from agents.policy import Policy
from agents.registry import POLICIES, make_policy

__all__ = ["POLICIES", "Policy", "make_policy"]
