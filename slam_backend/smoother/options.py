"""`SmoothingOptions`: what decides how a particle filter is rejuvenated."""

from dataclasses import dataclass

from slam_backend.core.validation import MOST, check_float, check_int, known_names


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingOptions:
    """All that decides a rejuvenation.

    Attributes:
        max_keys: Most key poses of one robot; where there are more, the most rigid neighbours become one. Effort grows
            hardly faster, for few keys see the same; memory with its product with the landmarks in view.
        further_keys: So many more for each further robot of the filter.
        recent_keys: Newest keys, of all robots together, that keep their raw measurements, which are linearised anew
            each time.
        kernel: Squared Mahalanobis distance of a measurement (3 degrees of freedom) above which it loses weight; 0:
            none does.
        noise_scale: Factor on the covariance of all measurements, in the smoother alone.
        closure_after: A loop is closed where three landmarks are matched at a time that were not seen for more steps
            than this, and that had not happened for half as many steps; the filter is then rejuvenated a fifth of
            `rejuvenate_every` after the last time. 0: never for that.
        effort: A rejuvenation waits, beyond `rejuvenate_every`, until the measurements read since the last one, times
            this, are as many as the sightings that must be worked through, `free_sightings` apart: the mean effort per
            step is then bounded, however long the run.
        free_sightings: So many cost nothing in this account.
        least_ess: Share of M that the effective sample size of the importance weights must reach.
        more_draws: Where M paths do not reach it, but so many times M may, so many are drawn and M of them chosen by
            their weights; 1: never.
        slice_steps: So many new steps, of all robots together but at least eight of each, are taken in as soon as they
            wait, and no step of the filter does more than one slice of the work, see `slices`; None: all of it is done
            in the step in which it is due.
        rigid_within: [m]. A new step stands rigidly to the key before, as odometry says, while that scatters less over
            the steps between than this (the root of the mean square of position and of heading at 3 m); 0: each step
            that measured something is a key.
        max_iterations: Of Gauss and Newton.
        tolerance: The descent ends when the cost is expected to fall by less than this (half a squared distance). In
            slices particles are drawn only where three iterations reach it: below 0.001 they may come late, or seldom.
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
        check_int("max_keys", self.max_keys, 2, "Two poses are the least that can be smoothed.", MOST)
        check_int("further_keys", self.further_keys, 0, "Use 0 to let all robots share those of one.", MOST)
        check_int("recent_keys", self.recent_keys, 1, "The newest pose is always fresh.", MOST)
        check_int("more_draws", self.more_draws, 1, "Use 1 to draw no more than M.", MOST)
        if self.slice_steps is not None:
            check_int("slice_steps", self.slice_steps, 1, "Use 90, or None for all at once.", MOST)
        check_float("rigid_within", self.rigid_within, "Use 0.01, or 0 for a key at each step.", at_least=0.0)
        check_int("max_iterations", self.max_iterations, 1, "Ten are enough as a rule.", MOST)
        check_float("effort", self.effort, "Use 1.5; more is dearer.", above=0.0)
        check_int("free_sightings", self.free_sightings, 0, "Use 0 to count them all.", MOST)
        check_int("closure_after", self.closure_after, 0, "Use 0 to look for no closures.", MOST)
        check_float("kernel", self.kernel, "Use 0 for plain squares.", at_least=0.0)
        check_float("noise_scale", self.noise_scale, "Use 1 for the noise as it is.", above=0.0)
        check_float("tolerance", self.tolerance, "Use 0.1.", above=0.0)
        check_float("least_ess", self.least_ess, "Give a share of M.", at_least=0.0, at_most=1.0)

    def most_keys(self, num_robots: int) -> int:
        """Return how many key poses the paths of K robots may have together."""
        return self.max_keys + (num_robots - 1) * self.further_keys
