"""Node of one robot of a team: it maps, tells the others its map, and finds where they are to it.

    python3 team_node.py --ros-args -r __ns:=/ada -p name:=ada -p state:=/var/tmp/ada.state

The page docs/how-to/ros2.md lists topics and parameters.
"""

import time
from array import array
from dataclasses import fields
from pathlib import Path
from typing import Any

import conversions as ros
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header, UInt8MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from slam_backend import Measurements
from slam_backend.core.files import write_file
from slam_backend.core.validation import FloatArray, argument_error, check_float
from slam_backend.distributed import RobotSlam

SHARED = "/vslam/maps"
QUEUE = 300  # messages: more than a map has parts


class TeamNode(Node):
    """`RobotSlam` over topics, which comes back from its file after it was killed."""

    def __init__(self) -> None:
        super().__init__("vslam_team")
        name, team, state, save_every, period, share_every, attempt_every, seed = ros.parameters(
            self, name="", team="team", state="", save_every=30.0, period=2.0, share_every=50, attempt_every=25, seed=0
        )
        particles, wait, sigma, mount = ros.parameters(self, **ros.SENSING)
        for key, value in (("save_every", save_every), ("period", period)):
            check_float(key, value, "Give seconds.", above=0.0)
        options, self._file = ros.filter_options(mount, particles), Path(state) if state else None
        if self._file is not None and self._file.exists():
            self.robot = RobotSlam.load(self._file, team)
            if self.robot.name != name:
                hint = "Give each robot a file of its own."
                raise argument_error("state", f"the file of {name!r}", f"a file of {self.robot.name!r}", hint)
            self.get_logger().info(f"back from {self._file}, at step {self.robot.filter.next_step}")
        else:
            self.robot = RobotSlam(
                name, team=team, life=time.time_ns(), seed=seed, share_every=share_every, attempt_every=attempt_every,
                **{each.name: getattr(options, each.name) for each in fields(options)},
            )  # fmt: skip
        self._warn = ros.warner(self)
        self._steps = ros.listen(self, self._step, self._warn, wait, sigma, options.camera)
        self._saved = self._resume()  # line of the odometry that fits the file
        ros.guarded(self._warn, self.save)()  # so that it is heard again, even if it is killed before the next time
        self._maps = self.create_publisher(UInt8MultiArray, SHARED, QUEUE)
        self._group_map = self.create_publisher(PointCloud2, "group_map", 1)
        self._group_poses = self.create_publisher(MarkerArray, "group_poses", 1)
        self.create_subscription(UInt8MultiArray, SHARED, ros.guarded(self._warn, self._hear), QUEUE)
        self.create_timer(period, ros.guarded(self._warn, self._show))
        if self._file is not None:
            self.create_timer(save_every, ros.guarded(self._warn, self.save))

    def _step(self, motion: FloatArray | None, frame: Measurements | None) -> None:
        self.robot.step(motion, frame)
        for message in self.robot.outbox():
            self._maps.publish(UInt8MultiArray(data=array("B", message)))
        for event in self.robot.events:
            found = event.alignment
            if event.kind in ("linked", "moved"):
                where = f"x {found.tx:.2f} m, y {found.ty:.2f} m, turn {found.theta:.2f} rad"
                self.get_logger().info(f"{event.kind}: {event.other} at {where}, by {len(found.inliers)} landmarks")
            elif event.kind != "kept":
                self._warn(f"{event.kind}: {event.other}, {found.reason} (docs/reference/metrics.md)")
        self.robot.events.clear()

    def _hear(self, message: Any) -> None:
        refusal = self.robot.receive(bytes(message.data))
        if refusal is not None:
            self._warn(f"message refused: {refusal}")

    def _show(self) -> None:
        """Publish map and poses of the group, in the start frame of this robot."""
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=f"{self.robot.name}/start")
        found, cloud, arrows = self.robot.map(min_count=2), PointCloud2(header=header), MarkerArray()
        ros.write_cloud(found.means, found.descriptors, cloud, PointField)
        poses = self.robot.poses().items()
        ros.write_arrows([(name, 0, pose.mean) for name, pose in poses], arrows, Marker, header)
        self._group_map.publish(cloud)
        self._group_poses.publish(arrows)

    def save(self) -> None:
        """Write the state, and beside it where the odometry was.

        Raises:
            ValueError: If a file cannot be written.
        """
        if self._file is None or self._steps.last is None:
            return
        stamp, pose = self._steps.last
        line = " ".join(map(repr, (self.robot.filter.next_step, stamp, *pose.tolist())))
        write_file(self._odometry_file(), f"{self._saved}\n{line}\n")  # whichever state is there if this is the end
        self.robot.save(self._file)
        self._saved = line

    def _resume(self) -> str:
        """Continue the odometry at the saved step; without it, the robot must stand where it was then."""
        if self._file is None or not self._odometry_file().is_file():
            return ""
        for line in self._odometry_file().read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                step, stamp, *pose = map(float, line.split())
            except ValueError:
                continue
            if step == self.robot.filter.next_step and len(pose) == 3 and np.isfinite([stamp, *pose]).all():
                self._steps.resume(stamp, np.array(pose))
                return line
        self._warn(f"{self._odometry_file()}: not of this state; the robot must stand where it was saved")
        return ""

    def _odometry_file(self) -> Path:
        assert self._file is not None
        return self._file.with_name(self._file.name + ".odom")

    def destroy_node(self) -> None:
        """Save, and end."""
        ros.guarded(self._warn, self.save)()
        super().destroy_node()


if __name__ == "__main__":
    ros.run(TeamNode)
