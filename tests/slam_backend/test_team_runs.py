"""Three robots drive about, find each other's maps, and go on together."""

import numpy as np
import pytest
from simulated_team import SimulatedTeam

from slam_backend.fastslam.reports import TeamReport
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment_types import REASONS
from slam_backend.team.team import TeamSlam

STEPS = 160


@pytest.fixture(scope="module", params=[0, 1, 2, 3])
def run(request: pytest.FixtureRequest) -> tuple[SimulatedTeam, TeamSlam, list[TeamReport]]:
    """A whole run, with what the team reported at each step."""
    simulation = SimulatedTeam(seed=request.param)
    team = simulation.build()
    return simulation, team, simulation.run(team, STEPS)


Run = tuple[SimulatedTeam, TeamSlam, list[TeamReport]]


def test_three_robots_become_one_group_without_a_false_merge(run: Run) -> None:
    """Both merges are right to within 0.5 m and 5 degrees, the contract's bounds, and all robots end together."""
    simulation, team, _ = run
    assert team.groups == ((0, 1, 2),)
    merges = [event for event in team.events if event.kind == "merge"]
    assert len(merges) == 2
    for event in merges:
        error = event.alignment.transform - simulation.true_motion(event.robots_a[0], event.robots_b[0])
        assert np.hypot(*error[:2]) < 0.5
        assert abs(wrap_angle(error[2])) < np.deg2rad(5.0)


def test_a_third_robot_joins_a_group_of_two(run: Run) -> None:
    """The second merge joins a pair and a single robot; groups are those of the report of its step."""
    _, _, reports = run
    merges = [event for report in reports for event in report.events if event.kind == "merge"]
    assert sorted(len(group) for group in (merges[1].robots_a, merges[1].robots_b)) == [1, 2]
    for report in reports:
        for event in report.events:
            if event.kind == "merge":
                assert tuple(sorted(event.robots_a + event.robots_b)) in report.groups


def test_the_joint_filter_goes_on_with_small_errors(run: Run) -> None:
    """At the end of 32 m each, every robot knows its place in its own start frame to 0.3 m, and the map is as good."""
    simulation, team, _ = run
    assert simulation.position_errors(team).max() < 0.3
    held = team.map(0).moved(simulation.starts[0])
    nearest = np.linalg.norm(held.means[:, None] - simulation.landmarks[0], axis=2).min(axis=1)
    assert np.sqrt(np.mean(nearest**2)) < 0.3
    assert len(held) < 1.2 * simulation.num_landmarks


def test_every_step_names_landmarks_that_exist(run: Run) -> None:
    """Ids created in a run, renamed at each merge, cover all ids of the final map; steps count from 0."""
    _, team, reports = run
    assert [report.step for report in reports] == list(range(STEPS))
    ids: list[set[int]] = [set() for _ in range(3)]  # per robot: landmarks ever created in the map it shares
    for report in reports:
        together = {robot: group for group in before_merges(report) for robot in group}
        for robot, created in enumerate(report.created):
            for mate in together[robot]:
                ids[mate] |= set(created[created >= 0].tolist())
        for robot, found in enumerate(report.associations):
            assert set(found[found >= 0].tolist()) <= ids[robot]
        for renaming in report.renamings:
            new_id = dict(renaming.ids_b.tolist())
            joint = ids[renaming.robots_a[0]] | {new_id[old] for old in ids[renaming.robots_b[0]] if old in new_id}
            for robot in renaming.robots_a + renaming.robots_b:
                ids[robot] = set(joint)
    assert set(team.map(0).ids.tolist()) <= ids[0]


def before_merges(report: TeamReport) -> list[tuple[int, ...]]:
    """Return the groups as they were in the step, before its merge."""
    groups = list(report.groups)
    for renaming in reversed(report.renamings):
        groups.remove(tuple(sorted(renaming.robots_a + renaming.robots_b)))
        groups += [renaming.robots_a, renaming.robots_b]
    return groups


def test_diagnostics_count_the_last_frame(run: Run) -> None:
    """Accepted, new and rejected measurements add up to the frame; robots of one group share ESS and landmarks."""
    _, team, reports = run
    rows = team.diagnostics
    for robot, row in enumerate(rows):
        assert row["accepted"] + row["new"] + row["rejected"] == len(reports[-1].associations[robot])
        assert 1.0 <= row["ess"] <= 30.0
        assert row["landmarks"] == len(team.map(robot))
    assert len({row["ess"] for row in rows}) == 1


@pytest.mark.parametrize(("aliased", "seed"), [(False, 5), (True, 6), (True, 7)])
def test_robots_without_overlap_never_merge(aliased: bool, seed: int) -> None:
    """Robots in separate rooms stay alone, whether or not the rooms repeat the same looks at other places."""
    simulation = SimulatedTeam(num_robots=2, seed=seed, separate=True, aliased=aliased)
    team = simulation.build()
    simulation.run(team, 150)
    assert team.groups == ((0,), (1,))
    assert all(event.kind == "attempt" and not event.alignment.success for event in team.events)
    if aliased:
        assert team.events  # there were candidates, so that the maps were compared
        assert {event.alignment.reason for event in team.events} <= set(REASONS)
