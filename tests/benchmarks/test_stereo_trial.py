"""The trial of rendered eyes: its interval, its figures, and that it goes on where it stopped."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

PATH = Path(__file__).parents[2] / "benchmarks" / "stereo_trial.py"


@pytest.fixture(scope="module")
def trial() -> Any:
    """The script as a module; other processes would find it by its name."""
    spec = importlib.util.spec_from_file_location("stereo_trial", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["stereo_trial"] = module
    spec.loader.exec_module(module)
    return module


def row(seed: int, ratio: float, merges: list[dict[str, Any]]) -> dict[str, Any]:
    """A row of an episode with two robots whose path errors are 0.9 and 1.1 times `ratio` times a metre of odometry."""
    robots = [
        {
            "ate_aligned_m": share * ratio,
            "dead_reckoning_ate_aligned_m": 1.0,
            "map_error": 0.6,
            "map_rmse_m": 0.05,
            "map_recall": 0.4,
            "map_precision": 0.7,
        }
        for share in (0.9, 1.1)
    ]
    team = {"ate_aligned_m": ratio, "dead_reckoning_ate_aligned_m": 1.0}
    known = {"groups": [[0, 1]], "coverage": 0.9, "seconds": 1.0}
    return {"seed": seed, "robots": robots, "team": team, "merges": merges} | known


@pytest.mark.parametrize("count", range(6, 31))
def test_the_interval_covers_the_median_and_no_narrower_one_does(trial: Any, count: int) -> None:
    """Of sorted values 1..n, [k, n + 1 - k] holds the median unless fewer than k lie below or above it: binomial."""
    low, high = trial.interval(np.random.default_rng(count).permutation(np.arange(1.0, count + 1.0)).tolist())
    k = int(low)
    assert high == count + 1 - k
    assert 1.0 - 2.0 * binom.cdf(k - 1, count, 0.5) >= 0.95
    assert 1.0 - 2.0 * binom.cdf(k, count, 0.5) < 0.95


def test_merges_that_were_undone_are_not_in_force(trial: Any) -> None:
    """A false merge counts as made, and as in force if it was not undone; ratios are per episode and per path."""
    merge = {"error_m": 0.1, "error_deg": 1.0, "false": False, "undone_s": None}
    wrong = {"error_m": 9.0, "error_deg": 90.0, "false": True}
    undone, stays = wrong | {"undone_s": 20.0}, wrong | {"undone_s": None}
    rows = [row(0, 0.2, [merge]), row(1, 0.4, [merge, undone]), row(2, 0.3, [stays])]
    summary = trial.summarise(rows)
    assert summary["path_error_ratio_median"] == pytest.approx(0.3)
    assert (summary["path_error_ratio_low"], summary["path_error_ratio_high"]) == (0.2, 0.4)
    assert summary["path_error_ratio_of_robots_worst"] == pytest.approx(0.44)
    assert (summary["merges"], summary["merges_undone"]) == (4, 1)
    assert (summary["false_merges"], summary["false_merges_in_force"]) == (2, 1)


def test_a_trial_goes_on_where_it_was_stopped(
    trial: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seeds that a folder holds are not played again; those that it lacks are; other options are refused."""
    played: list[int] = []

    def play(given: Any) -> dict[str, Any]:
        played.append(given.seed)
        if len(played) == 2:
            raise KeyboardInterrupt
        episode = {"style": given.style, "cycles": given.cycles, "num_robots": given.num_robots}
        scores = row(given.seed, 0.1 * (1 + given.seed), [])
        return (
            scores
            | episode
            | {"team": scores["team"] | {"map_error": 0.6, "map_rmse_m": 0.05, "map_recall": 0.4, "map_precision": 0.7}}
        )

    monkeypatch.setattr(trial, "play", play)
    options = {"first_seed": 0, "style": "distinct", "cycles": 5, "robots": 2, "processes": 1, "out": tmp_path / "run"}
    with pytest.raises(KeyboardInterrupt):
        trial.main(seeds=3, **options)
    trial.main(seeds=3, **options)
    assert played == [0, 1, 1, 2]
    assert "path_error_ratio_median" in capsys.readouterr().out
    with pytest.raises(ValueError, match="out: expected a folder of this very stereo"):
        trial.main(seeds=4, **options)


@pytest.mark.slow
def test_an_episode_gives_all_that_the_summary_asks_for(trial: Any) -> None:
    """A short episode with rendered eyes is scored like a long one."""
    played = trial.play(trial.StereoTrial(seed=100, style="posters_alike", cycles=3, num_robots=2))
    assert trial.summarise([played])["episodes"] == 1
    assert trial.ratio(played) > 0.0
