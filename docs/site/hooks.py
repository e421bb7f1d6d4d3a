"""Hooks of the site: pages made from other files, and links between pages.

Made are the pages of the repository's root, of notebooks, of commands and of public modules, and an index of each
section from the home page, `docs/README.md`. Pages outside of the menu belong to the section of their folder.
"""

import ast
import json
import os
import posixpath
import re
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
ROOT_PAGES = {  # place on the site by file
    "README.md": "overview.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md",
    "CODE_OF_CONDUCT.md": "CODE_OF_CONDUCT.md",
}  # fmt: skip
REPOSITORY = os.environ.get("GITHUB_REPOSITORY", "")  # ACCOUNT/NAME, in workflows of GitHub
LEADERBOARD = "reference/leaderboard.md"  # its tables have every word of the metrics
NOTEBOOKS = DOCS / "notebooks"
SECTION = re.compile(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
MODULE = re.compile(r"^\| `([\w.]+)` \|", re.MULTILINE)
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s:]+)\)")
SAID = re.compile(r"^#+ `(vslam [^`]+)`\n\n(.+?)\n\n", re.MULTILINE | re.DOTALL)
GROUP = re.compile(r"^\$ (vslam[\w -]*?) \[OPTIONS\] COMMAND.*?(?=^#|\Z)", re.MULTILINE | re.DOTALL)
SUMMARY = re.compile(r"^\* `([a-z][\w-]*)`: .*$", re.MULTILINE)
LONG_NAME = re.compile(r"<code>([\w.:/]{33,})</code>")
PART_END = re.compile("::|[._/]")
PAGE_NAME = re.compile(r"(?:<code>)?(docs/[\w/-]+\.md)(?:</code>)?")


def on_config(config: Any) -> Any:
    """Set the address of the site where a workflow publishes it."""
    if REPOSITORY:
        account, name = REPOSITORY.split("/")
        config.site_url = f"https://{account.lower()}.github.io/{name}/"
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made from other files."""
    from mkdocs.structure.files import File

    for name, page in ROOT_PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for page, content in made_pages().items():
        files.append(File.generated(config, page, content=content))
    return files


def made_pages() -> dict[str, str]:
    """Return paths and contents of all pages that are made here."""
    pages = {"reference/commands.md": commands_page(), **section_pages()}
    for notebook in notebooks():
        content = notebook_page(json.loads(notebook.read_text(encoding="utf-8")), notebook.name)
        pages[f"notebooks/{notebook.stem}.md"] = content
    for module in public_modules():
        pages[module_page(module)] = f"---\ntitle: {module}\n---\n::: {module}\n    options:\n      heading_level: 1\n"
    return pages


def commands_page() -> str:
    """Return the page of all commands with their options and defaults.

    Lists of commands have whole first paragraphs, of which typer leaves 45 letters.
    """
    import typer
    from typer.cli import get_docs_for_click

    from training.cli import app

    command = typer.main.get_command(app)
    text = get_docs_for_click(obj=command, ctx=typer.Context(command, info_name="vslam"), name="vslam")
    summaries = {name: " ".join(said.split()) for name, said in SAID.findall(text)}

    def with_summaries(group: re.Match[str]) -> str:
        return SUMMARY.sub(lambda line: f"* `{line[1]}`: {summaries[f'{group[1]} {line[1]}']}", group[0])

    return GROUP.sub(with_summaries, text)


def section_pages() -> dict[str, str]:
    """Return an index for each section of the home page whose pages have a folder."""
    pages = {}
    for title, text in SECTION.findall((DOCS / "README.md").read_text(encoding="utf-8")):
        folder = title.lower().replace(" ", "-")
        if (DOCS / folder).is_dir():
            pages[f"{folder}/index.md"] = f"# {title}\n" + LINK.sub(r"[\1](../\2)", text)
    return pages


def public_modules() -> list[str]:
    """Return the names of the modules that `docs/reference/api.md` lists."""
    return MODULE.findall((DOCS / "reference" / "api.md").read_text(encoding="utf-8"))


def module_page(module: str) -> str:
    """Return the path of a module's page."""
    return f"reference/api/{module}.md"


@cache
def public_names() -> dict[str, str]:
    """Return the place on the site of each name in `__all__` of a public module, the first one that has it."""
    places: dict[str, str] = {}
    for module in public_modules():
        path = ROOT.joinpath(*module.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        for statement in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
                for name in ast.literal_eval(statement.value):
                    places.setdefault(name, f"{module_page(module)}#{module}.{name}")
    return places


def notebooks() -> list[Path]:
    """Return the notebooks, as `make notebooks` writes them."""
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def notebook_page(notebook: Any, name: str) -> str:
    """Return the page of a notebook: its texts, programs and outputs, without the cell that installs the package."""
    parts = []
    for cell in notebook["cells"]:
        if "install" in cell["metadata"].get("tags", ()):
            continue
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            if picture := output.get("data", {}).get("image/png"):
                parts.append(f"![Output of the cell above](data:image/png;base64,{picture.strip()})")
            else:
                parts.append(f"```text\n{''.join(output['text'])}```")
    how = f'*A notebook: read it here, or <a href="{name}" download>download it for Jupyter</a>'
    if REPOSITORY:
        colab = f"https://colab.research.google.com/github/{REPOSITORY}/blob/main/docs/notebooks/{name}"
        how += f" or [in Colab]({colab})"
    return "\n\n".join([parts[0], how + ".*", *parts[1:]]) + "\n"


def on_nav(nav: Any, config: Any, files: Any) -> Any:
    """Let pages outside of the menu belong to the section whose index is in their folder."""
    indexes = [page for page in nav.pages if page.file.name == "index"]
    sections = {page.file.src_uri.rpartition("/")[0]: page.parent for page in indexes}
    for file in files.documentation_pages():
        if file.page not in nav.pages:
            file.page.parent = sections[file.src_uri.rpartition("/")[0].partition("/")[0]]
    return nav


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Let links to files outside of `docs` lead to the pages of the root, or to the repository, or show the name.

    A link of a public name to the page of the interface leads to that name.
    """
    source = page.file.src_uri
    here = posixpath.dirname(source) or "."
    folder = "" if source in ROOT_PAGES.values() else posixpath.dirname(f"docs/{source}")
    page.meta["tags"] = config.extra["keywords"].get(source, [])
    if page.is_homepage:
        page.meta["hide"] = ["navigation", "toc"]
    if source.startswith("lab/") or source == LEADERBOARD:
        page.meta["search"] = {"boost": 0.1}

    def site_link(link: re.Match[str]) -> str:
        text, target = link.groups()
        path, mark, anchor = target.partition("#")
        if not path:
            return link[0]
        place = posixpath.normpath(posixpath.join(folder, path))
        if place == "docs/reference/api.md" and (name := public_names().get(text.strip("`"))):
            return f"[{text}]({posixpath.relpath(name, here)})"
        inside = ROOT_PAGES.get(place, place.removeprefix("docs/").replace(".ipynb", ".md"))
        if files.get_file_from_path(inside) is not None and (place in ROOT_PAGES or place.startswith("docs/")):
            return f"[{text}]({posixpath.relpath(inside, here)}{mark}{anchor})"
        if REPOSITORY:
            return f"[{text}](https://github.com/{REPOSITORY}/blob/main/{place})"
        return f"{text} (`{place}`)" if text.strip("`") != place else text

    if source == "reference/api.md":
        markdown = MODULE.sub(lambda row: f"| [`{row[1]}`]({posixpath.relpath(module_page(row[1]), here)}) |", markdown)
    return LINK.sub(site_link, markdown)


def on_page_context(context: Any, page: Any, config: Any, nav: Any) -> Any:
    """Let names of pages, as in docstrings, be links, and let long names break between their parts."""
    pages = {f"docs/{file.src_uri}": file for file in context["pages"]}

    def page_link(name: re.Match[str]) -> str:
        file = pages.get(name[1])
        return f'<a href="{file.url_relative_to(page.file)}">{file.page.title}</a>' if file else name[0]

    content = PAGE_NAME.sub(page_link, page.content)
    page.content = LONG_NAME.sub(lambda name: "<code>" + PART_END.sub(r"\g<0><wbr>", name[1]) + "</code>", content)
    return context
