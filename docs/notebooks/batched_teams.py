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
# # Batches of teams
#
# Teams of two robots in different worlds drive at once, in one compiled function. It needs the extra `jax`; without an
# accelerator compiling takes a minute or two, and the drive another one.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

from vslam_env import EnvConfig
from vslam_env.batched.environment import BatchedExploration

config = EnvConfig(world="hall", num_robots=2, observation_keys="driver", decision_ticks=10, max_seconds=40)
env = BatchedExploration(config, num_worlds=3, rows=192)
reset, step = jax.jit(jax.vmap(env.reset_in)), jax.jit(jax.vmap(env.step_env))

# %% [markdown]
# A batch has an environment in each of the three worlds. Robots follow the longer side of their scan: a driver in a
# line of code, for all of them.

# %%
observations, state = reset(np.arange(3), jax.random.split(jax.random.key(0), 3))
errors, paths = [], [state.episode.poses]
for second in range(40):
    actions = {}
    for agent in env.agents:
        scan = observations[agent]["scan"]
        right, left = scan[:, :16].mean(axis=1), scan[:, 16:].mean(axis=1)
        room = scan[:, 12:20].min(axis=1)
        actions[agent] = np.stack([np.clip(room - 0.8, 0.0, 0.6), np.clip(0.4 * (left - right) + 0.1, -1, 1)], axis=1)
    observations, state, rewards, dones, infos = step(jax.random.split(jax.random.key(second), 3), state, actions)
    errors.append(infos["map_error"].mean(axis=1))
    paths.append(state.episode.poses)

# %% [markdown]
# The error E of the maps (0.71 m: nothing found), and where the robots of the first world drove. A belief has its
# landmarks in the frame of the group's first robot.

# %%
figure, (left_axes, right_axes) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
left_axes.plot(np.arange(1, len(errors) + 1), np.array(errors), label=[f"world {i}" for i in range(3)])
left_axes.set(xlabel="time [s]", ylabel="map error E [m]", ylim=(0, 0.75))
left_axes.legend()
scene = jax.tree.map(lambda values: np.asarray(values[0]), env.scenes)
for x0, y0, x1, y1 in scene.walls[np.abs(scene.walls[:, 0]) < 1e4]:
    right_axes.plot([x0, x1], [y0, y1], color="0.5", linewidth=1)
right_axes.scatter(*scene.landmarks[scene.observable, :2].T, s=4, color="0.6")
for robot in range(2):
    right_axes.plot(*np.array(paths)[:, 0, robot, :2].T, label=env.agents[robot])
right_axes.set_aspect("equal")
right_axes.legend()
plt.show()

# %%
belief = jax.tree.map(lambda values: np.asarray(values[0]), state.episode.belief)
held = belief.counts >= 2
print(f"{held.sum()} landmarks, groups {belief.groups.tolist()}")
print("first places [m]:", belief.places[held][:3].astype(float).round(2).tolist())
