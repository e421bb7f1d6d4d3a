"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

Sections 2 and 4 of the paper, with its errata. Robots are taken in turn (Algorithm 1): each moves, matches what it sees
to the map that the robots before it have just updated, weighs the particles and updates the landmarks; then the joint
particles are resampled.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend._journal import tell_refused
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend._step_input import FARTHEST_POSE, check_step
from slam_backend._turns import take_turns
from slam_backend.camera import StereoCamera
from slam_backend.errors import check_array, known_names
from slam_backend.existence import ExistenceModel
from slam_backend.filter_knowledge import FilterKnowledge
from slam_backend.filter_options import FilterOptions
from slam_backend.findings import Findings
from slam_backend.geometry import wrap_angle
from slam_backend.input_log import Seats, StepInput, seats_of
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.reports import RejuvenationReport, StepReport
from slam_backend.resampling import RESAMPLING
from slam_backend.smoothing.options import SmoothingOptions


@known_names
class FastSlam(FilterKnowledge):
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.
        num_particles, camera, motion, proposal, resampling, resample_threshold, position_gate, descriptor_gate,
        dead_zone, dead_radius, recovery_position, recovery_heading, descriptor_sigma, ambiguity,
        new_landmark_density, one_to_one, landmark_noise, existence, rejuvenate_every, smoothing: See
        `FilterOptions`.

    Raises:
        ValueError: If an argument is out of its range; the text names it.

    Example:
        >>> slam = FastSlam(num_particles=7, seed=1)
        >>> frame = Measurements([[0.0, 0.0, 2.0]], [[1.0, 0.0]])
        >>> slam.step([None], [frame]).num_new          # the first frame, at the start pose
        1
        >>> slam.map().means.round(3).tolist()          # two metres ahead: x of the map frame
        [[2.0, 0.0, 0.0]]
    """

    def __init__(
        self,
        num_robots: int = 1,
        num_particles: int = 100,
        camera: StereoCamera | None = None,
        motion: OdometryModel | None = None,
        proposal: Literal["fastslam2", "fastslam1"] = "fastslam2",
        resampling: str = "systematic",
        resample_threshold: float = 0.5,
        position_gate: float = 11.34,
        descriptor_gate: float = 0.45,
        dead_zone: float = 25.0,
        dead_radius: float = 1.0,
        recovery_position: float = 0.5,
        recovery_heading: float = 0.1,
        descriptor_sigma: float = 0.1,
        ambiguity: float = 6.0,
        new_landmark_density: float = 0.01,
        one_to_one: bool = True,
        landmark_noise: float | None = None,
        existence: ExistenceModel | None = None,
        rejuvenate_every: int | None = None,
        smoothing: SmoothingOptions | None = None,
        seed: int | np.random.SeedSequence | np.random.Generator = 0,
        initial_poses: ArrayLike | None = None,
    ) -> None:
        options = FilterOptions(
            num_particles=num_particles,
            camera=StereoCamera() if camera is None else camera,
            motion=OdometryModel() if motion is None else motion,
            proposal=proposal,
            resampling=resampling,
            resample_threshold=resample_threshold,
            position_gate=position_gate,
            descriptor_gate=descriptor_gate,
            dead_zone=dead_zone,
            dead_radius=dead_radius,
            recovery_position=recovery_position,
            recovery_heading=recovery_heading,
            descriptor_sigma=descriptor_sigma,
            ambiguity=ambiguity,
            new_landmark_density=new_landmark_density,
            one_to_one=one_to_one,
            landmark_noise=landmark_noise,
            existence=existence,
            rejuvenate_every=rejuvenate_every,
            smoothing=SmoothingOptions() if smoothing is None else smoothing,
        )
        self._set_up(num_robots, options, seed)
        if initial_poses is not None:
            cure = "Give one pose (x, y, theta) per robot."
            starts = check_array("initial_poses", initial_poses, (num_robots, 3), cure, within=FARTHEST_POSE)
            self._poses[:] = starts[:, :, None]
            self._poses[:, 2] = wrap_angle(self._poses[:, 2])
            self._starts[:] = self._means[:] = self._poses
            self._look_at_starts()
            self._estimates = self._mixtures()

    @classmethod
    def from_options(
        cls, num_robots: int, options: FilterOptions, seed: int | np.random.SeedSequence | np.random.Generator = 0
    ) -> "FastSlam":
        """Build a filter from ready-made options, all robots at the origin of the map frame.

        Args:
            num_robots: K.
            options: What it assumes and how it decides.
            seed: As of the class.

        Raises:
            ValueError: If `num_robots` or `seed` is out of its range.
        """
        self = cls.__new__(cls)
        self._set_up(num_robots, options, seed)
        return self

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None],
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> StepReport:
        """Move the robots, match what they see, weigh, update, and resample if needed.

        Args:
            odometry: Per robot (3,) [m, m, rad], motion since its last step in its previous frame; None: it stood.
            measurements: Per robot its frame, or None.
            identities: Per robot (n_i,) int, the caller's own names of the landmarks measured, -1 for a measurement to
                be rejected; association then follows these names. None: association by gates and descriptors.
            poses: Per robot (3,) [m, m, rad], its pose in its own start frame, taken as exact; odometry is ignored.

        Returns:
            What was matched and created.

        Raises:
            ValueError: If an argument is ill-formed; the filter is then as before.
        """
        count, size = self.num_robots, self.descriptor_size
        inputs = check_step(count, size, self.options.camera, odometry, measurements, identities, poses)
        findings = Findings.none_yet(inputs)
        report = self._step_checked(inputs, seats_of(tuple(range(count))), findings)
        findings.close()
        return report

    def _step_checked(self, inputs: StepInput, seats: Seats, findings: Findings) -> StepReport:
        """Do what `step` does with readings that `check_step` returned.

        Args:
            inputs: What these robots, and perhaps others, read; it is not written to.
            seats: Of these robots there.
            findings: Of `inputs`; what becomes of these robots' measurements is written there.
        """
        summary, deserted, used = take_turns(self, inputs, seats, findings.told)
        self._best, long_unseen, created, new, matched, rejected, ess, nis, is_depleted = summary
        report = StepReport(findings, seats.rows, created, new, matched, rejected, ess, nis, is_depleted)
        if used:
            self._consistency.note(self._steps, nis, ess / self.num_particles, used, used - new - matched)
        if rejected and self._rejuvenation is not None:
            tell_refused(self._rejuvenation, self._steps, inputs, seats, findings.told)
        self._steps += 1
        for slots in deserted:
            self._maps.release(slots)
        if is_depleted:
            self._resample()
        if (smoother := self._rejuvenation) is not None:
            smoother.count(new + matched, long_unseen)
            is_busy = self.may_smooth and not smoother.waits(self._steps - 1)
            if is_busy and (news := self._rejuvenate(smoother)) is not None:
                return report._replace(rejuvenation=news)
        return report

    def rejuvenate(self) -> RejuvenationReport:
        """Draw the particles anew from the posterior of whole paths now, whether or not `rejuvenate_every` is set.

        Where it is not, all steps so far are smoothed from the log, and nothing is kept for the next time.

        Returns:
            What came of it; where there is a reason the particles are as before.
        """
        smoother = self._rejuvenation
        if smoother is None:
            smoother = RejuvenationStep(replace(self.options, rejuvenate_every=1), self.num_robots)
        smoother.hasten()
        while (report := self._rejuvenate(smoother)) is None:
            pass
        return report

    @property
    def smooths_in_slices(self) -> bool:
        """Whether the filter keeps a smoother that works in slices, one at a time."""
        return self._rejuvenation is not None and self.options.smoothing.slice_steps is not None

    def hasten(self) -> None:
        """Let the particles be drawn anew as soon as may be, in slices if the smoother works so; see `is_hastened`."""
        if self._rejuvenation is not None:
            self._rejuvenation.hasten()

    @property
    def is_hastened(self) -> bool:
        """Whether `hasten` was called and nothing has come of it yet."""
        return self._rejuvenation is not None and self._rejuvenation.asked

    def _rejuvenate(self, smoother: RejuvenationStep) -> RejuvenationReport | None:
        """Draw the particles anew from the posterior of whole paths, if it is time and that can be found."""
        if smoother.rests(self._logs):
            return None
        starts = self._starts[:, :, : self.num_particles]
        result = smoother.run(
            self._logs, starts, self._maps, self.best_particle, self._camera, self._rng
        )  # fmt: skip
        if result is None:
            return None
        if result.particles is not None:
            self._renew(result.particles)
        return RejuvenationReport(result.reason, result.ess, result.iterations, result.graph.num_keys)

    def _resample(self) -> None:
        """Draw the particles anew in proportion to their weights; all that a particle holds goes with it."""
        ancestors = RESAMPLING[self.options.resampling](self._weights, self._rng, self.num_particles)
        self._best = self._maps.resample(ancestors, self._of_robots, self._of_particles)
