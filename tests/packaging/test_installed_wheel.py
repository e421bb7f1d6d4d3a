"""The wheel, installed outside of the checkout: commands, versions and data files."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import slam_backend
from slam_backend.core.compilation.cache import cache_folder

ROOT = Path(__file__).parents[2]
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")
SOURCES = ("pyproject.toml", "README.md", "LICENSE")
BUILD_WHEEL = "from setuptools import build_meta; build_meta.build_wheel({folder!r})"
pytestmark = [pytest.mark.slow, pytest.mark.nightly]


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without the checkout on Python's path; a failure shows its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VSLAM_DATA")}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def source_copy(place: Path) -> Path:
    """Copy what a wheel is built from to a new folder, and return it."""
    place.mkdir()
    for name in SOURCES:
        shutil.copy(ROOT / name, place)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    return place


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel of a copy of the checkout."""
    if tuple(map(int, version("setuptools").split(".")[:1])) < (77,):
        pytest.skip("setuptools is older than 77, which the build needs: pip install --upgrade setuptools")
    copy, built = source_copy(tmp_path_factory.mktemp("source") / "copy"), tmp_path_factory.mktemp("dist")
    run(sys.executable, "-c", BUILD_WHEEL.format(folder=str(built)), cwd=copy)
    (file,) = built.glob("vslam_env-*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new environment with the wheel, the dependencies of this one, and its compiled kernels."""
    place = tmp_path_factory.mktemp("installed") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", place, cwd=place.parent)
    site = Path(
        run(place / "bin" / "python", "-c", "import site; print(site.getsitepackages()[0])", cwd=place).stdout.strip()
    )
    # Packages of a folder named in a .pth file come last, and .pth files within it, such as that of the checkout, are
    # not read.
    (site / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        place / "bin" / "python",
        "install",
        "--no-deps",
        "--no-index",
        wheel,
        cwd=place,
    )
    checkout, chosen = Path(slam_backend.__file__).parents[1], os.environ.get("NUMBA_CACHE_DIR", "")
    for name in PACKAGES:
        for sources in {file.parent for file in (checkout / name).rglob("*.py")}:
            kept = cache_folder(sources, chosen)
            here = cache_folder(site / sources.relative_to(checkout), chosen)
            assert kept is not None
            assert here is not None
            for file in kept.glob("*.nbc"):
                shutil.copy(file, here)
    return place


def test_a_wheel_holds_the_packages_and_their_data(wheel: Path) -> None:
    """All modules are in the wheel with their data files, and nothing else of the checkout."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name.split("/")[0] for name in names} - set(PACKAGES) == {f"vslam_env-{version('vslam-env')}.dist-info"}
    sources = {
        file.relative_to(ROOT).as_posix()
        for name in PACKAGES for file in (ROOT / name).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }  # fmt: skip
    assert sources <= names
    assert {name for name in sources if not name.endswith((".py", "py.typed"))} >= {
        "agents/pretrained/goal.npz",
        "training/report/assets/report.html", "training/report/assets/report.css", "training/report/assets/report.js",
        "vslam_env/kernel_signatures.json",
    }  # fmt: skip


def test_an_installation_runs_outside_of_the_checkout(installed: Path, tmp_path: Path) -> None:
    """Commands, programs of the README and the model that comes along run from the installed files."""
    said = run(installed / "bin" / "python", ROOT / "tests" / "packaging" / "smoke.py", cwd=tmp_path).stdout
    parts = ["installation", "first_picture", "programs", "commands"]
    assert re.findall(r"^(\w+): \d+\.\d s \(", said, re.MULTILINE) == parts
    assert f"({version('vslam-env')} kernels of " in said


def test_the_source_distribution_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    """It has the packages, their data and the licence; the wheel built from it is that of the checkout."""
    code = f"from setuptools import build_meta; print(build_meta.build_sdist({str(tmp_path)!r}))"
    made = run(sys.executable, "-c", code, cwd=source_copy(tmp_path / "source")).stdout.split()[-1]
    with tarfile.open(tmp_path / made) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (folder,) = (tmp_path / "unpacked").iterdir()
    roots = {path.name for path in folder.iterdir()}
    assert roots == {*PACKAGES, *SOURCES, "PKG-INFO", "setup.cfg", "vslam_env.egg-info"}
    run(sys.executable, "-c", BUILD_WHEEL.format(folder=str(tmp_path)), cwd=folder)
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(tmp_path / wheel.name) as again:
        assert sorted(first.namelist()) == sorted(again.namelist())
