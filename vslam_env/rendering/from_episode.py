"""Conversion of an episode to a `Scene`: the truth, and the estimates moved by the robots' true start poses."""

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose
from vslam_env.config import TICK
from vslam_env.evaluation.team_metrics import TeamMetrics
from vslam_env.rendering import MergeFlash, RobotView, Scene
from vslam_env.simulation.episode import Episode

FLASH_TICKS = 30


def build_scene(episode: Episode, metrics: TeamMetrics) -> Scene:
    """Return the scene of an episode after the last tick.

    Args:
        episode: Running episode; only its constant arrays are shared with the scene.
        metrics: Current metrics of the team.
    """
    landmarks = episode.world.landmarks
    assert landmarks is not None
    truth, estimates = episode.true_path, episode.estimated_path
    return Scene(
        walls=episode.world.walls,
        landmarks=landmarks.positions,
        robots=tuple(
            _view(episode, robot, truth[:, robot], estimates[:, robot], landmarks.positions)
            for robot in range(len(episode.true_starts))
        ),
        tick=episode.tick,
        time=episode.tick * TICK,
        robot_radius=episode.body.radius,
        merges=tuple(
            MergeFlash(episode.tick - tick, robots_a, robots_b)
            for tick, robots_a, robots_b in episode.merge_ticks
            if episode.tick - tick <= FLASH_TICKS
        ),
        map_errors=tuple(float(error) for error in metrics.map_errors),
        coverage=metrics.coverage,
    )


def _view(episode: Episode, robot: int, truth: FloatArray, estimates: FloatArray, positions: FloatArray) -> RobotView:
    start = episode.true_starts[robot]
    belief = episode.belief.belief(robot)
    world_map = belief.map.moved(start)
    seen = episode.frames[robot].true_ids
    estimated = compose(start, estimates)
    return RobotView(
        true_pose=truth[-1],
        true_path=truth[:, :2],
        estimated_pose=estimated[-1],
        estimated_path=estimated[:, :2],
        particles=compose(start, belief.particles),
        landmark_means=world_map.means,
        landmark_covariances=world_map.covariances,
        sight_lines=positions[seen[seen >= 0], :2],
        group=belief.frame,
    )
