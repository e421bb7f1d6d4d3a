"""Survey of worlds: sizes and counts, and pictures of several worlds side by side."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import check_int
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.rendering import draw_frame
from vslam_env.rendering.canvas import write
from vslam_env.rendering.palette import INK, PAPER
from vslam_env.simulation.scenario import sample_scenario
from vslam_env.world import FreeSpace

TILE = (640, 480)  # [px]
TITLE_PX = 32  # height of the title above a tile


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldFigures:
    """Sizes and counts of one world."""

    name: str  # Name of the world
    walls: int  # Number of walls
    landmarks: int  # Number of observable landmarks
    floor_m2: float  # Area that robots can explore [m²]
    width_m: float  # Extent along x [m]
    height_m: float  # Extent along y [m]
    start_gap_m: float  # Smallest distance between two start poses [m]; infinity for one robot


def survey(world: str, world_seed: int, robots: int = 3) -> WorldFigures:
    """Build a world and place robots in it.

    Raises:
        ValueError: If that is impossible; the message gives the reason and a hint.
    """
    check_int("seed", world_seed, 0, "Use 0 or a positive number.")
    config = EnvConfig(world=world, num_robots=robots)
    scenario, _ = sample_scenario(config, world, np.random.SeedSequence(world_seed), world_seed)
    x_min, y_min, x_max, y_max = scenario.world.bounds
    starts = scenario.true_starts[:, :2]
    gaps = np.linalg.norm(starts[:, None] - starts, axis=2)[~np.eye(robots, dtype=bool)]
    squares = FreeSpace(scenario.world, config.robot_radius).free_area_cells
    return WorldFigures(
        name=scenario.world.name, walls=len(scenario.world.walls),
        landmarks=int(np.count_nonzero(scenario.observable_landmarks)),
        floor_m2=0.04 * len(squares), width_m=x_max - x_min, height_m=y_max - y_min,
        start_gap_m=float(gaps.min(initial=np.inf)),
    )  # fmt: skip


def survey_all(world: str, world_seeds: Iterable[int], robots: int) -> list[WorldFigures]:
    """Build the worlds of some seeds and place robots in each.

    Raises:
        ValueError: If that is impossible; the message gives the reason, a hint, and the seed.
    """
    surveys = []
    for seed in world_seeds:
        try:
            surveys.append(survey(world, seed, robots))
        except ValueError as error:
            raise ValueError(f"{error} That was world seed {seed}, after {len(surveys)} valid ones.") from error
    return surveys


def contact_sheet(world: str, first_seed: int, count: int, robots: int) -> NDArray[np.uint8]:
    """Draw worlds of `count` seeds side by side, with landmarks and start poses, (H, W, 3) uint8 RGB.

    Raises:
        ValueError: If an argument is invalid or a world cannot be built.
    """
    check_int("seeds", count, 1, "Use at least one world.")
    check_int("first_seed", first_seed, 0, "Use 0 or a positive number.")
    env = vslam_v1.parallel_env(world=world, num_robots=robots)
    tiles: list[Any] = []
    for seed in range(first_seed, first_seed + count):
        env.reset(seed=seed, options={"world_seed": seed})
        title = np.full((TITLE_PX, TILE[0], 3), PAPER, np.uint8)
        write(title, f"seed {seed}", 16.0, 0.5 * TITLE_PX, 0.4 * TITLE_PX, INK)
        tiles.append(np.vstack([title, draw_frame(env.scene(), TILE)]))
    columns = int(np.ceil(np.sqrt(count)))
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-count % columns)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    sheet: NDArray[np.uint8] = np.vstack(rows)
    return sheet
