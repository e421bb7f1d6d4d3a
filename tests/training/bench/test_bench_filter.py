import gc
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.bench.speed import filter as compile_timing
from training.bench.speed.config import FilterSpeedConfig
from training.bench.speed.filter import KERNELS, SNAPSHOTS, STEP, STUDY, trials
from training.experiments.machine.timing import processor, time_calls, timing_ms

TINY = ("--particles", "5,9", "--landmarks", "40", "--measurements", "3", "--robots", "1,2", "--steps", "4")


@pytest.mark.slow
def test_a_run_folder_repeats_the_benchmark(vslam: Any, tmp_path: Path) -> None:
    """There is one row per combination, in table, metrics.json and its copy; the config repeats them."""
    first, second, copy = tmp_path / "first", tmp_path / "second", tmp_path / "copy.json"
    status, shown, _ = vslam("bench", "speed", "filter", *TINY, "--out", str(first), "--json", str(copy))
    assert status == 0
    assert all(word in shown for word in ("A step, fastslam1", "A step, fastslam2", "get_state", "memory"))
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics == json.loads(copy.read_text())
    keys = ("proposal", "particles", "landmarks", "measurements", "robots")
    rows = [row for row in metrics["trials"] if row["part"] == STEP]
    loads = [tuple(row[key] for key in keys) for row in rows]
    assert loads == [(p, m, 40, 3, k) for p in ("fastslam1", "fastslam2") for m in (5, 9) for k in (1, 2)]
    for row in rows:
        assert 0.0 < row["min_ms"] <= row["low_ms"] <= row["median_ms"] <= row["high_ms"]
        assert row["calls"] == 4
        assert row["resampled"] == 1.0
        assert row["right"] >= 0.5  # twelve measurements
        assert row["bytes_per_landmark"] >= 76.0
    assert metrics["machine"]["processor"] == processor()
    assert (first / "filter.png").read_bytes().startswith(b"\x89PNG")
    fewer = ("--particles", "5", "--robots", "1")
    assert vslam("bench", "speed", "filter", "--config", str(first), "--out", str(second), *fewer).status == 0
    configs = [tomllib.loads((folder / "config.toml").read_text())["config"] for folder in (first, second)]
    assert configs[1] == configs[0] | {"particles": [5], "robots": [1]}
    assert configs[0]["steps"] == 4


def test_there_is_a_trial_for_each_row_snapshot_and_process() -> None:
    """Rows are all combinations; those of 10,000 particles and the compilation are there only if asked for."""
    few = FilterSpeedConfig(particles=(3,), landmarks=(30,), measurements=(2,), robots=(1, 2), proposals=("fastslam2",))
    assert [(trial.part, trial.robots) for trial in trials(few)] == [(STEP, 1), (STEP, 2), *((p, 1) for p in SNAPSHOTS)]
    more = [trial for trial in trials(few.replace(large=True, compile=True)) if trial not in trials(few)]
    assert [(trial.part, trial.particles) for trial in more] == [(STEP, 10_000)] * 2 + [(part, 100) for part in KERNELS]


def test_tables_have_short_headings_and_times_with_three_digits() -> None:
    """A line has load, times with three significant digits, share of right associations, and memory."""
    (load, *_) = trials(FilterSpeedConfig(particles=(1000,), landmarks=(300,), measurements=(15,), robots=(3,)))
    row: dict[str, Any] = {name: getattr(load, name) for name in ("part", "proposal", "particles", "landmarks")}
    row |= {"measurements": 15, "robots": 3, "median_ms": 1.504, "low_ms": 0.1, "high_ms": 64.26, "min_ms": 0.0912}
    table = STUDY.tables[0]
    (line,) = table.lines([row | {"right": 0.996, "bytes_per_landmark": 80.0}])
    assert table.headings[:4] == ["M", "N", "B", "K"]
    assert table.cells(line) == ["1000", "300", "15", "3", "1.50", "0.100", "64.3", "0.091", "100", "80"]


def test_timing_is_by_quantiles_of_single_calls() -> None:
    """Ten per cent are below the low and above the high quantile, half are below the median."""
    timing = timing_ms(np.linspace(0.0, 1.0, 101))
    assert [timing[name] for name in ("low_ms", "median_ms", "high_ms")] == pytest.approx([100.0, 500.0, 900.0])
    assert (timing["min_ms"], timing["calls"]) == (0.0, 101)


def test_calls_are_timed_without_the_garbage_collector() -> None:
    """The collector is off during the calls and restored afterwards, errors included; the first calls warm up."""
    seconds, results = time_calls(lambda number: (number, gc.isenabled()), range(5), warm_up=2)
    assert results == [(2, False), (3, False), (4, False)]
    assert (len(seconds), bool((seconds > 0.0).all())) == (3, True)
    with pytest.raises(ZeroDivisionError):
        time_calls(lambda number: 1 // number, [0])
    assert gc.isenabled()


# Program of a new process instead of the warm-up: writes a file into the cache and prints the number of files.
FAKE_WARM_UP = """
import json, os, pathlib
folder = pathlib.Path(os.environ["NUMBA_CACHE_DIR"])
found = len(list(folder.iterdir()))
(folder / f"kernel{found}").write_bytes(bytes(150_000))
seconds = {"import_s": 1.2, "compile_s": 41.0 * (not found), "warm_up_s": 0.3 + 41.0 * (not found)}
print(json.dumps(seconds | {"found": found, "folder": str(folder)}))
"""


def test_compilation_is_timed_with_a_new_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two new processes share a cache that is empty at first; its size is reported, and it is deleted afterwards."""
    monkeypatch.setattr(compile_timing, "WARM_UP_SCRIPT", FAKE_WARM_UP)
    compile_timing.time_compilation.cache_clear()
    times = compile_timing.time_compilation()
    assert (times["compiled"]["found"], times["cached"]["found"]) == (0, 1)
    assert (times["cached"]["cache_files"], times["cached"]["cache_bytes"]) == (2, 300_000)
    assert not Path(times["compiled"]["folder"]).exists()


def test_compilation_times_are_printed(monkeypatch: pytest.MonkeyPatch, vslam: Any, tmp_path: Path) -> None:
    """With --compile a table gives the times of compilation and of loading, measured together."""
    monkeypatch.setattr(compile_timing, "WARM_UP_SCRIPT", FAKE_WARM_UP)
    compile_timing.time_compilation.cache_clear()
    least = ("--particles", "3", "--landmarks", "30", "--measurements", "2", "--robots", "1", "--steps", "2")
    said = vslam("bench", "speed", "filter", *least, "--compile", "--out", str(tmp_path / "bench"))
    compile_timing.time_compilation.cache_clear()
    assert said.status == 0
    lines = [line.split() for line in said.out.splitlines()]
    assert ["compiled", "1.2", "41", "41.3", "0.3"] in lines
    assert ["cached", "1.2", "0", "0.3", "0.3"] in lines
