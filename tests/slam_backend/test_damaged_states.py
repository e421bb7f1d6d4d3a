"""What is damaged of a state is refused by name before anything is taken over, or does no harm."""

import re
from collections.abc import Callable
from typing import Any

import pytest
from builders.damage import at, replaced, try_damaged
from builders.teams import SimulatedTeam, begin_undo, driven, links, true_alignment

from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.state.codec import encode
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflows of what is out of place do no harm

SLICED = {"existence": ExistenceModel(), "rejuvenate_every": 8, "smoothing": SmoothingOptions(incremental=True)}
FORKED = links(3, (0, 2))

Subject = tuple[FastSlam | TeamSlam, list[Any]]


def filter_with_all(**options: Any) -> Subject:
    """Return a filter that keeps existence and is rejuvenated, and what its robots read next."""
    simulation = SimulatedTeam(2, seed=3)
    slam = FastSlam(2, num_particles=60, rejuvenate_every=9, resample_threshold=0.9, **options)
    for _ in range(20):
        slam.step(*simulation.read())  # type: ignore[arg-type]
    return slam, [simulation.read() for _ in range(8)]


def merged(**options: Any) -> tuple[SimulatedTeam, TeamSlam]:
    """Return a team of three robots, two of which have merged."""
    simulation, team = driven(3, 104, 60, num_particles=10, **options)
    team.merge(0, 1, true_alignment(simulation, team, 0, 1))
    simulation.run(team, 6)
    return simulation, team


def team_with_forks() -> Subject:
    """Return a team of which a robot is out of contact with its group."""
    simulation, team = merged(**SLICED)
    simulation.run(team, 10, FORKED)
    return team, [(*simulation.read(), FORKED if i < 2 else None) for i in range(5)]


def team_in_a_replay() -> Subject:
    """Return a team with a returned robot whose replay is not complete."""
    simulation, team = merged(rejuvenate_every=6)
    simulation.run(team, 30, FORKED)
    simulation.run(team, 1)
    return team, [simulation.read() for _ in range(5)]


def team_in_an_undo() -> Subject:
    """Return a team that takes back a merge."""
    simulation, team = merged(**SLICED, merging=MergeOptions(watch_every=10_000))
    simulation.run(team, 25)
    begin_undo(team)
    simulation.run(team, 2)
    return team, [simulation.read() for _ in range(6)]


def team_in_an_attempt() -> Subject:
    """Return a team that smooths two maps to align them again."""
    simulation = SimulatedTeam(3, seed=101)
    smoothing = SmoothingOptions(incremental=True)
    attempts = AttemptOptions(every=5)
    team = simulation.build(num_particles=10, rejuvenate_every=20, smoothing=smoothing, attempts=attempts)
    while team._merges.attempt is None:
        simulation.run(team, 1)
    return team, [simulation.read() for _ in range(8)]


SUBJECTS: dict[str, Callable[[], Subject]] = {
    "filter": filter_with_all,
    "filter with existence": lambda: filter_with_all(existence=ExistenceModel()),
    "forks": team_with_forks,
    "replay": team_in_a_replay,
    "undo": team_in_an_undo,
    "attempt": team_in_an_attempt,
}


def play(subject: FastSlam | TeamSlam, readings: list[Any]) -> None:
    """Let a filter or a team go on, and look at all that it knows."""
    for read in readings:
        subject.step(*read)
    subject.get_state()
    if isinstance(subject, TeamSlam):
        subject.map_summaries(), subject.team_poses(), subject.diagnostics
        for robot in range(subject.num_robots):
            subject.map(robot, "mixture")
    else:
        subject.map("mixture"), subject.pose(0)


@pytest.mark.parametrize("seeds", [range(350), pytest.param(range(1000, 1250), marks=pytest.mark.slow)], ids=len)
@pytest.mark.parametrize("kind", SUBJECTS)
def test_damaged_states_are_refused_or_harmless(kind: str, seeds: range) -> None:
    """Of the damaged states of each kind most are refused, which changes nothing; from the others it goes on."""
    subject, readings = SUBJECTS[kind]()
    whole = encode(subject.get_state())

    def go_on(_: Any) -> None:
        try:
            play(subject, readings)
        except ValueError as error:  # a map of descriptors of another length or kind goes on with frames like it
            if not re.search("expected vectors of size|Use one kind of descriptor", str(error)):
                raise

    counts = try_damaged(subject, seeds, lambda: encode(subject.get_state()) == whole, go_on)
    assert counts["refused"] > 0.57 * len(seeds)
    assert counts["accepted"] > 0.057 * len(seeds)


@pytest.mark.parametrize(
    ("way", "says"),
    [
        (("maps", "map_of"), r"state\['maps'\]\.map_of: expected integers from 0 to \d+, got a value out of range"),
        (("maps", "maps"), r"state\['maps'\]\.maps: expected integers from 0 to \d+"),
        (
            ("rejuvenation", "graph", "last_keys"),
            r"state\['rejuvenation'\]\['graph'\]\.last_keys: expected integers from",
        ),
        (("rejuvenation", "graph", "point_frames"), r"\.point_frames: expected integers"),
        (("rejuvenation", "graph", "parents"), r"\.parents: expected integers|keys that do not lead back to a start"),
    ],
)
def test_an_index_out_of_range_is_refused_by_name(way: tuple[str, ...], says: str) -> None:
    """Kernels would read and write beyond their arrays."""
    slam, _ = filter_with_all()
    for index in (10**9, -7):
        state: Any = slam.get_state()
        array = at(state, list(way)).copy()
        array.reshape(-1)[0] = index
        with pytest.raises(ValueError, match=says):
            slam.set_state(replaced(state, list(way), array))
