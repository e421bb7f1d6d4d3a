"""The configurations of all replays, and where their logs are."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from training.experiments.config import ONE_PARTICLE, Descriptor, ExperimentConfig, Proposal, option, setting, table

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from slam_backend import OdometryModel
    from slam_backend.readers.mrclam import Drive, SightingNoise
    from slam_backend.readers.stereo_files import StereoFiles
    from slam_backend.readers.victoria import TreeNoise
else:
    OdometryModel = table("slam_backend:OdometryModel")
    Drive = table("slam_backend.readers.mrclam:Drive")
    SightingNoise = table("slam_backend.readers.mrclam:SightingNoise")
    TreeNoise = table("slam_backend.readers.victoria:TreeNoise")

# Steps of a log, as many as ticks in environments. 50 does as well, but for the 51 images of KITTI 06, which then end
# 1.3 % of the path off in place of 1.0: see docs/how-to/real_data.md.
REJUVENATE_EVERY = 100
MRCLAM, VICTORIA = Path("mrclam") / "MRCLAM_Dataset7", Path("victoria_park")
KITTI, PAIRS = Path("kitti_landmarks"), Path("euroc_pairs")
NEAREST = 3.0  # [m] nothing of interest is nearer to a car's cameras
Pixels = Annotated[float, Field(gt=0.0)]

# Calibrated on data sets 7 and 4 of MR.CLAM. The odometry is the command. Against the truth of six robots (five of data
# set 7, one of 4) it is followed 0.2 s late, over four seconds at 0.91 to 0.94 of its speed and at 0.94 to 0.98 of its
# turn. What remains between two steps of 0.25 s is 23 to 27 % of the distance, 5 to 7 % of it sideways, and in heading
# up to 0.9 rad/m and 17 % of the turn.
MRCLAM_DRIVE = {"delay": 0.2, "speed": 0.93, "turn": 0.95}
MRCLAM_MOTION = {
    "sigma_along": 0.25, "sigma_across": 0.07, "sigma_heading": 0.7, "sigma_turn": 0.15, "floor_position": 0.001,
    "floor_heading": 0.004,
}  # fmt: skip
# Against the motion that fits the trees of two scans best, a second apart, the odometry of Victoria Park turns 4 % and
# 0.0014 rad/m too little, drifts 2 % sideways, and scatters by 1.5 % of the distance, 0.002 rad/m and the noise of the
# trees. What it gets wrong persists, while a filter draws anew at each step: hence more than that.
VICTORIA_MOTION = {
    "sigma_along": 0.03, "sigma_across": 0.03, "sigma_heading": 0.01, "sigma_turn": 0.1, "floor_position": 0.005,
    "floor_heading": 0.001,
}  # fmt: skip


def log_path(below: Path, help: str = "Folder of the log.") -> Any:
    """Return the field of a log's path, which by default is in the folder of data."""
    return option(..., help, shown=f"{below} in $VSLAM_DATA", is_path=True)


class ReplayConfig(ExperimentConfig):
    """What the replays of all logs have in common."""

    path: str
    duration: float | None = option(
        None, "Seconds to replay.", shown="all", gt=0.0, hint="Give seconds, or leave it away."
    )
    estimator: Proposal = option("fastslam2", "fastslam2 or fastslam1.")
    rejuvenate_every: int = option(
        REJUVENATE_EVERY, "Steps after which particles are redrawn from smoothed paths; 0: never.", ge=0,
        hint="Give a number of steps, or 0 for never.",
    )  # fmt: skip


class MrclamConfig(ReplayConfig):
    """The replay of an MR.CLAM log; assumptions are the same for all robots."""

    path: str = log_path(MRCLAM)
    robots: tuple[int, ...] | None = option(None, "Numbers of the robots with commas, e.g. 1,2,5.", shown="all")
    truth: str | None = option(
        None, "File of the true poses of the one robot named.", shown="the folder's", is_path=True
    )
    identities: Literal["given", "hidden"] = option("given", "given: barcodes are read. hidden: positions alone.")
    alone: bool = option(False, "Each robot by itself, or maps merge.", name="--alone/--team", shown="team")
    particles: int | None = option(
        None, "Particles per filter.", shown="100 for each robot of a team", ge=1, hint=ONE_PARTICLE
    )
    dt: float = setting(0.25, "Time between steps [s].", gt=0.0)
    drive: Drive = setting(MRCLAM_DRIVE, "How robots follow their commands.")
    motion: OdometryModel = setting(MRCLAM_MOTION, "Assumed odometry noise.")
    sensor: SightingNoise = setting({}, "Assumed noise of the sightings.")


class VictoriaConfig(ReplayConfig):
    """The replay of a log of Victoria Park."""

    path: str = log_path(VICTORIA)
    particles: int = option(100, "Particles per filter.", ge=1, hint=ONE_PARTICLE)
    motion: OdometryModel = setting(VICTORIA_MOTION, "Assumed odometry noise.")
    sensor: TreeNoise = setting({}, "Assumed noise of the trees' readings.")


class KittiConfig(ReplayConfig):
    """The replay of tracked features of a KITTI drive; the noise of its velocities is read off the log itself.

    Features creep along while they are tracked; the rows of both images, which should agree, differ by 0.38 px in
    `0027.npz`.
    """

    path: str = log_path(KITTI, "Archive of features, folder with one, or folder of images.")
    truth: str | None = option(None, "File of the true poses.", shown="that beside the data", is_path=True)
    particles: int = option(100, "Particles per filter.", ge=1, hint=ONE_PARTICLE)
    sigma_px: Pixels = setting(1.0, "Assumed standard deviation of a feature's column [px].")
    sigma_disparity_px: Pixels = setting(0.5, "Assumed standard deviation of its disparity [px].")


class ImagesConfig(ReplayConfig):
    """The replay of stereo images of a drive; without names of files the folder is laid out as KITTI's.

    The assumed noise of a feature's column covers the car's pitch and roll, which a plane does not know.
    """

    path: str = log_path(PAIRS, "Folder of stereo images.")
    left: str | None = option(
        None, "Left images in the folder: a pattern (cam0/*.png), or names with commas.", shown="left_img_*.png"
    )
    right: str | None = option(None, "Right images, in the same order.", shown="right_img_*.png")
    calibration: str | None = option(
        None, "calib.txt of KITTI for rectified images, or two sensor.yaml of EuRoC with a comma, left first.",
        shown="sensorLeft.yaml,sensorRight.yaml",
    )  # fmt: skip
    times: str | None = option(None, "File of the seconds of a drive's frames.", shown="0.1 s apart")
    truth: str | None = option(
        None, "File of true poses: rows of 3 x 4 matrices; of two pairs also image, quaternion w x y z, position.",
        shown="poses_dev.txt of two pairs, if there",
    )  # fmt: skip
    max_range: float = option(
        40.0, "Points farther than this are dropped (m).", shown="12 of two pairs, 40 of a drive", gt=NEAREST,
        hint="Give metres.",
    )  # fmt: skip
    particles: int = option(100, "Particles per filter.", ge=1, hint=ONE_PARTICLE)
    descriptor: Descriptor = option("usurf", "usurf, sift or orb; the others are shown beside it.")
    estimator: Proposal = "fastslam2"
    rejuvenate_every: int = setting(REJUVENATE_EVERY, ge=0)
    sigma_px: Pixels = setting(2.0, "Assumed standard deviation of a feature's column [px].")
    sigma_disparity_px: Pixels = setting(0.5, "Assumed standard deviation of its disparity [px].")


class PairsConfig(ExperimentConfig):
    """The alignment of two stereo pairs; without a file of true poses `poses_dev.txt` is taken, if it is there."""

    path: str
    left: str = "left_img_*.png"
    right: str = "right_img_*.png"
    calibration: str = "sensorLeft.yaml,sensorRight.yaml"
    truth: str | None = None
    descriptor: Descriptor = "usurf"
    max_range: float = setting(12.0, "Points farther than this are dropped [m].", gt=0.0)

    @property
    def files(self) -> "StereoFiles":
        """The names of the files."""
        from slam_backend.readers.stereo_files import StereoFiles

        return StereoFiles(left=self.left, right=self.right, calibration=self.calibration, truth=self.truth)


def find_log(path: str | None, below: Path, what: str) -> str:
    """Return the place of a log, and refuse one that is not there.

    Args:
        path: As the user named it; None: below the folder of data sets that VSLAM_DATA names.
        what: What must be there, as an error would say it.

    Raises:
        ValueError: If nothing is there, or `path` is None and the variable is not set.
    """
    from slam_backend.core.validation import argument_error

    data = os.environ.get("VSLAM_DATA")
    if path is None and not data:
        raise argument_error("path", what, "no --path", "Name it, or set VSLAM_DATA.")
    place = str(Path(data or "").resolve() / below) if path is None else path
    if not Path(place).exists():
        cure = f"Check {place!r}; if --path is left away, it is {str(below)!r} in the folder that VSLAM_DATA names."
        raise argument_error("path", what, "no such path", cure)
    return place
