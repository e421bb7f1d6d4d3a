import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vslam_env import EnvConfig, preset_config, vslam_v0
from vslam_env.presets import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_toml_round_trip(name: str, tmp_path: Path) -> None:
    """A configuration survives the way through a TOML file unchanged."""
    config = preset_config(name).replace(num_robots=2, decision_ticks=3, reward={"coverage": 0.5})
    path = tmp_path / "config.toml"
    path.write_text(config.to_toml(), encoding="utf-8")
    assert EnvConfig.from_toml(path) == config


def test_standard_is_the_contract() -> None:
    """The standard preset has the numbers that the documentation promises."""
    config = preset_config("standard")
    sensor, odometry, scan = config.landmark_sensor, config.odometry, config.scan
    assert config == EnvConfig()
    assert (sensor.max_measurements, sensor.detection_probability, sensor.false_points) == (5, 0.9, 0.02)
    assert (sensor.descriptor_noise, sensor.camera.max_range) == (0.17, 8.0)
    assert np.isclose(sensor.max_incidence, np.pi / 3)
    assert (odometry.sigma_distance, odometry.bias_distance) == (0.05, 0.02)
    assert np.allclose([odometry.sigma_heading_per_metre, odometry.bias_heading_per_metre], np.radians([2.0, 0.5]))
    assert (scan.num_rays, scan.max_range, scan.sigma) == (32, 8.0, 0.01)
    assert np.isclose(scan.half_fov, sensor.camera.half_fov)
    assert (config.num_robots, config.belief.filter.num_particles, config.max_cycles) == (3, 100, 1000)
    assert (config.min_start_distance, config.shared_start_view, config.map_error_cutoff) == (5.0, False, 1.0)


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


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("num_robots", 2.0),
        ("num_robots", "2"),
        ("max_cycles", True),
        ("max_cycles", "9"),
        ("decision_ticks", 2.0),
        ("stop_at_recall", True),
        ("oracle_pose", "yes"),
        ("oracle_merge", 1),
        ("shared_start_view", 0.0),
        ("robot_radius", "0.2"),
        ("world", 3),
        ("reward", 1.0),
        ("belief", 5),
    ],
)
def test_values_of_a_wrong_type_are_refused(field: str, value: Any) -> None:
    """No value is silently turned into another type, however a configuration is made; the error names the field."""
    message = f"^{field}: expected .*, got {re.escape(repr(value))}"
    with pytest.raises(ValueError, match=message):
        EnvConfig(**{field: value})
    with pytest.raises(ValueError, match=message):
        EnvConfig.from_dict({field: value})


@pytest.mark.parametrize("particles", [True, "10", 10.0])
def test_nested_values_of_a_wrong_type_are_refused(particles: Any) -> None:
    """Nor in the nested parts."""
    with pytest.raises(ValueError, match=r"num_particles: expected .*, got"):
        EnvConfig().replace(belief={"filter": {"num_particles": particles}})


def test_what_toml_writes_otherwise_is_accepted() -> None:
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


def test_a_file_changes_what_it_names(tmp_path: Path) -> None:
    """What a file leaves out of a nested table is that of the standard preset, as with `replace`."""
    path = tmp_path / "config.toml"
    path.write_text("num_robots = 2\n[belief.filter]\nnum_particles = 7\n", encoding="utf-8")
    assert EnvConfig.from_toml(path) == EnvConfig(num_robots=2).replace(belief={"filter": {"num_particles": 7}})


@pytest.mark.parametrize(
    "camera", [{"sigma_px": 1e-9}, {"sigma_disparity_px": 70.0}, {"baseline": 1e-6}, {"sigma_disparity_px": 1e5}]
)
@pytest.mark.parametrize("sensor", ["landmark", "stereo"])
def test_noise_under_which_filters_can_use_no_point_is_refused(camera: dict[str, float], sensor: str) -> None:
    """A filter whose camera makes covariances too flat for the points of the sensor is refused by name, at once."""
    with pytest.raises(ValueError, match=r"^belief\.filter\.camera: expected noise under which points .* m away"):
        preset_config("standard", sensor).replace(belief={"filter": {"camera": camera}})


BEYOND = [
    ({"robot_radius": 1e300}, "robot_radius"),
    ({"map_error_cutoff": 1e300}, "map_error_cutoff"),
    ({"landmarks": {"min_height": -1e12}}, "landmarks.min_height"),
    ({"landmarks": {"max_height": 1e12}}, "landmarks.max_height"),
    ({"odometry": {"sigma_distance": 1e300}}, "odometry.sigma_distance"),
    ({"odometry": {"bias_heading_per_metre": 1.7e308}}, "odometry.bias_heading_per_metre"),
    ({"landmark_sensor": {"max_measurements": 2**63}}, "sensor.max_measurements"),
    ({"landmark_sensor": {"false_points": 1e300}}, "sensor.false_points"),
    ({"scan": {"half_fov": 5e-324}}, "scan.half_fov"),
    ({"scan": {"max_range": 1e300}}, "scan.max_range"),
    ({"belief": {"confirm_after": 2**63}}, "belief.confirm_after"),
    ({"belief": {"filter": {"camera": {"focal_px": 1e-300}}}}, "camera.focal_px"),
    ({"belief": {"filter": {"camera": {"mount": [1e300, 0.0, 0.0]}}}}, "camera.mount"),
    ({"belief": {"filter": {"camera": {"sigma_px": 1e300}}}}, "camera.sigma_px"),
    ({"belief": {"filter": {"motion": {"sigma_along": 1e300}}}}, "motion.sigma_along"),
    ({"belief": {"filter": {"motion": {"floor_heading": 1e300}}}}, "motion.floor_heading"),
    ({"belief": {"filter": {"descriptor_gate": 1e300}}}, "descriptor_gate"),
    ({"belief": {"filter": {"descriptor_sigma": 1e300}}}, "descriptor_sigma"),
    ({"belief": {"filter": {"landmark_noise": 1e300}}}, "landmark_noise"),
    ({"belief": {"filter": {"smoothing": {"max_keys": 10**30}}}}, "max_keys"),
    ({"stereo": {"camera": {"width": 8}}}, "stereo.camera"),
    ({"stereo": {"camera": {"width": 10**6, "height": 10**6}}}, "stereo.camera"),
    ({"stereo": {"textures": {"ceiling": 1e300}}}, "textures.ceiling"),
    ({"stereo": {"textures": {"polygons": 1e300}}}, "textures.polygons"),
    ({"stereo": {"imaging": {"blur_px": 1e300}}}, "imaging.blur_px"),
    ({"stereo": {"imaging": {"parts": 2**63}}}, "imaging.parts"),
    ({"stereo": {"front_end": {"corners": {"block": 2**63}}}}, "corners.block"),
    ({"stereo": {"front_end": {"nearest": 0.01}}}, "front_end.nearest"),
    ({"stereo": {"working_distance": 1e-300}}, "stereo.working_distance"),
    ({"stereo": {"tolerance": 1e300}}, "stereo.tolerance"),
]


@pytest.mark.parametrize(("changes", "name"), BEYOND, ids=[name for _, name in BEYOND])
def test_numbers_beyond_what_filters_and_sensors_take_are_refused(changes: dict[str, Any], name: str) -> None:
    """They are refused by name when the configuration is made, not at a reset or in a step."""
    with pytest.raises(ValueError, match=rf"^{re.escape(name)}: expected .*, got "):
        EnvConfig().replace(**changes)


def test_none_against_a_standard_value_is_written(tmp_path: Path) -> None:
    """TOML has no None: the text "none" stands for it where the standard is something else, and nothing elsewhere."""
    config = EnvConfig().replace(belief={"filter": {"rejuvenate_every": None}})
    text = config.to_toml()
    assert text.count('"none"') == 1
    assert 'rejuvenate_every = "none"' in text
    assert EnvConfig.from_toml_text(text) == config
    assert '"none"' not in EnvConfig().to_toml()


def test_keywords_override_the_file(tmp_path: Path) -> None:
    """Arguments of `parallel_env` go before what a configuration file says; the environment tells the result."""
    path = tmp_path / "config.toml"
    path.write_text(EnvConfig(num_robots=2, max_cycles=55).to_toml(), encoding="utf-8")
    env = vslam_v0.parallel_env(config=path, num_particles=7, num_robots=4)
    assert (env.config.num_robots, env.config.max_cycles, env.config.belief.filter.num_particles) == (4, 55, 7)


@pytest.mark.parametrize("number", ["2", "0", '"1"', "1.0", "true"])
def test_a_configuration_of_another_format_is_refused(number: str, tmp_path: Path) -> None:
    """A file says of which format it is; one that says nothing is of the present one."""
    text = EnvConfig(num_robots=2).to_toml()
    assert text.startswith("format = 1\n")
    assert EnvConfig.from_toml_text(text.removeprefix("format = 1\n")) == EnvConfig(num_robots=2)
    (tmp_path / "env.toml").write_text(text.replace("format = 1", f"format = {number}", 1), encoding="utf-8")
    with pytest.raises(ValueError, match="config: expected one of format 1, got a configuration of format"):
        EnvConfig.from_toml(tmp_path / "env.toml")
