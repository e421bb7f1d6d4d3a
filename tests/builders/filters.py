"""Filters whose exact answer is known, filters that have resampled, and what a filter holds."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel

A_FROM_B = np.array([4.0, 3.0, 2.0])  # where b starts, seen from where a starts
LANDMARKS = np.array(  # in a's start frame
    [
        [3.0, 0.5, -0.4], [4.5, 2.0, 0.3], [6.0, -1.0, 0.8], [5.5, 4.0, 0.1], [8.0, 1.5, -0.7],
        [3.5, -3.0, 0.6], [7.0, 5.0, -0.2], [2.0, 4.5, 0.9], [9.0, -2.0, 0.0],
    ]
)  # fmt: skip
NAMES_A = np.array([0, 1, 2, 3, 4, 5, 6])
NAMES_B = np.array([7, 4, 3, 2, 8, 1, 0])  # 0 to 4 are common to both
PAIRS = np.array([[0, 6], [1, 5], [2, 3], [3, 2], [4, 1]])  # seen from the start, an id is a place in the frame
MOVE = np.array([1.0, 0.2, 0.15])
WIDE_MOTION = OdometryModel(sigma_along=0.05, sigma_across=0.02, sigma_heading=0.05, sigma_turn=0.02)
plain_filter = partial(FastSlam, rejuvenate_every=None)  # without a smoother, as in the paper


def looks(names: IntArray) -> NDArray[np.float32]:
    """Return the descriptors (n, 13) of landmarks: orthogonal unit vectors."""
    return np.eye(13, dtype=np.float32)[names]


def frame_of(points: FloatArray, names: IntArray, sigma: float) -> Measurements:
    """Return the frame in which points (n, 3), robot axes, are measured with a stated noise [m] in each direction."""
    covariances = np.tile(sigma**2 * np.eye(3), (len(points), 1, 1))
    return Measurements(points @ ROBOT_FROM_CAMERA, looks(names), covariances)


def map_once(
    names: IntArray,
    start: FloatArray,
    sigma: float,
    rng: np.random.Generator,
    num_particles: int = 7,
    moves: int = 0,
    claimed_sigma: float | None = None,
) -> FastSlam:
    """Return a filter whose particles are draws from the exact posterior, because nothing is seen twice.

    Args:
        names: (n,) which of `LANDMARKS` the robot sees, in this order.
        start: (3,) the robot's start in a's start frame.
        sigma: True noise of each coordinate of a measurement [m].
        rng: Random stream of the true noise and the filter.
        num_particles: M.
        moves: The robot makes `MOVE` so often, with the noise of `WIDE_MOTION`, and sees an equal share of the
            landmarks after each; 0: it sees them all from its start.
        claimed_sigma: Noise that the filter assumes; None: the true one.
    """
    slam = plain_filter(1, num_particles=num_particles, motion=WIDE_MOTION, proposal="fastslam1", seed=rng)
    pose = start
    shares = max(moves, 1)
    for share in range(shares):
        if moves:
            pose = compose(pose, MOVE + rng.normal(size=3) * WIDE_MOTION.sigmas(MOVE))
        seen = names[share::shares]
        points = transform_points(inverse(pose), LANDMARKS[seen]) + sigma * rng.normal(size=(len(seen), 3))
        frame = frame_of(points, seen, sigma if claimed_sigma is None else claimed_sigma)
        slam.step([MOVE if moves else None], [frame], identities=[seen])
    return slam


def names_of(slam: FastSlam) -> dict[int, int]:
    """Return the true name of each landmark that a filter holds, by its id."""
    maps = slam.maps
    slots = maps.used_slots()
    return dict(zip(maps.ids[slots].tolist(), maps.identities[slots].tolist(), strict=True))


def starts_of(slam: FastSlam, robot: int) -> FloatArray:
    """Return (M, 3) where a robot started in each particle, map frame."""
    return compose(slam.particles(robot)[0], inverse(slam.particles_from_start(robot)))


def common_landmarks(a: FastSlam, b: FastSlam) -> IntArray:
    """Return (k, 2) rows (id in a, id in b) of the landmarks that both filters hold."""
    ids_b = {name: landmark for landmark, name in names_of(b).items()}
    return np.array([(landmark, ids_b[name]) for landmark, name in names_of(a).items() if name in ids_b])


def known_alignment(sigma: float = 0.01, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Alignment:
    """Return an alignment a_from_b that is off by `offset`, with a stated deviation [m, m, rad]."""
    motion = A_FROM_B + np.array(offset)
    return Alignment(True, "", *motion, sigma**2 * np.eye(3), np.empty((0, 2), np.int64), 0.0)


def filter_after_some_steps(num_particles: int, seed: int) -> tuple[FastSlam, np.ndarray, np.ndarray]:
    """Return a filter that has resampled at twelve steps, and points (14, 3) and looks (14, 14) of its world."""
    rng = np.random.default_rng(seed)
    slam = plain_filter(num_particles=num_particles, seed=seed, resample_threshold=1.0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, 14), rng.uniform(-1.0, 1.0, 14), rng.uniform(2.0, 6.0, 14)])
    looks = np.linalg.qr(rng.standard_normal((14, 14)))[0].astype(np.float32)
    for step in range(12):
        seen = rng.choice(14 if step > 4 else 8, 5, replace=False)
        noisy = points[seen] + rng.normal(0.0, 0.004, (5, 3))
        slam.step([np.array([0.0, 0.0, 0.001])], [Measurements(noisy, looks[seen])])
    return slam, points, looks


def filter_with_gaps(num_particles: int, seed: int) -> FastSlam:
    """Return a filter whose particles have resampled at different times, and do not all hold the same landmarks."""
    slam, _, _ = filter_after_some_steps(num_particles, seed)
    slots = slam.maps.used_slots()
    slam.maps.refresh(slots[::2])
    slam.maps.counts[slam.maps.row_of[slots[::2]], 1::3] = 0
    return slam


def dense(slam: FastSlam) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return ids (n,), means (n, 3, M) [m], covariances (n, 6, M) [m^2] and counts (n, M), 0 where one lacks it."""
    maps = slam.maps
    slots = maps.used_slots()
    values, counts = maps.dense(slots)
    return maps.ids[slots], values[:, :3], values[:, 3:], counts.astype(np.int64)


def contents(slam: FastSlam) -> dict[str, Any]:
    """Return all of a snapshot, landmarks by ascending id, each at its particle's own place, zeros where it is lacking.

    Places beyond the last particle, which mean nothing, are left out.
    """
    ids, means, covariances, counts = dense(slam)  # brings all landmarks to their places
    count, held, maps = slam.num_particles, counts > 0, slam.maps.compact()
    np.testing.assert_array_equal(maps.ids, ids)
    np.testing.assert_array_equal(maps.map_of, 0)
    landmarks = {name: getattr(maps, name) for name in ("ids", "identities", "last_seen", "descriptors", "next_id")}
    landmarks |= {"counts": counts, "odds": None if maps.odds is None else np.where(held, maps.odds[:, :count], 0.0)}
    landmarks["means"], landmarks["covariances"] = (
        np.where(held[:, None], values, 0.0) for values in (means, covariances)
    )
    state = slam.get_state() | {"maps": landmarks}
    for name in ("poses", "starts", "means", "covariances"):
        state[name] = state[name][:, :, :count]
    return state


def map_of(slam: FastSlam, particle: int) -> FloatArray:
    """Return (n, 10) what one particle knows of the landmarks it holds: mean, covariance (upper triangle) and count."""
    _, means, covariances, counts = dense(slam)
    held = counts[:, particle] > 0
    columns = (means[held, :, particle], covariances[held, :, particle], counts[held, particle, None])
    return np.concatenate(columns, axis=1)


def load_landmarks(maps: ParticleMaps, values: FloatArray, *names: Any) -> None:
    """Replace all landmarks by these: `values` (n, 9, M) as of `dense`, the rest as of `load_metadata`."""
    maps.load_metadata(*names)
    padded = np.zeros((len(values), 9, maps.padded))
    padded[:, :, : maps.num_particles] = values
    maps.blocks[: len(values)] = padded.reshape(len(values), 9, -1, LANES).transpose(0, 2, 1, 3)


def arrays_of(slam: FastSlam) -> dict[str, Any]:
    """Return all arrays that a filter works with, by owner and name: not copies."""
    owners = {"filter": slam, "maps": slam.maps}
    return {
        f"{owner}.{name}": value
        for owner, holder in owners.items()
        for name, value in vars(holder).items()
        if isinstance(value, np.ndarray)
    }
