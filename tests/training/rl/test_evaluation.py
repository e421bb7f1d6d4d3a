"""Training and evaluation without a learner: sums over seeds, curves, refusals."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from agents import POLICIES
from training.rl import config as learn_extra
from training.rl.config import TrainConfig
from training.rl.curves import first_and_last_tenth, running_mean, to_csv
from training.rl.evaluation import FIGURES, leads, print_evaluation, summarise


def _row(policy: str, seed: int, gained: float) -> dict[str, Any]:
    return {"policy": policy, "seed": seed} | dict.fromkeys(FIGURES, 0.5) | {"return": gained}


def test_leads_are_paired_over_the_seeds_that_both_played() -> None:
    """The lead is the mean of the differences on common seeds; other seeds do not count."""
    rows = [_row("model", seed, gained) for seed, gained in ((1, 0.4), (2, 0.1), (3, 9.0))]
    rows += [_row("frontier", seed, gained) for seed, gained in ((1, 0.2), (2, 0.3), (4, -9.0))]
    (lead,) = leads(rows)
    assert lead["over"] == "frontier"
    assert lead["seeds"] == 2
    assert lead["lead"] == pytest.approx(0.0)
    assert lead["won"] == 0.5
    assert lead["lead_low"] == pytest.approx(-0.2)
    assert lead["lead_high"] == pytest.approx(0.2)


def test_equal_differences_have_an_interval_of_no_width() -> None:
    """If the lead is the same on all seeds, whatever the returns, both ends of the interval are this lead."""
    rows = [_row(name, seed, seed + ahead) for seed in range(5) for name, ahead in (("model", 0.25), ("other", 0.0))]
    (lead,) = leads(rows)
    np.testing.assert_allclose([lead["lead"], lead["lead_low"], lead["lead_high"]], 0.25)
    assert lead["won"] == 1.0
    model, other = summarise(rows)
    assert (model["policy"], other["policy"]) == ("model", "other")
    assert model["return"] == pytest.approx(2.25)
    assert model["return_low"] < 2.25 < model["return_high"]


@pytest.mark.parametrize(("split", "worlds"), [("test", "Worlds of the test split"), (None, "One building")])
def test_the_table_fits_into_80_columns(split: str | None, worlds: str) -> None:
    """Nothing is wrapped or cut on a terminal of 80 columns, with long names of policies, signs and hundreds."""
    rows = [_row(name, seed, 0.01 * (seed - 9)) | {"distance": 123.45} for seed in range(20) for name in POLICIES]
    rows += [_row("model", seed, -0.25) for seed in range(20)]
    console = Console(file=io.StringIO(), width=80)
    print_evaluation(console, summarise(rows), [], split)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in text
    assert all(line.count("..") in (0, 2) for line in text.splitlines())  # both intervals of a policy side by side
    for part in ("random_goals", "-0.250..-0.250", "123.45", f"{worlds}, 20 episodes of each policy"):
        assert part in text


def test_without_a_model_there_is_no_lead() -> None:
    """Without an episode of the model there is no lead."""
    assert leads([_row("frontier", 1, 0.2)]) == []


def test_curves_have_a_line_per_rollout() -> None:
    """The CSV has a header and a line per rollout; the ends are means over a tenth, at least one rollout."""
    rows = [{"steps": float(step), "return": 1.0 / (1 + step)} for step in range(20)]
    lines = to_csv(rows).splitlines()
    assert lines[0] == "steps,return"
    assert lines[3] == "2,0.333333"
    assert len(lines) == 21
    assert first_and_last_tenth(rows)["first"] == {"steps": 0.5, "return": 0.75}
    assert first_and_last_tenth(rows[:3])["last"]["steps"] == 2.0
    assert to_csv([]) == "\n"


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
    monkeypatch.setattr(learn_extra, "NEEDED", ("numpy", "a_missing_package"))
    with pytest.raises(
        ValueError, match=r"train: expected the packages of the extra 'train', got no a_missing_package"
    ):
        learn_extra.require_extra()
