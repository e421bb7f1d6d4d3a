"""Plans of the exploration benchmark: which episodes every policy plays. A plan is a TOML file, frozen by its hash."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from slam_backend.core.text_files import read_toml
from slam_backend.core.validation import argument_error, choice_error
from training.bench.exploration.players import environment_of
from training.experiments.config import Checked, NoisePreset, Positive, RobotCount

if TYPE_CHECKING:
    from vslam_env.config import EnvConfig

PLANS = Path(__file__).parent / "plans"
PLAN_COPY = "plan.toml"  # in run folders of plans that are not shipped
BASE_PART, FLOOR_PLANS = "base", "floor plans"
QUICK_SEEDS = 2
Oracle = Literal["none", "pose", "association", "merge", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanTrial:
    """One episode of one policy."""

    part: str  # Part of the plan
    policy: str  # Label, see `parted`
    family: str  # World as the part names it
    world: str  # Family, or file name of a floor plan
    robots: int  # K
    particles: int  # M
    oracle: str  # Ground truth given to the robots
    preset: str  # Noise preset
    comm_loss: float | None  # Probability that a contact fails; None: that of the preset
    duration: float  # Simulated time [s]
    seed: int  # Seed of the episode


class PlanPart(Checked):
    """Part of a plan: all combinations of its lists, with every policy."""

    title: str
    worlds: tuple[str, ...] = ("office", "maze", "loops", "hall")
    seeds: Positive
    robots: tuple[RobotCount, ...] = (3,)
    particles: tuple[Positive, ...] = (100,)
    oracles: tuple[Oracle, ...] = ("none",)
    preset: NoisePreset = "standard"
    comm_loss: float | None = None
    duration: float | None = None  # Simulated time of an episode [s]; None: that of the plan
    policies: tuple[str, ...] | None = None  # None: those of the run


class Plan(Checked):
    """Plan of a benchmark."""

    name: str
    split: Literal["train", "validation", "test"]
    duration: float  # Simulated time of an episode [s]
    policies: tuple[str, ...]  # Policies of a run that names none; the others are compared with the first
    parts: Mapping[str, Any]
    floor_plans: Mapping[str, str] = {}  # SHA-256 of each floor plan, by file name

    def check(self) -> None:
        """Refuse parts that are incomplete or name unknown worlds."""
        from vslam_env.world.registry import check_source

        for part in self.all_parts().values():
            for world in part.worlds:
                if world != FLOOR_PLANS:
                    check_source(world)
                elif part.seeds > len(self.floor_plans):
                    hint = "Name as many floor plans as the part has seeds."
                    raise argument_error("floor_plans", f"at least {part.seeds}", len(self.floor_plans), hint)

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
            known = [path.stem for path in sorted(PLANS.glob("*.toml"))]
            raise choice_error("plan", source, known, "Check the spelling.", ", or the path of a TOML file")
        values = read_toml(file, "plan")
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
        plan = cls.load(str(copy) if copy.is_file() else values["plan"])
        if plan.digest != values["plan_hash"]:
            hint = "Use the release that wrote it."
            raise argument_error(argument, f"results of plan {plan.digest}", values["plan_hash"], hint)
        return plan

    def all_parts(self) -> dict[str, PlanPart]:
        """Return the parts by name."""
        return {name: PlanPart(**values) for name, values in self.parts.items()}

    @property
    def digest(self) -> str:
        """First 16 hexadecimal digits of SHA-256 over what is played.

        Comments, the order of names, and the policies of a run that names none do not count.
        """
        return hashlib.sha256(repr(_sorted(self.model_dump(exclude={"policies"}))).encode()).hexdigest()[:16]

    def trials(self, policies: tuple[str, ...] | None = None, quick: bool = False) -> list[PlanTrial]:
        """Return all episodes, part by part, ordered by seed; those on floor plans that are missing are left out.

        Args:
            policies: Labels of the policies; None: those of the plan. Parts with policies of their own are played by
                those of these that are chosen.
            quick: Whether only the first seeds of the base part are played, without floor plans.
        """
        parts = self.all_parts()
        if quick:
            base, worlds = parts[BASE_PART], PlanPart.model_fields["worlds"].default
            parts = {BASE_PART: base.replace(seeds=min(QUICK_SEEDS, base.seeds), worlds=worlds)}
        return [
            PlanTrial(
                part=name, policy=policy, family=family, robots=robots, particles=particles, oracle=oracle, seed=seed,
                world=list(self.floor_plans)[seed] if family == FLOOR_PLANS else family, preset=part.preset,
                comm_loss=part.comm_loss, duration=part.duration or self.duration,
            )
            for name, part in parts.items()
            for seed, family, robots, particles, oracle, policy in product(
                range(part.seeds), part.worlds, part.robots, part.particles, part.oracles, self._players(part, policies)
            )
            if family != FLOOR_PLANS or not self.missing_floor_plans()
        ]  # fmt: skip

    def _players(self, part: PlanPart, chosen: tuple[str, ...] | None) -> tuple[str, ...]:
        """Return the policies that play a part."""
        if part.policies is None or chosen is None:
            return part.policies or chosen or self.policies
        return tuple(policy for policy in chosen if policy in part.policies)

    def missing_floor_plans(self) -> list[str]:
        """Return the names of floor plans that `VSLAM_DATA` does not contain."""
        return [name for name, digest in self.floor_plans.items() if _find_floor_plan(name, digest, _data()) is None]

    def environment(self, trial: PlanTrial) -> "EnvConfig":
        """Return the environment of an episode; all policies of a seed have the same world."""
        world = trial.world
        if trial.family == FLOOR_PLANS:
            found = _find_floor_plan(world, self.floor_plans[world], _data())
            if found is None:
                raise argument_error("VSLAM_DATA", f"a folder with {world!r}", _data(), "Set it to the data folder.")
            world = str(found)
        config = environment_of(
            trial, world, self.split, trial.duration, particles=trial.particles, preset=trial.preset
        )
        return config if trial.comm_loss is None else config.replace(comm_loss=trial.comm_loss)


@dataclass(frozen=True, slots=True)
class PlanBench:
    """What an episode of a plan needs, see `trials.Bench`."""

    plan: Plan
    decision_limit: float

    def environment(self, trial: PlanTrial) -> "EnvConfig":
        """Return the environment of an episode."""
        return self.plan.environment(trial)


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
