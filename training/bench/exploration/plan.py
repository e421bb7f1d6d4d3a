"""Plans of the exploration benchmark: which episodes every policy plays, track by track.

A plan is a TOML file, frozen by its hash. It fixes the task: worlds, starts, readings, time, and how maps are scored.
The estimator is not part of it: rows name the version that played them.
"""

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from slam_backend.core.files import missing_error
from slam_backend.core.text_files import read_toml
from slam_backend.core.validation import argument_error, check_choice, choice_error
from training.bench.exploration.players import environment_of
from training.experiments.config import Checked, NoisePreset, NonNegative, Positive, RobotCount

if TYPE_CHECKING:
    from vslam_env.config import EnvConfig

PLANS = Path(__file__).parent / "plans"
PLAN_COPY = "plan.toml"  # in run folders of plans that are not shipped
FLOOR_PLANS = "floor plans"
NO_RELAXATION = "none"
QUICK_SEEDS = 2
ALL, BASE, QUICK = "all", "base", "quick"  # how much of a plan is played


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanTrial:
    """One episode of one policy."""

    track: str  # Track of the plan
    policy: str  # Label, see `parted`
    family: str  # World as the track names it
    world: str  # Family, or file name of a floor plan
    robots: int  # K
    relaxation: str  # Limit that is relaxed
    seed: int  # Seed of the episode


class Track(Checked):
    """Track of a plan: all combinations of its lists, with every policy."""

    title: str
    worlds: tuple[str, ...] = ("office", "maze", "loops", "hall")
    seeds: Positive  # Episodes in each world
    base: NonNegative = 0  # First of these, which a row of the leaderboard needs; floor plans are not among them
    relaxed: NonNegative = 0  # First of these, which are also played with each limit relaxed
    robots: tuple[RobotCount, ...] = (3,)
    preset: NoisePreset = "standard"
    options: Mapping[str, Any] = {}  # Further options of the environment
    duration: float | None = None  # Simulated time of an episode [s]; None: that of the plan

    def check(self) -> None:
        """Refuse parts that are longer than the track."""
        for name in ("base", "relaxed"):
            if getattr(self, name) > self.seeds:
                raise argument_error(name, f"at most {self.seeds} seeds", getattr(self, name), "Correct the track.")


class Relaxation(Checked):
    """What an episode is without one of its limits."""

    title: str
    oracle: Literal["none", "pose", "association", "merge", "all"] = "none"  # Ground truth given to the robots
    times: float = 1.0  # Factor of the simulated time
    options: Mapping[str, Any] = {}  # Further options of the environment


class Plan(Checked):
    """Plan of a benchmark."""

    name: str
    split: Literal["train", "validation", "test"]
    first_seed: NonNegative = 0
    duration: float  # Simulated time of an episode [s]
    policies: tuple[str, ...]  # Policies of a run that names none; the others are compared with the first
    relaxed_policy: str | None = None  # Policy that plays with limits relaxed
    tracks: Mapping[str, Any]
    relaxations: Mapping[str, Any] = {}
    floor_plans: Mapping[str, str] = {}  # SHA-256 of each floor plan, by file name
    tasks: Mapping[str, str] = {}  # Digests of the tasks of the episodes of a track, world and team, in order of seeds

    def check(self) -> None:
        """Refuse tracks that are incomplete or name unknown worlds, and options that no environment has."""
        from vslam_env.world.registry import check_source

        for name, track in self.all_tracks.items():
            for world in track.worlds:
                if world != FLOOR_PLANS:
                    check_source(world)
                elif not self.floor_plans:
                    raise argument_error("floor_plans", "names and digests", "none", f"The track {name!r} needs them.")
        for trial in self._first_trials():
            self.environment(trial)

    @classmethod
    def load(cls, source: str) -> Self:
        """Read a plan by its name, or from a TOML file.

        Raises:
            ValueError: If there is no such plan, or a field is missing, unknown or out of range.
        """
        file = PLANS / f"{source}.toml"
        if not file.is_file():
            file = Path(source)
        if not file.is_file():
            if file.suffix == ".toml" or len(file.parts) > 1:
                raise missing_error("plan", "the path of a TOML file", file)
            known = [path.stem for path in sorted(PLANS.glob("*.toml"))]
            raise choice_error("plan", source, known, "Check the spelling.", ", or the path of a TOML file")
        values = read_toml(file, "plan")
        shipped = PLANS / f"{values.get('name')}.toml"
        if shipped.is_file() and {**values, "policies": None} != {**read_toml(shipped, "plan"), "policies": None}:
            hint = f"Change the field name of {str(file)!r}."
            raise argument_error("plan", "another name for a changed plan", shipped.stem, hint)
        try:
            return cls(**values)
        except ValueError as error:
            raise ValueError(f"plan {str(file)!r}: {error}") from error

    @classmethod
    def of_run(cls, folder: Path, values: Mapping[str, Any], argument: str) -> Self:
        """Read the plan of a run folder: the copy in it, or else the plan of the name in its configuration `values`.

        Raises:
            ValueError: As in `load`; also if the plan has another hash than in the run. The message names `argument`.
        """
        copy = folder / PLAN_COPY
        plan = cls.load(str(copy) if copy.is_file() else str(values["plan"]))
        if plan.digest != values.get("plan_hash"):
            hint = "Use the release that wrote it."
            raise argument_error(argument, f"results of plan {plan.digest}", values.get("plan_hash"), hint)
        return plan

    @cached_property
    def all_tracks(self) -> dict[str, Track]:
        """The tracks by name."""
        return {name: Track(**values) for name, values in self.tracks.items()}

    @cached_property
    def all_relaxations(self) -> dict[str, Relaxation]:
        """The relaxations by name, the first one that of no limit."""
        none = Relaxation(title="no limit relaxed")
        return {NO_RELAXATION: none} | {name: Relaxation(**values) for name, values in self.relaxations.items()}

    @cached_property
    def digest(self) -> str:
        """First 16 hexadecimal digits of SHA-256 over what is played.

        Comments, the order of names, and the policies of a run that names none do not count.
        """
        return hashlib.sha256(repr(_sorted(self.model_dump(exclude={"policies"}))).encode()).hexdigest()[:16]

    def trials(
        self, policies: Sequence[str] | None = None, tracks: Sequence[str] | None = None, extent: str = ALL,
        with_missing: bool = False,
    ) -> list[PlanTrial]:  # fmt: skip
        """Return all episodes: base parts of the tracks, then for each track those with limits relaxed, and the rest.

        Args:
            policies: Labels of the policies; None: those of the plan.
            tracks: Names of the tracks; None: all.
            extent: `ALL`, `BASE` for the base parts alone, or `QUICK` for the first seeds without floor plans.
            with_missing: Whether episodes on floor plans that are missing here are among them.

        Raises:
            ValueError: If there is no such track.
        """
        hint = "Correct the name."
        names = [check_choice("tracks", name, tuple(self.all_tracks), hint) for name in tracks or self.all_tracks]
        players = self.policies if policies is None else policies
        if extent == QUICK:
            few = {name: range(min(QUICK_SEEDS, self.all_tracks[name].seeds)) for name in names}
            return [trial for name in names for trial in self._of_track(name, players, few[name])]
        found = [trial for name in names for trial in self._of_track(name, players, range(self.all_tracks[name].base))]
        if extent == BASE:
            return found
        plans = range(len(self.floor_plans) if with_missing or not self.missing_floor_plans() else 0)
        relaxations = [*self.all_relaxations][1:] if self.relaxed_policy in players else []
        for name in names:
            track = self.all_tracks[name]
            compared = max(track.base, track.relaxed)
            found += self._of_track(name, players, range(track.base, compared))
            for relaxation in relaxations:
                found += self._of_track(name, [str(self.relaxed_policy)], range(track.relaxed), relaxation=relaxation)
            found += self._of_track(name, players, range(compared, track.seeds), plans)
        return found

    def _of_track(
        self, name: str, policies: Iterable[str], seeds: range, plans: range = range(0),
        relaxation: str = NO_RELAXATION,
    ) -> list[PlanTrial]:  # fmt: skip
        """Return episodes of a track, ordered by seed: some seeds of each world, and some floor plans if it has any."""
        track, files = self.all_tracks[name], list(self.floor_plans)
        places = [(k, world, world) for k, world in product(seeds, track.worlds) if world != FLOOR_PLANS]
        places += [(k, FLOOR_PLANS, files[k]) for k in plans if FLOOR_PLANS in track.worlds]
        return [
            PlanTrial(
                track=name, policy=policy, family=family, world=world, robots=robots, relaxation=relaxation,
                seed=self.first_seed + k,
            )
            for (k, family, world), robots, policy in product(places, track.robots, policies)
        ]  # fmt: skip

    def _first_trials(self) -> list[PlanTrial]:
        """Return an episode of each track and relaxation."""
        return [
            PlanTrial(
                track=name, policy="frontier", family=world, world=world, robots=track.robots[0], relaxation=relaxation,
                seed=self.first_seed,
            )
            for name, track in self.all_tracks.items()
            for world in [world for world in track.worlds if world != FLOOR_PLANS][:1]
            for relaxation in self.all_relaxations
        ]  # fmt: skip

    def missing_floor_plans(self) -> list[str]:
        """Return the names of floor plans that `VSLAM_DATA` does not contain."""
        return [name for name, digest in self.floor_plans.items() if _find_floor_plan(name, digest, _data()) is None]

    def task_of(self, trial: PlanTrial) -> str | None:
        """Return the digest that the task of an episode must have, None where the plan has none."""
        words = self.tasks.get(task_name(trial), "").split()
        k = trial.seed - self.first_seed
        return words[k] if trial.relaxation == NO_RELAXATION and k < len(words) else None

    def environment(self, trial: PlanTrial) -> "EnvConfig":
        """Return the environment of an episode; all policies of a seed have the same world."""
        track, relaxation = self.all_tracks[trial.track], self.all_relaxations[trial.relaxation]
        world = trial.world
        if trial.family == FLOOR_PLANS:
            found = _find_floor_plan(world, self.floor_plans[world], _data())
            if found is None:
                raise argument_error("VSLAM_DATA", f"a folder with {world!r}", _data(), "Set it to the data folder.")
            world = str(found)
        config = environment_of(
            trial.policy, relaxation.oracle, world, self.split, robots=trial.robots, preset=track.preset,
            max_seconds=relaxation.times * (track.duration or self.duration),
        )  # fmt: skip
        return config.replace(**track.options).replace(**relaxation.options)


@dataclass(frozen=True, slots=True)
class PlanBench:
    """What an episode of a plan needs, see `trials.Bench`."""

    plan: Plan
    decision_limit: float

    def environment(self, trial: PlanTrial) -> "EnvConfig":
        """Return the environment of an episode."""
        return self.plan.environment(trial)


def task_name(trial: PlanTrial) -> str:
    """Return the name under which a plan has the digests of a trial's track, world and number of robots."""
    return f"{trial.track}, {trial.family}, {trial.robots}"


def _sorted(value: Any) -> Any:
    """Return nested mappings as sorted pairs."""
    return sorted((name, _sorted(each)) for name, each in value.items()) if isinstance(value, Mapping) else value


def _data() -> str:
    """Return the folder of data sets, empty if it is not set."""
    return os.environ.get("VSLAM_DATA", "")


@lru_cache(maxsize=1024)
def _find_floor_plan(name: str, digest: str, data: str) -> Path | None:
    """Return the file of this name and SHA-256 below a folder, None if there is none."""
    found = sorted(Path(data).rglob(name)) if data and Path(data).is_dir() else []
    return next((file for file in found if hashlib.sha256(file.read_bytes()).hexdigest() == digest), None)
