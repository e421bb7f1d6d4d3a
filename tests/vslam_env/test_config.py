from pathlib import Path

import numpy as np
import pytest

from slam_backend.models.odometry import OdometryModel
from vslam_env import EnvConfig, preset_config, vslam_v0
from vslam_env.presets import PRESETS


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("sensor", ["landmark", "stereo"])
def test_toml_round_trip(name: str, sensor: str, tmp_path: Path) -> None:
    """A configuration survives the way through a TOML file unchanged, also one that Windows has saved."""
    config = preset_config(name, sensor).replace(num_robots=2, decision_ticks=3, reward={"coverage": 0.5})
    path = tmp_path / "config.toml"
    for encoding, end in (("utf-8", "\n"), ("utf-8-sig", "\r\n"), ("utf-16", "\r\n")):
        path.write_text(config.to_toml(), encoding=encoding, newline=end)
        assert EnvConfig.from_toml(path) == config


def test_presets_are_ordered() -> None:
    """From easy to hard all true noise grows and less is seen."""
    easy, standard, hard = (preset_config(name) for name in ("easy", "standard", "hard"))
    for less, more in ((easy, standard), (standard, hard)):
        assert less.odometry.sigma_distance < more.odometry.sigma_distance
        assert less.odometry.bias_heading_per_metre < more.odometry.bias_heading_per_metre
        assert less.landmark_sensor.descriptor_noise < more.landmark_sensor.descriptor_noise
        assert less.landmark_sensor.false_points < more.landmark_sensor.false_points
        assert less.landmark_sensor.detection_probability > more.landmark_sensor.detection_probability
        assert less.landmark_sensor.max_measurements > more.landmark_sensor.max_measurements
        assert less.landmark_sensor.camera.max_range > more.landmark_sensor.camera.max_range
        assert less.belief.filter.motion.sigma_along < more.belief.filter.motion.sigma_along
        assert less.belief.filter.camera.max_range == less.landmark_sensor.camera.max_range
        assert less.comm_loss <= more.comm_loss


def test_the_large_preset_has_a_large_world_and_standard_noise() -> None:
    """It differs from the standard preset in world, actions and time alone, and arguments replace its values."""
    large = vslam_v0.parallel_env(preset="large").config
    assert large.world == "rooms:extent=120"
    assert large.action_type == "goal"
    assert large.max_seconds == 1800.0
    common = {"world": "office", "action_type": "continuous", "max_seconds": 60.0}
    assert large.replace(**common) == preset_config("standard").replace(**common)
    own = vslam_v0.parallel_env(preset="large", world="campus", max_seconds=300.0).config
    assert (own.world, own.action_type, own.max_seconds) == ("campus", "goal", 300.0)


@pytest.mark.parametrize("name", PRESETS)
def test_filters_without_a_smoother_assume_more_odometry_noise(name: str) -> None:
    """Rendered cameras, whose filters are not rejuvenated, have the plain model's noise in proportion to its scale."""
    rejuvenated, not_rejuvenated = (preset_config(name, sensor).belief.filter for sensor in ("landmark", "stereo"))
    assert rejuvenated.rejuvenate_every is not None
    assert not_rejuvenated.rejuvenate_every is None
    plain, motion, less = OdometryModel(), not_rejuvenated.motion, rejuvenated.motion
    assert motion.sigma_across / motion.sigma_along == pytest.approx(plain.sigma_across / plain.sigma_along)
    assert (motion.sigma_turn, motion.floor_heading) == (plain.sigma_turn, plain.floor_heading)
    assert less.sigma_across < motion.sigma_across
    assert (less.sigma_along, less.bias_scale) == (motion.sigma_along, motion.bias_scale)


def test_true_and_assumed_noise_are_apart() -> None:
    """Changing what the filters assume leaves the simulator's noise, and the other way round."""
    config = EnvConfig()
    assumed = config.replace(belief={"filter": {"camera": {"sigma_px": 1.7}}})
    assert assumed.landmark_sensor == config.landmark_sensor
    assert assumed.belief.filter.camera.sigma_px == 1.7
    true = config.replace(landmark_sensor={"camera": {"sigma_px": 1.7}})
    assert true.belief == config.belief


def test_nested_changes_keep_the_rest() -> None:
    """A dict changes the fields that it names, and no others."""
    config = EnvConfig(max_cycles=77).replace(landmark_sensor={"max_measurements": 9})
    assert config.max_cycles == 77
    assert config.landmark_sensor.max_measurements == 9
    assert config.landmark_sensor.detection_probability == 0.9


def test_toml_number_and_list_types_are_accepted() -> None:
    """Whole numbers do for floats, lists for tuples, and numbers of numpy for those of Python."""
    config = EnvConfig().replace(
        robot_radius=1, stop_at_recall=1, num_robots=np.int64(2), landmark_sensor={"camera": {"mount": [0, 0, 1]}}
    )
    assert (config.robot_radius, config.stop_at_recall, config.num_robots) == (1.0, 1.0, 2)
    assert config.landmark_sensor.camera.mount == (0.0, 0.0, 1.0)


@pytest.mark.parametrize(("action_type", "ticks"), [("continuous", 1), ("discrete", 1), ("goal", 10)])
def test_default_decision_ticks(action_type: str, ticks: int) -> None:
    """A step is one tick, with goal actions ten, unless asked otherwise."""
    assert EnvConfig().replace(action_type=action_type).ticks_per_step == ticks
    assert EnvConfig().replace(action_type=action_type, decision_ticks=4).ticks_per_step == 4


@pytest.mark.parametrize(("action_type", "steps"), [("continuous", 1000), ("discrete", 1000), ("goal", 100)])
def test_episodes_last_100_seconds(action_type: str, steps: int) -> None:
    """Without a limit an episode has the steps of 100 s, else those of `max_seconds` rounded up, or `max_cycles`."""
    assert vslam_v0.parallel_env(action_type=action_type).max_cycles == steps
    config = EnvConfig().replace(action_type=action_type)
    assert config.num_cycles == steps
    assert config.replace(max_seconds=12.0).num_cycles == 12 * steps // 100
    assert config.replace(max_cycles=7).num_cycles == 7
    assert config.replace(max_seconds=3.5, decision_ticks=10).num_cycles == 4
    assert vslam_v0.parallel_env(config=config, decision_ticks=4).max_cycles == 250


def test_a_given_limit_replaces_the_other_one(tmp_path: Path) -> None:
    """Steps given as an argument win over the seconds of a configuration, and the reverse, also from a file."""
    path = tmp_path / "config.toml"
    path.write_text(EnvConfig(max_seconds=30.0).to_toml(), encoding="utf-8")
    assert EnvConfig.from_toml(path).num_cycles == 300
    env = vslam_v0.parallel_env(config=path, max_cycles=5)
    assert (env.max_cycles, env.config.max_cycles, env.config.max_seconds) == (5, 5, None)
    assert vslam_v0.parallel_env(config=env.config, max_seconds=2.0).max_cycles == 20


def test_a_file_changes_the_fields_that_it_names(tmp_path: Path) -> None:
    """What a file leaves out of a nested table is that of the standard preset, as with `replace`."""
    path = tmp_path / "config.toml"
    path.write_text("num_robots = 2\n[belief.filter]\nnum_particles = 7\n", encoding="utf-8")
    assert EnvConfig.from_toml(path) == EnvConfig(num_robots=2).replace(belief={"filter": {"num_particles": 7}})


def test_none_against_a_standard_value_is_written(tmp_path: Path) -> None:
    """TOML has no None: the text "none" stands for it where the standard is something else, and nothing elsewhere."""
    config = EnvConfig().replace(belief={"filter": {"rejuvenate_every": None}})
    text = config.to_toml()
    assert text.count('"none"') == 1
    assert 'rejuvenate_every = "none"' in text
    assert EnvConfig.from_toml_text(text) == config
    assert '"none"' not in EnvConfig().to_toml()


def test_keywords_override_the_file(tmp_path: Path) -> None:
    """Arguments of `parallel_env` override the configuration file; `env.config` is the result."""
    path = tmp_path / "config.toml"
    path.write_text(EnvConfig(num_robots=2, max_cycles=55).to_toml(), encoding="utf-8")
    env = vslam_v0.parallel_env(config=path, num_particles=7, num_robots=4)
    assert (env.config.num_robots, env.config.max_cycles, env.config.belief.filter.num_particles) == (4, 55, 7)


@pytest.mark.parametrize("number", ["3", "0", '"2"', "2.0", "true"])
def test_a_configuration_of_another_format_is_refused(number: str, tmp_path: Path) -> None:
    """A file says of which format it is; one that says nothing is of the present one."""
    text = EnvConfig(num_robots=2).to_toml()
    assert text.startswith("format = 2\n")
    assert EnvConfig.from_toml_text(text.removeprefix("format = 2\n")) == EnvConfig(num_robots=2)
    (tmp_path / "env.toml").write_text(text.replace("format = 2", f"format = {number}", 1), encoding="utf-8")
    with pytest.raises(ValueError, match="config: expected one of format 2, got a configuration of format"):
        EnvConfig.from_toml(tmp_path / "env.toml")


@pytest.mark.parametrize("name", PRESETS)
def test_filters_assume_the_prior_of_the_true_odometry_bias(name: str) -> None:
    """In each preset the assumed standard deviations of the bias are those from which it is drawn."""
    config = preset_config(name)
    assumed, true = config.belief.filter.motion, config.odometry
    assert assumed.bias_scale == pytest.approx(true.bias_distance)
    assert assumed.bias_heading == pytest.approx(true.bias_heading_per_metre)
    assert assumed.bias_turn == 0.0
