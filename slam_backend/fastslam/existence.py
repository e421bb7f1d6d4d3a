"""Existence of landmarks: log-odds that grow with detections and fall with missed ones.

The use of missed detections follows Montemerlo and Thrun (2003), "Simultaneous Localization and Mapping with Unknown
Data Association Using FastSLAM", IEEE Int. Conf. on Robotics and Automation: each landmark of each particle has the
log-odds of its existence, a binary Bayes filter with one constant for a detection and one for a miss. Here the
constants follow from a detection model: with P(detection | it exists and is expected in view) = d and P(false match |
it does not exist) = f,

    detection: + log(d / f)         miss: + log((1 - d) / (1 - f)).

The log-odds are capped, so that a landmark with a thousand detections can still be deleted. The filter's loops over
landmarks and particles are in `fastslam/_kernels/update/existence.py`.
"""

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, FloatArray, IntArray, argument_error, check_float, check_int, known_names
from slam_backend.fastslam._kernels.records import ViewBounds, Viewpoint
from slam_backend.fastslam._kernels.update import existence as kernels
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.models.camera import StereoCamera


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class ExistenceModel:
    """Detection model of landmarks, and the rule that deletes them.

    Attributes:
        detection: d. Share of frames in which a true landmark that is expected in view is matched. Unmodelled causes of
            misses (walls, other robots, rejected measurements) lower it; too high a value deletes good landmarks.
        false_alarm: f. Share of frames in which a measurement is matched to a landmark that does not exist.
        prior: Probability that a landmark exists after its first measurement.
        delete_below: Probability below which a landmark is deleted.
        cap: Upper limit of the probability.
        margin_px: Distance to the border of the image within which landmarks are not expected in view [px].
        range_share: Share of the camera's largest range beyond which landmarks are not expected in view.
        nearest: Depth below which landmarks are not expected in view [m]: a stereo pair does not see them.
        frame_limit: Largest number of measurements that the sensor reports in a frame; None: no limit. Of E landmarks
            expected in view, each is then detected with probability d min(1, limit / E).
    """

    detection: float = 0.8
    false_alarm: float = 0.05
    prior: float = 0.5
    delete_below: float = 0.01
    cap: float = 0.999
    margin_px: float = 8.0
    range_share: float = 0.9
    nearest: float = 0.3
    frame_limit: int | None = None

    def __post_init__(self) -> None:
        for name in ("detection", "false_alarm", "prior", "delete_below", "cap"):
            value = check_float(f"existence.{name}", getattr(self, name), "Give a probability.", above=0.0)
            if value >= 1.0:
                raise argument_error(f"existence.{name}", "a number < 1", value, "Nothing is certain.")
        ascending = (("false_alarm", "detection"), ("delete_below", "prior"), ("prior", "cap"))
        for lower, upper in ascending:
            if getattr(self, lower) >= getattr(self, upper):
                expected = f"a number > {lower} ({getattr(self, lower):g})"
                raise argument_error(f"existence.{upper}", expected, getattr(self, upper), "Check which is which.")
        check_float("existence.margin_px", self.margin_px, "Use 0 for the whole image.", at_least=0.0)
        check_float("existence.range_share", self.range_share, "Use 1 for the whole range.", above=0.0, at_most=1.0)
        check_float("existence.nearest", self.nearest, "Use 0 for all points ahead.", at_least=0.0)
        if self.frame_limit is not None:
            check_int("existence.frame_limit", self.frame_limit, 1, "Use None for a sensor without a limit.", MOST)

    @property
    def log_odds_prior(self) -> float:
        """Log-odds of a new landmark."""
        return _log_odds(self.prior)

    @property
    def log_odds_floor(self) -> float:
        """Log-odds below which a landmark is deleted."""
        return _log_odds(self.delete_below)

    @property
    def log_odds_cap(self) -> float:
        """Upper limit of the log-odds."""
        return _log_odds(self.cap)

    def increments(self, expected: int = 1) -> tuple[float, float]:
        """Return the log-odds increments of a detection and a miss, in a frame with `expected` landmarks in view.

        A detected landmark gets the first, expected or not: an unexpected detection is stronger evidence, not weaker.
        An expected landmark without detection gets the second; all others keep their log-odds.
        >>> sighting, miss = ExistenceModel(detection=0.9, false_alarm=0.1).increments()
        >>> round(sighting, 3), round(miss, 3)          # log 9 and -log 9
        (2.197, -2.197)
        """
        seen = self.detection
        if self.frame_limit is not None and expected > self.frame_limit:
            # Below the rate of false alarms a detection would count against the landmark.
            seen = max(seen * self.frame_limit / expected, self.false_alarm)
        return log(seen / self.false_alarm), log((1.0 - seen) / (1.0 - self.false_alarm))

    def view(self, camera: StereoCamera) -> "FieldOfView":
        """Return the part of a camera's field of view in which landmarks are expected.

        Raises:
            ValueError: If the margins cover the image, or the range ends before `nearest`.
        """
        side, rise = 0.5 * camera.width - self.margin_px, 0.5 * camera.height - self.margin_px
        if min(side, rise) <= 0.0:
            expected = f"a number < {0.5 * min(camera.width, camera.height):g}, half of the image"
            raise argument_error("existence.margin_px", expected, self.margin_px, "Leave some of the image.")
        reach = self.range_share * camera.max_range
        if reach <= self.nearest:
            hint = "Leave some of the range."
            raise argument_error("existence.nearest", f"a number < {reach:g}, the range", self.nearest, hint)
        return FieldOfView(self.nearest, side / camera.focal_px, rise / camera.focal_px, reach * reach)


class FieldOfView(ViewBounds):
    """Where landmarks are expected to be seen: bounds relative to a camera."""


def _log_odds(probability: float) -> float:
    """Return log p / (1 - p) of a probability in (0, 1)."""
    return log(probability / (1.0 - probability))


class ExistenceUpdate:
    """Existence model combined with a camera.

    Args:
        model: Detection model and deletion rule.
        camera: Camera of the filter.
    """

    def __init__(self, model: ExistenceModel, camera: StereoCamera) -> None:
        self._model = model
        self._view = model.view(camera)
        self._mount = np.array(camera.mount)
        self._bounds = (model.log_odds_floor, model.log_odds_cap)
        self._near = 2.0 * float(np.sqrt(self._view.reach_squared))

    def update(
        self, maps: ParticleMaps, poses: FloatArray, best: int, found: NDArray[np.int32], new_slots: IntArray
    ) -> IntArray:
        """Update the log-odds after one robot's frame, which may be empty; particles delete improbable landmarks.

        Args:
            maps: Maps of all particles, changed; landmarks that the frame started begin at the prior.
            poses: (3, P) [m, m, rad], map frame. Sampled poses of the robot.
            best: Index of the most probable particle before the step; its landmarks near the robot are considered.
            found: (n, P) slot matched by each particle to each measurement of the frame, -1 = none.
            new_slots: (n,) slot of the landmark that each measurement started, -1 = none.

        Returns:
            Slots that no particle holds any more, to be released once their ids are no longer needed.
        """
        maps.add_odds(new_slots)
        camera = Viewpoint(poses, np.cos(poses[2]), np.sin(poses[2]), self._mount)
        slots = kernels.landmarks_in_view(
            maps.arrays, maps.num_particles, best, camera, self._view, self._near, found, new_slots
        )
        if not len(slots):
            return slots
        maps.refresh(slots)
        pose = np.ascontiguousarray(poses[:, best])
        expected = kernels.count_expected(slots, maps.arrays, best, pose, self._mount, self._view)
        increments = self._model.increments(expected)
        return kernels.update_existence(slots, found, maps.arrays, camera, self._view, *increments, *self._bounds)
