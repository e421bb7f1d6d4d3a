"""`MergeOptions`: how two groups' filters become one, how sure they must be, and how long the team doubts it."""

import math
from dataclasses import dataclass

from slam_backend.core.validation import MOST, argument_error, check_float, check_int, known_names
from slam_backend.fastslam.options import MAX_PARTICLES


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class MergeOptions:
    """How filters are merged, and when a merge is undone.

    Attributes:
        merged_particles: Of the joint filter; None: as many as the larger of the two.
        smooth_first: Before a merge both sides' particles are drawn anew from the posterior of whole paths
            (`FastSlam.rejuvenate`; over some steps, where smoothers work in slices), and their maps have to align once
            more. False: maps are taken as the filters bent them.
        min_sigmas: An attempt is refused, as long as waiting helps, while so many standard deviations of the motion
            among the particles that the merge would make reach 0.5 m or 5 degrees; 0: never for that.
        min_sigmas_on_trial: Above 0 a pair that is less than `min_sigmas` merges on trial: the joint filter is
            smoothed, and kept if the motion that it has passes twice running; where waiting does not help, so many
            standard deviations of it suffice. 0: there are no trials, and where waiting does not help the pair merges
            however uncertain it is, as is right where nothing would ever tell more about the robots' starts.
        watch_steps: A merge is watched for so many steps in which robots of both sides are in contact, and can be
            undone so long; then its snapshot is freed. 0: merges are final.
        watch_every: In so many steps the evidence is weighed once.
        blocked_steps: After an undo the two sides do not try again for so long.
        max_deformed: A merge is undone if a larger share of the landmarks of either side have left their places among
            each other [-].
    """

    merged_particles: int | None = None
    smooth_first: bool = True
    min_sigmas: float = 5.0
    min_sigmas_on_trial: float = 0.0
    watch_steps: int = 200
    watch_every: int = 20
    blocked_steps: int = 200
    max_deformed: float = 0.2

    def __post_init__(self) -> None:
        if self.merged_particles is not None:
            cure = "Use None for the larger of the two."
            check_int("merging.merged_particles", self.merged_particles, 1, cure, MAX_PARTICLES)
        if not isinstance(self.smooth_first, bool):
            raise argument_error("merging.smooth_first", "True or False", self.smooth_first, "Give a bool.")
        check_float(
            "merging.min_sigmas", self.min_sigmas, "Use 5, or 0 to merge however uncertain it is.", at_least=0.0
        )
        cure = "Use 5, or 0 to merge in the end however uncertain it is."
        check_float("merging.min_sigmas_on_trial", self.min_sigmas_on_trial, cure, at_least=0.0)
        check_int("merging.watch_steps", self.watch_steps, 0, "Use 0 to make merges final.", MOST)
        check_int("merging.watch_every", self.watch_every, 1, "Weigh the evidence at every step or less often.", MOST)
        check_int("merging.blocked_steps", self.blocked_steps, 0, "Use 0 to let them try at once.", MOST)
        check_float("merging.max_deformed", self.max_deformed, "Give a share.", at_least=0.0, at_most=1.0)

    @property
    def max_uncertainty(self) -> float:
        """Uncertainty, 1 = `min_sigmas`, beyond which no pair merges; infinite if any merges in the end."""
        return self.min_sigmas / self.min_sigmas_on_trial if self.min_sigmas_on_trial else math.inf
