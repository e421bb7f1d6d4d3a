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
# # The SLAM backend on a log
#
# A robot drives a figure of eight among ten landmarks and logs velocities, ranges and bearings. The log is simulated
# here; replace the first cell by `read_csv` on your own files.

# %%
import matplotlib.pyplot as plt
import numpy as np

from slam_backend import FastSlam, OdometryModel
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.metrics import ate
from slam_backend.readers import integrate_commands, range_bearing_steps
from slam_backend.trajectory import dead_reckoning

rng = np.random.default_rng(7)
times = np.arange(0.0, 120.0, 0.1)
driven = np.column_stack([times, np.full_like(times, 0.4), 0.35 * np.where(times % 36.0 < 18.0, 1.0, -1.0)])
truth = compose([2.0, 1.0, 0.8], integrate_commands(driven, times))
angles = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
posts = truth[:, :2].mean(axis=0) + 4.0 * np.column_stack([np.cos(angles), np.sin(angles)])
logged = driven * [1.0, 1.05, 0.95] + rng.normal(0.0, [0.0, 0.02, 0.02], driven.shape)
seen, names = [], []
for time, pose in zip(times[::5], truth[::5], strict=True):
    for name, (x, y) in zip("ABCDEFGHIJ", transform_points(inverse(pose), posts), strict=True):
        if abs(np.arctan2(y, x)) < 0.6:
            seen.append([time, np.hypot(x, y) + rng.normal(0.0, 0.08), np.arctan2(y, x) + rng.normal(0.0, 0.015)])
            names.append(name)

# %% [markdown]
# One call turns the log into evenly spaced steps; a filter takes them one by one. Gates for known identities: no
# position is unlikely enough to reject a name.

# %%
steps = range_bearing_steps(logged, seen, names, sigma_range=0.1, sigma_bearing=0.02, dt=0.25)
motion = OdometryModel(sigma_along=0.1, sigma_across=0.05, sigma_heading=0.2, sigma_turn=0.1, floor_heading=0.003)
slam = FastSlam(motion=motion, position_gate=1e4, new_landmark_gate=1e6, seed=0)
path = np.zeros((len(steps.times), 3))
for step, (moved, frame) in enumerate(zip(steps.odometry, steps.measurements, strict=True)):
    slam.step([moved if step else None], [frame])
    path[step] = slam.pose().mean

# %% [markdown]
# Errors after the best rigid fit, of the filter and of odometry alone.

# %%
true = np.column_stack([np.interp(steps.times, times, truth[:, axis]) for axis in range(2)])
reckoned = dead_reckoning(np.zeros(3), steps.odometry[1:])
found, alone = ate(path[:, :2], true), ate(reckoned[:, :2], true)
print(f"filter {found.aligned:.3f} m, odometry {alone.aligned:.3f} m")
print("warnings:", slam.consistency.warnings or "none")
assert found.aligned < 0.3 * alone.aligned

# %%
figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
for positions, result, label in ((path, found, "filter"), (reckoned, alone, "odometry")):
    axes.plot(*transform_points(result.transform, positions[:, :2]).T, label=label)
axes.plot(*true.T, color="0.7", lw=3, zorder=0, label="truth")
axes.plot(*transform_points(found.transform, slam.map().means[:, :2]).T, "k.", label="landmarks")
axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
axes.legend()
plt.show()
