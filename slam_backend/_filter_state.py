"""All that a filter holds, from the particles to the random stream: begun, changed as a whole, written down, kept."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from slam_backend._existence_step import ExistenceStep
from slam_backend._filter_arrays import FilterArrays
from slam_backend._filter_checks import KEPT, POSES, check_filter, last_step
from slam_backend._journal import Journal
from slam_backend._kernels import add_share
from slam_backend._kernels.layout import CAMERA, RECOVERY
from slam_backend._mixtures import pose_mixtures
from slam_backend._particle_maps import ParticleMaps
from slam_backend._rejuvenated_maps import write_maps
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend.consistency import ConsistencyTest
from slam_backend.errors import IntArray, bad_argument, check_int, check_seed
from slam_backend.filter_options import MOST_ROBOTS, FilterOptions, assumed, spans_of
from slam_backend.reports import PoseEstimates
from slam_backend.run_log import RobotLog
from slam_backend.smoothing.rejuvenation import Particles
from slam_backend.state_checks import CURE, generator_of, refusing


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
        for name in (*POSES, "_blind"):
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
