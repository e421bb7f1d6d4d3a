"""The work of a smoother in slices, each of them bounded, so that no step of a filter waits for more than one.

A slice either takes in a few new steps and does two steps of Gauss and Newton; or does two more of these, until the
descent has ended, and then joins surplus keys; or, when all is at its mode, takes in the very last keys, ends the
descent and draws. Between slices there is nothing but a graph, and how damped its next step is.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.log_arrays import REJECTED, LogArrays
from slam_backend.motion import OdometryModel
from slam_backend.smoothing.coarsening import at_mode
from slam_backend.smoothing.extending import Places, extended
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.guesses import Guesses
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.rejuvenation import Looks, Rejuvenation, at_given_poses, drawn, settled
from slam_backend.smoothing.solving import NO_POSE, Mode, find_mode

NEAR = 100.0  # times the tolerance: slices that do not draw need not end a descent that the next one goes on with
STEPS = 2  # of Gauss and Newton in a slice: the second as a rule tells that the first has ended the descent
LAST_STEPS = 3  # of Gauss and Newton in the slice that draws: the graph was at its mode but for the last few keys


class Draft(NamedTuple):
    """A graph in the middle of a descent.

    Attributes:
        graph: Its poses and landmarks are where the descent has got to.
        damping: Of the next step.
        steps: Done so far.
    """

    graph: PathGraph
    damping: float = 0.0
    steps: int = 0


class Smoother(NamedTuple):
    """What all slices need.

    Attributes:
        motion: Noise of the odometry.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: What decides the rest.
        rng: Source of the draws.
    """

    motion: OdometryModel
    camera: FloatArray
    options: SmoothingOptions
    rng: np.random.Generator

    def take_in(
        self, graph: PathGraph, logs: Sequence[LogArrays], guesses: Sequence[Guesses], places: Places
    ) -> PathGraph | Draft | str:
        """Take in all rows of the logs, which are few, and do the first steps.

        Args:
            graph: At its mode.
            logs: Per robot, of the steps after `graph.latest`.
            guesses: Per robot where it may be after some of these steps.
            places: Where the filter holds landmarks to be, see `extended`.

        Returns:
            As of `descend`.
        """
        grown = extended(graph, logs, self.motion, self.camera[4:], guesses, self.options.rigid_within, places)
        return self.descend(Draft(graph=grown))

    def descend(self, draft: Draft) -> PathGraph | Draft | str:
        """Do the next steps of a descent.

        Args:
            draft: How it stands.

        Returns:
            The graph if that ended the descent, how it now stands if not, or what is wrong.
        """
        mode = find_mode(draft.graph, self.camera, self.options, STEPS, draft.damping, NEAR)
        return self._after(draft, mode)

    def draw(
        self,
        graph: PathGraph,
        logs: Sequence[LogArrays],
        guesses: Sequence[Guesses],
        places: Places,
        num_particles: int,
        looks: Looks,
    ) -> Rejuvenation | PathGraph | Draft | str:
        """Take in the logs' last rows, and draw particles, if so few steps end the descent.

        Args:
            graph, logs, guesses, places: As of `take_in`.
            num_particles: M.
            looks: For landmarks that turn out to be one.

        Returns:
            What came of the draws, or else as of `descend`.
        """
        grown = extended(graph, logs, self.motion, self.camera[4:], guesses, self.options.rigid_within, places)
        draft = Draft(graph=grown)
        mode = find_mode(grown, self.camera, self.options, LAST_STEPS)
        if not mode.reason:
            return drawn(grown, mode, self.camera, num_particles, self.rng, self.options, looks)
        if mode.reason == NO_POSE:
            return at_given_poses(grown, self.camera, self.options)
        return self._after(draft, mode)

    def without_measurements(self, graph: PathGraph, logs: Sequence[LogArrays]) -> PathGraph:
        """Return the graph after all rows of the logs, of which only the odometry is believed."""
        blind = [replace(log, ids=np.full_like(log.ids, REJECTED)) for log in logs]
        return extended(graph, blind, self.motion, self.camera[4:], rigid_within=self.options.rigid_within)

    def _after(self, draft: Draft, mode: Mode) -> PathGraph | Draft | str:
        """Return what a step came to, as of `descend`."""
        if not mode.reason:
            return settled(draft.graph, mode, self.camera, self.options, self.rng)
        if mode.reason == NO_POSE:
            return at_given_poses(draft.graph, self.camera, self.options).graph
        steps = draft.steps + mode.iterations
        if not mode.unfinished:
            return mode.reason
        if steps >= self.options.max_iterations:
            return f"no convergence in {steps} iterations"
        return Draft(graph=at_mode(draft.graph, mode), damping=mode.damping, steps=steps)
