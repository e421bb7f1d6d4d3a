"""Planners that divide frontiers: laws of the assignments, each robot for itself and centrally."""

import time
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from builders.environments import know

from agents import make_policy, make_team_policy
from agents.planners.common.targets import NO_PATH, Targets, own_targets, team_targets
from agents.planners.hungarian import assign_all, hungarian
from agents.planners.tare import LEFT_OVER, draw_cover
from agents.planners.utility_cost import COST, utility_cost
from agents.registry import ASSIGNMENTS, PLANNERS
from slam_backend.geometry import compose, inverse
from tests.agents.test_policies import ROOM
from vslam_env import CandidateKind, ExplorationEnv, vslam_v0
from vslam_env.navigation import OccupancyGrid, distance_map

RNG = np.random.default_rng(0)


def _targets(positions: list[tuple[float, float]], places: list[tuple[float, float]], wall: bool = False) -> Targets:
    """Return targets on free floor of 18 x 18 m, all lengths straight; with a wall along x = 0 but for a door."""
    grid = OccupancyGrid()
    evidence = np.zeros((300, 300), np.int8)
    evidence[105:195, 105:195] = -10
    if wall:
        evidence[105:195, 150] = 10
        evidence[170:175, 150] = -10
    know(grid, evidence)
    robots, goals = np.array(positions), np.array(places)
    lengths = np.linalg.norm(robots[:, None] - goals[None], axis=-1)
    slots = np.tile(np.arange(len(goals)), (len(robots), 1))
    return Targets(distance_map(grid.cells, robots[0]), robots, goals, lengths, slots, len(robots))


def test_assignments_agree_with_brute_force() -> None:
    """The assignment has the least total cost of all one-to-one assignments."""
    rng = np.random.default_rng(3)
    for rows, columns in ((2, 5), (3, 4), (4, 4)):
        costs = rng.uniform(0.0, 9.0, (rows, columns))
        best = min(sum(costs[i, j] for i, j in enumerate(order)) for order in permutations(range(columns), rows))
        assert costs[np.arange(rows), assign_all(costs)].sum() == pytest.approx(best)
    many = assign_all(rng.uniform(0.0, 9.0, (5, 2)))
    assert np.bincount(many).max() <= 3  # in each round every column has one row


def test_robots_spread_over_rooms() -> None:
    """Two robots side by side with frontiers in two rooms take one room each, and keep to the room they are in."""
    targets = _targets([(1.0, 0.0), (2.0, 0.0)], [(3.0, 1.0), (4.0, -1.0), (-4.0, 1.0)], wall=True)
    rooms = targets.rooms[1][hungarian(targets, RNG)]
    assert len(set(rooms.tolist())) == 2
    alone = _targets([(1.0, 0.0)], [(6.0, 0.0), (-2.0, 0.0)], wall=True)  # the other room's is nearer
    assert hungarian(alone, RNG).tolist() == [0]


def test_utility_falls_where_another_robot_looks() -> None:
    """The first pair is the nearest; the second robot prefers a frontier out of view if the way is not too long."""
    near = _targets([(0.0, 0.0), (0.5, 0.0)], [(-1.0, 0.0), (-1.0, 0.6), (-5.0, -5.0)])
    assert sorted(utility_cost(near, RNG)) == [0, 2]
    far = _targets([(0.0, 0.0), (0.5, 0.0)], [(-1.0, 0.0), (-1.0, 0.6), (0.0, -8.0)])
    seen = 1.0 - 0.6 / 8.0
    assert seen < COST * 8.0 + 0.5  # the way costs more than the view
    assert COST * far.lengths[1, 2] > seen + COST * far.lengths[1, 1] or sorted(utility_cost(far, RNG)) == [0, 2]


@pytest.mark.parametrize("name", ASSIGNMENTS)
def test_assignments_are_complete_and_spread(name: str) -> None:
    """Each robot has a target; robots at opposite ends take their own sides; more robots than targets share."""
    assign = ASSIGNMENTS[name]
    targets = _targets([(-7.0, 0.0), (7.0, 0.0)], [(6.0, 1.0), (-6.0, 1.0), (-6.0, -1.0), (6.0, -1.0)])
    sides = targets.places[assign(targets, RNG), 0]
    assert sides[0] < 0.0 < sides[1]
    crowd = _targets([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)], [(5.0, 5.0), (5.0, -5.0)])
    assert set(assign(crowd, RNG).tolist()) <= {0, 1}
    assert assign(_targets([(0.0, 0.0)], [(2.0, 2.0)]), RNG).tolist() == [0]


def test_isolated_frontiers_come_first() -> None:
    """Of two frontiers equally near, distance advantage takes the one far from all others."""
    targets = _targets([(0.0, 0.0)], [(2.0, 0.0), (-2.0, 0.0), (3.0, 1.0), (3.0, -1.0)])
    assert ASSIGNMENTS["distance_advantage"](targets, RNG).tolist() == [1]


def test_tours_do_not_leave_single_frontiers_behind() -> None:
    """A near single frontier comes before a cluster a little nearer, since the tour is then shorter."""
    targets = _targets([(0.0, 0.0)], [(2.0, 0.0), (3.0, 0.0), (4.0, 0.0), (5.0, 0.0), (-2.1, 0.0)])
    assert targets.places[ASSIGNMENTS["mtsp"](targets, RNG)[0], 0] == pytest.approx(-2.1)


def test_viewpoints_cover_what_can_be_covered() -> None:
    """A draw leaves less than `LEFT_OVER` cells to every viewpoint, and takes no viewpoint twice."""
    rng = np.random.default_rng(4)
    for n, m in product((1, 3, 7), (0, 1, 40)):
        covers = rng.random((n, m)) < 0.3
        drawn = draw_cover(covers, rng)
        assert len(set(drawn.tolist())) == len(drawn) >= 1
        left = ~covers[drawn].any(axis=0)
        assert (covers & left).sum(axis=1).max(initial=0) < LEFT_OVER


def _explored(num_robots: int, cycles: int, seed: int = 3) -> ExplorationEnv:
    """Return an environment of robots that share maps after some decisions of the nearest frontier."""
    env = vslam_v0.parallel_env(
        world=ROOM,
        num_robots=num_robots,
        num_particles=10,
        action_type="goal",
        max_cycles=cycles + 9,
        oracle_merge=True,
    )
    team = make_team_policy("frontier", "goal")
    observations, _ = env.reset(seed=seed)
    for _ in range(cycles):
        beliefs = {agent: env.belief(agent) for agent in env.agents}
        observations, *_ = env.step(team.act(observations, beliefs, RNG))
    return env


def test_targets_of_a_team_are_the_robots_own() -> None:
    """Each target of a group is a candidate of some robot, moved exactly; a robot's lengths are its own."""
    env = _explored(3, 4)
    beliefs = [env.belief(agent) for agent in env.agents]
    group = [belief for belief in beliefs if belief.group == beliefs[0].group]
    targets = team_targets(group, {})
    assert targets is not None
    assert len(targets.places) >= max(len(belief.candidates.of_kind(CandidateKind.FRONTIER)) for belief in group)
    for row, belief in enumerate(group):
        first_from_own = compose(group[0].start_from_group, inverse(belief.start_from_group))
        for target in np.flatnonzero(targets.slots[row] >= 0):
            slot = targets.slots[row, target]
            moved = compose(first_from_own, [*belief.candidates.goals[slot], 0.0])[:2]
            assert np.linalg.norm(moved - targets.places[target]) < 1.0
            assert targets.lengths[row, target] == belief.candidates.lengths[slot]
        assert (targets.lengths[row, targets.slots[row] < 0] == NO_PATH).all()


def test_a_held_goal_counts_as_nearer() -> None:
    """The path to the held goal counts half."""
    env = _explored(2, 2)
    belief = env.belief("robot_0")
    free, slot = own_targets(belief, None), int(belief.candidates.of_kind(CandidateKind.FRONTIER)[0])
    held = own_targets(belief, slot)
    assert free is not None
    assert held is not None
    own = free.slots[0] == slot
    np.testing.assert_allclose(held.lengths[0, own], 0.5 * free.lengths[0, own])
    np.testing.assert_array_equal(held.lengths[0, ~own], free.lengths[0, ~own])


def _play(name: str, action_type: str, seed: int) -> list[dict[str, Any]]:
    """Return the actions of an episode of a team policy."""
    env = vslam_v0.parallel_env(
        world=ROOM, num_robots=3, num_particles=10, action_type=action_type, max_cycles=12, oracle_merge=True
    )
    team, rng, log = make_team_policy(name, action_type), np.random.default_rng(seed), []
    team.reset()
    observations, _ = env.reset(seed=seed)
    while env.agents:
        actions = team.act(observations, {agent: env.belief(agent) for agent in env.agents}, rng)
        log.append(actions)
        observations, _, _, _, infos = env.step(actions)
        assert not any(info["invalid_action"] for info in infos.values())
    return log


@pytest.mark.parametrize(("name", "action_type"), [*((name, "goal") for name in PLANNERS), ("random_walk", "discrete")])
def test_team_policies_act_within_the_rules(name: str, action_type: str) -> None:
    """Actions of every team policy are valid, and the same seed gives the same actions."""
    assert _play(name, action_type, 5) == _play(name, action_type, 5)


@pytest.mark.parametrize("name", PLANNERS)
def test_decisions_are_fast(name: str) -> None:
    """The median decision of each planner takes less than 10 ms of processor time with three robots."""
    env = _explored(3, 8)
    policy, times = make_policy(name, "goal"), []
    for _ in range(15):
        for agent in env.agents:
            belief = env.belief(agent)
            begin = time.thread_time()
            policy.act(None, belief, RNG)
            times.append(time.thread_time() - begin)
    assert np.median(times) < 0.01
