"""`TrainingCallback`: training callback for episode statistics, checkpoints, progress and stopping."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from training.vec_env import ExplorationVecEnv

LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions")  # final values of an episode

Row = dict[str, float]


class TrainingCallback(BaseCallback):  # type: ignore[misc]   # its types are not checked
    """Callback that summarises the episodes of each rollout, and saves and stops between rollouts only.

    Attributes:
        rows: One row per rollout: `steps`, and means over its finished episodes of `return`, the final values `LAST`,
            `invalid_actions` and the sum of each reward term.
        stopped: Whether the training was stopped early.
    """

    def __init__(self, env: ExplorationVecEnv, save: Callable[[], None], every: int) -> None:
        super().__init__()
        self._save, self._every = save, every
        self._tell: Callable[[Row], None] = lambda row: None
        self._should_stop: Callable[[], bool] = lambda: False
        self._count: Callable[[int], None] = lambda decisions: None
        self.rows: list[Row] = []
        self._sums: list[dict[str, float]] = [{} for _ in range(env.num_envs)]
        self._ended: list[Row] = []
        self._begun = 0
        self.stopped = False

    def listen(
        self,
        on_update: Callable[[Row], None],
        should_stop: Callable[[], bool],
        on_step: Callable[[int], None] = lambda decisions: None,
    ) -> None:
        """Set the functions called between rollouts: to report a rollout, and to ask whether to stop.

        Args:
            should_stop: Function called between two rollouts; if it returns true, a checkpoint is saved and the
                training ends.
        """
        self._tell, self._should_stop, self._count = on_update, should_stop, on_step

    def get_state(self) -> dict[str, Any]:
        """Return the state of the callback."""
        return {"rows": [dict(row) for row in self.rows], "sums": [dict(sums) for sums in self._sums]}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`."""
        self.rows, self._sums = [dict(row) for row in state["rows"]], [dict(sums) for sums in state["sums"]]
        self._begun = len(self.rows)

    def _on_rollout_start(self) -> None:
        self._ended = []
        done = len(self.rows)
        if done > self._begun:
            self.stopped = self._should_stop()
            if self.stopped or done % self._every == 0:
                self._save()

    def _on_step(self) -> bool:
        if self.stopped:
            return False  # this step is discarded: the checkpoint was saved before it
        for slot, (info, done) in enumerate(zip(self.locals["infos"], self.locals["dones"], strict=True)):
            sums = self._sums[slot]
            for name, value in info.items():
                if name.startswith("reward/") or name == "invalid_action":
                    sums[name] = sums.get(name, 0.0) + value
            if done:
                self._ended.append(_finished(sums, info))
                self._sums[slot] = {}
        self._count(self.model.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        row: Row = {"steps": float(self.model.num_timesteps)}
        for name in self._ended[0] if self._ended else ():
            row[name] = float(np.mean([episode[name] for episode in self._ended]))
            self.logger.record(f"episode/{name}", row[name])
        self.rows.append(row)
        self._tell(row)


def _finished(sums: Mapping[str, float], info: Mapping[str, Any]) -> Row:
    """Return the metrics of a finished episode: return, final values, and the sum of each reward term."""
    terms = {name: value for name, value in sums.items() if name.startswith("reward/")}
    last = {name: float(info[name]) for name in LAST}
    return {"return": sum(terms.values()), **last, "invalid_actions": sums["invalid_action"], **terms}
