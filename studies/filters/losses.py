"""Losses between the information in a robot's readings and the error of its filter, in episodes of explored worlds.

python -m studies.filters.losses --worlds loops --seeds 4
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error
from slam_backend.geometry import inverse, transform_points, wrap_angle
from slam_backend.metrics import map_rmse, nees
from studies.bounds.episodes import NONE, FilterTrack, RecordedEpisode, record_episode, replay
from studies.bounds.ladder import LADDER, estimates, with_all_keyframes
from training.bench.exploration.config import with_absolute_paths
from training.bench.exploration.players import BOUND, parted, world_split
from training.bench.exploration.trials import first_steps
from training.commands.study import run_program
from training.episodes.config import RunConfig
from training.experiments.config import (
    ONE_PARTICLE,
    ExperimentConfig,
    NoisePreset,
    Positive,
    RobotCount,
    first_seed,
    option,
)
from training.experiments.policy_names import check_labels
from training.experiments.study import Column, Curves, ResultTable, Study
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.world.registry import check_source

ESTIMATES = ("odometry", "ideal_online", *(name for name, _ in LADDER))
LOSSES = tuple(loss for _, loss in LADDER[1:])
CURVE_POINTS = 25
LONG_UNSEEN = 100  # ticks without a measurement after which a landmark is seen again
LONGEST_DECISION = 600.0  # [s]
LEAST_SIGMA = 1e-4  # [m, rad]; lower limit of claimed standard deviations: robots at their start know their pose
Metres = Annotated[float, Field(gt=0.0)]

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """All combinations of the lists, for each seed."""

    seeds: int = option(16, "Number of seeds.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    worlds: tuple[str, ...] = option(("office", "maze", "loops", "hall"), "World families or paths to explore.")
    presets: tuple[NoisePreset, ...] = option(("standard",), "Noise presets: easy, standard, hard.")
    robots: tuple[RobotCount, ...] = option((1,), "Numbers of robots.", hint="Use 1 to 8 robots.")
    particles: tuple[Positive, ...] = option((100,), "Numbers of particles per filter.", hint=ONE_PARTICLE)
    split: Literal["train", "validation", "test", "any"] = option(
        "validation", "Split of the worlds: train, validation, test, or any.", name="world_split"
    )
    policies: tuple[str, ...] = option(
        ("frontier",), "Policies of the robots: name, path of a model, MODULE:NAME, or LABEL= and one of these; "
        "@discrete selects the action type.",
    )  # fmt: skip
    duration: float = option(
        120.0, "Simulated time of an episode [s].", name="max_seconds", also="--duration", ge=1.0, hint="Give seconds."
    )
    rejuvenate_every: int | None = option(
        None, "Ticks between rejuvenations of the particles; 0: never.", shown="50", ge=0
    )
    max_ranges: tuple[Metres, ...] | None = option(None, "Ranges of the camera [m].", shown="8", hint="Give metres.")
    baselines: tuple[Metres, ...] | None = option(
        None, "Baselines of the camera [m].", shown="0.12", hint="Give metres."
    )
    measurements: tuple[Positive, ...] | None = option(None, "Largest numbers of measurements of a frame.", shown="5")

    def check(self) -> None:
        """Refuse policies and worlds that do not exist, and bounds, which know the truth that readings do not tell."""
        check_labels(self.policies)
        for policy in self.policies:
            if parted(policy).role == BOUND:
                hint = "Bounds know the truth, which readings alone do not tell."
                raise argument_error("policy", "a policy of robots or of the team", policy, hint)
        for world in self.worlds:
            check_source(world)
        for trial in trials(self.model_copy(update={"seeds": 1})):
            environment(self, trial)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials can be repeated from any folder."""
        return with_absolute_paths(values)


class TeamConfig(Config):
    """Combinations for teams."""

    presets: tuple[NoisePreset, ...] = option(("standard", "hard"), "Noise presets: easy, standard, hard.")
    robots: tuple[RobotCount, ...] = option((3,), "Numbers of robots.", hint="Use 1 to 8 robots.")
    policies: tuple[str, ...] = option(
        ("next_best_view@continuous",), "Policies of the robots: name, path of a model, MODULE:NAME, or LABEL= and one "
        "of these; @discrete selects the action type.",
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One episode."""

    world: str  # Family or path
    robots: int  # K
    policy: str  # Name, path or `module:name`, optionally with `@` and the action type
    preset: NoisePreset  # Noise preset of the environment
    max_range: float | None  # Range of the camera [m]; None: that of the preset
    baseline: float | None  # Baseline of the camera [m]; None: that of the preset
    measurements: int | None  # Largest number of measurements of a frame; None: that of the preset
    particles: int  # M
    seed: int  # Seed of the episode

    @property
    def condition(self) -> str:
        """Short name of all but the seed: what differs from the default is named."""
        name = Path(self.world).stem if Path(self.world).suffix else self.world
        parts = [f"{name}, K = {self.robots}"]
        parts += [self.policy] if self.policy != "frontier" else []
        parts += [self.preset] if self.preset != "standard" else []
        parts += [f"range {self.max_range:g} m"] if self.max_range is not None else []
        parts += [f"baseline {self.baseline:g} m"] if self.baseline is not None else []
        parts += [f"B = {self.measurements}"] if self.measurements is not None else []
        return ", ".join(parts + ([f"M = {self.particles}"] if self.particles != 100 else []))


def trials(config: Config) -> list[Trial]:
    """Return all episodes, ordered by seed, then by combination."""
    combined = product(
        range(config.seed, config.seed + config.seeds), config.worlds, config.robots, config.policies, config.presets,
        config.max_ranges or (None,), config.baselines or (None,), config.measurements or (None,), config.particles,
    )  # fmt: skip
    return [
        Trial(
            world=world, robots=robots, policy=policy, preset=preset, max_range=max_range, baseline=baseline,
            measurements=measurements, particles=particles, seed=seed,
        )
        for seed, world, robots, policy, preset, max_range, baseline, measurements, particles in combined
    ]  # fmt: skip


def environment(config: Config, trial: Trial) -> EnvConfig:
    """Return the environment of an episode; true and assumed camera have the same geometry."""
    player = parted(trial.policy)
    shared: dict[str, Any] = {
        "world": trial.world, "robots": trial.robots, "policy": player.policy, "action_type": player.action_type,
        "particles": trial.particles, "rejuvenate_every": config.rejuvenate_every, "preset": trial.preset,
        "seed": trial.seed,
    }  # fmt: skip
    given = {"max_range": trial.max_range, "baseline": trial.baseline}
    camera = {name: value for name, value in given.items() if value is not None}
    sensor: dict[str, Any] = {"camera": camera}
    if trial.measurements is not None:
        sensor["max_measurements"] = trial.measurements
    return RunConfig(**shared, max_seconds=config.duration).environment().replace(
        world_split=world_split(config.split, trial.world), landmark_sensor=sensor,
        belief={"filter": {"camera": camera}},
    )  # fmt: skip


def checks(config: Config) -> Iterator[Callable[[], None]]:
    """Yield the first steps in each world, with each policy and number of robots."""
    for trial in {(t.policy, t.world, t.robots): t for t in reversed(trials(config))}.values():
        yield partial(first_steps, environment(config, trial), parted(trial.policy), trial.seed, LONGEST_DECISION)


def recorded(config: Config, trial: Trial) -> RecordedEpisode:
    """Run the episode of a trial and record it."""
    with closing(vslam_v1.parallel_env(config=environment(config, trial))) as env:
        return record_episode(env, parted(trial.policy).make(env, LONGEST_DECISION), trial.seed)


@single_threaded_blas
def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode and return the errors of all estimates from its readings.

    - `condition`: name of all but the seed.
    - For each of `ESTIMATES` the RMS position error [m] over robots and ticks, in start frames and without a fit;
      `curves`: `time_s`, and the RMS over the robots at these times. `loss of ...`: the factors between them.
    - `heading_rms_deg`, `end_error_m` (mean over robots): of each estimate, by name.
    - `nees` (3-D, median, ideal 2.4) of the poses by the filter, `ideal_nees` of those by the ideal online estimate.
    - `map_rms_m`: RMS error of the filter's landmarks at the end, `batch_map_rms_m`: of the same landmarks in the batch
      estimate, both in start frames, means over robots; `map_recall`, `map_precision`.
    - `wrong_match_share`: of the filter's matches, those with another true landmark than the landmark's first
      measurement; `unused_share`: of the measurements of true landmarks, those without a landmark;
      `copies_per_landmark`: landmarks of the filter for each true one.
    - `revisits`: number of times that a robot sees a landmark again which it did not see for `LONG_UNSEEN` ticks, and
      `missed_revisits`: those in which none of its measurements is associated with what it was before.
    - `merges`: merges that were not undone; `groups`: groups at the end; `path_m`, `duration_s`, `landmarks`,
      `num_measurements`, `seconds`.

    Raises:
        PolicyError: If the policy fails.
    """
    begin = time.perf_counter()
    episode = recorded(config, trial)
    options = episode.config.belief.filter
    track = replay(episode, options)
    found = estimates(episode, track)
    found["all_keyframes"] = replay(episode, with_all_keyframes(options)).paths
    record = episode.record
    return {
        "condition": trial.condition, **score_paths(episode, found), **maps(episode, found), **matches(episode, track),
        "nees": median_nees(episode, track.paths, track.covariances),
        "ideal_nees": median_nees(episode, found["ideal_online"], found["ideal_covariances"]),
        **count_revisits(episode.true_ids, track.labels),
        "merges": len(track.merges), "groups": len(record.groups),
        "path_m": float(np.mean([float(info["distance"]) for info in record.infos])),
        "duration_s": float(record.times[-1]),
        "num_measurements": sum(len(ids) for tick in episode.true_ids for ids in tick),
        "seconds": time.perf_counter() - begin,
    }  # fmt: skip


def score_paths(episode: RecordedEpisode, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the errors of the paths of all estimates, their ratios and their curves; see `play`."""
    errors = {name: errors_of(found[name], episode) for name in ESTIMATES}
    squares = {name: (away[..., :2] ** 2).sum(axis=-1) for name, away in errors.items()}
    rms = {name: float(np.sqrt(square.mean())) for name, square in squares.items()}
    times = np.linspace(0.0, episode.record.times[-1], CURVE_POINTS)
    ticks = np.linspace(0, episode.true_paths.shape[1] - 1, CURVE_POINTS).round().astype(int)
    return {
        **rms, **{
            f"loss of {loss}": ratio(rms[b], rms[a])
            for loss, (a, b) in zip(LOSSES, pairwise(dict(LADDER)), strict=True)
        },
        "over_batch": ratio(rms["filter"], rms["batch"]),
        "over_ideal_online": ratio(rms["filter"], rms["ideal_online"]),
        "heading_rms_deg": {
            name: float(np.degrees(np.sqrt((away[..., 2] ** 2).mean()))) for name, away in errors.items()
        },
        "end_error_m": {name: float(np.hypot(away[:, -1, 0], away[:, -1, 1]).mean()) for name, away in errors.items()},
        "curves": {"time_s": times}
        | {name: np.sqrt(square.mean(axis=0))[ticks] for name, square in squares.items()},
    }  # fmt: skip


def errors_of(paths: FloatArray, episode: RecordedEpisode) -> FloatArray:
    """Return estimate minus truth (K, T, 3) of paths in start frames."""
    errors = paths - episode.own_true_paths
    errors[..., 2] = wrap_angle(errors[..., 2])
    return np.asarray(errors)


def ratio(above: float, below: float) -> float | None:
    """Return the ratio of two errors; None if one is unknown or zero."""
    return above / below if above > 0.0 and below > 0.0 else None


def median_nees(episode: RecordedEpisode, paths: FloatArray, covariances: FloatArray) -> float:
    """Return the median NEES of the poses after the first tick."""
    errors = errors_of(paths, episode)[:, 1:].reshape(-1, 3)
    return float(np.median(nees(errors, covariances[:, 1:].reshape(-1, 3, 3) + LEAST_SIGMA**2 * np.eye(3))))


def maps(episode: RecordedEpisode, found: dict[str, Any]) -> dict[str, Any]:
    """Return errors of the maps at the end, of the filter and of the batch estimate on the same landmarks."""
    record, batch = episode.record, found["batch_estimate"]
    row_of = {int(name): row for row, name in enumerate(found["batch_names"])}
    own, peer = [], []
    for robot, (held, claims) in enumerate(zip(record.maps, record.map_claims, strict=True)):
        start = episode.true_paths[robot, 0]
        truths = transform_points(inverse(start), episode.landmarks)
        matched = map_rmse(held.means, truths[episode.observable], claims=claims).matched
        pairs = [(i, int(episode.observable[j])) for i, j in matched.tolist()]
        both = [(i, name) for i, name in pairs if name in row_of]
        if not both:
            continue
        estimates, names = np.array(both).T
        rows = [row_of[name] for name in names.tolist()]
        in_batch = transform_points(inverse(batch.bases[robot]), batch.landmarks[rows])
        own.append(np.sqrt(((held.means[estimates] - truths[names]) ** 2).sum(axis=1).mean()))
        peer.append(np.sqrt(((in_batch - truths[names]) ** 2).sum(axis=1).mean()))
    infos = record.infos
    errors = (float(np.mean(own)), float(np.mean(peer))) if own else (float("nan"), float("nan"))
    return {
        "map_rms_m": errors[0], "batch_map_rms_m": errors[1], "map_over_batch": ratio(*errors),
        "map_recall": float(np.mean([float(info["map_recall"]) for info in infos])),
        "map_precision": float(np.mean([float(info["map_precision"]) for info in infos])),
        "landmarks": float(np.mean([len(held.means) for held in record.maps])),
    }  # fmt: skip


def matches(episode: RecordedEpisode, track: FilterTrack) -> dict[str, float]:
    """Return how often the filter's associations are wrong, missing, or with a copy of a landmark."""
    labels = np.concatenate([own for tick in track.labels for own in tick])
    truths = np.concatenate([own for tick in episode.true_ids for own in tick])
    used, real = labels != NONE, truths != NONE
    _, firsts, rows = np.unique(labels[used], return_index=True, return_inverse=True)
    claims = truths[used][firsts]
    wrong: BoolArray = claims[rows] != truths[used]
    true_claims = claims[claims != NONE]
    return {
        "wrong_match_share": float(wrong.mean()) if len(wrong) else 0.0,
        "unused_share": float((real & ~used).sum() / max(real.sum(), 1)),
        "copies_per_landmark": len(true_claims) / max(len(np.unique(true_claims)), 1),
    }  # fmt: skip


def count_revisits(
    true_ids: Sequence[Sequence[IntArray]], labels: Sequence[Sequence[IntArray]]
) -> dict[str, int]:  # fmt: skip
    """Return the number of revisits of landmarks, and of those that the filter missed; see `play`.

    Args:
        true_ids: True landmarks (n,) of the measurements, by tick and robot; `NONE`: of no landmark.
        labels: Labels (n,) of the filter's landmarks; `NONE`: rejected.
    """
    visits: dict[tuple[int, int], list[tuple[int, set[int]]]] = {}  # last tick and labels of each visit
    for tick, (named, labelled) in enumerate(zip(true_ids, labels, strict=True)):
        for robot, (truths, own) in enumerate(zip(named, labelled, strict=True)):
            for truth, label in zip(truths.tolist(), own.tolist(), strict=True):
                if truth == NONE:
                    continue
                of_landmark = visits.setdefault((robot, truth), [])
                if not of_landmark or tick - of_landmark[-1][0] > LONG_UNSEEN:
                    of_landmark.append((tick, set()))
                of_landmark[-1] = (tick, of_landmark[-1][1] | ({label} - {NONE}))
    count = missed = 0
    for of_landmark in visits.values():
        known: set[int] = set()
        for _, seen in of_landmark:
            count += bool(known)
            missed += bool(known) and not known & seen
            known |= seen
    return {"revisits": count, "missed_revisits": missed}


# ---------------------------------------------------------------------- results


def factor(name: str, heading: str = "", digits: int = 2) -> Column:
    """Return the column of a geometric mean with its interval."""
    return Column(name, heading, "geometric mean", digits=digits, interval=True)


def table(name: str, title: str, *columns: Column) -> ResultTable:
    """Return a table with a line for each condition."""
    return ResultTable(name=name, title=title, by=("condition",), columns=columns)


STUDY = Study(
    name="losses",
    about="""Split the error of filters in explored worlds into losses, from batch maximum likelihood to the filter.

    Robots explore worlds; estimates from their readings differ in one thing each: assumed noise, associations, online
    or all readings at once, particles, keyframes. The factor between the errors of two of them is a loss. Options that
    accept several values take them comma-separated; all combinations are run. Episodes of a policy that fails are left
    out, with status 2 at the end. Ctrl-C finishes the current episode and summarises the finished ones; the same
    command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    quick={"worlds": ("office",), "seeds": 2, "duration": 30.0, "particles": (30,)},
    tables=(
        table(
            "positions", "Position RMS [m] of each estimate: geometric means over the seeds",
            *(factor(name, digits=3) for name in ESTIMATES),
        ),
        table(
            "losses", "Losses: factors between the estimates, geometric means",
            *(factor(f"loss of {loss}", loss) for loss in LOSSES),
        ),
        table(
            "filter", "Filter over ideal online estimate; map over batch ML; median NEES (ideal 2.4)",
            factor("over_ideal_online", "over ideal"), Column("over_ideal_online", "worst", "worst", digits=2),
            factor("map_over_batch"), Column("nees", digits=1), Column("ideal_nees", "of ideal", digits=1),
        ),
        table(
            "associations", "Associations, map, and path",
            Column("wrong_match_share", "wrong [%]", digits=2, factor=100.0),
            Column("unused_share", "unused [%]", digits=1, factor=100.0),
            Column("copies_per_landmark", "copies", digits=2), Column("revisits", digits=1),
            Column("missed_revisits", "missed", digits=2), Column("map_rms_m"),
            Column("map_rms_m", "worst map [m]", "worst"), Column("merges", digits=1), Column("groups", digits=1),
            Column("path_m", "path [m]", digits=0),
        ),
    ),
    curves=Curves(
        by=("condition",), label="position RMS over robots [m]",
        columns=(
            Column("odometry", "odometry"), Column("filter", "filter"), Column("ideal_online", "ideal online"),
            Column("batch", "batch ML"),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
