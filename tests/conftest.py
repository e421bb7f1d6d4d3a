"""Fixtures and settings shared by all tests."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("default", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("default")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, before workers start that would each compile them; all share one cache."""
    if session.config.getoption("dist", "no") != "no" and not hasattr(session.config, "workerinput"):
        code = "import vslam_env; print(f'Kernels compiled in {vslam_env.warm_up(everything=True):.0f} s.')"
        root = Path(__file__).parents[1]
        done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
        if reporter := session.config.pluginmanager.getplugin("terminalreporter"):
            reporter.write_line(done.stdout.strip() or done.stderr)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slow tests, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def pytest_collection_finish() -> None:
    """Spare the garbage collector the million objects of imported packages: tests that time or trace collect often."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data, from `VSLAM_DATA` or `../shared/data` beside the repository."""
    path = Path(os.environ.get("VSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real data at {path}: set VSLAM_DATA to the folder that holds them")
    return path
