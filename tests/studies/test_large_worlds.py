"""Measurements of large worlds, in small ones: claims of attempts beside the truth, and worlds in turn."""

import math

import pytest

from slam_backend.team import merge
from studies.in_turn import worlds as worlds_in_turn
from studies.merging import claims as merge_claims
from studies.scale import Config


def test_claims_are_those_of_all_attempts_whose_maps_align() -> None:
    """Each merge has a claim, refused attempts have one, too, and errors are those of the merges."""
    decide = merge.refused_if_uncertain
    config = Config(extents=(40.0,), robots=(3,), duration=120.0, seed=10001, seeds=1)
    claims, errors = merge_claims.claims_of(config)
    merged = [claim for claim in claims if claim["merged"]]
    assert len(merged) == len(errors) > 0
    assert [claim["error_m"] for claim in merged] == pytest.approx([error for error, _ in errors])
    assert all(math.isfinite(claim["nees"]) and claim["nees"] > 0.0 and claim["sigma_m"] > 0.0 for claim in claims)
    assert merge.refused_if_uncertain is decide


def test_claims_need_an_episode() -> None:
    """No seeds at all are refused."""
    with pytest.raises(ValueError, match="seeds: expected"):
        merge_claims.main(seeds=0)


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
