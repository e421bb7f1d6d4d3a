"""Study of faults: drives with a part left out, and one command for both tables."""

from dataclasses import asdict

import numpy as np
import pytest

from studies.filters.faults import JUMP, MISTAKES, STUDY, Config, drive, play, trials

SMALL = Config(worlds=("circle",), mistakes=("none", "sign of turns"), seeds=1, seed=3)


def test_a_carried_robot_lacks_a_part_of_its_readings() -> None:
    """The other readings stay as they are, each with its own truth."""
    whole = drive("circle", 3, "standard")
    part = whole.without(100, 130)
    assert len(part.odometry) == len(part.frames) == len(part.true_ids) == len(part.true_path) == 270
    np.testing.assert_array_equal(part.odometry[100:], whole.odometry[130:])
    assert part.frames[100] is whole.frames[130]


def test_one_command_shows_lost_robots_and_mistakes() -> None:
    """Each trial is a line of one of the tables: lost robots are warned of, others not, mistakes are named."""
    assert len(trials(Config())) == 3 * 20 * 3 + len(MISTAKES) * 2 * 20
    rows = [asdict(trial) | play(SMALL, trial) for trial in trials(SMALL)]
    lost, mistakes = (table.lines(rows) for table in STUDY.tables)
    assert [line["event"] for line in lost] == ["jump", "carried", "none"]
    assert [line["warned [%]"].value for line in lost] == [100.0, 100.0, 0.0]
    assert [line["soon [%]"].value for line in lost][:2] == [100.0, 100.0]
    assert lost[0]["end [m]"].value == pytest.approx(0.0, abs=0.1)
    assert lost[1]["end [m]"].value > 1.0
    assert lost[0]["worst [m]"].value > 0.9 * np.hypot(*JUMP[:2])
    assert [(line["mistake"], line["right [%]"].value) for line in mistakes] == [
        ("none", 100.0), ("none", 100.0), ("sign of turns", 100.0), ("sign of turns", 100.0),
    ]  # fmt: skip
