# %% [markdown]
# # Finding oneself in a saved map
#
# A map holds how its landmarks look. So a later frame can be found in it without any idea of where
# the camera is: the pose with its covariance, or the reason why none is to be believed.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg

recording = fg.rendered_recording("lab", frames=12)
with fg.Slam(recording.rig, estimator="isam2") as slam:
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
slam.result().map.save("place.fgmap")

# %% [markdown]
# ## Another day

# %%
place = fg.Map.load("place.fgmap")
print(f"{len(place)} landmarks")
images = recording[7][1]
assert images is not None  # it would be None for a frame that cannot be read
found = place.locate(recording.rig, images)
sigma_cm = 100.0 * np.sqrt(np.trace(found.covariance[3:, 3:]))
print(f"found: {found.found}, at {found.wTc[:3, 3].round(3)} m, {sigma_cm:.1f} cm: {found.why}")

# %% [markdown]
# The truth is known here: how far off is it?

# %%
truth = recording.ground_truth
assert truth is not None
first, true = truth.poses[[0, 7]]
error = np.linalg.norm(found.wTc[:3, 3] - (np.linalg.inv(first) @ true)[:3, 3])
print(f"off by {100.0 * error:.1f} cm")
assert found.found
assert error < 0.05

# %% [markdown]
# From above, the map's landmarks and where the frame was found:

# %%
plt.axes(aspect="equal", xlabel="right (m)", ylabel="ahead (m)")
plt.scatter(place.positions[:, 0], place.positions[:, 2], 4, "grey", label="landmarks")
plt.plot(*(np.linalg.inv(first) @ true)[[0, 2], 3], "g+", ms=18, label="true place of the frame")
plt.plot(*found.wTc[[0, 2], 3], "r.", label="found")
plt.legend()
plt.savefig("saved_map.png")

# %% [markdown]
# ## Going on in it
#
# A session can begin in the map. Its first pose is found without a prior; a frame before that has
# the status `not_located` and no pose. `extend_map=False` leaves the map as it is (estimators
# `landmark_kalman` and `ekf`); otherwise the session's result holds what became of it.

# %%
with fg.Slam(recording.rig, "landmark_kalman", start_map=place, extend_map=False) as later:
    steps = [later.track(*recording[k]) for k in range(7, 12)]
print([step.status.value for step in steps])
error = np.linalg.norm(steps[0].wTc[:3, 3] - (np.linalg.inv(first) @ true)[:3, 3])
assert error < 0.05

# %% [markdown]
# ## Where there is nothing to see
#
# A blank wall is refused with the reason, instead of being given some pose.

# %%
blank = tuple(np.full_like(image, 128) for image in images)
refused = place.locate(recording.rig, blank)
print(f"found: {refused.found}: {refused.why}")
assert not refused.found
