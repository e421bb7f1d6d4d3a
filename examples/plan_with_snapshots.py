"""Look ahead with snapshots: random shooting over a few decisions, beside the policy that it starts from.

    python examples/plan_with_snapshots.py --seeds 5

Every few decisions the planner tries some plans in a twin of the environment and follows the best. A plan sends each
robot to one of its candidates and then goes on with the base policy (nearest frontier); one plan is the base policy
alone. The twin earns true rewards and meets the very noise that will come: this is what an oracle could reach by
choosing goals, a bound for learned policies and no policy for robots.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import typer

from agents import make_policy
from vslam_env import ExplorationEnv, vslam_v0

Plan = dict[str, int]  # the candidate's slot that each robot heads for first; 0: as the base policy says


class Base:
    """The nearest-frontier policy for all robots."""

    def __init__(self, env: ExplorationEnv) -> None:
        self.policies = {agent: make_policy("frontier", "goal") for agent in env.possible_agents}

    def act(self, env: ExplorationEnv, plan: Plan) -> dict[str, Any]:
        """Return an action for each robot: the planned one while its slot is filled, else that of the policy."""
        actions = {}
        for agent in env.agents:
            belief, slot = env.belief(agent), plan.get(agent, 0)
            if slot and belief.candidates.valid[slot - 1]:
                actions[agent] = slot
            else:
                # Nearest frontier draws nothing; a policy that does would get a generator of its own here.
                actions[agent] = self.policies[agent].act(None, belief, np.random.default_rng(0))
        return actions


def draw_plan(env: ExplorationEnv, rng: np.random.Generator) -> Plan:
    """Send each robot to a candidate drawn at random, or leave it to the base policy."""
    plan = {}
    for agent in env.agents:
        filled = 1 + np.flatnonzero(env.belief(agent).candidates.valid)
        plan[agent] = int(rng.choice([0, *filled]))
    return plan


def earned(rewards: Mapping[str, float]) -> float:
    """Return what a step paid, averaged over the robots."""
    return float(np.mean(list(rewards.values())))


def follow(env: ExplorationEnv, plan: Plan, decisions: int) -> float:
    """Carry out a plan for some decisions; return what it earned."""
    base, total = Base(env), 0.0
    for _ in range(decisions):
        if env.agents:
            total += earned(env.step(base.act(env, plan))[1])
    return total


def best_plan(env: ExplorationEnv, twin: ExplorationEnv, rollouts: int, horizon: int, rng: np.random.Generator) -> Plan:
    """Try plans in the twin, from where the environment stands, and return the one that earned most."""
    state = env.get_state()
    plans: list[Plan] = [{}] + [draw_plan(env, rng) for _ in range(rollouts)]
    gains = []
    for plan in plans:
        twin.set_state(state)
        gains.append(follow(twin, plan, horizon))
    return plans[int(np.argmax(gains))]


def play(seed: int, decisions: int, rollouts: int, horizon: int) -> float:
    """Play an episode, planning anew every `horizon` decisions; without rollouts it is the base policy's."""
    env = vslam_v0.parallel_env(action_type="goal", num_robots=2, max_cycles=decisions)
    env.reset(seed=seed)
    twin, rng, total = env.clone(), np.random.default_rng(seed), 0.0
    while env.agents:
        plan = best_plan(env, twin, rollouts, horizon, rng) if rollouts else {}
        total += follow(env, plan, horizon)
    return total


def main(
    seeds: Annotated[int, typer.Option(help="Episodes.")] = 5,
    first_seed: Annotated[int, typer.Option(help="Of the first.")] = 100,
    decisions: Annotated[int, typer.Option(help="Of each episode, a second each.")] = 40,
    rollouts: Annotated[int, typer.Option(help="Plans that are tried beside the base policy's.")] = 12,
    horizon: Annotated[int, typer.Option(help="Decisions that a plan looks ahead.")] = 5,
) -> None:
    """Compare the planner with its base policy."""
    gains = []
    for seed in range(first_seed, first_seed + seeds):
        alone, planned = play(seed, decisions, 0, horizon), play(seed, decisions, rollouts, horizon)
        gains.append((alone, planned))
        typer.echo(f"seed {seed}: nearest frontier {alone:.3f} m, with snapshots {planned:.3f} m of map error removed")
    alone, planned = np.mean(gains, axis=0)
    typer.echo(f"mean: nearest frontier {alone:.3f} m, with snapshots {planned:.3f} m")


if __name__ == "__main__":
    typer.run(main)
