"""Information of a robot's belief about its pose and its landmarks."""

import numpy as np

from vslam_env.evaluation.team_metrics import BeliefSummary

PRIOR_POSE = (0.05, 0.05, 0.02)  # [m, m, rad] sigmas that count as one unit of uncertainty
PRIOR_SIGMA = 1.0  # [m] of a landmark that has not been measured, in each direction
LEAST_SIGMA = 0.1  # [m] below, a landmark gains no more information
MOST = 3.0 * float(np.log(PRIOR_SIGMA / LEAST_SIGMA))  # of one landmark


def information(belief: BeliefSummary) -> float:
    """Return the information of a belief, in nats (Carrillo et al. 2012: D-optimality of poses and landmarks).

    It is minus half the log-determinant of I + P0^-1 P for the covariance P of the pose in the start frame, where P0
    keeps it finite at the start, plus, for each landmark measured at least twice, half the log-ratio of the
    determinants of a prior and of the landmark's covariance, from 0 to `MOST`. Of landmarks that stand for the same
    true landmark the one with most information counts; false landmarks do not count.

    >>> pose = np.zeros((3, 3))
    >>> certain, vague = np.diag([0.1, 0.1, 0.1]) ** 2, 0.25 * np.eye(3)
    >>> held = BeliefSummary(pose, np.array([5, 2, 1]), np.array([certain, vague, certain]), np.array([7, 7, 3]))
    >>> round(information(held), 3), round(MOST, 3)
    (6.908, 6.908)
    """
    _, uncertainty = np.linalg.slogdet(np.eye(3) + belief.pose_covariance / np.array(PRIOR_POSE)[:, None] ** 2)
    counted = (belief.landmark_counts >= 2) & (belief.landmark_claims >= 0)
    claims = belief.landmark_claims[counted]
    _, spreads = np.linalg.slogdet(belief.landmark_covariances[counted])
    gains = np.clip(3.0 * np.log(PRIOR_SIGMA) - 0.5 * spreads, 0.0, MOST)
    best = np.zeros(int(claims.max(initial=-1)) + 1)
    np.maximum.at(best, claims, gains)
    return float(best.sum() - 0.5 * uncertainty)
