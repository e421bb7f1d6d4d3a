"""Planners that divide frontiers among robots: each robot for itself, or the team centrally."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from agents.goal_choice import GoalHolder
from agents.planners.common.targets import Targets, own_targets, team_targets
from agents.policy import Policy
from slam_backend.core.validation import IntArray
from vslam_env.belief.team_belief import Belief

# Target (K,) of each robot; all robots of the targets are considered. Without random draws in most planners.
Assign = Callable[[Targets, np.random.Generator], IntArray]


class TeamPolicy(Protocol):
    """Policy of all robots at once, as a team with perfect radio has it."""

    def reset(self) -> None:
        """Clear the state of the last episode."""

    def act(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, Any]:
        """Choose the actions of all robots.

        Args:
            observations: Observation of each agent, as the environment returned them.
            beliefs: Belief of each agent.
            rng: Source of all random draws.

        Returns:
            An action for each agent.
        """


class Assigned(GoalHolder):
    """Planner of one robot that solves the assignment for its group on its own belief, and takes its own part.

    Args:
        assign: Function that assigns a target to each robot.
    """

    def __init__(self, assign: Assign) -> None:
        super().__init__()
        self._assign = assign

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the previous one is kept unless another is much better."""
        targets = own_targets(belief, self._held)
        self._held = None if targets is None else int(targets.slots[0, self._assign(targets, rng)[0]])
        return self._held


class CentralPolicy:
    """Team policy for `goal` actions that assigns the frontiers of each group to its robots centrally.

    Robots that do not share a map yet know nothing of each other's frontiers: each group has its own assignment.

    Args:
        assign: Function that assigns a target to each robot.
    """

    def __init__(self, assign: Assign) -> None:
        self._assign = assign
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._held: dict[int, int | None] = {}

    def act(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, int]:
        """Return 1 + the slot of the assigned frontier for each agent, or 0."""
        groups: dict[tuple[int, ...], list[str]] = {}
        for agent, belief in beliefs.items():
            groups.setdefault(belief.group, []).append(agent)
        for agents in groups.values():
            self._decide([beliefs[agent] for agent in agents], rng)
        chosen = {agent: self._held[belief.robot] for agent, belief in beliefs.items()}
        return {agent: 0 if slot is None else 1 + slot for agent, slot in chosen.items()}

    def _decide(self, beliefs: list[Belief], rng: np.random.Generator) -> None:
        """Choose the slots of the robots of one group."""
        targets = team_targets(beliefs, self._held)
        if targets is None:
            self._held |= dict.fromkeys((belief.robot for belief in beliefs), None)
            return
        assigned = self._assign(targets, rng)
        for row, belief in enumerate(beliefs):
            slot = int(targets.slots[row, assigned[row]])
            if slot < 0:  # not among this robot's candidates: its nearest one
                slot = int(targets.slots[row, targets.lengths[row].argmin()])
            self._held[belief.robot] = slot if slot >= 0 else None


class SeparatePolicies:
    """Team policy that asks the policy of each robot.

    Args:
        make: Function that makes the policy of one robot.
    """

    def __init__(self, make: Callable[[], Policy]) -> None:
        self._make = make
        self._policies: dict[str, Policy] = {}

    def reset(self) -> None:
        """Clear the state of the last episode."""
        for policy in self._policies.values():
            policy.reset()

    def act(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, Any]:
        """Return the actions of the robots' own policies."""
        for agent in beliefs:
            if agent not in self._policies:
                self._policies[agent] = self._make()
        return {agent: self._policies[agent].act(observations[agent], belief, rng) for agent, belief in beliefs.items()}
