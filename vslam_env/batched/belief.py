"""Belief of a team as one Gaussian over its robots and landmarks, in arrays of fixed shape.

An extended Kalman filter over poses, odometry biases and planar landmarks, with unknown data association: what the
filters of the environment sample and smooth is linearised here once, in the step in which it is measured. All functions
are pure and can be batched by `jax.vmap`. Heights of landmarks are measured independently of all else.

A team's robots each begin in a frame of their own; robots and landmarks of different groups are independent.
"""

import math
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from slam_backend.fastslam.options import FilterOptions

ROBOT = 8  # variables of a robot: pose (3) [m, m, rad], relative bias of distances, bias of turns [rad/m], start (3)
START = 5  # first variable of the start among these
NEAREST = 0.3  # [m] noise is that of points at least so far ahead
ROUNDING = 0.003  # [m] standard deviation that is added to sights: beside variances of square metres float32 needs it
LEAST_WEIGHT = 0.1  # of a new measurement in the mean descriptor of a landmark


class Assumed(NamedTuple):
    """Assumed camera, noise and gates, see `FilterOptions`."""

    focal: float
    baseline: float
    sigma_px: float
    sigma_disparity: float
    mount: tuple[float, float, float]
    sigma_along: float
    sigma_across: float
    sigma_heading: float
    sigma_turn: float
    floor_position: float
    floor_heading: float
    bias_scale: float
    bias_heading: float
    position_gate: float
    new_landmark_gate: float
    new_landmark_radius: float
    descriptor_gate: float
    descriptor_sigma: float

    @classmethod
    def of(cls, options: FilterOptions) -> Self:
        """Return what a filter assumes."""
        camera = options.camera
        values: dict[str, Any] = {
            "focal": camera.focal_px, "sigma_disparity": camera.sigma_disparity_px, "mount": tuple(camera.mount)
        }  # fmt: skip
        for name in set(cls._fields) - values.keys():
            sources = (source for source in (camera, options.motion, options) if hasattr(source, name))
            values[name] = getattr(next(sources), name)
        return cls(**values)


class Frame(NamedTuple):
    """Measurements of a robot in one tick; the first dimension is the largest number B of a frame.

    Attributes:
        points: (B, 3) float32 [m], camera frame.
        descriptors: (B, D) float32. Descriptors.
        true_ids: (B,) int32. True landmarks, for scores alone; -1: of none.
        valid: (B,) bool. Whether there is a measurement.
    """

    points: Array
    descriptors: Array
    true_ids: Array
    valid: Array


class Belief(NamedTuple):
    """Gaussian over K robots and R rows of landmarks, with n = 8 K + 2 R variables in this order.

    Attributes:
        robots: (K, 8) float32. Poses [m, m, rad], map frame of the robot's group, odometry biases, and start poses.
        places: (R, 2) float32 [m], map frame of the group.
        covariance: (n, n) float32, symmetric.
        heights: (R, 2) float32 [m, m^2]. Height of each landmark above the floor, and its variance.
        descriptors: (R, D) float32. Mean descriptors.
        counts: (R,) int32. Measurements of each landmark; 0: a free row.
        true_ids: (R,) int32. True landmark of the first measurement, for scores alone; -1: of none.
        owners: (R,) int32. First robot of the group that holds each landmark.
        groups: (K,) int32. First robot of each robot's group.
    """

    robots: Array
    places: Array
    covariance: Array
    heights: Array
    descriptors: Array
    counts: Array
    true_ids: Array
    owners: Array
    groups: Array

    @property
    def first_place(self) -> int:
        """Index of the first variable of the landmarks."""
        return int(self.robots.size)


def start(num_robots: int, rows: int, size: int, assumed: Assumed) -> Belief:
    """Return the belief of robots at their starts, with room for R landmarks with descriptors of a size."""
    of_robot = jnp.zeros(ROBOT).at[3].set(assumed.bias_scale**2).at[4].set(assumed.bias_heading**2)
    variances = jnp.tile(of_robot, num_robots)
    return Belief(
        robots=jnp.zeros((num_robots, ROBOT)), places=jnp.zeros((rows, 2)),
        covariance=jnp.diag(jnp.concatenate([variances, jnp.zeros(2 * rows)])), heights=jnp.zeros((rows, 2)),
        descriptors=jnp.zeros((rows, size)), counts=jnp.zeros(rows, jnp.int32), true_ids=jnp.full(rows, -1, jnp.int32),
        owners=jnp.zeros(rows, jnp.int32), groups=jnp.arange(num_robots, dtype=jnp.int32),
    )  # fmt: skip


def rotation(angle: Array) -> Array:
    """Return the matrix (2, 2) of a rotation."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, -s], [s, c]])


def wrapped(angles: Array) -> Array:
    """Return angles in [-pi, pi)."""
    return (angles + math.pi) % (2.0 * math.pi) - math.pi


# ---------------------------------------------------------------------- motion


def moved(robot: Array, odometry: Array) -> Array:
    """Return a robot (8,) after a reading (3,) [m, m, rad], whose error by the biases is taken off."""
    x, y, heading, scale, turn_per_metre = robot[:5]
    dx, dy, turn = odometry
    late = turn_per_metre * distance_of(odometry)
    ahead, aside = dx - scale * dx + 0.5 * dy * late, dy - scale * dy - 0.5 * dx * late
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.stack([x + c * ahead - s * aside, y + s * ahead + c * aside, heading + turn - late, *robot[3:]])


def distance_of(odometry: Array) -> Array:
    """Return the distance of a reading (3,) [m]; its derivative is zero at rest."""
    square = odometry[0] ** 2 + odometry[1] ** 2
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def motion_noise(heading: Array, odometry: Array, assumed: Assumed) -> Array:
    """Return the covariance (8, 8) that a reading adds to a robot, see `OdometryModel.variances`."""
    dx, dy, turn = odometry
    square = dx**2 + dy**2
    along, across = (
        sigma**2 * square + assumed.floor_position**2 for sigma in (assumed.sigma_along, assumed.sigma_across)
    )
    turned = rotation(heading)
    of_heading = assumed.sigma_heading**2 * square + (assumed.sigma_turn * turn) ** 2 + assumed.floor_heading**2
    planar = turned @ jnp.diag(jnp.stack([along, across])) @ turned.T
    return jnp.zeros((ROBOT, ROBOT)).at[:2, :2].set(planar).at[2, 2].set(of_heading)


def predict(belief: Belief, odometry: Array, assumed: Assumed) -> Belief:
    """Return the belief after readings (K, 3) [m, m, rad], previous robot frames."""
    count, size = len(belief.robots), belief.robots.size
    by_robot = jax.vmap(jax.jacfwd(moved))(belief.robots, odometry)
    noise = jax.vmap(motion_noise, (0, 0, None))(belief.robots[:, 2], odometry, assumed)
    rows = jnp.einsum("kij,kjn->kin", by_robot, belief.covariance[:size].reshape(count, ROBOT, -1)).reshape(size, -1)
    among = jnp.einsum("akj,kij->aki", rows[:, :size].reshape(size, count, ROBOT), by_robot)
    robots = jnp.arange(count)
    among = among.reshape(count, ROBOT, count, ROBOT).at[robots, :, robots].add(noise).reshape(size, size)
    covariance = belief.covariance.at[:size].set(rows).at[:, :size].set(rows.T)
    covariance = covariance.at[:size, :size].set(0.5 * (among + among.T))
    return belief._replace(robots=jax.vmap(moved)(belief.robots, odometry), covariance=covariance)


# ---------------------------------------------------------------------- measurements


def seen_from(robot: Array, place: Array, assumed: Assumed) -> Array:
    """Return where a robot (8,) sees a place (2,): (ahead, left) of its camera [m]."""
    dx, dy = place[0] - robot[0], place[1] - robot[1]
    c, s = jnp.cos(robot[2]), jnp.sin(robot[2])
    return jnp.stack([c * dx + s * dy - assumed.mount[0], c * dy - s * dx - assumed.mount[1]])


def in_plane(points: Array) -> Array:
    """Return measured points (..., 3), camera frame, as (ahead, left) of the camera (..., 2) [m]."""
    return jnp.stack([points[..., 2], -points[..., 0]], axis=-1)


def place_of(robot: Array, seen: Array, assumed: Assumed) -> Array:
    """Return the place (2,) that a robot (8,) sees at (ahead, left) of its camera [m]: the inverse of `seen_from`."""
    ahead, left = seen[0] + assumed.mount[0], seen[1] + assumed.mount[1]
    c, s = jnp.cos(robot[2]), jnp.sin(robot[2])
    return jnp.stack([robot[0] + c * ahead - s * left, robot[1] + s * ahead + c * left])


def sight_noise(seen: Array, assumed: Assumed) -> Array:
    """Return the covariance (2, 2) [m^2] of a measured (ahead, left), see `StereoCamera.covariance`."""
    depth = jnp.maximum(seen[0], NEAREST)
    ray = jnp.stack([depth, seen[1]])
    along = (assumed.sigma_disparity * depth / (assumed.focal * assumed.baseline)) ** 2
    return along * jnp.outer(ray, ray) + jnp.diag(jnp.stack([0.0, pixel_noise(depth, assumed)]) + ROUNDING**2)


def pixel_noise(depth: Array, assumed: Assumed) -> Array:
    """Return the variance [m^2] by the noise of a pixel, across the line of sight, at a depth [m]."""
    return (jnp.maximum(depth, NEAREST) / assumed.focal * assumed.sigma_px) ** 2


def height_of(points: Array, depth: Array, assumed: Assumed) -> Array:
    """Return the heights above the floor [m] of points (..., 3), camera frame, at given depths."""
    return assumed.mount[2] - points[..., 1] / points[..., 2] * depth


class _Matches(NamedTuple):
    """Rows (B,) of matched landmarks, R without one, and whether measurements are new landmarks (B,)."""

    rows: Array
    new: Array


def match(belief: Belief, robot: Array, frame: Frame, assumed: Assumed) -> _Matches:
    """Match the measurements of a robot, at most one with each landmark, those of least cost first.

    The cost of a match is that of the environment's filters: squared Mahalanobis distance, log-determinant, and
    descriptors. Without a match a measurement is new unless a landmark that looks like it is near.
    """
    count, rows = len(frame.valid), len(belief.counts)
    pose, place = belief.robots[robot], belief.places
    seen = jax.vmap(seen_from, (None, 0, None))(pose, place, assumed)
    by_pose, by_place = jax.vmap(jax.jacfwd(seen_from, (0, 1)), (None, 0, None))(pose, place, assumed)
    first = belief.first_place
    own = jax.lax.dynamic_slice(belief.covariance, (ROBOT * robot, 0), (ROBOT, len(belief.covariance)))
    corner = jax.lax.dynamic_slice(own, (0, ROBOT * robot), (ROBOT, ROBOT))
    cross = own[:, first:].reshape(ROBOT, rows, 2)
    blocks = belief.covariance[first:, first:].reshape(rows, 2, rows, 2)[jnp.arange(rows), :, jnp.arange(rows)]
    mixed = jnp.einsum("ria,arb,rjb->rij", by_pose, cross, by_place)
    spread = jnp.einsum("ria,ab,rjb->rij", by_pose, corner, by_pose) + mixed + mixed.swapaxes(1, 2)
    spread += jnp.einsum("ria,rab,rjb->rij", by_place, blocks, by_place)
    spread += jax.vmap(sight_noise, (0, None))(seen, assumed)
    measured = in_plane(frame.points)
    off = measured[:, None] - seen
    determinant = spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] ** 2
    quadratic = (
        spread[:, 1, 1] * off[..., 0] ** 2 - 2.0 * spread[:, 0, 1] * off[..., 0] * off[..., 1]
        + spread[:, 0, 0] * off[..., 1] ** 2
    )  # fmt: skip
    heights = height_of(frame.points[:, None], seen[:, 0], assumed)
    slope = (frame.points[:, 1] / frame.points[:, 2])[:, None]
    tall = pixel_noise(seen[:, 0], assumed) + belief.heights[:, 1] + slope**2 * spread[:, 0, 0]
    distance = quadratic / jnp.maximum(determinant, 1e-20) + (heights - belief.heights[:, 0]) ** 2 / tall
    unlike = jnp.linalg.norm(frame.descriptors[:, None] - belief.descriptors, axis=-1)
    held = (belief.counts > 0) & (belief.owners == belief.groups[robot])
    alike = held & (unlike < assumed.descriptor_gate) & frame.valid[:, None]
    cost = distance + jnp.log(jnp.maximum(determinant, 1e-20)) + (unlike / assumed.descriptor_sigma) ** 2
    cost = jnp.where(alike & (distance < assumed.position_gate) & (seen[:, 0] > 0.0), cost, jnp.inf)

    def choose(_: int, so_far: tuple[Array, Array]) -> tuple[Array, Array]:
        open_costs, chosen = so_far
        measurement, row = jnp.divmod(jnp.argmin(open_costs), rows)
        is_match = jnp.isfinite(open_costs[measurement, row])
        chosen = chosen.at[measurement].set(jnp.where(is_match, row, chosen[measurement]))
        taken = (jnp.arange(count)[:, None] == measurement) | (jnp.arange(rows) == row)
        return jnp.where(taken & is_match, jnp.inf, open_costs), chosen

    _, chosen = jax.lax.fori_loop(0, count, choose, (cost, jnp.full(count, rows)))
    places = jax.vmap(place_of, (None, 0, None))(pose, measured, assumed)
    close = jnp.linalg.norm(places[:, None] - place, axis=-1) < assumed.new_landmark_radius
    near = (alike & (close | (distance < assumed.new_landmark_gate))).any(axis=1)
    return _Matches(chosen, frame.valid & (chosen == rows) & ~near)


def update(belief: Belief, frames: Frame, rows: Array, assumed: Assumed) -> Belief:
    """Return the belief given the matched measurements of all robots; frames (K, B) and rows (K, B) as in `match`."""
    count, first = rows.size, belief.first_place
    robots, rows = jnp.repeat(jnp.arange(len(rows)), rows.shape[1]), rows.ravel()
    used = rows < len(belief.counts)
    frame = jax.tree.map(lambda values: values.reshape(count, *values.shape[2:]), frames)
    pose, places = belief.robots[robots], belief.places[rows]
    measured = in_plane(frame.points)
    seen = jax.vmap(seen_from, (0, 0, None))(pose, places, assumed)
    by_pose, by_place = jax.vmap(jax.jacfwd(seen_from, (0, 1)), (0, 0, None))(pose, places, assumed)
    by_pose, by_place = (jnp.where(used[:, None, None], by, 0.0) for by in (by_pose, by_place))
    columns = jnp.concatenate([jnp.arange(first), (first + 2 * rows[:, None] + jnp.arange(2)).ravel()])
    each = jnp.arange(count)[:, None]
    jacobian = jnp.zeros((count, 2, first + 2 * count))
    jacobian = jacobian.at[each, :, ROBOT * robots[:, None] + jnp.arange(ROBOT)].set(by_pose.swapaxes(1, 2))
    jacobian = jacobian.at[each, :, first + 2 * each + jnp.arange(2)].set(by_place.swapaxes(1, 2))
    jacobian = jacobian.reshape(2 * count, -1)
    gain = belief.covariance[:, columns] @ jacobian.T  # (n, 2 K B); columns beyond the last are those of no match
    noise = jnp.where(used[:, None, None], jax.vmap(sight_noise, (0, None))(seen, assumed), jnp.eye(2))
    innovation = jacobian @ gain[columns]
    each = each[:, 0]
    innovation = innovation.reshape(count, 2, count, 2).at[each, :, each].add(noise).reshape(2 * count, 2 * count)
    off = jnp.where(used[:, None], measured - seen, 0.0).ravel()
    depth, known = seen[:, 0], belief.heights
    precision = 1.0 / pixel_noise(depth, assumed)
    told = jnp.stack([precision * height_of(frame.points, depth, assumed), precision], axis=-1)
    before = jnp.stack([known[:, 0], jnp.ones_like(known[:, 0])], axis=-1) / known[:, 1:]
    total = before.at[rows].add(told, mode="drop")
    counts = belief.counts.at[rows].add(1, mode="drop")
    change = jnp.maximum(1.0 / counts[rows], LEAST_WEIGHT)[:, None] * (frame.descriptors - belief.descriptors[rows])
    return conditioned(belief, gain, innovation, off)._replace(
        heights=jnp.where(belief.counts[:, None] > 0, jnp.stack([total[:, 0], jnp.ones_like(total[:, 0])], -1), 0.0)
        / jnp.where(belief.counts[:, None] > 0, total[:, 1:], 1.0),
        descriptors=belief.descriptors.at[rows].add(change, mode="drop"), counts=counts,
    )  # fmt: skip


def conditioned(belief: Belief, gain: Array, innovation: Array, off: Array) -> Belief:
    """Return the belief given m numbers that are linear in its variables.

    What turns with a robot's heading turns about the changed means as about those before: without that, filters become
    sure of headings that nothing told them (T. Zhang, K. Wu, J. Song, S. Huang, G. Dissanayake: Convergence and
    consistency analysis for a 3-D invariant-EKF SLAM. RA-L 2(2), 2017).

    Args:
        gain: (n, m). Covariance of the variables with the numbers, P H^T.
        innovation: (m, m). Covariance of the numbers with their noise, H P H^T + R.
        off: (m,). Differences of the numbers read from those expected.
    """
    lower = jnp.linalg.cholesky(0.5 * (innovation + innovation.T))
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(len(lower)), lower=True)  # slow for n right-hand sides
    half, first = inverse @ gain.T, belief.first_place
    change = half.T @ (inverse @ off)
    robots, places = change[:first].reshape(-1, ROBOT), change[first:].reshape(-1, 2)
    count = len(robots)
    each, headings = jnp.arange(count), ROBOT * jnp.arange(count) + 2
    by_robots = jnp.zeros((count, count, ROBOT)).at[each, each, :2].set(_turned(robots[:, :2]))
    by_places = jnp.where((belief.owners == each[:, None])[:, :, None], _turned(places), 0.0)
    by = jnp.concatenate([by_robots.reshape(count, -1), by_places.reshape(count, -1)], axis=1)  # (K, n)
    of_headings = belief.covariance[headings] - half[:, headings].T @ half
    with_headings = of_headings + 0.5 * of_headings[:, headings] @ by
    left, right = jnp.concatenate([half, by, with_headings]), jnp.concatenate([-half, with_headings, by])
    return belief._replace(
        robots=belief.robots + robots, places=belief.places + places,
        covariance=symmetric(belief.covariance + left.T @ right),
    )  # fmt: skip


def _turned(shifts: Array) -> Array:
    """Return shifts (..., 2) turned to the left."""
    return jnp.stack([-shifts[..., 1], shifts[..., 0]], axis=-1)


def symmetric(covariance: Array) -> Array:
    """Return a covariance that is symmetric to the last bit: a difference of its halves would grow by itself."""
    return 0.5 * (covariance + covariance.T)


def insert(belief: Belief, frames: Frame, new: Array, assumed: Assumed) -> Belief:
    """Return the belief with new landmarks, measurements (K, B) of all robots, as long as rows are free."""
    total, first, count = len(belief.counts), belief.first_place, new.size
    robots, new = jnp.repeat(jnp.arange(len(new)), new.shape[1]), new.ravel()
    frame = jax.tree.map(lambda values: values.reshape(count, *values.shape[2:]), frames)
    free = jnp.nonzero(belief.counts == 0, size=count, fill_value=total)[0]
    rows = jnp.where(new, free[jnp.cumsum(new) - 1], total)
    pose, seen, each = belief.robots[robots], in_plane(frame.points), jnp.arange(count)
    places = jax.vmap(place_of, (0, 0, None))(pose, seen, assumed)
    by_pose, by_seen = jax.vmap(jax.jacfwd(place_of, (0, 1)), (0, 0, None))(pose, seen, assumed)
    noise = jnp.einsum("ria,rab,rjb->rij", by_seen, jax.vmap(sight_noise, (0, None))(seen, assumed), by_seen)
    jacobian = jnp.zeros((count, 2, first)).at[each[:, None], :, ROBOT * robots[:, None] + jnp.arange(ROBOT)]
    jacobian = jacobian.set(by_pose.swapaxes(1, 2)).reshape(2 * count, first)
    cross = jacobian @ belief.covariance[:first]
    among = (cross[:, :first] @ jacobian.T).reshape(count, 2, count, 2).at[each, :, each].add(noise)
    at = jnp.where(new[:, None], first + 2 * rows[:, None] + jnp.arange(2), len(belief.covariance)).ravel()
    covariance = belief.covariance.at[at].set(cross, mode="drop").at[:, at].set(cross.T, mode="drop")
    covariance = covariance.at[at[:, None], at].set(symmetric(among.reshape(2 * count, -1)), mode="drop")
    depth = frame.points[:, 2]
    heights = jnp.stack([height_of(frame.points, depth, assumed), pixel_noise(depth, assumed)], axis=-1)
    return belief._replace(
        places=belief.places.at[rows].set(places, mode="drop"), covariance=covariance,
        heights=belief.heights.at[rows].set(heights, mode="drop"),
        descriptors=belief.descriptors.at[rows].set(frame.descriptors, mode="drop"),
        counts=belief.counts.at[rows].set(1, mode="drop"),
        true_ids=belief.true_ids.at[rows].set(frame.true_ids, mode="drop"),
        owners=belief.owners.at[rows].set(belief.groups[robots], mode="drop"),
    )  # fmt: skip


def observe(belief: Belief, frames: Frame, assumed: Assumed) -> Belief:
    """Return the belief given the frames of all robots, which have a first dimension K."""
    matches = jax.vmap(match, (None, 0, 0, None))(belief, jnp.arange(len(belief.robots)), frames, assumed)
    return insert(update(belief, frames, matches.rows, assumed), frames, matches.new, assumed)


def step(belief: Belief, odometry: Array, frames: Frame, assumed: Assumed) -> Belief:
    """Return the belief after a tick: readings of the odometry (K, 3) and of the cameras."""
    return observe(predict(belief, odometry, assumed), frames, assumed)
