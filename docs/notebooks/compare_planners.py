# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Compare planners
#
# Three planners in the same halls, with the same starts and noise. `vslam bench exploration` does this for more worlds,
# with intervals and resumption; here it is a loop that you can change.

# %%
import matplotlib.pyplot as plt
import numpy as np

from agents import make_policy
from vslam_env import vslam_v1

PLANNERS = {"random_goals": "goal", "frontier": "continuous", "next_best_view": "continuous"}  # and their action types
SEEDS, SECONDS = range(3), 100


def episode(planner: str, seed: int) -> np.ndarray:
    """Return map error [m] and coverage after each second."""
    action_type = PLANNERS[planner]
    env = vslam_v1.parallel_env(world="hall", num_robots=2, action_type=action_type, max_seconds=SECONDS)
    observations, _ = env.reset(seed=seed)
    policies, rng = {agent: make_policy(planner, action_type) for agent in env.agents}, np.random.default_rng(seed)
    rows = []
    while env.agents:
        actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
        observations, _, _, _, infos = env.step(actions)
        rows.append([np.mean([info["map_error"] for info in infos.values()]), infos["robot_0"]["coverage"]])
    return np.array(rows)[len(rows) // SECONDS - 1 :: len(rows) // SECONDS]


results = {planner: np.array([episode(planner, seed) for seed in SEEDS]) for planner in PLANNERS}

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
for planner, rows in results.items():
    for axis, column in zip(axes, np.moveaxis(rows, -1, 0), strict=True):
        axis.plot(np.arange(1, SECONDS + 1), column.mean(axis=0), label=planner)
axes[0].set(xlabel="time [s]", ylabel="map error E [m]")
axes[1].set(xlabel="time [s]", ylabel="coverage")
axes[0].legend()
plt.show()

# %% [markdown]
# For half a minute `next_best_view` gains nothing; then it sees again what the others missed. Compare pairs, world by
# world: differences vary less than the results themselves. Three worlds prove nothing; the leaderboard has more.

# %%
for planner in ("random_goals", "next_best_view"):
    difference = results[planner][:, -1, 0] - results["frontier"][:, -1, 0]
    print(f"{planner} minus frontier: E {difference.mean():+.3f} m, by world {difference.round(3).tolist()}")
assert results["next_best_view"][:, -1, 0].mean() < results["frontier"][:, -1, 0].mean()
