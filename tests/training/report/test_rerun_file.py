"""Files for the viewer rerun."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.report.rerun_file import TIMELINE, write_rerun


def test_a_file_holds_the_episode(episode: Any, tmp_path: Path) -> None:
    """Estimates, scores, maps and events come back from the file, at their times."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install .[rerun]")
    chunk = pytest.importorskip("rerun.chunk", reason="this version of rerun-sdk reads no files")
    recording = episode[2]
    file = write_rerun(recording, tmp_path / "episode.rrd")
    chunks = list(chunk.RrdReader(file).stream().to_chunks())
    rows: dict[str, list[Any]] = {}
    for each in chunks:
        rows.setdefault(each.entity_path.strip("/"), []).append(each.to_record_batch())
    robots = recording.estimate.shape[1]
    for robot in range(robots):
        for name in ("truth", "estimate", "path", "sights", "map", "candidates", "goal"):
            assert f"robots/{robot}/{name}" in rows
    assert {"world/walls", "world/landmarks", "scores/coverage", "events"} <= rows.keys()
    table = rows["scores/map_error/1"]
    (values,) = {name for name in table[0].schema.names if "Scalars" in name}
    found = np.concatenate([np.ravel(batch[values].to_pylist()) for batch in table])
    times = np.concatenate([[t.total_seconds() for t in batch[TIMELINE].to_pylist()] for batch in table])
    order = np.argsort(times)
    np.testing.assert_allclose(found[order], recording.scores[:, 1, 0], atol=1e-6)
    np.testing.assert_allclose(times[order], recording.times, atol=1e-6)


def test_other_names_and_a_missing_package_are_refused(refusal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are refused before a folder is made, with the cure."""
    monkeypatch.setattr("training.report.recording.find_spec", lambda name: None)
    assert "rerun: expected the package rerun-sdk, got no such package. Install it" in refusal(
        "run", "--rerun", "episode.rrd"
    )
    monkeypatch.setattr("training.report.recording.find_spec", lambda name: object())
    assert "rerun: expected a name that ends in .rrd, got 'episode.mp4'." in refusal("run", "--rerun", "episode.mp4")
