"""The filter in its plainest form, beside Algorithm 1: one particle, one landmark, one 3 x 3 matrix at a time.

It is the textbook with which `slam_backend.filter.FastSlam` has to agree, decision by decision. Random numbers are
consumed in the same order: for each robot that moved or measured one normal triple per particle, then the resampling.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose, wrap_angle
from slam_backend.measurements import Measurements
from slam_backend.plain.frame import Frame, Landmark, Prior, turn_about_vertical
from slam_backend.resampling import RESAMPLING

REJECTED = -1
NEW = -2  # minus b: the landmark that measurement b starts, until all particles have decided and it gets its name
Candidates = list[list[tuple[float, int]]]  # per measurement (squared descriptor distance E, landmark), nearest first


@dataclass
class Particle:
    """One hypothesis (Eq. 19): the poses of the K robots and the map conditioned on their paths."""

    poses: list[FloatArray]
    posteriors: list[Prior]  # of the poses, before they were sampled
    starts: list[FloatArray]
    log_weight: float
    path_log_weight: float = 0.0
    landmarks: dict[int, Landmark] = field(default_factory=dict)


class PlainFastSlam:
    """What `FastSlam` does.

    Args:
        num_robots: K.
        options: As of `FastSlam`.
        seed: Of the random stream.
        initial_poses: (K, 3), map frame; None: the origin.
    """

    def __init__(self, num_robots: int, options: FilterOptions, seed: int, initial_poses: Any = None) -> None:
        self.options = options
        self.rng = np.random.default_rng(seed)
        starts = list(np.zeros((num_robots, 3)) if initial_poses is None else np.asarray(initial_poses))
        weight = -np.log(options.num_particles)
        exact = [Prior(start, np.zeros((3, 3))) for start in starts]
        self.particles = [
            Particle(list(starts), list(exact), list(starts), weight) for _ in range(options.num_particles)
        ]
        self.descriptors: dict[int, FloatArray] = {}
        self.identities: dict[int, int] = {}
        self.next_id = 0
        self.ess = float(options.num_particles)
        self.resampled = False

    def step(
        self,
        odometry: Sequence[FloatArray | None],
        measurements: Sequence[Measurements | None],
        identities: Sequence[Sequence[int] | None] | None = None,
        poses: Sequence[FloatArray | None] | None = None,
    ) -> list[list[list[int]]]:
        """Do one step; return per robot, particle and used measurement the landmark to which it was given."""
        log_likelihoods = np.zeros(len(self.particles))
        decisions: list[list[list[int]]] = []
        measured = False
        for robot, (move, seen) in enumerate(zip(odometry, measurements, strict=True)):  # Algorithm 1, l. 6-8
            names = None if identities is None else identities[robot]
            exact = None if poses is None else poses[robot]
            seen = Measurements.empty() if seen is None else seen
            kept = [b for b in range(len(seen)) if names is None or names[b] >= 0]
            frame = Frame(seen, kept, None if names is None else [names[b] for b in kept], self.options.camera)
            if move is None and exact is None and not kept:
                decisions.append([[] for _ in self.particles])
                continue
            normals = self.rng.standard_normal((len(self.particles), 3))
            found = []
            for m, particle in enumerate(self.particles):  # l. 13
                before = particle.poses[robot] if exact is None else compose(particle.starts[robot], exact)
                prior = self._predict(before, move if exact is None else None)
                if self.options.proposal == "fastslam1":
                    advanced = self._fastslam1(particle, prior, frame, normals[m])
                else:
                    advanced = self._fastslam2(particle, prior, frame, normals[m], is_exact=exact is not None)
                posterior, pose, chosen, log_likelihood = advanced
                particle.posteriors[robot], particle.poses[robot] = posterior, pose
                found.append(chosen)
                log_likelihoods[m] += log_likelihood  # l. 9, in logarithms
            decisions.append(self._name_new(found, frame))
            measured |= bool(kept)
        self._weigh(log_likelihoods, measured)
        return decisions

    def _predict(self, before: FloatArray, move: FloatArray | None) -> Prior:
        """Return the prior of the pose after a motion; its noise is added in the robot's own previous frame."""
        if move is None:
            return Prior(before, np.zeros((3, 3)))
        turn = turn_about_vertical(before[2])
        return Prior(before + turn @ move, turn @ np.diag(self.options.motion.sigmas(move)))

    def _candidates(self, particle: Particle, frame: Frame) -> Candidates:
        """Return, for each measurement, the particle's landmarks that may have caused it."""
        result: Candidates = []
        for b in range(len(frame)):
            found = []
            for name in particle.landmarks:
                e = float(np.sum((frame.descriptors[b] - self.descriptors[name]) ** 2))  # l. 20
                by_name = frame.names is not None and frame.names[b] == self.identities[name]
                if by_name or (frame.names is None and e <= self.options.descriptor_gate**2):
                    found.append((e, name))
            result.append(sorted(found))
        return result

    # ------------------------------------------------------------------ fastslam1

    def _fastslam1(
        self, particle: Particle, prior: Prior, frame: Frame, normals: FloatArray
    ) -> tuple[Prior, FloatArray, list[int], float]:
        """Sample the pose from the odometry alone; match, weigh and update one measurement after the other."""
        options = self.options
        pose = wrapped(prior.mean + prior.root @ normals)  # l. 14, Eq. 4
        known = Prior(pose, np.zeros((3, 3)))
        chosen: list[int] = []
        total = 0.0
        for b, candidates in enumerate(self._candidates(particle, frame)):
            match = REJECTED
            for _, name in candidates:  # l. 15-24, the nearest descriptor first
                if options.one_to_one and name in chosen:
                    continue
                gate = frame.compare(known, particle.landmarks[name], b)
                if gate is not None and (frame.names is not None or gate.distance <= options.position_gate):
                    match, log_density = name, gate.log_density
                    break
            if match == REJECTED:  # l. 28-32
                match, log_density = NEW - b, frame.log_clutter(b, options.new_landmark_density)
                particle.landmarks[match] = frame.new_landmark(pose, b)
            else:  # l. 33-37
                frame.update(pose, particle.landmarks[match], b, iterations=1)
            chosen.append(match)
            total += log_density  # l. 39, from before the update
        return known, pose, chosen, total

    # ------------------------------------------------------------------ fastslam2

    def _fastslam2(
        self, particle: Particle, prior: Prior, frame: Frame, normals: FloatArray, is_exact: bool
    ) -> tuple[Prior, FloatArray, list[int], float]:
        """Let the measurements shape the pose that is sampled; associate in two passes."""
        options = self.options
        candidates = self._candidates(particle, frame)
        passes = 1
        if options.recovery_position > 0.0 and not is_exact and self._is_lost(particle, prior, frame, candidates):
            sigmas = [options.recovery_position, options.recovery_position, options.recovery_heading]
            prior, passes = Prior(prior.mean, np.diag(sigmas)), 2
        tentative = self._beyond_doubt(particle, prior, frame, candidates)
        refined = prior
        for _ in range(passes):
            refined, _ = self._refine(particle, prior, refined.xi, frame, tentative, robust=options.position_gate)
        chosen, log_unmatched = self._decide(particle, refined, frame, candidates)
        matches = {b: name for b, name in enumerate(chosen) if name >= 0}
        posterior, log_evidence = self._refine(particle, prior, refined.xi, frame, matches, robust=None)
        pose = posterior.pose + posterior.root @ np.linalg.cholesky(posterior.spread) @ normals
        for b, name in enumerate(chosen):
            if name >= 0:
                frame.update(pose, particle.landmarks[name], b, iterations=2)
            elif name != REJECTED:
                particle.landmarks[name] = frame.new_landmark(pose, b)
        return posterior, wrapped(pose), chosen, log_unmatched + log_evidence

    def _is_lost(self, particle: Particle, prior: Prior, frame: Frame, candidates: Candidates) -> bool:
        """Tell whether three or more, and most, of the measurements with one look-alike contradict the prior."""
        verdicts = []
        for b, possible in enumerate(candidates):
            looks = [e / self.options.descriptor_sigma**2 for e, _ in possible]
            if looks and (len(looks) == 1 or looks[1] - looks[0] >= self.options.ambiguity):
                gate = frame.compare(prior, particle.landmarks[possible[0][1]], b)
                verdicts.append(gate is None or gate.distance > self.options.position_gate)
        return sum(verdicts) >= 3 and 2 * sum(verdicts) > len(verdicts)

    def _beyond_doubt(self, particle: Particle, prior: Prior, frame: Frame, candidates: Candidates) -> dict[int, int]:
        """Pass A: match, at the predicted pose, what has one good candidate and no good second."""
        matches: dict[int, int] = {}
        for b, possible in enumerate(candidates):
            costs = []
            for e, name in possible:
                gate = frame.compare(prior, particle.landmarks[name], b)
                if gate is not None and (frame.names is not None or gate.distance <= self.options.position_gate):
                    costs.append((gate.cost + e / self.options.descriptor_sigma**2, name))
            costs.sort()
            clear = len(costs) == 1 or (len(costs) > 1 and costs[1][0] - costs[0][0] >= self.options.ambiguity)
            if clear and costs[0][1] not in matches.values():
                matches[b] = costs[0][1]
        return matches

    def _decide(
        self, particle: Particle, refined: Prior, frame: Frame, candidates: Candidates
    ) -> tuple[list[int], float]:
        """Pass B: match, hold back or start a landmark, at the refined pose.

        Returns:
            The choices, and the log-likelihood of the measurements that were not matched.
        """
        options = self.options
        chosen: list[int] = []
        total = 0.0
        for b, possible in enumerate(candidates):
            is_dead = False
            costs = []
            for e, name in possible:
                gate = frame.compare(refined, particle.landmarks[name], b)
                if gate is None:
                    continue
                if frame.names is not None:
                    gate = gate.within(options.position_gate)
                near = frame.metres(refined, particle.landmarks[name], b) <= options.dead_radius
                is_dead |= near or gate.distance <= options.dead_zone
                if gate.distance <= options.position_gate and name not in chosen:
                    costs.append((gate.cost + e / options.descriptor_sigma**2, name, gate.log_density))
            costs.sort()
            if len(costs) > 1 and costs[1][0] - costs[0][0] < options.ambiguity:
                chosen.append(REJECTED)  # held back; yet it is explained as well as its better candidate explains it
                total += costs[0][2]
            elif costs:
                chosen.append(costs[0][1])
            else:
                chosen.append(REJECTED if is_dead else NEW - b)
                total += frame.log_clutter(b, options.new_landmark_density)
        return chosen, total

    def _refine(
        self,
        particle: Particle,
        prior: Prior,
        xi: FloatArray,
        frame: Frame,
        matches: dict[int, int],
        robust: float | None,
    ) -> tuple[Prior, float]:
        """Go from xi to the mode of p(pose, matched measurements) by two steps of Gauss-Newton.

        Returns:
            The posterior N(x^, P^), and log p(measurements) by Laplace's formula:
            log p(z | x^) + log p(xi^) + 3/2 log 2 pi - 1/2 log|L|.
        """
        for iteration in range(3):
            here = Prior(prior.mean, prior.root, xi)
            information, gradient, log_likelihood = np.eye(3), xi.copy(), 0.0
            for b, name in matches.items():
                term = frame.linearise(here, particle.landmarks[name], b)
                if term is None:
                    continue
                weight = 1.0 if robust is None else 1.0 / (1.0 + term.distance / robust)  # Cauchy
                jacobian = term.by_pose @ prior.root
                information += weight * jacobian.T @ np.linalg.solve(term.covariance, jacobian)
                gradient -= weight * jacobian.T @ np.linalg.solve(term.covariance, term.innovation)
                log_likelihood += term.log_density
            if iteration < 2:
                xi = xi - np.linalg.solve(information, gradient)
        log_likelihood -= 0.5 * (xi @ xi + np.linalg.slogdet(information)[1])
        spread = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return Prior(prior.mean, prior.root, xi, spread), float(log_likelihood)

    # ------------------------------------------------------------------ all particles

    def _name_new(self, found: list[list[int]], frame: Frame) -> list[list[int]]:
        """Give each landmark that at least one particle has started its lasting name, one per measurement."""
        names = {}
        for b in range(len(frame)):
            if any(chosen[b] == NEW - b for chosen in found):
                names[NEW - b] = self.next_id
                self.descriptors[self.next_id] = frame.descriptors[b]
                self.identities[self.next_id] = -1 if frame.names is None else frame.names[b]
                self.next_id += 1
        for particle in self.particles:
            particle.landmarks = {names.get(name, name): one for name, one in particle.landmarks.items()}
        return [[names.get(name, name) for name in chosen] for chosen in found]

    def _weigh(self, log_likelihoods: FloatArray, measured: bool) -> None:
        """Multiply the weights of before by this step's (Eqs. 3, 11), normalise, and resample if needed (l. 9-10)."""
        for particle, value in zip(self.particles, log_likelihoods, strict=True):
            particle.path_log_weight += value  # Eq. 12, along the ancestral line
            particle.log_weight += value
        log_sum = np.logaddexp.reduce([p.log_weight for p in self.particles])
        for particle in self.particles:
            particle.log_weight -= log_sum
        weights = np.exp([p.log_weight for p in self.particles])
        self.ess = float(1.0 / np.sum(weights**2))
        self.resampled = measured and self.ess <= self.options.resample_threshold * len(weights) * (1.0 + 1e-12)
        if self.resampled:
            ancestors = RESAMPLING[self.options.resampling](weights, self.rng)
            self.particles = [copy.deepcopy(self.particles[a]) for a in ancestors]
            for particle in self.particles:
                particle.log_weight = -np.log(len(weights))


def wrapped(pose: FloatArray) -> FloatArray:
    """Return the pose with its heading in [-pi, pi)."""
    return np.array([pose[0], pose[1], wrap_angle(pose[2])])
