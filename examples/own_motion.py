# %% [markdown]
# # A motion model of your own
#
# A motion model predicts how the camera has moved since the last frame (`fgslam.MotionModel`): five
# members, and what it gives with a covariance is a measurement to every estimator. Where a robot's
# commands are known, or what its wheels can do, it predicts better than the built-in ones.
#
# This one is for a robot on wheels whose odometry is broken: it drives forward and turns, and does
# not jump sideways or up. It expects the last speed and the last turn.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, se3_exp, se3_log
from fgslam.core.types import Prediction

# Of the camera, in the order of all tangents: turns about x, y, z, then ways along them. The camera
# looks along z and y points down: the robot turns about y and drives along z.
TURNS, DRIVES = 1, 5
SHAKE = np.array([0.002, 0.02, 0.002, 0.002, 0.002, 0.02])  # rad and m, of a frame


class OnWheels:
    """The last turn and the last way once more, and nothing else."""

    uses_odometry = False

    def __init__(self) -> None:
        self.last: tuple[float, FloatArray] | None = None
        self.speed = np.zeros(6)

    def between(self, timestamp: float, body: fg.Odometry | None) -> fg.Odometry | None:
        """Expected motion of the camera since the last frame, with its covariance."""
        if self.last is None:
            return None
        dt = timestamp - self.last[0]
        return fg.Odometry(se3_exp(self.speed * dt), np.diag(SHAKE**2), measured=True)

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        """Learns the speed from the pose that the frame was found at."""
        if self.last is not None and measured:
            before, wTc = self.last
            step = se3_log(inverse(wTc) @ pose.wTc) / (timestamp - before)
            self.speed = np.zeros(6)
            self.speed[[TURNS, DRIVES]] = step[[TURNS, DRIVES]]
        self.last = timestamp, pose.wTc

    def displaced(self, timestamp: float, wTc: FloatArray, carried: bool) -> None:
        """Somebody moved the robot, or a loop moved its map: that was no driving."""
        self.last = timestamp, wTc

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """Found again after a motion that nobody expected."""
        self.speed, self.last = np.zeros(6), (timestamp, wTc)


# %%
recording = fg.rendered_recording("lab", frames=12)
with fg.Slam(recording.rig, estimator="isam2", odometry=OnWheels()) as slam:
    for t, images, _ in recording:
        step = slam.track(t, images)
result = slam.result()
print(f"{len(step.matches)} matches in the last frame, {step.landmarks} landmarks")

# %% [markdown]
# What the model measured is in the log, so that every estimator replays the same.

# %%
table = fg.compare({"isam2": result, "batch": fg.replay(slam.log, "batch")}, recording.ground_truth)
print(table.round(4))
assert table["ate_m"].max() < 0.02

# %% [markdown]
# From frame to frame, what the model expected and how far the camera went:

# %%
expected = [increment.odometry.motion[2, 3] for increment in slam.log if increment.odometry]
plt.axes(xlabel="frame", ylabel="motion ahead (cm)", ylim=(0.0, 12.0))
plt.plot(range(1, 12), 100.0 * np.diff(result.trajectory.poses[:, 2, 3]), "o-", label="found")
plt.plot(range(12 - len(expected), 12), 100.0 * np.array(expected), "x--", label="expected")
plt.legend()
plt.savefig("own_motion.png")
