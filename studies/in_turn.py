"""Time of `env.step` in several checkouts of this repository, measured in alternation.

    python -m studies.in_turn ../before . --config '{"num_robots": 6}'

Only public names are used, so that trees with different modules can be compared. Each checkout runs the same episode
with the same actions in its own process, and only one process runs at a time, in bursts of 20 steps. Variations of the
machine's speed therefore affect all checkouts equally. Two checkouts with the same arithmetic run the same episode;
otherwise rounding differences grow and the episodes diverge.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from slam_backend.core.validation import FloatArray, argument_error, check_int

BURST = 20  # steps per burst
WARM_UP = 60  # steps of each episode that are not counted
PLAYER = """
import json, os, sys, time
root, overrides, path, count = sys.argv[1], json.loads(sys.argv[2]), sys.argv[3], int(sys.argv[4])
sys.path.insert(0, root)
import numpy as np
import vslam_env
assert vslam_env.__file__.startswith(root), vslam_env.__file__
from agents import make_policy
from vslam_env import EnvConfig, vslam_v0
env = vslam_v0.parallel_env(config=EnvConfig().replace(**overrides))
env.max_cycles = count + 1
if not os.path.exists(path):  # the policy runs in the first tree, the others repeat its actions
    policies = {agent: make_policy("frontier", env.config.action_type) for agent in env.possible_agents}
    rng = np.random.default_rng(100)
    observations, actions = env.reset(seed=100)[0], []
    for _ in range(count):
        chosen = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        actions.append({agent: np.asarray(action).tolist() for agent, action in chosen.items()})
        observations = env.step(chosen)[0]
    with open(path, "w") as file:
        json.dump(actions, file)
with open(path) as file:
    actions = json.load(file)
as_action = (lambda x: np.array(x, np.float32)) if env.config.action_type == "continuous" else int
actions = [{agent: as_action(action) for agent, action in row.items()} for row in actions]
for line in sys.stdin:
    first, last = json.loads(line)
    if first == 0:
        env.reset(seed=100)
    micros = []
    for action in actions[first:last]:
        begin = time.process_time_ns()
        env.step(action)
        micros.append((time.process_time_ns() - begin) / 1e3)
    print(json.dumps(micros), flush=True)
"""


class Player:
    """Process that runs episodes of one checkout.

    Args:
        root: Folder of the checkout.
        overrides: JSON object of the changes to the configuration of the environment.
        actions: File of the actions; the first player records them.
        count: Number of actions.
    """

    def __init__(self, root: Path, overrides: str, actions: Path, count: int) -> None:
        command = [sys.executable, "-c", PLAYER, str(root), overrides, str(actions), str(count)]
        environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=root
        )

    def play(self, first: int, last: int) -> list[float]:
        """Run steps `first` to `last` - 1 of the episode, after a reset if `first` is 0; return their times [us]."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([first, last]) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{self._process.args!r} ended: see above.")
        micros: list[float] = json.loads(answer)
        return micros

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def times_in_turn(players: list[Player], steps: int, plays: int) -> FloatArray:
    """Return the times (players, plays, steps) [us] of all steps after the warm-up; the first play is discarded."""
    times: list[Any] = []
    for play in range(plays + 1):
        rows: list[list[float]] = [[] for _ in players]
        for burst, first in enumerate(range(0, WARM_UP + steps, BURST)):
            order = list(range(len(players)))[:: 1 if (burst + play) % 2 else -1]
            for player in order:
                rows[player] += players[player].play(first, min(first + BURST, WARM_UP + steps))
        times.append([row[WARM_UP:] for row in rows])
    return np.array(times[1:]).transpose(1, 0, 2)


def main(
    roots: Annotated[list[Path], typer.Argument(help="Checkouts; the first is the reference.")],
    config: Annotated[str, typer.Option(help="Changes of EnvConfig as JSON.")] = "{}",
    plays: Annotated[
        int, typer.Option(help="Number of repeats of the episode; the best time of each step counts.")
    ] = 4,
    steps: Annotated[int, typer.Option(help="Number of timed steps.")] = 600,
) -> None:
    """Print median, mean and 99 % quantile of each checkout, and their ratios to the first."""
    check_int("plays", plays, 1, "Use at least one repeat.")
    check_int("steps", steps, 1, "Use at least one step.")
    for root in roots:
        if not (root / "vslam_env").is_dir():
            raise argument_error("roots", "checkouts of this repository", str(root), "Name folders with vslam_env.")
    with tempfile.TemporaryDirectory() as folder:
        players = []
        try:
            for root in roots:
                players.append(Player(root.resolve(), config, Path(folder) / "actions", WARM_UP + steps))
                players[-1].play(0, 1)
            times = times_in_turn(players, steps, plays)
        finally:
            for player in players:
                player.close()
    best = times.min(axis=1)
    for root, own in zip(roots, best, strict=True):
        median, mean, high = np.median(own), own.mean(), np.quantile(own, 0.99)
        ratios = f"{median / np.median(best[0]):.2f}, {mean / best[0].mean():.2f} of the first"
        print(f"{root!s:20s} median {median:6.0f} us, mean {mean:6.0f} us, 99 % {high:6.0f} us: {ratios}")


if __name__ == "__main__":
    typer.run(main)
