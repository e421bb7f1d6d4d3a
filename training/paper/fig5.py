"""Fig. 5 of the paper: three robots in a room, the landmarks that they see, and those that walls hide from them."""

from dataclasses import dataclass

import numpy as np

from agents.registry import make_policy
from slam_backend.core.validation import BoolArray, FloatArray, bad_argument, check_int
from training.experiments.config import PlainConfig
from training.experiments.tables import csv_text
from vslam_env import EnvConfig, vslam_v0
from vslam_env.config import MAX_ROBOTS
from vslam_env.environment import ExplorationEnv
from vslam_env.sensors import LandmarkSensor
from vslam_env.world.visibility import view_limits, visible_landmarks

COMMAND = "paper fig5"
STATES = ("hidden", "seen", "measured")


@dataclass(frozen=True, slots=True, kw_only=True)
class Fig5Config(PlainConfig):
    """All that decides the figure.

    Attributes:
        robots: How many.
        decisions: Seconds that they have explored for.
        measurements: Number B that each integrates in a tick, at most.
        seed: Of the room and of all draws.
    """

    robots: int = 3
    decisions: int = 30
    measurements: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        if check_int("robots", self.robots, 1, "Use 1 to 8 robots.") > MAX_ROBOTS:
            raise bad_argument("robots", f"an int from 1 to {MAX_ROBOTS}", self.robots, "Use 1 to 8 robots.")
        check_int("decisions", self.decisions, 1, "Let them move for a second or more.")
        check_int("measurements", self.measurements, 1, "Let each measure a landmark or more.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")


@dataclass(frozen=True, slots=True, eq=False)
class Fig5:
    """What the figure shows, world frame.

    Attributes:
        walls: (S, 4) float64 [m].
        landmarks: (N, 3) float64 [m].
        poses: (K, 3) float64 [m, m, rad]. True poses.
        paths: (K, T, 2) float64 [m]. True paths.
        half_fov: Of the cameras [rad].
        max_range: [m].
        in_view: (K, N) bool. In range and in the image, looked at from their wall's face: what a robot would see in a
            room whose walls were glass.
        seen: (K, N) bool. What it does see.
        measured: (K, N) bool. What it integrates in this tick.
    """

    walls: FloatArray
    landmarks: FloatArray
    poses: FloatArray
    paths: FloatArray
    half_fov: float
    max_range: float
    in_view: BoolArray
    seen: BoolArray
    measured: BoolArray

    def figures(self) -> list[dict[str, int]]:
        """Return per robot how many landmarks are in view, hidden, seen and measured."""
        return [
            {
                "in_view": int(view.sum()),
                "hidden": int((view & ~seen).sum()),
                "seen": int(seen.sum()),
                "measured": int(used.sum()),
            }
            for view, seen, used in zip(self.in_view, self.seen, self.measured, strict=True)
        ]

    def to_csv(self) -> str:
        """Return a row for each robot and landmark in its view: where both are, and what became of the landmark."""
        headings = ["robot", "x", "y", "theta", "landmark", "landmark_x", "landmark_y", "landmark_z", "state"]
        rows = []
        for robot, pose in enumerate(self.poses):
            for mark in np.flatnonzero(self.in_view[robot]):
                state = STATES[int(self.seen[robot, mark]) + int(self.measured[robot, mark])]
                numbers = [f"{value:.4f}" for value in (*pose, *self.landmarks[mark])]
                rows.append([robot, *numbers[:3], int(mark), *numbers[3:], state])
        return csv_text(headings, rows)


def simulate_fig5(config: Fig5Config) -> Fig5:
    """Let robots explore the room for a while, and tell what each sees at the end."""
    chosen = EnvConfig().replace(landmark_sensor={"max_measurements": config.measurements})
    env = vslam_v0.parallel_env(
        world="fig5", num_robots=config.robots, action_type="goal", max_cycles=config.decisions, config=chosen
    )
    _explore(env, config.seed)
    return _as_seen(env)


def _explore(env: ExplorationEnv, seed: int) -> None:
    """Play an episode of nearest-frontier explorers."""
    policies = {agent: make_policy("frontier", "goal") for agent in env.possible_agents}
    rng = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    while env.agents:
        actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        observations = env.step(actions)[0]


def _as_seen(env: ExplorationEnv) -> Fig5:
    """Return what the robots see now, and what they would see without walls and each other."""
    episode, sight = env.episode, env.config.landmark_sensor
    marks, poses = env.world.landmarks, env.true_poses
    assert marks is not None
    assert isinstance(episode.setting.sensor, LandmarkSensor)
    nowhere = np.array([[1e6, 1e6, 1e6 + 1.0, 1e6]])  # a wall that hides nothing
    view, radius = view_limits(sight.camera, sight.max_incidence), env.config.robot_radius
    in_view = np.vstack([visible_landmarks(pose[None], marks, nowhere, radius, view) for pose in poses])
    measured = np.zeros_like(in_view)
    for robot, frame in enumerate(episode.frames):
        measured[robot, frame.true_ids[frame.true_ids >= 0]] = True
    return Fig5(
        walls=env.world.walls,
        landmarks=marks.positions,
        poses=poses,
        paths=np.array(episode.true_path)[:, :, :2].transpose(1, 0, 2),
        half_fov=sight.camera.half_fov,
        max_range=sight.camera.max_range,
        in_view=in_view,
        seen=episode.setting.sensor.visible(poses),
        measured=measured,
    )
