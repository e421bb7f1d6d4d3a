"""Textures of walls: each face of each wall carries a picture of its own, drawn from a stream of its own."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_choice, check_float
from slam_backend.frontend.images import Image

STYLES = ("distinct", "bricks", "posters_alike", "bricks_alike")
LEVELS = (20.0, 235.0)  # darkest and brightest paint
HIGHEST = 100.0  # [m]; faces are painted texel by texel
BRICK = (0.24, 0.12)  # width and height of a brick [m]
POSTER = 0.6  # side of a poster [m]
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm")


@dataclass(frozen=True, slots=True, kw_only=True)
class TextureConfig:
    """What the walls look like.

    Attributes:
        style: "distinct": polygons and posters, all different. "bricks": bricks whose edges and greys vary.
            "posters_alike": plain walls with one and the same poster every metre. "bricks_alike": equal bricks. The
            last three are there to deceive: places look alike.
        images: Folder of images that cover the walls instead; None: the style is drawn.
        texel: Side of a texel [m].
        floor: Height at which walls begin [m], above the robots' reference height.
        ceiling: Height at which they end [m].
        polygons: Of the style "distinct", 4 to 22 cm wide, per square metre [1/m^2].
        posters: Likewise, 30 to 70 cm wide [1/m^2].
    """

    style: str = "distinct"
    images: str | None = None
    texel: float = 0.01
    floor: float = -0.9
    ceiling: float = 1.2
    polygons: float = 5.0
    posters: float = 0.2

    def __post_init__(self) -> None:
        check_choice("textures.style", self.style, STYLES)
        check_float("textures.texel", self.texel, "Give metres; 0.01 is a good one.", at_least=0.002, at_most=0.1)
        check_float("textures.floor", self.floor, "Give metres.", at_least=-HIGHEST, at_most=HIGHEST)
        cure = "Give metres, above the floor."
        check_float("textures.ceiling", self.ceiling, cure, at_least=self.floor + 0.1, at_most=self.floor + HIGHEST)
        for name in ("polygons", "posters"):
            cure = "Give a number per square metre."
            check_float(f"textures.{name}", getattr(self, name), cure, at_least=0.0, at_most=1e4)
        if self.images is not None and not isinstance(self.images, str):
            raise argument_error("textures.images", "a folder as a string, or None", self.images, "Give a path.")


@dataclass(frozen=True, slots=True, eq=False)
class WallTextures:
    """The pictures of all faces, as sums from which the mean over any box follows; read-only.

    Face 2 w is the left one of wall w, seen from its beginning, face 2 w + 1 the right one. Columns of a picture run
    from the beginning of the wall to its end, rows from the ceiling down.

    Attributes:
        config: How they were drawn.
        sums: (C, T + 1) int32. Sums of the texels of a face left of a column and above a row, face after face; each
            face has one entry more than columns.
        starts: (2 S,) int64. Where each face begins in `sums`.
        columns: (2 S,) int64. Texel columns of each face.
        widths: (2 S,) float64 [m]. Width of a texel of each face; heights are `config.texel`.
    """

    config: TextureConfig
    sums: NDArray[np.int32]
    starts: IntArray
    columns: IntArray
    widths: FloatArray

    def __post_init__(self) -> None:
        for name in ("sums", "starts", "columns", "widths"):
            object.__setattr__(self, name, as_constant(getattr(self, name)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return WallTextures, (self.config, self.sums, self.starts, self.columns, self.widths)

    @property
    def rows(self) -> int:
        """T, texel rows of a face."""
        return int(self.sums.shape[1]) - 1

    def picture(self, face: int) -> Image:
        """Return the picture (T, columns) uint8 of a face."""
        begin, count = int(self.starts[face]), int(self.columns[face])
        sums = self.sums[begin : begin + count + 1].astype(np.int64)
        return np.diff(np.diff(sums, axis=0), axis=1).T.astype(np.uint8)


def draw_textures(walls: FloatArray, rng: np.random.Generator, config: TextureConfig | None = None) -> WallTextures:
    """Draw the faces of all walls.

    Args:
        walls: (S, 4) float64 [m], world frame.
        rng: Spawns one stream for each wall, so that a wall looks the same whatever the others are.
        config: What they look like.

    Raises:
        ValueError: If `config.images` is no folder with images.
    """
    config = TextureConfig() if config is None else config
    lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    rows = max(1, round((config.ceiling - config.floor) / config.texel))
    columns = np.repeat(np.maximum(1, np.ceil(lengths / config.texel).astype(np.int64)), 2)
    photographs = None if config.images is None else load_photographs(config.images, rows)
    common = rng.spawn(1)[0]
    poster = _poster(round(POSTER / config.texel), common)
    starts = np.concatenate([[0], np.cumsum(columns + 1)])
    sums = np.empty((int(starts[-1]), rows + 1), dtype=np.int32)
    for wall, stream in enumerate(rng.spawn(len(walls))):
        for face in (2 * wall, 2 * wall + 1):
            count = int(columns[face])
            if photographs is not None:
                picture = _photographed(count, photographs, stream)
            else:
                picture = _draw_face(rows, count, config, poster, stream)
            sums[starts[face] : starts[face + 1]] = cv2.integral(picture, sdepth=cv2.CV_32S).T
    widths = np.repeat(lengths, 2) / columns
    return WallTextures(config, *map(as_read_only, (sums, starts[:-1], columns, widths)))


def check_textures(textures: WallTextures, walls: FloatArray) -> None:
    """Refuse textures that are none of these walls (S, 4) [m]: kernels go by where each face begins.

    Raises:
        ValueError: As said.
    """
    cure = "Use those that draw_textures returned for the same walls."
    faces = 2 * len(walls)
    columns = check_array("textures.columns", textures.columns, (faces,), cure, dtype=np.int64)
    starts = check_array("textures.starts", textures.starts, (faces,), cure, dtype=np.int64)
    check_array("textures.widths", textures.widths, (faces,), cure)
    sums = textures.sums
    ends = np.cumsum(columns + 1) if columns.min() > 0 and columns.max() < len(sums) else np.zeros(faces, np.int64)
    kinds = [array.dtype.str for array in (textures.starts, textures.columns, sums)] == ["<i8", "<i8", "<i4"]
    rows = max(1, round((textures.config.ceiling - textures.config.floor) / textures.config.texel))
    if not kinds or sums.shape != (ends[-1], rows + 1) or starts[0] != 0 or (starts[1:] != ends[:-1]).any():
        raise argument_error("textures", "a picture for each face of each wall", f"shape {sums.shape}", cure)


def load_photographs(folder: str | Path, rows: int) -> list[Image]:
    """Read the images of a folder in grey, scaled to a height of `rows` texels.

    Raises:
        ValueError: If there are none.
    """
    files = sorted(file for file in Path(folder).glob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    photographs = []
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is not None:
            size = max(1, image.shape[1] * rows // image.shape[0]), rows
            photographs.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    if not photographs:
        raise argument_error("textures.images", "a folder with images", Path(folder), "Give PNG or JPEG files.")
    return photographs


def _photographed(columns: int, photographs: list[Image], rng: np.random.Generator) -> Image:
    """Cover a face with photographs side by side, the first one begun anywhere."""
    strips: list[Image] = []
    missing = columns
    while missing > 0:
        strip = photographs[int(rng.integers(len(photographs)))]
        if not strips:
            strip = strip[:, int(rng.integers(strip.shape[1])) :]
        strips.append(strip[:, :missing])
        missing -= strips[-1].shape[1]
    return np.ascontiguousarray(np.concatenate(strips, axis=1))


def _draw_face(rows: int, columns: int, config: TextureConfig, poster: Image, rng: np.random.Generator) -> Image:
    """Draw one face in the style of the configuration."""
    texel = config.texel
    plain = rng.uniform(95.0, 165.0) + _octaves(rows, columns, texel, rng)
    picture = np.rint(np.clip(plain, 0.0, 255.0)).astype(np.uint8)
    if config.style == "distinct":
        area = rows * columns * texel * texel
        for _ in range(rng.poisson(config.polygons * area)):
            _paint_polygon(picture, rng.uniform(0.04, 0.22) / texel, rng)
        for _ in range(rng.poisson(config.posters * area)):
            size = round(rng.uniform(0.3, 0.7) / texel)
            _lay(picture, _poster(size, rng), int(rng.integers(-size // 2, columns)), int(rng.integers(rows)))
    elif config.style == "posters_alike":
        top = max(0, (rows - len(poster)) // 2)
        for left in range(round(0.2 / texel), columns, round(1.0 / texel)):
            _lay(picture, poster, left, top)
    else:
        jitter = 0.0 if config.style == "bricks_alike" else 1.0
        picture = _bricks(rows, columns, texel, jitter, rng)
    return picture


def _octaves(rows: int, columns: int, texel: float, rng: np.random.Generator) -> FloatArray:
    """Return weak noise (rows, columns): a sum of smooth fields with details of 64, 16 and 4 cm."""
    total = np.zeros((rows, columns), dtype=np.float32)
    for size, height in ((0.64, 8.0), (0.16, 5.0), (0.04, 2.5)):
        shape = int(rows * texel / size) + 3, int(columns * texel / size) + 3
        coarse = rng.standard_normal(shape).astype(np.float32)
        # The field begins anywhere in the first cell, and cells are exactly `size` wide.
        scale = texel / size
        matrix = np.array([[scale, 0.0, rng.random()], [0.0, scale, rng.random()]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        total += height * cv2.warpAffine(coarse, matrix, (columns, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(total)


def _paint_polygon(picture: Image, size: float, rng: np.random.Generator) -> None:
    """Paint a polygon of 3 to 6 corners and about `size` texels somewhere into the picture."""
    rows, columns = picture.shape
    count = int(rng.integers(3, 7))
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    radii = 0.5 * size * rng.uniform(0.6, 1.2, count)
    centre = rng.uniform(0.0, [columns, rows])
    corners = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    level = float(rng.uniform(*LEVELS))
    cv2.fillPoly(picture, [np.rint(16.0 * corners).astype(np.int32)], level, cv2.LINE_AA, 4)


def _poster(size: int, rng: np.random.Generator) -> Image:
    """Return a poster (size, size): a frame, and a dozen shapes in it."""
    poster = np.full((size, size), round(rng.uniform(*LEVELS)), dtype=np.uint8)
    for _ in range(12):
        _paint_polygon(poster, rng.uniform(0.15, 0.5) * size, rng)
    edge = max(1, size // 30)
    cv2.rectangle(poster, (0, 0), (size - 1, size - 1), float(rng.uniform(*LEVELS)), edge)
    return poster


def _lay(picture: Image, patch: Image, left: int, top: int) -> None:
    """Lay a patch over the picture; what sticks out is cut off."""
    x0, y0 = max(0, left), max(0, top)
    x1, y1 = min(picture.shape[1], left + patch.shape[1]), min(picture.shape[0], top + patch.shape[0])
    if x0 < x1 and y0 < y1:
        picture[y0:y1, x0:x1] = patch[y0 - top : y1 - top, x0 - left : x1 - left]


def _bricks(rows: int, columns: int, texel: float, jitter: float, rng: np.random.Generator) -> Image:
    """Return courses of bricks with joints; `jitter` 0: all alike, 1: each with its own edges and grey."""
    picture = np.full((rows, columns), 175, dtype=np.uint8)
    width, height, joint = BRICK[0] / texel, BRICK[1] / texel, 0.012 / texel
    for course in range(int(rows / height) + 1):
        offset = 0.5 * width * (course % 2)
        for brick in range(-1, int(columns / width) + 2):
            moved = jitter * rng.uniform(-0.12, 0.12, 4) * [width, height, width, height]
            x0, y0 = brick * width + offset + joint + moved[0], course * height + joint + moved[1]
            x1, y1 = (brick + 1) * width + offset - joint + moved[2], (course + 1) * height - joint + moved[3]
            corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
            level = 95.0 + jitter * float(rng.uniform(-45.0, 45.0))
            cv2.fillPoly(picture, [np.rint(16.0 * corners).astype(np.int32)], level, cv2.LINE_AA, 4)
    return picture
