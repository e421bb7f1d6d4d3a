"""Look-alike corridors close no loop falsely, and the script would count it if they did."""

import numpy as np
import pytest

from studies import false_closures as closures


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
    trial = closures.run_trial(0, position_gate=1e9, new_landmark_gate=1e9, ambiguity_margin=0.0)
    assert trial.false_closures > 0
    assert trial.wrong > 20


@pytest.mark.slow
def test_look_alike_corridors_close_no_loop_falsely() -> None:
    """No trial of any kind has a false loop closure; the way back through A is recognised in most."""
    trials = [closures.run_trial(seed) for seed in range(5000, 5030)]
    assert {trial.kind for trial in trials} == set(closures.KINDS)
    assert [trial.seed for trial in trials if trial.false_closures] == []
    assert sum(trial.true_closure for trial in trials) >= 20
    assert sum(trial.end_error_m < 1.0 for trial in trials) >= 27
    assert min(trial.matches for trial in trials) > 50
    rows = closures.rows_of(trials)
    assert sum(int(row[2]) for row in rows) == 30
