"""`vslam bench speed start`: its rows, its fresh places, and what it refuses."""

import os
from pathlib import Path

import pytest

from training.bench.speed import start
from training.bench.speed.config import StartSpeedConfig
from training.bench.speed.start import FIGURES, STUDY, fresh_place, on_two_cores, play, trials


def test_places_have_neither_caches_nor_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program there runs the copied sources, with an empty home and numba's own defaults."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "elsewhere")
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    with fresh_place() as place:
        assert not list(place.home.iterdir())
        assert not list(place.sources.rglob("__pycache__"))
        told = place.run("-c", "import os, training; print(training.__file__, *sorted(os.environ), sep='\\n')")
        assert Path(told.splitlines()[0]).is_relative_to(place.sources)
        assert not [name for name in told.splitlines() if name.startswith("NUMBA_")]
        with pytest.raises(RuntimeError, match="ModuleNotFoundError"):
            place.run("-c", "import no_such_module")
        assert place.figures("print('text'); print(1.5, 2)") == (1.5, 2.0)
    assert not place.sources.exists()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system cannot choose cores")
def test_two_cores_are_used_and_given_back() -> None:
    """The bench changes nothing beyond its end."""
    before = os.sched_getaffinity(0)
    with on_two_cores():
        assert len(os.sched_getaffinity(0)) == min(2, len(before))
    assert os.sched_getaffinity(0) == before


def test_figures_have_units_and_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counts need no unit, times have one; a part is measured once for all its figures."""
    calls: list[None] = []
    monkeypatch.setattr(start, "count", lambda: calls.append(None) or (len(calls), 3.0))
    start.measured.cache_clear()
    config = StartSpeedConfig(parts=("count",), repeats=2)
    rows = [{"part": t.part, "figure": t.figure} | play(config, t) for t in trials(config)]
    start.measured.cache_clear()
    table = STUDY.tables[0]
    kernels, many = map(table.cells, table.lines(rows))
    assert len(calls) == 2
    assert kernels == ["count", "kernels", "2", "1", "2", "2", "200"]
    assert many[2:] == ["3", "3", "3", "2", "15"]
    (steps,) = table.lines([{"part": "steps", "figure": FIGURES["steps"][0].name, "value": 2.0}])
    assert table.cells(steps)[2:] == ["2 s", "2 s", "2 s", "1", "30 s"]


def test_a_wheel_is_a_part_of_its_own(tmp_path: Path) -> None:
    """Naming one adds the part; a wheel that is not there is refused, as is the part without one."""
    wheel = tmp_path / "some.whl"
    for given in ({"wheel": str(wheel)}, {"parts": ("wheel",)}):
        with pytest.raises(ValueError, match="wheel: expected the wheel that `make kernels-wheel` writes, got"):
            StartSpeedConfig(**given)
    wheel.touch()
    for parts in (("count",), ("count", "wheel")):
        found = trials(StartSpeedConfig(parts=parts, wheel=str(wheel), repeats=1))
        assert list(dict.fromkeys(trial.part for trial in found)) == ["count", "wheel"]
