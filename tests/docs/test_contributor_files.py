"""Files for contributors agree with the Makefile, the package and each other."""

import re
import tomllib
from inspect import getmembers, isfunction, signature
from pathlib import Path
from typing import Any

import yaml

from slam_backend.core import jit

ROOT = Path(__file__).parents[2]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _yaml(path: str) -> Any:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def test_workflow_jobs_run_existing_make_targets_only() -> None:
    """A job prepares Python and calls make, so that everything but an upload can be run by hand."""
    targets = set(re.findall(r"^([\w-]+):", MAKEFILE, re.MULTILINE))
    for workflow in (ROOT / ".github" / "workflows").glob("*.yml"):
        jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
        commands = [step["run"].split() for job in jobs.values() for step in job["steps"] if "run" in step]
        assert commands
        assert all(words[0] == "make" and words[1] in targets for words in commands)


def test_the_workflow_tests_the_oldest_supported_python() -> None:
    """Linux jobs must pass, and start at `requires-python`."""
    job = _yaml(".github/workflows/test.yml")["jobs"]["linux"]
    assert "continue-on-error" not in job
    assert f">={job['strategy']['matrix']['python'][0]}" == PROJECT["requires-python"]


def test_hooks_run_the_tools_of_make_lint() -> None:
    """Each line of `make lint` has a hook; hooks format where `make lint` checks the format."""
    recipe = re.search(r"^lint:.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert recipe is not None
    lint = [line.split()[0].removeprefix("$(BIN)/") for line in recipe.group(1).splitlines()]
    hooks = [hook["entry"].split()[0] for repo in _yaml(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    assert [hook.removeprefix(".venv/bin/") for hook in hooks] == lint


def test_the_citation_names_the_version_and_licence_of_the_package() -> None:
    """The citation gives the installed version."""
    citation = _yaml("CITATION.cff")
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])


def test_the_guide_lists_all_kernel_decorators() -> None:
    """The table of decorators in CONTRIBUTING.md lists exactly those that take a function or a kernel."""
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = guide[guide.index("| decorator |") : guide.index("- The disk cache keys a kernel")]
    explained = {name for row in table.split("\n|")[2:] for name in re.findall(r"`(\w+)`", row.split("|")[0])}
    decorators = {
        name
        for name, function in getmembers(jit, isfunction)
        if not name.startswith("_") and list(signature(function).parameters) in (["function"], ["kernel"])
    }
    assert explained == decorators
