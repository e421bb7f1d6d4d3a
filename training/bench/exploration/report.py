"""Study of `vslam bench exploration`: tables, paired differences and curves of its trials."""

from training.bench.exploration.config import NO_ORACLE, ExplorationConfig, Trial
from training.bench.exploration.players import label
from training.bench.exploration.trials import CURVES, checks, play
from training.experiments.output.tables import E_SCALE
from training.experiments.study import Column, Curves, ResultTable, Study, Words

PLACE = ("world", "robots")
CONDITION = (*PLACE, "policy", "oracle")
WORDS: Words = {
    "world": ("world", label), "robots": ("robots", lambda robots: f"K={robots}"), "policy": ("policy", label),
}  # fmt: skip
OVER_TIME = Column("mean_coverage", "over time [%]", digits=1, factor=100.0, interval=True)
BELOW_90 = Column("below_90_s", "below 90 % [s]", digits=1, interval=True)
MAP = (
    Column("map_error", "E [cm]", digits=1, factor=100.0, interval=True),
    Column("map_rmse_m", "RMSE [cm]", digits=1, factor=100.0, interval=True),
)
RECALL = Column("map_recall", digits=1, interval=True)
POSE = Column("pose_error", "pose [cm]", digits=1, factor=100.0, interval=True)
COMPARED = (OVER_TIME, BELOW_90, MAP[0], RECALL, POSE)

TABLES = (
    ResultTable(
        name="coverage", title="Coverage", by=CONDITION, each=PLACE, words=WORDS,
        columns=(
            Column("seeds", statistic=len, digits=0), Column("coverage", digits=1, interval=True), OVER_TIME, BELOW_90,
            Column("reached_90", "90 % reached [%]", digits=0, factor=100.0),
        ),
    ),
    ResultTable(
        name="maps", title="Maps and poses", by=CONDITION, each=PLACE, words=WORDS, note=E_SCALE,
        columns=(
            *MAP, Column("map_recall", digits=1), Column("map_precision", digits=1), POSE,
            Column("ate_start_m", "ATE [cm]", digits=1, factor=100.0),
        ),
    ),
    ResultTable(
        name="merges", title="Merges", by=CONDITION, each=PLACE, words=WORDS,
        columns=(
            Column("right_merges", "right", digits=2), Column("false_merges", "false", digits=2),
            Column("undone_merges", "undone", digits=2), Column("first_merge_s", "first [s]", digits=0),
            Column("last_merge_s", "last [s]", digits=0), Column("one_group", "one group [%]", digits=0, factor=100.0),
        ),
    ),
    ResultTable(
        name="driving", title="Driving and decisions", by=CONDITION, each=PLACE, words=WORDS,
        columns=(
            Column("way_m", "path [m]", digits=0), Column("collisions", "blocked [s]", digits=1, factor=0.1),
            Column("invalid_actions", digits=1), Column("decision_ms", "decision [ms]", digits=2),
            Column("decision_p99_ms", "99 % [ms]", digits=2),
        ),
    ),
    ResultTable(
        name="policies", title="Paired differences to the first policy", by=CONDITION, each=PLACE, words=WORDS,
        columns=COMPARED, against="policy",
    ),
    ResultTable(
        name="oracles", title="Paired differences to no oracle", by=CONDITION, each=PLACE, words=WORDS,
        columns=COMPARED, against="oracle", base=NO_ORACLE,
    ),
)  # fmt: skip

STUDY = Study(
    name="exploration",
    config=ExplorationConfig,
    trial=Trial,
    trials=ExplorationConfig.trials,
    play=play,
    checks=lambda config: checks(config, config.trials()),
    tables=TABLES,
    curves=Curves(
        by=CONDITION, rows=PLACE, words=WORDS, columns=tuple(Column(name) for name in CURVES),
    ),
)  # fmt: skip
