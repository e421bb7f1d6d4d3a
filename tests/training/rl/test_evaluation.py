"""Training and evaluation without a learner: sums over seeds, curves, refusals."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from agents import POLICIES
from training.commands.study import print_table
from training.rl import config as learn_extra
from training.rl.config import TrainConfig
from training.rl.curves import first_and_last_tenth, running_mean
from training.rl.evaluation import LAST, STUDY


def _row(policy: str, seed: int, gained: float) -> dict[str, Any]:
    return {"policy": policy, "seed": seed} | dict.fromkeys(LAST, 0.5) | {"return": gained}


def test_policies_are_compared_with_the_model_on_common_seeds() -> None:
    """Differences are means over the seeds that both played, with the share of seeds in which they are positive."""
    rows = [_row("model", seed, gained) for seed, gained in ((1, 0.4), (2, 0.1), (3, 9.0))]
    rows += [_row("frontier", seed, gained) for seed, gained in ((1, 0.2), (2, 0.3), (4, -9.0))]
    policies, differences = STUDY.tables
    assert [line["policy"] for line in policies.lines(rows)] == ["model", "frontier"]
    (line,) = differences.lines(rows)
    assert (line["policy"], line["seeds"].value, line["higher [%]"].value) == ("frontier", 2, 50.0)
    np.testing.assert_allclose(line["return [m]"], [0.0, -0.2, 0.2], atol=1e-12)


def test_equal_differences_have_an_interval_of_no_width() -> None:
    """If the difference is the same on all seeds, whatever the returns, both ends of its interval are this number."""
    rows = [_row(name, seed, seed + ahead) for seed in range(5) for name, ahead in (("model", 0.25), ("other", 0.0))]
    policies, differences = STUDY.tables
    (line,) = differences.lines(rows)
    np.testing.assert_allclose(line["return [m]"], [-0.25, -0.25, -0.25])
    assert line["higher [%]"].value == 0.0
    mean, low, high = policies.lines(rows)[0]["return [m]"]
    assert mean == pytest.approx(2.25)
    assert low < 2.25 < high


def test_the_tables_fit_into_80_columns() -> None:
    """No number is folded or cut on a terminal of 80 columns, with long names of policies, signs and hundreds."""
    names = [*POLICIES, "model"]
    rows = [_row(name, seed, 0.01 * (seed - 9)) | {"distance": 123.45} for seed in range(20) for name in names]
    console = Console(file=io.StringIO(), width=80)
    for table in STUDY.tables:
        print_table(console, table, table.lines(rows))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in text
    assert all(line.count("..") in (0, 2) for line in text.splitlines())  # both intervals of a policy side by side
    assert text.count("-0.021..0.030  0.500..0.500") == len(names)
    for part in ("random_goals", "123", "Paired differences to the model"):
        assert part in text


def test_without_a_model_there_is_no_difference() -> None:
    """Without an episode of the model there is nothing to compare with."""
    assert STUDY.tables[1].lines([_row("frontier", 1, 0.2)]) == []


def test_ends_of_curves_are_means() -> None:
    """The ends of curves are means over a tenth of the rollouts, at least one."""
    rows = [{"steps": float(step), "return": 1.0 / (1 + step)} for step in range(20)]
    assert first_and_last_tenth(rows)["first"] == {"steps": 0.5, "return": 0.75}
    assert first_and_last_tenth(rows[:3])["last"]["steps"] == 2.0


def test_running_means_look_back_only() -> None:
    """Each mean is over the last values, over fewer at the beginning."""
    values = np.arange(1.0, 8.0)
    np.testing.assert_allclose(running_mean(values, 3), [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0])


def test_rollouts_fill_the_steps() -> None:
    """Steps are rounded up to whole rollouts of one episode per robot."""
    config = TrainConfig(envs=3, robots=2, max_cycles=10, steps=61)
    assert config.rollout == 60
    assert config.updates == 2
    assert TrainConfig.from_mapping(config.to_mapping() | {"seed": 0}) == config


def test_only_families_have_splits(tmp_path: Path) -> None:
    """Families have a split for training and one for tests; a single layout has neither."""
    assert TrainConfig().make_env_config("train").world_split == "train"
    plan = tmp_path / "plan.png"
    cv2.imwrite(str(plan), np.pad(np.full((200, 300), 255, np.uint8), 5))
    assert TrainConfig(world=str(plan)).make_env_config("train").world_split is None


def test_missing_packages_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra, training names the packages to install."""
    monkeypatch.setitem(learn_extra.EXTRAS, "train", (("numpy", "a_missing_package"), "Install them."))
    with pytest.raises(
        ValueError, match=r"train: expected the packages of the extra 'train', got no a_missing_package"
    ):
        learn_extra.require_extra()
