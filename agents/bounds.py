"""Bounds of policies: they know the ground truth or the future, and show what is left to gain. Not for robots."""

import copy
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from agents.registry import make_policy
from agents.team import SeparatePolicies, TeamPolicy
from slam_backend.core.validation import IntArray, argument_error, check_choice
from vslam_env.belief.team_belief import Belief, Candidates
from vslam_env.navigation import CandidateKind

BOUNDS = ("oracles", "rollout")
ORACLES = ("oracle_pose", "oracle_association", "oracle_merge")
HORIZON = 8  # decisions that are tried in a twin
# Nearest candidates of a robot that are tried, beside the choice of the base policy.
CHOICES = ((CandidateKind.FRONTIER, 4), (CandidateKind.REVISIT, 2))
KEEP = 4  # decisions for which the choice is kept


def make_bound(name: str, env: Any, base: str = "frontier") -> TeamPolicy:
    """Make a bound for all robots: a team policy that knows more than robots can know.

    Args:
        name: `"oracles"`: the base policy in an environment whose robots know their poses, the identities of landmarks,
            and the transforms between their maps. `"rollout"`: each robot in turn takes the candidate with the largest
            reward in a twin of the environment, which has the true rewards and the same future noise, while the
            others follow the base policy (Bertsekas 2021, rollout of one agent at a time).
        env: Environment of the episodes, with `goal` actions.
        base: Policy by name, see `make_policy`.

    Raises:
        ValueError: If there is no such bound or policy, or the environment does not fit.
    """
    check_choice("bound", name, BOUNDS, "Choose one of these; make_policy has the policies.")
    if env.config.action_type != "goal":
        raise argument_error("env", "an environment with goal actions", env.config.action_type, "Set action_type.")
    if name == "rollout":
        return Rollout(env, base)
    missing = [oracle for oracle in ORACLES if not getattr(env.config, oracle)]
    if missing:
        raise argument_error("env", "an environment with all oracles", f"one without {missing[0]}", "Set it to True.")
    return SeparatePolicies(partial(make_policy, base, "goal"))


class Rollout:
    """Team policy that tries candidates in a twin of the environment, one robot at a time.

    Args:
        env: Environment in which it acts.
        base: Name of the base policy.
    """

    def __init__(self, env: Any, base: str) -> None:
        self._env, self._twin = env, None
        self._base = SeparatePolicies(partial(make_policy, base, "goal"))
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._base.reset()
        self._plan: dict[str, int] = {}
        self._age = KEEP

    def act(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, int]:
        """Return the best actions found, or those of the base policy where its choice was best."""
        self._age += 1
        if self._age >= KEEP:
            self._age, self._plan = 0, self._improve(observations, beliefs, rng)
        usual = self._base.act(observations, beliefs, rng)
        return {agent: self._valid(self._plan, agent, beliefs[agent]) or usual[agent] for agent in beliefs}

    def _improve(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, int]:
        """Return the slots + 1 of the robots' goals, 0 for the base policy: one robot after another."""
        if self._twin is None:
            self._twin = self._env.clone()
        state, plan = self._env.get_state(), dict.fromkeys(beliefs, 0)
        best = self._value(state, plan, observations, rng)
        for agent, belief in beliefs.items():
            for slot in _nearest(belief.candidates):
                trial = plan | {agent: 1 + int(slot)}
                value = self._value(state, trial, observations, rng)
                if value > best:
                    best, plan = value, trial
        return plan

    def _value(
        self, state: Any, plan: Mapping[str, int], observations: Mapping[str, Any], rng: np.random.Generator
    ) -> float:
        """Return the reward of the plan over `HORIZON` decisions in the twin, averaged over the robots."""
        twin: Any = self._twin
        twin.set_state(state)
        base, draws, total = copy.deepcopy(self._base), copy.deepcopy(rng), 0.0
        for _ in range(HORIZON):
            if not twin.agents:
                break
            beliefs = {agent: twin.belief(agent) for agent in twin.agents}
            usual = base.act(observations, beliefs, draws)
            actions = {agent: self._valid(plan, agent, beliefs[agent]) or usual[agent] for agent in beliefs}
            observations, rewards, *_ = twin.step(actions)
            total += float(np.mean(list(rewards.values())))
        return total

    @staticmethod
    def _valid(plan: Mapping[str, int], agent: str, belief: Belief) -> int:
        """Return the planned action of an agent while its candidate lives, otherwise 0."""
        action = plan.get(agent, 0)
        return action if action and belief.candidates.valid[action - 1] else 0


def _nearest(candidates: Candidates) -> IntArray:
    """Return the slots of the candidates that are tried, `CHOICES` of each kind."""
    kinds = [(candidates.of_kind(kind), most) for kind, most in CHOICES]
    return np.concatenate([slots[np.argsort(candidates.lengths[slots], kind="stable")][:most] for slots, most in kinds])
