"""`Readings`: all that robots perceive in one tick, and so all that their beliefs and observations can depend on."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_array
from slam_backend.models.measurements import Measurements, TeamMeasurements


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
        contacts: (K,) bool. Which robots its radio hears, itself included; None: all, always.
        image: (H, W) uint8. The left image, if `observe_images` is on, else None.
    """

    odometry: FloatArray | None
    measurements: Measurements
    scan: FloatArray
    bump: bool
    pose: FloatArray | None = None
    identities: IntArray | None = None
    contacts: BoolArray | None = None
    image: NDArray[np.uint8] | None = None


class TeamReadings(NamedTuple):
    """The `Readings` of all K robots in one tick, in one piece each.

    Who takes them in may keep them: nobody is to write to them afterwards.

    Attributes:
        odometry: (K, 3) float64 [m, m, rad], or None at a reset.
        measurements: Per robot, or in one piece.
        scans: (K, R) float64 [m].
        bumps: (K,) bool.
        poses: (K, 3) float64 [m, m, rad], or None.
        identities: Per robot, or None.
        contacts: (K, K) bool, or None.
        images: Per robot, or None.
    """

    odometry: FloatArray | None
    measurements: Sequence[Measurements] | TeamMeasurements
    scans: FloatArray
    bumps: BoolArray
    poses: FloatArray | None = None
    identities: Sequence[IntArray] | None = None
    contacts: BoolArray | None = None
    images: Sequence[NDArray[np.uint8]] | None = None

    def per_robot(self) -> tuple[Readings, ...]:
        """Return what each robot reads; arrays that can be written are copies."""
        frames = self.measurements
        nothing = [None] * len(self.bumps)
        return tuple(
            map(
                Readings,
                nothing if self.odometry is None else self.odometry.copy(),
                frames.per_robot() if isinstance(frames, TeamMeasurements) else frames,
                self.scans.copy(),
                self.bumps.tolist(),
                nothing if self.poses is None else self.poses.copy(),
                nothing if self.identities is None else [names.copy() for names in self.identities],
                nothing if self.contacts is None else self.contacts.copy(),
                nothing if self.images is None else [image.copy() for image in self.images],
            )
        )

    @classmethod
    def stack(cls, readings: Sequence[Readings]) -> "TeamReadings":
        """Return the readings of all K robots as those of a team.

        Raises:
            ValueError: If some robots have a kind of reading that others have not, or scans of another length, or a
                reading is no array of its shape.
        """
        if not readings:
            raise argument_error("readings", "those of each robot", readings, "Give one for each robot.")
        columns = list(zip(*readings, strict=True))
        for name, column in zip(Readings._fields, columns, strict=True):
            missing = [reading is None for reading in column]
            if any(missing) and not all(missing):
                cure = "Give this reading of all robots or of none."
                raise argument_error(f"readings[{missing.index(True)}].{name}", "an array", None, cure)
        odometry, measurements, scans, bumps, poses, identities, heard, images = columns
        each = (len(readings),)
        return cls(
            odometry=None if odometry[0] is None else _stacked("odometry", odometry, (3,)),
            measurements=measurements,
            scans=_stacked("scan", scans, np.shape(scans[0]), finite=False),
            bumps=_stacked("bump", bumps, (), np.bool_),
            poses=None if poses[0] is None else _stacked("pose", poses, (3,)),
            identities=None if identities[0] is None else identities,
            contacts=None if heard[0] is None else _stacked("heard", heard, each, dtype=None, finite=False),
            images=None if images[0] is None else images,
        )


def _stacked(
    name: str, column: Sequence[Any], shape: tuple[int, ...], dtype: Any = np.float64, finite: bool = True
) -> NDArray[Any]:
    """Return one kind of reading of all K robots as one array (K, ...), or raise by name of the robot's that is wrong.

    A fresh array; `dtype`, None for any, and `finite` as `check_array` takes them.
    """
    cure = "Give what env.readings holds of each robot."
    checked = [
        check_array(f"readings[{robot}].{name}", value, shape, cure, dtype=dtype, finite=finite)
        for robot, value in enumerate(column)
    ]
    return np.array(checked)
