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
    robots = len(agents)
    columns: dict[str, Sequence[Any]] = {
        "map_error": standing.map_errors.tolist(),
        "map_rmse": standing.map_rmses.tolist(),
        "map_recall": standing.map_recalls.tolist(),
        "map_precision": standing.map_precisions.tolist(),
        "pose_error": standing.pose_errors.tolist(),
        "heading_error": standing.heading_errors.tolist(),
        "coverage": [standing.coverage] * robots,
        "group": [group[0] for group in groups],
        "group_size": [len(group) for group in groups],
        "merges": [standing.merges] * robots,
        "collisions": standing.collisions.tolist(),
        "distance": standing.distances.tolist(),
        "bytes_sent": standing.bytes_sent.tolist(),
        "invalid_action": invalid,
    }
    columns |= {f"reward/{name}": paid.tolist() for name, paid in terms.items()}
    rows = zip(*columns.values(), strict=True)
    return {agent: dict(zip(columns, row, strict=True)) for agent, row in zip(agents, rows, strict=True)}
