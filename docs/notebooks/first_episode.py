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
# # A first episode
#
# Two robots explore a hall with the nearest-frontier planner. The notebook draws what they believe, and how the error
# of their maps falls.

# %%
import matplotlib.pyplot as plt
import numpy as np

from agents import make_policy
from vslam_env import vslam_v1

env = vslam_v1.parallel_env(world="hall", num_robots=2, action_type="goal", max_seconds=60, render_mode="rgb_array")
observations, infos = env.reset(seed=0)
policies = {agent: make_policy("frontier", "goal") for agent in env.agents}
rng = np.random.default_rng(0)
print({name: value.shape for name, value in observations["robot_0"].items()})

# %% [markdown]
# Each step is a second: a robot drives towards the chosen candidate. Policies get an observation and a belief; infos
# have the truth, for evaluation only.

# %%
errors = []
while env.agents:
    actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    errors.append([info["map_error"] for info in infos.values()])
    for event in env.events:
        if event.kind == "merge" and event.step >= 10 * (len(errors) - 1):
            print(f"{len(errors)} s: robots {event.robots_a} and {event.robots_b} share a map from now on")

# %% [markdown]
# The error E of a map: 0.71 m = nothing found, 0 = a perfect map.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
left.plot(np.arange(1, len(errors) + 1), errors, label=env.possible_agents)
left.set(xlabel="time [s]", ylabel="map error E [m]", ylim=(0, 0.75))
left.legend()
right.imshow(env.render())
right.set_axis_off()
plt.show()

# %% [markdown]
# The map of a robot has means and covariances, in its own start frame.

# %%
landmarks = env.belief("robot_0").map
deviations = np.sqrt(np.linalg.eigvalsh(landmarks.covariances)[:, -1])
print(f"{len(landmarks.means)} landmarks, standard deviations {deviations.min():.3f} to {deviations.max():.3f} m")
assert errors[-1][0] < errors[0][0]
