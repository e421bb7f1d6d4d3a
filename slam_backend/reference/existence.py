"""Update of the existence of landmarks after a robot's frame (Montemerlo and Thrun 2003)."""

from collections.abc import Sequence

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.models.camera import StereoCamera
from slam_backend.reference.measurement_model import Landmark
from slam_backend.reference.particles import Particle, RobotStep
from slam_backend.reference.pose_gaussian import turn_about_vertical


def update_existence(
    particles: Sequence[Particle],
    best: Particle,
    robot: int,
    record: RobotStep,
    model: ExistenceModel,
    camera: StereoCamera,
) -> None:
    """Update the log-odds of the landmarks around a robot after its frame; particles delete improbable landmarks.

    Args:
        particles: All particles; their maps are changed.
        best: The most probable particle before the step; its landmarks near the robot are considered.
        robot: Index of the robot.
        record: Outcome of the robot's frame.
        model: Detection model and deletion rule.
        camera: Assumed model of the camera.
    """
    started = {int(name) for name in record.created if name >= 0}
    matched = [{int(name) for name in names if name >= 0} for names in record.associations.T]
    around = set().union(*matched)
    for name in {name for particle in particles for name in particle.landmarks}:
        holder = next(p for p in [best, *particles] if name in p.landmarks)
        offset = holder.landmarks[name].mean[:2] - best.poses[robot][:2]
        if np.linalg.norm(offset) <= 2.0 * model.range_share * camera.max_range:
            around.add(name)
    around -= started
    expected = [name for name in around if name in best.landmarks]
    expected = [name for name in expected if is_expected(best.poses[robot], best.landmarks[name], model, camera)]
    sighting, miss = model.increments(len(expected))
    for particle, seen in zip(particles, matched, strict=True):
        for name in started & particle.landmarks.keys():
            particle.landmarks[name].log_odds = model.log_odds_prior
        for name in around & particle.landmarks.keys():
            landmark = particle.landmarks[name]
            if name in seen:
                landmark.log_odds += sighting
            elif is_expected(particle.poses[robot], landmark, model, camera):
                landmark.log_odds += miss
            landmark.log_odds = min(landmark.log_odds, model.log_odds_cap)
            if landmark.log_odds < model.log_odds_floor:
                del particle.landmarks[name]


def is_expected(pose: FloatArray, landmark: Landmark, model: ExistenceModel, camera: StereoCamera) -> bool:
    """Return whether a landmark lies inside the image, with a margin, and within range.

    Args:
        pose: (3,) of the robot [m, m, rad], map frame.
        landmark: The landmark; its mean is used.
        model: Detection model with the margins.
        camera: Assumed model of the camera.
    """
    offset = landmark.mean - [pose[0], pose[1], 0.0]
    point = camera.camera_from_robot(turn_about_vertical(pose[2]).T @ offset)
    if point[2] <= model.nearest or np.linalg.norm(point) > model.range_share * camera.max_range:
        return False
    u, v, _ = camera.project(point)
    return bool(abs(u) <= 0.5 * camera.width - model.margin_px and abs(v) <= 0.5 * camera.height - model.margin_px)
