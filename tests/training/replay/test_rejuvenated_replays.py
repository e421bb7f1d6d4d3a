"""`--rejuvenate-every` is passed to the filters of each command, and config.toml repeats it."""

import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from small_logs import write_drive, write_log, write_park

from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.fastslam.reports import RejuvenationReport
from slam_backend.smoother.rejuvenation import Rejuvenation
from training.commands.replay import rejuvenation_lines
from training.episodes.config import RunConfig
from training.replay.config import REJUVENATE_EVERY, ImagesConfig, KittiConfig, MrclamConfig, VictoriaConfig
from training.replay.core import RejuvenationCount
from vslam_env.config import EnvConfig
from vslam_env.presets import preset_config

WRITERS: Mapping[str, Callable[[Path], None]] = {
    "mrclam": lambda folder: write_log(folder, noise=1.0),
    "victoria": lambda folder: write_park(folder, skew=0.01),
    "kitti": lambda folder: write_drive(folder, bias=0.05),
}

PARTICLES = 20


def estimates(folder: Path) -> list[bytes]:
    """Return the estimated paths in a run folder, as text."""
    return [file.read_bytes() for file in sorted(folder.glob("*estimate.tum"))]


@pytest.fixture
def reasons(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the list of refusals of attempts, "" for success; attempts of the warm-up are left out."""
    said: list[str] = []
    usual = RejuvenationScheduler.run

    def run(scheduler: RejuvenationScheduler, logs: Any, starts: Any, *rest: Any) -> Rejuvenation | None:
        result = usual(scheduler, logs, starts, *rest)
        if result is not None and starts.shape[2] == PARTICLES:
            said.append(result.reason)
        return result

    monkeypatch.setattr(RejuvenationScheduler, "run", run)
    return said


@pytest.mark.slow
@pytest.mark.parametrize("command", WRITERS)
def test_a_replay_is_rejuvenated_and_repeats_itself(
    command: str, vslam: Any, tmp_path: Path, reasons: list[str]
) -> None:
    """Most attempts succeed, the estimates change, and config.toml has the option and repeats the paths."""
    log, plain, one, two = (tmp_path / name for name in ("log", "plain", "one", "two"))
    log.mkdir()
    WRITERS[command](log)
    options = ("replay", command, "--path", str(log), "--duration", "8", "--seed", "104")
    options += ("--particles", str(PARTICLES))
    assert vslam(*options, "--rejuvenate-every", "0", "--out", str(plain)).status == 0
    assert not reasons
    assert vslam(*options, "--rejuvenate-every", "8", "--out", str(one)).status == 0
    assert reasons.count("") > 0.5 * len(reasons) > 0.0
    assert vslam("replay", command, "--config", str(one), "--out", str(two)).status == 0
    counts = json.loads((one / "metrics.json").read_text())["rejuvenations"]
    assert counts["drawn"] == reasons.count("") // 2  # two runs
    assert sum(counts["refused"].values()) == (len(reasons) - reasons.count("")) // 2
    off = tmp_path / "off"
    never = ("--config", str(one), "--rejuvenate-every", "0", "--out", str(off))
    assert vslam("replay", command, *never).status == 0
    assert json.loads((off / "metrics.json").read_text())["rejuvenations"] == {"drawn": 0, "refused": {}}
    assert estimates(off) == estimates(plain)
    assert "rejuvenate_every = 8" in (one / "config.toml").read_text()
    assert "rejuvenate_every = 0" in (plain / "config.toml").read_text()
    assert estimates(one) == estimates(two)
    assert all(with_it != without for with_it, without in zip(estimates(one), estimates(plain), strict=True))
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (one, two))
    assert first == second


def test_replays_have_one_default_interval() -> None:
    """Replays of all kinds of logs are rejuvenated after the same number of steps."""
    for config in (MrclamConfig, VictoriaConfig, KittiConfig, ImagesConfig):
        assert config(path="log").rejuvenate_every == REJUVENATE_EVERY > 0


@pytest.mark.parametrize("command", WRITERS)
def test_replays_report_consistency(command: str, vslam: Any, tmp_path: Path) -> None:
    """The table and metrics.json have a row for each robot, with a warning where needed."""
    log, run = tmp_path / "log", tmp_path / "run"
    log.mkdir()
    WRITERS[command](log)
    done = vslam("replay", command, "--path", str(log), "--duration", "8", "--particles", "9", "--out", str(run))
    rows = json.loads((run / "metrics.json").read_text())["consistency"]
    assert len(rows) == len(json.loads((run / "metrics.json").read_text())["robots"])
    assert all(row["frames"] > 0 and 0.0 <= row["nis_share"] <= 1.0 for row in rows)
    assert all(row["verdict"] in done.out for row in rows)
    assert "Consistency" in done.out
    for row in rows:
        for warning in row["warnings"]:
            assert " ".join(warning["text"].split()) in " ".join(done.out.split())


@pytest.mark.parametrize("sensor", ["landmark", "stereo"])
def test_options_of_a_run_reach_its_filters(sensor: str) -> None:
    """The environment's filters have the particles and the interval of the run; other options are the preset's."""
    config = RunConfig(world="fig5", particles=17, rejuvenate_every=9, preset="hard", sensor=sensor)
    chosen = config.make_env().config
    assert (chosen.belief.filter.num_particles, chosen.belief.filter.rejuvenate_every) == (17, 9)
    expected = preset_config("hard", sensor).replace(world="fig5", max_seconds=180.0)
    usual = {"filter": {"num_particles": 100, "rejuvenate_every": expected.belief.filter.rejuvenate_every}}
    assert chosen.replace(belief=usual, observation_keys="all") == expected


def test_runs_have_the_environments_default_interval() -> None:
    """By default the environment's interval is used; 0 disables rejuvenation."""
    assert RunConfig().make_env().config.belief == preset_config("standard").belief
    assert preset_config("standard").belief.filter.rejuvenate_every is not None
    assert RunConfig(rejuvenate_every=0).make_env().config.belief.filter.rejuvenate_every is None


@pytest.mark.slow
def test_a_run_is_rejuvenated_and_repeats_itself(vslam: Any, tmp_path: Path) -> None:
    """Of three runs of the command, the one without differs from the one with, which its config repeats."""
    plain, one, two = (tmp_path / name for name in ("plain", "one", "two"))
    options = ("--robots", "2", "--particles", "11", "--max-cycles", "40", "--world", "fig5", "--seed", "104")
    with_it, without = (*options, "--rejuvenate-every", "10"), (*options, "--rejuvenate-every", "0")
    for folder, extra in ((plain, without), (one, with_it), (two, ("--config", str(one)))):
        assert vslam("run", *extra, "--no-video", "--out", str(folder)).status == 0
    assert tomllib.loads((one / "config.toml").read_text())["config"]["rejuvenate_every"] == 10
    assert EnvConfig.from_toml(one / "environment.toml").belief.filter.rejuvenate_every == 10
    assert estimates(one) == estimates(two)
    assert estimates(one) != estimates(plain)


def _count_of(*reasons: str) -> dict[str, Any]:
    """Return the count of attempts with these reasons."""
    count = RejuvenationCount()
    for reason in reasons:
        count.add(RejuvenationReport(reason, 1.0, 1, 1))
    return count.to_mapping()


def test_refusals_are_counted_by_reason() -> None:
    """Numbers within a reason are ignored."""
    sizes = [f"an effective sample size of {size}" for size in ("1.5", "29.9")]
    refused = {"an effective sample size of n": 2, "no convergence in n iterations": 1}
    assert _count_of("", *sizes, "", "no convergence in 15 iterations") == {"drawn": 2, "refused": refused}


def test_rejuvenations_are_summarised_in_a_line() -> None:
    """Successes only, successes and refusals, and no text without attempts."""
    assert not rejuvenation_lines(_count_of())
    assert rejuvenation_lines(_count_of("", "")) == ["Rejuvenated 2 times."]
    (line,) = rejuvenation_lines(_count_of("no pose to seek", ""))
    assert line == "Rejuvenated 1 times. Refused: no pose to seek (1)."
