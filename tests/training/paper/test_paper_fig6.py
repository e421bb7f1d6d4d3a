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
from training.experiments.study import Claim, Estimate
from training.experiments.trial_store import TRIALS_FILE
from training.paper.config import Fig6Config
from training.paper.fig6.claims import check_claims, claim, flat_within, over_robots, paired_ratio
from training.paper.fig6.report import STUDY
from training.paper.fig6.trials import (
    BOUND,
    FEW,
    FIGURES,
    FILTER_OPTIONS,
    REGIMES,
    Trial,
    full_steps,
    play,
    rms_of_all,
    time_in_turns,
    unfold,
)
from training.stereo_runs.runs import FALSE_POINT, StereoRun, simulate_run
from training.stereo_runs.scores import Answer

CONFIG = Fig6Config()
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
    """Return a row of map errors in the paper's regime."""
    row: dict[str, Any] = {"regime": "paper", "proposal": "fastslam1", "robots": (robots,), "particles": particles}
    (found,) = unfold([row | {"seed": seed} | dict.fromkeys(FIGURES, 1.0) | {"map_rmse_m": value}])
    return dict(found)


def _times(seed: int, particles: int, ratio: float) -> list[dict[str, Any]]:
    """Return the rows of a trial in which three robots take `ratio` times as long as one."""
    row: dict[str, Any] = {"regime": "paper", "proposal": "fastslam1", "robots": [1, 3], "particles": particles}
    return list(map(dict, unfold([row | {"seed": seed, "median_ms": [1.0, ratio]}])))


def test_defaults_match_the_paper() -> None:
    """Defaults are M and K of the paper's caption, 20 seeds, B = 15 for all robots, and unknown association."""
    config = Fig6Config()
    assert config.particles == (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000)
    assert config.robots == (1, 2, 3)
    errors = [trial for trial in config.trials() if not trial.is_timed]
    trials = [trial for trial in errors if trial.regime == "paper"]
    assert len(trials) == 11 * 3 * 20
    assert {trial.seed for trial in trials} == set(range(20))
    assert {trial.proposal for trial in trials} == {"fastslam1"}
    for trial in errors:
        (spec,) = trial.specs
        assert spec.measurements == trial.measurements == 15
        assert spec.association == "unknown"
        assert trial.regime == "paper" or trial.particles in ((0,) if trial.proposal == BOUND else FEW)
    assert {(t.robots, t.particles, t.seed) for t in config.trials() if t.is_timed} == {
        ((1, 2, 3), m, s) for m in config.particles for s in range(20)
    }
    bounds = [trial for trial in errors if trial.proposal == BOUND]
    assert [(t.regime, t.robots, t.seed) for t in bounds] == [("good", (k,), s) for s in range(20) for k in (1, 2, 3)]


def test_the_papers_filter_resamples_at_every_step(run: StereoRun) -> None:
    """The filter resamples after each step with a measurement, for any effective sample size (Algorithm 1, l. 10)."""
    slam = run.build_filter(7, "fastslam1", **FILTER_OPTIONS["fastslam1"])
    assert all(slam.step(**reading).resampled for reading in run.readings())


def test_trials_repeat() -> None:
    """The same trial gives the same results, and another seed gives other ones."""
    trial = Trial(regime="good", proposal="fastslam1", robots=(2,), particles=5, measurements=8, length=3.0, seed=42)
    other = replace(trial, seed=43)
    assert play(CONFIG, trial) == play(CONFIG, trial)
    assert play(CONFIG, trial)["map_rmse_m"] != play(CONFIG, other)["map_rmse_m"]


def test_the_bound_is_below_filter_errors() -> None:
    """Batch maximum likelihood, which has no particles, is more accurate than a filter with few particles."""
    trial = Trial(regime="good", proposal=BOUND, robots=(2,), particles=0, measurements=15, length=25.0, seed=42)
    bound, own = play(CONFIG, trial), play(CONFIG, replace(trial, proposal="fastslam1", particles=3))
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
    row = play(CONFIG, Trial(robots=(2, 1), particles=3, measurements=15, length=20.0, seed=44, is_timed=True))
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
    assert found == pytest.approx((0.7, 0.7, 0.7))
    assert paired_ratio({1: 2.0, 9: 5.0}, values) == Estimate(2.0 / 1.1)
    assert paired_ratio({9: 5.0}, values) == Estimate(None)


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
        assert found.low is not None
        assert found.high is not None
        held += found.low < 0.8 < found.high
        widths.append(np.log(found.high / found.low))
    assert 0.91 * 400 < held < 0.98 * 400
    assert np.mean(widths) == pytest.approx(2.0 * 2.09 * 0.3 / np.sqrt(20), rel=0.1)


def test_claims_follow_the_data() -> None:
    """Each claim holds on data made for it, fails on data against it, and is open with a single seed."""
    rng = np.random.default_rng(6)
    spread = {seed: float(np.exp(rng.normal(scale=0.05))) for seed in range(8)}
    value = {(1, 1): 1.0, (3, 1): 0.9, (1, 100): 0.5, (3, 100): 0.35, (1, 2000): 0.4, (3, 2000): 0.3}
    errors = [_error(s, k, m, v * spread[s] ** (k * m % 7 - 3)) for s in spread for (k, m), v in value.items()]
    ratios = ((10, 2.9), (100, 1.8), (1000, 1.2))
    times = [row for s in spread for m, ratio in ratios for row in _times(s, m, ratio * spread[s])]
    claims = {claim.text: claim for claim in check_claims(errors + times)}
    assert list(claims) == [
        "map error, K=1: M=2000 below M=1",
        "map error, K=3: M=2000 below M=1",
        "map error, M=100: K=3 below K=1",
        "map error, M=2000: K=3 below K=1",
        "time, M=100: K=3 over K=1",
        "time, M=1000: K=3 over K=1",
    ]
    assert all(claim.holds for claim in claims.values())
    assert claims["map error, K=1: M=2000 below M=1"].measured.value == pytest.approx(0.4, rel=0.2)
    assert [claim.limits for claim in claims.values()][2:5] == [
        "below 1, at most 0.85", "below 1", "above 0.5, below 2",
    ]  # fmt: skip
    worse = [row | {"map_rmse_m": row["map_rmse_m"] * (1.6 if row["robots"] == 3 else 1.0)} for row in errors]
    slower = [row for s in spread for m in (100, 1000) for row in _times(s, m, 2.5 * spread[s])]
    assert [claim.holds for claim in check_claims(worse + slower)] == [True, True, False, False, False, False]
    flat = [row | {"map_rmse_m": 0.5} for row in errors]
    assert not any(claim.holds for claim in check_claims(flat) if "2000 below" in claim.text)
    single = check_claims([row for row in errors + times if row["seed"] == 0])
    assert len(single) == 6
    assert not any(claim.holds for claim in single)
    assert check_claims([]) == []


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
    claims = check_claims(errors)
    assert [claim.text for claim in claims] == [
        "good stereo, M=100, K=1: rejuvenated below fastslam2",
        "good stereo, M=100, K=3: rejuvenated below fastslam2",
        "good stereo, M=100, K=1: rejuvenated near batch ML",
        "good stereo, M=100, K=3: rejuvenated near batch ML",
        "good stereo, M=100, rejuvenated: K=3 below K=1",
        "good stereo, M=100, rejuvenated: K=3 over K=1, over that of batch ML",
    ]
    assert [claim.measured.value for claim in claims] == pytest.approx([0.5, 0.3, 1.2, 1.2, 0.6, 1.0])

    def held(three: float) -> list[bool]:
        return [claim.holds for claim in check_claims(rejuvenated_errors(three))]

    assert held(0.018) == [True, True, True, True, True, True]
    assert held(0.020) == [True, True, True, False, True, True]
    assert held(0.021) == [True, True, True, False, True, False]
    assert held(0.07) == [True, False, True, False, False, False]
    assert check_claims([row for row in errors if row["proposal"] in ("fastslam2", BOUND)]) == []
    unbound = check_claims([row for row in errors if row["proposal"] != BOUND])
    assert [claim.holds for claim in unbound] == [True, True, False, False, True, False]


def test_limits_apply_to_the_ratio_itself() -> None:
    """At M = 100 the interval must be below 1 and the ratio at most its limit; nor may times be too short."""

    def held(ratio: float, low: float, high: float, **limits: float) -> bool:
        return claim("", Estimate(ratio, low, high), **limits).holds

    assert held(0.80, 0.66, 0.97, below=1.0, at_most=0.85)
    assert not held(0.87, 0.80, 0.95, below=1.0, at_most=0.85)
    assert not held(0.80, 0.60, 1.05, below=1.0, at_most=0.85)
    assert not held(0.4, 0.39, 0.41, above=0.5, below=2.0)
    assert claim("", Estimate(0.8), at_most=0.85) == Claim("", Estimate(0.8), "at most 0.85", False)
    assert [flat_within(m) for m in (100, 500, 1000, 2000)] == [2.0, 2.0, 1.5, 1.5]


def test_ratios_of_robots_are_shown_for_every_filter() -> None:
    """There is a ratio of most over fewest robots, raw and after the fit, for each filter and M."""
    errors = [_error(s, k, m, 1.0 / k) for s in range(3) for k in (1, 2, 3) for m in (10, 100)]
    errors += [row | {"filter": "another"} for row in errors]
    table = STUDY.tables[1]
    lines = table.lines(errors)
    third = "0.33 (0.33 .. 0.33)"
    assert [table.cells(line)[1:3] for line in lines] == [["10", third], ["100", third]] * 2
    assert {line["after fit"].value for line in lines} == {1.0}
    assert over_robots("map_rmse_m", [row for row in errors if row["robots"] == 2]) == Estimate(None)


def test_a_line_for_each_point() -> None:
    """Errors and times of one point share a line, with intervals; unknown values are None."""
    errors = [_error(s, k, 10, 0.1 * (s + 1)) for s in range(4) for k in (1, 3)]
    errors += [row | {"filter": "another"} for row in errors]
    lines = STUDY.tables[0].lines(errors + [row for s in range(2) for row in _times(s, 10, 2.0)])
    own = "as in the paper, fastslam1"
    found = [(line["filter"], line["robots"]) for line in lines]
    assert found == [(name, k) for name in (own, "another") for k in (1, 3)]
    first, other = lines[1], lines[3]
    assert first["map error [m]"].value == pytest.approx(0.25)
    assert 0.1 < first["map error [m]"].low < 0.25 < first["map error [m]"].high < 0.4
    assert first["step [ms]"].value == 2.0
    assert other["step [ms]"].value is None


def test_the_command_writes_figure_table_and_trials(finished: Path) -> None:
    """The command writes PNG, CSV with a line for each filter, K and M, the trials, and all as JSON."""
    assert (finished / "fig6.png").is_file()
    table = list(csv.DictReader((finished / "fig6.csv").read_text().splitlines()))
    points = {(row["filter"], int(row["robots"]), int(row["particles"])) for row in table}
    paper = {("as in the paper, fastslam1", k, m) for k in (1, 2) for m in (3, 10)}
    good = {(f"good stereo, {p}", k, 0 if p == BOUND else 10) for p in REGIMES["good"].proposals for k in (1, 2)}
    assert points == paper | good
    for row in table:
        low, value, high = (float(row[f"map error [m]{end}"]) for end in (" low", "", " high"))
        assert 0.0 < low <= value <= high
        assert (row["step [ms]"] != "") == row["filter"].startswith("as in the paper")
    content = json.loads((finished / "copy.json").read_text())
    assert content["config"]["robots"] == [1, 2]
    assert [claim["text"] for claim in content["claims"]] == [f"map error, K={k}: M=10 below M=3" for k in (1, 2)]
    kept = [json.loads(line) for line in (finished / TRIALS_FILE).read_text().splitlines()]
    assert sum(row["is_timed"] for row in kept) == 2 * 2
    assert len(kept) == 2 * len(points) + 2 * 2


def test_a_stopped_run_is_resumed(finished: Path, tmp_path: Path) -> None:
    """With half of its trials removed and one truncated, the same command computes them again, with equal errors."""
    out = tmp_path / "run"
    out.mkdir()
    (out / "config.toml").write_text((finished / "config.toml").read_text())
    lines = (finished / TRIALS_FILE).read_text().splitlines(keepends=True)
    kept = lines[-4:] + lines[:8]  # times, which do not repeat, and some errors
    (out / TRIALS_FILE).write_text("".join(kept)[:-30])
    assert _call([*ARGUMENTS, "--out", str(out)]) == 0
    assert (out / TRIALS_FILE).read_text().splitlines(keepends=True)[:12] == kept
    assert (out / "fig6.csv").read_text() == (finished / "fig6.csv").read_text()
    assert _call([*ARGUMENTS, "--length", "5", "--out", str(out)]) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "status"), [(0.5, 0), (1.5, 1)])
def test_check_sets_the_exit_status(tmp_path: Path, factor: float, status: int) -> None:
    """The status is 0 if all claims hold, 1 otherwise: errors of three robots are 0.5 or 1.5 times those of one."""
    out = tmp_path / "run"
    arguments = ["paper", "fig6", "--seeds", "3", "--particles", "1,100", "--robots", "1,3", "--regimes", "paper"]
    assert _call([*arguments, "--length", "0.25", "--out", str(out)]) == 0
    rows = [json.loads(line) for line in (out / TRIALS_FILE).read_text().splitlines()]
    for row in rows:
        if row["is_timed"]:
            row["median_ms"] = [1.0, 1.4]
        else:
            row["map_rmse_m"] = (factor if row["robots"] == [3] else 1.0) * (1.0 if row["particles"] == 1 else 0.3)
    (out / TRIALS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    again = [*arguments, "--length", "0.25", "--out", str(out)]
    assert _call([*again, "--check"]) == status
    assert _call(again) == 0
