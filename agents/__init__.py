"""Exploration policies; they use only observations and beliefs of the robots."""

from agents.bounds import BOUNDS, make_bound
from agents.policy import Policy
from agents.registry import POLICIES, make_policy, make_team_policy
from agents.team import TeamPolicy

__all__ = ["BOUNDS", "POLICIES", "Policy", "TeamPolicy", "make_bound", "make_policy", "make_team_policy"]
