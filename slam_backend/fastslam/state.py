"""State of `FastSlam`: poses, weights, maps, logs and the random stream, changed as a whole and snapshotted."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core.state_checks import CURE, generator_of, refusing
from slam_backend.core.validation import FloatArray, Int32Array, IntArray, bad_argument, check_int, check_seed
from slam_backend.fastslam._kernels import add_share
from slam_backend.fastslam._kernels.layout import (
    ASSOCIATED,
    CAMERA,
    COVARIANCES,
    LOG_WEIGHTS,
    MEANS,
    NUM_MEASURED,
    NUM_NOTED,
    PATH_LOG_WEIGHTS,
    POSES,
    RECOVERY,
    STARTS,
    WEIGHTS,
)
from slam_backend.fastslam._kernels.run_log import write_guesses
from slam_backend.fastslam.consistency import ConsistencyTest
from slam_backend.fastslam.estimates import pose_mixtures
from slam_backend.fastslam.existence import ExistenceStep
from slam_backend.fastslam.options import MOST_ROBOTS, FilterOptions, assumed, spans_of
from slam_backend.fastslam.particle_maps import ParticleMaps, aligned_zeros
from slam_backend.fastslam.rejuvenation import RejuvenationStep, write_maps
from slam_backend.fastslam.reports import PoseEstimates
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.fastslam.state_checks import KEPT, POSE_FIELDS, check_filter, last_step
from slam_backend.fastslam.step_input import Seats, StepInput
from slam_backend.smoother.rejuvenation import Particles


class FilterArrays:
    """What K robots and M particles of a filter hold without their maps, in P lanes; those beyond M mean nothing.

    All names but the attributes are views. Poses are in the map frame.

    Attributes:
        num_particles: M.
        _of_robots: (5, K, 3, P) float64. `_poses`, `_starts`, `_means`, and in the last two `_covariances`.
        _of_particles: (4, P) float64. `_log_weights`, `_path_log_weights`, `_weights`, and what a step adds to them.
        _blind: (K,) int64. 1 where N(x^, P^) was propagated since the last sighting, else 0.
        _frame: (3, 3) float64 [m, m, rad]. Covariance of a motion of the whole map that the particles do not show, as
            their frame was held when they were drawn anew; estimates have their share of it.
        _found, _distances: (n, P) int32, float64. Room for what is made of measurements within a step, see
            `update_fastslam2`.
    """

    def _make_arrays(self, num_robots: int, num_particles: int, padded: int) -> None:
        """Begin with all robots at the origin and equal weights."""
        self.num_particles = num_particles
        self._of_robots: FloatArray = aligned_zeros((5, num_robots, 3, padded), np.float64)
        self._of_particles: FloatArray = aligned_zeros((4, padded), np.float64)
        self._log_weights[:] = -np.log(num_particles)
        self._weights[:] = 1.0 / num_particles
        self._blind: IntArray = np.zeros(num_robots, np.int64)
        self._frame: FloatArray = np.zeros((3, 3))
        self._found: Int32Array = np.empty((0, padded), np.int32)
        self._distances: FloatArray = np.empty((0, padded))

    def _make_room_for(self, count: int) -> None:
        """Provide room for what is made of so many measurements, and more."""
        shape = 2 * count, self._found.shape[1]
        self._found, self._distances = np.empty(shape, np.int32), np.empty(shape)

    @property
    def num_robots(self) -> int:
        """K."""
        return int(self._of_robots.shape[1])

    @property
    def _poses(self) -> FloatArray:
        """(K, 3, P) [m, m, rad]. Of each robot (x_t^[m])."""
        return np.asarray(self._of_robots[POSES])

    @property
    def _starts(self) -> FloatArray:
        """(K, 3, P) likewise. Where each robot started; spreads at a merge."""
        return np.asarray(self._of_robots[STARTS])

    @property
    def _means(self) -> FloatArray:
        """(K, 3, P) likewise: with `_covariances` N(x^, P^) of each particle before sampling."""
        return np.asarray(self._of_robots[MEANS])

    @property
    def _covariances(self) -> FloatArray:
        """(K, 6, P) upper triangles."""
        return self._of_robots[COVARIANCES:].reshape(self.num_robots, 6, -1)

    @property
    def _log_weights(self) -> FloatArray:
        """(M,) since the last resampling, normalised."""
        return np.asarray(self._of_particles[LOG_WEIGHTS, : self.num_particles])

    @property
    def _path_log_weights(self) -> FloatArray:
        """(M,) accumulated along the ancestral line (Eq. 12)."""
        return np.asarray(self._of_particles[PATH_LOG_WEIGHTS, : self.num_particles])

    @property
    def _weights(self) -> FloatArray:
        """(M,) as the last step left them, summing to 1."""
        return np.asarray(self._of_particles[WEIGHTS, : self.num_particles])


LONGEST = 32  # steps that wait
ROOM = 16 * LONGEST  # for measurements at first


class Journal:
    """Steps that wait; kernels write into its arrays.

    Args:
        num_robots: K, of the filter.

    Attributes:
        steps: Numbers of the steps, T.
        noted: (`LONGEST`, K, 10) float64. Of each step, of which T are written, and robot; see `_kernels.layout`.
        measured: (>= n, 10) float64. What was measured in all of them, one robot's after the other's.
        num_measured: n.
    """

    __slots__ = ("measured", "noted", "num_measured", "steps")

    def __init__(self, num_robots: int) -> None:
        self.steps: list[int] = []
        self.noted = np.empty((LONGEST, num_robots, NUM_NOTED))
        self.measured = np.empty((ROOM, NUM_MEASURED))
        self.num_measured = 0

    def make_room(self, used: int) -> None:
        """Provide room for so many more measurements."""
        needed = self.num_measured + used
        if needed > len(self.measured):
            wider = np.empty((2 * needed, NUM_MEASURED))
            wider[: self.num_measured] = self.measured[: self.num_measured]
            self.measured = wider

    def clear(self) -> None:
        """Let no step wait any more."""
        self.steps.clear()
        self.num_measured = 0

    def write_down(self, logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
        """Enter what waits into the logs of K robots, and tell the smoother of the filter, if it has one.

        A step in which a robot did nothing and was given no measurement gets no row.
        """
        steps = np.array(self.steps)
        noted, measured = self.noted[: len(steps)], self.measured[: self.num_measured]
        for robot, log in enumerate(logs):
            log.extend(robot, steps, noted, measured)
            if smoother is not None:
                heard, poses = np.empty_like(steps), np.empty((len(steps), 3))
                count, is_placed = write_guesses(robot, steps, noted, heard, poses)
                smoother.note(robot, heard[:count], poses[:count], is_placed)
        self.clear()


def tell_refused(smoother: RejuvenationStep, step: int, inputs: StepInput, seats: Seats, told: IntArray) -> None:
    """Tell the smoother what of a step's measurements, those with names left out, was neither matched nor new."""
    for robot, row in seats.heard:
        _, begin, end, _, named, _ = inputs.turns[row]
        if not named:
            smoother.note_refused(robot, step, told[ASSOCIATED, begin:end], inputs.descriptors[begin:end])


class FilterState(FilterArrays):
    """What a filter of K robots with M particles holds.

    Attributes:
        options: What it assumes and how it decides.
        may_smooth: Whether it may in the next step; filters of a team take turns.
        _from_origin: Whether all robots started at the origin, as in a filter that was never merged.
        _spans: Whose turns are taken in each call; where existence is kept, one by one.
        _best: Index of the largest weight along paths.
        _maps: The landmarks of all particles.
        _estimates: The poses of all robots over all particles; written to in each step.
        _journal: What the last steps came to that the logs do not hold yet.
        _consistency: Whether it errs as little as it claims, as far as its frames tell.
        _steps: Number of the next step.
        _rng: The filter's own random stream.
    """

    def _set_up(self, num_robots: int, options: FilterOptions, seed: Any, num_particles: int | None = None) -> None:
        """Begin with all robots at the origin and no landmarks; with `num_particles` in place of the options' own."""
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.", MOST_ROBOTS)
        m = options.num_particles if num_particles is None else num_particles
        self.options = options
        self.may_smooth = True
        self._rng = np.random.default_rng(check_seed(seed))
        self._assumed = assumed(options)
        self._camera = self._assumed[CAMERA:RECOVERY]
        existence = options.existence
        self._existence = None if existence is None else ExistenceStep(existence, options.camera)
        self._spans = spans_of(k, existence is not None)
        self._rejuvenation = None if options.rejuvenate_every is None else RejuvenationStep(options, k)
        self._maps = ParticleMaps(m, None if existence is None else existence.log_odds_prior)
        self._make_arrays(k, m, self._maps.padded)
        self._from_origin = True
        self._best = 0
        self._steps = 0
        self._robot_logs = [RobotLog() for _ in range(k)]
        self._journal = Journal(k)
        self._consistency = ConsistencyTest()
        self._estimates = self._mixtures()

    @property
    def best_particle(self) -> int:
        """Index of the most probable particle, by accumulated log-weight (Eq. 12)."""
        return self._best

    def _mixtures(self) -> PoseEstimates:
        """Return the robots' poses over all particles, map frame. Fresh arrays."""
        return pose_mixtures(self._means, self._covariances, self._weights)

    def _widen(self) -> None:
        """Give the mixtures of the poses, as the particles show them, their share of what these do not show."""
        if self._frame.any():
            add_share(self._frame, *self._estimates)

    def _look_at_starts(self) -> None:
        """Take note of whether all robots start at the origin of the map frame; asked for when that was written."""
        self._from_origin = not self._starts[:, :, : self.num_particles].any()

    def _look_at_weights(self) -> None:
        """Take note of which particle is the most probable; asked for when the weights along paths were written."""
        self._best = int(self._path_log_weights.argmax())

    # ------------------------------------------------------------------ other particles, other robots

    def _renew(self, new: Particles) -> None:
        """Go on with M particles from smoothed paths; the old ones' most probable says which landmarks there are."""
        m = self.num_particles
        write_maps(self._maps, self.best_particle, new, self.options.landmark_walk)
        self._poses[:, :, :m], self._starts[:, :, :m] = new.poses, new.starts
        self._look_at_starts()
        self._means[:] = self._poses
        self._covariances.fill(0.0)
        self._frame[:] = new.frame
        self._blind.fill(0)
        self._log_weights[:], self._path_log_weights[:] = new.log_weights, new.log_densities
        self._look_at_weights()
        self._weights[:] = np.exp(new.log_weights)
        self._estimates.means[:], self._estimates.covariances[:] = new.means, new.covariances

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`; (K,) a permutation."""
        for name in (*POSE_FIELDS, "_blind"):
            array = getattr(self, name)
            array[:] = array[order]
        self._robot_logs = [self._logs[robot] for robot in order]
        self._estimates = PoseEstimates(*(of_all[order] for of_all in self._estimates))
        if self._rejuvenation is not None:
            self._rejuvenation.reorder(order)

    # ------------------------------------------------------------------ what a step leaves behind

    @property
    def _logs(self) -> list[RobotLog]:
        """Per robot what it did and measured so far, and which landmarks that was taken for."""
        if self._journal.steps:
            self._write_down()
        return self._robot_logs

    def _write_down(self) -> None:
        """Enter into the logs, and tell the smoother, what the steps in the journal came to."""
        self._journal.write_down(self._robot_logs, self._rejuvenation)

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the filter goes on, its random stream included. Shares nothing with it."""
        logs = tuple(log.get_state() for log in self._logs)  # first, for it tells the smoother as well
        state: dict[str, Any] = {name: getattr(self, name).copy() for name in KEPT}
        state |= {"steps": self._steps, "estimates": self._estimates.copy(), "maps": self._maps.get_state()}
        state |= {"logs": logs, "consistency": self._consistency.get_state()}
        if self._rejuvenation is not None:
            state["rejuvenation"] = self._rejuvenation.get_state()
        return state | {"options": self.options, "rng": copy.deepcopy(self._rng.bit_generator.state)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the filter that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`.
        """
        with refusing("state"):
            check_filter("state", state, (self.options,))
        if (last := max(map(last_step, state["logs"]))) >= state["steps"]:
            raise bad_argument("state['steps']", f"an int > {last}, the last step logged", state["steps"], CURE)
        self._go_on_from(state)

    def _go_on_from(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that was checked."""
        shapes = [state[name].shape == getattr(self, name).shape for name in ("_poses", "_weights")]
        same = state["options"] == self.options and all(shapes)
        if not same:
            self._set_up(len(state["_poses"]), state["options"], 0, len(state["_weights"]))
        for name in KEPT:
            getattr(self, name)[:] = state[name]
        self._look_at_starts()
        self._look_at_weights()
        self._maps.set_state(state["maps"])
        self._journal.clear()
        for log, logged in zip(self._robot_logs, state["logs"], strict=True):
            log.set_state(logged)
        if self._rejuvenation is not None:
            self._rejuvenation.set_state(state["rejuvenation"])
        self._consistency.set_state(state["consistency"])
        self._steps, self._estimates = state["steps"], state["estimates"].copy()
        self._rng = generator_of(state["rng"])  # of its own: the old one may be the caller's, or of another kind
