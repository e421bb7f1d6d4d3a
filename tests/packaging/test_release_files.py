"""Files of a release: the image, its context, the tag, and where pages install from."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


def make(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run `make` with the Makefile of the repository in a folder."""
    command = ["make", "--no-print-directory", "--file", str(ROOT / "Makefile"), *words]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def test_a_tag_is_the_version_of_the_package_and_of_the_changelog() -> None:
    """Another tag is refused."""
    assert make("check-tag", f"TAG=v{VERSION}").returncode == 0
    assert make("check-tag", f"TAG={VERSION}").returncode != 0


def test_pages_install_from_the_place_that_is_chosen(tmp_path: Path) -> None:
    """Pages, and notebooks in both forms, get the new place; the rest of the line stays."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "docs").mkdir()
    files = {
        "README.md": 'VSLAM_WHEEL={}   # a folder\npip install --find-links "$VSLAM_WHEEL" vslam-env\n',
        "docs/first.ipynb": '"source": ["%env VSLAM_WHEEL={}\\n"]\n',
        "docs/first.py": "# %env VSLAM_WHEEL={}\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text.format("dist"), encoding="utf-8")
    place = "https://example.org/releases/v1"
    assert make("install-from", f"VSLAM_WHEEL={place}", cwd=tmp_path).returncode == 0
    for name, text in files.items():
        assert (tmp_path / name).read_text(encoding="utf-8") == text.format(place)


def test_a_release_needs_the_approval_of_a_person() -> None:
    """Nothing is published unless the repository's variable says so, in an environment that can ask for approval."""
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))
    publish = workflow["jobs"]["publish"]
    assert "vars.PUBLISH == 'true'" in publish["if"]
    assert publish["environment"] == "release"
    assert publish["permissions"] == {"id-token": "write"}
    assert set(publish["needs"]) >= {"installed"}
    writing = [name for name, job in workflow["jobs"].items() if "write" in job.get("permissions", {}).values()]
    assert set(writing) == {"page", "publish", "pages"}
    assert workflow["permissions"] == {"contents": "read"}


def test_the_context_of_the_image_has_what_the_wheels_are_built_from() -> None:
    """The image gets the packages and the files that pyproject.toml names, and nothing else."""
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert ignored[0] == "*"
    allowed = {line[1:] for line in ignored if line.startswith("!")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = {name.rstrip("*") for name in project["tool"]["setuptools"]["packages"]["find"]["include"]}
    files = {project["project"]["readme"], *project["project"]["license-files"]}
    assert allowed == packages | files | {"pyproject.toml", "constraints.txt"}
    copied = re.findall(r"(?:^COPY|/source/)(\S*)", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(filter(None, copied)) == {"constraints.txt"}


@pytest.mark.slow
@pytest.mark.nightly
def test_the_image_runs_the_command_line() -> None:
    """The image is built and shows the version."""
    if shutil.which("docker") is None or subprocess.run(["docker", "info"], capture_output=True).returncode:
        pytest.skip("no Docker engine answers `docker info`")
    built = make("image")
    assert built.returncode == 0, built.stderr
    command = ["docker", "run", "--rm", f"vslam-env:{VERSION}", "--version"]
    assert VERSION in subprocess.run(command, capture_output=True, text=True, check=True).stdout
