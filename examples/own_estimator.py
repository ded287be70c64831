# %% [markdown]
# # An estimator of your own
#
# An estimator is an object with six members (`fgslam.Estimator`): its `kind`, what it `supports`,
# and `predict`, `landmarks`, `update`, `estimate`. It steers the tracking like any other, and it
# replays logs. This one is about the simplest that works: it takes the least-squares pose of each
# frame as it is, and leaves every landmark where it was first seen.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import transform_to_world
from fgslam.core.sensors import CameraRig, Increment, MeasurementType
from fgslam.core.types import EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats


class FirstSight:
    """Visual odometry against landmarks that never move."""

    kind = "first_sight"
    supports = frozenset({MeasurementType.ODOMETRY, MeasurementType.STEREO})

    def __init__(self, rig: CameraRig) -> None:
        self.rig = rig
        self.times: list[float] = []
        self.poses: list[FloatArray] = [np.eye(4)]
        self.covariances: list[FloatArray] = [np.zeros((6, 6))]
        self.map = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def predict(self, odometry: fg.Odometry | None) -> Prediction:
        """Pose after the camera moved by `odometry`, measured or a stand-in."""
        pose, covariance = self.poses[-1], self.covariances[-1]
        if odometry is None:
            return Prediction(pose, covariance)
        return Prediction(pose @ odometry.motion, covariance + odometry.covariance)

    def landmarks(self) -> LandmarkMap:
        """What the next frame is matched against."""
        return self.map

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Keeps the tracked pose; adds new landmarks, drops those that the database dropped."""
        if self.times and increment.timestamp <= self.times[-1]:
            raise EstimatorError("time must increase from frame to frame")
        self.times.append(increment.timestamp)
        self.poses.append(tracking.wTc)
        self.covariances.append(tracking.covariance)
        seen = increment.observations
        new = seen.select(seen.is_new)
        turned = tracking.wTc[:3, :3]
        local = self.rig.triangulation_covariance(new.measurement, new.covariance)
        points = transform_to_world(tracking.wTc, self.rig.triangulate(new.measurement))
        # Identities of new landmarks are higher than all before: they stay in ascending order.
        self.map = LandmarkMap(
            np.concatenate([self.map.ids, new.ids]),
            np.concatenate([self.map.positions, points]),
            np.concatenate([self.map.covariances, turned @ local @ turned.T]),
        ).without(increment.pruned_ids)
        closed = (False,) * len(increment.loops)
        return UpdateStats(
            tracking.wTc, tracking.covariance, len(self.map), float("nan"), 0, closed
        )

    def estimate(self) -> Estimate:
        """The poses as tracked, and the map."""
        trajectory = fg.Trajectory(np.array(self.times), np.array(self.poses[1:]))
        return Estimate(trajectory, np.array(self.covariances[1:]), self.map)


# %% [markdown]
# ## It steers a session ...

# %%
recording = fg.rendered_recording("lab", frames=12)
with fg.Slam(recording.rig, estimator=FirstSight(recording.rig)) as slam:
    for t, images, odometry in recording:
        slam.track(t, images, odometry)

# %% [markdown]
# ## ... and meets the others on the same log

# %%
answers = {"first_sight": fg.replay(slam.log, FirstSight(recording.rig))}
answers |= {kind: fg.replay(slam.log, kind) for kind in ("landmark_kalman", "isam2")}
table = fg.compare(answers, recording.ground_truth)
print(table.round(4))
assert "failure" not in table  # a column that is there where an estimator ended early
assert table["ate_m"].idxmax() == "first_sight"

# %% [markdown]
# Errors along the way, each from its own first pose on:

# %%
assert recording.ground_truth is not None
true = recording.ground_truth.poses
true = np.linalg.inv(true[0]) @ true
plt.axes(xlabel="time (s)", ylabel="error of the position (cm)")
for name, answer in answers.items():
    error = np.linalg.norm((answer.trajectory.poses - true)[:, :3, 3], axis=1)
    plt.plot(answer.trajectory.timestamps, 100.0 * error, ".-", label=name)
plt.legend()
plt.savefig("own_estimator.png")
