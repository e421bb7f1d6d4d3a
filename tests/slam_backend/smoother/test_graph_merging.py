"""Merging the graphs of two groups, and teams of rejuvenated filters."""

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.runs import TIGHT, camera_of, logs_of, small_run, upper
from builders.teams import NEVER, SimulatedTeam, check_snapshot, false_alignment

from slam_backend.geometry import between, compose
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.smoother import rejuvenation
from slam_backend.smoother.graph import NONE, SlamGraph, scattered
from slam_backend.smoother.graph_building import extend_graph, merge_graphs
from slam_backend.smoother.joint_graphs import relative_start
from slam_backend.smoother.optimizer import optimize
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_scheduler import AttemptOptions

OFFSET = 500  # by which other groups call landmarks differently


def group_graph(run, robots, offset=0):
    """Return the graph of some robots in the start frame of the first of them, and its landmarks' new names."""
    logs = [logs_of(run)[robot] for robot in robots]
    names = np.unique(np.concatenate([log.arrays().ids for log in logs]))
    arrays = [log.renamed(names, names + offset).arrays() for log in logs]
    starts = between(run.true_paths[robots[0], 0], run.true_paths[robots, 0])
    graph = extend_graph(
        SlamGraph.at_starts(starts), arrays, run.spec.noise.motion, np.array(run.spec.noise.camera.mount)
    )
    return graph, np.column_stack([names + offset, names])


def from_the_start(run, groups, guess):
    """Return the graph of all robots from their logs, as a filter would build it whose particles differ by group."""
    starts = np.repeat(between(run.true_paths[0, 0], run.true_paths[:, 0])[:, :, None], 40, axis=2)
    rng = np.random.default_rng(1)
    for robots in groups[1:]:
        frames = compose(guess + 1e-2 * rng.normal(size=(40, 3)), starts[robots[0], :, 0])
        for robot in robots:
            starts[robot] = compose(frames, between(run.true_paths[robots[0], 0], run.true_paths[robot, 0])).T
    logs = [log.arrays() for log in logs_of(run)]
    mount = np.array(run.spec.noise.camera.mount)
    return extend_graph(SlamGraph.at_uncertain_starts(starts), logs, run.spec.noise.motion, mount)


def in_order(graph):
    """Return the keys of the robots, robot by robot, in the order of time."""
    return np.concatenate([np.flatnonzero(graph.robots == robot) for robot in range(len(graph.last_keys))])


def covariance(graph, mode):
    """Return the joint covariance of all sought poses, in the order of `in_order`."""
    half = np.linalg.inv(upper(mode))
    columns = mode.columns[in_order(graph)]
    rows = (columns[columns >= 0][:, None] + np.arange(3)).ravel()
    return (half @ half.T)[np.ix_(rows, rows)]


def assert_same_posterior(graph, other, run):
    """Both graphs have the same mode and the same covariance about it."""
    one, two = optimize(graph, camera_of(run), TIGHT), optimize(other, camera_of(run), TIGHT)
    assert one.reason == two.reason == ""
    np.testing.assert_allclose(one.poses[in_order(graph), :2], two.poses[in_order(other), :2], atol=1e-5)
    names, same = np.argsort(graph.landmark_ids), np.argsort(other.landmark_ids)
    np.testing.assert_array_equal(graph.landmark_ids[names], other.landmark_ids[same])
    np.testing.assert_allclose(one.landmarks[names], two.landmarks[same], atol=1e-5)
    np.testing.assert_allclose(covariance(graph, one), covariance(other, two), rtol=1e-3, atol=1e-9)


def test_two_groups_joined_are_what_their_logs_give_from_the_start():
    """Mode and covariance of the joined graph are those of the graph built from all logs; b's starts stay rigid."""
    run = small_run(3, seed=104, length=8.0)
    guess = np.array([0.15, -0.1, 0.04])
    a, _ = group_graph(run, [0])
    b, renamed = group_graph(run, [1, 2], OFFSET)
    motion = compose(guess, between(run.true_paths[0, 0], run.true_paths[1, 0]))
    both = merge_graphs(a, b, motion, renamed)
    assert both.parents[both.first_keys].tolist() == [NONE, a.num_keys, both.first_keys[1]]
    assert_same_posterior(both, from_the_start(run, [[0], [1, 2]], guess), run)


def test_a_third_robot_joins_later():
    """Joined one after the other, in either order, or built from all their logs: the posterior is the same."""
    run = small_run(3, seed=104, length=8.0)
    guess = np.array([0.1, 0.05, -0.03])
    whole = from_the_start(run, [[0], [1], [2]], guess)
    graphs = [group_graph(run, [robot], OFFSET * robot) for robot in range(3)]
    starts = run.true_paths[:, 0]

    def motion(a, b):
        return compose(guess, between(starts[a], starts[b]))

    first = merge_graphs(graphs[0][0], graphs[1][0], motion(0, 1), graphs[1][1])
    assert_same_posterior(merge_graphs(first, graphs[2][0], motion(0, 2), graphs[2][1]), whole, run)
    names = graphs[2][1] - [0, -OFFSET]
    pair = merge_graphs(graphs[1][0], graphs[2][0], motion(1, 2), names)
    names = np.column_stack([pair.landmark_ids, pair.landmark_ids - OFFSET])
    assert_same_posterior(merge_graphs(graphs[0][0], pair, motion(0, 1), names), whole, run)


def test_the_relative_start_is_that_of_the_joint_mode():
    """Motion and covariance are those of the dense inverse, in a run of any length."""
    run = small_run(2, seed=104, length=8.0)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    motion = compose(np.array([0.15, -0.1, 0.04]), between(run.true_paths[0, 0], run.true_paths[1, 0]))
    found = relative_start(a, b, motion, renamed, camera_of(run), SmoothingOptions(kernel=0.0))
    both = merge_graphs(a, b, motion, renamed)
    mode = optimize(both, camera_of(run), TIGHT)
    key = both.first_keys[1]
    np.testing.assert_allclose(found.motion, mode.poses[key], atol=1e-4)
    half = np.linalg.inv(upper(mode))
    rows = mode.columns[key] + np.arange(3)
    np.testing.assert_allclose(found.covariance, (half @ half.T)[np.ix_(rows, rows)], rtol=1e-2, atol=1e-9)
    assert np.hypot(*(found.motion - motion)[:2]) > 0.05  # it began elsewhere


def test_a_joint_graph_without_a_mode_tells_no_start():
    """Where the descent fails, no motion is claimed."""
    run = small_run(2, seed=104)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    known = renamed, camera_of(run), SmoothingOptions(max_iterations=1)
    assert relative_start(a, b, np.array([3.0, -2.0, 2.0]), *known) is None


def test_landmarks_without_a_new_name_are_left_out():
    """What the joint map does not hold is not in the joined graph either, and nothing else changes its place."""
    run = small_run(2, seed=104)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    lost = b.landmark_ids[3]
    both = merge_graphs(a, b, np.array([1.0, 2.0, 0.5]), renamed[renamed[:, 0] != lost])
    assert len(both.points) == len(a.points) + np.count_nonzero(b.landmark_ids[b.point_landmarks] != lost)
    np.testing.assert_array_equal(both.landmark_ids[both.point_landmarks[: len(a.points)]],
                                  a.landmark_ids[a.point_landmarks])  # fmt: skip
    assert np.unique(both.landmark_ids).size == both.landmark_ids.size


def test_aliases_of_a_landmark_follow_it():
    """Former ids of a group remain aliases of the landmark that was kept, under its id in the joint map."""
    run = small_run(2, seed=104)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    old, kept = renamed[0], renamed[1]
    b = b.with_columns(merged_ids=np.array([[old[0], kept[0]]]))
    both = merge_graphs(a, b, np.zeros(3), renamed)
    assert both.resolve_ids(np.array([old[1], kept[1]])).tolist() == [kept[1], kept[1]]


@pytest.mark.parametrize("common", [0, 2])
def test_groups_with_few_common_landmarks_keep_the_motion_of_the_merge(common):
    """Two groups that share too few landmarks are as uncertain against each other as the motion was, not lost."""
    run = small_run(2)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    shared = renamed[np.isin(renamed[:, 1], a.landmark_ids)][:common]
    own = renamed[~np.isin(renamed[:, 1], a.landmark_ids)]
    uncertainty = np.diag([0.03, 0.04, 0.01]) ** 2
    motion = between(run.true_paths[0, 0], run.true_paths[1, 0])
    both = merge_graphs(a, b, motion, np.concatenate([shared, own]), uncertainty)
    mode = optimize(both, camera_of(run), TIGHT)
    assert mode.reason == ""
    half = np.linalg.inv(upper(mode))
    first = mode.columns[both.first_keys[1]] + np.arange(3)
    claimed = (half @ half.T)[np.ix_(first, first)]
    if common:
        assert np.linalg.eigvalsh(uncertainty - claimed).min() > -1e-9
        return
    np.testing.assert_allclose(mode.poses[both.first_keys[1]], motion, atol=1e-6)
    np.testing.assert_allclose(claimed, uncertainty, rtol=1e-3, atol=1e-9)


def test_scatter_is_the_covariance_about_the_mean_direction():
    """Poses on both sides of a half turn scatter as they would about zero."""
    rng = np.random.default_rng(3)
    poses = rng.normal(size=(3, 400)) * np.array([[0.3], [0.2], [0.1]])
    there = poses + np.array([[1.0], [2.0], [np.pi]])
    np.testing.assert_allclose(scattered(there), scattered(poses), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(scattered(poses), np.cov(poses, bias=True), atol=1e-3)


def build(simulation, every=20, incremental=False):
    """Return a team that merges early."""
    return simulation.build(
        alignment=AlignmentOptions(min_inliers=9), attempts=AttemptOptions(every=20, new_candidates=2),
        rejuvenate_every=every, smoothing=SmoothingOptions(incremental=incremental),
    )  # fmt: skip


@pytest.mark.parametrize("incremental", [False, True])
def test_a_merged_team_is_rejuvenated_and_knows_where_it_started(incremental):
    """Soon after a merge the joint filter is smoothed, at once or in slices; the other starts are then known."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, incremental=incremental)
    joint = []
    for _ in range(100):
        told = team.step(*simulation.read()).rejuvenations
        joint += [report.reason for robots, report in told if robots == (0, 1, 2)]
    assert team.groups == ((0, 1, 2),)
    assert len(joint) >= 1
    assert set(joint) == {""}
    for robot in (1, 2):
        off = team.start_from_group(robot) - simulation.true_motion(robot, 0)
        assert np.hypot(off[0], off[1]) < 0.1
    assert simulation.position_errors(team).max() < 0.2


def test_starts_are_constant_between_rejuvenations():
    """Resampling does not choose among the starts that a merged filter has drawn: they are held until the next draw."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, every=25)
    simulation.run(team, 100)
    assert team.groups == ((0, 1, 2),)
    stayed, frames = 0, None
    for _ in range(50):
        drawn = team.step(*simulation.read()).rejuvenations
        before, frames = frames, [team.start_from_group(robot) for robot in range(3)]
        if before is not None and not drawn:
            np.testing.assert_array_equal(frames, before)
            stayed += 1
    assert stayed > 30


@pytest.mark.parametrize(("every", "incremental"), [(None, False), (20, False), (20, True)])
def test_a_snapshot_of_a_team_continues_through_merges_and_rejuvenations(every, incremental):
    """A restored team gives, bit for bit, the results of the original, its smoothers included."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, every, incremental)
    simulation.run(team, 50)
    reports = check_snapshot(simulation, team, [None] * 40)
    assert any(report.id_maps for report in reports)


def test_a_merge_continues_from_the_smoothed_graphs_of_both_groups():
    """Just after a merge the joint smoother has all that the groups' smoothers had: nothing is done again."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, incremental=True)
    before = {}
    for _ in range(90):
        known = before
        report = team.step(*simulation.read())
        before = {group.robots: latest_of(group) for group in team._groups}
        for renaming in report.id_maps:
            robots = renaming.robots_a + renaming.robots_b
            latest = before[tuple(sorted(robots))][np.argsort(np.argsort(robots))]
            asked = np.concatenate([known[renaming.robots_a], known[renaming.robots_b]])
            assert (latest >= asked).all()
            assert (asked >= 0).all()
    assert team.groups == ((0, 1, 2),)


def latest_of(group):
    """Return the newest step of each robot in the graph of a group's joint filter."""
    graph = group.trunk.filter.rejuvenation.graph
    return np.full(len(group.robots), -1) if graph is None else graph.latest


def test_no_two_filters_work_on_their_smoothers_in_one_step(monkeypatch):
    """Robots that do not look for each other have steps of their own in which their filters may smooth."""
    simulation = SimulatedTeam(seed=101)
    smoothing = SmoothingOptions(incremental=True, slice_share=0.01)
    team = simulation.build(attempts=AttemptOptions(enabled=False), rejuvenate_every=20, smoothing=smoothing)
    worked = []

    def noted(*arguments):
        worked.append(team._step)
        return optimize(*arguments)

    monkeypatch.setattr(rejuvenation, "optimize", noted)
    simulation.run(team, 60)
    assert len(worked) > 10
    assert len(set(worked)) == len(worked)


@pytest.mark.parametrize("incremental", [False, True])
def test_joint_filters_of_longer_runs_keep_more_keyframes(incremental):
    """Two groups with many keyframes are reduced to their shares of the limit, which grows with the run."""

    def joint_keys(steps_per_key):
        smoothing = SmoothingOptions(
            incremental=incremental, max_keys=20, further_keys=0, recent_keys=4, steps_per_key=steps_per_key
        )
        simulation = SimulatedTeam(num_robots=2, seed=101)
        team = simulation.build(attempts=NEVER, rejuvenate_every=20, smoothing=smoothing)
        simulation.run(team, 80)
        alone = [group.trunk.filter.rejuvenation.graph for group in team._groups]
        team.merge(0, 1, false_alignment(simulation, team, np.zeros(3)))
        latest = np.concatenate([graph.latest for graph in alone])
        joint = team._groups[0].trunk.filter.rejuvenation.graph
        return sum(graph.num_keys for graph in alone), joint.num_keys, latest.sum()

    alone, joint, _ = joint_keys(10**6)
    assert joint <= 20 + 1 < alone  # each share of the limit may be exceeded by the newest keyframes
    alone, joint, steps = joint_keys(16)
    assert 20 + 1 < joint <= 20 + steps // 16 + 1 < alone


def test_after_an_undo_smoothers_are_as_if_they_had_never_been_joined():
    """Filters with all that their smoothers know are bit for bit those of a team that never merged, and stay so."""
    smoothing = SmoothingOptions(incremental=True, max_keys=40)
    (simulation, team), (other, twin) = (
        (run, run.build(attempts=NEVER, rejuvenate_every=20, smoothing=smoothing))
        for run in (SimulatedTeam(num_robots=2, seed=101) for _ in range(2))
    )
    simulation.run(team, 80)
    other.run(twin, 80)
    team.merge(0, 1, false_alignment(simulation, team, np.array([3.0, -2.0, 0.5])))
    while not any(event.kind == "undo" for event in team.events):
        assert len(simulation.run(team, 1)) == len(other.run(twin, 1)) == 1
        assert team._step < 400
    for _ in range(2):
        for robot in range(2):
            slam, same = (each._find(robot)[0].filter for each in (team, twin))
            assert_same(contents(slam), contents(same))
        simulation.run(team, 15)
        other.run(twin, 15)
