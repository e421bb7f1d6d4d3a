"""Random landmarks with descriptors on the wall faces that border on free space."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error, check_float, check_int
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World

HIGHEST = 1e3  # [m] limit of heights above or below the robots
CORNER = 0.05  # [m] distance of landmarks from the ends of their wall
LOOK = 0.12  # [m] a face is visible if the point this far in front of it lies in the free space


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkConfig:
    """Density, positions and appearance of landmarks.

    Attributes:
        density: Landmarks per metre of wall face [1/m].
        min_height: Least height above the robots' reference height [m].
        max_height: Greatest height above the reference height [m].
        min_spacing: Least distance between neighbours along a face [m].
        descriptor_size: Dimension d of a descriptor.
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
        hint = "Give metres."
        check_float("landmarks.min_height", self.min_height, hint, at_least=-HIGHEST, at_most=HIGHEST)
        hint = "Give metres, above min_height."
        check_float("landmarks.max_height", self.max_height, hint, at_least=self.min_height, at_most=HIGHEST)
        check_float("landmarks.min_spacing", self.min_spacing, "Give metres.", at_least=0.0)
        check_int("landmarks.descriptor_size", self.descriptor_size, 2, "Use 64 for u-SURF.", 10_000)
        hint = "Unrelated unit vectors differ by 1.41."
        check_float("landmarks.distinctness", self.distinctness, hint, above=0.0, at_most=2**0.5)
        check_float("landmarks.repeated", self.repeated, "Give a share.", at_least=0.0, at_most=1.0)


def place_landmarks(
    world: World,
    rng: np.random.Generator,
    config: LandmarkConfig | None = None,
    free_space: FreeSpace | None = None,
) -> Landmarks:
    """Place landmarks on all wall faces that border on the free space.

    Args:
        world: World with the walls.
        rng: Source of the draws.
        config: Density, positions and appearance.
        free_space: Free space of this world; None: computed.

    Returns:
        Landmarks on the wall lines, face by face.

    Raises:
        ValueError: If no landmark borders on the free space.
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
            "a density that gives at least one visible landmark",
            config.density,
            "Raise the density, or give the world its own landmarks.",
        )
    return Landmarks(
        positions=np.column_stack([positions, heights])[keep],
        normals=normals[keep],
        walls=wall_of[keep],
        descriptors=draw_descriptors(int(keep.sum()), config, rng),
    )


def _draw_offsets(length: float, config: LandmarkConfig, rng: np.random.Generator) -> FloatArray:
    """Draw positions along a face of `length` [m]: uniform, subject to the least spacing.

    Sorted uniform draws on the remaining length, shifted by the spacings before them, have exactly this distribution.
    """
    usable = length - 2.0 * CORNER
    if usable <= 0.0:
        return np.empty(0)
    count = int(config.density * length + rng.random())
    if (count - 1) * config.min_spacing > usable:
        count = int(usable / config.min_spacing) + 1
    slack = usable - (count - 1) * config.min_spacing
    return CORNER + np.sort(rng.uniform(0.0, slack, count)) + config.min_spacing * np.arange(count)


def draw_descriptors(count: int, config: LandmarkConfig, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw unit descriptors around a common mean, like descriptors of real images.

    With a share a^2 of the common mean and 1 - a^2 of an individual part, two descriptors have the mean cosine a^2 and
    thus the distance sqrt(2 (1 - a^2)).

    Args:
        count: Number of descriptors, at least 1.
        config: Size d, distinctness and share of repeated descriptors.
        rng: Source of the draws.

    Returns:
        (count, d) float32 [-].
    """
    own_share = 0.5 * config.distinctness**2
    common = rng.standard_normal(config.descriptor_size)
    unique = rng.standard_normal((count, config.descriptor_size))
    common /= np.linalg.norm(common)
    unique -= np.outer(unique @ common, common)
    unique /= np.linalg.norm(unique, axis=1, keepdims=True)
    descriptors = np.sqrt(1.0 - own_share) * common + np.sqrt(own_share) * unique
    copies = rng.random(count) < config.repeated
    copies[0] = False  # at least one original to copy
    originals = np.flatnonzero(~copies)
    descriptors[copies] = descriptors[originals[rng.integers(len(originals), size=count)]][copies]
    return np.asarray(descriptors, dtype=np.float32)
