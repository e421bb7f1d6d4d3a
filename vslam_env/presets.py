"""Presets of easy, standard, hard and large environments, for the landmark sensor and for rendered stereo cameras."""

import dataclasses
from typing import Any

from slam_backend.core.validation import check_choice
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.frontend import DESCRIPTOR_TYPES
from vslam_env.belief.belief import BeliefConfig, motion_without_smoother
from vslam_env.config import SENSORS, EnvConfig
from vslam_env.sensors import StereoSensorConfig

NOISE_PRESETS = ("easy", "standard", "hard")
PRESETS = (*NOISE_PRESETS, "large")
LARGE = {"world": "rooms:extent=120", "action_type": "goal", "max_seconds": 1800.0}


def preset_config(name: str, sensor: str = "landmark") -> EnvConfig:
    """Return the configuration of a preset.

    `standard`: odometry with sigma 5 % of the distance and 2 degrees per metre, and a bias per episode of 2 % and 0.5
    degrees per metre; 5 landmarks a tick within 8 m, detected with probability 0.9, 0.02 false points, descriptor
    noise 0.17.
    `easy`: odometry noise and bias halved, 10 landmarks a tick within 12 m, detected with probability 0.95, no false
    points, descriptor noise 0.1.
    `hard`: odometry noise and bias doubled, 3 landmarks a tick within 5 m, detected with probability 0.8, 0.1 false
    points, descriptor noise 0.25, every fifth landmark copies the descriptor of another one, half of the contacts lost.
    `large`: that of `standard`, for half an hour with `goal` actions in a world of 120 x 120 m, `rooms:extent=120`.
    The filters assume the range and the odometry noise of their preset.
    With `sensor="stereo"` presets differ in odometry and communication only, and the filters use `stereo_belief`.

    Raises:
        ValueError: If there is no such preset or sensor.
    """
    check_choice("preset", name, PRESETS)
    check_choice("sensor", sensor, SENSORS)
    if sensor == "stereo":
        config = dataclasses.replace(preset_config(name), sensor="stereo")
        return dataclasses.replace(config, belief=stereo_belief(config.stereo, config.belief))
    if name == "standard":
        return EnvConfig()
    if name == "large":
        return EnvConfig().replace(**LARGE)
    scale, max_range = (0.5, 12.0) if name == "easy" else (2.0, 5.0)
    standard = EnvConfig()
    motion = standard.belief.filter.motion
    sensors = {
        "easy": {"max_measurements": 10, "detection_probability": 0.95, "false_points": 0.0, "descriptor_noise": 0.1},
        "hard": {"max_measurements": 3, "detection_probability": 0.8, "false_points": 0.1, "descriptor_noise": 0.25},
    }
    scaled = ("sigma_along", "sigma_across", "sigma_heading", "bias_scale", "bias_heading")
    assumed = {part: scale * getattr(motion, part) for part in scaled}
    camera = {"max_range": max_range}
    return standard.replace(
        odometry={f.name: scale * getattr(standard.odometry, f.name) for f in dataclasses.fields(standard.odometry)},
        belief={"filter": {"motion": assumed, "camera": camera}},
        landmark_sensor=sensors[name] | {"camera": camera},
        landmarks={"repeated": 0.2 if name == "hard" else 0.0},
        comm_loss=0.5 if name == "hard" else 0.0,
    )


def stereo_belief(eyes: StereoSensorConfig, belief: BeliefConfig) -> BeliefConfig:
    """Return a belief configuration for rendered stereo cameras.

    It takes their optics, keeps the assumed camera noise of `belief`, and adds the existence model. The front end
    measures disparities to 0.05 px and corners to 0.1 to 0.2 px, but corners shift with the viewpoint and some points
    slide along edges: the existence model removes such landmarks. Recovery is off: with twenty measurements a frame
    among many similar landmarks it sometimes triggers falsely. In offices 100 and 101 (three robots, 60 s) the errors
    of the six paths were 1 to 9 cm with recovery and 1 to 2 cm without. Rejuvenation is off: it has not been evaluated
    with rendered cameras, so that more odometry noise is assumed (`motion_without_smoother`).

    Args:
        eyes: Configuration of the stereo sensor.
        belief: Configuration that supplies all settings unrelated to the sensor.
    """
    optics = {name: getattr(eyes.camera, name) for name in ("focal_px", "baseline", "width", "height", "max_range")}
    camera = dataclasses.replace(belief.filter.camera, mount=eyes.camera.mount, **optics)
    existence = ExistenceModel(detection=0.7, frame_limit=eyes.front_end.max_measurements)
    gate = DESCRIPTOR_TYPES[eyes.front_end.descriptor].gate
    changes: dict[str, Any] = {"existence": existence, "descriptor_gate": gate, "recovery_position": 0.0}
    changes |= {"rejuvenate_every": None, "motion": motion_without_smoother(belief.filter.motion)}
    assumed = dataclasses.replace(belief.filter, camera=camera, **changes)
    return dataclasses.replace(belief, filter=assumed)
