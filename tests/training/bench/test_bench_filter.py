import gc
import json
import tomllib
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from training.bench.config import FilterBenchConfig
from training.bench.filter import bench as compile_timing
from training.bench.filter.bench import count_trials, run_bench
from training.bench.filter.report import print_result
from training.bench.filter.workload import FilterLoad
from training.experiments.timing import processor, time_calls, timing_ms

TINY = ("--particles", "5,9", "--landmarks", "40", "--measurements", "3", "--robots", "1,2", "--steps", "4")


def _result(milliseconds: Any, loads: list[FilterLoad]) -> dict[str, Any]:
    """Result in which the median of each load is a function of the load."""
    timing = {"low_ms": 0.1, "high_ms": 9.0, "min_ms": 0.1, "calls": 3}
    rows = [
        load.model_dump() | timing | {
            "median_ms": milliseconds(load), "right": 1.0, "ess": 0.5, "landmarks_held": load.landmarks,
            "resampled": 1.0, "nbytes": 80 * load.particles * load.landmarks, "bytes_per_landmark": 80.0,
        }
        for load in loads
    ]  # fmt: skip
    state = {"get_state": timing | {"median_ms": 0.4}, "set_state": timing | {"median_ms": 0.6}}
    machine = {"processor": "abacus", "load_before": 2.5}
    return {"machine": machine, "rows": rows, "state": state, "compilation": None, "complete": False}


@pytest.mark.slow
def test_a_run_folder_repeats_the_benchmark(vslam: Any, tmp_path: Path) -> None:
    """There is one row per combination, in table, metrics.json and its copy; the config repeats them."""
    first, second, copy = tmp_path / "first", tmp_path / "second", tmp_path / "copy.json"
    status, shown, _ = vslam("bench", "filter", *TINY, "--out", str(first), "--json", str(copy))
    assert status == 0
    assert all(word in shown for word in ("K=2", "fastslam1", "fastslam2", "get_state", "bytes per particle"))
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics == json.loads(copy.read_text())
    keys = ("proposal", "particles", "landmarks", "measurements", "robots")
    loads = [tuple(row[key] for key in keys) for row in metrics["rows"]]
    assert loads == [(p, m, 40, 3, k) for p in ("fastslam1", "fastslam2") for m in (5, 9) for k in (1, 2)]
    for row in metrics["rows"]:
        assert 0.0 < row["min_ms"] <= row["low_ms"] <= row["median_ms"] <= row["high_ms"]
        assert row["calls"] == 4
        assert row["resampled"] == 1.0
        assert row["right"] >= 0.5  # twelve measurements
        assert row["bytes_per_landmark"] >= 76.0
    assert metrics["machine"]["processor"] == processor()
    assert (first / "speed.png").read_bytes().startswith(b"\x89PNG")
    fewer = ("--particles", "5", "--robots", "1")
    assert vslam("bench", "filter", "--config", str(first), "--out", str(second), *fewer).status == 0
    configs = [tomllib.loads((folder / "config.toml").read_text())["config"] for folder in (first, second)]
    assert configs[1] == configs[0] | {"particles": [5], "robots": [1]}
    assert configs[0]["steps"] == 4


def test_stopping_keeps_finished_rows() -> None:
    """After Ctrl-C no trial starts; finished rows are kept, and the result is marked incomplete."""
    config = FilterBenchConfig(particles=(3,), landmarks=(30,), measurements=(2,), robots=(1, 2), steps=2)
    begun: list[str] = []
    result = run_bench(config, begun.append, should_stop=lambda: len(begun) > 1)
    assert len(begun) == 2 < count_trials(config)
    assert [row["robots"] for row in result["rows"]] == [1, 2]
    assert (result["state"], result["complete"]) == ({}, False)


def test_every_trial_advances_the_bar() -> None:
    """The progress bar ends at its end."""
    config = FilterBenchConfig(particles=(3,), landmarks=(30,), measurements=(2,), robots=(1,), steps=2)
    begun: list[str] = []
    assert run_bench(config, begun.append)["complete"]
    assert len(begun) == count_trials(config)


def test_the_table_shows_load_and_early_stop() -> None:
    """On 80 columns the table shows robots side by side, a busy machine and an early stop."""
    load = FilterLoad(particles=1000)
    result = _result(lambda load: 0.5 * load.robots, [load, load.replace(robots=3)])
    shown = StringIO()
    print_result(Console(file=shown, width=80), result)
    text = shown.getvalue()
    line = next(line for line in text.splitlines() if line.strip().startswith("1000"))
    assert line.split() == ["1000", "300", "15", "0.500", "0.100-9.00", "0.100", "1.50", "100%"]
    text = " ".join(text.split())
    for words in (
        "fastslam2: median in ms",
        "80 bytes per particle and landmark",
        "was busy (load 2.5)",
        "set_state 0.600 ms",
    ):
        assert words in text
    assert "Stopped" in text


def test_the_widest_rows_fit_on_80_columns() -> None:
    """No row of a table with three numbers of robots and ten thousand particles is cut or wrapped."""
    loads = FilterBenchConfig(robots=(1, 2, 3), large=True).loads()
    shown = StringIO()
    result = _result(lambda load: 64.2e-4 * load.particles, loads)
    print_result(Console(file=shown, width=80), result)
    lines = [line.split() for line in shown.getvalue().splitlines()]
    assert ["10000", "1000", "15", "64.2", "0.100-9.00", "0.100", "100%"] in lines


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
    times = compile_timing.time_compilation()
    assert (times["cold"]["found"], times["cached"]["found"]) == (0, 1)
    assert (times["cache_files"], times["cache_bytes"]) == (2, 300_000)
    assert not Path(times["cold"]["folder"]).exists()


def test_compilation_times_are_printed(monkeypatch: pytest.MonkeyPatch, vslam: Any, tmp_path: Path) -> None:
    """With --compile one line gives the times of compilation and of loading; the JSON has both processes."""
    monkeypatch.setattr(compile_timing, "WARM_UP_SCRIPT", FAKE_WARM_UP)
    least = ("--particles", "3", "--landmarks", "30", "--measurements", "2", "--robots", "1", "--steps", "2")
    said = vslam("bench", "filter", *least, "--compile", "--out", str(tmp_path / "bench"))
    assert said.status == 0
    shown = " ".join(said.out.split())  # lines may be wrapped anywhere
    assert "Kernels: compiled in 41 s, once; loaded from the cache (0.3 MB) in 0.3 s; import 1.2 s." in shown
    compilation = json.loads((tmp_path / "bench" / "metrics.json").read_text())["compilation"]
    assert (compilation["cold"]["compile_s"], compilation["cached"]["compile_s"]) == (41.0, 0.0)
    assert (compilation["cache_files"], compilation["cache_bytes"]) == (2, 300_000)
