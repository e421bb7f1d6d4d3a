"""Hooks of the site: pages of the repository's root, of notebooks and of the commands, and links to other files."""

import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
ROOT_PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "CODE_OF_CONDUCT.md")
NOTEBOOKS = ROOT / "docs" / "notebooks"
CELL = re.compile(r"^# %%(?P<kind>[^\n]*)\n", re.MULTILINE)
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s:]+)\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the root, of the notebooks and of the commands to the site."""
    from mkdocs.structure.files import File

    for name in ROOT_PAGES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for notebook in notebooks():
        content = notebook_page(notebook.read_text(encoding="utf-8"), notebook.name)
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=content))
    files.append(File.generated(config, "reference/commands.md", content=commands_page()))
    return files


def commands_page() -> str:
    """Return the page of all commands with their options and defaults."""
    import typer
    from typer.cli import get_docs_for_click

    from training.cli import app

    command = typer.main.get_command(app)
    return get_docs_for_click(obj=command, ctx=typer.Context(command, info_name="vslam"), name="vslam")


def notebooks() -> list[Path]:
    """Return the notebooks: Python files with cells, as jupytext writes and reads them."""
    return sorted(NOTEBOOKS.glob("*.py"))


def notebook_page(text: str, name: str) -> str:
    """Return the page of a notebook: its texts, and its programs as code blocks."""
    parts = CELL.split(text)[1:]
    cells = []
    for kind, cell in zip(parts[::2], parts[1::2], strict=True):
        if "markdown" in kind:
            cells.append(re.sub(r"^# ?", "", cell.strip(), flags=re.MULTILINE))
        else:
            cells.append(f"```python\n{cell.strip()}\n```")
    how = f"*`docs/notebooks/{name}`: open it in Jupyter with jupytext, or `jupytext --to ipynb {name}`.*"
    return "\n\n".join([cells[0], how, *cells[1:]]) + "\n"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Let links to files outside of `docs` lead to the pages of the root, or show the file's name."""
    source = page.file.src_uri
    folder = "" if source in ROOT_PAGES else posixpath.dirname(f"docs/{source}")

    def site_link(link: re.Match[str]) -> str:
        text, target = link.groups()
        path, mark, anchor = target.partition("#")
        if not path:
            return link[0]
        place = posixpath.normpath(posixpath.join(folder, path))
        if place in ROOT_PAGES:
            inside = place
        elif place.startswith("docs/"):
            inside = place.removeprefix("docs/")
        else:
            return f"{text} (`{place}`)" if text.strip("`") != place else text
        if files.get_file_from_path(inside) is None:  # a folder or a file that is no page
            return f"{text} (`{place}`)"
        return f"[{text}]({posixpath.relpath(inside, posixpath.dirname(source) or '.')}{mark}{anchor})"

    return LINK.sub(site_link, markdown)
