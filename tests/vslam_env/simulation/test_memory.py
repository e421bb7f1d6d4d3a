"""Episodes that cannot fit into memory are refused before their first step."""

import importlib
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from slam_backend import FastSlam
from slam_backend.core.jit import LINE
from vslam_env import vslam_v0
from vslam_env.simulation import memory


def test_a_map_with_all_landmarks_needs_about_what_is_estimated() -> None:
    """The estimate is twice the values and counts of a filter's landmarks, apart from rounding up to lanes and room."""
    slam = FastSlam(num_particles=200)
    points = np.column_stack([np.linspace(-2.0, 2.0, 400), np.zeros(400), np.full(400, 3.0)])
    maps = slam.maps
    maps.reserve(len(points), 64)
    bytes_used = maps.values.nbytes + maps.counts.nbytes - LINE
    assert 0.4 < bytes_used / memory.required_memory(len(points), 200) < 0.7


def test_the_least_of_all_limits_counts(tmp_path: Path) -> None:
    """Free memory of the system, and of the control group if it has a limit; unknown where there is no such file."""
    system, group = tmp_path / "meminfo", tmp_path / "group"
    assert memory.available_memory(system, group) is None
    system.write_text("MemTotal:  9000 kB\nMemAvailable:   5000 kB\n")
    assert memory.available_memory(system, group) == 5000 * 1024
    group.mkdir()
    (group / "memory.current").write_text("1000000\n")
    for limit, expected in (("max", 5000 * 1024), ("3000000", 2_000_000), ("900000", 0), ("9000000000", 5000 * 1024)):
        (group / "memory.max").write_text(f"{limit}\n")
        assert memory.available_memory(system, group) == expected
    system.write_text("MemTotal:  9000 kB\n")
    assert memory.available_memory(system, group) is None


@pytest.mark.skipif(sys.platform != "linux", reason="the size of a process is read from /proc")
def test_a_limit_of_the_address_space_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What `ulimit -v` leaves to this process counts if it is less than the free memory."""
    resource = importlib.import_module("resource")
    system, own, page = tmp_path / "meminfo", tmp_path / "statm", os.sysconf("SC_PAGE_SIZE")
    system.write_text("MemAvailable:   5000 kB\n")
    own.write_text("100 50 3\n")
    for limit, expected in ((101 * page, page), (99 * page, 0), (10**12, 5_120_000), (-1, 5_120_000)):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        assert memory.available_memory(system, tmp_path, own) == expected


def test_a_lack_of_memory_at_a_reset_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """It names the world; the running episode goes on."""
    env = vslam_v0.parallel_env(world="hall", num_robots=2, num_particles=4)
    env.reset(seed=3)

    def fail(*_: object) -> None:
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr("vslam_env.environment.sample_scenario", fail)
    with pytest.raises(ValueError, match=r"world: expected one that fits into the free memory, got .*9 GiB"):
        env.reset(seed=4)
    assert env.agents


def test_what_fits_passes_and_the_error_names_what_would() -> None:
    """One landmark more than fits is refused, with the number of particles that would fit; so it is without figures."""
    needed = memory.required_memory(1000, 100)
    memory.check_memory(1000, 100, needed)
    memory.check_memory(1000, 100, None)
    with pytest.raises(ValueError, match=r"num_particles: expected at most 99 for the 1000 landmarks") as caught:
        memory.check_memory(1000, 100, needed - 1)
    memory.check_memory(1000, int(re.findall(r"at most (\d+)", str(caught.value))[0]), needed - 1)


def test_an_environment_beyond_the_memory_is_refused_at_its_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reset in a world whose landmarks do not fit raises one clear error; with fewer particles it works."""
    env = vslam_v0.parallel_env(world="hall", num_robots=2, num_particles=100)
    env.reset(seed=3)
    needed = memory.required_memory(int(env.episode.scenario.observable_landmarks.sum()), 100)
    monkeypatch.setattr("vslam_env.simulation.scenario.available_memory", lambda: needed - 1)
    with pytest.raises(ValueError, match="num_particles: expected at most 99 "):
        env.reset(seed=3)
    vslam_v0.parallel_env(world="hall", num_robots=2, num_particles=99).reset(seed=3)
