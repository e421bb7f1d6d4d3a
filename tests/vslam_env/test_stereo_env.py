import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest
from digests import digest
from small_env import MEETING, small_env, turning

from slam_backend.models.camera import StereoCamera
from vslam_env import EnvConfig, ExplorationEnv
from vslam_env.presets import preset_config, stereo_belief
from vslam_env.sensors import EyeFrame, StereoSensor

# pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
pytestmark = pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning")

SMALL = {"camera": {"width": 160, "height": 120, "focal_px": 160.0}, "textures": {"texel": 0.02}}


def _env(**changes: Any) -> ExplorationEnv:
    """Return the small room with small rendered eyes."""
    config = preset_config("standard", "stereo").replace(stereo=SMALL)
    config = dataclasses.replace(config, belief=stereo_belief(config.stereo, config.belief))
    return small_env(config=config, **changes)


def _run(env: ExplorationEnv, steps: int) -> str:
    total = hashlib.sha256()
    for _ in range(steps):
        digest(env.step(turning(env.agents)), total)
    return total.hexdigest()


def test_it_keeps_pettingzoos_contract() -> None:
    """PettingZoo's own test of parallel environments passes with rendered eyes."""
    from pettingzoo.test import parallel_api_test

    parallel_api_test(_env(max_cycles=12), num_cycles=20)


def test_the_same_seed_gives_the_same_bytes() -> None:
    """All that 25 steps return repeats with the seed, goes on from a snapshot, and differs with another seed."""
    digests = []
    for seed in (3, 3, 4):
        env = _env()
        env.reset(seed=seed)
        _run(env, 5)
        twin = env.clone()
        digests.append(_run(env, 20))
        assert _run(twin, 20) == digests[-1]
    assert digests[0] == digests[1]
    assert digests[0] != digests[2]


def test_robots_that_see_build_maps_of_the_walls() -> None:
    """In half a turn the robots map texture corners to a few centimetres; frames hold the images they came from."""
    env = _env()
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(38):
        _, _, _, _, infos = env.step(turning(env.agents))
    for agent, frame in zip(env.agents, env.episode.frames, strict=True):
        assert isinstance(frame, EyeFrame)
        assert frame.left.shape == (120, 160)
        assert len(env.belief(agent).map) > 20
        assert infos[agent]["map_rmse"] < 0.25
        assert infos[agent]["map_precision"] > 0.3
        assert infos[agent]["pose_error"] < 0.2
    assert isinstance(env.episode.setting.sensor, StereoSensor)
    assert len(env.true_landmarks) > 100


def test_the_filter_assumes_the_camera_that_the_robot_has() -> None:
    """The stereo preset gives filters the eyes' optics, a life cycle for landmarks, and the eyes' limit."""
    config = preset_config("standard", "stereo")
    assumed, eyes = config.belief.filter, config.stereo
    for name in ("focal_px", "baseline", "width", "height", "max_range"):
        assert getattr(assumed.camera, name) == getattr(eyes.camera, name)
    assert assumed.existence is not None
    assert assumed.existence.frame_limit == eyes.front_end.max_measurements
    assert preset_config("hard", "stereo").belief.filter.motion == preset_config("hard").belief.filter.motion
    assert preset_config("standard").belief.filter.existence is None


def test_a_configuration_survives_toml(tmp_path: Any) -> None:
    """What rendered eyes are configured with is written to TOML and read back."""
    config = preset_config("standard", "stereo").replace(stereo={"textures": {"style": "bricks"}})
    file = tmp_path / "environment.toml"
    file.write_text(config.to_toml(), encoding="utf-8")
    assert EnvConfig.from_toml(file) == config
    assert EnvConfig.from_toml(file).stereo.textures.style == "bricks"


def test_impossible_eyes_are_refused() -> None:
    """The error names the part and the field."""
    with pytest.raises(ValueError, match=r"textures\.style: expected one of"):
        EnvConfig().replace(stereo={"textures": {"style": "wallpaper"}})
    with pytest.raises(ValueError, match="sensor: expected"):
        EnvConfig(sensor="sonar")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="stereo: expected a StereoSensorConfig"):
        EnvConfig(stereo=StereoCamera())  # type: ignore[arg-type]


def test_images_can_be_observed() -> None:
    """An image observation is a copy of the robot's last left image, inside its space; the rest is as without.

    So is the image of its readings.
    """
    plain, seeing = _env(), _env(observe_images=True)
    expected, _ = plain.reset(seed=6)
    observed, _ = seeing.reset(seed=6)
    for _ in range(3):
        for agent, frame, reading in zip(seeing.agents, seeing.episode.frames, seeing.readings, strict=True):
            assert isinstance(frame, EyeFrame)
            assert reading.image is not None
            assert seeing.observation_space(agent).contains(observed[agent])
            image = observed[agent]["image"]
            np.testing.assert_array_equal(image[:, :, 0], frame.left)
            np.testing.assert_array_equal(reading.image, frame.left)
            image[:] = reading.image[:] = 0
            assert frame.left.any()
            assert set(observed[agent]) == {*expected[agent], "image"}
            np.testing.assert_array_equal(observed[agent]["pose"], expected[agent]["pose"])
        expected, observed = (env.step(turning(env.agents))[0] for env in (plain, seeing))
    for refused in ({"sensor": "landmark"}, {"observation_type": "flat"}):
        with pytest.raises(ValueError, match="observe_images: expected False without rendered eyes or named arrays"):
            _env(observe_images=True, **refused)


def test_textures_follow_the_world_seed() -> None:
    """A world seed fixes walls and what is painted on them, whatever the seed of the rest."""
    pictures = []
    for seed in (1, 2):
        env = _env()
        env.reset(seed=seed, options={"world_seed": 9})
        sensor = env.episode.setting.sensor
        assert isinstance(sensor, StereoSensor)
        pictures.append(np.array(sensor.textures.sums))
    np.testing.assert_array_equal(*pictures)
