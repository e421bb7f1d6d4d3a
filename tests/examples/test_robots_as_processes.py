"""The example of robots as processes: they find each other, and killing one leaves the others right."""

import re

import numpy as np
import pytest

from examples.robots_as_processes import main

LINE = re.compile(r"(robot-\d), with ([\w -]+): (\d+) landmarks, (\d+) at true ones, RMS error ([\d.]+) m\.")
HALL = {"robots": 3, "world": "hall", "seconds": 60.0, "mrclam": None}


def maps_of(output: str) -> dict[str, tuple[list[str], float, float]]:
    """Return group, share of landmarks that are true ones, and RMS error [m] of each robot, from what it printed."""
    found = LINE.findall(output)
    return {name: (group.split(), int(true) / int(count), float(error)) for name, group, count, true, error in found}


@pytest.mark.slow
def test_robots_of_processes_find_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    """Three processes end in one group, each with a map of true landmarks to a few centimetres."""
    main(**HALL, seed=0, speed=6.0, kill=None, at=0.0, revive=True)
    maps = maps_of(capsys.readouterr().out)
    assert len(maps) == 3
    for group, share, error in maps.values():
        assert group == ["robot-0", "robot-1", "robot-2"]
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
