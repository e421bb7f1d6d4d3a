"""One robot's turn with the proposal of FastSLAM 2.0: the measurements shape the pose that is sampled.

Montemerlo et al., FastSLAM 2.0 (IJCAI 2003), for frames of several measurements with unknown association: what is
beyond doubt at the predicted pose refines the pose; there every measurement is matched, held back or becomes a
landmark; the matches give the Gaussian from which the pose is sampled, and the weight.
"""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.reference.measurement_model import Frame, Innovation, log_density
from slam_backend.reference.particles import NEW, REJECTED, Candidates, Landmarks, RobotUpdate, is_held
from slam_backend.reference.pose_gaussian import GaussianPose, WhitenedPose

WIDE_HEADING = 0.03  # [rad]; a predicted heading less certain than this asks for more iterations
MORE_ITERATIONS = 3
RELINEARISE_BELOW = 4  # a landmark seen up to so many times is updated by the iterated EKF: its depth is still vague

Gates = dict[tuple[int, int], Innovation]  # by measurement and landmark, for the candidates that can be seen


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
        landmarks: The particle's map; it is changed.
        prior: Of the pose, after the motion.
        frame: What the robot measured, at least one measurement.
        candidates: Per measurement the landmarks of the particle that may have caused it.
        normals: (3,) standard normal numbers, from which the pose is sampled.
        options: Of the filter.
        is_exact: Whether the caller gave the pose, which is then never doubted.

    Returns:
        The choices, the sampled pose and the log-evidence of the frame.
    """
    predicted = WhitenedPose.of(prior)
    iterations = 1 + MORE_ITERATIONS * bool(prior.covariance[2, 2] > WIDE_HEADING**2)
    gates = gates_at(predicted, landmarks, frame, candidates)  # pass A
    if options.recovery_position > 0.0 and not is_exact:
        doubt = np.diag([options.recovery_position, options.recovery_position, options.recovery_heading]) ** 2
        doubtful = WhitenedPose.of(GaussianPose(prior.mean, doubt))
        wide_gates = gates_at(doubtful, landmarks, frame, candidates)
        if is_lost(gates, wide_gates, candidates, options):
            predicted, gates, iterations = doubtful, wide_gates, 1 + MORE_ITERATIONS
    tentative = unambiguous_matches(gates, frame, candidates, options)
    refined = refine(predicted, landmarks, frame, tentative, iterations, options.position_gate)
    chosen, log_unmatched = decide(refined, landmarks, frame, candidates, options)  # pass B
    matches = {b: name for b, name in enumerate(chosen) if name >= 0}
    posterior, log_evidence = pose_given(refined, landmarks, frame, matches)
    pose = posterior.sample(normals)
    walk = options.landmark_walk
    for b, name in enumerate(chosen):
        if name >= 0:
            frame.update(
                pose, landmarks[name], b, walk, iterations=2 if landmarks[name].count <= RELINEARISE_BELOW else 1
            )
        elif name != REJECTED:
            landmarks[name] = frame.new_landmark(pose, b, walk)
    distances = [np.nan] * len(frame)
    for b, name in matches.items():
        distances[b] = gates[b, name].distance if (b, name) in gates else np.inf
    belief = GaussianPose(posterior.pose, posterior.covariance)
    return RobotUpdate(belief, pose, chosen, distances, log_unmatched + log_evidence)


def gates_at(here: WhitenedPose, landmarks: Landmarks, frame: Frame, candidates: Candidates) -> Gates:
    """Compare each measurement with each of its candidates that can be seen, the doubt about the pose included.

    Args:
        here: Where the robot may be, map frame.
        landmarks: The particle's map.
        frame: What the robot measured (n measurements).
        candidates: Per measurement the landmarks of the particle that may have caused it.
    """
    gates: Gates = {}
    for b, possible in enumerate(candidates):
        for _, name in possible:
            term = frame.compare(here.pose, landmarks[name], b)
            if term is not None:
                gates[b, name] = term.widened(here.covariance)
    return gates


def is_lost(gates: Gates, wide_gates: Gates, candidates: Candidates, options: FilterOptions) -> bool:
    """Tell whether a wide prior explains three or more, and most, of what it can explain better than the pose's own.

    A measurement that even the wide prior cannot explain says nothing about the pose: it may be of a new landmark.

    Args:
        gates: Under the pose's own prior.
        wide_gates: Under the wide one.
        candidates: As in `gates_at`.
        options: Of the filter; `position_gate` says what is explained.
    """
    verdicts = []
    for b, possible in enumerate(candidates):
        own, wide = (
            min((found[b, name].distance for _, name in possible if (b, name) in found), default=np.inf)
            for found in (gates, wide_gates)
        )
        if wide <= options.position_gate:
            verdicts.append(own > options.position_gate)
    return sum(verdicts) >= 3 and 2 * sum(verdicts) > len(verdicts)


def unambiguous_matches(gates: Gates, frame: Frame, candidates: Candidates, options: FilterOptions) -> dict[int, int]:
    """Match, at the predicted pose, each measurement that has one good candidate and no good second.

    Args:
        gates: At the predicted pose.
        frame, candidates: As in `gates_at`.
        options: Of the filter: its gates, its ambiguity, and whether matches are one-to-one.

    Returns:
        Landmark by measurement.
    """
    matches: dict[int, int] = {}
    for b, possible in enumerate(candidates):
        costs = []
        for e, name in possible:
            gate = gates.get((b, name))
            if gate is not None and (frame.names is not None or gate.distance <= options.position_gate):
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
    """Go towards the mode of p(pose, matched measurements) by Gauss-Newton, with weights 1 / (1 + D / scale) (Cauchy).

    D counts what is known of the pose so far: one wrong match hardly counts once the right ones agree.

    Args:
        predicted: The pose before the measurements, where it starts.
        landmarks: The particle's map.
        frame: What the robot measured.
        matches: Landmark by measurement.
        iterations: Steps of Gauss-Newton.
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
            told, slope = term.in_terms_of(here.root)
            information = information + weight * told
            gradient = gradient + weight * slope
        here = here.at(here.xi - np.linalg.solve(information, gradient), information)
    return here


def decide(
    refined: WhitenedPose, landmarks: Landmarks, frame: Frame, candidates: Candidates, options: FilterOptions
) -> tuple[list[int], float]:
    """Match, hold back, pass over or start a landmark, measurement by measurement, at the refined pose.

    Args:
        refined: The pose that `refine` found.
        landmarks, frame, candidates: As in `gates_at`.
        options: Of the filter: its gates, its ambiguity, its dead zone, and whether matches are one-to-one.

    Returns:
        The choices, and the log-likelihood of the measurements that were not matched.
    """
    gates = gates_at(refined, landmarks, frame, candidates)
    chosen: list[int] = []
    total = 0.0
    for b, possible in enumerate(candidates):
        is_dead = frame.names is not None and is_held(b, possible, chosen, frame.names)
        costs = []
        for e, name in possible:
            gate = gates.get((b, name))
            if gate is None:
                continue
            distance = gate.distance if frame.names is None else min(gate.distance, options.position_gate)
            is_dead |= distance <= options.new_landmark_gate
            is_dead |= frame.metres(refined.pose, landmarks[name], b) <= options.new_landmark_radius
            if distance <= options.position_gate and not (options.one_to_one and name in chosen):
                cost = distance + gate.log_det + e / options.descriptor_sigma**2
                costs.append((cost, name, log_density(distance, gate.log_det)))
        costs.sort()
        if len(costs) > 1 and costs[1][0] - costs[0][0] < options.ambiguity_margin:
            chosen.append(REJECTED)  # held back; yet it is explained as well as its better candidate explains it
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
        refined: The pose that `refine` found.
        landmarks: The particle's map, before it is updated.
        frame: What the robot measured.
        matches: Landmark by measurement; each can be seen from the refined pose.

    Returns:
        The posterior, and the log-evidence of the measurements: of the linearised model, without approximation.
    """
    xi = refined.xi
    information, gradient = np.eye(3), xi
    log_evidence = -0.5 * float(xi @ xi)
    for b, name in matches.items():
        term = frame.compare(refined.pose, landmarks[name], b)
        assert term is not None, "what cannot be seen from the refined pose is not matched there"
        told, slope = term.in_terms_of(refined.root)
        information = information + told
        gradient = gradient + slope
        log_evidence += term.log_density
    step = np.linalg.solve(information, gradient)
    log_evidence += 0.5 * float(gradient @ step - np.linalg.slogdet(information)[1])
    return refined.at(xi - step, information), log_evidence
