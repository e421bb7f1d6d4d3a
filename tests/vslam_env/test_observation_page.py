import ast
import dataclasses
import inspect
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_env import small_env

from vslam_env import EnvConfig, preset_config, vslam_v0
from vslam_env.reward import TERMS

PAGE = (Path(__file__).parents[2] / "docs" / "observations.md").read_text(encoding="utf-8")


def tables() -> dict[str, list[dict[str, str]]]:
    """Return the page's tables by the name of their first column: per row the cells by column, marks of code kept."""
    found: dict[str, list[dict[str, str]]] = {}
    lines = PAGE.splitlines()
    begins = [i for i in range(len(lines) - 1) if lines[i].startswith("|") and lines[i + 1].startswith("|---")]
    for begin in begins:
        columns = cells_of(lines[begin])
        rows = []
        for line in lines[begin + 2 :]:
            if not line.startswith("|"):
                break
            rows.append(dict(zip(columns, cells_of(line), strict=True)))
        name = columns[0].strip("`") + (" by preset" if "easy" in columns else "")
        assert name not in found, f"two tables begin with the column {name}"
        found[name] = rows
    return found


def cells_of(line: str) -> list[str]:
    """Return the cells of a table's line."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


TABLES = tables()


def by_name(table: str) -> dict[str, dict[str, str]]:
    """Return the rows of a table by what stands between the first marks of code in their first cells."""
    rows = TABLES[table]
    named = {next(iter(row.values())).split("`")[1]: row for row in rows}
    assert len(named) == len(rows)
    return named


def test_observations_are_as_the_page_says() -> None:
    """Names, shapes, dtypes and scalar ranges of the table are those of the spaces, in both directions."""
    rows = by_name("key")
    space: Any = small_env(action_type="goal").observation_space("robot_0")
    assert rows.keys() == space.spaces.keys()
    for name, row in rows.items():
        box = space[name]
        assert ast.literal_eval(row["shape"]) == box.shape, name
        assert np.dtype(row["dtype"]) == box.dtype, name
        if " to " in row["range"] and "," not in row["range"]:
            low, high = map(float, row["range"].split(" to "))
            assert (box.low == low).all(), name
            assert (box.high == high).all(), name


def test_the_flat_vector_is_as_long_as_the_page_says() -> None:
    """The page names the shape of the flat observation."""
    space = small_env(observation_type="flat").observation_space("robot_0")
    assert f"float32 vector {space.shape}" in PAGE


def test_infos_are_as_the_page_says() -> None:
    """The table names each key of an info with its type, and no other."""
    rows = by_name("info")
    env = small_env(reward={"map_error": 1.0, "collisions": 0.5})
    for infos in (env.reset(seed=0)[1], env.step({agent: np.zeros(2) for agent in env.agents})[4]):
        types = {"reward/<term>" if key.startswith("reward/") else key: type(v) for key, v in infos["robot_0"].items()}
        assert {name: row["type"] for name, row in rows.items()} == {key: t.__name__ for key, t in types.items()}


def test_arguments_are_as_the_page_says() -> None:
    """The table names every argument of `parallel_env` in order, and what it is in the standard preset."""
    rows = by_name("argument")
    assert list(rows) == list(inspect.signature(vslam_v0.parallel_env).parameters)
    standard = EnvConfig()
    for name, row in rows.items():
        value = standard.belief.filter.num_particles if name == "num_particles" else getattr(standard, name, None)
        assert ast.literal_eval(row["standard"].strip("`")) == value, name


def test_fields_are_as_the_page_says() -> None:
    """Each field of the configuration stands on the page: as an argument, or in the table of those that are none."""
    rows = by_name("setting")
    arguments = inspect.signature(vslam_v0.parallel_env).parameters
    fields = [field.name for field in dataclasses.fields(EnvConfig) if field.name not in arguments]
    assert list(rows) == fields
    for name, row in rows.items():
        value, said = getattr(EnvConfig(), name), row["standard"].strip("`")
        assert said == (type(value).__name__ if dataclasses.is_dataclass(value) else repr(value)), name


@pytest.mark.parametrize("preset", ["easy", "standard", "hard"])
def test_presets_are_as_the_page_says(preset: str) -> None:
    """The numbers of the table are those of the presets, to three digits."""
    config = preset_config(preset)
    for name, row in by_name("field by preset").items():
        assert float(row[preset]) == pytest.approx(reduce(getattr, name.split("."), config), rel=5e-3), name


def test_reward_terms_and_actions_are_as_the_page_says() -> None:
    """The page names the terms that a reward can have, and the space of each type of action."""
    assert by_name("term").keys() == TERMS.keys()
    for name, row in by_name("action_type").items():
        assert repr(small_env(action_type=name).action_space("robot_0")).replace(".0", "") == row["space"].strip("`")


def test_options_are_as_the_page_says() -> None:
    """The options of a reset that the page names are those that its docstring names, and they are obeyed."""
    rows = by_name("option")
    documented = inspect.getdoc(small_env().reset)
    assert documented is not None
    assert all(f'`"{name}"`' in documented for name in rows)
    env = small_env()
    starts = np.array([[2.0, 2.0, 0.0], [8.0, 3.0, 1.0]])
    options = {"world_seed": 5, "start_poses": starts}
    assert options.keys() == rows.keys()
    env.reset(seed=1, options=options)
    looks = env.world.landmarks
    assert looks is not None
    np.testing.assert_allclose(env.true_start_poses, starts)
    env.reset(seed=2, options=options)
    again = env.world.landmarks
    assert again is not None
    np.testing.assert_array_equal(again.positions, looks.positions)
