"""Every family of worlds gives sound buildings, and splits keep training apart from tests."""

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_env import WALLS, room, small_env

from vslam_env import EnvConfig, World, vslam_v0
from vslam_env.simulation.scenario import draw_setting
from vslam_env.world import SPLITS, WORLD_FAMILIES, FreeSpace, draw_world_seed, make_world, save_walls_json
from vslam_env.world.loaders.splits import files_of_split

FAMILIES = sorted(WORLD_FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_seed_gives_one_building(family: str) -> None:
    """The same seed gives the same walls, another one others."""
    walls = [make_world(family, np.random.default_rng(seed)).walls for seed in (3, 3, 4)]
    np.testing.assert_array_equal(walls[0], walls[1])
    assert walls[0].shape != walls[2].shape or not np.array_equal(walls[0], walls[2])


@pytest.mark.parametrize("family", FAMILIES)
def test_all_floor_hangs_together(family: str) -> None:
    """In 15 buildings of a family the reachable part is nearly all floor in which a robot fits."""
    for seed in range(15):
        world = make_world(family, np.random.default_rng(seed))
        space = FreeSpace(world)
        alone = FreeSpace(world, 0.05)  # a robot so small that it fits almost wherever there is floor
        x_min, y_min, x_max, y_max = world.bounds
        assert len(space.free_area_cells) == len(alone.free_area_cells)
        assert 0.04 * len(space.free_area_cells) > 0.35 * (x_max - x_min) * (y_max - y_min)
        assert space.reachable.sum() > 0.4 * space.open_space.sum()
        assert 10 <= len(world.walls) <= 100


@pytest.mark.parametrize("family", FAMILIES)
def test_starts_are_free_reachable_and_apart(family: str) -> None:
    """Three robots start 5 m apart, or 7 m if that is asked, off the walls, in the same part, sharing no view."""
    for seed, apart in ((0, 5.0), (1, 7.0), (2, 5.0)):
        config = EnvConfig(world=family, min_start_distance=apart)
        setting = draw_setting(config, family, np.random.SeedSequence(seed))
        starts = setting.true_starts
        gaps = np.linalg.norm(starts[:, None, :2] - starts[:, :2], axis=2)[~np.eye(3, dtype=bool)]
        assert gaps.min() >= apart
        FreeSpace(setting.world).check_starts(starts, 3)
        assert setting.sensor.visible(starts).sum(axis=0).max() <= 1


@pytest.mark.parametrize("family", ["maze", "loops"])
def test_there_are_ways_round(family: str) -> None:
    """Free floor has a hole in most mazes, and in all loops one around each block: walls that touch no outer wall."""
    with_loops = 0
    for seed in range(10):
        open_space = FreeSpace(make_world(family, np.random.default_rng(seed))).open_space
        parts = cv2.connectedComponents((~open_space).astype(np.uint8), connectivity=8)[0] - 1  # the outside is one
        with_loops += parts >= 2
        if family == "loops":
            assert parts >= 5
    assert with_loops >= 7


def test_a_hall_hides_something_from_everywhere() -> None:
    """Pillars stand apart: each is passed on all sides by a robot, as the free floor goes around it."""
    world = make_world("hall", np.random.default_rng(5))
    pillars = world.walls[4:].reshape(-1, 4, 4)
    middles = pillars[:, :, :2].mean(axis=1)
    gaps = np.linalg.norm(middles[:, None] - middles, axis=2)[~np.eye(len(middles), dtype=bool)]
    assert len(pillars) >= 8
    assert gaps.min() > 1.4


def test_splits_do_not_meet() -> None:
    """The seeds of the splits are apart, and each draw stays in its own range."""
    ranges = sorted(SPLITS.values())
    assert all(end <= begin for (_, end), (begin, _) in pairwise(ranges))
    rng = np.random.default_rng(2)
    for split, (first, end) in SPLITS.items():
        drawn = [draw_world_seed(split, rng) for _ in range(200)]
        assert first <= min(drawn) <= max(drawn) < end
        assert len(set(drawn)) > 150


def test_a_split_environment_draws_from_its_seeds() -> None:
    """The buildings of a split are those of world seeds in its range; a world seed that is given is obeyed."""
    seen: list[int] = []

    def watched(rng: np.random.Generator) -> World:
        seen.append(int(rng.integers(2**40)))
        return room()

    env = small_env(world=watched, world_split="validation")
    env.reset(seed=4)
    env.reset(seed=4)
    first, end = SPLITS["validation"]
    possible = {
        int(np.random.default_rng(np.random.SeedSequence(seed).spawn(2)[0]).integers(2**40)): seed
        for seed in range(first, end)
    }
    assert seen[0] == seen[1]
    assert seen[0] in possible
    env.reset(seed=5)
    assert seen[2] in possible
    assert seen[2] != seen[0]
    env.reset(seed=5, options={"world_seed": 3})
    assert seen[3] not in possible


def test_files_take_turns(tmp_path: Path) -> None:
    """Of twelve files the first and the eleventh are for tests, the second and the twelfth for validation."""
    files = [tmp_path / f"{index:02d}.json" for index in range(12)]
    for file in files:
        save_walls_json(World(file.stem, WALLS), file)
    split = {name: files_of_split(files, name) for name in SPLITS}
    assert split["test"] == [files[0], files[10]]
    assert split["validation"] == [files[1], files[11]]
    assert split["train"] == files[2:10]
    names = {make_world(tmp_path, np.random.default_rng(seed), "test").name for seed in range(20)}
    assert names == {"00", "10"}


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda path: small_env(world_split="test"), "world_split: expected None for a world of which there is one"),
        (lambda path: vslam_v0.parallel_env(world_split="exam"), "world_split: expected .*'train'.*, got 'exam'"),
        (lambda path: small_env(world=path, world_split="train").reset(), "world_split: expected files for 'train'"),
    ],
)
def test_bad_splits_are_refused(act: Callable[[Path], object], says: str, tmp_path: Path) -> None:
    """A split of what cannot be split, or that does not exist, is refused."""
    save_walls_json(room(), tmp_path / "room.json")
    with pytest.raises(ValueError, match=says):
        act(tmp_path)


def test_a_file_is_read_again_when_it_changes(tmp_path: Path) -> None:
    """A world that is loaded twice is read once, unless its file was written in between."""
    path, rng = tmp_path / "room.json", np.random.default_rng(0)
    save_walls_json(World("room", WALLS), path)
    first = make_world(path, rng)
    assert make_world(path, rng) is first
    save_walls_json(World("room", 2.0 * WALLS), path)
    os.utime(path, ns=(1, 1))
    np.testing.assert_array_equal(make_world(path, rng).walls, 2.0 * WALLS)
