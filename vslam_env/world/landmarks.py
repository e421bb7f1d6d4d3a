"""Landmarks with descriptors are put on those wall faces that robots can look at."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, argument_error, check_float, check_int
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World

HIGHEST = 1e3  # [m] above or below the robots; nothing there is in view
CORNER = 0.05  # [m] landmarks keep this far from the ends of their wall
LOOK = 0.12  # [m] a face looks into the free space if the point this far in front of it lies there


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkConfig:
    """How many landmarks there are, where, and how alike they look.

    Attributes:
        density: Landmarks per metre of wall face [1/m].
        min_height: Lowest height above the robots' reference height [m].
        max_height: Greatest height [m].
        min_spacing: Between neighbours along a face [m].
        descriptor_size: Numbers in a descriptor (d).
        distinctness: Typical L2 distance between the descriptors of two landmarks, at most sqrt(2). The nearest of
            300 others is about a fifth closer.
        repeated: Share of the landmarks that copy the descriptor of another one, in [0, 1].
    """

    density: float = 1.4
    min_height: float = -0.6
    max_height: float = 0.8
    min_spacing: float = 0.15
    descriptor_size: int = 64
    distinctness: float = 0.8
    repeated: float = 0.0

    def __post_init__(self) -> None:
        check_float("landmarks.density", self.density, "Give landmarks per metre of wall face.", above=0.0, at_most=1e4)
        cure = "Give metres."
        check_float("landmarks.min_height", self.min_height, cure, at_least=-HIGHEST, at_most=HIGHEST)
        cure = "Give metres, above min_height."
        check_float("landmarks.max_height", self.max_height, cure, at_least=self.min_height, at_most=HIGHEST)
        check_float("landmarks.min_spacing", self.min_spacing, "Give metres.", at_least=0.0)
        check_int("landmarks.descriptor_size", self.descriptor_size, 2, "Use 64 for u-SURF.", 10_000)
        cure = "Unrelated unit vectors differ by 1.41."
        check_float("landmarks.distinctness", self.distinctness, cure, above=0.0, at_most=2**0.5)
        check_float("landmarks.repeated", self.repeated, "Give a share.", at_least=0.0, at_most=1.0)


def place_landmarks(
    world: World,
    rng: np.random.Generator,
    config: LandmarkConfig | None = None,
    free_space: FreeSpace | None = None,
) -> Landmarks:
    """Put landmarks on both faces of all walls, where a face looks into the space that robots can reach.

    Args:
        world: The walls.
        rng: Source of the draws.
        config: How many and how alike.
        free_space: Of this world, if it has been made already.

    Returns:
        Landmarks on the wall lines, face by face.

    Raises:
        ValueError: If no face looks into the free space.
    """
    config = LandmarkConfig() if config is None else config
    free_space = FreeSpace(world) if free_space is None else free_space
    starts, ends = world.walls[:, :2], world.walls[:, 2:]
    lengths = np.linalg.norm(ends - starts, axis=1)
    along = (ends - starts) / lengths[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    walls, offsets, sides = [], [], []
    for wall, length in enumerate(lengths):
        for side in (1.0, -1.0):
            face = _draw_offsets(float(length), config, rng)
            walls.append(np.full(len(face), wall))
            offsets.append(face)
            sides.append(np.full(len(face), side))
    wall_of = np.concatenate(walls)
    positions = starts[wall_of] + np.concatenate(offsets)[:, None] * along[wall_of]
    normals = np.concatenate(sides)[:, None] * left[wall_of]
    heights = rng.uniform(config.min_height, config.max_height, len(wall_of))
    keep = free_space.contains(positions + LOOK * normals)
    if not keep.any():
        raise argument_error(
            "landmarks.density",
            "enough for one landmark on the walls that robots can look at",
            config.density,
            "Raise the density, or give the world landmarks of its own.",
        )
    return Landmarks(
        positions=np.column_stack([positions, heights])[keep],
        normals=normals[keep],
        walls=wall_of[keep],
        descriptors=draw_descriptors(int(keep.sum()), config, rng),
    )


def _draw_offsets(length: float, config: LandmarkConfig, rng: np.random.Generator) -> FloatArray:
    """Draw where along a face of `length` [m] landmarks sit: uniformly, but never closer than the spacing.

    Sorted uniform draws on the room that is left, each moved on by the spacings before it, have exactly that law.
    """
    room = length - 2.0 * CORNER
    if room <= 0.0:
        return np.empty(0)
    count = int(config.density * length + rng.random())
    if (count - 1) * config.min_spacing > room:
        count = int(room / config.min_spacing) + 1
    slack = room - (count - 1) * config.min_spacing
    return CORNER + np.sort(rng.uniform(0.0, slack, count)) + config.min_spacing * np.arange(count)


def draw_descriptors(count: int, config: LandmarkConfig, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw unit descriptors around a common mean, as those of real images are.

    With a share a^2 of the common mean and 1 - a^2 of its own, two descriptors have the cosine a^2 on average and thus
    the distance sqrt(2 (1 - a^2)).

    Args:
        count: How many, at least 1.
        config: Their size d, their distinctness, and how many are repeated.
        rng: Source of the draws.

    Returns:
        (count, d) float32 [-].
    """
    own_share = 0.5 * config.distinctness**2
    common = rng.standard_normal(config.descriptor_size)
    own = rng.standard_normal((count, config.descriptor_size))
    common /= np.linalg.norm(common)
    own -= np.outer(own @ common, common)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    descriptors = np.sqrt(1.0 - own_share) * common + np.sqrt(own_share) * own
    copies = rng.random(count) < config.repeated
    copies[0] = False  # there is always one to copy
    originals = np.flatnonzero(~copies)
    descriptors[copies] = descriptors[originals[rng.integers(len(originals), size=count)]][copies]
    return np.asarray(descriptors, dtype=np.float32)
