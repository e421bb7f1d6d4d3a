"""The site: a short menu, all pages within reach, links that lead somewhere, and pages made from other files."""

import json
import posixpath
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from builders.scripts import load_script

from tests.regression.public_api import MODULES, PACKAGES

ROOT = Path(__file__).parents[2]
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
SETTINGS = SimpleNamespace(extra=CONFIG["extra"])


def pages(nav: Any) -> list[str]:
    """Return the pages of a part of the menu."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages(part)]


class References(HTMLParser):
    """Collector of the links and anchors of a page of the site."""

    def __init__(self, file: Path) -> None:
        """Read a page."""
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the targets and the names of a tag."""
        for key, value in attrs:
            if value and key in ("href", "src"):
                self.links.add(value)
            elif value and (key == "id" or (tag == "a" and key == "name")):
                self.anchors.add(value)


@pytest.fixture(scope="module")
def hooks() -> Any:
    """Return the hooks of the site, which need no mkdocs to be imported."""
    module = load_script(ROOT / CONFIG["hooks"][0])
    module.REPOSITORY = ""  # also in a workflow
    return module


@pytest.fixture(scope="module")
def sources(hooks: Any) -> dict[str, str]:
    """Return the text of each page of the site by its path there."""
    own = {page.relative_to(ROOT / "docs").as_posix(): page for page in (ROOT / "docs").rglob("*.md")}
    files = own | {page: ROOT / name for name, page in hooks.ROOT_PAGES.items()}
    return {page: file.read_text(encoding="utf-8") for page, file in files.items()} | hooks.made_pages()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed: make docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def rendered(hooks: Any, source: str, text: str, known: Any) -> str:
    """Return a page after the hook on its links, for a site with the known pages and files."""
    files = SimpleNamespace(get_file_from_path=lambda path: path if path in known else None)
    page = SimpleNamespace(file=SimpleNamespace(src_uri=source), meta={}, is_homepage=source == "README.md")
    made: str = hooks.on_page_markdown(text, page, SETTINGS, files)
    return made


def test_the_menu_is_short(sources: dict[str, str]) -> None:
    """The menu has at most 30 entries below its sections, each a page of its own; the gallery is the second."""
    menu = pages(CONFIG["nav"])
    assert len(menu) == len(set(menu))
    assert sum(not page.endswith("/index.md") for page in menu) <= 30
    assert set(menu) <= set(sources)
    assert menu[:2] == ["README.md", "gallery.md"]
    assert [page for page in menu if page.startswith("lab/")] == ["lab/README.md"]


def test_all_pages_are_in_reach(hooks: Any, sources: dict[str, str]) -> None:
    """From the menu, links lead to every page; the home page lists all but modules, laboratory and indexes."""

    def linked(page: str) -> set[str]:
        text = rendered(hooks, page, sources[page], sources)
        targets = [target.partition("#")[0] for _, target in hooks.LINK.findall(text)]
        return {posixpath.normpath(posixpath.join(posixpath.dirname(page), target)) for target in targets}

    reached, new = set(), set(pages(CONFIG["nav"]))
    while new:
        reached |= new
        new = {target for page in new for target in linked(page) if target in sources} - reached
    assert set(sources) - reached == set()
    other = ("lab/", "reference/api/", "README.md", "reference/commands.md")
    listed = {page for page in sources if not page.startswith(other) and not page.endswith("/index.md")}
    assert listed - linked("README.md") == set()


def test_the_interface_has_all_public_modules(hooks: Any, sources: dict[str, str]) -> None:
    """Each public module has a page, which the page on the interface lists."""
    assert {*PACKAGES, *MODULES} <= set(hooks.public_modules())
    text = rendered(hooks, "reference/api.md", sources["reference/api.md"], sources)
    for module in hooks.public_modules():
        assert f"\n::: {module}\n" in sources[f"reference/api/{module}.md"]
        assert f"| [`{module}`](api/{module}.md) |" in text


def test_keywords_name_pages_with_these_words(sources: dict[str, str]) -> None:
    """The search shows a page first only for words that the page has."""
    for page, words in CONFIG["extra"]["keywords"].items():
        assert all(word in sources[page] for word in words)


def test_the_page_of_commands_has_all_options(hooks: Any) -> None:
    """Each command is a section, and is listed with what it says of itself; options have their defaults."""
    text = hooks.commands_page()
    assert "* `merge`: Align two landmark maps from files and merge them, or say why not." in text
    assert {"## `vslam run`", "### `vslam bench exploration`", "## `vslam evaluate`"} <= set(text.splitlines())
    own = text.split("## `vslam evaluate`")[1].split("\n## ")[0]
    assert "* `--world-split <str>`: Split of the worlds: validation or test.  [default: (validation)]" in own


@pytest.mark.parametrize(("source", "before", "after"), [
    ("how-to/robots.md", "[add](../../CONTRIBUTING.md#a-world-family)", "[add](../CONTRIBUTING.md#a-world-family)"),
    ("lab/code.md", "[`Policy`](../reference/api.md)", "[`Policy`](../reference/api/agents.md#agents.Policy)"),
    ("how-to/bags.md", "[interface](../reference/api.md)", "[interface](../reference/api.md)"),
    ("tutorials/own_log.md", "[example](../../examples/own_log.py)", "example (`examples/own_log.py`)"),
    ("tutorials/own_log.md", "[`examples/own_log.py`](../../examples/own_log.py)", "`examples/own_log.py`"),
    ("README.md", "[lab](lab/README.md)", "[lab](lab/README.md)"),
    ("README.md", "[one](notebooks/one.ipynb)", "[one](notebooks/one.md)"),
    ("CONTRIBUTING.md", "[site](docs/architecture.md#x)", "[site](architecture.md#x)"),
    ("overview.md", "[how](CONTRIBUTING.md#x)", "[how](CONTRIBUTING.md#x)"),
    ("overview.md", "[site](docs/lab/README.md)", "[site](lab/README.md)"),
    ("architecture.md", "[why](../README.md#cite)", "[why](overview.md#cite)"),
    ("reference/results.md", "[here](#there) [web](https://example.org/a)", "[here](#there) [web](https://example.org/a)"),
    ("how-to/exploration.md", "![picture](../figures/exploration.png)", "![picture](../figures/exploration.png)"),
])  # fmt: skip
def test_links_lead_to_pages_of_the_site(source: str, before: str, after: str, hooks: Any) -> None:
    """Links to pages are relative to the page; other files of the repository are named."""
    pages = {"architecture.md", "lab/README.md", "notebooks/one.md", "reference/api.md", "figures/exploration.png"}
    known = pages.union(hooks.ROOT_PAGES.values())
    assert rendered(hooks, source, before, known) == after


def test_long_names_break_between_their_parts(hooks: Any) -> None:
    """In code, a name of more than 32 letters may break after its points and underscores, a shorter one nowhere."""
    page = SimpleNamespace(content="<code>maps.fuse</code> <code>team.filter_merging.landmarks.write_joint</code>")
    hooks.on_page_context({"pages": []}, page, None, None)
    long = "team.<wbr>filter_<wbr>merging.<wbr>landmarks.<wbr>write_<wbr>joint"
    assert page.content == f"<code>maps.fuse</code> <code>{long}</code>"


def test_a_workflow_links_to_its_repository(hooks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a workflow of GitHub links lead to files of the repository and to Colab, and the site knows its address."""
    monkeypatch.setattr(hooks, "REPOSITORY", "Someone/vslam_env")
    text = rendered(hooks, "tutorials/own_log.md", "[example](../../examples/own_log.py)", ())
    assert text == "[example](https://github.com/Someone/vslam_env/blob/main/examples/own_log.py)"
    assert hooks.on_config(SETTINGS).site_url == "https://someone.github.io/vslam_env/"
    page = hooks.made_pages()["notebooks/first_episode.md"]
    assert "colab.research.google.com/github/Someone/vslam_env/blob/main/docs/notebooks/first_episode.ipynb" in page


def test_notebooks_are_pages(hooks: Any) -> None:
    """Programs become code blocks, outputs follow, and the cell that installs the package is left out."""
    outputs = [{"text": ["1\n"]}, {"data": {"image/png": "AAAA\n"}}]
    cells = [
        {"cell_type": "code", "source": ["%pip\n"], "metadata": {"tags": ["install"]}},
        {"cell_type": "markdown", "source": ["# Title\n", "\n", "A text."], "metadata": {}},
        {"cell_type": "code", "source": ["print(1)"], "metadata": {}, "outputs": outputs},
    ]
    page = hooks.notebook_page({"cells": cells}, "some.ipynb")
    assert page.startswith('# Title\n\nA text.\n\n*A notebook: read it here, or <a href="some.ipynb" download>')
    shown = "```python\nprint(1)\n```\n\n```text\n1\n```\n\n![Output of the cell above](data:image/png;base64,AAAA)\n"
    assert page.endswith(f"*\n\n{shown}")


@pytest.mark.slow
def test_the_site_shows_the_interface(site: Path) -> None:
    """The site builds without a warning; the interface shows docstrings, and the search finds classes and keywords."""
    for page, name in (("vslam_env.vslam_v0", "parallel_env"), ("slam_backend", "FastSlam.step"), ("agents", "Policy")):
        assert f'id="{page}.{name}"' in (site / "reference" / "api" / f"{page}.html").read_text(encoding="utf-8")
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))["docs"]
    assert any("FastSlam" in entry["title"] for entry in index)
    tags = {entry["location"]: entry["tags"] for entry in index if entry.get("tags") and "#" not in entry["location"]}
    assert tags == {page.replace(".md", ".html"): words for page, words in CONFIG["extra"]["keywords"].items()}


@pytest.mark.slow
def test_links_of_the_site_lead_somewhere(site: Path) -> None:
    """Every link within the site has its file, and its anchor there."""
    found = {file: References(file) for file in site.rglob("*.html") if file.name != "404.html"}
    broken = []
    for file, references in found.items():
        for link in references.links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            target = target / "index.html" if target.is_dir() else target
            anchor = unquote(parts.fragment)
            if not target.is_file() or (anchor and target in found and anchor not in found[target].anchors):
                broken.append(f"{file.relative_to(site)}: {link}")
    assert len(found) > 50
    assert broken == []
