"""Options of merges: verification, consistency check and undo."""

from dataclasses import dataclass
from typing import ClassVar

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, argument_error, check_float, check_int, known_names
from slam_backend.fastslam.options import MAX_PARTICLES


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class MergeOptions:
    """Options of merges and of their undo.

    Attributes:
        merged_particles: Number of particles of the joint filter; None: the larger of the two.
        smooth_first: Whether both sides, if they have smoothers, are rejuvenated from the posterior of whole paths
            before a merge (`FastSlam.rejuvenate`; over several steps, if smoothers work in slices), and must align
            again. False: maps are used without smoothing.
        min_sigmas: A merge needs 0.5 m and 5 degrees to be at least this many standard deviations of the motion between
            the maps, by the joint graph of both groups, or by the particles of a merge if they have no smoothers.
            Otherwise the attempt is refused as too uncertain, as long as waiting helps. 0: no such refusal.
        watch_steps: Number of steps, counted with robots of both sides in contact, in which a merge is monitored and
            can be undone; then its snapshot is freed. 0: merges are final.
        watch_every: Steps between two checks of a merge.
        blocked_steps: Steps after an undo before the two sides try again.
        max_deformed: Largest share of the landmarks of each side that may move relative to each other; beyond it a
            merge is undone [-].
    """

    GONE: ClassVar[dict[str, str]] = dict.fromkeys(
        ("min_sigmas_on_trial", "least_sigmas"),
        "Drop it: groups merge with any uncertainty where waiting does not help.",
    )

    merged_particles: int | None = None
    smooth_first: bool = True
    min_sigmas: float = 5.0
    watch_steps: int = 200
    watch_every: int = 20
    blocked_steps: int = 200
    max_deformed: float = 0.2

    def __post_init__(self) -> None:
        if self.merged_particles is not None:
            hint = "Use None for the larger of the two."
            check_int("merging.merged_particles", self.merged_particles, 1, hint, MAX_PARTICLES)
        if not isinstance(self.smooth_first, bool):
            raise argument_error("merging.smooth_first", "True or False", self.smooth_first, "Give a bool.")
        check_float("merging.min_sigmas", self.min_sigmas, "Use 5, or 0 to merge with any uncertainty.", at_least=0.0)
        check_int("merging.watch_steps", self.watch_steps, 0, "Use 0 to make merges final.", MOST)
        check_int("merging.watch_every", self.watch_every, 1, "Give a number of steps, 1 for every step.", MOST)
        check_int("merging.blocked_steps", self.blocked_steps, 0, "Use 0 to let them try at once.", MOST)
        check_float("merging.max_deformed", self.max_deformed, "Give a share.", at_least=0.0, at_most=1.0)
