"""What holds for the configurations of all commands: they come back from a `config.toml`, and misspelt names do not."""

from pathlib import Path
from typing import Any

import pytest

from training.bench.accuracy.bench import AccuracyConfig
from training.bench.alignment.bench import AlignmentBenchConfig
from training.bench.alignment.mrclam import MrclamPairsConfig
from training.bench.env.bench import EnvBenchConfig
from training.bench.exploration.bench import ExplorationBenchConfig
from training.bench.filter.bench import BenchConfig
from training.bench.stereo.bench import StereoBenchConfig
from training.bench.train.bench import TrainBenchConfig
from training.episodes.config import RunConfig
from training.experiments.config import PlainConfig, check_each_once
from training.experiments.run_folder import RunFolder, read_config
from training.paper.fig1 import Fig1Config
from training.paper.fig2 import Fig2Config
from training.paper.fig3 import PairConfig
from training.paper.fig5 import Fig5Config
from training.paper.fig6.config import Fig6Config
from training.replay.kitti import KittiConfig
from training.replay.mrclam import ReplayConfig
from training.replay.stereo_images import ImagesConfig
from training.replay.stereo_pairs import PairsConfig
from training.replay.victoria import VictoriaConfig
from training.rl.config import TrainConfig
from training.rl.evaluation import EvaluateConfig

# Per class what it cannot do without, and a value that is not its default.
CASES: dict[type[PlainConfig], dict[str, Any]] = {
    AccuracyConfig: {"lengths": (5.0, 7.5)},
    AlignmentBenchConfig: {"methods": ("icp", "svd")},
    EnvBenchConfig: {"worlds": ("fig5",)},
    ExplorationBenchConfig: {"policies": ("frontier@discrete",), "worlds": ("maze",)},
    BenchConfig: {"proposals": ("fastslam1",), "large": True},
    StereoBenchConfig: {"descriptors": ("orb",)},
    TrainBenchConfig: {"workers": (0, 2)},
    EvaluateConfig: {"model": str(Path("model.npz").resolve()), "policies": ("random_goals",)},
    TrainConfig: {"preset": "smoke", "learning_rate": 1e-4},
    MrclamPairsConfig: {"path": "log", "durations": (50.0,)},
    Fig1Config: {"every": 2.5},
    Fig2Config: {"length": 25.0},
    PairConfig: {"landmarks": 40},
    Fig5Config: {"decisions": 3},
    Fig6Config: {"regimes": ("good",)},
    ImagesConfig: {"path": "images", "descriptor": "orb"},
    KittiConfig: {"path": "drive", "truth": "poses.txt"},
    ReplayConfig: {"path": "log", "robots": (1, 4), "motion": {"sigma_along": 0.125}},
    PairsConfig: {"path": "room", "max_range": 7.0},
    VictoriaConfig: {"path": "log", "sensor": {"range": 0.25}},
    RunConfig: {"world": "maze", "max_cycles": 12},
}
KINDS = [pytest.param(kind, id=kind.__name__) for kind in CASES]


def test_every_configuration_is_among_them() -> None:
    """The laws below are asked of all classes that the commands use."""
    found = {kind.__name__ for kind in PlainConfig.__subclasses__() if kind.__module__.startswith("training.")}
    assert found == {kind.__name__ for kind in CASES}


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_folder_brings_the_same_configuration_back(kind: type[PlainConfig], tmp_path: Path) -> None:
    """Values written to `config.toml` and read again make an equal configuration, tables and lists included."""
    config = kind.from_mapping(CASES[kind] | {"seed": 7})
    RunFolder.create(tmp_path / "run", "some command", config.to_mapping(), config.seed)
    values, seed = read_config(tmp_path / "run", "some command")
    assert seed == 7
    assert "seed" not in values
    assert kind.from_mapping(values | {"seed": seed}) == config


@pytest.mark.parametrize("kind", KINDS)
def test_a_misspelt_name_is_told_with_those_that_there_are(kind: type[PlainConfig]) -> None:
    """What the configuration does not know is named, and not taken for nothing."""
    with pytest.raises(ValueError, match=r"^config: expected names among .*seed.*, got 'sede'\. Correct the name\."):
        kind.from_mapping(CASES[kind] | {"sede": 1})


@pytest.mark.parametrize("values", [(), (3, 1, 3)])
def test_lists_hold_each_value_once(values: tuple[int, ...]) -> None:
    """A list without values, or with one twice, is refused by its name."""
    with pytest.raises(ValueError, match="sizes: expected at least one value, each once, got"):
        check_each_once("sizes", values)
    check_each_once("sizes", (3, 1, 2))
