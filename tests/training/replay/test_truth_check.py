"""True landmarks that contradict themselves are named, with the swap that explains them; maps alone are not blamed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import write_log

from slam_backend.geometry import transform_points
from training.replay.truth_check import find_wrong_landmarks, wrong_landmark_notes

NUM = 15
MOTION = np.array([3.0, -2.0, 2.5])


def map_of(truth: np.ndarray, rng: np.random.Generator, sigma: float = 0.1, bend: float = 0.0) -> np.ndarray:
    """Return estimates (n, 2) of true positions (n, 2) in another frame, with errors, bent by an angle per metre."""
    angles = bend * truth[:, :1]
    turned = truth + np.concatenate([-angles * truth[:, 1:], angles * truth[:, :1]], axis=1)
    return transform_points(MOTION, turned + rng.normal(0.0, sigma, truth.shape))


def places(seed: int) -> tuple[np.ndarray, np.random.Generator]:
    """Return true positions (n, 2) in a hall of 15 x 8 m, none within 1.5 m of another, and the random stream."""
    rng = np.random.default_rng(seed)
    found = [np.zeros(2)]
    while len(found) < NUM:
        drawn = rng.uniform([0.0, 0.0], [15.0, 8.0])
        if np.hypot(*(np.array(found) - drawn).T).min() > 1.5:
            found.append(drawn)
    return np.array(found), rng


@pytest.mark.parametrize("wrong", [[4, 9], [0, 14], [1, 2, 7], [3, 5, 6, 8]])
def test_swapped_landmarks_are_found_with_their_permutation(wrong: list[int]) -> None:
    """Whatever the frame of the map, the swapped landmarks and those at whose places they lie are named."""
    truth, rng = places(1)
    means = map_of(truth, rng, sigma=0.05)
    truth[wrong] = truth[np.roll(wrong, 1)]
    found = find_wrong_landmarks(truth, means)
    assert found is not None
    assert found.rows.tolist() == wrong
    assert found.instead.tolist() == np.roll(wrong, -1).tolist()
    assert found.errors.min() > 1.0
    assert found.others < 0.15


def test_a_misplaced_landmark_is_found_without_a_swap() -> None:
    """A position of its own contradicts the others, but no permutation explains it."""
    truth, rng = places(2)
    means = map_of(truth, rng, sigma=0.05)
    truth[6] += [1.0, 1.5]
    found = find_wrong_landmarks(truth, means)
    assert found is not None
    assert found.rows.tolist() == found.instead.tolist() == [6]


def test_errors_of_maps_are_no_contradiction() -> None:
    """Of 600 maps with noise, bent ones among them, none is blamed on the truth: no gap separates a few landmarks."""
    for seed in range(200):
        truth, rng = places(seed)
        for sigma, bend in ((0.1, 0.0), (0.3, 0.0), (0.05, 0.02)):
            assert find_wrong_landmarks(truth, map_of(truth, rng, sigma, bend)) is None
    assert find_wrong_landmarks(truth[:5], truth[:5] * [[1.0, 5.0]]) is None  # too few to tell


def test_most_maps_must_agree() -> None:
    """What one of three maps has wrong is its own error; what two have, or the only one, is that of the truth."""
    truth, rng = places(3)
    right, wrong = map_of(truth, rng), map_of(truth, rng)
    wrong[[2, 5]] = wrong[[5, 2]]
    one, other = (dict(enumerate(means)) for means in (right, wrong))
    names = list(range(100, 100 + NUM))
    assert not list(wrong_landmark_notes(truth, [one, one, other], names))
    for maps in ([other], [other, one, other], [other, {row: one[row] for row in range(4)}]):
        (note,) = wrong_landmark_notes(truth, maps, names)
        assert "landmarks 102, 105 seem to be swapped (102 is mapped at 105, 105 is mapped at 102)" in note


def test_a_replay_names_swapped_landmarks(vslam: Any, tmp_path: Path) -> None:
    """One line in the output and in the notes of `metrics.json`; none for the right truth."""
    write_log(tmp_path, noise=1.0)
    options = ("replay", "mrclam", "--path", str(tmp_path), "--particles", "20", "--seed", "0")
    file = tmp_path / "Landmark_Groundtruth.dat"
    rows = file.read_text().splitlines()
    for out, swapped in (("right", False), ("wrong", True)):
        if swapped:
            number_a, number_b = rows[2].split()[0], rows[9].split()[0]
            rows[2], rows[9] = (row.partition(" ")[2] for row in (rows[9], rows[2]))
            rows[2], rows[9] = f"{number_a} {rows[2]}", f"{number_b} {rows[9]}"
            file.write_text("\n".join(rows) + "\n")
        done = vslam(*options, "--out", str(tmp_path / out))
        notes = json.loads((tmp_path / out / "metrics.json").read_text())["notes"]
        assert len(notes) == swapped
        assert ("seem to be swapped" in done.out) == swapped
        assert all(f"landmarks {number_a}, {number_b} seem to be swapped" in note for note in notes)
