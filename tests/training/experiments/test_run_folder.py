import json
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.trajectory import Trajectory
from training.experiments.run_folder import METRICS_FILE, RunFolder, plain, read_config, read_versions


@dataclass(frozen=True)
class Trial:
    """Trial identified by its seed."""

    seed: int


def test_a_run_can_be_read_back(tmp_path: Path) -> None:
    """Config and seed are restored; None means not given; versions are recorded."""
    config = {"path": tmp_path, "robots": (1, 3), "duration": None, "motion": {"sigma_along": np.float64(0.25)}}
    folder = RunFolder.create(tmp_path / "new" / "run", "replay mrclam", config, seed=7)
    expected = {"path": str(tmp_path), "robots": [1, 3], "motion": {"sigma_along": 0.25}}
    for path in (folder.path, folder.path / "config.toml"):
        assert read_config(path, "replay mrclam") == (expected, 7)
    content = tomllib.loads((folder.path / "config.toml").read_text())
    assert content["versions"]["numpy"] == np.__version__


def test_folders_without_a_name_never_collide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each run takes the next free number."""
    monkeypatch.chdir(tmp_path)
    names = [str(RunFolder.create(None, "replay mrclam", {}, seed=2).path) for _ in range(3)]
    assert names == [f"runs/replay-mrclam-2-{n}" for n in (1, 2, 3)]


def test_only_empty_folders_are_accepted(tmp_path: Path) -> None:
    """No file is ever overwritten."""
    (tmp_path / "empty").mkdir()
    RunFolder.create(tmp_path / "empty", "run", {}, seed=0)
    with pytest.raises(ValueError, match=r"out: expected a new or empty folder, got a folder with files\."):
        RunFolder.create(tmp_path / "empty", "run", {}, seed=0)
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="out: expected a new or empty folder, got a file"):
        RunFolder.create(tmp_path / "file", "run", {}, seed=0)
    with pytest.raises(
        ValueError, match=r"out: expected a folder that can be written, got '.*below'\. The system says: Not a"
    ):
        RunFolder.create(tmp_path / "file" / "below", "run", {}, seed=0)
    with pytest.raises(ValueError, match="seed: expected an int >= 0, got -1"):
        RunFolder.create(tmp_path / "other", "run", {}, seed=-1)
    assert not (tmp_path / "other").exists()


def test_metrics_are_valid_json(tmp_path: Path) -> None:
    """Values that are not finite become null, and no partial file exists at any time."""
    folder = RunFolder.create(tmp_path / "run", "run", {"world": "office"}, seed=3)
    folder.write_metrics({"coverage": float("nan"), "robots": [{"ate_aligned_m": np.float64(0.5)}]})
    written = folder.write_metrics({"coverage": np.inf, "matrix": np.arange(2)})
    content = json.loads((folder.path / METRICS_FILE).read_text())
    assert content == written
    assert content["coverage"] is None
    assert content["matrix"] == [0, 1]
    assert content["config"] == {"world": "office"}
    assert content["seed"] == 3
    assert sorted(file.name for file in folder.path.iterdir()) == ["config.toml", "metrics.json"]


def test_paths_are_written_as_tum(tmp_path: Path) -> None:
    """A path is restored bit by bit."""
    path = Trajectory([1.0, 2.5], [[0.1, 0.2, 0.0], [0.3, 0.4, 0.0]])
    file = RunFolder.create(tmp_path / "run", "run", {}, seed=0).write_trajectory("robot1_estimate", path)
    assert file.name == "robot1_estimate.tum"
    assert np.array_equal(Trajectory.load_tum(file).poses, path.poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"config: expected the config\.toml of an earlier run, got no such file\. Check '.*config\.toml'"),
        ("seed = = 1", r"got a syntax error: .*Correct line 1, column 8 of .*config\.toml"),
        ('command = "run"', r"config: expected a run of 'replay mrclam', got 'run'"),
        ('command = "replay mrclam"', r"config: expected a table \[config\] and an int seed"),
    ],
)
def test_invalid_configs_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    """A missing, broken or foreign config has one clear error."""
    file = tmp_path / "config.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_config(file, "replay mrclam")


def test_configs_are_read_as_editors_save_them(tmp_path: Path) -> None:
    """A byte order mark and lines that end with CRLF change nothing."""
    folder = RunFolder.create(tmp_path / "run", "run", {"world": "office"}, seed=3)
    expected, text = read_config(folder.path, "run"), (folder.path / "config.toml").read_text()
    (folder.path / "config.toml").write_text(text, encoding="utf-8-sig", newline="\r\n")
    assert read_config(folder.path, "run") == expected
    assert read_versions(folder.path) == folder.versions


def test_write_errors_name_the_option(tmp_path: Path) -> None:
    """A file in a deleted folder is refused as `out`, with the reason."""
    folder = RunFolder.create(tmp_path / "run", "run", {}, seed=0)
    shutil.rmtree(folder.path)
    with pytest.raises(
        ValueError, match=r"out: expected a file that can be written, got .*\. The system says: No such"
    ):
        folder.write_metrics({})


values = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(values)
def test_plain_values_survive_json(value: object) -> None:
    """Plain values survive JSON unchanged, and conversion is idempotent."""
    once = plain(value)
    assert json.loads(json.dumps(once, allow_nan=False)) == once
    assert plain(once) == once


def test_a_folder_of_another_format_is_refused(tmp_path: Path) -> None:
    """A configuration states the format of the folder; without one it is the current format."""
    folder = RunFolder.create(tmp_path / "run", "run", {"many": 3}, 1)
    file = folder.path / "config.toml"
    text = file.read_text()
    assert text.startswith("format = 1\n")
    file.write_text(text.removeprefix("format = 1\n"))
    assert read_config(file, "run") == ({"many": 3}, 1)
    file.write_text(text.replace("format = 1", "format = 7", 1))
    with pytest.raises(ValueError, match=r"config: expected one of format 1, got a run folder of format 7\. Use the"):
        read_config(folder.path, "run")
