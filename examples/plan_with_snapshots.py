"""Planning with snapshots: random shooting over several decisions, compared with its base policy.

    python examples/plan_with_snapshots.py --seeds 5

Every few decisions the planner evaluates plans in a twin of the environment and executes the best. A plan sends each
robot to one of its candidates and then continues with the base policy (nearest frontier); one plan is the base policy
only. The twin returns true rewards and has the same future noise: the result is an upper bound for learned policies
that choose goals, not a policy for robots.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import typer

from agents import make_policy
from vslam_env import ExplorationEnv, vslam_v1

Plan = dict[str, int]  # slot of each robot's first goal; 0: base policy


class Base:
    """Nearest-frontier policy for all robots."""

    def __init__(self, env: ExplorationEnv) -> None:
        self.policies = {agent: make_policy("frontier", "goal") for agent in env.possible_agents}

    def act(self, env: ExplorationEnv, plan: Plan) -> dict[str, Any]:
        """Return an action for each robot: the planned one while its slot is filled, otherwise the policy's."""
        actions = {}
        for agent in env.agents:
            belief, slot = env.belief(agent), plan.get(agent, 0)
            if slot and belief.candidates.valid[slot - 1]:
                actions[agent] = slot
            else:
                # Nearest frontier uses no randomness; other policies would get their own generator here.
                actions[agent] = self.policies[agent].act(None, belief, np.random.default_rng(0))
        return actions


def draw_plan(env: ExplorationEnv, rng: np.random.Generator) -> Plan:
    """Send each robot to a random candidate, or leave it to the base policy."""
    plan = {}
    for agent in env.agents:
        filled = 1 + np.flatnonzero(env.belief(agent).candidates.valid)
        plan[agent] = int(rng.choice([0, *filled]))
    return plan


def earned(rewards: Mapping[str, float]) -> float:
    """Return the reward of a step, averaged over the robots."""
    return float(np.mean(list(rewards.values())))


def follow(env: ExplorationEnv, plan: Plan, decisions: int) -> float:
    """Execute a plan for some decisions; return its reward."""
    base, total = Base(env), 0.0
    for _ in range(decisions):
        if env.agents:
            total += earned(env.step(base.act(env, plan))[1])
    return total


def best_plan(env: ExplorationEnv, twin: ExplorationEnv, rollouts: int, horizon: int, rng: np.random.Generator) -> Plan:
    """Evaluate plans in the twin from the current state, and return the one with the highest reward."""
    state = env.get_state()
    plans: list[Plan] = [{}] + [draw_plan(env, rng) for _ in range(rollouts)]
    gains = []
    for plan in plans:
        twin.set_state(state)
        gains.append(follow(twin, plan, horizon))
    return plans[int(np.argmax(gains))]


def play(seed: int, decisions: int, rollouts: int, horizon: int) -> float:
    """Run an episode with a new plan every `horizon` decisions; without rollouts the base policy decides."""
    env = vslam_v1.parallel_env(action_type="goal", num_robots=2, max_cycles=decisions)
    env.reset(seed=seed)
    twin, rng, total = env.clone(), np.random.default_rng(seed), 0.0
    while env.agents:
        plan = best_plan(env, twin, rollouts, horizon, rng) if rollouts else {}
        total += follow(env, plan, horizon)
    return total


def main(
    seeds: Annotated[int, typer.Option(help="Episodes.")] = 5,
    first_seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 100,
    decisions: Annotated[int, typer.Option(help="Number of decisions per episode, of 1 s each.")] = 40,
    rollouts: Annotated[int, typer.Option(help="Number of plans in addition to the base policy.")] = 12,
    horizon: Annotated[int, typer.Option(help="Planning horizon in decisions.")] = 5,
) -> None:
    """Compare the planner with its base policy."""
    gains = []
    for seed in range(first_seed, first_seed + seeds):
        alone, planned = play(seed, decisions, 0, horizon), play(seed, decisions, rollouts, horizon)
        gains.append((alone, planned))
        typer.echo(
            f"seed {seed}: nearest frontier {alone:.3f} m, with snapshots {planned:.3f} m reduction of the map error"
        )
    alone, planned = np.mean(gains, axis=0)
    typer.echo(f"mean: nearest frontier {alone:.3f} m, with snapshots {planned:.3f} m")


if __name__ == "__main__":
    typer.run(main)
