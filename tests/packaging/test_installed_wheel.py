"""The wheel, installed outside of the checkout: commands, versions and data files."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import slam_backend
from slam_backend.core.compilation.cache import cache_folder

ROOT = Path(__file__).parents[2]
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")
pytestmark = [pytest.mark.slow, pytest.mark.nightly]


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without the checkout on Python's path; a failure shows its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VSLAM_DATA")}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel of a copy of the checkout."""
    if tuple(map(int, version("setuptools").split(".")[:1])) < (77,):
        pytest.skip("setuptools is older than 77, which the build needs: pip install --upgrade setuptools")
    copy, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(built)!r})"
    run(sys.executable, "-c", code, cwd=copy)
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


def test_the_demo_runs_outside_of_the_checkout(installed: Path, tmp_path: Path) -> None:
    """The installed command explores, maps, and writes a folder with a report; it runs the installed files."""
    python, vslam = installed / "bin" / "python", installed / "bin" / "vslam"
    code = "import vslam_env, training; print(vslam_env.__file__, training.__file__, vslam_env.__version__)"
    env_file, training_file, shown = run(python, "-c", code, cwd=tmp_path).stdout.split()
    assert Path(env_file).is_relative_to(installed)
    assert Path(training_file).is_relative_to(installed)
    assert shown == version("vslam-env")
    assert shown in run(python, "-m", "vslam_env", "--version", cwd=tmp_path).stdout
    few = ("--world", "office", "--robots", "3", "--policy", "frontier", "--max-seconds", "6", "--particles", "30")
    done = run(vslam, "run", *few, "--out", "demo", cwd=tmp_path)
    assert re.search(r"Report: .*report\.html", done.stdout)
    names = {file.name for file in (tmp_path / "demo").iterdir()}
    assert names >= {"report.html", "metrics.json", "map.png", "error.png", "video.mp4", "recording.npz", "config.toml"}
    run(vslam, "report", "demo", cwd=tmp_path)
    few = ("--world", "hall", "--robots", "1", "--policy", "learned", "--max-seconds", "4", "--particles", "10")
    run(vslam, "run", *few, "--no-video", "--out", "learned", cwd=tmp_path)


def test_the_program_of_the_readme_runs_outside_of_the_checkout(installed: Path, tmp_path: Path) -> None:
    """The environment is registered with PettingZoo and Gymnasium, and steps."""
    program = """
import gymnasium
from vslam_env import vslam_v0

env = vslam_v0.parallel_env(world="fig5", num_robots=2, action_type="goal", max_cycles=3)
observations, infos = env.reset(seed=0)
while env.agents:
    actions = {agent: env.action_space(agent).sample(observations[agent]["action_mask"]) for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
print(len(env.belief("robot_0").map.means), gymnasium.spec("vslam_env/SoloExploration-v0").id)
"""
    landmarks, name = run(installed / "bin" / "python", "-c", program, cwd=tmp_path).stdout.split()
    assert int(landmarks) > 0
    assert name == "vslam_env/SoloExploration-v0"
