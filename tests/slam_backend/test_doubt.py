"""How uncertain a merge is, asked before it is made."""

import math

import numpy as np
from merged_pair import NEVER, false_alignment
from simulated_team import SimulatedTeam

from slam_backend.geometry import compose
from slam_backend.maps.alignment import RIVAL_ANGLE, RIVAL_DISTANCE
from slam_backend.team.filter_merging.merging import motion_covariance
from slam_backend.team.group_merging import MergePlan, doubt_about
from slam_backend.team.options import MergeOptions


def test_what_held_frames_leave_open_is_doubted_as_well() -> None:
    """The doubt is that of the motion between the groups' starts: by the particles, and by draws of both frames."""
    simulation = SimulatedTeam(num_robots=2, seed=3)
    team = simulation.build(attempts=NEVER, num_particles=13)
    simulation.run(team, 60)
    alignment = false_alignment(simulation, team, np.zeros(3))
    a, b = (group.trunk.filter for group in team._groups)
    plan = MergePlan.of(*team._groups, alignment).paired(MergeOptions(), team._rng)
    assert plan.pairing is not None
    covariance = motion_covariance(plan.pairing.motion, alignment)
    before = doubt_about(plan)

    rng = np.random.default_rng(0)
    frames = [np.diag([3e-2, 1e-2, 9e-3]), np.diag([1e-2, 5e-2, 4e-3])]
    moved_a, moved_b = (rng.multivariate_normal(np.zeros(3), frame, size=100_000) for frame in frames)
    covariance += np.cov(compose(compose(moved_a, alignment.transform), moved_b).T)
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])

    for slam, frame in zip((a, b), frames, strict=True):
        slam.state.gauge_covariance[:] = frame
    after = doubt_about(plan)
    np.testing.assert_allclose(after, max(position / RIVAL_DISTANCE, heading / RIVAL_ANGLE), rtol=0.03)
    assert after > 1.5 * before
