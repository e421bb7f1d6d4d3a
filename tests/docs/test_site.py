"""The site: all pages are in its navigation, and links out of `docs` are resolved."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from builders.scripts import load_script

ROOT = Path(__file__).parents[2]
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def pages(nav: Any) -> list[str]:
    """Return the pages of a part of the navigation."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages(part)]


@pytest.fixture(scope="module")
def hooks() -> Any:
    """Return the hooks of the site, which need no mkdocs to be imported."""
    return load_script(ROOT / CONFIG["hooks"][0])


def test_all_pages_are_in_the_navigation(hooks: Any) -> None:
    """Each page of `docs` is listed once, with the pages of the root; none is missing or gone."""
    found = [page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")]
    found += [f"notebooks/{notebook.stem}.md" for notebook in hooks.notebooks()]
    assert sorted(pages(CONFIG["nav"])) == sorted([*found, *hooks.ROOT_PAGES, "reference/commands.md"])
    assert all((ROOT / page).is_file() for page in hooks.ROOT_PAGES)


def test_the_page_of_commands_has_all_options(hooks: Any) -> None:
    """Each command is a section; options have their defaults."""
    text = hooks.commands_page()
    assert {"## `vslam run`", "### `vslam bench exploration`", "## `vslam evaluate`"} <= set(text.splitlines())
    own = text.split("## `vslam evaluate`")[1].split("\n## ")[0]
    assert "* `--world-split <str>`: Split of the worlds: validation or test.  [default: (validation)]" in own


@pytest.mark.parametrize(("source", "before", "after"), [
    ("how-to/environment.md", "[add](../../CONTRIBUTING.md#a-world-family)", "[add](../CONTRIBUTING.md#a-world-family)"),
    ("tutorials/own_log.md", "[example](../../examples/own_log.py)", "example (`examples/own_log.py`)"),
    ("tutorials/own_log.md", "[`examples/own_log.py`](../../examples/own_log.py)", "`examples/own_log.py`"),
    ("README.md", "[lab](lab/README.md)", "[lab](lab/README.md)"),
    ("CONTRIBUTING.md", "[site](docs/architecture.md#x)", "[site](architecture.md#x)"),
    ("reference/results.md", "[here](#there) [web](https://example.org/a)", "[here](#there) [web](https://example.org/a)"),
    ("how-to/exploration.md", "![picture](../figures/exploration.png)", "![picture](../figures/exploration.png)"),
])  # fmt: skip
def test_links_lead_to_pages_of_the_site(source: str, before: str, after: str, hooks: Any) -> None:
    """Links to pages are relative to the page; other files of the repository are named."""
    known = {*hooks.ROOT_PAGES, "architecture.md", "lab/README.md", "figures/exploration.png"}
    files = SimpleNamespace(get_file_from_path=lambda path: path if path in known else None)
    page = SimpleNamespace(file=SimpleNamespace(src_uri=source))
    assert hooks.on_page_markdown(before, page, None, files) == after


def test_notebooks_are_pages(hooks: Any) -> None:
    """Texts lose their comment signs, programs become code blocks, the header of jupytext is left out."""
    text = "# ---\n# jupyter: x\n# ---\n\n# %% [markdown]\n# # Title\n#\n# A text.\n\n# %%\nprint(1)  # %% no cell\n"
    page = hooks.notebook_page(text, "some.py")
    assert page.startswith("# Title\n\nA text.\n\n*`docs/notebooks/some.py`")
    assert page.endswith("\n\n```python\nprint(1)  # %% no cell\n```\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["first_episode", "slam_on_a_log", "compare_planners"])
def test_notebooks_run(name: str, hooks: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The cells run in their order, and draw pictures."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    shown: list[Any] = []
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gcf()))
    monkeypatch.chdir(tmp_path)
    notebook = next(each for each in hooks.notebooks() if each.stem == name)
    exec(compile(notebook.read_text(encoding="utf-8"), str(notebook), "exec"), {"__name__": "__main__"})
    assert shown
    assert all(axes.has_data() for figure in shown for axes in figure.axes)
    pyplot.close("all")


@pytest.mark.slow
def test_the_site_builds_strictly(tmp_path: Path) -> None:
    """The site builds without a warning; its search finds classes, and the interface shows their docstrings."""
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed: make docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    interface = (tmp_path / "site" / "reference" / "api.html").read_text(encoding="utf-8")
    for name in ("vslam_env.vslam_v0.parallel_env", "slam_backend.FastSlam.step", "agents.make_policy"):
        assert f'id="{name}"' in interface
    assert "FastSlam" in (tmp_path / "site" / "search" / "search_index.json").read_text(encoding="utf-8")
