# %% [markdown]
# # A measurement of your own
#
# A measurement model is one function, `predict`: what the sensor should read, of points in its own
# frame, over arrays. Derivatives, where a landmark begins, factors of GTSAM: all that is made of
# it, and every estimator takes it. This one is the direction of a beacon, as a microphone array or
# an infrared sensor gives it; a robot on wheels drives a circle among ten of them.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import se3_exp


class Direction(fg.LandmarkModel):
    """Azimuth and elevation of a beacon, radians; x ahead, y to the left, z up."""

    kind, size, angles = "direction", 2, (0, 1)

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 2) of points (k, 3)."""
        azimuth, across = np.arctan2(x[:, 1], x[:, 0]), np.hypot(x[:, 0], x[:, 1])
        return np.column_stack([azimuth, np.arctan2(x[:, 2], across)])


# %% [markdown]
# ## A log of your own
#
# A frame is its time, the odometry since the last one, and what was measured. The beacons are told
# apart by numbers. (With cameras, `Slam.log` is such a log already, and landmarks share numbers.)
# Where the robot and its beacons lie in a plane, heights are measured, too: 0, with a variance; of
# the six degrees of freedom three never err then, and a NEES of 0.5 is right.

# %%
rng = np.random.default_rng(1)
beacons = rng.uniform([-6.0, -3.0, 0.5], [6.0, 9.0, 3.0], (10, 3))
step, noise = np.array([0.0, 0.0, 0.1, 0.3, 0.0, 0.0]), np.array([0.001] * 2 + [0.01] + [0.02] * 3)
direction, sigma = Direction(), 0.01
log, true = fg.MeasurementLog(), [np.eye(4)]
for k in range(64):
    if k:
        true.append(true[-1] @ se3_exp(step))
    moved = se3_exp(step + noise * rng.standard_normal(6))
    exact = direction.predict((beacons - true[-1][:3, 3]) @ true[-1][:3, :3])
    seen = exact + sigma * rng.standard_normal(exact.shape)
    odometry = fg.Odometry(moved, np.diag(noise**2)) if k else None
    measured = direction.measured(seen, sigma**2 * np.eye(2), ids=range(10))
    log.append(fg.Increment.of(k, 0.2 * k, odometry, [measured]))

# %% [markdown]
# ## Six estimators

# %%
kinds = ["landmark_kalman", "ekf", "fixed_lag", "sliding_window", "isam2", "batch"]
answers = {kind: fg.replay(log, kind) for kind in ["odometry", *kinds]}
table = fg.compare(answers, fg.Trajectory(log.timestamps, np.array(true)))
print(table.round(3).to_string())
assert "failure" not in table  # a column that is there where an estimator ended early
ate = dict(table["ate_m"])
assert max(ate[kind] for kind in kinds) < 0.5 * ate["odometry"]

# %% [markdown]
# Over time:

# %%
plt.axes(xlabel="time (s)", ylabel="error of the position (m)")
for kind, answer in answers.items():
    error = np.linalg.norm((answer.trajectory.poses - true)[:, :3, 3], axis=1)
    plt.plot(log.timestamps, error, label=kind)
plt.legend()
plt.savefig("own_measurement.png")
