import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies import env_soak


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No episode is repeated, because that takes other processes."""
    monkeypatch.setattr(env_soak, "beginning", lambda *_: "")
    monkeypatch.setattr(env_soak, "in_another_process", lambda *_: "")


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.usefixtures("quick")
def test_a_resumed_soak_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    """A soak test that stops at a snapshot and resumes in a new object returns the same bytes as an unbroken one."""
    whole = env_soak.Soak(3)
    whole.run(120, None)
    keep = tmp_path / "soak.state"
    env_soak.Soak(3).run(47, keep, keep_every=20)
    resumed = env_soak.Soak.resumed(keep)
    assert resumed.steps == 47
    resumed.run(120, keep)
    assert (resumed.chain, resumed.episodes) == (whole.chain, whole.episodes)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_soak_leaves_a_whole_snapshot(tmp_path: Path, how: signal.Signals) -> None:
    """A soak test that is killed, or stopped by Ctrl-C, while it writes snapshots leaves a valid one."""
    keep = tmp_path / "soak.state"
    code = (
        "import pathlib, signal, sys; from studies import env_soak\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # the tests may run where it is ignored\n"
        "env_soak.beginning = env_soak.in_another_process = lambda *_: ''\n"
        "env_soak.Soak(3).run(10**6, pathlib.Path(sys.argv[1]), keep_every=1, log=lambda t: print(t, flush=True))\n"
    )
    command = [sys.executable, "-c", code, str(keep)]
    soak = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert soak.stdout is not None
    for _ in range(12):
        soak.stdout.readline()
    soak.send_signal(how)
    soak.stdout.close()
    soak.wait()
    resumed = env_soak.Soak.resumed(keep)
    assert resumed.steps >= 12
    assert how == signal.SIGKILL or [file.name for file in tmp_path.iterdir()] == ["soak.state"]
    reference = env_soak.Soak(3)
    reference.run(resumed.steps, None)
    assert reference.chain == resumed.chain


@pytest.mark.usefixtures("quick")
def test_violated_invariants_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot in a wall, an observation outside its space and a non-numeric info each end the soak test."""
    env = env_soak.vslam_v1.parallel_env(world="fig5", num_robots=2, num_particles=3)
    returned: tuple[Any, ...] = env.reset(seed=1)
    env_soak.check(env, returned)
    returned[1]["robot_0"]["map_error"] = np.nan
    with pytest.raises(AssertionError, match="info of robot_0 not finite"):
        env_soak.check(env, returned)
    returned = env.reset(seed=1)
    returned[0]["robot_1"]["pose"][:] = np.inf
    with pytest.raises(AssertionError, match="observation of robot_1 outside its space"):
        env_soak.check(env, returned)
    returned = env.reset(seed=1)
    x1, y1, x2, y2 = env.world.walls[0]
    stuck = np.array([[0.5 * (x1 + x2), 0.5 * (y1 + y2) + 0.1, 0.0], env.true_poses[1]])
    monkeypatch.setattr(type(env), "true_poses", property(lambda self: stuck))
    with pytest.raises(AssertionError, match="a robot is inside a wall"):
        env_soak.check(env, returned)


@pytest.mark.slow
@pytest.mark.nightly
def test_beginnings_do_not_depend_on_the_process() -> None:
    """The first steps of an episode have the same bytes beside another environment and with another hash seed."""
    reference = env_soak.beginning(5, 6, False)
    assert env_soak.beginning(5, 6, True) == reference
    assert env_soak.in_another_process(5, 6, 99) == reference
    assert env_soak.beginning(6, 6, False) != reference
