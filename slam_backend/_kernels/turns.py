"""The turns of a step: one robot after the other moves, and matches what it sees to the map of those before it."""

import math

import numpy as np

from slam_backend._jit import jit
from slam_backend._kernels.candidates import to_robot_axes
from slam_backend._kernels.fastslam1 import update_fastslam1
from slam_backend._kernels.fastslam2 import update_fastslam2
from slam_backend._kernels.motion import move_blind
from slam_backend.errors import BoolArray, Float32Array, FloatArray, Int32Array, IntArray

IDLE, STOOD, MOVED, PLACED = 0, 1, 2, 3  # what a robot did: nothing at all, stood and looked, moved, was told its pose


@jit
def write_sigmas(noise: FloatArray, move: FloatArray, sigmas: FloatArray) -> None:
    """Write the standard deviations (3,) [m, m, rad] of an odometry reading (3,), as `OdometryModel.sigmas` says."""
    distance = math.hypot(move[0], move[1])
    sigmas[0] = math.hypot(noise[0] * distance, noise[4])
    sigmas[1] = math.hypot(noise[1] * distance, noise[4])
    sigmas[2] = math.hypot(math.hypot(noise[2] * distance, noise[3] * move[2]), noise[5])


@jit
def take_turns(
    low: int, high: int, sighting: bool, acts: IntArray, moves: FloatArray, noise: FloatArray, normals: FloatArray,
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: BoolArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    firsts: IntArray, measured: FloatArray, spreads: FloatArray, given: BoolArray, descriptors: Float32Array,
    names: IntArray, named: BoolArray, camera: FloatArray,
    descriptor_gate: float, descriptor_variance: float, position_gate: float, dead_zone: float, dead_radius: float,
    ambiguity: float, recovery: FloatArray, log_p0: float, walk: float, one_to_one: bool,
    points: FloatArray, noises: FloatArray, work: FloatArray, records: FloatArray, found: Int32Array,
    distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match, weigh and update landmarks (Algorithm 1, l. 6-8).

    Args:
        low, high: Whose turns are taken.
        sighting: Whether measurements shape the sampled pose (FastSLAM 2.0).
        acts: (K,) what each robot did: `IDLE`, `STOOD`, `MOVED`, or `PLACED`, with the pose already in `poses`.
        moves: (K, 3) odometry [m, m, rad] of those that moved.
        noise: (6,) the odometry model: sigmas along, across, of heading, of turns, floors of position and heading.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        poses, means, covariances: (K, 3, P), (K, 3, P), (K, 6, P) samples x_t^[m], and N(x^, P^) before sampling.
        blind: (K,) whether that was propagated since the last sighting.
        firsts: (K + 1,) where each robot's measurements begin among all n.
        measured: (n, 3) [m], camera frame.
        spreads: (n, 3, 3) [m^2], camera frame, their covariances, of the robots that `given` (K,) tells of.
        names: (n,) the caller's names, of the robots that `named` (K,) tells of.
        points, noises: (n, 3), (n, 6), written: `measured` and `spreads` in robot axes.
        The others are as in `update_fastslam2`; those of measurements are of all robots.
    """
    still, sigmas, drawn = np.zeros(3), np.zeros(3), -1
    for robot in range(high):
        drawn += acts[robot] != IDLE
        if robot < low or acts[robot] == IDLE:
            continue
        a, b = firsts[robot], firsts[robot + 1]
        own_spreads = spreads[a:b] if given[robot] else spreads[:0]
        to_robot_axes(measured[a:b], own_spreads, points[a:b], noises[a:b])
        move, placed = still, acts[robot] == PLACED
        sigmas[:] = 0.0
        if acts[robot] == MOVED:
            move = moves[robot]
            write_sigmas(noise, move, sigmas)
        own_poses, own_means, own_covariances = poses[robot], means[robot], covariances[robot]
        was_blind = blind[robot] and not placed
        lost = still if placed else recovery
        if not sighting:
            update_fastslam1(
                own_poses, own_means, own_covariances, not placed, move, sigmas, normals[drawn],
                values, counts, odds, row_of, map_of, maps, users, free_rows, free_slots, tops, ids, identities, stored,
                heads, points[a:b], noises[a:b], given[robot], camera, descriptors[a:b], names[a:b], named[robot],
                descriptor_gate, position_gate, log_p0, walk, one_to_one,
                work, records, found[a:b], distances[a:b], new_slots[a:b], log_likelihood,
            )  # fmt: skip
        elif b > a:
            update_fastslam2(
                own_poses, own_means, own_covariances, was_blind, move, sigmas, normals[drawn],
                values, counts, odds, row_of, map_of, maps, users, free_rows, free_slots, tops, ids, identities, stored,
                heads, points[a:b], noises[a:b], given[robot], camera, descriptors[a:b], names[a:b], named[robot],
                descriptor_gate, descriptor_variance, position_gate, dead_zone, dead_radius, ambiguity,
                lost, log_p0, walk, one_to_one,
                work, records, found[a:b], distances[a:b], new_slots[a:b], log_likelihood,
            )  # fmt: skip
            was_blind = False
        elif placed:
            own_means[:] = own_poses
            own_covariances[:] = 0.0
        else:
            move_blind(own_poses, own_means, own_covariances, was_blind, move, sigmas, normals[drawn], work)
            was_blind = True
        blind[robot] = was_blind
