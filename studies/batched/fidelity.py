"""Fidelity of simpler estimators: what an environment with one of them would get wrong, on the same worlds and actions.

Readings are those of the environment, but for `batched`, which draws its own in the same worlds.

python -m studies.batched.fidelity --worlds office,loops --seeds 4
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import FloatArray, argument_error
from slam_backend.geometry import between
from studies.bounds.episodes import RecordedEpisode, record_episode
from studies.bounds.gaussian_team import GaussianTeam, gaussian_team, simulated_team
from studies.filters import losses
from training.bench.exploration.players import parted
from training.commands.study import run_program
from training.episodes.guard import GuardedTeam
from training.experiments.config import option
from training.experiments.study import Column, ResultTable, Row, Study
from training.rl.config import require_extra
from vslam_env import vslam_v1
from vslam_env.belief.team_belief import Belief
from vslam_env.config import TICK, EnvConfig

Estimator = Literal[
    "no smoother", "no smoother, 400 particles", "30 keyframes", "60 keyframes", "60 keyframes, 3 iterations",
    "every 200 ticks", "10 particles", "1 particle", "one Gaussian", "batched",
]  # fmt: skip
FEW: dict[str, Any] = {"further_keys": 0, "steps_per_key": 10**6, "landmarks_per_key": 10**6, "closure_after": 0}
OPTIONS: Mapping[str, Mapping[str, Any]] = {  # of the filters; batched teams are none
    "no smoother": {"rejuvenate_every": None},
    "no smoother, 400 particles": {"rejuvenate_every": None, "num_particles": 400},
    "30 keyframes": {"smoothing": FEW | {"max_keys": 30, "recent_keys": 15}},
    "60 keyframes": {"smoothing": FEW | {"max_keys": 60, "recent_keys": 30}},
    "60 keyframes, 3 iterations": {"smoothing": FEW | {"max_keys": 60, "recent_keys": 30, "max_iterations": 3}},
    "every 200 ticks": {"rejuvenate_every": 200, "smoothing": {"closure_after": 0}},
    "10 particles": {"num_particles": 10},
    "1 particle": {"num_particles": 1},
}
# Limits within which an estimator stands for the environment's own
RATIO, RECALL, MAP_ERROR_M, CORRELATION, DELAY_S = 2.0, 0.04, 0.03, 0.9, 10.0

# ---------------------------------------------------------------------- trials


class Config(losses.TeamConfig):
    """Episodes with each estimator."""

    seeds: int = option(2, "Number of seeds.", ge=1, hint="Use at least one seed.")
    estimators: tuple[Estimator, ...] = option(get_args(Estimator), "Estimators to compare.", shown="all")

    def check(self) -> None:
        """Refuse what the episodes refuse, and a missing package."""
        if not set(self.estimators) <= OPTIONS.keys():
            require_extra("jax")
        goals = [policy for policy in self.policies if parted(policy).action_type == "goal"]
        if "batched" in self.estimators and goals:
            raise argument_error("policy", "policies with @continuous or @discrete", goals[0], "Or omit batched.")
        super().check()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(losses.Trial):
    """One episode with one estimator."""

    estimator: Estimator


def trials(config: Config) -> list[Trial]:
    """Return all trials, with those of the same episode in succession."""
    return [
        Trial(**asdict(episode), estimator=estimator)
        for episode in losses.trials(config)
        for estimator in config.estimators
    ]


class _Tape:
    """Team policy that plays actions."""

    def __init__(self, actions: Sequence[Mapping[str, Any]]) -> None:
        self._actions = actions
        self.reset()

    def reset(self) -> None:
        self._tick = 0

    def act(
        self, observations: Mapping[str, Any], beliefs: Mapping[str, Belief], rng: np.random.Generator
    ) -> dict[str, Any]:
        self._tick += 1
        return dict(self._actions[self._tick - 1])


def run_again(
    environment: EnvConfig, seed: int, policy: str, actions: Sequence[Mapping[str, Any]]
) -> RecordedEpisode:  # fmt: skip
    """Run an episode with given actions, those of a policy."""
    with closing(vslam_v1.parallel_env(config=environment)) as env:
        return record_episode(env, GuardedTeam(_Tape(actions), policy, environment.action_type), seed)


@lru_cache(maxsize=1)
def exact(config: Config, episode: losses.Trial) -> RecordedEpisode:
    """Return an episode of the environment as it is."""
    return losses.recorded(config, episode)


@single_threaded_blas
def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode with the environment's estimator, and its actions again with another one.

    Returns:
        `position_ratio`, `map_ratio`: position RMS of the poses and RMS error of the landmarks, over those of the
        environment's estimator; `recall_change` and `map_error_change` [m] of the means over robots at the end; returns
        (K,) `own_returns` and `exact_returns`; `delays` [s]: later than in the environment, of each merge by order, the
        end of the episode where there is none; `false_merges`, and `exact_false_merges`.

    Raises:
        PolicyError: If the policy fails.
    """
    shared = {name: value for name, value in asdict(trial).items() if name != "estimator"}
    whole = exact(config, losses.Trial(**shared))
    a = _outcome(whole)
    if trial.estimator == "one Gaussian":
        b = _gaussian_outcome(gaussian_team(whole), whole)
    elif trial.estimator == "batched":
        b = _gaussian_outcome(simulated_team(whole, trial.seed, whole.actions), whole)
    else:
        changed = losses.environment(config, trial).replace(belief={"filter": dict(OPTIONS[trial.estimator])})
        b = _outcome(run_again(changed, trial.seed, trial.policy, whole.actions))
    return {
        "position_ratio": losses.ratio(b.position, a.position), "map_ratio": losses.ratio(b.landmarks, a.landmarks),
        "recall_change": b.recall - a.recall, "map_error_change": float(np.mean(b.last_errors - a.last_errors)),
        "own_returns": b.first_errors - b.last_errors, "exact_returns": a.first_errors - a.last_errors,
        "delays": b.merge_times - a.merge_times, "false_merges": b.false_merges, "exact_false_merges": a.false_merges,
    }  # fmt: skip


class _Outcome(NamedTuple):
    """Errors of a team's poses and maps: RMS of positions [m], of landmarks [m], E (K,) [m], and K - 1 merges [s]."""

    position: float
    landmarks: float
    recall: float
    first_errors: FloatArray
    last_errors: FloatArray
    merge_times: FloatArray
    false_merges: int


def _outcome(episode: RecordedEpisode) -> _Outcome:
    """Return the errors of the environment's estimator."""
    record = episode.record
    kept = [merge for merge in record.merges if merge.undone is None]
    landmarks, recall = (float(np.mean([float(i[key]) for i in record.infos])) for key in ("map_rmse", "map_recall"))
    return _Outcome(
        _position(record.estimated, record.true_poses), landmarks, recall,
        record.map_errors[:, 0], record.map_errors[:, -1],
        _padded([merge.time for merge in kept], episode), sum(merge.is_false for merge in kept),
    )  # fmt: skip


def _gaussian_outcome(team: GaussianTeam, episode: RecordedEpisode) -> _Outcome:
    """Return the errors of a batched team."""
    first, last = team.map_errors.T
    return _Outcome(
        _position(team.paths, team.true_paths), float(team.map_rmses.mean()), float(team.map_recalls.mean()),
        first, last, _padded([TICK * tick for tick in team.merges], episode), team.false_merges,
    )  # fmt: skip


def _position(paths: FloatArray, truth: FloatArray) -> float:
    """Return the RMS position error [m] of paths (K, T, 3) in start frames, given the true ones in the world frame."""
    errors = paths - between(truth[:, :1], truth)
    return float(np.sqrt((errors[..., :2] ** 2).sum(axis=-1).mean()))


def _padded(times: Sequence[float], episode: RecordedEpisode) -> FloatArray:
    """Return the times of K - 1 merges, the end of the episode for those that are missing."""
    result = np.full(len(episode.true_paths) - 1, episode.record.times[-1])
    result[: len(times)] = sorted(times)[: len(result)]
    return result


# ---------------------------------------------------------------------- results


def correlation(rows: Sequence[Row]) -> float | None:
    """Return the correlation of the robots' returns with both estimators."""
    own, exact = (np.concatenate([row[name] for row in rows]) for name in ("own_returns", "exact_returns"))
    return float(np.corrcoef(own, exact)[0, 1]) if min(np.ptp(own), np.ptp(exact)) > 0.0 else None


def median_delay(rows: Sequence[Row]) -> float | None:
    """Return the median delay of merges [s]; None without any."""
    delays = np.concatenate([row["delays"] for row in rows])
    return float(np.median(delays)) if len(delays) else None


COLUMNS = (
    Column("position_ratio", "position", "geometric mean", digits=2, interval=True),
    Column("map_ratio", "landmarks", "geometric mean", digits=2, interval=True),
    Column("recall_change", "recall [points]", digits=1, factor=100.0),
    Column("map_error_change", "E [cm]", digits=1, factor=100.0, interval=True),
    Column("correlation", "correlation", correlation, digits=2),
    Column("delay", "merges later [s]", median_delay, digits=1),
    Column("false_merges", "false", "sum", digits=0),
)


def shortfalls(rows: Sequence[Row]) -> str:
    """Return the headings of the columns that exceed their limits."""
    position, landmarks, recall, error, returns, delay, false = (column.estimate(rows).value for column in COLUMNS)
    exceeded = (
        position is None or position > RATIO, landmarks is None or landmarks > RATIO, abs(recall) > 100.0 * RECALL,
        abs(error) > 100.0 * MAP_ERROR_M, returns is None or returns < CORRELATION,
        delay is not None and delay > DELAY_S, false > sum(row["exact_false_merges"] for row in rows),
    )  # fmt: skip
    return ", ".join(column.title for column, is_beyond in zip(COLUMNS, exceeded, strict=True) if is_beyond) or "none"


STUDY = Study(
    name="fidelity",
    about="""Play the actions of episodes again with simpler estimators, and compare what the environment tells.

    Readings are the same, but for `batched`, which simulates its own. An estimator stands for the environment's own if
    its position and landmark errors are at most twice as large, recall differs by at most four points and E by 3 cm in
    the mean, returns of robots correlate by 0.9, merges come at most 10 s later in the median, and false ones are not
    more frequent.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=losses.checks,
    quick={"worlds": ("office",), "seeds": 1, "duration": 20.0, "particles": (20,), "presets": ("standard",)},
    tables=(
        ResultTable(
            name="fidelity", title="Simpler estimators beside the environment's own", by=("preset", "estimator"),
            columns=(*COLUMNS, Column("beyond", "beyond limits", shortfalls)),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
