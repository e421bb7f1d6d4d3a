"""Benchmark `vslam bench stereo`: speed and quality of stereo measurements on rendered pairs."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrontEnd
from slam_backend.models.camera import StereoCamera
from training.bench.config import StereoBenchConfig
from training.bench.stereo.quality import quality_row, retrieval, second_looks
from training.bench.stereo.real_images import RealPart, measure_parts
from training.bench.stereo.scenes import Scene, panel_hall
from training.experiments.timing import describe_machine, time_calls, timing_ms
from vslam_env.sensors.stereo.textures import STYLES, TextureConfig

BUSY = TextureConfig(polygons=20.0, posters=0.6)  # enough corners for 100 landmarks in an image
CROWDED = 2  # spacing of corners for more than 100 landmarks [px]; 4 px leave 270 corners per image
WARM_UP = 5  # number of pairs that are not timed
WINDOW = 0.6  # descriptor window of constant physical size [m]


def camera_of(width: int) -> StereoCamera:
    """Return the default camera with another image width and the same field of view."""
    return StereoCamera(focal_px=float(width), width=width, height=3 * width // 4)


def speed_row(width: int, landmarks: int, walls: int, descriptor: Any, steps: int, seed: int) -> dict[str, Any]:
    """Time rendering and front end on one thread."""
    camera = camera_of(width)
    scene = Scene(panel_hall(walls), camera, seed, BUSY)
    spacing = CROWDED if landmarks > 100 else CornerOptions().spacing
    corners = CornerOptions(most=round(2.6 * landmarks), spacing=spacing)
    options = FrontEndOptions(descriptor=descriptor, corners=corners, max_measurements=landmarks)
    front_end, rng = StereoFrontEnd(camera, options), np.random.default_rng(seed)
    pose = np.array([1.5, 3.0, 0.5])
    view = scene.look(pose, rng)
    num_landmarks = len(front_end.measure(view.left, view.right).measurements)
    render = _timed(lambda _: scene.look(pose, rng), steps)
    measure = _timed(lambda _: front_end.measure(view.left, view.right), steps)
    return {
        "width": width, "height": camera.height, "walls": walls, "wanted": landmarks, "landmarks": num_landmarks,
        "descriptor": descriptor, "render": render, "front_end": measure,
    }  # fmt: skip


def _timed(call: Callable[[Any], Any], steps: int) -> dict[str, float]:
    """Time a call [ms]: wall-clock time, and processor time, which other load does not affect."""
    time_calls(call, range(WARM_UP))
    begin = time.process_time()
    timing = timing_ms(time_calls(call, range(steps))[0])
    return timing | {"processor_ms": 1e3 * (time.process_time() - begin) / steps}


def run_stereo_bench(
    config: StereoBenchConfig,
    real: Sequence[RealPart] = (),
    on_part: Callable[[str], None] = lambda name: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Run all parts, with one OpenCV thread; `interrupted` is checked between them."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    result = _run_rendered(config, on_part, interrupted)
    measure_parts(real, result, on_part, interrupted)
    cv2.setNumThreads(threads)
    return result


def _run_rendered(
    config: StereoBenchConfig, on_part: Callable[[str], None], interrupted: Callable[[], bool]
) -> dict[str, Any]:
    """Run all parts on rendered pairs."""
    speed: list[dict[str, Any]] = []
    middle = (320 if 320 in config.sizes else config.sizes[0], 100, 40)
    loads = [(*middle, descriptor) for descriptor in config.descriptors]
    loads += [(width, middle[1], middle[2], config.descriptors[0]) for width in config.sizes if width != middle[0]]
    loads += [(middle[0], count, middle[2], config.descriptors[0]) for count in config.landmarks if count != middle[1]]
    loads += [(middle[0], middle[1], walls, config.descriptors[0]) for walls in config.walls if walls != middle[2]]
    result: dict[str, Any] = {"machine": describe_machine(), "speed": speed, "quality": [], "retrieval": []}
    for width, landmarks, walls, descriptor in loads:
        if interrupted():
            return result
        on_part(f"speed: {width} px, {landmarks} landmarks, {walls} walls, {descriptor}")
        speed.append(speed_row(width, landmarks, walls, descriptor, config.steps, config.seed))
    for descriptor in config.descriptors:
        if interrupted():
            return result
        on_part(f"quality: {descriptor}")
        result["quality"].append(quality_row(descriptor, config.views, config.seed))
    cases: list[tuple[str, float | None, str]] = [(descriptor, None, "distinct") for descriptor in config.descriptors]
    if "usurf" in config.descriptors:
        cases += [("usurf", WINDOW, "distinct"), *(("usurf", None, style) for style in STYLES if style != "distinct")]
    for way, window, style in cases:
        if interrupted():
            return result
        on_part(f"retrieval: {way}, {style}" + (f", window {window} m" if window else ""))
        result["retrieval"].append(retrieval(way, window, style, config.seed))
    on_part("second looks")
    result["second_looks"] = second_looks(config.seed)
    return result
