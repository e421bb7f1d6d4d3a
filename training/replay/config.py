"""Configurations of all replays, and the default locations of their logs."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from training.experiments.config import ONE_PARTICLE, Descriptor, ExperimentConfig, Proposal, option, setting, table

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from slam_backend import OdometryModel
    from slam_backend.readers.mrclam import Drive, SightingNoise
    from slam_backend.readers.stereo_files import StereoFiles
    from slam_backend.readers.victoria import TreeNoise
else:
    OdometryModel = table("slam_backend:OdometryModel")
    Drive = table("slam_backend.readers.mrclam:Drive")
    SightingNoise = table("slam_backend.readers.mrclam:SightingNoise")
    TreeNoise = table("slam_backend.readers.victoria:TreeNoise")

# Steps of a log, equal to the ticks in environments. 50 gives the same errors, except for the 51 images of KITTI 06,
# which then end with an error of 1.3 % of the path instead of 1.0: see docs/how-to/real_data.md.
REJUVENATE_EVERY = 100
MRCLAM, VICTORIA = Path("mrclam") / "MRCLAM_Dataset7", Path("victoria_park")
KITTI, PAIRS = Path("kitti_landmarks"), Path("euroc_pairs")
NEAREST = 3.0  # smallest useful range of a car's cameras [m]
Pixels = Annotated[float, Field(gt=0.0)]

# Calibrated on data sets 7 and 4 of MR.CLAM. The odometry is the command. Compared with the true paths of six robots
# (five of data set 7, one of 4), robots follow it 0.2 s late, over four seconds with 0.91 to 0.94 of its speed and 0.94
# to 0.98 of its turn rate. The remaining error between two steps of 0.25 s is 23 to 27 % of the distance, 5 to 7 % of
# it sideways, and in heading up to 0.9 rad/m and 17 % of the turn.
MRCLAM_DRIVE = {"delay": 0.2, "speed": 0.93, "turn": 0.95}
MRCLAM_MOTION = {
    "sigma_along": 0.25, "sigma_across": 0.07, "sigma_heading": 0.7, "sigma_turn": 0.15, "floor_position": 0.001,
    "floor_heading": 0.004,
}  # fmt: skip
# Compared with the motion that best fits the trees of two scans one second apart, the odometry of Victoria Park turns
# 4 % and 0.0014 rad/m too little, drifts 2 % sideways, and scatters by 1.5 % of the distance, 0.002 rad/m and the noise
# of the trees. Its errors are correlated over time, while the filter assumes independent ones: hence a larger value.
VICTORIA_MOTION = {
    "sigma_along": 0.03, "sigma_across": 0.03, "sigma_heading": 0.01, "sigma_turn": 0.1, "floor_position": 0.005,
    "floor_heading": 0.001,
}  # fmt: skip
# Assumed for tags of 10 to 20 cm up to 6 m away; messages with a covariance have their own.
BAG_SENSOR = {"range_floor": 0.03, "range_share": 0.03, "bearing": 0.02, "height": 0.05}


def log_path(below: Path, help: str = "Folder of the log.") -> Any:
    """Return the field of a log's path, whose default is below the data folder."""
    return option(..., help, shown=f"{below} in $VSLAM_DATA", is_path=True)


class ReplayConfig(ExperimentConfig):
    """Common fields of the replays of all logs."""

    path: str
    duration: float | None = option(
        None, "Duration to replay [s].", shown="all", gt=0.0, hint="Give seconds, or omit it."
    )
    particles: int | None = option(100, "Number of particles per filter.", ge=1, hint=ONE_PARTICLE)
    estimator: Proposal | None = option("fastslam2", "Proposal: fastslam2 or fastslam1.", name="proposal")
    rejuvenate_every: int | None = option(
        REJUVENATE_EVERY, "Steps between rejuvenations of the particles from smoothed paths; 0: never.", ge=0,
        hint="Give a number of steps, or 0 for never.",
    )  # fmt: skip


class MrclamConfig(ReplayConfig):
    """Replay of an MR.CLAM log; noise assumptions are the same for all robots."""

    path: str = log_path(MRCLAM)
    robots: tuple[int, ...] | None = option(None, "Numbers of the robots, comma-separated, e.g. 1,2,5.", shown="all")
    truth: str | None = option(
        None, "File of the true poses, for a single robot.", shown="file in the folder", is_path=True
    )
    identities: Literal["given", "hidden"] = option(
        "given", "Landmark identities: given (from barcodes) or hidden (positions only)."
    )
    alone: bool = option(
        False, "Run each robot separately, or as a team that merges maps.", name="--alone/--team", shown="team"
    )
    particles: int | None = option(
        None, "Number of particles per filter.", shown="100 per robot of a team", ge=1, hint=ONE_PARTICLE
    )
    dt: float = setting(0.25, "Time between steps [s].", gt=0.0)
    drive: Drive = setting(MRCLAM_DRIVE, "Response of the robots to commands.")
    motion: OdometryModel = setting(MRCLAM_MOTION, "Assumed odometry noise.")
    sensor: SightingNoise = setting({}, "Assumed measurement noise.")


class VictoriaConfig(ReplayConfig):
    """Replay of the Victoria Park log."""

    path: str = log_path(VICTORIA)
    motion: OdometryModel = setting(VICTORIA_MOTION, "Assumed odometry noise.")
    sensor: TreeNoise = setting({}, "Assumed noise of the tree measurements.")


class KittiConfig(ReplayConfig):
    """Replay of tracked features of a KITTI drive; the noise of the velocities is estimated from the log.

    Features drift while they are tracked; the rows in both images, which should be equal, differ by 0.38 px in
    `0027.npz`.
    """

    path: str = log_path(KITTI, "Archive of features, folder with an archive, or folder of images.")
    truth: str | None = option(None, "File of the true poses.", shown="file beside the data", is_path=True)
    sigma_px: Pixels = setting(1.0, "Assumed standard deviation of a feature's column [px].")
    sigma_disparity_px: Pixels = setting(0.5, "Assumed standard deviation of its disparity [px].")


class ImagesConfig(ReplayConfig):
    """Replay of stereo images of a drive; without file names the folder has KITTI's layout.

    The assumed noise of a feature's column covers the car's pitch and roll, which a planar model lacks.
    """

    path: str = log_path(PAIRS, "Folder of stereo images.")
    left: str | None = option(
        None, "Left images in the folder: a pattern (cam0/*.png), or comma-separated names.", shown="left_img_*.png"
    )
    right: str | None = option(None, "Right images, in the same order.", shown="right_img_*.png")
    calibration: str | None = option(
        None, "Calibration: calib.txt of KITTI for rectified images, or sensor.yaml,sensor.yaml of EuRoC, left first.",
        shown="sensorLeft.yaml,sensorRight.yaml",
    )  # fmt: skip
    times: str | None = option(None, "File of the time stamps of a drive [s].", shown="0.1 s apart")
    truth: str | None = option(
        None, "File of true poses: rows of 3 x 4 matrices; for two pairs also image, quaternion w x y z, position.",
        shown="poses_dev.txt for two pairs, if present",
    )  # fmt: skip
    max_range: float = option(
        40.0, "Maximum distance of points [m].", shown="12 for two pairs, 40 for a drive", gt=NEAREST,
        hint="Give metres.",
    )  # fmt: skip
    descriptor: Descriptor = option("usurf", "Descriptor: usurf, sift or orb.")
    estimator: Proposal | None = "fastslam2"
    rejuvenate_every: int | None = setting(REJUVENATE_EVERY, ge=0)
    sigma_px: Pixels = setting(2.0, "Assumed standard deviation of a feature's column [px].")
    sigma_disparity_px: Pixels = setting(0.5, "Assumed standard deviation of its disparity [px].")

    @property
    def files(self) -> "StereoFiles":
        """Names of the files, by default those of two pairs."""
        from slam_backend.readers.stereo_files import StereoFiles

        given = {name: getattr(self, name) for name in ("left", "right", "calibration", "times", "truth")}
        return StereoFiles(**{name: value for name, value in given.items() if value is not None})


class BagConfig(ReplayConfig):
    """Replay of a bag of ROS 1 or ROS 2; several topics of odometry are a team with unknown starts."""

    path: str = option(
        ..., "Bag: .bag of ROS 1; .mcap, .db3 or folder of ROS 2.", shown="none", hint="Give --path.", is_path=True
    )
    odometry: tuple[str, ...] | None = option(
        None, "Topic of the odometry, comma-separated for several robots; without both topics are listed.", shown="none"
    )
    landmarks: tuple[str, ...] | None = option(None, "Topic of the landmarks, one for each robot.", shown="none")
    truth: tuple[str, ...] | None = option(None, "Topic of the true poses, one for each robot.", shown="none")
    camera: str | None = option(None, "Topic of the CameraInfo of all robots, for their field of view.", shown="none")
    base: tuple[str, ...] | None = option(
        None, "Frame of the robot, or one for each.", shown="child_frame_id of the odometry"
    )
    tag_frames: str = option("tag*", "Pattern of the frames that are landmarks, where their topic is /tf.")
    alone: bool = option(
        False, "Run each robot separately, or as a team that merges maps.", name="--alone/--team", shown="team"
    )
    particles: int | None = option(
        None, "Number of particles per filter.", shown="100 per robot of a team", ge=1, hint=ONE_PARTICLE
    )
    dt: float = option(0.25, "Time between steps [s].", gt=0.0, hint="Give seconds, near those between two frames.")
    motion: OdometryModel = setting({}, "Assumed odometry noise.")
    sensor: SightingNoise = setting(BAG_SENSOR, "Assumed noise of landmarks without covariance.")


class GraphConfig(ReplayConfig):
    """Replay of a pose graph with landmarks; the odometry noise is fitted to its edges."""

    path: str = option(..., "Pose graph: .g2o, .pyfg or .fg.", hint="Give --path.", is_path=True)
    truth: str | None = option(None, "Pose graph whose vertices are true.", shown="none", is_path=True)


class LogConfig(ReplayConfig):
    """Replay of a log by a reader of the user; what is not given is as in the log, or else as for other logs."""

    path: str = option(..., "Path that the reader gets.", hint="Give --path.", is_path=True)
    particles: int | None = option(None, "Number of particles per filter.", shown="as the log", ge=1, hint=ONE_PARTICLE)
    estimator: Proposal | None = option(None, "Proposal: fastslam2 or fastslam1.", name="proposal", shown="as the log")
    rejuvenate_every: int | None = option(
        None, "Steps between rejuvenations of the particles; 0: never.", shown="as the log", ge=0,
        hint="Give a number of steps, or 0 for never.",
    )  # fmt: skip


def find_log(path: str | None, below: Path, what: str) -> str:
    """Return the path of a log, and refuse a missing one.

    Args:
        path: Path given by the user; None: `below` in the data folder VSLAM_DATA.
        what: Description of the expected content, for the error.

    Raises:
        ValueError: If the path does not exist, or `path` is None and VSLAM_DATA is not set.
    """
    from slam_backend.core.files import missing_error
    from slam_backend.core.validation import argument_error

    data = os.environ.get("VSLAM_DATA")
    if path is None and not data:
        raise argument_error("path", what, "no --path", "Give --path, or set VSLAM_DATA.")
    place = str(Path(data or "").resolve() / below) if path is None else path
    if not Path(place).exists():
        raise missing_error("path", what, place, f"Without --path it is {str(below)!r} in the folder VSLAM_DATA.")
    return place
