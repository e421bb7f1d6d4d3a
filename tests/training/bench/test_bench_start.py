"""`vslam bench start`: its rows, its fresh places, and what it refuses."""

import os
from pathlib import Path

import pytest

from training.bench.config import StartBenchConfig
from training.bench.start.bench import FIGURES, cells, check_wheel, fresh_place, markdown, on_two_cores, run_bench


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


def test_each_part_has_rows_with_medians() -> None:
    """Counts need no unit, times have one, and a part that was not run shows dashes."""
    result = run_bench(StartBenchConfig(parts=("count",), repeats=2))
    kernels, many = result["figures"]
    assert result["complete"]
    assert kernels["values"][0] == kernels["values"][1] > many["values"][0] > 0
    assert cells(kernels)[1] == str(int(kernels["values"][0]))
    stopped = run_bench(StartBenchConfig(parts=("wheel",)), should_stop=lambda: True)
    assert not stopped["complete"]
    assert cells(stopped["figures"][0])[1:] == ("- s", "- s", "- s", "0", "15 s")
    assert len(markdown(stopped).splitlines()) == 2 + len(FIGURES["wheel"])


def test_a_wheel_is_a_part_of_its_own(tmp_path: Path) -> None:
    """Naming one adds the part; asking for the part without one is refused."""
    wheel = tmp_path / "some.whl"
    config = StartBenchConfig(wheel=str(wheel)).with_wheel()
    assert config.parts[-1] == "wheel"
    assert config.with_wheel().parts == config.parts
    with pytest.raises(ValueError, match="wheel: expected the wheel that `make kernels-wheel` writes, got '"):
        check_wheel(config)
    wheel.touch()
    check_wheel(config)
