"""Update of one robot with the proposal of FastSLAM 2.0, which includes the measurements.

Montemerlo et al., FastSLAM 2.0 (IJCAI 2003), extended to frames of several measurements with unknown association:
matches that are unambiguous at the predicted pose refine the pose; there each measurement is matched, rejected or
starts a landmark; the matches give the Gaussian from which the pose is sampled, and the weight.
"""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.reference.measurement_model import Frame, Innovation, log_density
from slam_backend.reference.particles import NEW, REJECTED, Candidates, Landmarks, RobotUpdate, is_held
from slam_backend.reference.pose_gaussian import GaussianPose, WhitenedPose

WIDE_HEADING = 0.03  # [rad]; a larger sigma of the predicted heading needs more iterations
MORE_ITERATIONS = 3
RELINEARISE_UP_TO = 4  # largest count of a landmark updated by the iterated EKF, as its depth is still uncertain

Gates = dict[tuple[int, int], Innovation]  # by measurement and landmark, for visible candidates


def update_fastslam2(
    landmarks: Landmarks,
    prior: GaussianPose,
    frame: Frame,
    candidates: Candidates,
    normals: FloatArray,
    options: FilterOptions,
    is_exact: bool,
) -> RobotUpdate:
    """Associate in two passes, sample the pose, weigh the particle and update its map.

    Args:
        landmarks: Map of the particle, changed.
        prior: Pose after the motion.
        frame: Measurements of the robot, at least one.
        candidates: Candidate landmarks of the particle for each measurement.
        normals: (3,) standard normal numbers, from which the pose is sampled.
        options: Options of the filter.
        is_exact: Whether the caller gave the pose; recovery is then disabled.

    Returns:
        The associations, the sampled pose and the log-evidence of the frame.
    """
    predicted = WhitenedPose.of(prior)
    iterations = 1 + MORE_ITERATIONS * bool(prior.covariance[2, 2] > WIDE_HEADING**2)
    gates = gates_at(predicted, landmarks, frame, candidates)  # first pass
    tentative = unambiguous_matches(gates, frame, candidates, options)
    refined = refine(predicted, landmarks, frame, tentative, iterations, options.position_gate)
    if options.recovery_position > 0.0 and not is_exact:
        wide = np.diag([options.recovery_position, options.recovery_position, options.recovery_heading]) ** 2
        inflated = WhitenedPose.of(GaussianPose(prior.mean, wide))
        wide_gates = gates_at(inflated, landmarks, frame, candidates)
        if is_lost(gates, wide_gates, candidates, options):
            tentative = unambiguous_matches(wide_gates, frame, candidates, options)
            found = refine(inflated, landmarks, frame, tentative, 1 + MORE_ITERATIONS, options.position_gate)
            if is_confirmed(found, landmarks, frame, tentative, options):
                refined, gates = found, wide_gates
    chosen, log_unmatched = decide(refined, landmarks, frame, candidates, options)  # second pass
    matches = {b: name for b, name in enumerate(chosen) if name >= 0}
    posterior, log_evidence = pose_given(refined, landmarks, frame, matches)
    pose = posterior.sample(normals)
    walk = options.landmark_walk
    for b, name in enumerate(chosen):
        if name >= 0:
            frame.update(
                pose, landmarks[name], b, walk, iterations=2 if landmarks[name].count <= RELINEARISE_UP_TO else 1
            )
        elif name != REJECTED:
            landmarks[name] = frame.new_landmark(pose, b, walk)
    distances = [np.nan] * len(frame)
    for b, name in matches.items():
        distances[b] = gates[b, name].distance if (b, name) in gates else np.inf
    belief = GaussianPose(posterior.pose, posterior.covariance)
    return RobotUpdate(belief, pose, chosen, distances, log_unmatched + log_evidence)


def gates_at(here: WhitenedPose, landmarks: Landmarks, frame: Frame, candidates: Candidates) -> Gates:
    """Return the innovation of each measurement and visible candidate, pose uncertainty included.

    Args:
        here: Estimated pose of the robot, map frame.
        landmarks: Map of the particle.
        frame: Measurements of the robot (n).
        candidates: Candidate landmarks of the particle for each measurement.
    """
    gates: Gates = {}
    for b, possible in enumerate(candidates):
        for _, name in possible:
            term = frame.compare(here.pose, landmarks[name], b)
            if term is not None:
                gates[b, name] = term.widened(here.covariance)
    return gates


def is_lost(gates: Gates, wide_gates: Gates, candidates: Candidates, options: FilterOptions) -> bool:
    """Return whether a wide prior explains at least three measurements, and most of those it can, that the pose cannot.

    A measurement that even the wide prior cannot explain says nothing about the pose: it may be of a new landmark.

    Args:
        gates: Innovations under the pose's own prior.
        wide_gates: Innovations under the wide prior.
        candidates: Argument of `gates_at`.
        options: Options of the filter; within `position_gate` a measurement is explained.
    """
    verdicts = []
    for b, possible in enumerate(candidates):
        narrow, wide = (
            min((found[b, name].distance for _, name in possible if (b, name) in found), default=np.inf)
            for found in (gates, wide_gates)
        )
        if wide <= options.position_gate:
            verdicts.append(narrow > options.position_gate)
    return sum(verdicts) >= 3 and 2 * sum(verdicts) > len(verdicts)


def is_confirmed(
    found: WhitenedPose, landmarks: Landmarks, frame: Frame, matches: dict[int, int], options: FilterOptions
) -> bool:
    """Return whether at least three matches hold together at the pose found with a wide prior.

    The wide prior explains each measurement by itself, at poses that need not agree.

    Args:
        found: Pose refined with the wide prior.
        landmarks: Map of the particle.
        frame: Measurements of the robot.
        matches: Landmark by measurement, as matched with the wide prior.
        options: Options of the filter; within `position_gate` a match holds.
    """
    terms = [frame.compare(found.pose, landmarks[name], b) for b, name in matches.items()]
    holding = [term for term in terms if term and term.widened(found.covariance).distance <= options.position_gate]
    return len(holding) >= 3


def unambiguous_matches(gates: Gates, frame: Frame, candidates: Candidates, options: FilterOptions) -> dict[int, int]:
    """Match at the predicted pose each measurement with one good candidate and no good second one.

    Args:
        gates: Innovations at the predicted pose.
        frame, candidates: Arguments of `gates_at`.
        options: Options of the filter: gates, ambiguity margin, and one-to-one matching.

    Returns:
        Landmark by measurement.
    """
    matches: dict[int, int] = {}
    for b, possible in enumerate(candidates):
        costs = []
        for e, name in possible:
            gate = gates.get((b, name))
            if gate is not None and (frame.identities is not None or gate.distance <= options.position_gate):
                costs.append((gate.distance + gate.log_det + e / options.descriptor_sigma**2, name))
        costs.sort()
        if not costs or (len(costs) > 1 and costs[1][0] - costs[0][0] < options.ambiguity_margin):
            continue
        name = costs[0][1]
        if not (options.one_to_one and name in matches.values()):
            matches[b] = name
    return matches


def refine(
    predicted: WhitenedPose,
    landmarks: Landmarks,
    frame: Frame,
    matches: dict[int, int],
    iterations: int,
    scale: float,
) -> WhitenedPose:
    """Approach the mode of p(pose, matched measurements) by Gauss-Newton, with weights 1 / (1 + D / scale) (Cauchy).

    D includes the present uncertainty of the pose: a single wrong match has little weight once the others agree.

    Args:
        predicted: Pose before the measurements, the initial value.
        landmarks: Map of the particle.
        frame: Measurements of the robot.
        matches: Landmark by measurement.
        iterations: Number of Gauss-Newton iterations.
        scale: Squared Mahalanobis distance [-] at which a match has half its weight.
    """
    here = predicted
    for _ in range(iterations):
        information, gradient = np.eye(3), here.xi
        for b, name in matches.items():
            term = frame.compare(here.pose, landmarks[name], b)
            if term is None:
                continue
            weight = 1.0 / (1.0 + term.widened(here.covariance).distance / scale)
            term_information, slope = term.in_terms_of(here.root)
            information = information + weight * term_information
            gradient = gradient + weight * slope
        here = here.at(here.xi - np.linalg.solve(information, gradient), information)
    return here


def decide(
    refined: WhitenedPose, landmarks: Landmarks, frame: Frame, candidates: Candidates, options: FilterOptions
) -> tuple[list[int], float]:
    """Match, reject or start a landmark, measurement by measurement, at the refined pose.

    Args:
        refined: Result of `refine`.
        landmarks, frame, candidates: Arguments of `gates_at`.
        options: Options of the filter: gates, ambiguity margin, dead zone, and one-to-one matching.

    Returns:
        The associations, and the log-likelihood of the measurements that were not matched.
    """
    gates = gates_at(refined, landmarks, frame, candidates)
    chosen: list[int] = []
    total = 0.0
    for b, possible in enumerate(candidates):
        is_dead = frame.identities is not None and is_held(b, possible, chosen, frame.identities)
        costs = []
        for e, name in possible:
            gate = gates.get((b, name))
            if gate is None:
                continue
            distance = gate.distance if frame.identities is None else min(gate.distance, options.position_gate)
            is_dead |= distance <= options.new_landmark_gate
            is_dead |= frame.metres(refined.pose, landmarks[name], b) <= options.new_landmark_radius
            if distance <= options.position_gate and not (options.one_to_one and name in chosen):
                cost = distance + gate.log_det + e / options.descriptor_sigma**2
                costs.append((cost, name, log_density(distance, gate.log_det)))
        costs.sort()
        if len(costs) > 1 and costs[1][0] - costs[0][0] < options.ambiguity_margin:
            chosen.append(REJECTED)  # ambiguous, but as likely as its best candidate makes it
            total += costs[0][2]
        elif costs:
            chosen.append(costs[0][1])
        else:
            chosen.append(REJECTED if is_dead else NEW - b)
            total += frame.log_clutter(b, options.new_landmark_density)
    return chosen, total


def pose_given(
    refined: WhitenedPose, landmarks: Landmarks, frame: Frame, matches: dict[int, int]
) -> tuple[WhitenedPose, float]:
    """Return the posterior of the pose given the matched measurements, linearised at the refined pose.

    Args:
        refined: Result of `refine`.
        landmarks: Map of the particle before its update.
        frame: Measurements of the robot.
        matches: Landmark by measurement, all visible from the refined pose.

    Returns:
        The posterior, and the log-evidence of the measurements, exact for the linearised model.
    """
    xi = refined.xi
    information, gradient = np.eye(3), xi
    log_evidence = -0.5 * float(xi @ xi)
    for b, name in matches.items():
        term = frame.compare(refined.pose, landmarks[name], b)
        assert term is not None, "matches are visible from the refined pose"
        term_information, slope = term.in_terms_of(refined.root)
        information = information + term_information
        gradient = gradient + slope
        log_evidence += term.log_density
    step = np.linalg.solve(information, gradient)
    log_evidence += 0.5 * float(gradient @ step - np.linalg.slogdet(information)[1])
    return refined.at(xi - step, information), log_evidence
