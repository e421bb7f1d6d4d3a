"""Physics simulator: disc robots that follow velocity commands among walls, with contacts solved by pymunk."""

from typing import Any
from weakref import finalize

import numpy as np
import pymunk

from slam_backend.core.jit import in_place
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, check_array, check_float
from slam_backend.state import BOOL, FLOAT64, MAX_DISTANCE, Array, State
from vslam_env.world.spec import World

LONGEST_SUBSTEP = 12.5e-3  # [m] largest motion of a robot between contact checks
SKIN = 9e-3  # [m] margin around a robot at which contacts begin, so that its body stays out of walls
SLOP = 1e-3  # [m] penetration of the skin that is not corrected
CORRECTION = 0.2  # share of a deeper penetration corrected per substep
STANDING_MASS = 1e6  # [kg] a robot at rest is not pushed by a robot of 1 kg
MAX_SPEED = 1e3  # [m/s, rad/s] limits the number of substeps per tick
SHORTFALL = 0.01  # missing share of the commanded motion that counts as a bump


@in_place
def _drive_freely(
    poses: FloatArray, commands: FloatArray, tick: float, walls: FloatArray, radius: float, goals: FloatArray,
    reach: FloatArray,
) -> bool:  # fmt: skip
    """Write the poses after a tick without obstacles; return whether contacts are impossible.

    A robot moves along the chord of its arc, which has the same end. The result is False for a command beyond
    `MAX_SPEED`.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. Current poses.
        commands: (K, 2) float64 [m/s, rad/s]. Velocity commands.
        tick: Duration of a tick [s].
        walls: (S, 4) float64 [m], world frame. Wall segments.
        radius: Radius of the robots [m].
        goals: (K, 3) float64 [m, m, rad], world frame. Output: poses after the tick.
        reach: (K,) float64 [m]. Output: largest distance of each robot's body from its current position.
    """
    clear = True
    for k in range(len(poses)):
        turn = commands[k, 1] * tick
        half = 0.5 * turn  # underflows to 0 for the least turn
        chord = commands[k, 0] * tick * (np.sin(half) / half if half != 0.0 else 1.0)
        goals[k, 0] = poses[k, 0] + chord * np.cos(poses[k, 2] + half)
        goals[k, 1] = poses[k, 1] + chord * np.sin(poses[k, 2] + half)
        goals[k, 2] = (poses[k, 2] + turn + np.pi) % (2.0 * np.pi) - np.pi
        reach[k] = radius + abs(chord)
        clear &= abs(commands[k, 0]) <= MAX_SPEED and abs(commands[k, 1]) <= MAX_SPEED  # False for NaN
    for k in range(len(poses)):
        for i in range(len(walls)):
            ex, ey = walls[i, 2] - walls[i, 0], walls[i, 3] - walls[i, 1]
            px, py = poses[k, 0] - walls[i, 0], poses[k, 1] - walls[i, 1]
            u = min(1.0, max(0.0, (px * ex + py * ey) / (ex * ex + ey * ey)))
            clear &= (px - u * ex) ** 2 + (py - u * ey) ** 2 > reach[k] ** 2
        for j in range(k):
            gap = (poses[k, 0] - poses[j, 0]) ** 2 + (poses[k, 1] - poses[j, 1]) ** 2
            clear &= gap > (reach[k] + reach[j]) ** 2
    return clear


class Simulator:
    """World with disc robots that follow velocity commands and stop at, or slide along, obstacles.

    The poses are the whole state between ticks. Chipmunk caches contact impulses and pending corrections; bodies
    therefore enter its space only in ticks with possible contacts and are otherwise parked outside the walls, where
    these caches are cleared.

    Attributes:
        radius: Radius of the robots [m].
        tick: Duration of a step [s].
        poses: (K, 3) float64 [m, m, rad], world frame, theta in [-pi, pi). True poses. Each tick makes new arrays;
            callers must not write to them.
        bumped: (K,) bool, read-only. True for robots whose commanded motion was blocked in the last tick.

    Raises:
        ValueError: If a number is out of range or poses are not (K, 3) finite numbers.
    """

    STATE = State(
        poses=Array(FLOAT64, "K 3", -MAX_DISTANCE, MAX_DISTANCE, renewed=True), bumped=Array(BOOL, "K", constant=True)
    )

    def __init__(self, world: World, start_poses: FloatArray, radius: float = 0.2, tick: float = 0.1) -> None:
        self.radius = check_float("radius", radius, "Give the radius of a robot in metres.", above=0.0)
        self.tick = check_float("tick", tick, "Give seconds.", above=0.0)
        self._walls = world.walls.copy()
        self.poses = check_array("start_poses", start_poses, (None, 3), "Give one row x y theta for each robot.")
        self._shape = len(self.poses), 2  # shape of commands
        self._reach = np.empty(len(self.poses))
        _, _, x_max, y_max = world.bounds
        spacing = 4.0 * (radius + SKIN)
        parking = [(x_max + spacing * (2 + robot), y_max + spacing) for robot in range(len(self.poses))]
        self._contacts = _ContactSpace()
        # Also when Python ends: pymunk's objects call Python when they are freed, which crashes after its end.
        finalize(self, self._contacts.close)
        self._contacts.build(self._walls, parking, radius + SKIN, self.tick)
        self.bumped = self._no_bumps = as_read_only(np.zeros(len(self.poses), dtype=np.bool_))

    def step(self, commands: Any) -> bool:
        """Drive all robots for one tick.

        Args:
            commands: (K, 2) [m/s, rad/s], array-like. Forward speed and turn rate of each robot.

        Returns:
            Whether contacts were possible for some robot.

        Raises:
            ValueError: If the shape is wrong, or a number is not finite or beyond `MAX_SPEED`.
        """
        is_array = type(commands) is np.ndarray and commands.dtype == np.float64 and commands.flags.carray
        if not (is_array and commands.shape == self._shape):
            commands = self._checked(commands)
        goals = np.empty((len(self.poses), 3))
        clear = _drive_freely(self.poses, commands, self.tick, self._walls, self.radius + SKIN, goals, self._reach)
        if clear:
            self.bumped = self._no_bumps
        else:
            self._checked(commands)  # commands beyond MAX_SPEED are never clear
            motion = goals[:, :2] - self.poses[:, :2]
            goals[:, :2] = self._contacts.move(self.poses[:, :2], motion)
            achieved = np.sum((goals[:, :2] - self.poses[:, :2]) * motion, axis=1)
            self.bumped = as_read_only(achieved < (1.0 - SHORTFALL) * np.sum(motion * motion, axis=1))
        self.poses = goals
        return not clear

    def _checked(self, commands: Any) -> FloatArray:
        """Return validated commands (K, 2), or raise."""
        return check_array("commands", commands, self._shape, "Give (v, omega) for each robot.", within=MAX_SPEED)


class _ContactSpace:
    """Chipmunk space with the walls and the bodies of the robots."""

    def __init__(self) -> None:
        self._space: pymunk.Space | None = pymunk.Space()
        self._bodies: list[pymunk.Body] = []
        self._parking: list[tuple[float, float]] = []

    def build(self, walls: FloatArray, parking: list[tuple[float, float]], radius: float, tick: float) -> None:
        """Add walls (S, 4) [m], and bodies of a radius [m], each at its place [m] outside the walls."""
        space = self._open_space()
        space.collision_slop = SLOP
        space.collision_persistence = 1  # contacts are dropped in the first substep without them
        ground = space.static_body
        space.add(*(pymunk.Segment(ground, (a, b), (c, d), 0.0) for a, b, c, d in walls.tolist()))
        self._parking, self._tick = parking, tick
        for place in parking:
            body = pymunk.Body(1.0, float("inf"))
            body.position = place
            space.add(body, pymunk.Circle(body, radius))
            self._bodies.append(body)

    def move(self, places: FloatArray, motion: FloatArray) -> FloatArray:
        """Move the bodies from their places by `motion` (K, 2) [m] as far as contacts allow; return their places.

        pymunk moves bodies before it solves contacts. The first step therefore starts from rest, with the command
        applied as a force, so that existing contacts act before any motion.
        """
        space = self._open_space()
        longest = float(np.hypot(motion[:, 0], motion[:, 1]).max())
        substeps = max(2, int(np.ceil(longest / LONGEST_SUBSTEP)))
        duration = self._tick / substeps
        for body, (x, y), (dx, dy) in zip(self._bodies, places.tolist(), motion.tolist(), strict=True):
            body.position = x, y
            body.velocity = 0.0, 0.0
            body.mass = STANDING_MASS if dx == dy == 0.0 else 1.0
            body.force = body.mass * dx / (self._tick * duration), body.mass * dy / (self._tick * duration)
        space.collision_bias = (1.0 - CORRECTION) ** (1.0 / duration)  # share of a penetration left after 1 s
        for _ in range(substeps + 1):
            space.step(duration)
        after = np.array([body.position for body in self._bodies])
        for body, place in zip(self._bodies, self._parking, strict=True):
            body.position = place
        space.step(duration)
        return after

    def close(self) -> None:
        """Free the space: shapes before the bodies to which they point, and these before their space."""
        space, self._space = self._space, None
        if space is not None:
            space.remove(*space.shapes)
            space.remove(*space.bodies)
            self._bodies.clear()

    def _open_space(self) -> pymunk.Space:
        """Return the space, or raise after `close`."""
        if self._space is None:
            raise RuntimeError("step: expected a running interpreter, got one that ends. Step environments before.")
        return self._space
