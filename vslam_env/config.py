"""`EnvConfig`: everything that defines an environment, frozen and validated, with a TOML form."""

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np
import tomli_w

from slam_backend.core.validation import argument_error, check_choice, check_float, check_int
from vslam_env.belief.belief import BeliefConfig
from vslam_env.sensors import LandmarkSensorConfig, ScanConfig, StereoSensorConfig
from vslam_env.world import SPLITS, LandmarkConfig, OdometryNoise
from vslam_env.world.spec import LARGEST_EXTENT

T = TypeVar("T")

NONE = "none"  # what TOML, which has no word for it, says for None


def validate(cls: type[T], values: Mapping[str, Any]) -> T:
    """Build `cls` from nested dicts, or raise the project's one error for the first thing that is wrong."""
    try:
        text = json.dumps(to_plain(values), default=str)
    except (ValueError, RecursionError) as error:  # an int of 5000 digits, or a part that holds itself
        raise argument_error("config", "values that JSON can hold", "no such values", f"It says: {error}.") from error
    from pydantic import TypeAdapter, ValidationError  # slow to import, and not always needed

    try:
        # Strict on JSON refuses 2.0, "2" and True as ints, but takes dicts for parts, lists for tuples, int for float.
        return TypeAdapter(cls).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        own = first.get("ctx", {}).get("error")
        if isinstance(own, ValueError):  # raised by a check of ours, which explains itself
            raise own from None
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "unexpected_keyword_argument":
            raise argument_error(name, "a known field", first["input"], "Check the spelling.") from None
        expected = first["msg"].removeprefix("Input should be ")
        raise argument_error(name, expected, first["input"], "Correct this value.") from None


def to_plain(value: Any) -> Any:
    """Turn nested configurations into dicts, lists and numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [to_plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def merge(values: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts with some entries changed; weights of rewards are replaced as a whole."""
    result = dict(values)
    for key, change in changes.items():
        change = to_plain(change)
        nested = isinstance(change, dict) and isinstance(result.get(key), dict) and key != "reward"
        result[key] = merge(result[key], change) if nested else change
    return result


def without_none(values: Mapping[str, Any], standard: Any) -> dict[str, Any]:
    """Return nested dicts without None: left out where the standard is None or knows no such entry, else `NONE`."""
    usual = standard if isinstance(standard, Mapping) else {}
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result[key] = without_none(value, usual.get(key))
        elif value is not None:
            result[key] = value
        elif usual.get(key) is not None:
            result[key] = NONE
    return result


def with_none(values: Any) -> Any:
    """Turn the text `NONE` into None in nested dicts."""
    if isinstance(values, Mapping):
        return {key: with_none(value) for key, value in values.items()}
    return None if values == NONE else values


FORMAT = 1  # of TOML files; raised when what a field means changes
ACTION_TYPES = ("continuous", "discrete", "goal")
OBSERVATION_TYPES = ("dict", "flat")
SENSORS = ("landmark", "stereo")
MAX_ROBOTS = 8
TICK = 0.1  # [s]
GOAL_DECISION_TICKS = 10
MAX_TICKS = 10**9  # in a step; they would last three years
NESTED_CONFIGS = {
    "landmarks": LandmarkConfig,
    "odometry": OdometryNoise,
    "landmark_sensor": LandmarkSensorConfig,
    "stereo": StereoSensorConfig,
    "scan": ScanConfig,
    "belief": BeliefConfig,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """An environment. The true noise of the simulator and the noise that the filters assume are set separately.

    Attributes:
        world: A family name, or the path of a floor plan, of a JSON file of walls or of a folder of these. Of an
            environment made with a `World` or a function: its name.
        world_split: Layouts and textures of the seeds of `"train"`, `"validation"` or `"test"` only; None: any.
        num_robots: K, at most 8.
        sensor: What measures landmarks.
        action_type: `"continuous"`: (speed, turn) in [-1, 1]. `"discrete"`: stay, ahead, left, right. `"goal"`: one of
            the candidates of the last observation.
        decision_ticks: Ticks of 0.1 s in an `env.step`; None: 1, or 10 with `goal` actions.
        max_cycles: After so many calls of `env.step` the episode is truncated.
        stop_at_recall: The episode terminates when every robot's map holds this share of the landmarks; None: never.
        observation_type: `"dict"`: named arrays. `"flat"`: one float32 vector.
        observe_images: Whether a robot observes its left image, as `"image"` (H, W, 1) uint8; with rendered eyes only.
        reward: Weights of the named reward terms. Learners discount by at least 0.999 per tick: see `vslam_env.reward`.
        shared_reward: Each robot gets the mean of all robots' rewards, term by term.
        oracle_pose: The robots know their poses, each in its own start frame.
        oracle_association: The robots know which landmark is which.
        oracle_merge: Groups in contact that share three true landmarks merge with the true transform; none tries by
            itself.
        comm_range: Robots hear each other no farther than this [m]; None: at any distance.
        comm_line_of_sight: Whether walls keep robots from hearing each other.
        comm_loss: Probability that two robots that could hear each other do not, in each tick.
        robot_radius: [m].
        min_start_distance: Between any two robots [m].
        shared_start_view: Whether two robots may see a common landmark at their starts.
        map_error_cutoff: c of the map error [m].
        landmarks: Where the landmarks of worlds without their own are, and how alike they look.
        odometry: True noise of the odometry.
        landmark_sensor: True noise of the landmark sensor.
        stereo: Rendered eyes: what walls look like, how images are taken and measured; with `sensor="stereo"`.
        scan: The range finder and its true noise.
        belief: What the robots assume, and how they align their maps.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    world: str = "office"
    world_split: Literal["train", "validation", "test"] | None = None
    num_robots: int = 3
    sensor: Literal["landmark", "stereo"] = "landmark"
    action_type: Literal["continuous", "discrete", "goal"] = "continuous"
    decision_ticks: int | None = None
    max_cycles: int = 1000
    stop_at_recall: float | None = None
    observation_type: Literal["dict", "flat"] = "dict"
    observe_images: bool = False
    reward: Mapping[str, float] = field(default_factory=lambda: {"map_error": 1.0})
    shared_reward: bool = False
    oracle_pose: bool = False
    oracle_association: bool = False
    oracle_merge: bool = False
    comm_range: float | None = None
    comm_line_of_sight: bool = False
    comm_loss: float = 0.0
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
        if self.decision_ticks is not None:
            check_int("decision_ticks", self.decision_ticks, 1, "Give a number of ticks of 0.1 s.", MAX_TICKS)
        check_int("max_cycles", self.max_cycles, 1, "Give a number of steps.")
        if self.stop_at_recall is not None:
            check_float("stop_at_recall", self.stop_at_recall, "Give a share or None.", above=0.0, at_most=1.0)
        switches = ("oracle_pose", "oracle_association", "oracle_merge", "shared_start_view", "shared_reward")
        for name in (*switches, "comm_line_of_sight", "observe_images"):
            if not isinstance(getattr(self, name), bool):
                raise argument_error(name, "True or False", getattr(self, name), "Give a bool.")
        if not isinstance(self.reward, Mapping):
            raise argument_error("reward", "weights by name", self.reward, "E.g. {'map_error': 1.0}.")
        for name, weight in self.reward.items():
            check_float(f"reward[{name!r}]", weight, "Give the weight of the term.")
        if self.comm_range is not None:
            check_float("comm_range", self.comm_range, "Give metres, or None for any distance.", at_least=0.0)
        check_float("comm_loss", self.comm_loss, "Give a probability.", at_least=0.0, at_most=1.0)
        check_float("robot_radius", self.robot_radius, "Give metres.", above=0.0, at_most=LARGEST_EXTENT)
        check_float("min_start_distance", self.min_start_distance, "Give metres.", at_least=0.0)
        check_float("map_error_cutoff", self.map_error_cutoff, "Give metres.", at_least=1e-6, at_most=1e6)
        for name, kind in NESTED_CONFIGS.items():
            if not isinstance(getattr(self, name), kind):
                raise argument_error(
                    name, f"a {kind.__name__}", getattr(self, name), f"Build one: {kind.__name__}(...)."
                )
        if self.observe_images and (self.sensor, self.observation_type) != ("stereo", "dict"):
            cure = 'Use sensor="stereo" and observation_type="dict".'
            raise argument_error("observe_images", "False without rendered eyes or named arrays", True, cure)
        check_float("scan.half_fov", self.scan.half_fov, "A scan spans less than a half circle.", at_most=1.57)
        eyes = self.stereo if self.sensor == "stereo" else self.landmark_sensor
        usable = self.belief.filter.camera.farthest_usable
        if eyes.farthest > usable:
            expected = f"noise under which points {eyes.farthest:g} m away can be used"
            cure = "Raise sigma_px or baseline, lower sigma_disparity_px, or the max_range of the true camera."
            raise argument_error("belief.filter.camera", expected, f"a limit of {usable:g} m", cure)

    @property
    def always_in_contact(self) -> bool:
        """Whether nothing can keep the robots from hearing each other."""
        return self.comm_range is None and not self.comm_line_of_sight and self.comm_loss == 0.0

    @property
    def ticks_per_step(self) -> int:
        """Ticks in an `env.step`."""
        if self.decision_ticks is not None:
            return self.decision_ticks
        return GOAL_DECISION_TICKS if self.action_type == "goal" else 1

    @property
    def agents(self) -> list[str]:
        """Names of the agents: `robot_0`, `robot_1`, ..."""
        return [f"robot_{robot}" for robot in range(self.num_robots)]

    def replace(self, **changes: Any) -> Self:
        """Return a validated copy with some fields changed.

        Args:
            **changes: Fields by name. A nested part can be given as an object or as a dict, which then changes only
                the fields that it names.

        Raises:
            ValueError: If a field is unknown or a value is refused; the text names it.
        """
        return validate(type(self), merge(to_plain(self), changes))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from nested dicts; what is left out has the value of the `standard` preset."""
        return validate(cls, merge(to_plain(cls()), values))

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a configuration from a TOML file, as `to_toml` writes it.

        What the file leaves out, in nested tables as well, has the value of the `standard` preset; without a `format`
        it is of the present one.
        """
        try:
            values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, TypeError, ValueError) as error:  # of the path, of the encoding and of the syntax
            raise argument_error("config", "a readable TOML file", str(path), f"The reader says: {error}.") from error
        return cls._of_file(values)

    @classmethod
    def from_toml_text(cls, text: str) -> Self:
        """Build a configuration from what `to_toml` returned."""
        if not isinstance(text, str):
            raise argument_error("config", "TOML as text", text, "Pass what to_toml returned, or use from_toml.")
        try:
            values = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise argument_error("config", "TOML", text, f"The reader says: {error}.") from error
        return cls._of_file(values)

    @classmethod
    def _of_file(cls, values: dict[str, Any]) -> Self:
        """Build a configuration from what a TOML file says, or raise if it is of another format."""
        found = values.pop("format", FORMAT)
        if type(found) is not int or found != FORMAT:
            cure = "Use the release that wrote it, or set the values again."
            raise argument_error("config", f"one of format {FORMAT}", f"a configuration of format {found!r}", cure)
        return cls.from_dict(with_none(values))

    def to_toml(self) -> str:
        """Return the configuration as TOML, with the number of its format.

        None is left out where it is the standard, else it is the text "none".
        """
        values = without_none(to_plain(self), to_plain(type(self)()))
        return tomli_w.dumps({"format": FORMAT} | values)
