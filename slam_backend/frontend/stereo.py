"""Stereo front end: corners, matching along rows and triangulation, from rectified images to `Measurements`.

A match must pass these checks:

1. mutual: each corner is the most similar one near the other's row;
2. patch: the patch around the left corner correlates with the right image after sub-pixel registration;
3. rows: the registered rows agree;
4. back: registration from right to left returns to the left corner;
5. range: the distance of the point is within limits.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import (
    MOST,
    BoolArray,
    Float32Array,
    FloatArray,
    argument_error,
    check_array,
    check_choice,
    check_float,
    check_int,
    known_names,
)
from slam_backend.frontend._matching_kernels import LARGEST_PATCH, match_rows, refine
from slam_backend.frontend.corners import CornerOptions, Corners, find_corners, grid_order
from slam_backend.frontend.descriptors import DESCRIPTOR_TYPES, DESCRIPTORS, describe_points
from slam_backend.frontend.images import Image, check_image
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.state import BOOL, FLOAT32, FLOAT64, Array, Record, with_state

MATCH_CHECKS = ("mutual", "patch", "rows", "back", "range")
LEAST_SCALE, LARGEST_SCALE = 1.0, 8.0  # px; limits for windows of constant physical size
SWAPPED = 12  # points at negative disparity, three times the number at positive, above which images count as swapped


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """Options of the stereo front end.

    Attributes:
        descriptor: "usurf", "sift" or "orb".
        corners: Options of corner detection.
        scale: Scale s of the descriptors for matching between the two images [px].
        window: Side of a descriptor's window [m], the same at any distance; None: 21 `scale` pixels at any distance.
        row_tolerance: Largest difference of the rows of two corners [px].
        patch_half: Half size of a patch, which is 2 `patch_half` + 1 pixels wide.
        iterations: Maximum number of iterations of a patch registration.
        least_correlation: Minimum correlation of two registered patches.
        row_difference: Largest difference of the rows of registered patches [px].
        back_difference: Largest difference between forward and backward registration [px].
        nearest: Smallest distance of reported points [m].
        max_measurements: Maximum number of points, the first ones of `grid_order`. None: all.
    """

    descriptor: Literal["usurf", "sift", "orb"] = "usurf"
    corners: CornerOptions = field(default_factory=CornerOptions)
    scale: float = 2.3
    window: float | None = None
    row_tolerance: float = 1.5
    patch_half: int = 5
    iterations: int = 8
    least_correlation: float = 0.9
    row_difference: float = 0.5
    back_difference: float = 0.3
    nearest: float = 0.4
    max_measurements: int | None = None

    def __post_init__(self) -> None:
        check_choice("front_end.descriptor", self.descriptor, DESCRIPTORS)
        if not isinstance(self.corners, CornerOptions):
            raise argument_error(
                "front_end.corners", "CornerOptions", self.corners, "Build them with CornerOptions(...)."
            )
        for name in ("row_tolerance", "row_difference", "back_difference"):
            check_float(f"front_end.{name}", getattr(self, name), "Give a positive number.", above=0.0)
        check_float("front_end.scale", self.scale, "Give pixels.", at_least=0.1, at_most=100.0)
        check_float("front_end.nearest", self.nearest, "Filters reject points nearer than 5 cm.", at_least=0.06)
        if self.window is not None:
            check_float("front_end.window", self.window, "Give metres, or None.", at_least=1e-6, at_most=1e6)
        half = check_int("front_end.patch_half", self.patch_half, 1, "5 is a good value.")
        if 2 * half + 1 > LARGEST_PATCH:
            expected = f"an int <= {LARGEST_PATCH // 2}"
            raise argument_error("front_end.patch_half", expected, half, "Large patches cover several depths.")
        check_int("front_end.iterations", self.iterations, 1, "8 are enough.", 1000)
        hint = "Give a correlation."
        check_float("front_end.least_correlation", self.least_correlation, hint, at_least=0.0, at_most=1.0)
        if self.max_measurements is not None:
            check_int("front_end.max_measurements", self.max_measurements, 1, "Use None to keep all.", MOST)


@short_repr
@with_state(
    corners=Array(FLOAT64, "n 2", constant=True),
    responses=Array(FLOAT64, "n", constant=True),
    corner_disparity=Array(FLOAT64, "n", constant=True),
    disparity=Array(FLOAT64, "n", -np.inf, np.inf, nan=True, constant=True),
    descriptors=Array(FLOAT32, "n d", constant=True),
    passed=Array(BOOL, "* n", constant=True),
)
class StereoMatches(NamedTuple):
    """Corners of both images matched by descriptor, with the results of all checks.

    Attributes:
        corners: (n, 2) float64 [px]. Corners in the left image.
        responses: (n,) float64 [-]. Harris responses of the left corners.
        corner_disparity: (n,) float64 [px]. Difference of the columns of both corners.
        disparity: (n,) float64 [px]. Disparity by registration of patches; undefined if the check "patch" failed.
        descriptors: (n, d) float32. Descriptors of the left corners, at the scale of matching.
        passed: (5, n) bool. Result of each of `MATCH_CHECKS`, independent of the others.
    """

    corners: FloatArray
    responses: FloatArray
    corner_disparity: FloatArray
    disparity: FloatArray
    descriptors: Float32Array
    passed: BoolArray


@short_repr
@with_state(
    measurements=Record(Measurements),
    pixels=Array(FLOAT64, "n 3", constant=True),
    responses=Array(FLOAT64, "n", constant=True),
    matches=Record(StereoMatches),
)
class StereoFrame(NamedTuple):
    """Measurements of one pair of images.

    Attributes:
        measurements: n points with descriptors, without covariances: the camera model applies at the predicted point.
        pixels: (n, 3) float64 [px]. Column and row in the left image, and disparity; pixel centres are at integers.
        responses: (n,) float64 [-]. Harris responses.
        matches: All matches by descriptor.
    """

    measurements: Measurements
    pixels: FloatArray
    responses: FloatArray
    matches: StereoMatches


class StereoFrontEnd:
    """Stereo front end for rectified pairs of one camera.

    Args:
        camera: Focal length, baseline, size of the images, and the largest distance of reported points.
        options: Options of the front end; None: the defaults.
        centre_px: (2,) [px]. Column and row of the optical axis, pixel centres at integers, the same in both images;
            None: the middle of the image.

    Example:
        >>> front_end = StereoFrontEnd(StereoCamera(width=64, height=48))
        >>> grey = np.full((48, 64), 128, np.uint8)
        >>> len(front_end.measure(grey, grey).measurements)  # no contrast
        0
    """

    def __init__(self, camera: Any, options: FrontEndOptions | None = None, centre_px: Any | None = None) -> None:
        if not isinstance(camera, StereoCamera):
            hint = "Points need a focal length and a baseline: read them with slam_backend.readers.calibration."
            raise argument_error("camera", "a StereoCamera", camera, hint)
        self.camera: StereoCamera = camera
        self.options = FrontEndOptions() if options is None else options
        middle = (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
        centre = check_array("centre_px", middle if centre_px is None else centre_px, (2,), "Give column and row.")
        self._centre: FloatArray = as_read_only(np.append(centre, 0.0))
        self._kind = DESCRIPTOR_TYPES[self.options.descriptor]
        span = camera.focal_px * camera.baseline
        self._least, self._largest = span / camera.max_range, span / self.options.nearest

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors."""
        return self._kind.size

    def measure(self, left: Any, right: Any) -> StereoFrame:
        """Measure a rectified pair.

        Args:
            left: (H, W) uint8, of the camera's size.
            right: (H, W) uint8, of the camera's size.

        Returns:
            Points spread over the image; none for empty or saturated images.

        Raises:
            ValueError: If an image is not an eight-bit grey image of the camera's size, or if the pair is swapped.
        """
        left, right = self._check("left", left), self._check("right", right)
        matches = self.match(left, right)
        kept = np.flatnonzero(matches.passed.all(axis=0))
        if len(kept) < SWAPPED:
            self._check_order(left, right, len(kept))
        order = grid_order(matches.corners[kept], matches.responses[kept], self.options.corners.cell)
        kept = kept[order]
        pixels = np.column_stack([matches.corners[kept], matches.disparity[kept]])
        points = self.camera.triangulate(pixels - self._centre)
        near = np.flatnonzero((points * points).sum(axis=1) <= self.camera.max_range**2)
        near = near[: self.options.max_measurements]
        pixels, points, kept = pixels[near], points[near], kept[near]
        descriptors = matches.descriptors[kept]
        if self.options.window is not None:
            scales = self.options.window * self.camera.focal_px / (21.0 * points[:, 2])
            scales = np.clip(scales, LEAST_SCALE, LARGEST_SCALE)
            descriptors = describe_points(left, pixels[:, :2], scales, self.options.descriptor)
            known = descriptors.any(axis=1)
            pixels, points, descriptors, kept = pixels[known], points[known], descriptors[known], kept[known]
        (frame,) = TeamMeasurements(points, descriptors, np.array([len(points)])).per_robot()
        return StereoFrame(frame, pixels, matches.responses[kept], matches)

    def match(self, left: Image, right: Image) -> StereoMatches:
        """Return all matches by descriptor of the corners of a checked pair."""
        options = self.options
        (ours, described), (theirs, their_descriptors) = (self._describe(image) for image in (left, right))
        partner, mutual, _ = match_rows(
            ours.points,
            theirs.points,
            described,
            their_descriptors,
            options.row_tolerance,
            0.8 * self._least,
            1.2 * self._largest,
            self._kind.stereo_gate**2,
        )
        found = partner >= 0
        corners, others = ours.points[found], theirs.points[partner[found]]
        laid = refine(left, right, corners, others, options.patch_half, options.iterations)
        forward, row_forward, backward, row_backward, *correlations = laid.T
        disparity = 0.5 * (forward + backward)
        return StereoMatches(
            corners=corners,
            responses=ours.responses[found],
            corner_disparity=corners[:, 0] - others[:, 0],
            disparity=disparity,
            descriptors=described[found],
            passed=np.stack(
                [
                    mutual[found],
                    np.minimum(*correlations) >= options.least_correlation,
                    np.abs(0.5 * (row_forward + row_backward)) <= options.row_difference,
                    np.hypot(forward - backward, row_forward - row_backward) <= options.back_difference,
                    (disparity >= self._least) & (disparity <= self._largest),
                ]
            ),
        )

    def _check(self, name: str, image: Any) -> Image:
        """Return the image, or raise unless it has the camera's size."""
        checked = check_image(name, image)
        expected = (self.camera.height, self.camera.width)
        if checked.shape != expected:
            hint = "Rectify it to the camera's size, or correct the camera."
            raise argument_error(name, f"an image of {expected[1]} x {expected[0]} px", f"shape {checked.shape}", hint)
        return checked

    def _check_order(self, left: Image, right: Image, count: int) -> None:
        """Raise if a pair with few matches has many after swapping its images."""
        reverse = int(self.match(right, left).passed.all(axis=0).sum())
        if reverse >= SWAPPED and reverse > 3 * count:
            got = f"a pair with {reverse} points at negative disparities and {count} at positive ones"
            raise argument_error("left, right", "the left image first", got, "Swap the images.")

    def _describe(self, image: Image) -> tuple[Corners, Float32Array]:
        """Return the corners of an image and their descriptors; corners without one are dropped."""
        corners = find_corners(image, self.options.corners)
        scales = np.full(len(corners.points), self.options.scale)
        descriptors = describe_points(image, corners.points, scales, self.options.descriptor)
        known = descriptors.any(axis=1)
        if known.all():
            return corners, descriptors
        return Corners(corners.points[known], corners.responses[known]), descriptors[known]
