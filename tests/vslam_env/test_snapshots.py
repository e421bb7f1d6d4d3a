import copy
import hashlib
import os
import pickle
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same, digest
from builders.damage import Trap
from builders.environments import MEETING, small_env, wander

from slam_backend.state.codec import encode
from slam_backend.state.format import equal, format_of
from slam_backend.team import merge
from slam_backend.team.branches import Branch
from vslam_env import EnvConfig, ExplorationEnv, load_state, save_state, vslam_v0
from vslam_env.reward import RUNNING_COST
from vslam_env.snapshots import EnvParts, check_state, state_version

FURTHER = 300
FORMAT = format_of(EnvParts)


def _env(action_type: str = "continuous", **kwargs: Any) -> ExplorationEnv:
    return small_env(action_type=action_type, max_cycles=1000, **kwargs)


def _begun(action_type: str = "continuous", steps: int = 20) -> ExplorationEnv:
    """Return an environment some steps after a reset from which its two robots soon merge."""
    env = _env(action_type)
    env.reset(seed=5, options={"start_poses": MEETING})
    _go_on(env, steps, seed=1)
    return env


def _go_on(env: ExplorationEnv, steps: int, seed: int = 7) -> str:
    """Return the hash of all that further steps return."""
    total, rng = hashlib.sha256(), np.random.default_rng(seed)
    for _ in range(steps):
        digest(env.step(wander(env, rng)), total)
        digest(env.state(), total)
    return total.hexdigest()


def _into_another(env: ExplorationEnv, tmp_path: Path) -> ExplorationEnv:
    """Return an environment that was in the middle of something else."""
    other = _env(env.config.action_type)
    other.reset(seed=77)
    _go_on(other, 5)
    other.set_state(env.get_state())
    return other


def _through_disk(env: ExplorationEnv, tmp_path: Path) -> ExplorationEnv:
    save_state(env.get_state(), tmp_path / "state")
    other = _env(env.config.action_type)
    other.set_state(load_state(tmp_path / "state"))
    return other


WAYS: dict[str, Callable[[ExplorationEnv, Path], ExplorationEnv]] = {
    "another env": _into_another,
    "clone": lambda env, _: env.clone(),
    "deepcopy": lambda env, _: copy.deepcopy(env),
    "pickled env": lambda env, _: pickle.loads(pickle.dumps(env)),
    "disk": _through_disk,
}


@pytest.mark.parametrize("way", WAYS)
def test_a_state_continues_bit_for_bit(way: str, tmp_path: Path) -> None:
    """300 steps after a snapshot, bumps and a merge among them, return the same bytes wherever it is restored."""
    env = _begun()
    assert env.belief("robot_0").group == (0,)
    other = WAYS[way](env, tmp_path)
    reference = _go_on(env, FURTHER)
    assert any(event.kind == "merge" for event in env.events)
    assert env.state()[-1] == 1.0
    assert env.episode.team_metrics().collisions.sum() > 20
    assert _go_on(other, FURTHER) == reference
    digests = []
    for one in (env, other):  # resets to come are part of the state as well
        total = hashlib.sha256()
        digest(one.reset(), total)
        digests.append(total.hexdigest())
    assert digests[0] == digests[1]


@pytest.mark.parametrize("action_type", ["goal", "discrete"])
def test_all_action_types_continue(action_type: str) -> None:
    """Paths to candidates in progress, and discrete actions, continue bit for bit."""
    env = _begun(action_type, 6)
    twin = env.clone()
    assert _go_on(twin, 30) == _go_on(env, 30)


def test_before_and_after_a_merge() -> None:
    """States from before and after a merge are restored by turns, and each continues as before."""
    env = _begun()
    apart = env.get_state()
    first = _go_on(env, 150)
    assert len(env.belief("robot_0").group) == 2
    joined = env.get_state()
    second = _go_on(env, 50)
    for _ in range(2):
        env.set_state(apart)
        assert env.belief("robot_0").group == (0,)
        assert _go_on(env, 150) == first
        env.set_state(joined)
        assert _go_on(env, 50) == second


def test_during_an_attempt(tmp_path: Path) -> None:
    """States taken while an attempt waits for smoothed maps continue bit for bit; taking them changes nothing."""
    quiet, env = _begun(), _begun()
    slam, rng = env.episode.belief.team, np.random.default_rng(3)
    snapshots: list[tuple[int, ExplorationEnv]] = []
    taken: list[dict[str, Any]] = []
    while not any(event.kind == "merge" for event in env.events):
        actions = wander(env, rng)
        quiet.step(actions)
        env.step(actions)
        taken.append(actions)
        if slam._merges.attempt is not None:
            snapshots.append((len(taken), _through_disk(env, tmp_path)))
    assert len(snapshots) >= 3
    for begun, other in [(len(taken), quiet), *snapshots]:
        for actions in taken[begun:]:
            other.step(actions)
        assert_same(other.state(), env.state())
        assert_same(other.events, env.events)
        assert _go_on(other, 3) == _go_on(env.clone(), 3)


def _sometimes_refuted(number: int, trunk: Branch, *_: Any) -> bool:
    """Return whether a merge can be undone now, and the step is one of some."""
    monitors = trunk.monitors[trunk.merge_numbers.index(number) :]
    can_be_undone = all(monitor.both_sides_connected(trunk.active_robots) for monitor in monitors)
    return can_be_undone and (13 * number + monitors[0].steps) % 97 < 5


@pytest.mark.slow
@pytest.mark.parametrize(("world", "robots", "seed"), [
    ("office", 4, 3), pytest.param("loops", 3, 0, marks=pytest.mark.nightly),
    pytest.param("hall", 3, 2, marks=pytest.mark.nightly),
])  # fmt: skip
def test_merges_that_are_undone_in_a_lossy_network(
    world: str, robots: int, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies taken at any time continue bit for bit, and the records of maps, grids and inputs stay complete."""
    monkeypatch.setattr(merge, "is_refuted", _sometimes_refuted)
    rng = np.random.default_rng(seed)
    config = EnvConfig().replace(
        world=world, num_robots=robots, action_type="goal", decision_ticks=3, comm_range=12.0, comm_loss=0.1,
        max_cycles=1000,
        belief={"filter": {"num_particles": 13}, "merging": {"watch_every": 5, "blocked_steps": 5}},
    )  # fmt: skip
    env = vslam_v0.parallel_env(config=config)
    env.reset(seed=seed)
    copies: list[tuple[ExplorationEnv, int]] = []
    for step in range(400):
        actions = wander(env, rng)
        returned = env.step(actions)
        for copied, since in list(copies):
            assert_same(copied.step(actions), returned)
            assert_same(copied.state(), env.state())
            if step - since > 60:
                copies.remove((copied, since))
        if step % 9 == 0 and len(copies) < 3:
            copies.append((pickle.loads(pickle.dumps(env)), step))
    kinds = [event.kind for event in env.events]
    assert kinds.count("merge") > 1
    assert kinds.count("undo") > 0


def test_taking_a_state_changes_nothing() -> None:
    """An environment continues as without `get_state`, and a state does not change while the environment moves."""
    env, quiet = _begun(), _begun()
    state = env.get_state()
    before = pickle.dumps(state)
    assert _go_on(env, 60) == _go_on(quiet, 60)
    env.set_state(state)
    _go_on(env, 60)
    assert pickle.dumps(state) == before


def test_the_end_and_the_time_before_the_first_reset() -> None:
    """States of environments that have ended, or have not begun, are states as well."""
    env = small_env(max_cycles=3)
    unborn = env.get_state()
    env.reset(seed=3)
    _go_on(env, 3)
    other = small_env(max_cycles=3)
    other.set_state(env.get_state())
    with pytest.raises(RuntimeError, match="one that has ended"):
        other.step({})
    assert np.array_equal(other.state(), env.state())
    other.set_state(unborn)
    with pytest.raises(RuntimeError, match="got none"):
        other.state()


def test_a_clone_is_independent() -> None:
    """Stepping a clone leaves its original alone; cycles are counted on."""
    env = small_env(max_cycles=10)
    env.reset(seed=3)
    _go_on(env, 4)
    before = pickle.dumps(env.get_state())
    twin = env.clone()
    _go_on(twin, 6)
    assert not twin.agents
    assert pickle.dumps(env.get_state()) == before
    assert env.clone().agents == env.agents


@pytest.mark.slow
def test_a_state_continues_in_another_process(tmp_path: Path) -> None:
    """A state on disk continues with the same bytes in a process with other hashes and BLAS threads."""
    env = _begun()
    save_state(env.get_state(), tmp_path / "state")
    code = (
        "import test_snapshots as t\n"
        "from vslam_env import load_state\n"
        "env = t._env()\n"
        f"env.set_state(load_state({str(tmp_path / 'state')!r}))\n"
        "print(t._go_on(env, 100))"
    )
    reference = _go_on(env, 100)
    for hashes, threads in (("12345", "1"), ("54321", "2")):
        other = {"PYTHONHASHSEED": hashes, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        found = subprocess.run(
            [sys.executable, "-c", code],
            cwd=Path(__file__).parent,
            env=os.environ | other | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            capture_output=True,
            text=True,
            check=True,
        )
        assert found.stdout.strip() == reference, other


def _edited(**changes: Any) -> Callable[[], Any]:
    def act() -> None:
        env = _begun(steps=1)
        env.set_state(env.get_state() | changes)

    return act


def _without(key: str) -> Callable[[], Any]:
    def act() -> None:
        env = _begun(steps=1)
        env.set_state({name: value for name, value in env.get_state().items() if name != key})

    return act


def _from_other(**kwargs: Any) -> Callable[[], Any]:
    def act() -> None:
        env = vslam_v0.parallel_env(**kwargs)
        small_env().set_state(env.get_state())

    return act


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda: small_env().set_state(3), "state: expected what get_state returned, got a int. Pass it unchanged"),
        (_without("executor"), "state: expected what get_state returned, got a mapping without 'executor'"),
        (_edited(version="0/0.0.1"), rf"state: expected a state of version '{state_version()}', got '0/0.0.1'"),
        (lambda: small_env().set_state({"version": "0/0.0.1"}), "state: expected a state of version .*, got '0/0.0.1'"),
        (_edited(config={}), r"state\['config'\]: expected EnvConfig that can be built"),
        (_from_other(num_robots=4), "state: expected one made with world = 'room', got 'office'"),
        (
            lambda: small_env().set_state(small_env(num_particles=30).get_state()),
            r"state: expected one made with belief\.filter\.num_particles = 20, got 30\. Restore",
        ),
        (_from_other(world="fig5"), "state: expected one made with world = 'room', got 'fig5'"),
    ],
)  # fmt: skip
def test_bad_states_are_refused(act: Callable[[], Any], says: str) -> None:
    """What is no state, or one of another version or configuration, is refused with the reason."""
    with pytest.raises(ValueError, match=says):
        act()


PARTS = ["episode", "executor", "root", "agents", "cycle", "objects"]
PARTS += [f"episode.{part}" for part in ("tick", "metric_rows", "simulator", "belief", "ground_truth", "coverage")]


def test_a_state_of_which_a_part_is_damaged_is_refused() -> None:
    """The part is named, and the environment goes on as before."""
    env, quiet = _begun(), _begun()
    state = env.get_state()
    for part in PARTS:
        outer, _, inner = part.partition(".")
        damaged = state["episode"] | {inner: {}} if inner else {"scenario": 3}
        name = rf"\['{outer}'\]" + (rf"\['{inner}'\]" if inner else "")
        with pytest.raises(ValueError, match=rf"state({name}|: expected one made with world \(World\) objects)"):
            env.set_state(state | {outer: damaged})
    with pytest.raises(ValueError, match="version"):
        env.set_state(state | {"version": "other"})
    assert _go_on(env, 20) == _go_on(quiet, 20)


def _marked(content: bytes, body: bytes) -> bytes:
    """Return a file of the same version with another body, as if it had been written so."""
    return content[: content.index(b"\n") + 1] + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda content: content[: len(content) // 2], "path: expected an intact state file, got a damaged file"),
        (lambda content: b"hello" + content, "path: expected a state file"),
        (
            lambda content: content.replace(f"state {FORMAT}/".encode(), b"state 999/", 1),
            r"expected a state of version .*got '999/",
        ),
        (lambda content: content[:-9] + bytes([content[-9] ^ 1]) + content[-8:], "a damaged file"),
        (lambda content: content + b".", "a damaged file"),
        (lambda content: content[: content.index(b"\n") + 1] + pickle.dumps(3), "a damaged file"),
        (lambda content: _marked(content, pickle.dumps(3)), "expected a readable state file"),
        (lambda content: _marked(content, encode(3)), "expected what get_state returned, got a int"),
        (None, "path: expected a state file, .*no such file|No such file"),
    ],
)
def test_bad_files_are_refused(spoil: Callable[[bytes], bytes] | None, says: str, tmp_path: Path) -> None:
    """A file that is missing, cut off, something else or of another version is refused with the reason."""
    path = tmp_path / "state"
    if spoil is not None:
        save_state(_begun(steps=1).get_state(), path)
        path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(ValueError, match=says):
        load_state(path)


@pytest.mark.parametrize("number", [FORMAT, "38"])
def test_a_pickle_in_the_place_of_a_state_is_not_run(number: str, tmp_path: Path) -> None:
    """Whatever its version and checksum say, a file that holds a pickle runs nothing."""
    path, proof = tmp_path / "state", tmp_path / "proof"
    body = pickle.dumps(_begun(steps=1).get_state() | {"cycle": Trap(proof)})
    save_state(_begun(steps=1).get_state(), path)
    content = _marked(path.read_bytes(), body)
    path.write_bytes(content.replace(f"state {FORMAT}/".encode(), f"state {number}/".encode(), 1))
    with pytest.raises(ValueError, match="readable state file" if number == FORMAT else f"got '{number}/"):
        load_state(path)
    assert not proof.exists()
    pickle.loads(body)
    assert proof.exists()


def test_custom_objects_are_required_at_restore(tmp_path: Path) -> None:
    """A state of an environment with a world and a reward term of the caller's says which ones it needs."""

    class Found:
        name, weight = "found", 2.0

        def __call__(self, before: Any, after: Any) -> Any:
            return after.discovered - before.discovered

    env = small_env(reward=[Found()])
    env.reset(seed=1)
    save_state(env.get_state(), tmp_path / "state")
    state = load_state(tmp_path / "state")
    with pytest.raises(ValueError, match=r"States do not contain your own objects: .* the same world, reward 'found'"):
        small_env().set_state(state)
    with pytest.raises(ValueError, match=r"expected one made with no objects, got 'world \(World\), reward 'found' \("):
        check_state(state, env.config, {})
    other = small_env(reward=[Found()])
    other.set_state(state)
    assert _go_on(other, 5) == _go_on(env, 5)


def test_a_file_restores_sharing_and_write_protection(tmp_path: Path) -> None:
    """Shared parts are shared, and arrays that cannot be written still cannot, so that no kernel is compiled again."""
    env = _begun(steps=150)
    state = env.get_state()
    save_state(state, tmp_path / "state")
    other = _begun(steps=3)
    other.set_state(load_state(tmp_path / "state"))
    loaded = other.get_state()
    assert equal(loaded, state)
    merges = loaded["episode"]["belief"]["team"]["merges"]
    event = next(event for event in merges["events"] if event.kind == "merge")
    (process,) = merges["joined"].values()
    assert process["phase"]["joined"].alignment is event.alignment


def test_files_are_whole_or_not_there(tmp_path: Path) -> None:
    """A write that fails leaves the old file and no other."""
    path = tmp_path / "state"
    state = _begun(steps=1).get_state()
    save_state(state, path)
    before = path.read_bytes()
    says = r"state: expected numbers, arrays and configurations .* 'cycle'. Your own objects are not stored: make"
    with pytest.raises(ValueError, match=says):
        save_state(state | {"cycle": lambda: None}, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["state"]
    with pytest.raises(ValueError, match="path: expected a file that can be written"):
        save_state(state, tmp_path / "nowhere" / "state")
    with pytest.raises(ValueError, match=r"path: expected a file that can be written, .* File name too long"):
        save_state(state, tmp_path / ("x" * 300))
    for other in (None, 3, "a\0b", Path("a\0b")):
        with pytest.raises(ValueError, match="path: expected the path of a file, got "):
            save_state(state, other)
        with pytest.raises(ValueError, match="path: expected the path of a file, got "):
            load_state(other)


@pytest.mark.skipif(os.name != "posix", reason="modes of files are POSIX")
def test_file_permissions_follow_the_umask(tmp_path: Path) -> None:
    """Who may read the file follows from the process' umask; a pipe, a device or a folder is not replaced."""
    state = _begun(steps=1).get_state()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    former = os.umask(0o027)
    try:
        save_state(state, tmp_path / "state")
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o640
    for other in (pipe, tmp_path, "."):
        with pytest.raises(ValueError, match=r"path: expected a file that can be written, got .*is not a file"):
            save_state(state, other)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["pipe", "state"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        ({"comm_range": 4.0, "comm_loss": 0.3, "oracle_merge": True}, 60),
        ({"reward": {"map_error": 1.0, RUNNING_COST: 1.0}, "decision_ticks": 3}, 8),
        pytest.param({"sensor": "stereo"}, 8, marks=pytest.mark.slow),
    ],
)
def test_lossy_radios_rendered_cameras_and_running_costs_continue(changes: dict[str, Any], steps: int) -> None:
    """Robots that lose contact, see with rendered cameras or are charged per tick continue bit for bit."""
    env = _env(**changes)
    env.reset(seed=5, options={"start_poses": MEETING})
    _go_on(env, steps // 2)
    state = pickle.loads(pickle.dumps(env.get_state()))
    other = _env(**changes)
    other.reset(seed=8)
    other.set_state(state)
    assert _go_on(other, steps) == _go_on(env, steps)
