"""What `vslam replay kitti` does with a folder of images."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from training.commands._progress import share_shown
from training.commands._run_folder import begin

COMMAND = "replay kitti"


def replay_folder_of_images(
    values: Mapping[str, Any], out: Path | None, json: Path | None, command: str = COMMAND
) -> None:
    """Replay a folder of stereo images, print how far off it ended, and write the run folder."""
    from training.commands.replay_one import drift_told, end_told, finish_one
    from training.replay.image_figures import draw_frame, expected_pixels
    from training.replay.stereo_images import ImagesConfig, replay_images, score_images, summarise_images

    chosen = ImagesConfig.from_mapping(values)
    log = chosen.load()
    console, folder = begin(command, chosen, out)
    with share_shown(console, "replay") as on_step:
        result = replay_images(log, chosen, on_step)
    one, scored = result.replay, score_images(result.replay, log)
    metrics = summarise_images(result, scored)
    told = [
        f"Odometry: visual, from every second of {metrics['features_per_frame']:.0f} features a frame "
        f"({metrics['odometry_inliers_per_frame']:.0f} agreed); the filter got the others. Motion is taken to be in "
        f"the plane. Front end and odometry took {1e3 * result.front_end_seconds / len(log.times):.0f} ms a frame."
    ]
    if scored is not None:
        ends = scored.end_error, scored.odometry_end_error
        told += [drift_told(scored.drifts), end_told(ends, scored.length, "visual odometry alone")]
    landmarks = one.landmarks
    counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
    often = landmarks.subset(landmarks.counts >= 3)
    means = often.means.copy()
    means[:, 2] = [result.heights[name] for name in often.ids.tolist()]
    expected = expected_pixels(means, one.path[-1], log.pair.focal_px, log.pair.centre_px, 30.0)
    image = log.images(len(log.times) - 1)[0]
    draw_frame(folder.path / "frame.png", image, result.last.pixels[::2], result.last_ids, counts, expected)
    finish_one(
        console, folder, json, one, metrics, told, "stereo images in the plane",
        paths=(one.path, one.reckoned),
        scores=(scored.estimate, scored.odometry) if scored else None,
        known=scored.truth if scored else None,
        truth=log.truth,
    )  # fmt: skip
