"""Digests of the numbers that the project computes: a move or a rename must keep every one of them.

    python tests/regression/recorded_digests.py            # compare with the recorded ones, say which differ
    python tests/regression/recorded_digests.py --record   # record all, after a change that is meant to change numbers;
                                                           # those of some names alone: --record office

Digests hold no names and no texts: observations are hashed in the order of their sorted keys, states and results as
unordered collections of their arrays and numbers. Last bits depend on the versions of the libraries, and on the
processor through NumPy and OpenBLAS: they are computed as on a processor with AVX2 and no more, so that they are the
same on all newer ones.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend import Alignment, LandmarkMap, align_maps, fuse_maps
from slam_backend.geometry import between
from training.experiments.machine.numerics import PORTABLE, numerics, variables_for
from vslam_env import vslam_v0

FILE = Path(__file__).with_name("digests.json")
ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("VSLAM_DATA", ROOT.parent / "shared" / "data"))
LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "opencv-python-headless", "pymunk")
NOT_RESULTS = {"config", "versions", "machine", "seed"}  # tables of metrics.json
STEPS, STEREO_STEPS = 300, 40
NOT_COMPARABLE = 5  # status
IS_PORTABLE = "RECORDED_DIGESTS"  # variable of the processes that compute
ALIGNMENT = "align and fuse"
FALSE_MERGE, FALSE_MERGE_STEP = "fig5, undone merge", 60

NO_ATTEMPTS = {"belief": {"attempts": {"enabled": False}}}
NEAR = {"min_start_distance": 1.0, "shared_start_view": True}
SHORT_RANGE = {"comm_range": 6.0, "comm_line_of_sight": True}
FASTSLAM1 = {"belief": {"filter": {"proposal": "fastslam1"}}}
EXISTENCE = {"belief": {"filter": {"existence": {}}}}
EPISODES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # arguments of parallel_env, changes of its config
    "office": ({}, {}),
    "office, one robot": ({"num_robots": 1}, {}),
    "office, discrete": ({"action_type": "discrete", "num_robots": 2}, {}),
    "office, goal": ({"action_type": "goal"}, {}),
    "maze, goal": ({"world": "maze", "action_type": "goal", "num_robots": 4}, {}),
    "loops, goal, flat": ({"world": "loops", "action_type": "goal", "observation_type": "flat"}, {}),
    "hall, goal": ({"world": "hall", "action_type": "goal", "num_robots": 5}, NEAR),
    "fig5": ({"world": "fig5", "num_robots": 3}, NEAR),
    FALSE_MERGE: ({"world": "fig5", "num_robots": 2}, NEAR | NO_ATTEMPTS),
    "hall, short range": ({"world": "hall", "action_type": "goal", **SHORT_RANGE}, NEAR),
    "hall, lost contacts": ({"world": "hall", "action_type": "goal", "comm_loss": 0.5}, NEAR),
    "preset hard": ({"preset": "hard", "action_type": "goal"}, {}),
    "preset easy": ({"preset": "easy", "action_type": "goal"}, {}),
    "stereo": ({"sensor": "stereo", "num_robots": 2}, {}),
    "stereo, goal": ({"sensor": "stereo", "num_robots": 2, "action_type": "goal"}, NEAR),
    "oracle pose": ({"oracle_pose": True, "num_robots": 2}, {}),
    "oracle association": ({"oracle_association": True, "action_type": "goal", "num_robots": 2}, {}),
    "oracle merge": ({"oracle_merge": True, "action_type": "goal"}, NEAR),
    "fastslam1": ({"num_robots": 2}, FASTSLAM1),
    "existence": ({"action_type": "goal", "num_robots": 2}, NEAR | EXISTENCE),
}


def environment() -> dict[str, str]:
    """Return what last bits depend on."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, "numerics": numerics()} | {name: version(name) for name in LIBRARIES}


def recorded() -> Mapping[str, str] | None:
    """Return the recorded digests, or None if they are of other numerics or versions."""
    record: dict[str, Any] = json.loads(FILE.read_text())
    return record["digests"] if record["environment"] == environment() else None


def names() -> list[str]:
    """Return the names of all that is computed; replays are left out where the data are not there."""
    return [*EPISODES, ALIGNMENT, *commands()]


def digests_of(name: str) -> dict[str, str]:
    """Compute an episode, the alignment or a command; return its digests by name."""
    if name in EPISODES:
        return {f"{name}: {part}": digest for part, digest in play(name).items()}
    return {name: align_and_fuse() if name == ALIGNMENT else run_command(commands()[name])}


def all_digests() -> dict[str, str]:
    """Compute all digests."""
    return {part: digest for name in names() for part, digest in digests_of(name).items()}


def play(name: str) -> dict[str, str]:
    """Play an episode; return digests of what the environment returns, of its events and maps, and of its snapshots."""
    returned, learned, snapshots = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
    options, changes = EPISODES[name]
    env = vslam_v0.parallel_env(config=vslam_v0.parallel_env(**options).config.replace(**changes, max_cycles=1000))
    observations, infos = env.reset(seed=11)
    rng = np.random.default_rng(5)
    add_ordered(returned, [observations, infos, env.state()])
    for step in range(STEREO_STEPS if "stereo" in name else STEPS):
        if not env.agents:
            break
        if name == FALSE_MERGE and step == FALSE_MERGE_STEP:
            merge_falsely(env)
        actions = {agent: draw(env, agent, rng, turning=name == FALSE_MERGE) for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)
        add_ordered(returned, [observations, rewards, terminations, truncations, infos])
        if step % 50 == 49:
            state = env.get_state()
            add_unordered(snapshots, state)
            env.set_state(state)
    add_ordered(returned, env.state())
    for event in env.events:
        add_unordered(learned, [event.step, event.robots_a, event.robots_b, numbers_of(event.alignment)])
    for agent in env.possible_agents:
        found = env.belief(agent).map
        add_ordered(learned, [found.means, found.covariances, found.descriptors, found.ids])
    env.close()
    parts = {"returned": returned, "events and maps": learned, "snapshots": snapshots}
    return {part: digest.hexdigest()[:24] for part, digest in parts.items()}


def draw(env: Any, agent: str, rng: np.random.Generator, turning: bool) -> Any:
    """Return a random action: most of the time ahead, or a turn on the spot."""
    if turning:
        return np.array([-0.54, rng.uniform(0.3, 0.7)], dtype=np.float32)
    if env.config.action_type == "goal":
        valid = np.flatnonzero(env.belief(agent).candidates.valid)
        return 1 + int(rng.choice(valid)) if len(valid) else 0
    if env.config.action_type == "discrete":
        return int(rng.choice(4, p=[0.05, 0.65, 0.15, 0.15]))
    return np.array([rng.uniform(0.2, 1.0), rng.uniform(-0.6, 0.6)], dtype=np.float32)


def merge_falsely(env: Any) -> None:
    """Merge the first two robots by a transform that is 1 m off, which the team finds out and undoes."""
    start = between(*env.true_start_poses[:2]) + np.array([1.0, 0.0, 0.0])
    found = Alignment(True, "", *start, 1e-3 * np.eye(3), np.empty((0, 2), dtype=np.int64), 0.0)
    env.episode.ground_truth.merge(env.episode.belief.merge(0, 1, found))


def align_and_fuse() -> str:
    """Align and fuse simulated pairs of maps by each method; return a digest of the results."""
    digest = hashlib.sha256()
    for method in ("ransac", "svd", "icp", "impicp"):
        for seed in range(4):
            rng = np.random.default_rng(seed)
            one, other = pair_of_maps(rng, 40)
            alignment = align_maps(one, other, method, np.random.default_rng(seed))
            add_unordered(digest, numbers_of(alignment))
            if alignment.success:
                fused = fuse_maps(one, other, alignment)
                add_ordered(digest, [fused.means, fused.covariances])
    return digest.hexdigest()[:24]


def pair_of_maps(rng: np.random.Generator, count: int) -> tuple[LandmarkMap, LandmarkMap]:
    """Return two maps of `count` landmarks of which half are common, the second turned by .5 rad and moved."""
    points = rng.uniform([-8, -8, 0], [8, 8, 2], (count + count // 2, 3))
    looks = rng.normal(size=(len(points), 32))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = (points - [1.0, -2.0, 0.0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    covariances = np.tile(4e-4 * np.eye(3), (count, 1, 1))
    maps = []
    for chosen, places in ((slice(0, count), points), (slice(-count, None), turned)):
        means = places[chosen] + rng.normal(0.0, 0.02, (count, 3))
        descriptors = (looks[chosen] + rng.normal(0.0, 0.02, (count, 32))).astype(np.float32)
        maps.append(LandmarkMap(means, covariances, descriptors))
    return maps[0], maps[1]


def commands() -> dict[str, list[str]]:
    """Return the commands whose metrics are hashed."""
    found = {
        "studies accuracy": ["studies.filters.accuracy", "--seeds", "1", "--lengths", "20", "--particles", "30"],
        "studies alignment": ["studies.merging.alignment", "--seeds", "2", "--hard", "9"],
        "run": ["training", "run", "--world", "maze", "--robots", "2", "--max-cycles", "120", "--no-video"],
    }
    logs = (
        ("mrclam", "mrclam/MRCLAM_Dataset7", 150), ("victoria", "victoria_park", 100),
        ("kitti", "kitti_landmarks/0027.npz", 20),
    )  # fmt: skip
    for name, path, seconds in logs:
        found[f"replay {name}"] = ["training", "replay", name, "--path", str(DATA / path), "--duration", str(seconds)]
    return {name: words for name, words in found.items() if "replay" not in name or DATA.is_dir()}


def run_command(arguments: list[str]) -> str:
    """Run a module with options; return a digest of the numbers in its `metrics.json`, those of time left out."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", *arguments, "--out", str(out)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
        content = json.loads((out / "metrics.json").read_text())
    digest = hashlib.sha256()
    add_unordered(digest, results_of(content))
    return digest.hexdigest()[:24]


TIMES = "seconds", "_s", "_ms", "_us", "[ms]", "[s]"  # ends of names of times


def results_of(content: Any) -> Any:
    """Return a tree of metrics without what describes the run or measures time."""
    if isinstance(content, Mapping):
        kept = (key for key in content if key not in NOT_RESULTS and not key.endswith(TIMES))
        return [results_of(content[key]) for key in kept]
    return [results_of(item) for item in content] if isinstance(content, list) else content


def numbers_of(value: Any) -> list[Any]:
    """Return the numbers of an alignment."""
    return [value.success, value.tx, value.ty, value.theta, value.covariance, value.inliers, value.ratio]


def add_ordered(digest: "hashlib._Hash", value: Any) -> None:
    """Feed nested values into a digest, mappings in the order of their keys."""
    if isinstance(value, Mapping):
        for key in sorted(value):
            add_ordered(digest, value[key])
    elif isinstance(value, (tuple, list)):
        for item in value:
            add_ordered(digest, item)
    elif not isinstance(value, str):
        digest.update(bytes_of(value))


def add_unordered(digest: "hashlib._Hash", value: Any) -> None:
    """Feed the arrays and numbers of a tree into a digest, in an order of their own."""
    for leaf in sorted(leaves(value)):
        digest.update(hashlib.sha256(leaf).digest())


def leaves(value: Any) -> Iterator[bytes]:
    """Yield the arrays and numbers of a tree as bytes."""
    if isinstance(value, Mapping):
        value = list(value.values())
    elif is_dataclass(value):
        value = [getattr(value, field.name) for field in fields(value)]
    if isinstance(value, (tuple, list, set, frozenset)):
        for item in value:
            yield from leaves(item)
    elif isinstance(value, (np.ndarray, np.generic, int, float)):
        yield bytes_of(value)


def bytes_of(value: Any) -> bytes:
    """Return type, shape and content of an array or number."""
    array = np.asarray(value) if not isinstance(value, int) or abs(value) < 2**63 else np.array(str(value))
    return f"{array.dtype.str}{array.shape}".encode() + array.tobytes()


def main(arguments: list[str]) -> int:
    """Compare with the recorded digests those of some names, or of all; or record them.

    Returns:
        0 if they are equal, 1 if some differ, `NOT_COMPARABLE` if none are recorded for this environment.
    """
    before = recorded()
    if arguments[:1] == ["--record"]:
        some = {part: digest for name in arguments[1:] for part, digest in digests_of(name).items()}
        digests = (before or {}) | some if some else all_digests()
        FILE.write_text(json.dumps({"environment": environment(), "digests": digests}, indent=1) + "\n")
        return 0
    if before is None:
        print(f"Nothing is recorded for {environment()}.")
        return NOT_COMPARABLE
    found = {part: digest for name in arguments or names() for part, digest in digests_of(name).items()}
    differing = {name for name, digest in found.items() if before.get(name) != digest}
    print(*(f"differs: {name}" for name in sorted(differing)), sep="\n")
    print(f"{len(found) - len(differing)} of {len(found)} digests are equal.")
    return 1 if differing else 0


def run(arguments: list[str]) -> "subprocess.CompletedProcess[str]":
    """Run this file in a process with the numerics of the records."""
    command = [sys.executable, __file__, *arguments]
    environ = os.environ | variables_for(PORTABLE) | {IS_PORTABLE: "1"}
    return subprocess.run(command, env=environ, cwd=ROOT, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    if IS_PORTABLE in os.environ:
        sys.exit(main(sys.argv[1:]))
    done = run(sys.argv[1:])
    print(done.stdout + done.stderr, end="")
    sys.exit(done.returncode)
