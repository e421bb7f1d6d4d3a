"""The infos that an environment hands out with its observations."""

from collections.abc import Mapping, Sequence
from typing import Any

from slam_backend.errors import FloatArray
from vslam_env.reward import Standing


def infos_of(
    agents: Sequence[str],
    groups: Sequence[tuple[int, ...]],
    standing: Standing,
    terms: Mapping[str, FloatArray],
    invalid: Sequence[int],
) -> dict[str, dict[str, Any]]:
    """Return each agent's figures; `map_rmse` is the cutoff of the map error while nothing is matched.

    `collisions` (ticks), `distance` [m], `bytes_sent` and `merges` count since the reset.

    Args:
        agents: Names of the K robots.
        groups: Per robot who shares its map, as far as it knows.
        standing: Of the team.
        terms: (K,) by name: what each term of the reward has paid for the step.
        invalid: Per robot 1 if its action was masked.
    """
    figures = zip(
        standing.map_errors.tolist(),
        standing.map_rmses.tolist(),
        standing.map_recalls.tolist(),
        standing.map_precisions.tolist(),
        standing.pose_errors.tolist(),
        standing.heading_errors.tolist(),
        standing.collisions.tolist(),
        standing.distances.tolist(),
        standing.bytes_sent.tolist(),
        strict=True,
    )
    paid = {f"reward/{name}": values.tolist() for name, values in terms.items()}
    infos: dict[str, dict[str, Any]] = {}
    for robot, (agent, group, own) in enumerate(zip(agents, groups, figures, strict=True)):
        error, rmse, recall, precision, pose_error, heading_error, collisions, distance, bytes_sent = own
        infos[agent] = {
            "map_error": error,
            "map_rmse": rmse,
            "map_recall": recall,
            "map_precision": precision,
            "pose_error": pose_error,
            "heading_error": heading_error,
            "coverage": standing.coverage,
            "group": group[0],
            "group_size": len(group),
            "merges": standing.merges,
            "collisions": collisions,
            "distance": distance,
            "bytes_sent": bytes_sent,
            "invalid_action": invalid[robot],
            **{name: values[robot] for name, values in paid.items()},
        }
    return infos
