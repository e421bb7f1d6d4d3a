"""What `vslam replay kitti` does with a folder of images."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from training.command_options import finish
from training.compiling import prepare

COMMAND = "replay kitti"


def replay_folder_of_images(values: Mapping[str, Any], out: Path | None, json: Path | None) -> None:
    """Replay a folder of stereo images, print how far off it ended, and write the run folder."""
    from slam_backend.readers.kitti_images import load_kitti_images
    from training.figures_images import draw_frame, expected_pixels
    from training.figures_replay_one import draw_one
    from training.replay_images import ImagesConfig, replay_images, score_images, summarise_images
    from training.replay_one_command import print_table, with_progress, write_paths
    from training.run_folder import RunFolder, plain

    chosen = ImagesConfig.from_mapping(values)
    log = load_kitti_images(chosen.path, chosen.truth, chosen.duration)
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = with_progress(console, lambda on_step: replay_images(log, chosen, on_step))
    one = result.replay
    scored = score_images(one, log)
    metrics = plain(summarise_images(result, scored))
    print_table(console, metrics, one)
    console.print(
        f"Odometry: visual, from every second of {metrics['features_per_frame']:.0f} features a frame "
        f"({metrics['odometry_inliers_per_frame']:.0f} agreed); the filter got the others. Motion is taken to be in "
        f"the plane. Front end and odometry took {1e3 * result.front_end_seconds / len(log.times):.0f} ms a frame.",
        highlight=False,
    )
    if scored is not None:
        ends = [100.0 * error / scored.length for error in (scored.end_error, scored.odometry_end_error)]
        console.print(
            f"End of {scored.length:.1f} m: off by {scored.end_error:.2f} m, {ends[0]:.2f} % of the path "
            f"(visual odometry alone {ends[1]:.2f} %).",
            highlight=False,
        )
    draw_one(
        folder.path / "replay.png",
        "KITTI stereo images in the plane",
        one,
        (one.path[:, :2], one.reckoned[:, :2]),
        (scored.estimate, scored.odometry) if scored else None,
        scored.truth[:, :2] if scored else None,
    )
    landmarks = one.landmarks
    counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
    often = landmarks.subset(landmarks.counts >= 3)
    means = often.means.copy()
    means[:, 2] = [result.heights[name] for name in often.ids.tolist()]
    expected = expected_pixels(means, one.path[-1], log.pair.focal_px, log.pair.centre_px, 30.0)
    image = log.images(len(log.times) - 1)[0]
    draw_frame(folder.path / "frame.png", image, result.last.pixels[::2], result.last_ids, counts, expected)
    write_paths(folder, one, log.truth)
    finish(console, folder, folder.write_metrics(metrics), json)
