"""Pages of reports: HTML, style and program in one file that needs no network."""

import json
import re
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from slam_backend.core.files import write_file
from training.report.content import Content, folder_content

REPORT_FILE = "report.html"
SLOT = re.compile(r"\{\{(\w+)\}\}")


def render(content: Content, live: bool = False) -> str:
    """Return the page; all texts of the run are data, which the page shows as text and never as HTML.

    Args:
        content: Content of the page.
        live: Whether the page asks its server for newer content; otherwise it may not use the network.
    """
    parts = {
        "connect": "; connect-src 'self'" if live else "",
        "live": f"<script>\n{_asset('live.js')}</script>" if live else "",
        "title": escape(content.title), "style": _asset("report.css"), "program": _asset("report.js"),
        "data": _as_script(content.to_mapping()), "arrays": content.packer.text(),
    }  # fmt: skip
    return SLOT.sub(lambda slot: parts[slot[1]], _asset("report.html"))


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run folder, from the other files in it.

    Raises:
        ValueError: If it is not a run folder, a file in it is damaged, or the report cannot be written.
    """
    return write_file(folder / REPORT_FILE, render(folder_content(folder)), "out")


def _asset(name: str) -> str:
    return (files("training.report") / "assets" / name).read_text(encoding="utf-8")


def _as_script(value: Any) -> str:
    r"""Return plain values as JSON that cannot end the script element around it.

    >>> print(_as_script("</script>"))
    "\u003c/script>"
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
