"""Short `repr`s: one line for objects with arrays, and settings that Python can evaluate."""

import importlib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from slam_backend.core.short_repr import short_repr
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.pose_graph import PoseGraph
from slam_backend.state import options_in
from tests.regression.public_api import MODULES, PACKAGES
from vslam_env import EnvConfig, preset_config, vslam_v0

CONFIGURATIONS = options_in(EnvConfig)
COUNTED = (PoseGraph,)  # whose text counts what they hold
SHORT = short_repr(type("Sample", (), {})).__repr__


def public_records() -> Iterator[type[Any]]:
    """Yield the public dataclasses and named tuples whose annotations name arrays."""
    for path in (*PACKAGES, *MODULES):
        module = importlib.import_module(path)
        for name in getattr(module, "__all__", vars(module)):
            kind = getattr(module, name)
            is_own = getattr(kind, "__module__", "") == path or hasattr(module, "__all__")
            is_record = is_own and isinstance(kind, type) and (is_dataclass(kind) or hasattr(kind, "_fields"))
            if is_record and not name.startswith("_") and "rray" in str(getattr(kind, "__annotations__", {})):
                yield kind


@pytest.mark.parametrize("kind", dict.fromkeys((*CONFIGURATIONS, *public_records())), ids=lambda kind: kind.__name__)
def test_all_configurations_and_public_records_have_a_short_repr(kind: type[Any]) -> None:
    """No public object prints its arrays, or unchanged settings."""
    assert kind.__repr__ is SHORT or kind in COUNTED


@pytest.mark.parametrize("kind", CONFIGURATIONS, ids=lambda kind: kind.__name__)
def test_settings_show_what_differs_from_the_defaults(kind: type[Any]) -> None:
    """Defaults are left out, at any depth, and what is printed builds an equal object."""
    assert repr(kind()) == f"{kind.__name__}()"
    for field in fields(kind):
        value = getattr(kind(), field.name)
        if type(value) is float and value:
            try:
                changed = replace(kind(), **{field.name: value * (1.0 - 2.0**-50)})
            except ValueError:  # a value at the end of its interval
                continue
            assert repr(changed).startswith(f"{kind.__name__}({field.name}=")
            assert eval(repr(changed), {kind.__name__: kind}) == changed


@pytest.mark.parametrize(("preset", "sensor"), [("hard", "landmark"), ("large", "landmark"), ("easy", "stereo")])
def test_a_printed_environment_builds_an_equal_one(preset: str, sensor: str) -> None:
    """Settings within settings, some of whose defaults differ from those of their class, are complete."""
    config = preset_config(preset, sensor)
    assert eval(repr(config), {kind.__name__: kind for kind in CONFIGURATIONS}) == config


def test_all_that_an_environment_shows_is_printed_in_one_line() -> None:
    """Beliefs and their parts, readings, events and scenes of a team that has merged have at most 700 characters."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=3, num_particles=7, action_type="goal", oracle_merge=True)
    env.reset(seed=0)
    for _ in range(12):
        env.step(dict.fromkeys(env.agents, 1))
    belief = env.belief("robot_0")
    parts = [getattr(belief, field.name) for field in fields(belief) if field.name not in ("looks", "particles")]
    shown = [belief, belief.map, *env.readings, *env.events, env.scene(), env.world, env.episode.scenario, *parts]
    shown = [each for each in shown if not isinstance(each, np.ndarray)]
    assert belief.teammates
    assert env.events
    for each in shown:
        assert len(repr(each)) <= 700, type(each)
        assert "\n" not in repr(each)


def test_shapes_few_numbers_and_lengths_are_shown() -> None:
    """Records show small vectors with four digits, and larger arrays and parts by what they are."""
    frame = Measurements(np.ones((2, 3)), np.ones((2, 5)))
    assert repr(frame) == "Measurements(points=<(2, 3) float64>, descriptors=<(2, 5) float32>)"
    points = LandmarkMap(np.eye(3), [np.eye(3)] * 3, np.eye(3, 7))
    assert repr(points) == (
        "LandmarkMap(means=<(3, 3) float64>, covariances=<(3, 3, 3) float64>, descriptors=<(3, 7) float32>, "
        "counts=[1, 1, 1], ids=[0, 1, 2])"
    )


def test_parts_that_are_long_are_shown_by_class_and_length() -> None:
    """A map, a list and a text of a record fit; minus zero, NaN and defaults are no noise."""
    from slam_backend.core.short_repr import described

    class Record:
        pose = np.array([-0.0, np.nan, 1.23456e-7])
        part = LandmarkMap.empty(5)
        listed = tuple(range(100, 130))

    shown = described(Record(), ("pose", "part", "listed"))
    assert shown == "Record(pose=[0, nan, 1.235e-07], part=<LandmarkMap of 0>, listed=<tuple of 30>)"
