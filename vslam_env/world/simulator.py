"""The one owner of the pymunk space: robots drive as commanded until walls or other robots stop them."""

from typing import Any

import numpy as np
import pymunk

from slam_backend.core.jit import in_place
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, check_array, check_float
from vslam_env.world.spec import World

LONGEST_SUBSTEP = 12.5e-3  # [m] no robot moves farther between two looks for contacts
SKIN = 9e-3  # [m] contacts begin this far outside the robot, so that the robot itself stays out of walls
SLOP = 1e-3  # [m] depth of contact, inside the skin, that is left alone
CORRECTION = 0.2  # share of a deeper contact that is undone in each substep
STANDING_MASS = 1e6  # [kg] a robot with its brakes on is not pushed away by one of 1 kg
MAX_SPEED = 1e3  # [m/s, rad/s] the way of a tick at a greater speed would be looked through for contacts for minutes
SHORTFALL = 0.01  # share of the commanded way that must be missing for a bump


@in_place
def _drive_freely(
    poses: FloatArray, commands: FloatArray, tick: float, walls: FloatArray, radius: float, goals: FloatArray,
    reach: FloatArray,
) -> bool:  # fmt: skip
    """Write down where robots end after a tick if nothing stops them; tell whether surely nothing can.

    A robot goes along the chord of its arc, so that it ends where the arc does. With a command beyond
    `MAX_SPEED` nothing is clear.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame.
        commands: (K, 2) float64 [m/s, rad/s].
        tick: [s].
        walls: (S, 4) float64 [m], world frame.
        radius: Radius of the robots [m].
        goals: (K, 3) float64 [m, m, rad], world frame. Written to.
        reach: (K,) float64 [m]. Written to: how far from where it was each robot may have come, its body included.
    """
    clear = True
    for k in range(len(poses)):
        turn = commands[k, 1] * tick
        half = 0.5 * turn  # 0 also of the least turn that there is
        chord = commands[k, 0] * tick * (np.sin(half) / half if half != 0.0 else 1.0)
        goals[k, 0] = poses[k, 0] + chord * np.cos(poses[k, 2] + half)
        goals[k, 1] = poses[k, 1] + chord * np.sin(poses[k, 2] + half)
        goals[k, 2] = (poses[k, 2] + turn + np.pi) % (2.0 * np.pi) - np.pi
        reach[k] = radius + abs(chord)
        clear &= abs(commands[k, 0]) <= MAX_SPEED and abs(commands[k, 1]) <= MAX_SPEED  # not so for NaN
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
    """A world with robots in it: discs that follow velocity commands, stop at what they hit and slide along it.

    Nothing but the poses outlives a tick, so they are the whole state. Chipmunk remembers the impulses of contacts and
    the corrections that are due; bodies therefore enter its space only for a tick in which something can touch, and
    wait outside the walls, where it forgets both, for the rest of the time.

    Attributes:
        radius: Radius of the robots [m].
        tick: Duration of a step [s].
        poses: True poses (K, 3) float64 [m, m, rad], world frame, theta in [-pi, pi). Each tick makes both
            arrays anew: earlier arrays stay as they were, and are not to be written to.
        bumped: Which robots (K,) bool something kept from going where they were commanded in the last tick. Read-only.

    Raises:
        ValueError: If a number is out of range or poses are not (K, 3) finite numbers.
    """

    def __init__(self, world: World, start_poses: FloatArray, radius: float = 0.2, tick: float = 0.1) -> None:
        self.radius = check_float("radius", radius, "Give the radius of a robot in metres.", above=0.0)
        self.tick = check_float("tick", tick, "Give seconds.", above=0.0)
        self._walls = world.walls.copy()
        self._space = pymunk.Space()
        self._space.collision_slop = SLOP
        self._space.collision_persistence = 1  # a contact is forgotten in the first substep without it
        ground = self._space.static_body
        self._space.add(*(pymunk.Segment(ground, (a, b), (c, d), 0.0) for a, b, c, d in world.walls.tolist()))
        self._bodies = []
        self.poses = check_array("start_poses", start_poses, (None, 3), "Give one row x y theta for each robot.")
        self._shape = len(self.poses), 2  # of commands
        self._reach = np.empty(len(self.poses))
        _, _, x_max, y_max = world.bounds
        apart = 4.0 * (radius + SKIN)
        self._parking = [(x_max + apart * (2 + robot), y_max + apart) for robot in range(len(self.poses))]
        for place in self._parking:
            body = pymunk.Body(1.0, float("inf"))
            body.position = place
            self._space.add(body, pymunk.Circle(body, radius + SKIN))
            self._bodies.append(body)
        self.bumped = self._nobody = as_read_only(np.zeros(len(self._bodies), dtype=np.bool_))

    def step(self, commands: Any) -> bool:
        """Drive all robots for one tick.

        Args:
            commands: (K, 2) [m/s, rad/s], as numpy can read it. Speed ahead and rate of turn of each robot.

        Returns:
            Whether some robot was near enough to something that it may have bumped into it.

        Raises:
            ValueError: If the shape is wrong, or a number is not finite or beyond `MAX_SPEED`.
        """
        is_array = type(commands) is np.ndarray and commands.dtype == np.float64 and commands.flags.carray
        if not (is_array and commands.shape == self._shape):
            commands = self._checked(commands)
        goals = np.empty((len(self._bodies), 3))
        clear = _drive_freely(self.poses, commands, self.tick, self._walls, self.radius + SKIN, goals, self._reach)
        if clear:
            self.bumped = self._nobody
        else:
            self._checked(commands)  # beyond the fastest nothing is clear
            way = goals[:, :2] - self.poses[:, :2]
            goals[:, :2] = self._move_in_contact(way)
            achieved = np.sum((goals[:, :2] - self.poses[:, :2]) * way, axis=1)
            self.bumped = as_read_only(achieved < (1.0 - SHORTFALL) * np.sum(way * way, axis=1))
        self.poses = goals
        return not clear

    def _checked(self, commands: Any) -> FloatArray:
        """Return commands (K, 2) as `step` needs them, or raise."""
        return check_array("commands", commands, self._shape, "Give (v, omega) for each robot.", within=MAX_SPEED)

    def _move_in_contact(self, way: FloatArray) -> FloatArray:
        """Move the bodies by `way` (K, 2) [m] as far as contacts allow; return their positions (K, 2) [m].

        A step of pymunk moves bodies first and solves contacts afterwards. The first step here starts from rest, with
        the command given as a force: contacts that are there already act before anything moves.
        """
        longest = float(np.hypot(way[:, 0], way[:, 1]).max())
        substeps = max(2, int(np.ceil(longest / LONGEST_SUBSTEP)))
        duration = self.tick / substeps
        for body, (x, y), (dx, dy) in zip(self._bodies, self.poses[:, :2].tolist(), way.tolist(), strict=True):
            body.position = x, y
            body.velocity = 0.0, 0.0
            body.mass = STANDING_MASS if dx == dy == 0.0 else 1.0
            body.force = body.mass * dx / (self.tick * duration), body.mass * dy / (self.tick * duration)
        self._space.collision_bias = (1.0 - CORRECTION) ** (1.0 / duration)  # what pymunk leaves of a depth after 1 s
        for _ in range(substeps + 1):
            self._space.step(duration)
        after = np.array([body.position for body in self._bodies])
        for body, place in zip(self._bodies, self._parking, strict=True):
            body.position = place
        self._space.step(duration)
        return after

    def get_state(self) -> dict[str, Any]:
        """Return all that the next tick depends on; it shares no memory with the simulator."""
        return {"poses": self.poses.copy(), "bumped": self.bumped.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of `get_state`, bit by bit as the simulator would have from which it was taken."""
        robots = len(self._bodies)
        cure = "Give what get_state returned, for the same number of robots."
        self.poses = check_array("state['poses']", state["poses"], (robots, 3), cure)
        self.bumped = as_read_only(check_array("state['bumped']", state["bumped"], (robots,), cure, dtype=np.bool_))
