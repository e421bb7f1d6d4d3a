"""Fig. 5 of the paper: three robots in a room, the landmarks that they see, and those hidden by walls."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge

from agents.registry import make_policy
from slam_backend.core.validation import BoolArray, FloatArray
from training.experiments.output.plotting import picture, save_png
from training.experiments.study import Column, ResultTable, Row
from training.paper.config import Fig5Config
from vslam_env import EnvConfig, vslam_v1
from vslam_env.environment import ExplorationEnv
from vslam_env.rendering.palette import robot_colour
from vslam_env.sensors import LandmarkSensor
from vslam_env.world.visibility import view_limits, visible_landmarks

STATES = ("hidden", "seen", "measured")
MARK = ("landmark_x", "landmark_y", "landmark_z")

WIDTH = 7.0  # [in]
BODY = 0.35  # radius of drawn robots [m], larger than the true one
INK = "0.15"


@dataclass(frozen=True, slots=True, eq=False)
class Fig5:
    """Content of the figure, world frame."""

    walls: FloatArray  # (S, 4) float64 [m]
    landmarks: FloatArray  # (N, 3) float64 [m]
    poses: FloatArray  # (K, 3) float64 [m, m, rad]. True poses.
    paths: FloatArray  # (K, T, 2) float64 [m]. True paths.
    half_fov: float  # Half the field of view of the cameras [rad]
    max_range: float  # [m]
    # (K, N) bool. Landmarks in range and in the image that face the robot: what a robot would see in a room with glass
    # walls.
    in_view: BoolArray
    seen: BoolArray  # (K, N) bool. Visible landmarks.
    measured: BoolArray  # (K, N) bool. Landmarks measured in this tick.

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each robot and landmark in its view: positions, and whether it is seen and measured."""
        return [
            {
                "robot": robot, **dict(zip(("x", "y", "theta"), map(float, pose), strict=True)), "landmark": int(mark),
                **dict(zip(MARK, map(float, self.landmarks[mark]), strict=True)),
                "state": STATES[int(self.seen[robot, mark]) + int(self.measured[robot, mark])],
            }
            for robot, pose in enumerate(self.poses)
            for mark in np.flatnonzero(self.in_view[robot])
        ]  # fmt: skip


def _count(states: Sequence[str], rows: Sequence[Row]) -> int:
    return sum(row["state"] in states for row in rows)


TABLE = ResultTable(
    name="robots", title="Landmarks in view", by=("robot",), pooled=("robot",),
    columns=(
        Column("in_view", statistic=len, digits=0), Column("hidden", "", partial(_count, STATES[:1]), digits=0),
        Column("seen", "", partial(_count, STATES[1:]), digits=0),
        Column("measured", "", partial(_count, STATES[2:]), digits=0),
    ),
)  # fmt: skip


def simulate_fig5(config: Fig5Config) -> Fig5:
    """Let robots explore the room for a while, and return what each sees at the end."""
    chosen = EnvConfig().replace(landmark_sensor={"max_measurements": config.measurements})
    env = vslam_v1.parallel_env(
        world="fig5", num_robots=config.robots, action_type="goal", max_cycles=config.decisions, config=chosen
    )
    _explore(env, config.seed)
    return _visibility(env)


def _explore(env: ExplorationEnv, seed: int) -> None:
    """Run an episode of nearest-frontier exploration."""
    policies = {agent: make_policy("frontier", "goal") for agent in env.possible_agents}
    rng = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    while env.agents:
        actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        observations = env.step(actions)[0]


def _visibility(env: ExplorationEnv) -> Fig5:
    """Return what the robots see now, and what they would see without walls and other robots."""
    episode, sight = env.episode, env.config.landmark_sensor
    marks, poses = env.world.landmarks, env.true_poses
    assert marks is not None
    assert isinstance(episode.scenario.sensor, LandmarkSensor)
    nowhere = np.array([[1e6, 1e6, 1e6 + 1.0, 1e6]])  # a wall that hides nothing
    view, radius = view_limits(sight.camera, sight.max_incidence), env.config.robot_radius
    in_view = np.vstack([visible_landmarks(pose[None], marks, nowhere, radius, view) for pose in poses])
    measured = np.zeros_like(in_view)
    for robot, frame in enumerate(episode.frames):
        measured[robot, frame.true_ids[frame.true_ids >= 0]] = True
    return Fig5(
        walls=env.world.walls, landmarks=marks.positions, poses=poses,
        paths=np.array(episode.true_path)[:, :, :2].transpose(1, 0, 2), half_fov=sight.camera.half_fov,
        max_range=sight.camera.max_range, in_view=in_view, seen=episode.scenario.sensor.visible(poses),
        measured=measured,
    )  # fmt: skip


@picture
def draw_fig5(file: Path, fig5: Fig5) -> None:
    """Draw the figure into a PNG file."""
    low, high = fig5.walls.reshape(-1, 2).min(axis=0), fig5.walls.reshape(-1, 2).max(axis=0)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(WIDTH, WIDTH * ratio + 0.6), layout="constrained")
    axes = figure.subplots()
    axes.add_collection(LineCollection(fig5.walls.reshape(-1, 2, 2).tolist(), colors=INK, linewidths=1.6))
    axes.plot(*fig5.landmarks[:, :2].T, "o", color="0.62", markersize=2.2, zorder=3)
    for robot, pose in enumerate(fig5.poses):
        colour = [channel / 255 for channel in robot_colour(robot)]
        axes.plot(*fig5.paths[robot].T, color=colour, linewidth=0.9, alpha=0.6)
        fan = np.degrees([pose[2] - fig5.half_fov, pose[2] + fig5.half_fov])
        axes.add_patch(Wedge(tuple(pose[:2]), fig5.max_range, *fan, facecolor=colour, alpha=0.07, linewidth=0))
        for mark in np.flatnonzero(fig5.seen[robot]):
            width = 0.9 if fig5.measured[robot, mark] else 0.35
            ends = np.vstack([pose[:2], fig5.landmarks[mark, :2]])
            axes.plot(*ends.T, "--", color=colour, linewidth=width, dashes=(4, 3), zorder=2)
        hidden = fig5.landmarks[fig5.in_view[robot] & ~fig5.seen[robot]]
        axes.plot(*hidden[:, :2].T, "x", color=colour, markersize=4.5, markeredgewidth=0.9, zorder=4)
        angles = pose[2] + np.array([0.0, 2.5, -2.5])
        body = pose[:2] + BODY * np.column_stack([np.cos(angles), np.sin(angles)])
        axes.fill(*body.T, facecolor=colour, edgecolor=INK, linewidth=0.8, zorder=5)
    handles = [
        Line2D([], [], color=INK, linewidth=1.6, label="wall"),
        Line2D([], [], color="0.62", marker="o", linestyle="", markersize=3, label="landmark"),
        Line2D([], [], color=INK, linestyle="--", linewidth=0.9, label="measured now"),
        Line2D([], [], color=INK, linestyle="--", linewidth=0.35, label="seen"),
        Line2D([], [], color=INK, marker="x", linestyle="", markersize=4.5, label="in view, but hidden"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7, frameon=False)
    axes.set_aspect("equal")
    axes.set_xlim(low[0] - 0.4, high[0] + 0.4)
    axes.set_ylim(low[1] - 0.4, high[1] + 0.4)
    axes.set_xlabel("x [m]", fontsize=7)
    axes.set_ylabel("y [m]", fontsize=7)
    axes.tick_params(labelsize=7)
    save_png(figure, file, 150)
