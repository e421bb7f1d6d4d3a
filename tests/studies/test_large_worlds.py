"""Measurements of large worlds, in small ones: worlds in turn."""

import pytest

from studies.in_turn import worlds as worlds_in_turn


def test_worlds_are_played_in_turn(capsys: pytest.CaptureFixture[str]) -> None:
    """Each line has a world; the last one's ratio is 1."""
    worlds_in_turn.main(["office:extent=30@3", "loops@2"], seed=1, robots=2, steps=10)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" ms at")[0].rsplit(": ", 1)[0] for line in lines[:2]] == ["office:extent=30@3"] * 2
    assert [line.split()[1] for line in lines] == ["steps", "states"] * 2
    assert all("; 1.00 of" in line for line in lines[2:])


@pytest.mark.parametrize("named", ["office", "office@", "@3", "office@soon"])
def test_worlds_need_a_time(named: str) -> None:
    """A world without a time is refused with an example."""
    with pytest.raises(ValueError, match=r"worlds: expected WORLD@SECONDS, got .*office:extent=30@60"):
        worlds_in_turn.played(named, 1, 2, 10)
