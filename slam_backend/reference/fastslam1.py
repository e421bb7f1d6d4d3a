"""Update of one robot with the proposal of the paper, the motion model alone (Algorithm 1, l. 14-41)."""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.reference.measurement_model import Frame
from slam_backend.reference.particles import NEW, REJECTED, Candidates, Landmarks, RobotUpdate, is_held
from slam_backend.reference.pose_gaussian import GaussianPose


def update_fastslam1(
    landmarks: Landmarks, pose: FloatArray, frame: Frame, candidates: Candidates, options: FilterOptions
) -> RobotUpdate:
    """Match, weigh and update one measurement after the other at the sampled pose.

    Args:
        landmarks: Map of the particle, changed.
        pose: (3,) [m, m, rad], map frame, as sampled from the motion model (Eq. 4).
        frame: Measurements of the robot.
        candidates: Candidate landmarks of the particle for each measurement.
        options: Options of the filter.

    Returns:
        The associations, the pose as given, and the log-likelihood of the frame.
    """
    chosen: list[int] = []
    distances: list[float] = []
    total = 0.0
    for b, possible in enumerate(candidates):
        match, distance = REJECTED, np.nan
        log_likelihood = frame.log_clutter(b, options.new_landmark_density)
        for _, name in possible:  # l. 15-24, the nearest descriptor first
            if options.one_to_one and name in chosen:
                continue
            gate = frame.compare(pose, landmarks[name], b)
            if gate is not None and (frame.identities is not None or gate.distance <= options.position_gate):
                match, distance, log_likelihood = name, gate.distance, gate.log_density  # l. 39, before the update
                break
        if match == REJECTED:  # l. 28-32
            if frame.identities is None or not is_held(b, possible, chosen, frame.identities):
                match = NEW - b
                landmarks[match] = frame.new_landmark(pose, b, options.landmark_walk)
        else:  # l. 33-37
            frame.update(pose, landmarks[match], b, options.landmark_walk)
        chosen.append(match)
        distances.append(distance)
        total += log_likelihood
    return RobotUpdate(GaussianPose.known(pose), pose, chosen, distances, total)
