"""Look-alike corridors close no loop falsely, and the script would count it if they did."""

from dataclasses import asdict

import numpy as np
import pytest

from studies.filters import false_closures as closures


@pytest.mark.parametrize("kind", ["seen", "blind", "turned"])
def test_both_corridors_look_the_same(kind: str) -> None:
    """Each landmark of A has one in B with the same descriptor, shifted or turned by half a turn, on a wall."""
    length, pitch = 9.0, 5.0
    built = closures.build_corridors(kind, length, pitch, np.random.default_rng(3))
    descriptors, walls = built.landmarks.descriptors, built.world.walls
    twins = [np.flatnonzero((descriptors == own).all(axis=1)) for own in descriptors]
    pairs = np.array([pair for pair in twins if len(pair) == 2])
    assert len(pairs) >= 20
    assert (len(pairs) == len(descriptors)) == (kind != "seen")
    a, b = pairs.T
    positions, normals = built.landmarks.positions, built.landmarks.normals
    first = positions[a, 1] < 0.5 * pitch
    a, b = np.where(first, a, b), np.where(first, b, a)
    sign, shift = (-1.0, [length, pitch]) if kind == "turned" else (1.0, [0.0, pitch])
    np.testing.assert_allclose(positions[b, :2], sign * positions[a, :2] + shift)
    np.testing.assert_allclose(normals[b], sign * normals[a])
    of_wall = walls[built.landmarks.walls]
    ways, off = of_wall[:, 2:] - of_wall[:, :2], positions[:, :2] - of_wall[:, :2]
    np.testing.assert_allclose(ways[:, 0] * off[:, 1] - ways[:, 1] * off[:, 0], 0.0, atol=1e-9)


def test_a_filter_without_a_position_gate_closes_loops_falsely() -> None:
    """A gate that lets pass what is metres off takes B for A, and the trial says so."""
    trial = closures.Trial(kind="seen", seed=0)
    row = closures.play(closures.Config(), trial, position_gate=1e9, new_landmark_gate=1e9, ambiguity_margin=0.0)
    assert row["false_closures"] > 0
    assert row["wrong"] > 20


@pytest.mark.slow
def test_look_alike_corridors_close_no_loop_falsely() -> None:
    """No trial of any kind has a false loop closure; the way back through A is recognised in most."""
    config = closures.Config(trials=30, seed=5000)
    rows = [asdict(trial) | closures.play(config, trial) for trial in closures.trials(config)]
    assert {row["kind"] for row in rows} == set(closures.KINDS)
    assert [row["seed"] for row in rows if row["false_closures"]] == []
    assert sum(row["true_closure"] for row in rows) >= 20
    assert sum(row["end_error_m"] < 1.0 for row in rows) >= 27
    assert min(row["matches"] for row in rows) > 50
    lines = [line for line in closures.STUDY.tables[0].lines(rows) if line["offset"] == "all"]
    assert [line["trials"].value for line in lines] == [10, 10, 10]
