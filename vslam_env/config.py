"""Configuration of an environment: frozen, validated, readable from and writable to TOML."""

import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np
import tomli_w

from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import parse_toml, read_toml
from slam_backend.core.validation import argument_error, check_choice, check_float, check_int, check_kind, did_you_mean
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.options import MergeOptions
from vslam_env.belief.belief import BeliefConfig
from vslam_env.belief.observation_keys import checked_keys
from vslam_env.sensors import LandmarkSensorConfig, ScanConfig, StereoSensorConfig
from vslam_env.simulation.communication import outage_rates
from vslam_env.world import SPLITS, LandmarkConfig, OdometryNoise
from vslam_env.world.spec import LARGEST_EXTENT

T = TypeVar("T")

NONE = "none"  # stands for None in TOML


def validate(cls: type[T], values: Mapping[str, Any]) -> T:
    """Build `cls` from nested dicts, or raise an argument error for the first invalid value."""
    try:
        text = json.dumps(to_plain(values), default=str)
    except (ValueError, RecursionError) as error:  # e.g. an int of 5000 digits, or a cycle
        hint = f"The encoder says: {error}."
        raise argument_error("config", "values that JSON can represent", "no such values", hint) from error
    from pydantic import TypeAdapter, ValidationError  # slow to import, and not always needed

    try:
        # Strict JSON mode rejects 2.0, "2" and True as ints, but accepts a dict for a dataclass, a list for a tuple.
        return TypeAdapter(cls).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        cause = first.get("ctx", {}).get("error")
        if isinstance(cause, ValueError):  # raised by __post_init__ with a complete message
            raise cause from None
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "unexpected_keyword_argument":
            *outer, wrong = first["loc"]
            known = _fields_beside(values, outer, wrong)
            advice = GONE.get(str(wrong), did_you_mean(wrong, known).rstrip())
            hint = f"{advice} The fields are {', '.join(known)}.".lstrip()
            raise argument_error(name, "a known field", first["input"], hint) from None
        expected = first["msg"].removeprefix("Input should be ")
        hint = did_you_mean(first["input"], re.findall(r"'(\w+)'", expected)) + "Correct this value."
        raise argument_error(name, expected, first["input"], hint) from None


def _fields_beside(values: Mapping[str, Any], outer: Sequence[int | str], wrong: int | str) -> list[str]:
    """Return the names beside a wrong one in nested dicts that contain all defaults."""
    for key in outer:
        values = values[key]  # type: ignore[index]   # as pydantic has named it
    return [name for name in values if name != wrong]


def to_plain(value: Any) -> Any:
    """Turn nested configurations into dicts, lists and numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, Set)):
        return [to_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def merge(values: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts with some entries changed; the reward weights are replaced as a whole."""
    result = dict(values)
    for key, change in changes.items():
        change = to_plain(change)
        nested = isinstance(change, dict) and isinstance(result.get(key), dict) and key != "reward"
        result[key] = merge(result[key], change) if nested else change
    return result


def without_none(values: Mapping[str, Any], defaults: Any) -> dict[str, Any]:
    """Return nested dicts without None: omitted where the default is None or lacks the entry, else `NONE`."""
    known = defaults if isinstance(defaults, Mapping) else {}
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result[key] = without_none(value, known.get(key))
        elif value is not None:
            result[key] = value
        elif known.get(key) is not None:
            result[key] = NONE
    return result


def with_none(values: Any) -> Any:
    """Turn the text `NONE` into None in nested dicts."""
    if isinstance(values, Mapping):
        return {key: with_none(value) for key, value in values.items()}
    return None if values == NONE else values


def num_cycles(max_seconds: float, step_s: float) -> int:
    """Return how many steps of `step_s` [s] take `max_seconds` [s], rounded up, at least one.

    >>> num_cycles(100.0, 0.1), num_cycles(100.0, 1.0), num_cycles(1.1, 0.1), num_cycles(100.0, 0.3)
    (1000, 100, 11, 334)
    """
    return max(1, math.ceil(round(max_seconds / step_s, 6)))  # 1.1 / 0.1 is slightly more than 11


FORMAT = 2  # version of TOML files; raised when the meaning of a field changes
GONE = SmoothingOptions.GONE | MergeOptions.GONE  # advice by the names of fields of earlier versions
ACTION_TYPES = ("continuous", "discrete", "goal")
OBSERVATION_TYPES = ("dict", "flat")
SENSORS = ("landmark", "stereo")
MAX_ROBOTS = 8
TICK = 0.1  # [s]
TICKS_PER_SECOND = 10
GOAL_DECISION_TICKS = 10
MAX_TICKS = 10**9  # per step; three years of simulated time
MAX_SECONDS = 100.0  # [s] default length of an episode
NESTED_CONFIGS = {
    "landmarks": LandmarkConfig,
    "odometry": OdometryNoise,
    "landmark_sensor": LandmarkSensorConfig,
    "stereo": StereoSensorConfig,
    "scan": ScanConfig,
    "belief": BeliefConfig,
}


LIMITS = ("max_cycles", "max_seconds")


def check_one_limit(max_cycles: Any, max_seconds: Any) -> None:
    """Raise if both limits of an episode are given."""
    if max_cycles is not None and max_seconds is not None:
        hint = "Give one of the two, steps or seconds."
        raise argument_error("max_seconds", "None together with max_cycles", max_seconds, hint)


def replace_limit(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changes of a configuration in which a given limit of an episode removes the other one."""
    given = [name for name in LIMITS if changes.get(name) is not None]
    return (dict.fromkeys(LIMITS) if len(given) == 1 else {}) | dict(changes)


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """Configuration of an environment, with separate true and assumed noise.

    Attributes:
        world: Family name, or path of a floor plan, of a JSON file of walls or of a folder of these; the name of the
            world if the environment was made with a `World` or a function.
        world_split: `"train"`, `"validation"` or `"test"`: worlds of that split only; None: any.
        num_robots: Number of robots K, at most 8.
        sensor: `"landmark"`: simulated measurements. `"stereo"`: rendered stereo images.
        action_type: `"continuous"`: (speed, turn) in [-1, 1]. `"discrete"`: stay, ahead, left, right. `"goal"`: one of
            the candidates of the last observation.
        decision_ticks: Ticks of 0.1 s per `env.step`; None: 1, or 10 with `goal` actions.
        max_cycles: Number of calls of `env.step` after which the episode is truncated; None: as many as `max_seconds`
            takes.
        max_seconds: Simulated time after which the episode is truncated [s], rounded up to whole steps; None: 100 s,
            unless `max_cycles` is given. At most one of the two can be given.
        stop_at_recall: Map recall of all robots at which the episode terminates; None: never.
        observation_type: `"dict"`: named arrays. `"flat"`: one float32 vector.
        observation_keys: `"driver"`, `"goal"` or `"all"`, sets of keys, or keys in any order; see
            `vslam_env.belief.observation_keys.SETS`. Beliefs hold all that is left out.
        observe_images: Whether a robot observes its left image, `"image"` (H, W, 1) uint8; with `sensor="stereo"` only.
        reward: Weights of the named reward terms. Learners discount by at least 0.999 per tick: see `vslam_env.reward`.
        shared_reward: Whether each robot gets the mean of all robots' rewards, term by term.
        oracle_pose: Whether each filter receives the true pose in the robot's start frame.
        oracle_association: Whether data association is replaced by the truth.
        oracle_merge: Whether groups in contact that share three true landmarks merge with the true transform, and only
            these.
        oracle_floor: Whether the occupancy grid of each robot begins with the true floor plan.
        comm_range: Largest distance of two robots in contact [m]; None: unlimited.
        comm_line_of_sight: Whether walls block contacts.
        comm_loss: Share of the time in which a contact fails, for each pair of robots.
        comm_outage_seconds: Mean duration for which a contact fails [s], from an exponential distribution in whole
            ticks; 0: drawn in each tick by itself.
        robot_radius: Radius of the robots [m].
        min_start_distance: Least distance between any two start positions [m].
        shared_start_view: Whether two robots may see a common landmark at their starts.
        map_error_cutoff: Cutoff c of the map error [m].
        landmarks: Density and appearance of landmarks, for worlds without landmarks of their own.
        odometry: True noise of the odometry.
        landmark_sensor: True noise of the landmark sensor.
        stereo: Textures, rendering and front end; with `sensor="stereo"`.
        scan: Range finder and its true noise.
        belief: Assumed noise, filters, map alignment and merging.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    world: str = "office"
    world_split: Literal["train", "validation", "test"] | None = None
    num_robots: int = 3
    sensor: Literal["landmark", "stereo"] = "landmark"
    action_type: Literal["continuous", "discrete", "goal"] = "continuous"
    decision_ticks: int | None = None
    max_cycles: int | None = None
    max_seconds: float | None = None
    stop_at_recall: float | None = None
    observation_type: Literal["dict", "flat"] = "dict"
    observation_keys: Any = "all"  # a name or a tuple; errors of `checked_keys` are clearer than those of pydantic
    observe_images: bool = False
    reward: Mapping[str, float] = field(default_factory=lambda: {"map_error": 1.0})
    shared_reward: bool = False
    oracle_pose: bool = False
    oracle_association: bool = False
    oracle_merge: bool = False
    oracle_floor: bool = False
    comm_range: float | None = None
    comm_line_of_sight: bool = False
    comm_loss: float = 0.0
    comm_outage_seconds: float = 0.0
    robot_radius: float = 0.2
    min_start_distance: float = 5.0
    shared_start_view: bool = False
    map_error_cutoff: float = 1.0
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    landmark_sensor: LandmarkSensorConfig = field(default_factory=LandmarkSensorConfig)
    stereo: StereoSensorConfig = field(default_factory=StereoSensorConfig)
    scan: ScanConfig = field(default_factory=ScanConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)

    def __post_init__(self) -> None:
        robots = check_int("num_robots", self.num_robots, 1, "Use 1 to 8 robots.")
        if robots > MAX_ROBOTS:
            raise argument_error("num_robots", f"an int from 1 to {MAX_ROBOTS}", robots, "Use 1 to 8 robots.")
        if not isinstance(self.world, str):
            raise argument_error("world", "a name or a path, as a string", self.world, "Pass a World to parallel_env.")
        if self.world_split is not None:
            check_choice("world_split", self.world_split, tuple(SPLITS))
        check_choice("sensor", self.sensor, SENSORS)
        check_choice("action_type", self.action_type, ACTION_TYPES)
        check_choice("observation_type", self.observation_type, OBSERVATION_TYPES)
        keys = self.observed
        if not isinstance(self.observation_keys, str):
            object.__setattr__(self, "observation_keys", keys)
        if self.decision_ticks is not None:
            check_int("decision_ticks", self.decision_ticks, 1, "Give a number of ticks of 0.1 s.", MAX_TICKS)
        if self.max_cycles is not None:
            check_int("max_cycles", self.max_cycles, 1, "Give a number of steps.")
        if self.max_seconds is not None:
            check_float("max_seconds", self.max_seconds, "Give seconds.", above=0.0, at_most=MAX_TICKS * TICK)
        check_one_limit(self.max_cycles, self.max_seconds)
        if self.stop_at_recall is not None:
            check_float("stop_at_recall", self.stop_at_recall, "Give a share or None.", above=0.0, at_most=1.0)
        switches = (
            "oracle_pose",
            "oracle_association",
            "oracle_merge",
            "oracle_floor",
            "shared_start_view",
            "shared_reward",
        )
        for name in (*switches, "comm_line_of_sight", "observe_images"):
            if not isinstance(getattr(self, name), bool):
                raise argument_error(name, "True or False", getattr(self, name), "Give a bool.")
        if not isinstance(self.reward, Mapping):
            raise argument_error("reward", "weights by name", self.reward, "For example {'map_error': 1.0}.")
        for name, weight in self.reward.items():
            check_float(f"reward[{name!r}]", weight, "Give the weight of the term.")
        if self.comm_range is not None:
            check_float("comm_range", self.comm_range, "Give metres, or None for any distance.", at_least=0.0)
        check_float("comm_loss", self.comm_loss, "Give a probability.", at_least=0.0, at_most=1.0)
        self._check_outages()
        check_float("robot_radius", self.robot_radius, "Give metres.", above=0.0, at_most=LARGEST_EXTENT)
        check_float("min_start_distance", self.min_start_distance, "Give metres.", at_least=0.0)
        check_float("map_error_cutoff", self.map_error_cutoff, "Give metres.", at_least=1e-6, at_most=1e6)
        for name, kind in NESTED_CONFIGS.items():
            check_kind(name, getattr(self, name), kind)
        if self.observe_images and (self.sensor, self.observation_type) != ("stereo", "dict"):
            hint = 'Use sensor="stereo" and observation_type="dict".'
            raise argument_error("observe_images", "False unless images are rendered and named", True, hint)
        check_float("scan.half_fov", self.scan.half_fov, "A scan spans less than a half circle.", at_most=1.57)
        sensor = self.stereo if self.sensor == "stereo" else self.landmark_sensor
        usable = self.belief.filter.camera.farthest_usable
        if sensor.farthest > usable:
            expected = f"noise that allows the use of points {sensor.farthest:g} m away"
            hint = "Raise sigma_px or baseline, lower sigma_disparity_px, or the max_range of the true camera."
            raise argument_error("belief.filter.camera", expected, f"a limit of {usable:g} m", hint)

    def _check_outages(self) -> None:
        """Raise unless outages can last as long as said and make up the share of the time that is said."""
        name, loss, outage = "comm_outage_seconds", self.comm_loss, self.comm_outage_seconds
        check_float(name, outage, "Give seconds, or 0.", at_least=0.0, at_most=MAX_TICKS * TICK)
        if outage > 0.0 and not 0.0 < loss < 1.0:
            hint = "Give the share of the time in which contacts fail, above 0 and below 1."
            raise argument_error(name, f"0 with a comm_loss of {loss:g}", outage, hint)
        if outage > 0.0 and outage_rates(loss, outage / TICK)[0] > 1.0:
            hint = f"Outages that make up {loss:g} of the time last longer in the mean; give more seconds, or 0."
            raise argument_error(name, f"more seconds with a comm_loss of {loss:g}", outage, hint)

    @property
    def observed(self) -> tuple[str, ...]:
        """Keys of observations, in their order, without images."""
        return checked_keys(self.observation_keys, self.action_type)

    @property
    def always_in_contact(self) -> bool:
        """Whether all robots are always in contact."""
        return self.comm_range is None and not self.comm_line_of_sight and self.comm_loss == 0.0

    @property
    def ticks_per_step(self) -> int:
        """Number of ticks per `env.step`."""
        if self.decision_ticks is not None:
            return self.decision_ticks
        return GOAL_DECISION_TICKS if self.action_type == "goal" else 1

    @property
    def num_cycles(self) -> int:
        """Number of calls of `env.step` after which the episode is truncated."""
        if self.max_cycles is not None:
            return self.max_cycles
        seconds = MAX_SECONDS if self.max_seconds is None else self.max_seconds
        return num_cycles(seconds, self.ticks_per_step * TICK)

    @property
    def agents(self) -> list[str]:
        """Names of the agents: `robot_0`, `robot_1`, ..."""
        return [f"robot_{robot}" for robot in range(self.num_robots)]

    def replace(self, **changes: Any) -> Self:
        """Return a validated copy with some fields changed.

        Args:
            **changes: New values of fields. A nested configuration can be an object, or a dict of the nested fields to
                change. `max_cycles` replaces `max_seconds`, and the reverse.

        Raises:
            ValueError: If a field is unknown or a value is invalid; the message names it.
        """
        return validate(type(self), merge(to_plain(self), replace_limit(changes)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from nested dicts; omitted fields have the value of the `standard` preset."""
        return validate(cls, merge(to_plain(cls()), values))

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a configuration from a TOML file, as written by `to_toml`.

        Omitted fields, also in nested tables, have the value of the `standard` preset; a missing `format` means the
        current one.
        """
        return cls._of_file(read_toml(path, "config"))

    @classmethod
    def from_toml_text(cls, text: str) -> Self:
        """Build a configuration from a text of `to_toml`."""
        if not isinstance(text, str):
            raise argument_error("config", "TOML as text", text, "Pass what to_toml returned, or use from_toml.")
        return cls._of_file(parse_toml(text, "config", "the text"))

    @classmethod
    def _of_file(cls, values: dict[str, Any]) -> Self:
        """Build a configuration from the content of a TOML file, or raise if its format differs."""
        number = values.pop("format", FORMAT)
        if type(number) is not int or number != FORMAT:
            hint = "Use the release that wrote it, or set the values again."
            raise argument_error("config", f"one of format {FORMAT}", f"a configuration of format {number!r}", hint)
        return cls.from_dict(with_none(values))

    def to_toml(self) -> str:
        """Return the configuration as TOML, with its format number.

        None is omitted where it is the default, else written as the text "none".
        """
        values = without_none(to_plain(self), to_plain(type(self)()))
        return tomli_w.dumps({"format": FORMAT} | values)
