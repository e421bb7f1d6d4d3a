"""Fig. 6: trials, summary, claims, and stored trials."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training import cli
from training.experiments.run_folder import plain
from training.paper.config import Fig6Config
from training.paper.fig6.claims import (
    POINT,
    TIMES,
    Claim,
    check_claims,
    flat_within,
    paired_ratio,
    robots_ratios,
    summarise,
    to_csv,
)
from training.paper.fig6.report import draw_fig6
from training.paper.fig6.trials import (
    BOUND,
    ERRORS_FILE,
    FEW,
    FIGURES,
    FILTER_OPTIONS,
    REGIMES,
    TIMES_FILE,
    ErrorTrial,
    TimeTrial,
    cost,
    full_steps,
    play_error,
    play_time,
    rms_of_all,
    time_in_turns,
)
from training.stereo_runs.runs import FALSE_POINT, StereoRun, simulate_run
from training.stereo_runs.scores import Answer

ARGUMENTS = ["paper", "fig6", "--seeds", "2", "--first-seed", "50", "--robots", "1,2", "--particles", "3,10"]
ARGUMENTS += ["--length", "4", "--regimes", "paper,good"]


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 4 m."""
    return simulate_run(REGIMES["paper"].spec(2, 4.0), seed=41)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small run of the command."""
    out = tmp_path_factory.mktemp("fig6") / "run"
    assert _call([*ARGUMENTS, "--out", str(out), "--json", str(out / "copy.json")]) == 0
    return out


def _call(arguments: list[str]) -> int:
    """Run the command line; return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["vslam", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
    return int(end.value.code or 0)


def _error(seed: int, robots: int, particles: int, value: float) -> dict[str, Any]:
    """Return a row of `play_error` in the paper's regime."""
    trial: dict[str, Any] = {"regime": "paper", "proposal": "fastslam1", "robots": robots, "particles": particles}
    trial |= {"measurements": 15, "length": 100.0}
    return trial | {"seed": seed} | dict.fromkeys(FIGURES, 1.0) | {"map_rmse_m": value}


def _time(seed: int, particles: int, ratio: float) -> dict[str, Any]:
    """Return a row of `play_time` in which three robots take `ratio` times as long as one."""
    values: dict[str, Any] = {name: [1.0, ratio] for name in TIMES}
    return {"robots": [1, 3], "particles": particles, "measurements": 15, "length": 100.0, "seed": seed} | values


def test_defaults_match_the_paper() -> None:
    """Defaults are M and K of the paper's caption, 20 seeds, B = 15 for all robots, and unknown association."""
    config = Fig6Config()
    assert config.particles == (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000)
    assert config.robots == (1, 2, 3)
    trials = [trial for trial in config.error_trials() if trial.regime == "paper"]
    assert len(trials) == 11 * 3 * 20
    assert {trial.seed for trial in trials} == set(range(20))
    assert {trial.proposal for trial in trials} == {"fastslam1"}
    for trial in config.error_trials():
        assert trial.spec.measurements == trial.measurements == 15
        assert trial.spec.association == "unknown"
        assert trial.regime == "paper" or trial.particles in ((0,) if trial.proposal == BOUND else FEW)
    assert {(t.robots, t.particles, t.seed) for t in config.time_trials()} == {
        ((1, 2, 3), m, s) for m in config.particles for s in range(20)
    }
    assert cost(config.time_trials()[0]) > cost(trials[0])
    bounds = [trial for trial in config.error_trials() if trial.proposal == BOUND]
    assert [(t.regime, t.robots, t.seed) for t in bounds] == [("good", k, s) for s in range(20) for k in (1, 2, 3)]


def test_the_papers_filter_resamples_at_every_step(run: StereoRun) -> None:
    """The filter resamples after each step with a measurement, for any effective sample size (Algorithm 1, l. 10)."""
    slam = run.build_filter(7, "fastslam1", **FILTER_OPTIONS["fastslam1"])
    assert all(slam.step(**reading).resampled for reading in run.readings())


def test_trials_repeat() -> None:
    """The same trial gives the same results, and another seed gives other ones."""
    trial = ErrorTrial(regime="good", proposal="fastslam1", robots=2, particles=5, measurements=8, length=3.0, seed=42)
    other = replace(trial, seed=43)
    assert play_error(trial) == play_error(trial)
    assert play_error(trial)["map_rmse_m"] != play_error(other)["map_rmse_m"]


def test_the_bound_is_below_filter_errors() -> None:
    """Batch maximum likelihood, which has no particles, is more accurate than a filter with few particles."""
    trial = ErrorTrial(regime="good", proposal=BOUND, robots=2, particles=0, measurements=15, length=25.0, seed=42)
    bound, own = play_error(trial), play_error(replace(trial, proposal="fastslam1", particles=3))
    assert 0.0 < bound["map_rmse_m"] < 0.5 * own["map_rmse_m"]
    assert bound["map_recall"] == bound["map_precision"] == 1.0
    assert np.isnan(bound["ess_share"])
    with pytest.raises(ValueError, match=r"particles: expected an int >= 1, got 0\."):
        replace(trial, proposal="fastslam2")
    with pytest.raises(ValueError, match="proposal: expected one of 'fastslam1', got 'batch_ml'"):
        replace(trial, regime="paper")


def test_the_error_of_all_landmarks_counts_duplicates(run: StereoRun) -> None:
    """Each landmark of the map counts with the distance from its true landmark; false points do not count."""
    means = np.vstack([run.landmarks[:2], run.landmarks[1] + [0.0, 0.0, 3.0], [[50.0, 0.0, 0.0]]])
    claims = np.array([0, 1, 1, FALSE_POINT])
    answer = Answer(run.true_paths, None, means, claims, np.ones(4, dtype=bool))
    assert rms_of_all(run, answer) == pytest.approx(np.sqrt(9.0 / 3.0))
    assert np.isnan(rms_of_all(run, Answer(run.true_paths, None, means[3:], claims[3:], np.ones(1, dtype=bool))))


def test_alternating_timing_does_not_change_filters(run: StereoRun) -> None:
    """Filters timed in alternation end in the same states as alone, and each step of each filter is timed."""
    other = simulate_run(REGIMES["paper"].spec(1, 6.0), seed=41)
    runs = [run, other]
    filters = [each.build_filter(5, "fastslam1", seed=3) for each in runs]
    times = time_in_turns(filters, runs)
    for slam, each, taken in zip(filters, runs, times, strict=True):
        alone = each.build_filter(5, "fastslam1", seed=3)
        for reading in each.readings():
            alone.step(**reading)
        np.testing.assert_array_equal(slam.particles()[0], alone.particles()[0])
        assert taken.shape == (each.num_steps,)
        assert (taken > 0.0).all()


def test_times_use_full_steps() -> None:
    """A row has one time for each K; full steps are those with B measurements, of which two robots have more."""
    row = play_time(TimeTrial(robots=(2, 1), particles=3, measurements=15, length=20.0, seed=44))
    runs = [simulate_run(REGIMES["paper"].spec(k, 20.0), seed=44) for k in (2, 1)]
    for i, each in enumerate(runs):
        counts = np.array([sum(len(frame) for frame in frames) for frames in each.frames])
        np.testing.assert_array_equal(full_steps(each), counts == 15)
        assert row["measured"][i] == pytest.approx(counts.mean())
    assert row["measured"][0] > row["measured"][1]
    assert all(row["median_ms"][i] > 0.0 for i in range(2))


def test_paired_ratios_are_geometric_means() -> None:
    """A constant factor is found exactly; only common seeds count; one seed has no interval."""
    values = {seed: 0.1 + seed for seed in range(6)}
    found = paired_ratio({seed: 0.7 * value for seed, value in values.items()}, values)
    assert found["ratio"] == pytest.approx(0.7)
    assert found["low"] == pytest.approx(0.7)
    assert found["high"] == pytest.approx(0.7)
    assert found["seeds"] == 6
    assert paired_ratio({1: 2.0, 9: 5.0}, values) == {"ratio": 2.0 / 1.1, "low": None, "high": None, "seeds": 1}
    assert paired_ratio({9: 5.0}, values)["ratio"] is None


def test_paired_intervals_cover_what_they_should() -> None:
    """Of 400 intervals of 20 log-normal pairs 95 % contain the true ratio: 91 to 98 % with a false alarm below 1e-3.

    A common factor of a pair, however large, does not widen the interval.
    """
    rng = np.random.default_rng(5)
    held, widths = 0, []
    for _ in range(400):
        shared = rng.normal(scale=3.0, size=20)
        above, below = np.exp(shared + rng.normal(scale=0.3, size=20)), np.exp(shared)
        found = paired_ratio(dict(enumerate(0.8 * above)), dict(enumerate(below)))
        held += found["low"] < 0.8 < found["high"]
        widths.append(np.log(found["high"] / found["low"]))
    assert 0.91 * 400 < held < 0.98 * 400
    assert np.mean(widths) == pytest.approx(2.0 * 2.09 * 0.3 / np.sqrt(20), rel=0.1)


def test_claims_follow_the_data() -> None:
    """Each claim holds on data made for it, fails on data against it, and is open with a single seed."""
    rng = np.random.default_rng(6)
    spread = {seed: float(np.exp(rng.normal(scale=0.05))) for seed in range(8)}
    value = {(1, 1): 1.0, (3, 1): 0.9, (1, 100): 0.5, (3, 100): 0.35, (1, 2000): 0.4, (3, 2000): 0.3}
    errors = [_error(s, k, m, v * spread[s] ** (k * m % 7 - 3)) for s in spread for (k, m), v in value.items()]
    times = [_time(s, m, ratio * spread[s]) for s in spread for m, ratio in ((10, 2.9), (100, 1.8), (1000, 1.2))]
    claims = {claim.claim: claim for claim in check_claims(errors, times)}
    assert list(claims) == [
        "map error, K=1: M=2000 below M=1",
        "map error, K=3: M=2000 below M=1",
        "map error, M=100: K=3 below K=1, at most 0.85 of it",
        "map error, M=2000: K=3 below K=1",
        "time, M=100: K=3 and K=1 equal within a factor of 2",
        "time, M=1000: K=3 and K=1 equal within a factor of 1.5",
    ]
    assert all(claim.holds for claim in claims.values())
    assert claims["map error, K=1: M=2000 below M=1"].ratio == pytest.approx(0.4, rel=0.2)
    worse = [row | {"map_rmse_m": row["map_rmse_m"] * (1.6 if row["robots"] == 3 else 1.0)} for row in errors]
    slower = [_time(s, m, 2.5 * spread[s]) for s in spread for m in (100, 1000)]
    assert [claim.holds for claim in check_claims(worse, slower)] == [True, True, False, False, False, False]
    flat = [row | {"map_rmse_m": 0.5} for row in errors]
    assert not any(claim.holds for claim in check_claims(flat, []) if "2000 below" in claim.claim)
    single = check_claims([row for row in errors if row["seed"] == 0], times[:3])
    assert len(single) == 6
    assert not any(claim.holds for claim in single)
    assert check_claims([], []) == []


def rejuvenated_errors(three: float) -> list[dict[str, Any]]:
    """Return map errors of 6 cm with `fastslam2`; with rejuvenation 3 cm for one robot and `three` [m] for three.

    Batch maximum likelihood has 2.5 and 1.5 cm.
    """
    value = {(1, "fastslam2"): 0.06, (3, "fastslam2"): 0.06, (1, BOUND): 0.025, (3, BOUND): 0.015}
    value |= {(1, "fastslam2+rejuvenation"): 0.03, (3, "fastslam2+rejuvenation"): three}
    return [
        _error(seed, k, 0 if name == BOUND else 100, v * (1.0 + 0.02 * seed)) | {"regime": "good", "proposal": name}
        for seed in range(10) for (k, name), v in value.items()
    ]  # fmt: skip


def test_rejuvenation_claims_follow_the_data() -> None:
    """Rejuvenated errors are below those of `fastslam2`, near the bound, and gain from robots as the bound does.

    Without rejuvenation there is no claim; without the bound claims about both are open.
    """
    errors = rejuvenated_errors(three=0.018)
    claims = check_claims(errors, [])
    assert [claim.claim for claim in claims] == [
        "good stereo, M=100, K=1: rejuvenated below fastslam2",
        "good stereo, M=100, K=3: rejuvenated below fastslam2",
        "good stereo, M=100, K=1: rejuvenated at most 1.3 times batch ML",
        "good stereo, M=100, K=3: rejuvenated at most 1.3 times batch ML",
        "good stereo, M=100, rejuvenated: K=3 below K=1",
        "good stereo, M=100, rejuvenated: K=3 over K=1 at most 1.15 times that of batch ML",
    ]
    assert [claim.ratio for claim in claims] == pytest.approx([0.5, 0.3, 1.2, 1.2, 0.6, 1.0])

    def held(three: float) -> list[bool]:
        return [claim.holds for claim in check_claims(rejuvenated_errors(three), [])]

    assert held(0.018) == [True, True, True, True, True, True]
    assert held(0.020) == [True, True, True, False, True, True]
    assert held(0.021) == [True, True, True, False, True, False]
    assert held(0.07) == [True, False, True, False, False, False]
    assert check_claims([row for row in errors if row["proposal"] in ("fastslam2", BOUND)], []) == []
    unbound = check_claims([row for row in errors if row["proposal"] != BOUND], [])
    assert [claim.holds for claim in unbound] == [True, True, False, False, True, False]


def test_limits_apply_to_the_ratio_itself() -> None:
    """At M = 100 the interval must be below 1 and the ratio at most its limit; nor may times be too short."""
    base: dict[str, Any] = {"claim": "", "seeds": 20, "below": 1.0, "ratio_at_most": 0.85}
    assert Claim(**base, ratio=0.80, low=0.66, high=0.97).holds
    assert not Claim(**base, ratio=0.87, low=0.80, high=0.95).holds
    assert not Claim(**base, ratio=0.80, low=0.60, high=1.05).holds
    assert not Claim(claim="", seeds=20, ratio=0.4, low=0.39, high=0.41, above=0.5, below=2.0).holds
    assert [flat_within(m) for m in (100, 500, 1000, 2000)] == [2.0, 2.0, 1.5, 1.5]


def test_ratios_of_robots_are_shown_for_every_regime() -> None:
    """There is a ratio of most over fewest robots, raw and aligned, for each regime, proposal and M."""
    errors = [_error(s, k, m, 1.0 / k) for s in range(3) for k in (1, 2, 3) for m in (10, 100)]
    errors += [row | {"regime": "good", "proposal": "fastslam2"} for row in errors]
    found = robots_ratios(errors)
    assert [(row["regime"], row["proposal"], row["particles"]) for row in found] == [
        ("paper", "fastslam1", 10), ("paper", "fastslam1", 100), ("good", "fastslam2", 10), ("good", "fastslam2", 100),
    ]  # fmt: skip
    for row in found:
        assert row["robots"] == [1, 3]
        assert row["raw"]["ratio"] == pytest.approx(1.0 / 3.0)
        assert row["aligned"]["ratio"] == pytest.approx(1.0)
    assert robots_ratios([row for row in errors if row["robots"] == 2]) == []


def test_a_line_for_each_point(tmp_path: Path) -> None:
    """Errors and times of one point share a line, with intervals; unknown values are None, empty in CSV."""
    errors = [_error(s, k, 10, 0.1 * (s + 1)) for s in range(4) for k in (1, 3)]
    errors += [row | {"regime": "good"} for row in errors]
    lines = summarise(errors, [_time(s, 10, 2.0) for s in range(2)])
    assert [tuple(line[name] for name in POINT) for line in lines] == [
        (regime, "fastslam1", k, 10) for regime in ("paper", "good") for k in (1, 3)
    ]
    first, good = lines[1], lines[3]
    assert (first["seeds"], first["timed_seeds"]) == (4, 2)
    assert first["map_rmse_m"] == pytest.approx(0.25)
    assert 0.1 < first["map_rmse_m_low"] < 0.25 < first["map_rmse_m_high"] < 0.4
    assert first["median_ms"] == 2.0
    assert good["median_ms"] is None
    table = list(csv.DictReader(to_csv(lines).splitlines()))
    expected = [*POINT, "seeds", "timed_seeds"]
    expected += [name + end for name in (*FIGURES, *TIMES) for end in ("", "_low", "_high")]
    assert list(table[0]) == expected
    assert float(table[1]["map_rmse_m"]) == pytest.approx(0.25)
    assert table[3]["median_ms"] == ""
    draw_fig6(tmp_path / "fig6.png", plain(lines))
    assert (tmp_path / "fig6.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_writes_figure_table_and_trials(finished: Path) -> None:
    """The command writes PNG, CSV with a line for each regime, proposal, K and M, the trials, and all as JSON."""
    assert (finished / "fig6.png").is_file()
    table = list(csv.DictReader((finished / "fig6.csv").read_text().splitlines()))
    points = {(row["regime"], row["proposal"], int(row["robots"]), int(row["particles"])) for row in table}
    paper = {("paper", "fastslam1", k, m) for k in (1, 2) for m in (3, 10)}
    good = {("good", name, k, 0 if name == BOUND else 10) for name in REGIMES["good"].proposals for k in (1, 2)}
    assert points == paper | good
    assert len(points) == 4 + 4 * 2
    for row in table:
        assert row["seeds"] == "2"
        assert 0.0 < float(row["map_rmse_m_low"]) <= float(row["map_rmse_m"]) <= float(row["map_rmse_m_high"])
        assert (row["all_median_ms"] != "") == (row["regime"] == "paper")
    content = json.loads((finished / "copy.json").read_text())
    assert content["config"]["robots"] == [1, 2]
    assert [claim["claim"] for claim in content["claims"]] == [f"map error, K={k}: M=10 below M=3" for k in (1, 2)]
    assert len((finished / ERRORS_FILE).read_text().splitlines()) == 2 * len(points)
    assert len((finished / TIMES_FILE).read_text().splitlines()) == 2 * 2


def test_a_stopped_run_is_resumed(finished: Path, tmp_path: Path) -> None:
    """With half of its trials removed and one truncated, the same command computes them again, with equal errors."""
    out = tmp_path / "run"
    out.mkdir()
    for name in ("config.toml", TIMES_FILE):
        (out / name).write_text((finished / name).read_text())
    kept = (finished / ERRORS_FILE).read_text().splitlines(keepends=True)[:8]
    (out / ERRORS_FILE).write_text("".join(kept)[:-30])
    assert _call([*ARGUMENTS, "--out", str(out)]) == 0
    assert (out / ERRORS_FILE).read_text().splitlines(keepends=True)[:8] == kept
    assert (out / "fig6.csv").read_text() == (finished / "fig6.csv").read_text()
    assert _call([*ARGUMENTS, "--length", "5", "--out", str(out)]) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "status"), [(0.5, 0), (1.5, 1)])
def test_check_sets_the_exit_status(tmp_path: Path, factor: float, status: int) -> None:
    """The status is 0 if all claims hold, 1 otherwise: errors of three robots are 0.5 or 1.5 times those of one."""
    out = tmp_path / "run"
    arguments = ["paper", "fig6", "--seeds", "3", "--particles", "1,100", "--robots", "1,3", "--regimes", "paper"]
    assert _call([*arguments, "--length", "0.25", "--out", str(out)]) == 0
    for name in (ERRORS_FILE, TIMES_FILE):
        rows = [json.loads(line) for line in (out / name).read_text().splitlines()]
        for row in rows:
            if name == ERRORS_FILE:
                row["map_rmse_m"] = (factor if row["robots"] == 3 else 1.0) * (1.0 if row["particles"] == 1 else 0.3)
            else:
                row["median_ms"] = [1.0, 1.4]
        (out / name).write_text("".join(json.dumps(row) + "\n" for row in rows))
    again = [*arguments, "--length", "0.25", "--out", str(out)]
    assert _call([*again, "--check"]) == status
    assert _call(again) == 0
