"""The leaderboard is that of the kept results."""

from pathlib import Path

from training.bench.exploration.leaderboard import leaderboard, read_results

ROOT = Path(__file__).parents[2]


def test_the_leaderboard_is_made_from_the_kept_results() -> None:
    """`vslam bench leaderboard benchmarks/vslam-bench-v0/*/ --out docs/reference/leaderboard.md` gives the page."""
    kept = sorted(file.parent for file in (ROOT / "benchmarks" / "vslam-bench-v0").glob("*/config.toml"))
    page = (ROOT / "docs" / "reference" / "leaderboard.md").read_text(encoding="utf-8")
    assert page == leaderboard([read_results(folder) for folder in kept], "leaderboard.png")
