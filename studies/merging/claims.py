"""Attempts of teams to merge, beside the truth: what they claim to know of the relative start, and its error.

    python -m studies.merging.claims --extent 120 --seconds 1800 --first-seed 10001 --seeds 4

The episodes are those of `python -m studies.scale`. A line of JSON for each attempt whose maps align: time, groups,
claimed standard deviations, error, and NEES, the squared error in units of the claimed covariance (three degrees of
freedom: 2.4 in the median if claims are right). Then a summary of all.
"""

import json
from typing import Annotated, Any

import numpy as np
import typer

from slam_backend.core.validation import check_int
from slam_backend.geometry import between, wrap_angle
from slam_backend.maps.alignment import Alignment
from slam_backend.team import merge
from slam_backend.team.groups import Group
from studies.scale import DECISION_LIMIT, Config, environment, trials
from training.bench.exploration.players import parted
from training.episodes.runner import Progress, run_episode
from vslam_env import warm_up
from vslam_env.environment import ExplorationEnv

Claim = dict[str, Any]


def claims_of(config: Config) -> tuple[list[Claim], list[tuple[float, float]]]:
    """Play the first trial; return its claims, and the error [m, degrees] of each merge."""
    trial, claims, now = trials(config)[0], [], [0.0]
    env = ExplorationEnv(environment(config, trial))
    decide = merge.refused_if_uncertain  # type: ignore[attr-defined]

    def noted(found: Alignment, pair: tuple[Group, Group], *args: Any) -> Alignment:
        decided = decide(found, pair, *args)
        starts, frames = env.true_start_poses, [group.robots[0] for group in pair]
        error = found.transform - between(starts[frames[0]], starts[frames[1]])
        error[2] = wrap_angle(error[2])
        covariance = found.covariance
        claims.append(
            {
                "time_s": now[0], "groups": [list(group.robots) for group in pair], "merged": decided.success,
                "sigma_m": float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])),
                "error_m": float(np.hypot(*error[:2])), "error_deg": float(np.degrees(abs(error[2]))),
                "nees": float(error @ np.linalg.solve(covariance, error)),
            }
        )  # fmt: skip
        return decided

    def watch(progress: Progress) -> None:
        now[0] = progress.time

    merge.refused_if_uncertain = noted  # type: ignore[attr-defined, assignment]
    try:
        record = run_episode(env, parted(config.policy).make(env, DECISION_LIMIT), trial.seed, watch)
    finally:
        merge.refused_if_uncertain = decide  # type: ignore[attr-defined]
    return claims, [(merge.error_m, merge.error_deg) for merge in record.merges]


def main(
    extent: Annotated[float, typer.Option(help="Width of the worlds [m].")] = 120.0,
    robots: Annotated[int, typer.Option(help="Robots of each team.")] = 3,
    seconds: Annotated[float, typer.Option(help="Simulated time of an episode [s].")] = 1800.0,
    first_seed: Annotated[int, typer.Option(help="First seed.")] = 10001,
    seeds: Annotated[int, typer.Option(help="Number of episodes.")] = 4,
    after: Annotated[float, typer.Option(help="Time [s] from which claims count in the summary.")] = 600.0,
) -> None:
    """Print the claims of each episode, and the median NEES of all and of merges."""
    check_int("seeds", seeds, 1, "Use at least one episode.")
    warm_up(workers=1)
    claims: list[Claim] = []
    errors: list[tuple[float, float]] = []
    for seed in range(first_seed, first_seed + seeds):
        config = Config(extents=(extent,), robots=(robots,), duration=seconds, seed=seed, seeds=1)
        found, merges = claims_of(config)
        for claim in found:
            print(json.dumps({"seed": seed, **claim}), flush=True)
        claims, errors = claims + found, errors + merges
    late = [claim["nees"] for claim in claims if claim["time_s"] >= after]
    joined = [claim["nees"] for claim in claims if claim["merged"]]
    print(f"{len(errors)} merges, errors up to {max((m for m, _ in errors), default=float('nan')):.2f} m")
    for name, values in ((f"attempts after {after:g} s", late), ("merges", joined)):
        print(f"NEES of {len(values)} {name}: {np.median(values) if values else float('nan'):.1f} in the median")


if __name__ == "__main__":
    typer.run(main)
