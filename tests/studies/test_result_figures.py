"""Figures of the page of results are those of its tables."""

from pathlib import Path

import pytest
from PIL import Image, ImageChops

from studies.result_figures import PAGE, ROOT, draw_beside_gtsam, draw_loop, read_table


def test_tables_are_read_by_their_first_heading() -> None:
    """Labels lose their code marks, and numbers their commas."""
    page = "text\n\n| a | b | c |\n|---|---|---|\n| x `y` | 1,108 | .5 |\n| z | 2 | 3 |\n\nmore\n"
    assert read_table(page, "a") == (["a", "b", "c"], [("x y", [1108.0, 0.5]), ("z", [2.0, 3.0])])
    with pytest.raises(ValueError, match="page: expected a table whose first heading is 'q', got no such table"):
        read_table(page, "q")


@pytest.mark.parametrize(("draw", "name"), [(draw_loop, "loop"), (draw_beside_gtsam, "beside_gtsam")])
def test_kept_figures_show_the_tables(draw: object, name: str, tmp_path: Path) -> None:
    """A figure that is drawn again hardly differs from the kept one; fonts may."""
    assert callable(draw)
    draw(PAGE.read_text(encoding="utf-8"), tmp_path / "new.png")
    kept = Image.open(ROOT / "docs" / "figures" / f"{name}.png").convert("L")
    drawn = Image.open(tmp_path / "new.png").convert("L")
    assert drawn.size == kept.size
    changed = sum(ImageChops.difference(drawn, kept).histogram()[64:])
    assert changed < 0.02 * kept.width * kept.height
