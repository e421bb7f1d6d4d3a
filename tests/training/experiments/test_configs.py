"""Common behaviour of all configurations: restored from a `config.toml`, with bad values refused."""

from pathlib import Path
from typing import Any, get_args

import pytest

from slam_backend.fastslam.options import PROPOSALS
from slam_backend.frontend import DESCRIPTORS
from slam_backend.maps.alignment import METHODS
from slam_backend.readers.stereo_files import StereoFiles
from studies.filters import accuracy, losses
from studies.front_end import stereo
from studies.learning import speed as training_speed
from studies.merging import alignment, mrclam_pairs
from training.bench.exploration import config as exploration
from training.bench.speed import config as speed
from training.dataset.config import RecordConfig
from training.episodes.config import RunConfig
from training.experiments import config as experiments
from training.experiments.config import ExperimentConfig
from training.experiments.run_folder import RunFolder, read_config
from training.paper import config as paper
from training.paper.fig6.trials import REGIMES
from training.replay import config as replay
from training.rl.batched_config import BatchedTrainConfig
from training.rl.config import TRAIN_PRESETS, EvaluateConfig, TrainConfig
from training.stereo_runs import runs
from vslam_env.config import ACTION_TYPES, MAX_ROBOTS, SENSORS
from vslam_env.presets import NOISE_PRESETS, PRESETS
from vslam_env.world import SPLITS

# Required values of each class, and a value that differs from its default.
CASES: dict[type[ExperimentConfig], dict[str, Any]] = {
    accuracy.Config: {"lengths": (5.0, 7.5)}, losses.Config: {"worlds": ("fig5",), "presets": ("hard",)},
    speed.EnvSpeedConfig: {"worlds": ("fig5",)},
    exploration.ExplorationConfig: {"policies": ("frontier@discrete",), "worlds": ("maze",)},
    speed.FilterSpeedConfig: {"proposals": ("fastslam1",), "large": True},
    exploration.PlanConfig: {"plan": "vslam-bench-v1", "policies": ("frontier",), "tracks": ("hard",)},
    speed.BatchedSpeedConfig: {"batches": (8, 16), "rows": 64},
    BatchedTrainConfig: {"world": "maze", "batch": 64, "minutes": 4.0, "learning_rate": 1e-3},
    speed.StartSpeedConfig: {"parts": ("import",), "repeats": 1}, stereo.Config: {"descriptors": ("orb",)},
    training_speed.Config: {"workers": (0, 2)},
    mrclam_pairs.Config: {"path": "log", "durations": (50.0,)},
    EvaluateConfig: {"model": str(Path("model.npz").resolve()), "policies": ("random_goals",)},
    TrainConfig: {"preset": "smoke", "learning_rate": 1e-4}, paper.Fig1Config: {"every": 2.5},
    paper.Fig2Config: {"length": 25.0}, paper.PairConfig: {"landmarks": 40}, paper.Fig5Config: {"decisions": 3},
    paper.Fig6Config: {"regimes": ("good",)}, replay.ImagesConfig: {"path": "images", "descriptor": "orb"},
    replay.KittiConfig: {"path": "drive", "truth": "poses.txt"},
    replay.MrclamConfig: {"path": "log", "robots": (1, 4), "motion": {"sigma_along": 0.125}},
    replay.LogConfig: {"path": "log", "particles": 7}, replay.GraphConfig: {"path": "a.g2o", "truth": "b.g2o"},
    replay.BagConfig: {"path": "log.bag", "odometry": ("/odom",), "sensor": {"height": 0.125}},
    replay.VictoriaConfig: {"path": "log", "sensor": {"range": 0.25}}, RunConfig: {"world": "maze", "max_cycles": 12},
    RecordConfig: {"world": "maze", "max_cycles": 12, "episodes": 7, "observations": "all"},
}  # fmt: skip
KINDS = [pytest.param(kind, id=kind.__name__) for kind in CASES]
AT_LEAST_0 = "an int >= 0"
AT_LEAST_1 = "an int >= 1"
ROBOTS = "an int from 1 to 8"
ABOVE_0 = "a finite number > 0"
# Bad values of each class, with the expected part of the error.
BAD: dict[type[ExperimentConfig], dict[str, dict[Any, str]]] = {
    accuracy.Config: {
        "seeds": {0: AT_LEAST_1}, "particles": {(0,): AT_LEAST_1, (): "at least one value, each once"},
        "presets": {("fine",): "one of 'good', 'coarse', 'paper'"}, "methods": {("magic",): "one of 'dead_reckoning'"},
        "lengths": {(0.1,): "a finite number >= 0.25"}, "noise_factor": {0.0: ABOVE_0},
        "robots": {(16,): "an int >= 16"},
    },
    losses.Config: {
        "presets": {("fine",): "one of 'easy', 'standard', 'hard'"}, "duration": {0.0: "a finite number >= 1"},
        "baselines": {(0.0,): ABOVE_0}, "robots": {(9,): ROBOTS},
    },
    speed.EnvSpeedConfig: {
        "robots": {(9,): ROBOTS}, "modes": {("image",): "one of 'driver', 'poses'"}, "steps": {1: "an int >= 2"},
        "particles": {(0,): AT_LEAST_1}, "plays": {0: AT_LEAST_1}, "peer": {1: "a bool"},
    },
    exploration.ExplorationConfig: {
        "split": {"all": "one of 'train', 'validation', 'test', 'any'"}, "robots": {(9,): ROBOTS},
        "oracles": {("pose", "fate"): "one of 'none', 'pose', 'association', 'merge', 'all'"},
        "duration": {0.0: "a finite number >= 1"}, "seeds": {0: AT_LEAST_1},
        "preset": {"dire": "one of 'easy', 'standard', 'hard'"}, "rejuvenate_every": {-1: AT_LEAST_0},
        "policies": {("frontier", "frontier"): "at least one value, each once", (3,): "a text"},
    },
    speed.FilterSpeedConfig: {
        "steps": {0: AT_LEAST_1}, "proposals": {("ekf",): "one of 'fastslam2', 'fastslam1'"},
        "particles": {(5, 5): "at least one value, each once"}, "lookalikes": {0: AT_LEAST_1},
        "landmarks": {(9,): "an int >= 10"},
    },
    exploration.PlanConfig: {
        "decision_limit": {0.0: ABOVE_0}, "extent": {"half": "one of 'all', 'base', 'quick'"}, "plan": {3: "a text"},
        "policies": {("frontier", "frontier"): "at least one value, each once"},
    },
    speed.BatchedSpeedConfig: {"rows": {3: "an int >= 16"}, "beside": {-1: AT_LEAST_0}, "batches": {(0,): AT_LEAST_1}},
    BatchedTrainConfig: {
        "rows": {3: "an int >= 16"}, "batch": {0: AT_LEAST_1}, "minutes": {0.0: ABOVE_0}, "robots": {9: ROBOTS},
        "minibatches": {7: "a divisor of batch x steps, 2048"}, "gamma": {1.5: "a finite number > 0 and <= 1"},
        "preset": {"calm": "one of 'easy'"}, "std": {0.0: ABOVE_0},
    },
    speed.StartSpeedConfig: {"repeats": {0: AT_LEAST_1}, "parts": {("none",): "one of"}},
    stereo.Config: {
        "sizes": {(32,): "an int >= 64"}, "walls": {(3,): "an int >= 4"}, "views": {0: AT_LEAST_1},
    },
    training_speed.Config: {
        "robots": {9: ROBOTS}, "workers": {(99,): "at most one per environment, 16"}, "steps": {1: "an int >= 2"},
    },
    mrclam_pairs.Config: {"durations": {(-1.0,): "a finite number >= 0"}, "particles": {0: AT_LEAST_1}},
    EvaluateConfig: {"seeds": {1: "an int >= 2"}, "split": {"train": "one of 'validation', 'test'"}},
    TrainConfig: {
        "preset": {"slow": "one of 'quick', 'imitate', 'ppo', 'smoke'"}, "rounds": {0: AT_LEAST_1},
        "noise": {"calm": "one of 'easy'"}, "robots": {9: ROBOTS},
        "batch": {1: "an int >= 2"}, "gamma": {1.5: "a finite number > 0 and <= 1"}, "clip": {0.0: ABOVE_0},
        "entropy": {-1.0: "a finite number >= 0"}, "envs": {0: AT_LEAST_1}, "straighten": {1: "a bool"},
    },
    paper.Fig1Config: {"every": {0.1: "a finite number >= 0.25"}, "robots": {10: "at most 9"}},
    paper.Fig2Config: {"every": {0.1: "a finite number >= 0.25"}, "length": {1.0: "a finite number >= 5"}},
    paper.PairConfig: {"length": {0.1: "a finite number >= 0.25"}, "landmarks": {0: AT_LEAST_1}},
    paper.Fig5Config: {"robots": {9: ROBOTS}, "decisions": {0: AT_LEAST_1}, "measurements": {0: AT_LEAST_1}},
    paper.Fig6Config: {
        "seeds": {0: AT_LEAST_1}, "regimes": {("calm",): "one of 'paper', 'look_alikes', 'good'"},
        "robots": {(10,): "at most 9", (0,): AT_LEAST_1}, "measurements": {2: "an int >= 3"},
        "length": {0.1: "a finite number >= 0.25"},
    },
    replay.ImagesConfig: {
        "descriptor": {"surf": "one of 'usurf', 'sift', 'orb'"}, "max_range": {3.0: "a finite number > 3"},
    },
    replay.KittiConfig: {"sigma_px": {0.0: ABOVE_0}, "rejuvenate_every": {-1: AT_LEAST_0}, "duration": {-1.0: ABOVE_0}},
    replay.MrclamConfig: {
        "identities": {"lost": "one of 'given', 'hidden'"}, "alone": {"yes": "a bool"}, "dt": {0.0: ABOVE_0},
        "estimator": {"ekf": "one of 'fastslam2', 'fastslam1'"}, "particles": {0: AT_LEAST_1},
        "drive": {3: "a table of delay, speed, turn"}, "duration": {float("nan"): ABOVE_0},
    },
    replay.LogConfig: {"particles": {0: AT_LEAST_1}},
    replay.BagConfig: {
        "dt": {0.0: ABOVE_0}, "odometry": {(): "at least one value, each once"}, "particles": {0: AT_LEAST_1},
        "alone": {"yes": "a bool"},
    },
    replay.LogConfig: {"particles": {0: AT_LEAST_1}}, replay.GraphConfig: {"particles": {0: AT_LEAST_1}},
    replay.VictoriaConfig: {"particles": {True: AT_LEAST_1, 2.5: AT_LEAST_1}},
    RecordConfig: {
        "episodes": {0: AT_LEAST_1}, "robots": {9: ROBOTS}, "observations": {"none": "one of 'driver', 'goal', 'all'"},
    },
    RunConfig: {
        "robots": {0: ROBOTS, 9: ROBOTS}, "sensor": {"sonar": "one of 'landmark', 'stereo'"},
        "action_type": {"jump": "one of 'continuous', 'discrete', 'goal'"}, "max_cycles": {0: AT_LEAST_1},
        "rejuvenate_every": {-1: AT_LEAST_0}, "max_seconds": {0.0: ABOVE_0},
        "preset": {"stand": "one of 'easy', 'standard', 'hard', 'large'"},
        "start_poses": {
            "1,2": "a pose x,y,theta of each of 3 robots", "1,2,3; 4,5,6": "a pose x,y,theta of each of 3 robots",
            "1,2,north": "numbers x,y,theta", "": "numbers x,y,theta",
        },
    },
}  # fmt: skip
# Fields whose options have other names, which errors use.
OPTIONS = {
    "seed": "first_seed", "lengths": "length", "split": "world_split", "estimator": "proposal",
    "lookalikes": "look_alikes", "duration": "max_seconds", "decisions": "max_seconds",
}  # fmt: skip
BAD_VALUES = [
    pytest.param(kind, name, value, expected, id=f"{kind.__name__}-{name}-{value}")
    for kind, names in BAD.items()
    for name, values in ({"seed": {-1: AT_LEAST_0}} | names).items()
    for value, expected in values.items()
]


def test_every_configuration_is_covered() -> None:
    """The tests below cover all classes of the commands."""

    def below(kind: type[ExperimentConfig]) -> set[str]:
        subclasses = [each for each in kind.__subclasses__() if each.__module__.startswith("training.")]
        return {each.__name__ for each in subclasses}.union(*map(below, subclasses))

    assert below(ExperimentConfig) - {"ReplayConfig"} == {
        kind.__name__ for kind in CASES if kind.__module__.startswith("training.")
    }
    assert BAD.keys() == CASES.keys()


@pytest.mark.parametrize("kind", KINDS)
def test_run_folders_restore_the_configuration(kind: type[ExperimentConfig], tmp_path: Path) -> None:
    """Values written to `config.toml` and read again give an equal configuration, tables and lists included."""
    config = kind.from_mapping(CASES[kind] | {"seed": 7})
    RunFolder.create(tmp_path / "run", "some command", config.to_mapping(), config.seed)
    values, seed = read_config(tmp_path / "run", "some command")
    assert seed == 7
    assert "seed" not in values
    assert kind.from_mapping(values | {"seed": seed}) == config


@pytest.mark.parametrize("kind", KINDS)
def test_misspelt_names_are_reported_with_the_valid_ones(kind: type[ExperimentConfig]) -> None:
    """Unknown names are reported, not ignored."""
    with pytest.raises(
        ValueError, match=r"^config: expected names among .*seed.*, got 'sede'\. Did you mean 'seed'\? C"
    ):
        kind.from_mapping(CASES[kind] | {"sede": 1})


@pytest.mark.parametrize(("kind", "name", "value", "expected"), BAD_VALUES)
def test_bad_values_are_refused_by_name(kind: type[ExperimentConfig], name: str, value: Any, expected: str) -> None:
    """One line has the name, the expected and the actual value, and a hint."""
    with pytest.raises(ValueError, match="expected") as refusal:
        kind.from_mapping(CASES[kind] | {name: value})
    text = str(refusal.value)
    names = {name, OPTIONS.get(name, name), "measurements" if name == "robots" else name}
    assert text.startswith(tuple(f"{each}: expected {expected}" for each in names))
    assert ", got " in text
    assert text.endswith(".")
    assert "\n" not in text


def test_misspelt_choices_and_names_get_the_nearest_one() -> None:
    """A value with choices, and a name in a table, are refused with the one that is probably meant."""
    with pytest.raises(ValueError, match=r"got 'lrage'\. Did you mean 'large'\?"):
        RunConfig(preset="lrage")
    with pytest.raises(ValueError, match=r"got 'sigma_alnog'\. Did you mean 'sigma_along'\?"):
        replay.VictoriaConfig(path="log", motion={"sigma_alnog": 1.0})


def test_a_preset_given_for_an_earlier_run_brings_its_values() -> None:
    """What a given preset implies overrides the configuration of an earlier run, and is overridden by options."""
    earlier = TrainConfig().to_mapping()
    repeated = TrainConfig.from_mapping(TrainConfig.merged(earlier, {"preset": "smoke", "envs": 4}))
    assert repeated == TrainConfig.from_mapping({"preset": "smoke", "envs": 4})
    assert repeated.world == "fig5"


def test_a_table_of_another_package_is_checked_there() -> None:
    """An unknown name and a bad number in a table are refused by both names."""
    with pytest.raises(ValueError, match=r"motion: expected names among sigma_along, .* got 'sigma'"):
        replay.VictoriaConfig(path="log", motion={"sigma": 1.0})
    with pytest.raises(ValueError, match="sigma_along: expected a finite number"):
        replay.VictoriaConfig(path="log", motion={"sigma_along": -1.0})


def test_choices_match_the_packages() -> None:
    """Configurations repeat the choices, so that `--help` imports none of the packages that define them."""
    assert get_args(experiments.Proposal) == PROPOSALS
    assert get_args(experiments.Descriptor) == DESCRIPTORS
    assert get_args(experiments.ActionType) == ACTION_TYPES
    assert get_args(experiments.NoisePreset) == NOISE_PRESETS
    assert get_args(experiments.Preset) == PRESETS
    assert get_args(experiments.Sensor) == SENSORS
    assert get_args(alignment.Method) == METHODS
    assert paper.STEP == runs.STEP
    assert tuple(TRAIN_PRESETS) == ("quick", "imitate", "ppo", "smoke")
    assert paper.Fig6Config().regimes == tuple(REGIMES)
    assert speed.EnvSpeedConfig().robots[-1] == MAX_ROBOTS
    assert set(SPLITS) < {"train", "validation", "test", "any"}
    assert replay.ImagesConfig(path="room").files == StereoFiles()
