"""Readings of the robots in one tick: the only inputs of beliefs and observations."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_array
from slam_backend.models.measurements import Measurements, TeamMeasurements


@short_repr
class Readings(NamedTuple):
    """Readings of one robot's sensors and radio in one tick.

    Attributes:
        odometry: (3,) float64 [m, m, rad], previous robot frame. Motion since the last tick; None at a reset.
        measurements: Measured landmarks.
        scan: (R,) float64 [m]. Ranges along the rays of the range finder.
        bump: Whether an obstacle blocked the commanded motion.
        pose: (3,) float64 [m, m, rad], own start frame. The true pose if `oracle_pose` is on, else None.
        identities: (n,) int64. The true landmark of each measurement, -1 for a false point, if
            `oracle_association` is on, else None.
        contacts: (K,) bool. Robots in contact, itself included; None: always all.
        image: (H, W) uint8. The left image, if `observe_images` is on, else None.
        goal: (2,) float64 [m], own start frame. Goal to which the robot drives, NaN if it stays; None without `goal`
            actions. Robots of its group receive it while in contact.
    """

    odometry: FloatArray | None
    measurements: Measurements
    scan: FloatArray
    bump: bool
    pose: FloatArray | None = None
    identities: IntArray | None = None
    contacts: BoolArray | None = None
    image: NDArray[np.uint8] | None = None
    goal: FloatArray | None = None


@short_repr
class TeamReadings(NamedTuple):
    """`Readings` of all K robots in one tick, stacked by kind.

    Receivers may keep the arrays, so they must not be written to afterwards.

    Attributes:
        odometry: (K, 3) float64 [m, m, rad], or None at a reset.
        measurements: Measurements of each robot, or of the team in one record.
        scans: (K, R) float64 [m].
        bumps: (K,) bool.
        poses: (K, 3) float64 [m, m, rad], or None.
        identities: True landmarks of each robot's measurements, or None.
        contacts: (K, K) bool, or None.
        images: Left image of each robot, or None.
        goals: (K, 2) float64 [m], or None.
    """

    odometry: FloatArray | None
    measurements: Sequence[Measurements] | TeamMeasurements
    scans: FloatArray
    bumps: BoolArray
    poses: FloatArray | None = None
    identities: Sequence[IntArray] | None = None
    contacts: BoolArray | None = None
    images: Sequence[NDArray[np.uint8]] | None = None
    goals: FloatArray | None = None

    def per_robot(self) -> tuple[Readings, ...]:
        """Return the readings of each robot; writable arrays are copied."""
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
                nothing if self.goals is None else self.goals.copy(),
            )
        )

    @classmethod
    def stack(cls, readings: Sequence[Readings]) -> "TeamReadings":
        """Stack the readings of all K robots.

        Raises:
            ValueError: If robots differ in the kinds of readings or the number of rays, or an array has a wrong shape.
        """
        if not readings:
            raise argument_error("readings", "at least one", readings, "Give the readings of each robot.")
        columns = list(zip(*readings, strict=True))
        for name, column in zip(Readings._fields, columns, strict=True):
            missing = [reading is None for reading in column]
            if any(missing) and not all(missing):
                hint = "Give this reading for all robots or for none."
                raise argument_error(f"readings[{missing.index(True)}].{name}", "an array", None, hint)
        odometry, measurements, scans, bumps, poses, identities, contacts, images, goals = columns
        each = (len(readings),)
        return cls(
            odometry=None if odometry[0] is None else _stacked("odometry", odometry, (3,)),
            measurements=measurements,
            scans=_stacked("scan", scans, np.shape(scans[0]), finite=False),
            bumps=_stacked("bump", bumps, (), np.bool_),
            poses=None if poses[0] is None else _stacked("pose", poses, (3,)),
            identities=None if identities[0] is None else identities,
            contacts=None if contacts[0] is None else _stacked("contacts", contacts, each, dtype=None, finite=False),
            images=None if images[0] is None else images,
            goals=None if goals[0] is None else _stacked("goal", goals, (2,), finite=False),
        )


def _stacked(
    name: str, column: Sequence[Any], shape: tuple[int, ...], dtype: Any = np.float64, finite: bool = True
) -> NDArray[Any]:
    """Stack one kind of reading of all K robots into a new array (K, ...), or raise with the index of the robot.

    See `check_array` for `dtype` and `finite`.
    """
    hint = "Give the readings as returned by env.readings."
    checked = [
        check_array(f"readings[{robot}].{name}", value, shape, hint, dtype=dtype, finite=finite)
        for robot, value in enumerate(column)
    ]
    return np.array(checked)
