"""Kernels come ready in a wheel: chosen by the processor, found without a cache, and never stale."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

from slam_backend.core.compilation.compiler import recorded_signatures
from slam_backend.core.compilation.shipped import LEVELS, V3, host_features, reason_against, versions
from slam_backend.core.compilation.wheel import build_wheel

ROOT = Path(__file__).parents[4]
LEVEL = "x86-64-v3"
IS_LEVEL = LEVELS[LEVEL] <= host_features()
PART = "slam_backend.frontend."  # kernels that the wheel of these tests holds
# Describes the corners of an image after it has compiled some kernels in a given order; prints the result's bytes, and
# how many kernels were compiled in all.
DESCRIBE = """
import json, sys
import numpy as np
from slam_backend.core.compilation.messages import watch_compilation
from slam_backend.core.compilation.compiler import compile_lines
from slam_backend.frontend import harris_corners, usurf_descriptors

with watch_compilation(lambda name: None) as watch:
    compile_lines(iter(sys.argv[1].splitlines()), lambda line, seconds: None)
    image = np.kron(np.random.default_rng(0).integers(0, 256, (10, 20)), np.ones((12, 12))).astype(np.uint8)
    corners = harris_corners(image)
    looks = usurf_descriptors(image, corners.points, 2.3)
assert len(looks) > 5
print(json.dumps([corners.points.tobytes().hex() + looks.tobytes().hex(), len(watch.names)]))
"""


def python(
    program: str, *arguments: str, site: Path | None = None, sources: Path = ROOT, **variables: str
) -> tuple[Any, str]:
    """Return what a program prints, read as JSON, and its warnings."""
    search = os.pathsep.join(str(path) for path in (sources, ROOT / "tests", site) if path is not None)
    environment = os.environ | {"PYTHONPATH": search} | variables
    command = [sys.executable, "-P", "-c", program, *arguments]  # without the current folder
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def manifest(**changes: Any) -> dict[str, Any]:
    """Return what a wheel that was built here says of itself."""
    return versions() | {"levels": list(LEVELS)} | changes


def test_the_highest_level_of_the_processor_is_chosen() -> None:
    """A processor that lacks one feature of a level gets the next one, or none."""
    best, next_best = LEVELS
    assert reason_against(manifest(), LEVELS[best]) == ("", best)
    assert reason_against(manifest(), LEVELS[best] - {"avx512vl"}) == ("", next_best)
    assert reason_against(manifest(levels=[next_best]), LEVELS[best]) == ("", next_best)
    for feature in V3:
        assert reason_against(manifest(), LEVELS[best] - {feature}) == ("this processor is below x86-64-v3", "")


@pytest.mark.parametrize("name", list(versions()))
def test_kernels_of_other_versions_are_not_used(name: str) -> None:
    """The reason names both versions."""
    why, level = reason_against(manifest(**{name: "0.1"}), LEVELS["x86-64-v4"])
    assert (why, level) == (f"built for {name} 0.1, this is {versions()[name]}", "")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of some kernels, with one level, compiled by two processes."""
    return build_wheel(tmp_path_factory.mktemp("dist"), ["slam_backend", "vslam_env"], [LEVEL], PART, 2)


@pytest.fixture
def site(wheel: Path, tmp_path: Path) -> Path:
    """A folder in which that wheel is installed."""
    folder = tmp_path / "site"
    install = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder), str(wheel)]
    subprocess.run([sys.executable, *install], check=True)
    return folder


@pytest.mark.slow
@pytest.mark.nightly
def test_a_wheel_is_tagged_and_pinned(wheel: Path) -> None:
    """It fits one Python, platform, numba and llvmlite, and holds one file per recorded signature."""
    here = versions()
    tag = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    assert wheel.name.split("-", 2)[2].startswith(f"{tag}-{tag}")
    assert wheel.stem.rsplit("-", 1)[1] in (distribution("llvmlite").read_text("WHEEL") or wheel.stem)
    with ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = archive.read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert f"Requires-Dist: numba=={here['numba']}\n" in metadata
    assert f"Requires-Dist: llvmlite=={here['llvmlite']}\n" in metadata
    recorded = recorded_signatures("slam_backend", "vslam_env")
    number = sum(len(words) for kernel, words in recorded.items() if kernel.startswith(PART))
    assert sum(name.startswith(f"vslam_env_kernels/{LEVEL}/") for name in names) == number > 3


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(not IS_LEVEL, reason=f"this processor is below {LEVEL}")
def test_shipped_kernels_compile_nothing_and_give_the_same_bytes(site: Path, tmp_path: Path) -> None:
    """From an installation that is only read, and a cache that cannot be written, with nothing to say.

    The shipped kernels are of a portable level and compiled by two processes, those here are native.
    """
    for path in (site, *site.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    (tmp_path / "file").touch()
    no_place = {"NUMBA_CACHE_DIR": str(tmp_path / "file"), "HOME": str(tmp_path / "file")}
    sources = tmp_path / "sources"
    for package in ("slam_backend", "vslam_env"):
        shutil.copytree(ROOT / package, sources / package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [folder for folder in sources.rglob("*") if folder.is_dir()]:
        (folder / "__pycache__").touch()  # where a cache would be
    shipped, warnings = python(DESCRIBE, "", site=site, sources=sources, **no_place)
    assert (shipped[1], warnings) == (0, "")
    here, _ = python(DESCRIBE, "")
    assert here[0] == shipped[0]


@pytest.mark.slow
@pytest.mark.nightly
def test_the_order_of_compilation_decides_nothing(tmp_path: Path) -> None:
    """Kernels compiled backwards, by one process, give the bytes of those that several processes compile forwards."""
    names = [name for name in recorded_signatures("slam_backend") if name.startswith(PART)]
    backwards = [f"{name} {words}" for name in reversed(names) for words in recorded_signatures("slam_backend")[name]]
    there, _ = python(DESCRIBE, "\n".join(backwards), NUMBA_CACHE_DIR=str(tmp_path))
    here, _ = python(DESCRIBE, "")
    assert there[1] > 3
    assert there[0] == here[0]


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(not IS_LEVEL, reason=f"this processor is below {LEVEL}")
def test_stale_damaged_or_unwanted_kernels_are_not_used(site: Path, tmp_path: Path) -> None:
    """A file that is damaged and a manifest that does not fit are one line each; a chosen processor is obeyed."""
    count = "import json, vslam_env; from slam_backend.core.compilation.compiler import *; "
    count += "some = {n: w for n, w in recorded_signatures('slam_backend').items() if n.startswith(sys.argv[1])}; "
    count += "print(json.dumps(len(missing_tasks(some))))"
    empty = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert python(count, PART, site=site, **empty) == (0, "")
    number = python(count, PART, **empty)[0]
    assert python(count, PART, site=site, NUMBA_CPU_NAME=LEVEL, NUMBA_CPU_FEATURES="", **empty) == (number, "")
    folder = site / "vslam_env_kernels"
    file = next(file for file in (folder / LEVEL).iterdir() if not file.name.startswith("refine"))
    file.write_bytes(file.read_bytes()[:-5])
    assert python(count, PART, site=site, **empty) == (1, f"{file} is damaged: the kernel is compiled again.\n")
    sources = tmp_path / "sources"
    for package in ("slam_backend", "vslam_env"):
        shutil.copytree(ROOT / package, sources / package, ignore=shutil.ignore_patterns("__pycache__"))
    edited = sources / "slam_backend" / "frontend" / "_matching_kernels.py"  # a constant of one kernel
    edited.write_text(re.sub(r"(?m)^FARTHEST.*$", "FARTHEST = 3.5", edited.read_text()))
    assert python(count, PART, site=site, sources=sources, **empty)[0] == 2 < number
    about = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(about | {"numba": "0.1"}))
    why = f"built for numba 0.1, this is {about['numba']}"
    told = f"The kernels of vslam-env-kernels are not used ({why}): kernels are compiled here.\n"
    assert python(count, PART, site=site, **empty) == (number, told)
