"""The infos that an environment hands out with its observations."""

from collections.abc import Mapping, Sequence
from typing import Any

from vslam_env.standing import Standing


def infos_of(
    agents: Sequence[str],
    groups: Sequence[tuple[int, ...]],
    standing: Standing,
    terms: Mapping[str, Sequence[float]],
    invalid: Sequence[int],
) -> dict[str, dict[str, Any]]:
    """Return each agent's figures; `map_rmse` is the cutoff of the map error while nothing is matched.

    `collisions` (ticks), `distance` [m], `bytes_sent` and `merges` count since the reset.

    Args:
        agents: Names of the K robots.
        groups: Per robot who shares its map, as far as it knows.
        standing: Of the team.
        terms: By name, per robot: what each term of the reward has paid for the step.
        invalid: Per robot 1 if its action was masked.
    """
    errors, rmses, recalls, precisions, _, pose_errors, heading_errors, _, _, distances, _ = standing.figures
    collisions, bytes_sent = standing.counts
    infos: dict[str, dict[str, Any]] = {}
    for robot, agent in enumerate(agents):
        group = groups[robot]
        infos[agent] = info = {
            "map_error": errors[robot],
            "map_rmse": rmses[robot],
            "map_recall": recalls[robot],
            "map_precision": precisions[robot],
            "pose_error": pose_errors[robot],
            "heading_error": heading_errors[robot],
            "coverage": standing.coverage,
            "group": group[0],
            "group_size": len(group),
            "merges": standing.merges,
            "collisions": collisions[robot],
            "distance": distances[robot],
            "bytes_sent": bytes_sent[robot],
            "invalid_action": invalid[robot],
        }
        for name, paid in terms.items():
            info["reward/" + name] = paid[robot]
    return infos
