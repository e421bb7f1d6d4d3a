"""Study of `vslam paper fig6`."""

from functools import partial

from training.experiments.study import Chart, Column, Panel, ResultTable, Study, Words
from training.paper.config import Fig6Config
from training.paper.fig6.claims import check_claims, over_robots
from training.paper.fig6.trials import BOUND, Trial, play, unfold

WORDS: Words = {"particles": ("M", lambda particles: str(particles or "-")), "robots": ("K", str)}
ERROR = Column("map_rmse_m", "map error [m]", interval=True)
TIME = Column("median_ms", "step [ms]", digits=2, interval=True)

STUDY = Study(
    name="fig6",
    config=Fig6Config,
    trial=Trial,
    trials=Fig6Config.trials,
    play=play,
    unfold=unfold,
    claims=check_claims,
    tables=(
        ResultTable(
            name="fig6", title="Map error and time of a step", by=("filter", "particles", "robots"), each=("filter",),
            words=WORDS,
            columns=(
                ERROR, Column("map_aligned_rmse_m", "after fit [m]", interval=True),
                Column("map_recall", digits=1), Column("pose_rms_m", "pose [m]"), TIME,
            ),
        ),
        ResultTable(
            name="robots", title="Map error, most over fewest robots", by=("filter", "particles"), words=WORDS,
            where=lambda row: row.get("map_rmse_m") is not None,
            columns=tuple(
                Column(name, heading, partial(over_robots, name), digits=2)
                for name, heading in (("map_rmse_m", "ratio"), ("map_aligned_rmse_m", "after fit"))
            ),
        ),
    ),
    chart=Chart(
        x="particles", label="particles M", by="robots", rows="filter", log=True,
        where=lambda row: row["proposal"] != BOUND,
        panels=(Panel(column=ERROR, log=True), Panel(column=TIME, log=True)),
    ),
)  # fmt: skip
