"""Make the moving picture of the README: three robots map an office and merge their maps.

python -m studies.moving_picture                  # docs/figures/episode.webp, about a minute
python -m studies.moving_picture --seed 1 --out other.webp
python -m studies.moving_picture --policy learned --beside frontier --out both.webp   # the same world twice
python -m studies.moving_picture --preset hard --beside-file old.webp --out both.webp       # beside another version
"""

import argparse
from pathlib import Path

from PIL import Image, ImageSequence

from training.episodes.config import RunConfig
from training.episodes.runner import Progress, run_episode
from training.episodes.video import with_video_time_merges
from vslam_env.rendering import draw_frame

ROOT = Path(__file__).parents[1]
SIZE = (640, 480)  # [px]
FPS = 10
SPEEDUP = 10.0  # simulated seconds per second
LINGER = 2.0  # time for which the last frame stays [s]
COLOURS = 48  # few colours without dithering make differences between frames small


def film(config: RunConfig) -> list[Image.Image]:
    """Return the frames of an episode."""
    env, frames = config.make_env(), []
    stride = round(SPEEDUP / FPS / config.step_s)

    def on_step(progress: Progress) -> None:
        if progress.step % stride == 0:
            scene = with_video_time_merges(env.scene(), env.events, SPEEDUP)
            frames.append(Image.fromarray(draw_frame(scene, SIZE)))

    run_episode(env, config.make_policies(env), config.seed, on_step)
    return frames


def side_by_side(left: list[Image.Image], right: list[Image.Image]) -> list[Image.Image]:
    """Return the frames of two episodes beside each other; the last frame of the shorter one stays."""
    both = []
    for k in range(max(len(left), len(right))):
        pair = [frames[min(k, len(frames) - 1)] for frames in (left, right)]
        both.append(Image.new("RGB", (sum(frame.width for frame in pair), pair[0].height)))
        both[-1].paste(pair[0], (0, 0))
        both[-1].paste(pair[1], (pair[0].width, 0))
    return both


def with_few_colours(frames: list[Image.Image]) -> list[Image.Image]:
    """Return frames in the colours that suit all of them best."""
    width, height = frames[0].size
    some = frames[:: max(1, len(frames) // 10)]
    sheet = Image.new("RGB", (width, height * len(some)))
    for row, frame in enumerate(some):
        sheet.paste(frame, (0, height * row))
    palette = sheet.quantize(COLOURS)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE).convert("RGB") for frame in frames]


def main() -> None:
    """Film an episode and write it as animated WebP."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "figures" / "episode.webp")
    parser.add_argument("--world", default="office")
    parser.add_argument("--world-split", choices=("train", "validation", "test"))
    parser.add_argument("--policy", default="next_best_view")
    second = parser.add_mutually_exclusive_group()
    second.add_argument("--beside", metavar="POLICY", help="second policy, in the same world")
    second.add_argument("--beside-file", metavar="WEBP", type=Path, help="moving picture of another version")
    parser.add_argument("--preset", choices=("easy", "standard", "hard"), default="standard")
    parser.add_argument("--action-type", choices=("continuous", "discrete", "goal"), default="continuous")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-seconds", type=float, default=120.0)
    options = parser.parse_args()
    episodes = [
        film(
            RunConfig(
                world=options.world, world_split=options.world_split, policy=policy, seed=options.seed,
                max_seconds=options.max_seconds, action_type=options.action_type, preset=options.preset,
            )
        )
        for policy in (options.policy, options.beside)
        if policy is not None
    ]  # fmt: skip
    if options.beside_file is not None:
        with Image.open(options.beside_file) as picture:
            episodes.append([frame.convert("RGB") for frame in ImageSequence.Iterator(picture)])
    frames = with_few_colours(episodes[0] if len(episodes) == 1 else side_by_side(*episodes))
    durations = [round(1e3 / FPS)] * (len(frames) - 1) + [round(1e3 * LINGER)]
    frames[0].save(
        options.out, save_all=True, append_images=frames[1:], duration=durations, loop=0, lossless=True, quality=80,
        method=4, kmin=len(frames), kmax=len(frames) + 1,
    )  # fmt: skip
    print(f"{options.out}: {len(frames)} frames, {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
