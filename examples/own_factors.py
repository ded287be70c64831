# %% [markdown]
# # Add your own factors
#
# `fg.graph` gives a log as GTSAM's own factor graph, with values at the solution. What GTSAM can do
# with a graph can be done with this one: here a position is added, as a GPS gives it, and all
# solved again by GTSAM's Levenberg-Marquardt.

# %%
import gtsam
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg

recording = fg.rendered_recording("lab", frames=12)
with fg.Slam(recording.rig, estimator="landmark_kalman") as slam:
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
graph, values, poses, landmarks = fg.graph(slam.log)
print(f"{graph.size()} factors of {len(poses)} poses and {len(landmarks)} landmarks")

# %% [markdown]
# The last camera is said to be 5 cm further to the right, to a millimetre: a pose of the first
# frame is held by its prior, so everything between bends.

# %%
last = poses[max(poses)]
there = values.atPose3(last).translation() + np.array([0.05, 0.0, 0.0])
graph.add(gtsam.GPSFactor(last, there, gtsam.noiseModel.Isotropic.Sigma(3, 0.001)))
solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
moved = [solved.atPose3(k).translation() - values.atPose3(k).translation() for k in poses.values()]
print(np.round(1e3 * np.array(moved)[:, 0], 1), "mm to the right")
assert 0.03 < moved[-1][0] < 0.051  # odometry and matches hold against it
assert abs(moved[0][0]) < 0.001

# %% [markdown]
# How the path bends:

# %%
plt.axes(xlabel="frame", ylabel="moved to the right (mm)")
plt.plot(list(poses), 1e3 * np.array(moved)[:, 0], "o-")
plt.savefig("own_factors.png")
