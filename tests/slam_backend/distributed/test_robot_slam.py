"""Robots in processes of their own: lost, late, repeated and foreign messages, restarts, and groups that agree."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.teams import ASSUMED_CAMERA, MOTION, SimulatedTeam
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend.core.validation import FloatArray
from slam_backend.distributed import RobotSlam
from slam_backend.distributed import messages as m
from slam_backend.geometry import compose, inverse
from slam_backend.models.measurements import Measurements
from slam_backend.state.codec import encode
from slam_backend.state.format import equal

NAMES = ("ada", "bo", "cleo")


def robots_of(simulation: SimulatedTeam, **options: Any) -> list[RobotSlam]:
    """Return robots that assume the noise of a simulation, with few particles."""
    given = {"num_particles": 10, "camera": ASSUMED_CAMERA, "motion": MOTION, "rejuvenate_every": 10,
             "share_every": 10, "attempt_every": 5} | options  # fmt: skip
    return [RobotSlam(name, seed=k, **given) for k, name in enumerate(NAMES[: simulation.num_robots])]


def drive(simulation: SimulatedTeam, robots: list[RobotSlam], steps: int, hears: Any = lambda k, j: True) -> None:
    """Drive, and deliver all messages at once to the robots that hear them."""
    for _ in range(steps):
        for robot, odometry, frame in zip(robots, *simulation.read(), strict=True):
            robot.step(odometry, frame)
        for k, robot in enumerate(robots):
            for message in robot.outbox():
                for j, other in enumerate(robots):
                    if j != k and hears(k, j):
                        assert other.receive(message) is None


def tell_all(robots: list[RobotSlam]) -> None:
    """Let all robots publish, hear each other, align whom they can, and publish and hear that, too."""
    for _ in range(2):
        for robot in robots:
            robot.share()
        for robot in robots:
            for message in robot.outbox():
                for other in robots:
                    if other is not robot:
                        assert other.receive(message) is None
        for robot in robots:
            while robot.attempt() is not None:
                pass
    for robot in robots:
        robot.share()
    for robot in robots:
        for message in robot.outbox():
            for other in robots:
                if other is not robot:
                    other.receive(message)


@pytest.fixture(scope="module")
def met() -> tuple[SimulatedTeam, list[RobotSlam]]:
    """Three robots after a round of the ring, which have heard each other."""
    simulation = SimulatedTeam(3, seed=5)
    robots = robots_of(simulation)
    drive(simulation, robots, 120)
    tell_all(robots)
    return simulation, robots


def copy_of(robot: RobotSlam, folder: Path) -> RobotSlam:
    """Return the robot of a file of another."""
    robot.save(folder / robot.name)
    return RobotSlam.load(folder / robot.name)


def test_robots_with_unknown_starts_find_each_other(met: Any) -> None:
    """Each robot places the others where they started and are, and holds a map of what all have seen."""
    simulation, robots = met
    for k, robot in enumerate(robots):
        assert robot.group == NAMES
        poses = robot.poses()
        for j, name in enumerate(NAMES):
            off = compose(inverse(compose(simulation.starts[k], poses[name].mean)), simulation.poses[j])
            assert np.hypot(*off[:2]) < 0.3
        assert len(robot.map()) > max(len(other.filter.map()) for other in robots)


def test_all_robots_of_a_group_agree(met: Any) -> None:
    """The motions between three robots are the same by whichever of them composes them, and so are their maps."""
    _, robots = met
    placed = [{name: estimate.mean for name, estimate in robot.poses().items()} for robot in robots]

    def between(of: dict[str, FloatArray], one: str, other: str) -> FloatArray:
        return compose(inverse(of[one]), of[other])

    for one, other in (("ada", "bo"), ("bo", "cleo"), ("cleo", "ada")):
        motions = [between(of, one, other) for of in placed]
        np.testing.assert_allclose(motions[1:], motions[:-1], atol=0.05)


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_lost_late_repeated_and_reordered_messages_do_no_harm(data: st.DataObject) -> None:
    """Whatever becomes of messages on the way, none is refused, and once all maps have arrived the groups agree."""
    simulation = SimulatedTeam(3, seed=data.draw(st.integers(0, 3)))
    robots = robots_of(simulation)
    on_the_way: list[tuple[int, bytes]] = []
    for _ in range(60):
        for robot, odometry, frame in zip(robots, *simulation.read(), strict=True):
            robot.step(odometry, frame)
        for k, robot in enumerate(robots):
            on_the_way += [(j, message) for message in robot.outbox() for j in range(3) if j != k]
        for _ in range(min(len(on_the_way), data.draw(st.integers(0, 4)))):
            j, message = on_the_way.pop(data.draw(st.integers(0, len(on_the_way) - 1)))
            for _ in range(data.draw(st.integers(0, 2))):  # lost, delivered, or delivered twice
                assert robots[j].receive(message) is None
    tell_all(robots)
    known = [robot.group for robot in robots]
    for robot, group in zip(robots, known, strict=True):
        assert robot.name in group
        assert all(known[NAMES.index(name)] == group for name in group)


def test_a_silent_robot_stops_no_other(met: Any) -> None:
    """A robot that is killed only stops to be heard: the others keep its last map, and go on."""
    simulation = SimulatedTeam(3, seed=5)
    robots = robots_of(simulation)
    drive(simulation, robots, 70)
    before = robots[0].map()
    drive(simulation, robots, 50, lambda k, j: 2 not in (k, j))
    assert robots[0].group == robots[1].group == NAMES
    assert len(robots[0].map()) >= len(before)


def test_a_robot_continues_from_its_file_bit_for_bit(met: Any, tmp_path: Path) -> None:
    """A robot of a file takes the steps that the saved one takes, and holds the maps that it had received."""
    simulation, robots = met
    robot = copy_of(robots[0], tmp_path)
    assert robot.group == robots[0].group
    assert encode(robot.map()) == encode(robots[0].map())
    twin = copy_of(robots[0], tmp_path)
    for _ in range(7):
        odometry, frames = simulation.read()
        one, other = (each.step(odometry[0], frames[0]) for each in (robot, twin))
        assert equal(one, other)
    assert encode(robot.filter.get_state()) == encode(twin.filter.get_state())


def test_a_robot_of_a_file_is_heard_again(met: Any, tmp_path: Path) -> None:
    """Maps that a robot publishes after its return count as newer than those from before it was killed."""
    simulation = SimulatedTeam(2, seed=5)
    robots = robots_of(simulation)
    drive(simulation, robots, 40)
    robots[1].save(tmp_path / "bo")
    drive(simulation, robots, 40)  # publishes, and is killed
    number = robots[0]._inbox.maps["bo"].number
    back = RobotSlam.load(tmp_path / "bo")
    back.share()
    assert all(robots[0].receive(message) is None for message in back.outbox())
    assert robots[0]._inbox.maps["bo"].number > number
    number = robots[0]._inbox.maps["bo"].number
    back = RobotSlam.load(tmp_path / "bo")
    back.save(tmp_path / "bo")  # at once, and is killed before the next time
    again = RobotSlam.load(tmp_path / "bo")
    again.share()
    assert all(robots[0].receive(message) is None for message in again.outbox())
    assert robots[0]._inbox.maps["bo"].number > number


def test_a_robot_with_an_empty_memory_replaces_its_former_self(met: Any) -> None:
    """A later life of a name drops the map and the links of the earlier one; the earlier one is refused."""
    simulation = SimulatedTeam(2, seed=5)
    robots = robots_of(simulation)
    drive(simulation, robots, 120)
    tell_all(robots)
    assert robots[0].group == ("ada", "bo")
    old, new = robots[1], robots_of(simulation, life=1)[1]
    for _ in range(20):
        odometry, frames = simulation.read()
        new.step(odometry[1], frames[1])
    new.share()
    assert all(robots[0].receive(message) is None for message in new.outbox())
    assert robots[0].group == ("ada",)
    old.share()
    assert all(robots[0].receive(message) is None for message in old.outbox())  # late: not refused, not used
    assert robots[0]._inbox.maps["bo"].life == 1


@pytest.mark.parametrize("life", [0, 7])
def test_two_robots_of_one_name_are_noticed(met: Any, life: int) -> None:
    """A robot that hears its own name in a later life, or with a map that it has not published, says so."""
    simulation = SimulatedTeam(1, seed=5)
    robot, other = robots_of(simulation)[0], robots_of(simulation, life=life)[0]
    drive(simulation, [other], 20)
    other.share()
    assert robot.receive(other.outbox()[0]) == "expected one robot named 'ada', got two: rename one"
    assert robot.refused == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda whole: b"hello", "expected a message of a robot, got other bytes"),
        (lambda whole: b"", "expected a message of a robot, got other bytes"),
        (lambda whole: whole[:4] + b"\x09\x00" + whole[6:], "got version 9: use one version on all robots"),
        (lambda whole: whole[:-1] + bytes([whole[-1] ^ 1]), "got one of a stranger, or a damaged one"),
        (lambda whole: whole[:60], "got one of a stranger, or a damaged one"),
        (lambda whole: whole + bytes(20_000), "expected a message of at most 16,384 bytes"),
    ],
)
def test_bad_messages_cost_a_line(met: Any, change: Any, words: str) -> None:
    """Other bytes, other versions, damaged, cut and long messages are refused in one line, and change nothing."""
    _, robots = met
    robots[1].share()
    message = robots[1].outbox()[0]
    maps = dict(robots[0]._inbox.maps)
    answer = robots[0].receive(change(message))
    assert answer is not None
    assert words in answer
    assert "\n" not in answer
    assert robots[0]._inbox.maps == maps


def test_messages_of_another_team_are_refused(met: Any) -> None:
    """Without the word of the team no message is read."""
    simulation = SimulatedTeam(1, seed=5)
    stranger = robots_of(simulation, team="others")[0]
    drive(simulation, [stranger], 20)
    stranger.share()
    answer = met[1][0].receive(stranger.outbox()[0])
    assert answer is not None
    assert "stranger" in answer


@settings(max_examples=200, deadline=None)
@given(body=st.binary(max_size=300), name=st.text(max_size=8), part=st.integers(0, 70), parts=st.integers(0, 70))
def test_no_payload_does_harm(body: bytes, name: str, part: int, parts: int) -> None:
    """Messages with the right seal and any content are refused in one line or wait for their other parts."""
    robot = RobotSlam("ada", num_particles=5)
    answer = robot.receive(m._sealed(m.Part(name, 1, 1, part, parts, body), robot._key))
    assert answer is None or (answer and "\n" not in answer)
    assert not robot._inbox.maps


def test_only_the_latest_map_waits_to_be_sent(met: Any) -> None:
    """Messages that are not fetched do not pile up: a later map replaces them, which is counted."""
    simulation = SimulatedTeam(1, seed=5)
    (robot,) = robots_of(simulation)
    for _ in range(60):
        odometry, frames = simulation.read()
        robot.step(odometry[0], frames[0])
    assert robot.dropped >= 5
    assert len({m.read_message(message, robot._key).number for message in robot.outbox()}) == 1  # type: ignore[union-attr]
    assert robot.outbox() == []


def test_copies_of_messages_are_spread_over_time(met: Any) -> None:
    """With three copies each message is sent three times before the next map, not at once."""
    simulation = SimulatedTeam(1, seed=5)
    (robot,) = robots_of(simulation, copies=3)
    sent = []
    for _ in range(29):
        odometry, frames = simulation.read()
        robot.step(odometry[0], frames[0])
        sent.append(robot.outbox())
    assert [step for step, messages in enumerate(sent, start=1) if messages and step >= 20] == [20, 23, 26]
    assert sent[19] == sent[22] == sent[25]


def test_a_team_has_at_most_so_many_robots() -> None:
    """Robots beyond the limit are refused in one line, so that memory is bounded."""
    robot, key = RobotSlam("ada", num_particles=5), RobotSlam("ada", num_particles=5)._key
    answers = [robot.receive(m._sealed(m.Part(f"r{k}", 1, 1, 0, 2, b""), key)) for k in range(m.MOST_PEERS + 1)]
    assert answers[:-1] == [None] * m.MOST_PEERS
    assert answers[-1] == "expected at most 32 robots, got one more, 'r32'"


def test_maps_with_other_descriptors_are_refused(met: Any) -> None:
    """A map of another front end is refused in one line; one that came before the own first landmark is dropped."""
    frames = [Measurements([[0.0, 0.0, 2.0]], [[1.0] + [0.0] * (d - 1)]) for d in (2, 3)]
    two, three = (RobotSlam(name, num_particles=5, min_count=1, rejuvenate_every=5) for name in ("two", "three"))
    for _ in range(6):
        three.step([0.01, 0.0, 0.0], frames[1])
    three.share()
    (message,) = three.outbox()
    assert two.receive(message) is None  # nothing is known of its own yet
    for _ in range(6):
        two.step([0.01, 0.0, 0.0], frames[0])
    two.share()
    assert two.attempt() is None
    assert not two._inbox.maps
    assert two.receive(message) == "expected descriptors of length 2, got 3 of 'three': use one front end"
    assert two.group == ("two",)


def test_a_link_that_later_maps_contradict_is_undone(met: Any) -> None:
    """A link with a wrong motion moves or goes at the next attempts."""
    simulation = SimulatedTeam(2, seed=5)
    robots = robots_of(simulation)
    drive(simulation, robots, 100)
    tell_all(robots)
    link = robots[0]._links["bo"]
    robots[0]._links["bo"] = m.Link(
        other="bo", life=link.life, motion=np.add(link.motion, (2.0, 0.0, 0.0)), pairs=link.pairs
    )
    drive(simulation, robots, 20)
    assert "moved" in [event.kind for event in robots[0].events]
    true = simulation.true_motion(0, 1)
    assert np.hypot(*(robots[0]._links["bo"].motion - true)[:2]) < 0.5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": ""}, "name: expected a name of 1 to 64 bytes"),
        ({"name": "x" * 65}, "name: expected a name of 1 to 64 bytes"),
        ({"life": -1}, "life: expected an int"),
        ({"share_every": 0}, "share_every: expected an int"),
        ({"share_every": 2, "copies": 3}, "copies: expected an int"),
        ({"team": 7}, "team: expected a str"),
        ({"alignment": 3}, "alignment: expected"),
        ({"num_particles": 0}, "num_particles: expected"),
        ({"particles": 5}, "particles"),
        ({"rejuvenate_every": None}, "rejuvenate_every: expected a smoother"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], words: str) -> None:
    """The error names the argument."""
    with pytest.raises((ValueError, TypeError), match=words):
        RobotSlam(**{"name": "ada"} | arguments)


def test_bad_files_are_refused(met: Any, tmp_path: Path) -> None:
    """Missing, foreign and damaged files are refused with the name of the file."""
    _, robots = met
    file = tmp_path / "ada"
    with pytest.raises(ValueError, match="path: expected a state file"):
        RobotSlam.load(file)
    file.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"Write one with RobotSlam\.save"):
        RobotSlam.load(file)
    robots[0].save(file)
    content = file.read_bytes()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match="an intact state file"):
        RobotSlam.load(file)
    with pytest.raises(ValueError, match="path: expected"):
        robots[0].save(tmp_path / "no folder" / "ada")
