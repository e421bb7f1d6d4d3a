"""`Readings`: all that one robot perceives in one tick, and so all that its beliefs and observations can depend on."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.errors import BoolArray, FloatArray, IntArray
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
