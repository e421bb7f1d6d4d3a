"""Data sets of `vslam record`: what files hold, that they repeat, and what readers refuse."""

import hashlib
import io
import json
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

from training.cli import app
from training.commands import record as command
from training.dataset import recording
from training.dataset.card import CARD, LOAD, SUMS
from training.dataset.config import RecordConfig
from training.dataset.reading import load_episodes, read_description, to_minari
from training.dataset.recording import ABOUT, check_room, fields_of, memory_of, packed, play
from vslam_env.belief.observation_keys import KEYS

ROBOTS, STEPS, EPISODES = 2, 17, 3
OPTIONS = (
    "--world", "fig5", "--robots", str(ROBOTS), "--max-cycles", str(STEPS), "--particles", "5", "--episodes",
    str(EPISODES), "--first-seed", "40",
)  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a data set with all keys and goal actions, made by the command."""
    folder: Path = tmp_path_factory.mktemp("recorded") / "set"
    arguments = ["record", *OPTIONS, "--action-type", "goal", "--observations", "all", "--out", str(folder)]
    get_command(app).main(arguments, standalone_mode=False)
    return folder


@pytest.fixture
def copy(recorded: Path, tmp_path: Path) -> Path:
    """Copy of the data set that may be damaged."""
    return Path(shutil.copytree(recorded, tmp_path / "set"))


def config_of(folder: Path) -> RecordConfig:
    """Return the configuration of a data set."""
    content = tomllib.loads((folder / "config.toml").read_text())
    return RecordConfig.from_mapping(content["config"] | {"seed": content["seed"]})


def test_recorded_actions_give_the_recorded_observations(recorded: Path) -> None:
    """An environment of the recipe, reset with the seed and stepped by the actions, returns what the file holds."""
    config = config_of(recorded)
    env = config.make_env()
    episodes = list(load_episodes(recorded))
    assert [episode.seed for episode in episodes] == [40, 41, 42]
    for episode in episodes[::2]:
        observations, infos = env.reset(seed=episode.seed)
        assert set(episode.observations) == set(KEYS)
        for step in range(STEPS + 1):
            for robot, agent in enumerate(env.possible_agents):
                for key, value in observations[agent].items():
                    np.testing.assert_array_equal(episode.observations[key][robot, step], value)
                    assert episode.observations[key].dtype == value.dtype
                assert episode.estimates["groups"][robot, step] == infos[agent]["group"]
                assert episode.truth["map_errors"][robot, step] == infos[agent]["map_error"]
            np.testing.assert_array_equal(episode.truth["poses"][:, step], env.true_poses)
            if step == STEPS:
                break
            actions = dict(zip(env.possible_agents, episode.actions[:, step], strict=True))
            observations, rewards, ended, cut, infos = env.step(actions)
            for name, values in (("rewards", rewards), ("terminations", ended), ("truncations", cut)):
                assert getattr(episode, name)[:, step].tolist() == list(values.values())
        assert not env.agents
        assert episode.truncations[:, -1].all()
        np.testing.assert_allclose(episode.times, np.arange(STEPS + 1.0))
        np.testing.assert_array_equal(episode.truth["walls"], env.episode.scenario.world.walls)
        np.testing.assert_array_equal(episode.truth["landmarks"], env.true_landmarks)


def test_plain_numpy_reads_the_files_as_the_card_says(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The program on the card runs in the folder, and its table lists exactly the arrays of a file."""
    card = (recorded / CARD).read_text()
    assert LOAD in card
    monkeypatch.chdir(recorded)
    exec(LOAD, {})
    assert f"({ROBOTS}, {STEPS + 1}, 3) ({ROBOTS}, {STEPS})" in capsys.readouterr().out
    with np.load("episode_00000.npz") as episode:
        assert [line.split("`")[1] for line in card.splitlines() if line.startswith("| `")] == list(episode)
    assert f"{EPISODES} of {EPISODES} episodes of {ROBOTS} robots: world fig5" in card


def test_digests_are_those_of_sha256sum(recorded: Path) -> None:
    """The file of digests has a line for each episode; its own digest is that of the data set."""
    lines = (recorded / SUMS).read_text()
    for line in lines.splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((recorded / name).read_bytes()).hexdigest() == digest
    assert len(lines.splitlines()) == EPISODES
    assert read_description(recorded).sha256 == hashlib.sha256(lines.encode()).hexdigest()
    assert hashlib.sha256(lines.encode()).hexdigest() in (recorded / CARD).read_text()


def test_a_stopped_data_set_is_completed_with_the_same_bytes(copy: Path, recorded: Path, vslam: Any) -> None:
    """After a kill in the middle of a row, the same command keeps finished episodes and repeats the others."""
    rows = (copy / "trials.jsonl").read_text()
    (copy / "trials.jsonl").write_text(rows[: rows.index("\n") + 30])
    (copy / "episode_00001.npz").write_bytes(b"cut short")
    (copy / "episode_00002.npz").unlink()
    kept = (copy / "episode_00000.npz").stat().st_mtime_ns
    arguments = (*OPTIONS, "--action-type", "goal", "--observations", "all", "--out", str(copy))
    said = vslam("record", *arguments)
    assert said.status == 0, said.err
    assert "1 of 3 trials are finished, 2 are left" in said.out
    assert (copy / "episode_00000.npz").stat().st_mtime_ns == kept
    for name in (SUMS, "metrics.json", "trials.jsonl", "environment.toml"):
        assert (copy / name).read_bytes() == (recorded / name).read_bytes()
    (copy / "episode_00002.npz").unlink()
    said = vslam("record", *arguments)
    assert said.status == 2
    assert "expected all files of the data set, got a missing file" in said.err


@pytest.mark.slow
def test_workers_and_a_verification_give_the_same_bytes(recorded: Path, copy: Path, vslam: Any) -> None:
    """Two processes write the bytes of one; a verification finds an exchanged episode, with status 1."""
    again = copy.parent / "again"
    assert vslam("record", "--config", str(recorded), "--out", str(again), "--workers", "2").status == 0
    assert (again / SUMS).read_bytes() == (recorded / SUMS).read_bytes()
    said = vslam("record", "--verify", str(copy))
    assert said.status == 0
    assert "3 of 3 episodes played again, 3 with the same bytes." in said.out
    shutil.copy(copy / "episode_00000.npz", copy / "episode_00001.npz")
    said = vslam("record", "--verify", str(copy))
    assert said.status == 2
    assert "has changed since it was recorded" in said.err
    content = json.loads((copy / "metrics.json").read_text())
    content["episodes"][1]["sha256"] = content["episodes"][0]["sha256"]
    (copy / "metrics.json").write_text(json.dumps(content))
    said = vslam("record", "--verify", str(copy))
    assert said.status == 1
    assert "Different episodes: 1 (" in said.out


def test_verification_takes_no_other_options(copy: Path, refusal: Any) -> None:
    """Options that the data set fixes are refused with it, and so is a custom policy that only its file names."""
    assert "verify: expected no options that the data set fixes, got ['robots']" in refusal(
        "record", "--verify", str(copy), "--robots", "2"
    )
    file = copy / "config.toml"
    file.write_text(file.read_text().replace('policy = "frontier"', 'policy = "no_module:Missing"'))
    assert "expected custom policies that the command line names, too" in refusal("record", "--verify", str(copy))


def test_a_failing_policy_leaves_its_episode_out(vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other episodes are recorded, and the exit status is 2."""
    real: Callable[..., Any] = recording.run_episode

    def fail(env: Any, team: Any, seed: int, *more: Any, **options: Any) -> Any:
        if seed == 41:
            raise recording.PolicyError("policy 'x': expected act() to return, got nothing.")
        return real(env, team, seed, *more, **options)

    monkeypatch.setattr(recording, "run_episode", fail)
    said = vslam("record", *OPTIONS, "--policy", "random_walk", "--out", str(tmp_path / "set"))
    assert said.status == 2
    assert "policy 'x': expected act() to return" in said.out
    assert [episode.seed for episode in load_episodes(tmp_path / "set")] == [40, 42]
    assert "2 of 3 episodes" in (tmp_path / "set" / CARD).read_text()


def forged(arrays: dict[str, Any], **changed: Any) -> bytes:
    """Return an archive with some arrays changed; None removes one."""
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **{k: v for k, v in (arrays | changed).items() if v is not None})
    return stream.getvalue()


class Trap:
    """Object that leaves a trace when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path("trace").write_text, ("unpickled",)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda a: b"no archive", "broken file"),
        (lambda a: packed(a)[:-300], "broken file"),
        (lambda a: forged(a, actions=None), "it lacks or adds .*actions"),
        (lambda a: forged(a, more=np.zeros(3)), "it lacks or adds .*more"),
        (lambda a: forged(a, rewards=np.zeros((ROBOTS, STEPS), np.float32)), "rewards is float32"),
        (lambda a: forged(a, rewards=np.zeros((ROBOTS, STEPS + 1))), "rewards has the shape"),
        (lambda a: forged(a, times=np.full(STEPS + 1, np.nan)), "times has numbers that are not finite"),
        (lambda a: forged(a, actions=np.array([[Trap()]], object)), "actions.npy holds object"),
    ],
)
def test_files_with_other_content_are_refused(
    change: Callable[[dict[str, Any]], bytes], says: str, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a fitting digest, an archive cut short, with other arrays or with objects gives one error; no code runs."""
    monkeypatch.chdir(copy)
    with np.load(copy / "episode_00001.npz") as archive:
        content = change(dict(archive))
    (copy / "episode_00001.npz").write_bytes(content)
    episodes = load_episodes(copy)
    next(episodes)
    with pytest.raises(ValueError, match=r"has changed since it was recorded\. Copy it again\."):
        next(episodes)
    about = json.loads((copy / "metrics.json").read_text())
    about["episodes"][1]["sha256"] = hashlib.sha256(content).hexdigest()
    (copy / "metrics.json").write_text(json.dumps(about))
    episodes = load_episodes(copy)
    next(episodes)
    with pytest.raises(ValueError, match=f"folder: expected a data set of vslam record, .*{says}|{says}"):
        next(episodes)
    assert not (copy / "trace").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda about: about.update(format=9), "one of format 1, got a data set of format 9"),
        (lambda about: about["episodes"][0].update(file="../secret.npz"), "got a damaged description"),
        (lambda about: about["arrays"]["times"].update(shape=[-1]), "an axis of length -1"),
        (lambda about: about["arrays"]["times"].update(dtype="object"), "numbers of type 'object'"),
        (lambda about: about.pop("arrays"), "got a damaged description"),
    ],
)
def test_other_descriptions_are_refused(change: Callable[[Any], Any], says: str, copy: Path) -> None:
    """A description of another format, with paths, negative lengths or objects gives one error."""
    about = json.loads((copy / "metrics.json").read_text())
    change(about)
    (copy / "metrics.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="folder: expected") as refused:
        load_episodes(copy)
    assert says in str(refused.value)
    (copy / "metrics.json").unlink()
    with pytest.raises(ValueError, match=r"folder: expected a data set of vslam record, got no metrics\.json"):
        load_episodes(copy)


def test_rooms_for_episodes_are_checked_before_any_is_played(refusal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode above 1 GiB, and a disk with too little room, are refused before the folder is made."""
    assert "max_seconds: expected episodes of at most 1024 MiB, got '" in refusal(
        "record", "--world", "fig5", "--max-cycles", "100000"
    )
    monkeypatch.setattr(recording.shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    assert "out: expected a disk with " in refusal("record", *OPTIONS)


def test_memory_is_that_of_the_arrays(recorded: Path) -> None:
    """The announced memory is the size of all arrays but walls and landmarks."""
    config = config_of(recorded)
    env = config.make_env()
    with np.load(recorded / "episode_00000.npz") as archive:
        sizes = {name: array.nbytes for name, array in archive.items()}
    total = sum(sizes.values()) - sizes["truth/walls"] - sizes["truth/landmarks"]
    assert memory_of(fields_of(env), config.num_steps) == total
    assert check_room(config, env, None).startswith("Size: about 0.")


def test_episodes_that_end_early_are_cut(tmp_path: Path) -> None:
    """Arrays of an episode that terminates before its limit have its length."""

    class Short(RecordConfig):
        def environment(self) -> Any:
            return super().environment().replace(stop_at_recall=1e-6)

    config = Short(world="fig5", robots=1, max_cycles=60, particles=5, policy="random_walk", seed=3)
    row = play(config, tmp_path, config.trials()[0])
    with np.load(tmp_path / row["file"]) as archive:
        assert archive["terminations"][:, -1].all()
        assert not archive["truncations"].any()
        assert archive["actions"].shape == (1, row["steps"], 2)
        assert len(archive["times"]) == row["steps"] + 1 < 61


def test_sets_without_keys_that_the_policy_reads_are_refused(refusal: Any) -> None:
    """A model of goal actions reads keys that the driver's set lacks."""
    said = refusal("record", "--policy", "learned", "--action-type", "goal", "--observations", "driver")
    assert said.startswith("error observations: expected a set with all keys that the policy reads, such as ")


def test_all_keys_have_units_and_meanings() -> None:
    """Each key of observations has an entry, so that each can be recorded."""
    assert set(ABOUT) == set(KEYS)
    assert command.ENVIRONMENT == "environment.toml"


@pytest.mark.filterwarnings("ignore::UserWarning")  # Minari recommends an author, an environment, and more
@pytest.mark.parametrize("data_format", ["arrow", "hdf5"])
def test_minari_reads_what_was_recorded(
    data_format: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each robot of each episode is an episode of Minari, bit for bit, in both of its formats."""
    minari = pytest.importorskip("minari", reason="Minari is not installed: pip install 'minari[hdf5,arrow]'")
    pytest.importorskip({"arrow": "pyarrow", "hdf5": "h5py"}[data_format], reason="Minari's format is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    to_minari(recorded, "vslam/fig5/frontier-v0", data_format=data_format, author="an engineer")
    found = minari.load_dataset("vslam/fig5/frontier-v0")
    assert (found.total_episodes, found.total_steps) == (EPISODES * ROBOTS, EPISODES * ROBOTS * STEPS)
    assert found.action_space.n == 33
    number = 0
    for episode in load_episodes(recorded):
        for robot in range(ROBOTS):
            (own,) = found.iterate_episodes([number])
            for key, values in episode.observations.items():
                np.testing.assert_array_equal(own.observations[key], values[robot])
                assert found.observation_space[key].contains(own.observations[key][0])
            np.testing.assert_array_equal(own.actions, episode.actions[robot])
            np.testing.assert_array_equal(own.rewards, episode.rewards[robot])
            np.testing.assert_array_equal(own.truncations, episode.truncations[robot])
            np.testing.assert_array_equal(own.infos["true_pose"], episode.truth["poses"][robot])
            number += 1


def test_a_missing_minari_is_named(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package the error has the command that installs it."""
    monkeypatch.setitem(sys.modules, "minari", None)
    says = r"minari: expected the package minari, got .*pip install 'minari\[hdf5,arrow\]'"
    with pytest.raises(ValueError, match=says):
        to_minari(recorded, "vslam/none-v0")
