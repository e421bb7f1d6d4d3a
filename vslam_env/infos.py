"""The infos that an environment hands out with its observations."""

from collections.abc import Mapping, Sequence
from typing import Any

from slam_backend.errors import FloatArray
from vslam_env.errors_of_maps import MapScores
from vslam_env.reward import Standing


def infos_of(
    agents: Sequence[str],
    groups: Sequence[tuple[int, ...]],
    scores: Sequence[MapScores],
    pose_errors: FloatArray,
    standing: Standing,
    terms: Mapping[str, FloatArray],
    invalid: Sequence[int],
) -> dict[str, dict[str, Any]]:
    """Return each agent's figures; `map_rmse` is the cutoff of the map error while nothing is matched.

    `collisions` (ticks), `distance` [m], `bytes_sent` and `merges` count since the reset.

    Args:
        agents: Names of the K robots.
        groups: Per robot who shares its map, as far as it knows.
        scores: Per robot those of its map.
        pose_errors: (K, 2): distance [m] and difference of the headings [rad].
        standing: Of the team.
        terms: (K,) by name: what each term of the reward has paid for the step.
        invalid: Per robot 1 if its action was masked.
    """
    errors, collisions = pose_errors.tolist(), standing.collisions.tolist()
    distances, bytes_sent = standing.distances.tolist(), standing.bytes_sent.tolist()
    paid = {f"reward/{name}": values.tolist() for name, values in terms.items()}
    infos: dict[str, dict[str, Any]] = {}
    for robot, agent in enumerate(agents):
        score, group = scores[robot], groups[robot]
        infos[agent] = {
            "map_error": score.error,
            "map_rmse": score.rmse,
            "map_recall": score.recall,
            "map_precision": score.precision,
            "pose_error": errors[robot][0],
            "heading_error": errors[robot][1],
            "coverage": standing.coverage,
            "group": group[0],
            "group_size": len(group),
            "merges": standing.merges,
            "collisions": collisions[robot],
            "distance": distances[robot],
            "bytes_sent": bytes_sent[robot],
            "invalid_action": invalid[robot],
            **{name: values[robot] for name, values in paid.items()},
        }
    return infos
