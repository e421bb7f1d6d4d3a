"""Who hears whom, and what an environment does with it."""

from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, WALLS, small_env, turning
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import between
from slam_backend.maps.alignment import Alignment
from slam_backend.team.reports import MergeEvent
from vslam_env import EnvConfig, ExplorationEnv
from vslam_env.belief.observation import observe
from vslam_env.belief.team_belief import TeamBelief
from vslam_env.simulation.communication import contacts, crosses_wall, next_failures, outage_rates

POSES = np.array([[1.0, 1.0, 0.3], [4.0, 5.0, 2.0], [1.0, 9.0, -1.0]])  # the wall at y = 7 cuts the third off


def matrix(*pairs: tuple[int, int]) -> Any:
    """Return symmetric contacts of three robots."""
    heard = np.eye(3, dtype=bool)
    for a, b in pairs:
        heard[a, b] = heard[b, a] = True
    return heard


def hears(comm_range: float | None = None, sight: bool = False, loss: float = 0.0, seed: int = 0) -> Any:
    """Return who hears whom in the room of `small_env`."""
    failing = next_failures(None, len(POSES), loss, 0.0, np.random.default_rng(seed))
    return contacts(POSES, WALLS, comm_range, sight, failing)


def test_range_sight_and_loss_cut_links() -> None:
    """Distances are 5, 5 and 8 m; a wall stands between the third robot and the others; at loss 1 all are deaf."""
    assert hears().all()
    np.testing.assert_array_equal(hears(comm_range=5.0), matrix((0, 1), (1, 2)))
    np.testing.assert_array_equal(hears(comm_range=4.99), matrix())
    np.testing.assert_array_equal(hears(sight=True), matrix((0, 1)))
    np.testing.assert_array_equal(hears(loss=1.0), matrix())


def test_links_fail_as_often_as_said() -> None:
    """Of 3000 links at a loss of 0.3, 900 fail but for five standard deviations (25 each), both ways at once."""
    rng = np.random.default_rng(1)
    matrices = np.array(
        [contacts(POSES, WALLS, None, False, next_failures(None, 3, 0.3, 0.0, rng)) for _ in range(1000)]
    )
    np.testing.assert_array_equal(matrices, matrices.transpose(0, 2, 1))
    assert abs(np.count_nonzero(~matrices) / 2 - 900) < 5 * 25.1


@pytest.mark.parametrize(("loss", "ticks"), [(0.3, 5.0), (0.5, 20.0), (0.8, 20.0)])
def test_outages_last_and_recur_as_said(loss: float, ticks: float) -> None:
    """Mean duration and share of the time of outages of 28 links are as asked, but for five standard errors.

    A duration in whole ticks has the mean 1 / (1 - exp(-1 / ticks)).
    """
    rng, failing, links = np.random.default_rng(4), None, []
    for _ in range(20_000):
        failing = next_failures(failing, 8, loss, ticks, rng)
        links.append(failing[np.triu_indices(8, 1)])
    fails = np.array(links)
    ends = np.count_nonzero(fails[:-1] & ~fails[1:])
    mean = 1.0 / -np.expm1(-1.0 / ticks)
    assert fails[:-1].sum() / ends == pytest.approx(mean, abs=5.0 * mean / np.sqrt(ends))
    assert fails.mean() == pytest.approx(loss, abs=5.0 * np.sqrt(2.0 * mean * loss * (1.0 - loss) / fails.size))
    begin, end = outage_rates(loss, ticks)
    assert begin / (begin + end) == pytest.approx(loss)  # of a chain with these probabilities


def test_links_without_outages_are_drawn_by_tick() -> None:
    """With a duration of zero the last tick does not matter, and each tick draws as much as with one."""
    streams = [np.random.default_rng(1) for _ in range(3)]
    before = np.ones((5, 5), np.bool_)
    first, other = (
        next_failures(failing, 5, 0.4, 0.0, rng) for failing, rng in zip((None, before), streams[:2], strict=True)
    )
    np.testing.assert_array_equal(first, other)
    next_failures(before, 5, 0.4, 30.0, streams[2])
    assert len({stream.random() for stream in streams}) == 1


@pytest.mark.parametrize(
    ("loss", "seconds", "expected"),
    [(0.0, 5.0, "expected 0 with"), (1.0, 5.0, "expected 0 with"), (0.9, 0.2, "expected more seconds")],
)
def test_outages_that_cannot_be_are_refused(loss: float, seconds: float, expected: str) -> None:
    """Contacts that never or always fail have no outages, and nine tenths of the time needs long ones."""
    with pytest.raises(ValueError, match=f"comm_outage_seconds: {expected}"):
        EnvConfig(comm_loss=loss, comm_outage_seconds=seconds)
    assert EnvConfig(comm_loss=0.9, comm_outage_seconds=1.0).comm_outage_seconds == 1.0


def test_outages_are_part_of_the_state() -> None:
    """An environment that restores a state in the middle of an outage has the same contacts from then on."""
    env, twin = (small_env(comm_loss=0.5, comm_outage_seconds=2.0, max_cycles=200) for _ in range(2))
    drive(env, 30)
    twin.set_state(env.get_state())
    for _ in range(60):
        for each in (env, twin):
            each.step(turning(each.agents))
        np.testing.assert_array_equal(env.readings[0].contacts, twin.readings[0].contacts)


def test_the_stream_of_the_radio_does_not_depend_on_where_robots_are() -> None:
    """Out of range or not, a tick draws as much."""
    streams = [np.random.default_rng(1) for _ in range(2)]
    for stream, limit in zip(streams, (None, 0.1), strict=True):
        contacts(POSES, WALLS, limit, True, next_failures(None, 3, 0.3, 0.0, stream))
    assert streams[0].random() == streams[1].random()


@given(st.lists(st.floats(-9.0, 9.0), min_size=8, max_size=8), st.floats(-3.0, 3.0), st.floats(-20.0, 20.0))
def test_crossing_does_not_depend_on_direction_or_frame(numbers: list[float], angle: float, shift: float) -> None:
    """Turned, shifted, or with ends exchanged, a line crosses a wall or does not, unless they all but touch."""
    a, b, c, d = np.array(numbers).reshape(4, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    one = crosses_wall(a[None], b[None], np.concatenate([c, d])[None])
    moved = [turn @ p + shift for p in (a, b, c, d)]
    other = crosses_wall(moved[1][None], moved[0][None], np.concatenate([moved[3], moved[2]])[None])
    area = [np.linalg.det(np.array([q - p, r - p])) for p, q, r in ((a, b, c), (a, b, d), (c, d, a), (c, d, b))]
    if min(np.abs(area)) > 1e-6:
        assert one[0] == other[0] == (area[0] * area[1] < 0.0 and area[2] * area[3] < 0.0)


# ---------------------------------------------------------------------- in an environment


def drive(env: ExplorationEnv, ticks: int, seed: int = 5) -> list[dict[str, Any]]:
    """Let robots that start side by side drive in circles; return the infos of all ticks."""
    infos = [env.reset(seed=seed, options={"start_poses": MEETING})[1]]
    return infos + [env.step(turning(env.agents))[4] for _ in range(ticks)]


def test_robots_without_range_never_merge_and_send_nothing() -> None:
    """With a range of zero two robots that map the same corner stay alone; with any range they merge."""
    deaf, near = (small_env(comm_range=comm_range, max_cycles=400) for comm_range in (0.0, None))
    for env, groups in ((deaf, {0, 1}), (near, {0})):
        infos = drive(env, 150)[-1]
        assert {info["group"] for info in infos.values()} == groups
        assert all((info["bytes_sent"] > 0) == (len(groups) == 1) for info in infos.values())


def test_the_oracle_merges_in_contact_only() -> None:
    """Robots that know the true transform need contact to use it."""
    for comm_range, merges in ((0.0, 0), (None, 1)):
        env = small_env(comm_range=comm_range, oracle_merge=True, max_cycles=400)
        assert drive(env, 60)[-1]["robot_0"]["merges"] == merges


@pytest.mark.parametrize("options", [{"comm_loss": 0.6}, {"comm_loss": 0.6, "oracle_merge": True}])
def test_beliefs_with_contact_now_and_then_follow_from_readings_alone(options: Any) -> None:
    """Observations are rebuilt byte for byte from recorded readings, who hears whom among them, without the world."""
    env = small_env(max_cycles=400, num_particles=15, **options)
    log: list[Any] = []
    env.recorder = log.append
    observed = [env.reset(seed=5, options={"start_poses": MEETING})[0]]
    for _ in range(150):
        observed.append(env.step(turning(env.agents))[0])
    apart = [not readings[0].contacts.all() for readings in log]
    assert 0.4 < np.mean(apart) < 0.8
    if options.get("oracle_merge"):
        assert env.events[-1].kind == "merge"
        return  # a merge by the oracle comes from the truth
    episode = env.episode
    assert [event.kind for event in env.events if event.kind != "attempt"] == ["merge"]
    belief = TeamBelief(env.config.belief, 2, episode.belief_seed, episode.body)
    for tick, (readings, expected) in enumerate(zip(log, observed, strict=True)):
        belief.step(readings)
        belief.set_seconds_left(0.1 * (400 - tick))
        for robot, agent in enumerate(env.possible_agents):
            again = observe(belief.belief(robot), env.config.observed)
            for name, value in expected[agent].items():
                np.testing.assert_array_equal(again[name], value, err_msg=name)


@pytest.mark.parametrize("comm_loss", [0.0, 0.7])
def test_claims_are_right_through_forks_and_replays(comm_loss: float) -> None:
    """What the books say of a landmark is what it is: over all, nine of ten lie within 0.6 m of what they claim."""
    env = small_env(max_cycles=400, num_particles=30, comm_loss=comm_loss)
    drive(env, 200)
    assert any(event.kind == "merge" for event in env.events)
    episode = env.episode
    for robot, agent in enumerate(env.possible_agents):
        held = env.belief(agent).map.moved(env.true_start_poses[robot])
        claims = episode.ground_truth.true_ids(robot, held.ids)
        real = claims >= 0
        distances = np.linalg.norm(held.means[real] - env.true_landmarks[claims[real]], axis=1)
        assert np.count_nonzero(real) > 15
        assert np.mean(distances < 0.6) > 0.9


# ---------------------------------------------------------------------- undo


def merged_wrongly(env: ExplorationEnv) -> MergeEvent:
    """Merge the robots of an environment 1.2 m and 0.2 rad from the truth; return the event."""
    episode = env.episode
    x, y, theta = true_start_motion(env) + np.array([1.0, -0.7, 0.2])
    wrong = Alignment(True, "", x, y, theta, 1e-3 * np.eye(3), np.empty((0, 2), np.int64), 0.0)
    episode.ground_truth.merge(episode.belief.merge(0, 1, wrong))
    return env.events[-1]


def true_start_motion(env: ExplorationEnv) -> Any:
    """Return (3,) where robot 1 started, seen from where robot 0 started."""
    return between(*env.true_start_poses)


def test_after_an_undo_beliefs_and_scores_are_as_if_never_merged() -> None:
    """Poses, maps, scores and teammates are those of an environment that never merged, and the grids all but."""
    quiet = small_env().config.replace(belief={"attempts": {"enabled": False}})
    env, twin = (small_env(config=quiet, max_cycles=400) for _ in range(2))
    for each in (env, twin):
        drive(each, 70)
    merged_wrongly(env)
    for _ in range(150):
        infos = env.step(turning(env.agents))[4]
        others = twin.step(turning(twin.agents))[4]
        if env.events[-1].kind == "undo":
            break
        assert infos["robot_1"]["group"] == 0
    assert env.events[-1].kind == "undo"
    for robot, agent in enumerate(env.agents):
        one, two = env.belief(agent), twin.belief(agent)
        np.testing.assert_array_equal(one.particles, two.particles)
        np.testing.assert_array_equal(one.map.means, two.map.means)
        assert one.teammates == ()
        assert np.mean(one.grid.cells != two.grid.cells) < 2e-3
        figures = {name for name in infos[agent] if name not in ("bytes_sent", "merges", "coverage")}
        assert {name: infos[agent][name] for name in figures if "reward" not in name} == {
            name: others[agent][name] for name in figures if "reward" not in name
        }
        assert robot == one.frame
