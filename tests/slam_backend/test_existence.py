"""Log-odds of existence: Bayes' rule, its promises about deletions, and where landmarks are expected to be seen."""

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from python_entry import python_entry
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels.existence import in_view, updated_log_odds
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.models.camera import StereoCamera

in_view, updated_log_odds = map(python_entry, (in_view, updated_log_odds))

MODELS = [
    ExistenceModel(),
    ExistenceModel(detection=0.9, false_alarm=0.02, prior=0.3, delete_below=0.02, cap=0.99),
    ExistenceModel(detection=0.4, false_alarm=0.1, prior=0.6, delete_below=0.05, cap=0.999),
]
EVERY_MODEL = pytest.mark.parametrize("model", MODELS)


def probability(log_odds: float) -> float:
    """Return the probability that log-odds stand for."""
    return float(1.0 / (1.0 + np.exp(-log_odds)))


@EVERY_MODEL
@given(sightings=st.lists(st.booleans(), max_size=12))
def test_log_odds_are_bayes_rule(model: ExistenceModel, sightings: list[bool]) -> None:
    """Over any sequence of sightings and misses the probability is that of Bayes' rule on the whole sequence."""
    sighting, miss = model.increments()
    log_odds = model.log_odds_prior
    likelihood_right, likelihood_false = 1.0, 1.0
    for seen in sightings:
        log_odds = updated_log_odds(log_odds, seen, True, sighting, miss, np.inf)
        likelihood_right *= model.detection if seen else 1.0 - model.detection
        likelihood_false *= model.false_alarm if seen else 1.0 - model.false_alarm
    joint = model.prior * likelihood_right
    assert probability(log_odds) == pytest.approx(joint / (joint + (1.0 - model.prior) * likelihood_false), rel=1e-9)


def test_what_was_not_expected_tells_nothing_unless_it_is_seen() -> None:
    """A miss counts in view only, a sighting anywhere, and the cap holds."""
    for before in (-1.0, 0.5):
        assert updated_log_odds(before, False, False, 2.0, -1.5, 6.0) == before
        assert updated_log_odds(before, False, True, 2.0, -1.5, 6.0) == before - 1.5
        assert updated_log_odds(before, True, True, 2.0, -1.5, 6.0) == before + 2.0
        assert updated_log_odds(before, True, False, 2.0, -1.5, 6.0) == before + 2.0
    assert updated_log_odds(5.0, True, True, 2.0, -1.5, 6.0) == 6.0


@EVERY_MODEL
def test_a_landmark_that_is_not_there_dies_after_the_stated_number_of_misses(model: ExistenceModel) -> None:
    """From the prior, from the cap and from levels between, that many misses delete it and one fewer does not."""
    sighting, miss = model.increments()
    for start in (model.log_odds_prior, 0.5 * (model.log_odds_prior + model.log_odds_cap), model.log_odds_cap):
        log_odds, misses = start, 0
        while log_odds >= model.log_odds_floor:
            log_odds = updated_log_odds(log_odds, False, True, sighting, miss, model.log_odds_cap)
            misses += 1
        assert misses == model.misses_to_delete(start)
        assert probability(start + misses * miss) < model.delete_below <= probability(start + (misses - 1) * miss)
    assert model.misses_to_delete(model.log_odds_floor - 1e-9) == 0


def lives(model: ExistenceModel, seen_with: float, looks: int, runs: int, seed: int) -> tuple[int, int]:
    """Return how many of `runs` landmarks die, and how many ever reach the cap before, in so many looks."""
    rng = np.random.default_rng(seed)
    sighting, miss = model.increments()
    log_odds = np.full(runs, model.log_odds_prior)
    alive, capped = np.ones(runs, dtype=np.bool_), np.zeros(runs, dtype=np.bool_)
    for _ in range(looks):
        log_odds = np.minimum(model.log_odds_cap, log_odds + np.where(rng.random(runs) < seen_with, sighting, miss))
        alive &= log_odds >= model.log_odds_floor
        capped |= alive & (log_odds >= model.log_odds_cap)
    return int(np.count_nonzero(~alive)), int(np.count_nonzero(capped))


@EVERY_MODEL
@pytest.mark.parametrize("looks", [10, 200])
def test_a_right_landmark_survives_with_the_stated_probability(model: ExistenceModel, looks: int) -> None:
    """Seen with probability `detection`, no more than the stated share is ever deleted; false alarm 1e-3."""
    died, _ = lives(model, model.detection, looks, 20_000, seed=100)
    assert 0 < died <= stats.binom.isf(1e-3, 20_000, model.deletion_bound(looks))


@EVERY_MODEL
def test_a_false_landmark_rarely_becomes_certain_and_always_dies(model: ExistenceModel) -> None:
    """Seen with probability `false_alarm`, at most the share exp(prior - cap) is ever sure, and all die; alarm 1e-3."""
    died, capped = lives(model, model.false_alarm, 300, 20_000, seed=101)
    assert capped <= stats.binom.isf(1e-3, 20_000, np.exp(model.log_odds_prior - model.log_odds_cap))
    assert died == 20_000


def test_a_sensor_that_reports_few_points_makes_a_miss_say_less() -> None:
    """With E landmarks in view and at most L reported, each is seen with d L / E; beyond use nothing is learnt."""
    model = ExistenceModel(detection=0.8, false_alarm=0.05, frame_limit=5)
    assert model.increments(5) == model.increments() == ExistenceModel().increments(1000)
    sighting, miss = model.increments(20)
    assert sighting == pytest.approx(np.log(0.8 * 5 / 20 / 0.05))
    assert miss == pytest.approx(np.log((1.0 - 0.8 * 5 / 20) / 0.95))
    assert model.increments(80) == model.increments(10_000) == (0.0, 0.0)


@numba.njit
def compiled(points: FloatArray, nearest: float, side: float, rise: float, reach: float, out: Any) -> None:
    """Ask for each point as a filter's loop does."""
    for i in range(len(points)):
        out[i] = in_view(points[i, 0], points[i, 1], points[i, 2], nearest, side, rise, reach)


def test_expected_in_view_is_what_a_smaller_camera_sees() -> None:
    """Inside the image less its margin and within the share of the range, compiled or not, for points all around."""
    model = ExistenceModel(margin_px=10.0, range_share=0.75, nearest=0.6)
    camera = StereoCamera(width=300, height=200, focal_px=250.0, mount=(0.1, 0.2, 0.3))
    smaller = replace(camera, width=280, height=180, max_range=6.0)
    rng = np.random.default_rng(7)
    camera_points = rng.uniform([-3.0, -3.0, -2.0], [3.0, 3.0, 7.0], (4000, 3))
    depth = camera_points[:, 2]
    expected = smaller.sees(camera_points) & (depth > 0.6)
    in_robot_axes = camera.robot_from_camera(camera_points) - camera.mount
    found = np.zeros(4000, dtype=np.bool_)
    compiled(np.ascontiguousarray(in_robot_axes), *model.view(camera), found)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal([in_view(*point, *model.view(camera)) for point in in_robot_axes[:300]], found[:300])
    assert 500 < found.sum() < 3500
    assert np.any(camera.sees(camera_points) & ~expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"detection": 0.0}, r"existence\.detection: expected a finite number > 0, got 0\.0"),
        ({"detection": 1.0}, r"existence\.detection: expected a number < 1, got 1\.0\. Nothing is certain\."),
        ({"detection": 0.05}, r"existence\.detection: expected a number > false_alarm \(0\.05\), got 0\.05"),
        ({"prior": 0.005}, r"existence\.prior: expected a number > delete_below \(0\.01\), got 0\.005"),
        ({"cap": 0.5}, r"existence\.cap: expected a number > prior \(0\.5\), got 0\.5"),
        ({"margin_px": -1.0}, r"existence\.margin_px: expected a finite number >= 0, got -1\.0"),
        ({"range_share": 1.1}, r"existence\.range_share: expected a finite number > 0 and <= 1, got 1\.1"),
        ({"nearest": -0.1}, r"existence\.nearest: expected a finite number >= 0, got -0\.1"),
        ({"frame_limit": 0}, r"existence\.frame_limit: expected an int >= 1, got 0"),
    ],
)
def test_models_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the parameter, its range and what came."""
    with pytest.raises(ValueError, match="^" + message):
        ExistenceModel(**change)


def test_a_view_must_leave_something_to_see() -> None:
    """Margins as large as the image, and a range that ends where it begins, are refused."""
    with pytest.raises(ValueError, match=r"^existence\.margin_px: expected a number < 120, half of the image, got 120"):
        ExistenceModel(margin_px=120.0).view(StereoCamera())
    with pytest.raises(ValueError, match=r"^existence\.nearest: expected a number < 0\.18, the range, got 0\.3"):
        ExistenceModel().view(StereoCamera(max_range=0.2))
