"""The moving picture of the README."""

from pathlib import Path

from PIL import Image

from studies.moving_picture import COLOURS, ROOT, SIZE, film, side_by_side, with_few_colours
from training.episodes.config import RunConfig


def test_an_episode_is_filmed_in_few_colours() -> None:
    """A frame is drawn for each second and for the reset, and all share one small palette."""
    config = RunConfig(world="fig5", robots=1, policy="random_walk", particles=5, max_seconds=3.0)
    frames = with_few_colours(film(config))
    assert len(frames) == 4
    assert {frame.size for frame in frames} == {SIZE}
    colours = {colour for frame in frames for _, colour in frame.getcolors(COLOURS)}
    assert 8 < len(colours) <= COLOURS


def test_two_episodes_are_shown_side_by_side() -> None:
    """The last frame of the shorter episode stays until the other one ends."""
    left = [Image.new("RGB", (3, 2), (k, 0, 0)) for k in range(2)]
    right = [Image.new("RGB", (3, 2), (0, k, 0)) for k in range(4)]
    both = side_by_side(left, right)
    assert [frame.size for frame in both] == [(6, 2)] * 4
    assert [frame.getpixel((0, 0)) for frame in both] == [(min(k, 1), 0, 0) for k in range(4)]
    assert [frame.getpixel((5, 1)) for frame in both] == [(0, k, 0) for k in range(4)]


def test_the_picture_of_the_readme_moves_and_is_small() -> None:
    """The file that the README shows has many frames and less than 2 MB."""
    file = ROOT / "docs" / "figures" / "episode.webp"
    assert "docs/figures/episode.webp" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert Path(file).stat().st_size < 2_000_000
    with Image.open(file) as picture:
        assert getattr(picture, "n_frames", 1) > 50
