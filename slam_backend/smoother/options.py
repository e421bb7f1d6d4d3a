"""Options of the smoother that rejuvenates a particle filter."""

from dataclasses import dataclass
from typing import ClassVar

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, IntArray, argument_error, check_float, check_int, known_names


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingOptions:
    """Options of a rejuvenation.

    Attributes:
        max_keys: Number of keyframes of one robot beyond which the most rigid neighbours are joined, in a short run.
            Memory grows with the product of keyframes and landmarks in view, effort hardly faster than the keyframes.
        further_keys: Additional keyframes for each further robot of the filter.
        steps_per_key: The number of keyframes grows by one for so many steps of all robots together,
        landmarks_per_key: up to one for so many landmarks: a run in the same place needs no more; see `keyframe_limit`.
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
        least_ess: Share of M that the effective sample size of the importance weights must reach; weights of draws
            that miss it are tempered until they do.
        incremental: Whether a step of the filter does at most one slice of the work. False: all slices are done in the
            step in which a rejuvenation is due.
        slice_share: Number of new steps, of all robots together but at least eight of each, that one slice adds to the
            graph, over the keyframes of the graph: the mean effort per step then does not depend on its size.
        rigid_within: Limit [m] of the odometry's scatter since the last keyframe (root mean square of position and of
            heading at 3 m) up to which a new step is attached to it rigidly; 0: each step with measurements becomes a
            keyframe.
        max_iterations: Maximum number of Gauss-Newton iterations.
        tolerance: Expected decrease of the cost (half a squared distance) below which the descent ends. With slices,
            particles are drawn only where three iterations reach it: below 0.001 that may be late or rare.
    """

    GONE: ClassVar[dict[str, str]] = {
        "slice_steps": "Use incremental=True; slice_share sets the size of the slices.",
        "more_draws": "Weights are tempered instead, see least_ess.",
    }

    max_keys: int = 120
    further_keys: int = 30
    steps_per_key: int = 50
    landmarks_per_key: int = 5
    recent_keys: int = 60
    kernel: float = 16.0
    noise_scale: float = 1.0
    closure_after: int = 100
    effort: float = 1.5
    free_sightings: int = 3000
    least_ess: float = 0.3
    incremental: bool = False
    slice_share: float = 0.5
    rigid_within: float = 0.0
    max_iterations: int = 15
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        check_int("max_keys", self.max_keys, 2, "At least two poses are needed to smooth.", MOST)
        check_int("further_keys", self.further_keys, 0, "Use 0 to share the keyframes of one robot.", MOST)
        check_int("recent_keys", self.recent_keys, 1, "The newest keyframe always keeps its measurements.", MOST)
        check_int("steps_per_key", self.steps_per_key, 1, "Use 50.", MOST)
        check_int("landmarks_per_key", self.landmarks_per_key, 1, "Use 5.", MOST)
        if not isinstance(self.incremental, bool):
            raise argument_error("incremental", "True or False", self.incremental, "Give a bool.")
        check_float("slice_share", self.slice_share, "Use 0.5.", above=0.0)
        check_float("rigid_within", self.rigid_within, "Use 0.01, or 0 for a keyframe at each step.", at_least=0.0)
        check_int("max_iterations", self.max_iterations, 1, "Ten are usually enough.", MOST)
        check_float("effort", self.effort, "Use 1.5; larger values cost more time.", above=0.0)
        check_int("free_sightings", self.free_sightings, 0, "Use 0 to count all sightings.", MOST)
        check_int("closure_after", self.closure_after, 0, "Use 0 to ignore loop closures.", MOST)
        check_float("kernel", self.kernel, "Use 0 for plain least squares.", at_least=0.0)
        check_float("noise_scale", self.noise_scale, "Use 1 to keep the noise unchanged.", above=0.0)
        check_float("tolerance", self.tolerance, "Use 0.1.", above=0.0)
        check_float("least_ess", self.least_ess, "Give a share of M.", at_least=0.0, at_most=1.0)


def keyframe_limit(options: SmoothingOptions, num_landmarks: int, latest: IntArray) -> int:
    """Return the maximum number of keyframes of K robots together.

    Few keyframes for a long way are joined over long distances, and their relative poses, linearised once, claim a
    certainty that they do not have. A run in the same place revisits what its keyframes see.

    Args:
        options: Options of the smoother.
        num_landmarks: Number of landmarks of the graph.
        latest: (K,) int64. Last step of each robot.
    """
    grown = min(int(latest.sum()) // options.steps_per_key, num_landmarks // options.landmarks_per_key)
    return options.max_keys + (len(latest) - 1) * options.further_keys + max(grown, 0)
