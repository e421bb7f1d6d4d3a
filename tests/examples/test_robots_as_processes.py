"""The example of robots as processes: a killed one, or a full disk, stops no other."""

import re
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.full_disk import files_up_to
from builders.teams import ASSUMED_CAMERA, MOTION, SimulatedTeam

from examples.robots_as_processes import free_ports, main, run_robot

LINE = re.compile(r"(robot-\d), with ([\w -]+): (\d+) landmarks, (\d+) at true ones, RMS error ([\d.]+) m, ")
HALL = {"robots": 3, "world": "hall", "seconds": 60.0, "mrclam": None}


def maps_of(output: str) -> dict[str, tuple[list[str], float, float]]:
    """Return the others of its group, share of landmarks that are true ones, and RMS error [m], by robot."""
    found = LINE.findall(output)
    return {name: (group.split(), int(true) / int(count), float(error)) for name, group, count, true, error in found}


@pytest.mark.slow
def test_robots_of_processes_find_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    """Three processes end in one group, each with a map of true landmarks to a few centimetres."""
    main(**HALL, seed=0, speed=6.0, kill=None, at=0.0, revive=True)
    maps = maps_of(capsys.readouterr().out)
    assert len(maps) == 3
    for name, (others, share, error) in maps.items():
        assert sorted([name, *others]) == ["robot-0", "robot-1", "robot-2"]
        assert share > 0.9
        assert error < 0.1


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("number", range(20))
def test_killing_a_process_leaves_the_others_right(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Whichever process is killed, and when, the others hold maps of true landmarks; it comes back from its file."""
    rng = np.random.default_rng(number)
    killed = int(rng.integers(3))
    main(**HALL, seed=number, speed=6.0, kill=killed, at=float(rng.uniform(1.0, 58.0)), revive=number % 2 == 0)
    maps = maps_of(capsys.readouterr().out)
    names = {f"robot-{k}" for k in range(3)}
    assert set(maps) == (names if number % 2 == 0 else names - {f"robot-{killed}"})
    for name, (_, share, error) in maps.items():
        if name != f"robot-{killed}":
            assert share > 0.9
            assert error < 0.1


class Parent(list[Any]):
    """The pipe to a parent that lets a robot begin and end at once, and keeps what the robot says."""

    send = list.append

    def recv(self) -> str:
        """Let it begin."""
        return "begin"

    def poll(self, timeout: float) -> bool:
        """Let it end."""
        return True


class Readings(list[Any]):
    """Readings during which there is room on the disk again."""

    room: ExitStack

    def __getitem__(self, rows: Any) -> Any:
        for k, each in enumerate(super().__getitem__(rows)):
            if k == 120:
                self.room.close()
            yield each


def test_a_full_disk_does_not_stop_a_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without room for its state a robot says so once and goes on; with room it saves, and comes back from there."""
    monkeypatch.setattr(signal, "signal", lambda *given: None)
    simulation, file = SimulatedTeam(1, seed=5), tmp_path / "robot-0.state"
    readings = Readings((odometry[0], frames[0]) for odometry, frames in (simulation.read() for _ in range(180)))
    ports = dict(zip(("robot-0", "robot-1"), free_ports(2), strict=True))
    options = {"num_particles": 10, "camera": ASSUMED_CAMERA, "motion": MOTION}
    ends = []
    for _ in range(2):
        parent = Parent()
        with ExitStack() as readings.room:
            readings.room.enter_context(files_up_to(1000))
            run_robot("robot-0", ports, readings, 0.0, options, file, parent)
        ends.append(parent)
    lines = capsys.readouterr().out.splitlines()
    not_saved = "robot-0: not saved, goes on: path: expected a file that can be written, "
    assert [line.partition(f"got '{file}'")[0] for line in lines] == [
        not_saved, "robot-0: saved again", "robot-0: back from its file, at step 150 of 180", not_saved,
    ]  # fmt: skip
    assert "File too large" in lines[0]
    assert list(tmp_path.iterdir()) == [file]
    assert [end[0] for end in ends] == ["ready"] * 2
    assert ends[0][1] > ends[1][1] == 0.0  # bytes a step: no map is due in the last 30
    (_, one), (_, other) = (end[2] for end in ends)
    np.testing.assert_array_equal(one.means, other.means)  # as if it had never been gone
