"""Compilation of the backend's kernels ahead of their first use."""

from collections.abc import Collection

import numpy as np

from slam_backend.core.compilation.compiler import (
    Progress,
    Signatures,
    compile_kernels,
    exempt_from_collection,
    recorded_signatures,
)
from slam_backend.core.compilation.messages import watch_compilation
from slam_backend.core.jit import IS_PLAIN
from slam_backend.core.read_only import as_read_only
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.frontend import StereoFrontEnd
from slam_backend.geometry import inverse
from slam_backend.maps.alignment import align_maps
from slam_backend.metrics.maps import map_error
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.sampling import retract_on_se2
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

# Features that default options do not use, and the prefixes of the kernels that only these call, signature included.
EXTRAS = {
    "existence": ("slam_backend.fastslam._kernels.update.existence.",),
    "images": ("slam_backend.frontend.",),
    "planners": ("vslam_env.navigation.tours.", "vslam_env.navigation._planning_kernels.path_lengths."),
}
STEPS = 4
LANDMARKS = 12  # more than an alignment needs


def warm_up(
    options: FilterOptions | None = None,
    *,
    everything: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> float:
    """Compile the kernels that a filter or a team needs, or load them from the cache.

    Kernels are stored beside the package if its folder is writable, else in the user's cache folder, or in the folder
    NUMBA_CACHE_DIR. Missing kernels come from the package `vslam-env-kernels` if a matching version is installed, else
    they are compiled. While one process fills the cache, others wait. Afterwards the objects of this process are left
    out of Python's searches for garbage (`gc.freeze`), which would interrupt a step for 0.1 s now and then.

    Args:
        options: Options of the filters; None: the defaults.
        everything: Whether to compile also kernels that these options do not need, which else compile at first call.
        workers: Number of compiling processes; None: one per core. The calling script needs no main guard.
        progress: Callback with the number of compiled kernels, the total number, and the estimated seconds left [s].

    Returns:
        Seconds spent compiling; 0 if all kernels came from the cache, or numba's compiler is switched off.
    """
    if IS_PLAIN:
        return 0.0
    extras = EXTRAS if everything else extras_of(FilterOptions() if options is None else options)
    seconds = compile_kernels(needed(recorded_signatures("slam_backend"), extras), workers, progress)
    seconds += run_all_paths(extras)
    exempt_from_collection()
    return seconds


def extras_of(options: FilterOptions) -> set[str]:
    """Return the keys of `EXTRAS` that filters with these options need."""
    return set() if options.existence is None else {"existence"}


def needed(signatures: Signatures, extras: Collection[str]) -> dict[str, list[str]]:
    """Return the signatures without those that only other extras need."""
    left_out = tuple(start for extra, starts in EXTRAS.items() if extra not in extras for start in starts)
    return {name: list(words) for name, words in signatures.items() if not name.startswith(left_out)}


def run_all_paths(extras: Collection[str]) -> float:
    """Run tiny filters, a tiny team and a tiny pair of images along all paths that end in a kernel.

    Args:
        extras: Keys of `EXTRAS`.

    Returns:
        Seconds spent compiling in this process.
    """
    with watch_compilation(lambda name: None) as watch:
        angles = np.linspace(0.0, 2.0 * np.pi, LANDMARKS, endpoint=False)
        points = np.column_stack([2.0 * np.cos(angles), np.sin(angles), np.linspace(4.0, 6.0, LANDMARKS)])
        descriptors = np.eye(LANDMARKS, dtype=np.float32)
        ids, some_ids = np.arange(LANDMARKS), np.arange(LANDMARKS) - 1  # `some_ids` has one rejected measurement
        plain = Measurements(points, descriptors)
        given = Measurements(points, descriptors, np.tile(1e-4 * np.eye(3), (LANDMARKS, 1, 1)))
        move, still = np.array([0.0, 0.0, 0.01]), np.zeros(3)
        for frame in (plain, given):
            slam = FastSlam(2, num_particles=4, resample_threshold=1.0, rejuvenate_every=None)
            slam.step([None, None], [frame, None])
            for _ in range(STEPS):
                slam.step([move, None], [frame, frame])
            slam.step([None, None], [frame, frame], [ids, some_ids], [still, None])
            slam.step([move, move], [None, None])
        few_keys = SmoothingOptions(incremental=True, max_keys=2, recent_keys=1)  # keys are joined between slices
        biased = OdometryModel(bias_scale=0.02)
        smoothing = FastSlam(num_particles=4, motion=biased, rejuvenate_every=3 * STEPS, smoothing=few_keys)
        for _ in range(4 * STEPS):
            smoothing.step([move], [plain])
        smoothing.set_state(smoothing.get_state())
        if "existence" in extras:
            slam = FastSlam(num_particles=4, existence=ExistenceModel(), resample_threshold=1.0, rejuvenate_every=None)
            for _ in range(STEPS):
                slam.step([move], [plain])
            slam.set_state(slam.get_state())
        root = as_read_only(np.array([-1]))
        retract_on_se2(np.zeros((1, 3)), root, np.zeros((1, 3, 1)))
        inverse(np.zeros((2, 3)))  # of starts in a fixed gauge
        attempts, merging = AttemptOptions(every=1), MergeOptions(watch_every=1)
        team = TeamSlam(2, num_particles=4, rejuvenate_every=None, attempts=attempts, merging=merging)
        for _ in range(STEPS):
            team.step([None, None], [plain, plain])
        both = np.tile(points, (2, 1)), np.tile(descriptors, (2, 1))
        team.step(np.zeros((2, 3)), TeamMeasurements(*both, np.array([LANDMARKS, 2 * LANDMARKS])))
        team.team_poses(), team.map_summaries()
        landmarks = team.map(0)
        align_maps(landmarks, landmarks)
        map_error(landmarks.means, ids, points)
        if "images" in extras:
            _measure_images()
    return watch.seconds


def _measure_images() -> None:
    """Run the stereo front end on a tiny pair of images."""
    blocks = np.kron(np.random.default_rng(0).integers(0, 256, (8, 12)), np.ones((12, 12))).astype(np.uint8)
    front_end = StereoFrontEnd(StereoCamera(focal_px=100.0, width=128, height=96))
    front_end.measure(blocks[:, :128], blocks[:, 8:136])
