"""Fixtures and settings shared by all tests."""

import gc
import os
from pathlib import Path

if worker := os.environ.get("PYTEST_XDIST_WORKER"):  # before numba: two processes cannot write to one cache safely
    caches = Path(os.environ.get("NUMBA_CACHE_DIR", Path(__file__).parents[1] / ".pytest_cache" / "numba"))
    os.environ["NUMBA_CACHE_DIR"] = str(caches / worker)

import pytest
from hypothesis import settings

settings.register_profile("default", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("default")


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
