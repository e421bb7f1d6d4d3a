"""Trial of an installed vslam-env, outside of its checkout: `PYTHON tests/packaging/smoke.py [--tests]`.

PYTHON is that of the environment with the installation; `--tests` also runs the tests that need no file of the checkout
but `tests`, and needs pytest and hypothesis. Prints a line for each part, and ends with the first that fails.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
WHERE = """
import agents, slam_backend, training, vslam_env
for package in (agents, slam_backend, training, vslam_env):
    assert package.__file__.startswith({prefix!r}), package.__file__
from slam_backend.core.compilation.shipped import shipped_kernels
print(vslam_env.__version__, "kernels of", getattr(shipped_kernels(), "folder", None))
"""
EPISODE = ("run", "--world", "office", "--robots", "3", "--seed", "0", "--max-seconds", "20", "--out", "episode")
LEARNED = ("run", "--world", "hall", "--robots", "1", "--policy", "learned", "--max-seconds", "4", "--particles", "10")
WRITTEN = {"report.html", "metrics.json", "map.png", "error.png", "video.mp4", "recording.npz", "config.toml"}
TESTS = (
    "tests/agents",
    *(f"tests/vslam_env/test_{name}.py" for name in ("pettingzoo_suite", "environment", "snapshots", "wrappers")),
    "tests/vslam_env/test_reward.py",
    "tests/slam_backend/fastslam/test_filter_reference.py",
    "tests/slam_backend/readers",
    "tests/training/episodes",
    "tests/training/report",
)
SETTINGS = "[pytest]\nmarkers =\n    slow: takes more than a few seconds\n    nightly: takes minutes\n"


def run(place: Path, *command: str | Path) -> str:
    """Run a command in a folder, without the checkout on Python's path, and return what it prints.

    Raises:
        SystemExit: If the command fails; its output is printed.
    """
    left_out = ("PYTHONPATH", "VSLAM_DATA")
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    done = subprocess.run(list(map(str, command)), cwd=place, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def installation(place: Path) -> str:
    """Check that the packages come from the environment; return their version and the kernels that came with them."""
    about = run(place, sys.executable, "-c", WHERE.format(prefix=sys.prefix)).strip()
    for shown in (run(place, BIN / "vslam", "--version"), run(place, sys.executable, "-m", "vslam_env", "--version")):
        assert about.split()[0] in shown, shown
    return about


def first_picture(place: Path) -> str:
    """Explore an office for 20 s and check the files of the run folder."""
    run(place, BIN / "vslam", *EPISODE)
    missing = WRITTEN - {file.name for file in (place / "episode").iterdir()}
    assert not missing, missing
    return "episode/map.png"


def programs(place: Path) -> str:
    """Run the programs of the README as written."""
    said = run(place, sys.executable, ROOT / "tests" / "docs" / "run_page.py", ROOT / "README.md")
    return said.strip().splitlines()[-1]


def commands(place: Path) -> str:
    """Write a report again, and run an episode with the model that comes with the package."""
    run(place, BIN / "vslam", "report", "episode")
    run(place, BIN / "vslam", *LEARNED, "--no-video", "--out", "learned")
    return "report, learned"


def tests(place: Path) -> str:
    """Run the tests of the installed package from a copy of the folder of tests."""
    shutil.copytree(ROOT / "tests", place / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    (place / "pytest.ini").write_text(SETTINGS, encoding="utf-8")
    options = ("-q", "-p", "no:cacheprovider", "-m", "not slow and not nightly")
    return run(place, sys.executable, "-m", "pytest", *options, *TESTS).strip().splitlines()[-1]


def main(arguments: Sequence[str]) -> None:
    """Try all parts in an empty folder."""
    parts = (installation, first_picture, programs, commands, *((tests,) if "--tests" in arguments else ()))
    with TemporaryDirectory() as folder:
        for part in parts:
            begun = time.perf_counter()
            about = part(Path(folder))
            print(f"{part.__name__}: {time.perf_counter() - begun:.1f} s ({about})", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
