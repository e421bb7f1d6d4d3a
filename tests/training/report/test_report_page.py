"""Pages of reports: self-contained, exact, and safe against texts of a run."""

import base64
import json
import re
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.experiments.run_folder import METRICS_FILE, RunFolder
from training.report.content import Content, curve_charts, folder_content, table
from training.report.packing import Packer
from training.report.page import render, write_report
from training.report.recording import RECORDING_FILE, Recording

HOSTILE = "</script><img src=x onerror=alert(1)>\u2028&amp;"


class Page(HTMLParser):
    """Elements of a page, with the text of each script by id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self._script: str | None = None
        self.feed(text)
        self.data = json.loads(self.scripts["data"])
        self._bytes = zlib.decompress(base64.b64decode(self.scripts["arrays"]))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element."""
        self.tags.append((tag, dict(attrs)))
        self._script = dict(attrs).get("id") or "program" if tag == "script" else None

    def handle_endtag(self, tag: str) -> None:
        """Note the end of a script."""
        self._script = None

    def handle_data(self, data: str) -> None:
        """Note the text of a script."""
        if self._script is not None:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data

    def array(self, about: dict[str, Any]) -> Any:
        """Return a packed array, as the program of the page decodes it."""
        kind = {"u8": "u1", "i32": "<i4", "i16": "<i2"}[about["kind"]]
        found = np.frombuffer(self._bytes, kind, about["size"], about["begin"])
        if kind != "<i2":
            return found
        return np.where(found == -32768, np.nan, found * about["scale"] + about["offset"])


def test_a_page_needs_no_network_and_is_small(run: Path) -> None:
    """One file without references to other files or hosts, which its policy forbids, too."""
    text = write_report(run).read_text()
    assert len(text) < 500_000
    page = Page(text)
    for tag, attributes in page.tags:
        assert not attributes.keys() & {"src", "href", "srcset"}, tag
    (policy,) = [a["content"] for _, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    program = page.scripts["program"]
    assert not re.search(
        r"fetch\(|XMLHttpRequest|import\(|innerHTML|eval\(|https?://(?!www\.w3\.org/2000/svg)", program
    )


def test_arrays_of_a_page_are_those_of_the_recording(run: Path) -> None:
    """Numbers are exact to a 65,000th of their range, integers exactly."""
    page, recording = Page(write_report(run).read_text()), Recording.load(run)
    arrays = page.data["episode"]["arrays"]
    for name, values in (
        ("times", recording.times), ("truth", recording.truth), ("estimate", recording.estimate),
        ("errors", recording.scores[..., 0]), ("mapXY", recording.map_points[:, :2]), ("sights", recording.sights),
        ("walls", recording.walls), ("starts", recording.starts), ("candidateXY", recording.candidates[:, :2]),
    ):  # fmt: skip
        step = float(np.ptp(values)) / 65_000
        np.testing.assert_allclose(page.array(arrays[name]), values.ravel(), atol=step + 1e-7)
    for name, values in (
        ("keyframes", recording.keyframes), ("mapEnds", recording.map_ends), ("gridRuns", recording.grid_runs),
        ("gridValues", recording.grid_values), ("gridEnds", recording.grid_ends), ("frames", recording.frames),
    ):  # fmt: skip
        np.testing.assert_array_equal(page.array(arrays[name]), values.ravel())
    assert page.data["episode"]["events"] == list(recording.about["events"])


def test_charts_have_errors_bands_and_coverage(run: Path) -> None:
    """E of each robot, its parts, coverage, and position errors with the radius that holds 95 %."""
    page, recording = Page(write_report(run).read_text()), Recording.load(run)
    charts = {chart["title"]: chart for chart in page.data["charts"]}
    assert list(charts) == ["map error E", "parts of E², mean over robots", "coverage", "position error"]
    assert [line["name"] for line in charts["map error E"]["lines"]] == ["robot 0", "robot 1"]
    top = page.array(charts["parts of E², mean over robots"]["lines"][-1]["high"])
    np.testing.assert_allclose(top, (recording.scores[..., 0].astype(float) ** 2).mean(axis=1), atol=2e-5)
    line = charts["position error"]["lines"][1]
    off = np.hypot(*(recording.estimate - recording.truth)[:, 1, :2].T)
    np.testing.assert_allclose(page.array(line["y"]), off, atol=1e-5)
    xx, xy, yy = recording.covariances[:, 1].astype(float).T
    largest = np.array([np.linalg.eigvalsh([[a, b], [b, c]])[1] for a, b, c in zip(xx, xy, yy, strict=True)])
    np.testing.assert_allclose(page.array(line["high"]), np.sqrt(5.991 * np.maximum(largest, 0.0)), atol=1e-4)


def test_texts_of_a_run_cannot_become_html(tmp_path: Path) -> None:
    """Names, options and cells with markup end no script and add no element; they come back unchanged."""
    folder = RunFolder.create(tmp_path / "run", "bench exploration", {"policies": [HOSTILE]}, 0)
    folder.write_metrics({"summary": [{"policy": HOSTILE, "coverage": 0.5}], HOSTILE: [{HOSTILE: 1}], "note": HOSTILE})
    rows = f'policy,time_s,coverage\n"{HOSTILE}",0,0.5\n"{HOSTILE}",1,0.6\n'.replace("\u2028", "")
    folder.write_text("curves.csv", rows)
    page = Page(write_report(folder.path).read_text())
    assert [tag for tag, _ in page.tags].count("script") == 3
    assert "img" not in [tag for tag, _ in page.tags]
    assert page.data["tables"][0]["rows"][0][0][0] == HOSTILE
    assert HOSTILE in dict(map(tuple, page.data["about"])).values()


def test_a_title_is_escaped() -> None:
    """The title is the only text that is part of the HTML."""
    page = Page(render(Content(title=HOSTILE)))
    assert page.data["title"] == HOSTILE
    assert "img" not in [tag for tag, _ in page.tags]


def test_tables_join_intervals_and_leave_curves_out() -> None:
    """Mean and interval share a cell that sorts by the mean; unknown values are dashes; curves are left out."""
    rows = [
        {"policy": "a", "map_error": 0.5, "map_error_low": 0.4, "map_error_high": 0.625, "curves": {"time_s": [0]}},
        {"policy": "b", "map_error": None, "map_error_low": None, "map_error_high": None, "right": True},
    ]
    made = table("summary", "", rows)
    assert made["headings"] == ["policy", "map error E [m]", "right"]
    assert made["rows"][0] == [["a", "a"], ["0.5\n(0.4 .. 0.625)", 0.5], ["-", None]]
    assert made["rows"][1] == [["b", "b"], ["-", None], ["yes", "yes"]]
    assert "0.71 m = nothing found" in made["note"]


def test_columns_have_words_units_and_three_digits() -> None:
    """No heading is a key of `metrics.json`; shares are percentages; empty columns are left out."""
    rows: list[dict[str, Any]] = [
        {"robots_a": [0, 2], "ess_share": 0.0123456, "path_m": 1234.567, "frames": 12345, "excess": None, "missed": ""},
        {"robots_a": [1], "ess_share": 1.0, "path_m": 0.123456, "frames": 7, "excess": None, "missed": ""},
    ]
    made = table("some", "", rows)
    assert made["headings"] == ["first map", "frames with few particles [%]", "path length [m]", "frames"]
    assert [[text for text, _ in row] for row in made["rows"]] == [
        ["0, 2", "1.23", "1235", "12345"], ["1", "100", "0.123", "7"],
    ]  # fmt: skip


def test_tables_of_a_study_have_intervals_in_the_unit_of_their_headings(tmp_path: Path) -> None:
    """The page of a study shows its tables as the console does, before its trials."""
    folder = RunFolder.create(tmp_path / "run", "bench exploration", {}, 0)
    line = {"policy": "a", "E [cm]": 25.0, "E [cm] low": 12.5, "E [cm] high": 37.5}
    folder.write_metrics({"tables": {"maps": [line]}, "trials": [{"policy": "a", "map_error": 0.25}]})
    tables = Page(write_report(folder.path).read_text()).data["tables"]
    assert [made["title"] for made in tables] == ["maps", "trials"]
    assert tables[0]["headings"] == ["policy", "E [cm]"]
    assert tables[0]["rows"] == [[["a", "a"], ["25\n(12.5 .. 37.5)", 25.0]]]


def test_tables_of_a_run_have_no_keys_as_headings(run: Path) -> None:
    """All columns of robots, merges, attempts and consistency have words, and no more than three digits."""
    tables = Page(write_report(run).read_text()).data["tables"]
    keys = {key for rows in json.loads((run / METRICS_FILE).read_text()).values() if isinstance(rows, list)
            for row in rows if isinstance(row, dict) for key in row}  # fmt: skip
    unchanged = {"robot", "frames", "step", "warnings", "landmarks", "false", "verdict"}
    for made in tables:
        for title in made["headings"]:
            assert title.split(" [")[0] not in {key.replace("_", " ") for key in keys} - unchanged
        for row in made["rows"]:
            for text, value in row:
                if isinstance(value, float):
                    assert len(text.lstrip("-0.").replace(".", "")) <= 3 or value >= 1000


def test_curves_have_a_line_for_each_policy() -> None:
    """Rows of a bench become a chart for each place and metric, with intervals, and labels of policies."""
    ends = {"map_error": "0.5", "map_error_low": "0.25", "map_error_high": "0.75"}
    rows = [
        {"world": world, "policy": policy, "time_s": time, **ends}
        for world in ("office", "maze") for policy in ("mine=m:Own", "frontier") for time in ("0", "10")
    ]  # fmt: skip
    charts = curve_charts(rows, Packer())
    assert [chart["title"] for chart in charts] == ["map error E: world office", "map error E: world maze"]
    assert [line["name"] for line in charts[0]["lines"]] == ["mine", "frontier"]
    assert all({"x", "y", "low", "high"} <= line.keys() for line in charts[0]["lines"])


def test_packed_numbers_keep_their_range_and_nan() -> None:
    """Constant, empty and missing values survive; arrays are aligned to four bytes."""
    packer = Packer()
    given: list[Any] = [[1.5], [], [np.nan, 2.0, -3.0], [7.0, 7.0, 7.0], np.linspace(-200.0, 200.0, 999)]
    about = [packer.add(values) for values in given] + [
        packer.add_integers([1, 2, 255]),
        packer.add_integers([-1, 700]),
    ]
    content = Content(title="arrays", packer=packer)
    page = Page(render(content))
    for values, where in zip(given, about, strict=False):
        np.testing.assert_allclose(page.array(where), values, atol=400.0 / 65_000)
        assert where["begin"] % 4 == 0
    assert page.array(about[-2]).tolist() == [1, 2, 255]
    assert page.array(about[-1]).tolist() == [-1, 700]


def test_grids_of_large_worlds_are_thinned(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where grids have too many cells, every n-th is kept, with the last."""
    recording = Recording.load(run)
    areas = recording.grid_boxes[..., 2] * recording.grid_boxes[..., 3]
    monkeypatch.setattr("training.report.content.CELLS", int(areas.sum() / 3))
    content = folder_content(run)
    assert content.episode is not None
    page = Page(render(content))
    arrays = page.data["episode"]["arrays"]
    ends = page.array(arrays["gridEnds"]).reshape(recording.grid_ends.shape)
    kept = np.diff(ends.ravel(), prepend=0).reshape(ends.shape)
    whole = np.diff(recording.grid_ends.ravel(), prepend=0).reshape(ends.shape)
    assert (kept[-1] == whole[-1]).all()
    assert 0.2 < (kept > 0).sum() / (whole > 0).sum() < 0.6
    assert len(page.array(arrays["gridRuns"])) == ends[-1, -1]


@pytest.mark.parametrize(("name", "text", "error"), [
    ("config.toml", "= broken", "folder: expected a file in TOML, got a syntax error"),
    (METRICS_FILE, "{", "folder: expected a file in JSON, got a syntax error"),
    (RECORDING_FILE, "x", "folder: expected a recording of an episode, got a broken file"),
])  # fmt: skip
def test_damaged_folders_are_refused(name: str, text: str, error: str, run: Path) -> None:
    """A damaged file is refused by name, and no page is written."""
    (run / name).write_text(text)
    with pytest.raises(ValueError, match=error):
        write_report(run)
    assert not (run / "report.html").exists()


def test_the_command_repeats_a_report(run: Path, vslam: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """`vslam report` writes the same page again, and opens it if asked; other folders are refused."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    first = write_report(run).read_text()
    assert vslam("report", str(run)).status == 0
    assert opened == []
    said = vslam("report", str(run), "--open")
    assert said.status == 0
    assert f"Report: {run / 'report.html'}" in said.out.replace("\n", "")
    assert opened == [(run / "report.html").as_uri()]
    assert (run / "report.html").read_text() == first
    said = vslam("report", str(run.parent))
    assert said.status == 2
    assert "folder: expected the folder of a run, with config.toml, got no such folder" in said.err
