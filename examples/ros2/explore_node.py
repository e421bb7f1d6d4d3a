"""Node that chooses where to explore next, and publishes the goal for Nav2 and the candidates themselves.

    python3 explore_node.py --ros-args -p policy:=next_best_view -p odom_frame:=odom

The page docs/how-to/ros2.md lists topics and parameters.
"""

from typing import Any

import conversions as ros
import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from agents import make_policy
from agents.plugins import one_line
from slam_backend import Measurements
from slam_backend.core.validation import FloatArray, argument_error, check_float, check_int
from slam_backend.geometry import between, compose, inverse
from vslam_env.belief.readings import TeamReadings
from vslam_env.belief.team_belief import BeliefConfig, RobotHardware, TeamBelief
from vslam_env.navigation import CandidateKind
from vslam_env.sensors.range_finder import ScanConfig

SAME_GOAL = 0.2  # [m] nearer goals are the same


class ExploreNode(Node):
    """Belief of one robot, from odometry, landmarks and the map of any SLAM node, and a policy that chooses goals."""

    def __init__(self) -> None:
        super().__init__("vslam_explore")
        self._policy_name, period, self._map_frame, self._odom_frame, radius, self._repeat, seed = ros.parameters(
            self, policy="next_best_view", period=2.0, map_frame="map", odom_frame="", radius=0.2, repeat=30.0, seed=0
        )
        particles, wait, sigma, mount = ros.parameters(self, **ros.SENSING)
        check_float("period", period, "Give seconds.", above=0.0)
        self._radius = check_float("radius", radius, "Give metres.", above=0.0)
        self._policy = make_policy(self._policy_name, "goal")
        self._rng = np.random.default_rng(check_int("seed", seed, 0, "Give a number."))
        options, scan = ros.filter_options(mount, particles), ScanConfig()
        self._rays = scan.ray_angles, scan.max_range
        body = RobotHardware(radius=self._radius, ray_angles=scan.ray_angles, scan_range=scan.max_range)
        self.team = TeamBelief(BeliefConfig(filter=options), 1, seed, body)
        self._map_from_start: FloatArray | None = None  # None: no step yet
        self._message: Any = None  # the last map, and its content in the start frame
        self._known: Any = None
        self._goal, self._published = np.full(2, np.nan), 0.0  # start frame; time [s]
        if self._odom_frame:
            from tf2_ros import Buffer, TransformListener  # needed here alone

            self._transforms = Buffer()
            self._listener = TransformListener(self._transforms, self)
        self._warn = ros.warner(self)
        self._steps = ros.listen(self, self._step, self._warn, wait, sigma, options.camera)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # as maps are published
        self.create_subscription(OccupancyGrid, "map", ros.guarded(self._warn, self._take_map), latched)
        self._goals = self.create_publisher(PoseStamped, "goal_pose", 1)
        self._candidates = self.create_publisher(MarkerArray, "candidates", 1)
        self.create_timer(period, ros.guarded(self._warn, self._decide))

    def _step(self, motion: FloatArray | None, frame: Measurements | None) -> None:
        """Update the belief. The scan is what the map shows: no range finder is read."""
        assert self._steps.last is not None
        here = compose(self._map_from_odom(), self._steps.last[1])
        if self._map_from_start is None:
            self._map_from_start, motion = here, None
            if self._message is not None:
                self._take_map(self._message)
        guess = compose(self.team.poses[0], np.zeros(3) if motion is None else motion)
        pose = between(self._map_from_start, here) if self._odom_frame else guess
        readings = TeamReadings(
            odometry=None if motion is None else motion[None], measurements=[frame],
            scans=ros.scan_in(self.team.grid(0), pose, *self._rays)[None], bumps=np.zeros(1, np.bool_),
            poses=pose[None] if self._odom_frame else None, goals=self._goal[None],
        )  # fmt: skip
        self.team.step(readings)
        self._enter_map()

    def _map_from_odom(self) -> FloatArray:
        """Return the pose of the odometry's frame in the map, by TF if the parameter odom_frame is given."""
        if not self._odom_frame:
            return np.zeros(3)
        from tf2_ros import TransformException

        try:
            found = self._transforms.lookup_transform(self._map_frame, self._odom_frame, Time()).transform
        except TransformException as error:
            hint = "Start the SLAM node, or set the parameter odom_frame."
            raise argument_error("odom_frame", "its transform to the map", f"no transform: {error}", hint) from error
        return ros.planar_pose(found.translation, found.rotation, "tf")

    def _take_map(self, message: Any) -> None:
        """Read a map, or keep it until the start of the robot in it is known."""
        self._message = message
        if self._map_from_start is not None:
            self._known = ros.grid_of_map(message, self._map_frame, inverse(self._map_from_start)).known
            self._enter_map()

    def _enter_map(self) -> None:
        """Make the grid that of the map, in place of what scans have painted."""
        if self._known is not None:
            self.team.grid(0).known = self._known
            self.team.grid(0).clear_disc(self.team.poses[0], self._radius)

    def _decide(self) -> None:
        """Publish the candidates, and the goal if it is another one."""
        if self._map_from_start is None or self._known is None or not self._known.values.any():
            return
        self.team.keeps_candidates = False  # so that they are found now
        belief, now = self.team.belief(0), self.get_clock().now()
        candidates, header = belief.candidates, Header(stamp=now.to_msg(), frame_id=self._map_frame)
        poses = compose(self._map_from_start, np.column_stack([candidates.goals, candidates.headings]))
        slots = np.flatnonzero(candidates.valid).tolist()
        arrows = [(CandidateKind(int(candidates.kinds[slot])).name.lower(), slot, poses[slot]) for slot in slots]
        shown = MarkerArray()
        ros.write_arrows(arrows, shown, Marker, header)
        self._candidates.publish(shown)
        with one_line(self._policy_name):
            slot = int(self._policy.act({}, belief, self._rng)) - 1
        if slot == -1:
            self._goal = np.full(2, np.nan)
            self._warn("nothing left to go to")
            return
        if slot not in slots:
            raise argument_error("policy", "0 or 1 + the slot of a candidate", slot + 1, "Choose one that is valid.")
        goal, time = candidates.goals[slot], 1e-9 * now.nanoseconds
        if not np.linalg.norm(goal - self._goal) < SAME_GOAL or time - self._published > self._repeat:
            self._goal, self._published = goal.copy(), time
            stamped = PoseStamped(header=header)
            ros.write_pose(poses[slot], stamped.pose)
            self._goals.publish(stamped)


if __name__ == "__main__":
    ros.run(ExploreNode)
