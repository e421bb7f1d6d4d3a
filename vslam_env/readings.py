"""`Readings`: all that robots perceive in one tick, and so all that their beliefs and observations can depend on."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument
from slam_backend.measurements import Measurements


class Readings(NamedTuple):
    """What one robot's own sensors say in one tick.

    Attributes:
        odometry: (3,) float64 [m, m, rad], previous robot frame: motion since the last tick; None at a reset.
        measurements: Landmarks that the camera measured.
        scan: (R,) float64 [m]. Ranges along the rays of the range finder.
        bump: Whether something kept the robot from going where it was commanded.
        pose: (3,) float64 [m, m, rad], own start frame. The true pose if `oracle_pose` is on, else None.
        identities: (n,) int64. The true landmark behind each measurement, -1 for a false point, if
            `oracle_association` is on, else None.
        heard: (K,) bool. Which robots its radio hears, itself included; None: all, always.
        image: (H, W) uint8. The left image, if `observe_images` is on, else None.
    """

    odometry: FloatArray | None
    measurements: Measurements
    scan: FloatArray
    bump: bool
    pose: FloatArray | None = None
    identities: IntArray | None = None
    heard: BoolArray | None = None
    image: NDArray[np.uint8] | None = None


class TeamReadings(NamedTuple):
    """The `Readings` of all K robots in one tick, in one piece each.

    Who takes them in may keep them: nobody is to write to them afterwards.

    Attributes:
        odometry: (K, 3) float64 [m, m, rad], or None at a reset.
        measurements: Per robot.
        scans: (K, R) float64 [m].
        bumps: (K,) bool.
        poses: (K, 3) float64 [m, m, rad], or None.
        identities: Per robot, or None.
        heard: (K, K) bool, or None.
        images: Per robot, or None.
    """

    odometry: FloatArray | None
    measurements: Sequence[Measurements]
    scans: FloatArray
    bumps: BoolArray
    poses: FloatArray | None = None
    identities: Sequence[IntArray] | None = None
    heard: BoolArray | None = None
    images: Sequence[NDArray[np.uint8]] | None = None

    def of_each(self) -> tuple[Readings, ...]:
        """Return what each robot reads; arrays that can be written are copies."""
        nothing = [None] * len(self.measurements)
        return tuple(
            map(
                Readings,
                nothing if self.odometry is None else self.odometry.copy(),
                self.measurements,
                self.scans.copy(),
                self.bumps.tolist(),
                nothing if self.poses is None else self.poses.copy(),
                nothing if self.identities is None else [names.copy() for names in self.identities],
                nothing if self.heard is None else self.heard.copy(),
                nothing if self.images is None else [image.copy() for image in self.images],
            )
        )

    @classmethod
    def gathered(cls, readings: "TeamReadings | Sequence[Readings]") -> "TeamReadings":
        """Return the readings of all K robots as those of a team; such that are so already as they are.

        Raises:
            ValueError: If some robots have a kind of reading that others have not, or scans of another length.
        """
        if isinstance(readings, TeamReadings):
            return readings
        if not readings:
            raise bad_argument("readings", "those of each robot", readings, "Give one for each robot.")
        columns = list(zip(*readings, strict=True))
        for name, column in zip(Readings._fields, columns, strict=True):
            missing = [reading is None for reading in column]
            if any(missing) and not all(missing):
                cure = "Give this reading of all robots or of none."
                raise bad_argument(f"readings[{missing.index(True)}].{name}", "an array", None, cure)
        odometry, measurements, scans, bumps, poses, identities, heard, images = columns
        for robot, scan in enumerate(scans):
            if np.shape(scan) != np.shape(scans[0]):
                name, expected = f"readings[{robot}].scan", f"an array of shape {np.shape(scans[0])}"
                raise bad_argument(name, expected, f"shape {np.shape(scan)}", "Give a range for each ray.")
        return cls(
            odometry=None if odometry[0] is None else np.array(odometry, np.float64),
            measurements=measurements,
            scans=np.array(scans, np.float64),
            bumps=np.array(bumps, np.bool_),
            poses=None if poses[0] is None else np.array(poses, np.float64),
            identities=None if identities[0] is None else identities,
            heard=None if heard[0] is None else np.array(heard, np.bool_),
            images=None if images[0] is None else images,
        )
