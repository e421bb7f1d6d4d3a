"""Policies of the exploration benchmark: of each robot, of the team, and bounds, by their names on the command line."""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

from agents.bounds import BOUNDS, make_bound
from agents.plugins import is_plugin, plugin_file
from agents.policy import keys_for
from agents.registry import action_types, make_policy, make_team_policy, model_file
from agents.trained import MODEL_FILE
from slam_backend.core.validation import check_choice
from training.bench.exploration.config import ALL_ORACLES, ANY_SPLIT, ORACLES
from training.episodes.config import RunConfig
from training.episodes.guard import GuardedTeam
from training.experiments.policy_names import parted_label
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.world import is_single_layout

ROBOT, TEAM, BOUND = "robot", "team", "bound"
BASE = "frontier"  # base policy of the bounds


class Player(NamedTuple):
    """Policy of a trial.

    Attributes:
        label: Name on the command line and in results, which marks team policies and bounds.
        name: Name of the policy or the bound.
        action_type: Action type.
        role: `robot`, `team` or `bound`.
    """

    label: str
    name: str
    action_type: str
    role: str

    @property
    def policy(self) -> str:
        """Name of a policy: that of the base policy for a bound."""
        return BASE if self.role == BOUND else self.name

    @property
    def observation_keys(self) -> str | tuple[str, ...]:
        """Keys of the observations of its environment."""
        return keys_for(make_policy(self.policy, self.action_type), self.action_type)

    def source_file(self) -> Path | None:
        """Return the file of a custom policy or a model; None for planners."""
        return plugin_file(self.policy) if is_plugin(self.policy) else model_file(self.policy)

    def source_digest(self) -> str:
        """Return 16 hexadecimal digits of SHA-256 over a custom policy's file or a model; empty for planners."""
        file = self.source_file()
        return "" if file is None else hashlib.sha256(file.read_bytes()).hexdigest()[:16]

    @property
    def needs_oracles(self) -> bool:
        """Whether the environment must tell the robots the truth."""
        return self.role == BOUND and self.name == "oracles"

    def make(self, env: ExplorationEnv, limit: float) -> GuardedTeam:
        """Make the policies of an environment's robots.

        Args:
            env: Environment of the episode.
            limit: Longest time of a decision [s]; bounds have none.
        """
        if self.role == BOUND:
            return GuardedTeam(make_bound(self.name, env, BASE), self.label, self.action_type)
        if self.role == TEAM:
            return GuardedTeam(make_team_policy(self.name, self.action_type), self.label, self.action_type, limit)
        policies = {agent: make_policy(self.name, self.action_type) for agent in env.possible_agents}
        return GuardedTeam(policies, self.label, self.action_type, limit)


def environment_of(policy: str, oracle: str, world: str, split: str, **run: Any) -> EnvConfig:
    """Return the environment of an episode of a policy.

    Args:
        policy: Label of the policy.
        oracle: Ground truth given to the robots: `NO_ORACLE`, `ALL_ORACLES` or one of `ORACLES`.
        world: World family or path.
        split: Split of worlds, or `ANY_SPLIT`.
        run: More fields of `RunConfig`.
    """
    player = parted(policy)
    config = RunConfig(
        world=world, policy=player.policy, action_type=player.action_type, **run,  # type: ignore[arg-type]
    ).environment()  # fmt: skip
    has_all = oracle == ALL_ORACLES or player.needs_oracles
    oracles = {f"oracle_{name}": has_all or oracle == name for name in ORACLES}
    return config.replace(world_split=world_split(split, world), **oracles)


def world_split(split: str, world: str) -> str | None:
    """Return the split of an environment, None where a world is not drawn or any will do."""
    return None if split == ANY_SPLIT or is_single_layout(world) else split


def label(name: str) -> str:
    """Return the label of a policy or a world for tables and figures: a path is given without its folders.

    >>> label("runs/train-0-1"), label("runs/train-0-1/model.npz"), label("mine=look_again:LookAgain@discrete")
    ('train-0-1', 'train-0-1/model.npz', 'mine@discrete')
    """
    given, policy = parted_label(name)
    if given:
        _, at, suffix = policy.rpartition("@")
        return f"{given}{at}{suffix}" if at else given
    path = Path(name)
    if is_plugin(name):
        return name
    return f"{path.parent.name}/{path.name}" if path.name == MODEL_FILE else path.name


def parted(label: str) -> Player:
    """Return the policy of a label: `goal` if the policy supports it, unless `@` selects another action type.

    `NAME@team` is the central team policy, `NAME@bound` a bound; `LABEL=` may come first.

    Raises:
        ValueError: If there is no such policy, or it does not support the action type.

    >>> parted("mtsp@team").role, parted("frontier@discrete").action_type, parted("random_walk").action_type
    ('team', 'discrete', 'continuous')
    """
    _, policy = parted_label(label)
    name, at, wanted = policy.rpartition("@") if "@" in policy else (policy, "", "")
    if wanted == BOUND:
        hint = "Choose one of these; policies have no @bound."
        return Player(label, check_choice("bound", name, BOUNDS, hint), "goal", BOUND)
    known = action_types(name)
    if not at:
        return Player(label, name, known[0], ROBOT)
    choices = (*known, TEAM)
    hint = "Choose an action type that the policy supports, or team."
    check_choice(f"{name}@", wanted, choices, hint)
    return Player(label, name, known[0], TEAM) if wanted == TEAM else Player(label, name, wanted, ROBOT)
