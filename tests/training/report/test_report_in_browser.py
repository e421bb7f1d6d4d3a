"""Reports in a headless browser: no error, playback moves, tables and charts appear."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.training.report.test_comparison_page import bench
from training.report.page import write_report

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium is installed (Debian: apt-get install chromium)"
)
pytestmark = [pytest.mark.slow, needs_browser]


def shown(page: Path | str, fragment: str, folder: Path, *, seconds: float = 3.0) -> str:
    """Return the document of a file or address after some seconds of the browser's time.

    Any message on the console is an error.
    """
    assert BROWSER is not None
    command = [
        BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
        f"--user-data-dir={folder / 'profile'}", f"--virtual-time-budget={round(1e3 * seconds)}",
        "--run-all-compositor-stages-before-draw", "--window-size=1280,1600", "--dump-dom",
        f"{page if isinstance(page, str) else page.resolve().as_uri()}{fragment}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    messages = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    assert messages == []
    assert 'data-ready="yes"' in done.stdout
    return done.stdout


def clock(document: str) -> float:
    """Return the time that the playback shows."""
    found = re.search(r'<output id="time">([\d.]+) of ', document)
    assert found is not None
    return float(found[1])


def with_frames(page: Path) -> Path:
    """Return a copy of a page whose frames come from timers.

    Timers keep the browser's virtual time exactly; of frames it draws as many as it finds time for, often one.
    """
    frames = "<script>window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 16);</script>"
    text = page.read_text(encoding="utf-8")
    assert "<head>" in text
    copy = page.with_name("with_frames.html")
    copy.write_text(text.replace("<head>", f"<head>{frames}", 1), encoding="utf-8")
    return copy


def test_playback_moves(run: Path, tmp_path: Path) -> None:
    """A page opens at a given time; when it plays, the time advances, and the robots' errors change with it."""
    page = write_report(run)
    still = shown(page, "#t=0.5&show=grids,candidates,reckoned&hide=truth", tmp_path)
    assert clock(still) == 0.5
    assert still.count("<svg") == 4
    assert "maps of 0 and 1 merged" in still
    moved = shown(with_frames(page), "#t=0.5&play", tmp_path)
    assert clock(moved) > 1.0
    rows = [re.findall(r"<td>(?:<span[^>]*></span>)?([^<]*)</td>", text) for text in (still, moved)]
    assert rows[0] != rows[1]


PROBE = """
<body><iframe width="{width}" height="{height}"></iframe><script>
const frame = document.querySelector("iframe");
frame.srcdoc = {page};
setTimeout(() => {{
  const inside = frame.contentDocument;
  const of = (name) => [...inside.querySelectorAll(name)].map((each) => each.getBoundingClientRect());
  const found = {{
    wide: inside.documentElement.scrollWidth, controls: of("#controls")[0].bottom, stage: of("#stage")[0].bottom,
    columns: new Set(of(".chart").map((box) => Math.round(box.left))).size,
  }};
  document.body.append(JSON.stringify(found));
  document.body.dataset.ready = "yes";
}}, 2000);
</script></body>
"""


@pytest.mark.parametrize(("width", "height", "columns"), [(390, 844, 1), (1280, 720, 2)])
def test_a_page_fits_its_screen(run: Path, tmp_path: Path, width: int, height: int, columns: int) -> None:
    """On a phone and a desktop nothing is wider than the screen; the controls are on it, below the picture."""
    page = json.dumps(write_report(run).read_text(encoding="utf-8")).replace("</", "<\\/")
    probe = tmp_path / "probe.html"
    probe.write_text(PROBE.format(width=width, height=height, page=page), encoding="utf-8")
    document = shown(probe, "", tmp_path, seconds=5.0)
    found = json.loads(re.findall(r"{\"wide.*?}", document)[-1])
    assert found["wide"] <= width
    assert found["stage"] < found["controls"] <= height
    assert found["columns"] == columns


def test_benches_have_tables_and_curves(tmp_path: Path) -> None:
    """The page of a bench has a chart and a table, and no player."""
    document = shown(write_report(bench(tmp_path / "bench", "frontier", {1: 0.5, 2: 0.25})), "", tmp_path)
    assert '<section id="player" hidden' in document
    assert document.count("<svg") == 1
    assert "0.25" in document
