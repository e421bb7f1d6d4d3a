"""Random textures of the walls, with an independent random stream for each wall."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.image_files import read_grey_image
from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_choice, check_float
from slam_backend.frontend.images import Image
from slam_backend.state import FLOAT64, INT32, INT64, Array, Options, State

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

STYLES = ("distinct", "bricks", "posters_alike", "bricks_alike")
LEVELS = (20.0, 235.0)  # darkest and brightest grey level
HIGHEST = 100.0  # [m] limits the number of texels
BRICK = (0.24, 0.12)  # width and height of a brick [m]
POSTER = 0.6  # side of a poster [m]
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm")


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class TextureConfig:
    """Style and resolution of the wall textures.

    Attributes:
        style: "distinct": polygons and posters, all different. "bricks": bricks with varying edges and grey levels.
            "posters_alike": plain walls with the same poster every metre. "bricks_alike": equal bricks. The last three
            create perceptual aliasing.
        images: Folder of images to cover the walls with instead of the style; None: use the style.
        texel: Side of a texel [m].
        floor: Height of the lower edge of walls above the robots' reference height [m].
        ceiling: Height of their upper edge [m].
        polygons: Density of the polygons in the style "distinct", 4 to 22 cm wide [1/m^2].
        posters: Density of the posters in the style "distinct", 30 to 70 cm wide [1/m^2].
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
        check_float("textures.texel", self.texel, "Give metres, for example 0.01.", at_least=0.002, at_most=0.1)
        check_float("textures.floor", self.floor, "Give metres.", at_least=-HIGHEST, at_most=HIGHEST)
        hint = "Give metres, above the floor."
        check_float("textures.ceiling", self.ceiling, hint, at_least=self.floor + 0.1, at_most=self.floor + HIGHEST)
        for name in ("polygons", "posters"):
            hint = "Give a number per square metre."
            check_float(f"textures.{name}", getattr(self, name), hint, at_least=0.0, at_most=1e4)
        if self.images is not None and not isinstance(self.images, str):
            raise argument_error("textures.images", "a folder as a string, or None", self.images, "Give a path.")


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class WallTextures:
    """Textures of all faces as integral images; read-only.

    Face 2 w is the left face of wall w, seen from its start, face 2 w + 1 the right one. Columns of a texture run from
    the start of the wall to its end, rows from the ceiling down.

    Attributes:
        config: Style and resolution.
        sums: (C, T + 1) int32. Integral images of the faces, transposed and concatenated; each face has one row more
            than columns.
        starts: (2 S,) int64. First row of each face in `sums`.
        columns: (2 S,) int64. Number of texel columns of each face.
        widths: (2 S,) float64 [m]. Texel width of each face; the height is `config.texel`.
    """

    STATE: ClassVar[State] = State(
        config=Options(TextureConfig),
        sums=Array(INT32, "* *", constant=True),
        starts=Array(INT64, "faces", constant=True),
        columns=Array(INT64, "faces", constant=True),
        widths=Array(FLOAT64, "faces", constant=True),
    )

    config: TextureConfig
    sums: NDArray[np.int32]
    starts: IntArray
    columns: IntArray
    widths: FloatArray

    def __post_init__(self) -> None:
        for name in ("sums", "starts", "columns", "widths"):
            object.__setattr__(self, name, as_constant(getattr(self, name)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled instances read-only."""
        return WallTextures, (self.config, self.sums, self.starts, self.columns, self.widths)

    @property
    def rows(self) -> int:
        """Number of texel rows T of a face."""
        return int(self.sums.shape[1]) - 1

    def picture(self, face: int) -> Image:
        """Return the texture (T, columns) uint8 of a face."""
        begin, count = int(self.starts[face]), int(self.columns[face])
        sums = self.sums[begin : begin + count + 1].astype(np.int64)
        return np.diff(np.diff(sums, axis=0), axis=1).T.astype(np.uint8)


def draw_textures(walls: FloatArray, rng: np.random.Generator, config: TextureConfig | None = None) -> WallTextures:
    """Draw the textures of all walls.

    Args:
        walls: (S, 4) float64 [m], world frame. Wall segments.
        rng: Parent of one stream per wall, so that the texture of a wall is independent of the other walls.
        config: Style and resolution.

    Raises:
        ValueError: If `config.images` is not a folder with images.
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
    """Check that textures match walls (S, 4) [m], since kernels index them unchecked.

    Raises:
        ValueError: If a shape, dtype or offset is wrong.
    """
    hint = "Pass what draw_textures returned for the same walls."
    faces = 2 * len(walls)
    columns = check_array("textures.columns", textures.columns, (faces,), hint, dtype=np.int64)
    starts = check_array("textures.starts", textures.starts, (faces,), hint, dtype=np.int64)
    check_array("textures.widths", textures.widths, (faces,), hint)
    sums = textures.sums
    ends = np.cumsum(columns + 1) if columns.min() > 0 and columns.max() < len(sums) else np.zeros(faces, np.int64)
    kinds = [array.dtype.str for array in (textures.starts, textures.columns, sums)] == ["<i8", "<i8", "<i4"]
    rows = max(1, round((textures.config.ceiling - textures.config.floor) / textures.config.texel))
    if not kinds or sums.shape != (ends[-1], rows + 1) or starts[0] != 0 or (starts[1:] != ends[:-1]).any():
        raise argument_error("textures", "a texture for each face of each wall", f"shape {sums.shape}", hint)


def load_photographs(folder: str | Path, rows: int) -> list[Image]:
    """Read the images of a folder in grey levels, scaled to a height of `rows` texels.

    Raises:
        ValueError: If the folder contains no images, or a damaged one.
    """
    files = sorted(file for file in Path(folder).glob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    photographs = []
    for file in files:
        image = read_grey_image(file, "textures.images")
        size = max(1, image.shape[1] * rows // image.shape[0]), rows
        photographs.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    if not photographs:
        raise argument_error("textures.images", "a folder with images", Path(folder), "Give PNG or JPEG files.")
    return photographs


def _photographed(columns: int, photographs: list[Image], rng: np.random.Generator) -> Image:
    """Cover a face with photographs side by side, the first one from a random column."""
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
        # The field has a random offset, and cells are exactly `size` wide.
        scale = texel / size
        matrix = np.array([[scale, 0.0, rng.random()], [0.0, scale, rng.random()]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        total += height * cv2.warpAffine(coarse, matrix, (columns, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(total)


def _paint_polygon(picture: Image, size: float, rng: np.random.Generator) -> None:
    """Paint a polygon of 3 to 6 corners and about `size` texels at a random position."""
    rows, columns = picture.shape
    count = int(rng.integers(3, 7))
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    radii = 0.5 * size * rng.uniform(0.6, 1.2, count)
    centre = rng.uniform(0.0, [columns, rows])
    corners = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    level = float(rng.uniform(*LEVELS))
    cv2.fillPoly(picture, [np.rint(16.0 * corners).astype(np.int32)], level, cv2.LINE_AA, 4)


def _poster(size: int, rng: np.random.Generator) -> Image:
    """Return a poster (size, size) with a frame and twelve polygons."""
    poster = np.full((size, size), round(rng.uniform(*LEVELS)), dtype=np.uint8)
    for _ in range(12):
        _paint_polygon(poster, rng.uniform(0.15, 0.5) * size, rng)
    edge = max(1, size // 30)
    cv2.rectangle(poster, (0, 0), (size - 1, size - 1), float(rng.uniform(*LEVELS)), edge)
    return poster


def _lay(picture: Image, patch: Image, left: int, top: int) -> None:
    """Paste a patch into the picture, clipped to its bounds."""
    x0, y0 = max(0, left), max(0, top)
    x1, y1 = min(picture.shape[1], left + patch.shape[1]), min(picture.shape[0], top + patch.shape[0])
    if x0 < x1 and y0 < y1:
        picture[y0:y1, x0:x1] = patch[y0 - top : y1 - top, x0 - left : x1 - left]


def _bricks(rows: int, columns: int, texel: float, jitter: float, rng: np.random.Generator) -> Image:
    """Return courses of bricks with joints; `jitter` 0: equal bricks, 1: individual edges and grey levels."""
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
