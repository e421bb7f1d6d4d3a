"""Steps and snapshots of several worlds at given times of their episodes, measured in alternation.

    python -m studies.in_turn.worlds rooms:extent=120@900 rooms:extent=120@1600 office:extent=30@60 --seed 10002

Each world is played with `frontier` and `goal` actions up to its time; then all go on in turn, in bursts of ten steps,
with a snapshot after each fifth step that is kept until the next one, as a program does that saves its last state.
Variations of the machine's speed therefore affect all worlds equally. The last one is the reference of the ratios.
"""

import time
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import typer

from slam_backend.core.validation import argument_error, check_int
from studies.scale import DECISION_LIMIT
from training.bench.exploration.players import parted
from training.episodes.config import RunConfig
from vslam_env import warm_up
from vslam_env.config import TICK
from vslam_env.environment import ExplorationEnv

BURST, EVERY = 10, 5  # steps in a burst, and from one snapshot to the next


@dataclass
class Played:
    """World in play.

    Attributes:
        name: Family, options and time, as on the command line.
        steps, states: Processor times of steps and snapshots so far [ms].
    """

    name: str
    env: ExplorationEnv
    team: Any
    seed: int
    steps: list[float] = field(default_factory=list)
    states: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._observations = self.env.reset(seed=self.seed)[0]
        self.team.reset()
        self._rngs = {agent: np.random.default_rng(i) for i, agent in enumerate(self.env.possible_agents)}
        self._rng = np.random.default_rng(self.seed)
        self._last: Any = None

    def step(self) -> float:
        """Do a step and return its time [ms]."""
        beliefs = {agent: self.env.belief(agent) for agent in self.env.agents}
        actions = self.team.act_all(self._observations, beliefs, self._rngs, self._rng)
        begin = time.process_time()
        self._observations = self.env.step(actions)[0]
        return 1e3 * (time.process_time() - begin)

    def burst(self) -> None:
        """Time a burst of steps, and snapshots."""
        for step in range(1, BURST + 1):
            self.steps.append(self.step())
            if step % EVERY == 0:
                begin = time.process_time()
                state = self.env.get_state()
                self.states.append(1e3 * (time.process_time() - begin))
                self._last = state


def played(named: str, seed: int, robots: int, steps: int) -> Played:
    """Return a world, named WORLD@SECONDS, played up to its time, with room for so many steps more."""
    world, _, seconds = named.rpartition("@")
    if not world or not seconds.replace(".", "", 1).isdigit():
        raise argument_error("worlds", "WORLD@SECONDS", named, "Name one like office:extent=30@60.")
    player = parted("frontier")
    shared: dict[str, Any] = {"policy": player.policy, "action_type": player.action_type}
    config = RunConfig(world=world, robots=robots, seed=seed, **shared)
    env = ExplorationEnv(config.environment())
    before = round(float(seconds) / (env.config.ticks_per_step * TICK))
    env.max_cycles = before + steps + 1
    result = Played(named, env, player.make(env, DECISION_LIMIT), seed)
    for _ in range(before):
        result.step()
    return result


def main(
    worlds: Annotated[list[str], typer.Argument(help="WORLD@SECONDS, the last one is the reference.")],
    seed: Annotated[int, typer.Option(help="Seed of all episodes.")] = 10002,
    robots: Annotated[int, typer.Option(help="Robots of each world.")] = 3,
    steps: Annotated[int, typer.Option(help="Timed steps of each world, in whole bursts.")] = 120,
) -> None:
    """Print quantiles of the times of steps and snapshots, and ratios of medians to those of the last world."""
    bursts = -(-check_int("steps", steps, 1, "Use at least one step.") // BURST)
    warm_up(workers=1)
    all_played = [played(named, seed, robots, BURST * bursts) for named in worlds]
    for _ in range(bursts):
        for one in all_played:
            one.burst()
    reference = all_played[-1]
    for one in all_played:
        for name in ("steps", "states"):
            own, others = getattr(one, name), getattr(reference, name)
            quantiles = ", ".join(f"{value:.1f}" for value in np.quantile(own, (0.5, 0.9, 0.99, 1.0)))
            ratio = np.median(own) / np.median(others)
            print(f"{one.name}: {name} {quantiles} ms at 50, 90, 99, 100 %; {ratio:.2f} of the last world's median")


if __name__ == "__main__":
    typer.run(main)
