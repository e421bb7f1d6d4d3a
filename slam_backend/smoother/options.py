"""Options of the smoother that rejuvenates a particle filter."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, IntArray, check_float, check_int, known_names

MANY_LANDMARKS, LANDMARKS_PER_KEY = 2700, 15  # beyond so many landmarks one more keyframe for every 15,
MANY_STEPS, MANY_ROBOTS, STEPS_PER_KEY = 6000, 3, 50  # beyond so many steps of a robot, or of 3, for every 50,
LEAST_LANDMARKS_PER_KEY = 5  # but at most one for every 5 landmarks: a run in the same place needs no more


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingOptions:
    """Options of a rejuvenation.

    Attributes:
        max_keys: Maximum number of keyframes of one robot; beyond it the most rigid neighbours are joined. Large maps
            and long runs may have more, see `extra_keys`. Memory grows with the product of keyframes and landmarks in
            view, effort hardly faster than the keyframes.
        further_keys: Additional keyframes for each further robot of the filter.
        recent_keys: Newest keyframes, of all robots together, that keep their raw measurements, relinearised at each
            rejuvenation.
        kernel: Squared Mahalanobis distance of a measurement (3 degrees of freedom) above which the robust kernel
            reduces its weight; 0: no kernel.
        noise_scale: Factor on the covariance of all measurements, in the smoother alone.
        closure_after: Steps without a sighting after which three landmarks matched at once count as a loop closure, if
            there was none for half as many steps; the filter is then rejuvenated a fifth of `rejuvenate_every` after
            the last time. 0: no detection of loop closures.
        effort: Factor that bounds the mean effort per step, however long the run: a rejuvenation waits, beyond
            `rejuvenate_every`, until the measurements since the last one times this factor reach the number of
            sightings to process, less `free_sightings`.
        free_sightings: Number of sightings that `effort` does not count.
        least_ess: Share of M that the effective sample size of the importance weights must reach.
        more_draws: Factor on M for a second draw where the first one misses `least_ess` by less than this factor; M of
            these paths are then resampled. 1: no second draw. Where `extra_keys` raises the limit of
            keyframes, weights are tempered until they reach `least_ess` instead.
        slice_steps: New steps, of all robots together but at least eight of each, that one slice adds to the graph;
            twice these where `extra_keys` raises the limit of keyframes. No step of the filter then does more than
            one slice of the work. None: all work in the step in which it is due.
        rigid_within: Limit [m] of the odometry's scatter since the last keyframe (root mean square of position and of
            heading at 3 m) up to which a new step is attached to it rigidly; 0: each step with measurements becomes a
            keyframe.
        max_iterations: Maximum number of Gauss-Newton iterations.
        tolerance: Expected decrease of the cost (half a squared distance) below which the descent ends. With slices,
            particles are drawn only where three iterations reach it: below 0.001 that may be late or rare.
    """

    max_keys: int = 120
    further_keys: int = 30
    recent_keys: int = 60
    kernel: float = 16.0
    noise_scale: float = 1.0
    closure_after: int = 100
    effort: float = 1.5
    free_sightings: int = 3000
    least_ess: float = 0.3
    more_draws: int = 8
    slice_steps: int | None = None
    rigid_within: float = 0.0
    max_iterations: int = 15
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        check_int("max_keys", self.max_keys, 2, "At least two poses are needed to smooth.", MOST)
        check_int("further_keys", self.further_keys, 0, "Use 0 to share the keyframes of one robot.", MOST)
        check_int("recent_keys", self.recent_keys, 1, "The newest keyframe always keeps its measurements.", MOST)
        check_int("more_draws", self.more_draws, 1, "Use 1 to draw M paths only.", MOST)
        if self.slice_steps is not None:
            check_int("slice_steps", self.slice_steps, 1, "Use 90, or None to do all work at once.", MOST)
        check_float("rigid_within", self.rigid_within, "Use 0.01, or 0 for a keyframe at each step.", at_least=0.0)
        check_int("max_iterations", self.max_iterations, 1, "Ten are usually enough.", MOST)
        check_float("effort", self.effort, "Use 1.5; larger values cost more time.", above=0.0)
        check_int("free_sightings", self.free_sightings, 0, "Use 0 to count all sightings.", MOST)
        check_int("closure_after", self.closure_after, 0, "Use 0 to ignore loop closures.", MOST)
        check_float("kernel", self.kernel, "Use 0 for plain least squares.", at_least=0.0)
        check_float("noise_scale", self.noise_scale, "Use 1 to keep the noise unchanged.", above=0.0)
        check_float("tolerance", self.tolerance, "Use 0.1.", above=0.0)
        check_float("least_ess", self.least_ess, "Give a share of M.", at_least=0.0, at_most=1.0)

    def most_keys(self, num_robots: int) -> int:
        """Return the maximum number of keyframes of K robots together, without those of `extra_keys`."""
        return self.max_keys + (num_robots - 1) * self.further_keys


def keyframe_limit(options: SmoothingOptions, num_landmarks: int, latest: IntArray) -> int:
    """Return the maximum number of keyframes of K robots together.

    Args:
        options: Options of the smoother.
        num_landmarks: Number of landmarks of the graph.
        latest: (K,) int64. Last step of each robot.
    """
    return options.most_keys(len(latest)) + extra_keys(num_landmarks, latest)


def extra_keys(num_landmarks: int, latest: IntArray) -> int:
    """Return by how much the limit of keyframes grows in large maps and long runs; bounded where the map is.

    Few keyframes for a long way are joined over long distances, and their relative poses, linearised once, claim a
    certainty that they do not have (docs/lab/scale.md).

    Args:
        num_landmarks, latest: See `keyframe_limit`.
    """
    large = max(num_landmarks - MANY_LANDMARKS, 0) // LANDMARKS_PER_KEY
    steps = max(int(np.maximum(latest - MANY_STEPS, 0).sum()), int(latest.sum()) - MANY_ROBOTS * MANY_STEPS)
    return min(large + steps // STEPS_PER_KEY, num_landmarks // LEAST_LANDMARKS_PER_KEY)
