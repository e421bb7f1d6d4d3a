"""What the configurations of all replays refuse."""

from slam_backend.core.validation import check_choice, check_float, check_int
from slam_backend.fastslam.options import PROPOSALS

# Steps of a log, as many as ticks in environments. 50 does as well, but for the 51 images of KITTI 06, which then end
# 1.3 % of the path off in place of 1.0: see docs/real_data.md.
REJUVENATE_EVERY = 100


def check_common(particles: int, estimator: str, seed: int, duration: float | None, rejuvenate_every: int) -> None:
    """Refuse what no replay can use.

    Raises:
        ValueError: If a value is out of its range; the text names it.
    """
    check_int("particles", particles, 1, "Use at least one particle; 100 is a good start.")
    check_int("seed", seed, 0, "Use 0 or a positive number.")
    check_choice("estimator", estimator, PROPOSALS)
    if duration is not None:
        check_float("duration", duration, "Give seconds, or leave it away.", above=0.0)
    check_int("rejuvenate_every", rejuvenate_every, 0, "Give a number of steps, or 0 for never.")
