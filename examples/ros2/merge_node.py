"""Node with a service that merges two maps from files, of unknown relative frame, or says why not.

    python3 merge_node.py --ros-args -p map_a:=first.npz -p map_b:=second.npz -p out:=both.npz
    ros2 service call /merge_maps std_srvs/srv/Trigger

The page docs/how-to/ros2.md lists the parameters, which each call reads again.
"""

from pathlib import Path
from typing import Any

import conversions as ros
from rclpy.node import Node
from std_srvs.srv import Trigger

from slam_backend import AlignmentOptions, LandmarkMap, align_maps, fuse_maps
from slam_backend.core.files import check_writable
from slam_backend.core.validation import argument_error
from training.commands.merge import described


class MergeNode(Node):
    """Service `merge_maps`."""

    def __init__(self) -> None:
        super().__init__("vslam_merge")
        ros.parameters(self, map_a="", map_b="", out="merged.npz", min_inliers=8, appearance=True)
        self.create_service(Trigger, "merge_maps", self._merge)

    def _merge(self, request: Any, response: Any) -> Any:
        try:
            response.success, response.message = self._merged()
        except ValueError as error:
            response.success, response.message = False, str(error)
        return response

    def _merged(self) -> tuple[bool, str]:
        """Return whether the maps are merged, and the motion between them or the reason."""
        one, other, out, min_inliers, appearance = (
            self.get_parameter(name).value for name in ("map_a", "map_b", "out", "min_inliers", "appearance")
        )
        if not out.endswith(".npz"):
            raise argument_error("out", "a name that ends in .npz", out, "Maps are written as numpy archives.")
        check_writable(Path(out), "out")
        map_a, map_b = LandmarkMap.load(one), LandmarkMap.load(other)
        found = align_maps(map_a, map_b, options=AlignmentOptions(min_inliers=min_inliers, appearance=appearance))
        text = described(found, map_a, map_b)
        if not found.success:
            return False, text
        merged = fuse_maps(map_a, map_b, found)
        merged.save(out)
        return True, f"{text}\nMap of {len(merged)} landmarks: {out}"


if __name__ == "__main__":
    ros.run(MergeNode)
