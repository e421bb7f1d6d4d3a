import itertools
import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from agents.registry import LEARNED
from agents.trained import load_model, save_model
from slam_backend.geometry import between, compose
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.trajectory import Trajectory
from training.commands.run import describe, errors_in_short, live_progress
from training.episodes import figures
from training.episodes.config import EPISODE_S, RunConfig
from training.episodes.figures import LETTER, draw_errors, draw_maps, place_labels, turns
from training.episodes.metrics import score_episode
from training.episodes.runner import EpisodeRecord, MergeRecord, Progress, run_episode
from training.episodes.tables import print_tables
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig
from vslam_env.presets import preset_config
from vslam_env.world import World

# A room of 7 x 5 m in which two robots see the same wall from different places.
ROOM = World(
    "room",
    np.array([[0.0, 0.0, 7.0, 0.0], [7.0, 0.0, 7.0, 5.0], [7.0, 5.0, 0.0, 5.0], [0.0, 5.0, 0.0, 0.0]]),
    start_poses=np.array([[2.0, 1.5, 0.2], [1.5, 3.5, -0.4]]),
)
STEPS = 31
MERGE_KEYS = {"step", "time_s", "robots_a", "robots_b", "landmarks", "error_m", "error_deg", "false", "undone_s"}


def play(**options: object) -> EpisodeRecord:
    """Return the record of two random walkers in the room."""
    config = RunConfig(robots=2, policy="random_walk", seed=3)
    env = vslam_v0.parallel_env(**{"world": ROOM, "num_robots": 2, "max_cycles": STEPS, "num_particles": 13} | options)
    return run_episode(env, config.make_policies(env), config.seed)


@pytest.fixture(scope="module")
def record() -> EpisodeRecord:
    """Return an episode in which the oracle merges both maps as soon as they share three landmarks."""
    return play(oracle_merge=True)


def test_a_record_has_a_row_for_the_reset_and_for_each_step(record: EpisodeRecord) -> None:
    """Times, poses, errors and coverage have one entry more than there are steps, and start at the reset."""
    assert record.complete
    np.testing.assert_allclose(record.times, 0.1 * np.arange(STEPS + 1))
    for poses in (record.true_poses, record.estimated, record.reckoned):
        assert poses.shape == (2, STEPS + 1, 3)
    assert record.map_errors.shape == (2, STEPS + 1)
    assert record.coverage.shape == (STEPS + 1,)
    np.testing.assert_allclose(record.true_poses[:, 0], ROOM.start_poses)
    np.testing.assert_allclose(record.estimated[:, 0], 0.0, atol=1e-9)
    np.testing.assert_array_equal(record.reckoned[:, 0], 0.0)
    assert record.coverage[-1] >= record.coverage[0] > 0.0


def test_the_oracle_merges_without_error(record: EpisodeRecord) -> None:
    """A merge with the true transform has no error, and both robots are alone until then."""
    (merge,) = record.merges
    assert (merge.robots_a, merge.robots_b) == ((0,), (1,))
    assert merge.error_m < 1e-9
    assert merge.error_deg < 1e-9
    assert not merge.is_false
    assert record.groups == ((0, 1),)
    assert record.alone_until == (merge.time, merge.time)


def test_an_episode_repeats_from_its_seed() -> None:
    """The same seed gives the same record, bit by bit; goal actions are recorded tick by tick as well."""
    first, second = play(), play()
    for name in ("true_poses", "estimated", "reckoned", "map_errors", "coverage"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    config = RunConfig(robots=2, action_type="goal", seed=3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, action_type="goal", max_cycles=3, num_particles=13)
    goal = run_episode(env, config.make_policies(env), config.seed)
    np.testing.assert_allclose(goal.times, [0.0, 1.0, 2.0, 3.0])
    # Thirty readings are chained to three rows: noisy, but within the error of odometry after three metres.
    for robot in range(2):
        truth = between(goal.true_poses[robot, 0], goal.true_poses[robot])
        assert np.abs(goal.reckoned[robot] - truth).max() < 0.5


def test_an_episode_can_be_stopped() -> None:
    """`should_stop` ends the episode after the current step, and the record is marked incomplete."""
    config = RunConfig(robots=2, policy="random_walk", seed=3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, max_cycles=STEPS, num_particles=13)
    seen: list[int] = []
    stopped = run_episode(env, config.make_policies(env), 3, lambda p: seen.append(p.step), lambda: len(seen) > 5)
    assert seen == [0, 1, 2, 3, 4, 5]
    assert not stopped.complete
    assert len(stopped.times) == 6


def test_an_episode_leaves_the_recorder_as_it_was() -> None:
    """Episodes in one environment do not keep each other's readings; a recorder that was there gets those of both."""
    config = RunConfig(robots=2, policy="random_walk", seed=3)
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2, max_cycles=4, num_particles=13)
    run_episode(env, config.make_policies(env), 3)
    assert env.recorder is None
    seen: list[Any] = []
    env.recorder = seen.append
    kept = env.recorder
    for _ in range(2):
        run_episode(env, config.make_policies(env), 3)
        assert env.recorder is kept
    assert len(seen) == 10


def test_every_agent_needs_a_policy() -> None:
    """A missing policy is reported before anything runs."""
    env = vslam_v0.parallel_env(world=ROOM, num_robots=2)
    with pytest.raises(ValueError, match=r"policies: expected a policy for each agent, got no policy for \['robot_0'"):
        run_episode(env, {}, 0)


def test_a_perfect_path_scores_zero_and_dead_reckoning_is_scored(record: EpisodeRecord) -> None:
    """The true path scores 0; one that ends 0.6 m off after 12 m is 5 % off; a pure rotation is aligned away."""
    own = between(record.true_poses[:, :1], record.true_poses)
    off = own.copy()
    off[:, -1, 0] += 0.6
    infos = tuple({**info, "distance": 12.0} for info in record.infos)
    metrics = score_episode(replace(record, estimated=own, reckoned=off, infos=infos))
    for robot in metrics["robots"]:
        assert robot["ate_start_m"] < 1e-12
        assert robot["ate_aligned_m"] < 1e-12
        assert robot["dead_reckoning_end_percent"] == pytest.approx(5.0)
        assert robot["dead_reckoning_ate_start_m"] == pytest.approx(0.6 / np.sqrt(STEPS + 1))
    turned = score_episode(replace(record, estimated=compose([0.0, 0.0, 0.3], own)))
    for robot in turned["robots"]:
        assert robot["ate_start_m"] > 10.0 * robot["ate_aligned_m"]
    assert metrics["team"]["path_m"] == 12.0


def test_metrics_have_the_promised_names(record: EpisodeRecord) -> None:
    """External checks rely on these keys."""
    metrics = score_episode(record)
    assert {"robots", "merges", "groups", "coverage", "attempts", "refusals"} <= set(metrics)
    assert sum(row["attempts"] for row in metrics["refusals"]) == metrics["attempts"]
    promised = {
        "ate_aligned_m", "ate_start_m", "dead_reckoning_ate_aligned_m", "map_rmse_m", "map_recall", "map_precision",
        "map_error", "map_rmse_start_m", "map_rmse_aligned_m", "robot",
    }  # fmt: skip
    assert all(promised <= set(robot) for robot in metrics["robots"])
    assert set(metrics["merges"][0]) == MERGE_KEYS
    for robot in metrics["robots"]:
        assert robot["map_rmse_aligned_m"] <= robot["map_rmse_start_m"] == robot["map_rmse_m"]


@pytest.mark.parametrize(("error_m", "error_deg", "false"), [(0.5, 5.0, False), (0.51, 0.0, True), (0.0, 5.1, True)])
def test_a_merge_is_false_beyond_half_a_metre_or_five_degrees(error_m: float, error_deg: float, false: bool) -> None:
    """Each limit of the definition suffices."""
    merge = MergeRecord(12, 1.2, (0,), (1, 2), 9, error_m, error_deg)
    assert merge.is_false is false
    assert describe(merge).startswith("   1.2 s  maps of 0 and 1, 2 merged on 9 landmarks, error")


def test_figures_are_drawn_for_any_team(record: EpisodeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One robot or eight, merged or not, and a run stopped at once: all give two plots with their whole legends."""
    written = figures.save_png

    def check_legend(figure: Figure, file: Path, dpi: int) -> None:
        written(figure, file, dpi)
        owners = [figure, *figure.subfigs]
        (legend,) = (legend for owner in owners for legend in owner.legends)
        box = legend.get_window_extent()
        assert figure.bbox.padded(1.0).contains(*box.min)
        assert figure.bbox.padded(1.0).contains(*box.max)
        axes = [each for owner in owners for each in owner.axes if each.get_visible()]
        assert not any(box.overlaps(each.get_window_extent()) for each in axes)

    monkeypatch.setattr(figures, "save_png", check_legend)

    def cut(robots: int, rows: int) -> EpisodeRecord:
        chosen = [k % 2 for k in range(robots)]
        return replace(
            record, times=record.times[:rows], coverage=record.coverage[:rows],
            map_errors=record.map_errors[chosen, :rows],
            **{n: getattr(record, n)[chosen, :rows] for n in ("true_poses", "estimated", "reckoned")},
            infos=tuple(record.infos[k] for k in chosen), own_maps=tuple(record.own_maps[k] for k in chosen),
            alone_until=tuple(None if k == 0 else 1.0 for k in chosen),
            scene=replace(record.scene, robots=tuple(record.scene.robots[k] for k in chosen)),
            merges=record.merges * (robots - 1),
        )  # fmt: skip

    for robots, rows in ((1, 1), (1, STEPS), (8, STEPS)):
        for draw in (draw_maps, draw_errors):
            file = tmp_path / f"{draw.__name__}-{robots}-{rows}.png"
            draw(cut(robots, rows), file)
            assert file.read_bytes().startswith(b"\x89PNG")


def test_robots_that_share_a_map_draw_their_curves_in_turn(record: EpisodeRecord) -> None:
    """Before a merge each robot draws its curve all the time, afterwards exactly one of the group at a time."""
    (merge,) = record.merges
    before, drawn = record.times < merge.time, turns(record)
    assert drawn[:, before].all()
    assert (drawn[:, ~before].sum(axis=0) == 1).all()
    assert drawn[:, ~before].any(axis=1).all()
    undone = turns(replace(record, merges=(replace(merge, undone=merge.time + 1.0),)))
    assert undone[:, record.times >= merge.time + 1.0].all()


def test_labels_of_merges_neither_overlap_nor_leave_the_plot() -> None:
    """Labels of any times and lengths lie within the plot, and those of one row apart from each other."""
    rng, width, end = np.random.default_rng(4), 8.0, 180.0
    for _ in range(50):
        times = np.sort(rng.uniform(0.0, end, 7)).tolist()
        labels = ["0, 1 + 2 merged" + "x" * int(rng.integers(0, 30)) for _ in times]
        spans: dict[int, list[tuple[float, float]]] = {}
        for (row, is_left), time, label in zip(place_labels(times, labels, end, width), times, labels, strict=True):
            at, length = width * time / end, LETTER * len(label)
            spans.setdefault(row, []).append((at - length, at) if is_left else (at, at + length))
        for own in spans.values():
            own.sort()
            assert own[0][0] >= 0.0
            assert own[-1][1] <= width
            assert all(first[1] < second[0] for first, second in itertools.pairwise(own))


def test_tables_show_unknown_values_as_a_dash(record: EpisodeRecord) -> None:
    """A missing value is a dash, units in brackets are kept, and a false merge is marked."""
    metrics = score_episode(record)
    metrics["robots"][1]["map_rmse_m"] = None
    metrics["merges"][0]["false"] = True
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115 - closed with the console
    print_tables(console, metrics)
    console.file.close()
    text = console.export_text()
    for word in ("E [m]", "0.71 m = nothing found", "error [deg]", "false", " - ", "robot", "team"):
        assert word in text


def test_merges_are_printed_live(record: EpisodeRecord) -> None:
    """Each merge is printed when it happens, beside the bar."""
    with open("/dev/null", "w") as nowhere:
        console = Console(width=120, record=True, file=nowhere)
        infos = {f"robot_{k}": info for k, info in enumerate(record.infos)}
        with live_progress(console, STEPS, list(infos)) as show:
            show(Progress(5, 0.5, infos, record.merges))
    assert "maps of 0 and 1 merged" in console.export_text()


def test_tables_of_eight_robots_fit_into_80_columns(record: EpisodeRecord) -> None:
    """Each robot has a row with all metrics, also at 80 columns and with large numbers."""
    metrics = score_episode(record)
    row = metrics["robots"][0] | {"path_m": 1234.5, "ate_start_m": 12.345}
    with open("/dev/null", "w") as nowhere:
        console = Console(width=80, record=True, file=nowhere)
        print_tables(console, metrics | {"robots": [row] * 8, "merges": []})
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if line.split()[:1] in ([str(robot)] for robot in range(8))]
    assert [len(cells) for cells in rows] == [5] * 8 + [7] * 8
    assert rows[8][3] == "12.3"


def test_the_bar_of_eight_robots_has_mean_and_range() -> None:
    """Map errors of many robots are shown in short; those of three are listed."""
    assert errors_in_short([0.1, 0.2, 0.3]) == "0.10 0.20 0.30"
    assert errors_in_short([0.7] * 7 + [0.3]) == "0.65 (0.30 to 0.70)"


def test_a_run_takes_worlds_of_a_split() -> None:
    """`world_split` reaches the environment and the run folder; other names are refused."""
    config = RunConfig(world="maze", world_split="test", robots=1)
    assert config.environment().world_split == "test"
    assert config.to_mapping()["world_split"] == "test"
    with pytest.raises(ValueError, match="world_split: expected one of 'train', 'validation', 'test', got 'any'"):
        RunConfig(world_split="any")


SHORT = ("--robots", "2", "--particles", "11", "--max-cycles", "23", "--world", "fig5")


@pytest.mark.slow
def test_a_run_folder_repeats_itself(vslam: Any, tmp_path: Path) -> None:
    """A run writes all documented files, and its config repeats its paths and metrics exactly."""
    one, two, copy = tmp_path / "one", tmp_path / "two", tmp_path / "copy.json"
    assert vslam("run", *SHORT, "--seed", "5", "--out", str(one), "--json", str(copy)).status == 0
    assert vslam("run", "--config", str(one / "config.toml"), "--no-video", "--out", str(two)).status == 0
    names = {file.name for file in one.iterdir()}
    paths = {f"robot{k}_{kind}.tum" for k in range(2) for kind in ("estimate", "dead_reckoning", "truth")}
    usual = {"config.toml", "environment.toml", "metrics.json", "map.png", "error.png", "video.mp4"}
    usual |= {"recording.npz", "report.html"}
    groups = json.loads((one / "metrics.json").read_text())["groups"]
    stems = {f"map_{'-'.join(map(str, group))}" for group in groups}
    assert names == paths | usual | {f"{stem}.{kind}" for stem in stems for kind in ("npz", "csv", "ply")} | {
        stem.replace("map_", "grid_") + suffix for stem in stems for suffix in (".yaml", ".pgm")
    }
    assert all(len(LandmarkMap.load(one / f"{stem}.npz")) > 0 for stem in stems)
    assert {file.name for file in two.iterdir()} == names - {"video.mp4"}
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (one, two))
    assert first == second == json.loads(copy.read_text())
    assert (first["seed"], first["config"]["world"], first["complete"]) == (5, "fig5", True)
    for folder in (one, two):
        config = EnvConfig.from_toml(folder / "environment.toml")
        assert (config.world, config.num_robots, config.max_cycles) == ("fig5", 2, 23)
    for name in paths:
        assert (one / name).read_bytes() == (two / name).read_bytes()
        assert len(Trajectory.load_tum(one / name)) == 24


@pytest.mark.parametrize(("policy", "action_type"), [("a_policy_of_mine:Still", "discrete"), ("random_goals", "goal")])
def test_policies_determine_the_default_action_type(
    policy: str, action_type: str, vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The action type need not be given for a policy without continuous actions, built-in or custom."""
    lines = ("class Still:", "    action_type = 'discrete'", "    def reset(self): pass", "    def act(*_): return 0")
    (tmp_path / "a_policy_of_mine.py").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    few = ("--world", "fig5", "--robots", "1", "--max-cycles", "3", "--particles", "5", "--no-video", "--out", "run")
    assert vslam("run", "--policy", policy, *few).status == 0
    metrics = json.loads(Path("run/metrics.json").read_text())
    assert (metrics["config"]["policy"], metrics["config"]["action_type"]) == (policy, action_type)
    assert (metrics["robots"][0]["path_m"] == 0.0) is (action_type == "discrete")


def test_the_large_preset_brings_its_world_length_and_actions(vslam: Any, tmp_path: Path) -> None:
    """`--preset large` runs as `parallel_env(preset="large")` does; given options and the needs of a policy win."""
    large = RunConfig.from_mapping({"preset": "large"})
    assert large.environment() == preset_config("large")
    assert RunConfig.from_mapping({"preset": "large", "max_cycles": 7, "world": "maze"}).num_steps == 7
    assert RunConfig.from_mapping({"preset": "large", "policy": "random_walk"}).action_type == "continuous"
    assert RunConfig.from_mapping(RunConfig.merged(RunConfig(max_cycles=9).to_mapping(), {"preset": "large"})) == large
    few = ("--max-seconds", "2", "--robots", "2", "--particles", "5", "--no-video", "--world", "fig5")
    assert vslam("run", "--preset", "large", *few, "--out", str(tmp_path / "run")).status == 0
    config = json.loads((tmp_path / "run" / "metrics.json").read_text())["config"]
    assert (config["preset"], config["action_type"], config["world"]) == ("large", "goal", "fig5")


def test_start_poses_of_the_command_line_are_those_of_the_run(vslam: Any, tmp_path: Path) -> None:
    """Robots begin there, also in a repetition from the run folder; a place in a wall is refused by name."""
    starts = [[3.0, 3.0, 0.5], [8.0, 4.0, -1.0]]
    few = ("--world", "fig5", "--robots", "2", "--max-cycles", "3", "--particles", "5", "--no-video")
    given = ("--start-poses", "3,3,.5; 8, 4, -1")
    assert vslam("run", *few, *given, "--out", str(tmp_path / "one")).status == 0
    assert vslam("run", "--config", str(tmp_path / "one"), "--no-video", "--out", str(tmp_path / "two")).status == 0
    for folder in ("one", "two"):
        paths = [Trajectory.load_tum(tmp_path / folder / f"robot{k}_truth.tum") for k in range(2)]
        np.testing.assert_allclose([path.poses[0] for path in paths], starts, atol=1e-6)
    refused = vslam("run", *few, "--start-poses", "3,3,0; -9,4,0", "--out", str(tmp_path / "three"))
    assert refused.status == 2
    assert "start_poses[1]: expected a reachable place" in refused.err
    assert not (tmp_path / "three").exists()


def test_a_policy_that_never_returns_ends_the_run_with_one_line(
    vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Past the decision limit the run ends; the first three decisions have a minute, for they may compile kernels."""
    lines = (
        "class Spins:", "    def reset(self): self.left = 5", "    def act(self, *_):", "        self.left -= 1",
        "        while self.left < 0: pass", "        return 0",
    )  # fmt: skip
    (tmp_path / "a_policy_that_spins.py").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    few = ("--world", "fig5", "--robots", "1", "--max-cycles", "9", "--particles", "5", "--no-video", "--out", "run")
    said = vslam("run", "--policy", "a_policy_that_spins:Spins", *few, "--decision-limit", "0.4")
    assert said.status == 2
    assert said.err.count("expected decisions within 0.4 s, got one of at least 0.4 s") == 1
    assert "Traceback" not in said.err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_writes_partial_results(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, vslam: Any, tmp_path: Path
) -> None:
    """A signal after seven steps leaves a complete folder of these seven steps, and the exit status of the signal."""

    @contextmanager
    def stopping(*arguments: Any) -> Iterator[Callable[[Progress], None]]:
        with live_progress(*arguments) as usual:

            def show(progress: Progress) -> None:
                usual(progress)
                if progress.step == 7:
                    signal.raise_signal(number)

            yield show

    monkeypatch.setattr(sys.modules["training.commands.run"], "live_progress", stopping)
    assert vslam("run", *SHORT, "--out", str(tmp_path / "run")).status == 128 + number
    metrics: Mapping[str, object] = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["complete"] is False
    assert metrics["duration_s"] == pytest.approx(0.7)
    assert len(Trajectory.load_tum(tmp_path / "run" / "robot1_truth.tum")) == 8
    assert (tmp_path / "run" / "video.mp4").stat().st_size > 1000
    assert not [file for file in (tmp_path / "run").iterdir() if file.name.startswith(".")]


@pytest.mark.parametrize(("action_type", "step_s"), [("continuous", 0.1), ("discrete", 0.1), ("goal", 1.0)])
def test_episode_duration_does_not_depend_on_the_action_type(action_type: str, step_s: float) -> None:
    """By default the simulated time does not depend on the duration of a step."""
    config = RunConfig(action_type=action_type)
    assert config.step_s == pytest.approx(step_s)
    assert config.num_steps * config.step_s == pytest.approx(EPISODE_S)
    assert RunConfig.from_mapping(config.to_mapping()) == config.replace(max_seconds=EPISODE_S)
    assert config.replace(max_seconds=7.0).num_steps * step_s == pytest.approx(7.0)
    assert config.replace(max_cycles=7).make_env().max_cycles == 7
    assert config.replace(max_seconds=7.0).make_env().max_cycles == config.replace(max_seconds=7.0).num_steps


def test_a_given_limit_replaces_that_of_the_repeated_run() -> None:
    """An option for the length of the episode overrides the steps or seconds of the repeated run; two are refused."""
    earlier = RunConfig(max_cycles=5).to_mapping()
    assert RunConfig.from_mapping(RunConfig.merged(earlier, {"max_seconds": 3.0})) == RunConfig(max_seconds=3.0)
    assert RunConfig.from_mapping(RunConfig.merged(earlier, {"robots": 2})) == RunConfig(max_cycles=5, robots=2)
    with pytest.raises(ValueError, match="max_seconds: expected None together with max_cycles, got 3"):
        RunConfig(max_cycles=5, max_seconds=3.0)


def test_a_config_repeats_a_run_from_any_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The path of a world is stored as absolute path; the name of a family stays a name."""
    monkeypatch.chdir(tmp_path)
    assert RunConfig(world="plan.png").to_mapping()["world"] == str(tmp_path.resolve() / "plan.png")
    assert RunConfig(world="fig5").to_mapping()["world"] == "fig5"


@pytest.mark.parametrize("text", ["", "[[[", "num_robots = 1000", "max_cycles = inf", "num_robots = " + "9" * 5000])
def test_models_of_impossible_environments_are_refused(text: str, tmp_path: Path) -> None:
    """An environment of a training that cannot be made is an error of the model, in one line."""
    weights, about = load_model(LEARNED)
    save_model(tmp_path / "model.npz", weights, about | {"environment": text})
    with pytest.raises(ValueError, match=r"^policy: expected a model of .* Train again, .* cannot be used: .*\Z"):
        RunConfig(policy=str(tmp_path), action_type="goal").environment()
