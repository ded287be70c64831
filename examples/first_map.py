# %% [markdown]
# # A first map from arrays
#
# Two or three rectified cameras, images as NumPy arrays, and out come the path of the camera and a
# map of landmarks. The images of this example are rendered (a laboratory, three cameras, wheel
# odometry with noise), so that it runs alone, offline, in some seconds. Yours may come from any
# camera or file: (height, width) or (height, width, 3), uint8 or uint16.

# %%
import matplotlib.pyplot as plt

import fgslam as fg

recording = fg.rendered_recording("lab", frames=12)  # for your own: a list of (t, images, odometry)

# %% [markdown]
# ## The cameras
#
# Rectified images need seven numbers; `fg.load_rig("camchain.yaml")` reads calibration files.

# %%
rig = fg.StereoRig(
    width=320, height=240, fx=recording.rig.fx, fy=recording.rig.fy, cx=recording.rig.cx,
    cy=recording.rig.cy, baseline=recording.rig.baseline,
    vertical_baseline=recording.rig.vertical_baseline, bTc=recording.rig.bTc,
)  # fmt: skip

# %% [markdown]
# ## Track

# %%
with fg.Slam(rig, estimator="isam2") as slam:
    for t, images, odometry in recording:  # images: (left, right, top); odometry may be None
        step = slam.track(t, images, odometry)
        x, _, z = step.wTc[:3, 3]
        print(f"{t:5.2f} s  {step.status.value:5}  x {x:6.3f} m  z {z:6.3f} m  {step.landmarks}")

# %% [markdown]
# ## Keep what was found

# %%
result = slam.result()
result.trajectory.save("path.tum")  # of the right camera; evo reads it
result.map.save("map.ply")  # MeshLab, CloudCompare and Open3D read it
slam.log.save("drive.npz")  # the measurements, for other estimators: see filter_or_smoother.py
print(f"{len(result.trajectory)} poses, {len(result.map)} landmarks")

# %% [markdown]
# ## From above

# %%
landmarks, path = result.map.positions, result.trajectory.poses[:, :3, 3]
plt.axes(aspect="equal", xlabel="right (m)", ylabel="ahead (m)")
plt.scatter(landmarks[:, 0], landmarks[:, 2], 4, landmarks[:, 1], label="landmarks, by height")
plt.plot(path[:, 0], path[:, 2], "r.-", label="path of the camera")
plt.legend()
plt.savefig("first_map.png")
