# %% [markdown]
# # Drive home
#
# A wheelchair with a mirror camera is led along a path once and remembers features of some images,
# no pixels and no map. Afterwards it drives the path by itself, image by image, on bearings alone
# (Goedemé et al. 2005). The house of this example is simulated; it runs alone, offline, in about a
# minute.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.datasets.opening import open_house
from fgslam.worlds.settings import HousePathSettings, OmniHouseSettings

house = open_house(OmniHouseSettings(path=HousePathSettings(legs=1, spacing_m=2.0)), seed=0)

# %% [markdown]
# ## Teach the path
#
# One image for each target, about 2 m apart. With a camera of your own: `fg.load_camera(file)`.

# %%
path = fg.teach(house.targets, house.camera)
kilobytes = path.save(Path("path.npz"))
print(f"{len(path.images)} target, {kilobytes:.0f} kB")

# %% [markdown]
# ## Follow it
#
# `step` takes the present image and its time and gives a speed and a turning rate, which hold until
# the next image. A homing vector that is not certain is refused with its reason; the robot then
# stands, or looks again from farther on.

# %%
dt, driven = 0.1, [house.true_pose]
with fg.PathFollower(house.camera, path, estimator="homing_graph") as follower:
    for k in range(400):
        command = follower.step(house.image(k * dt), k * dt)
        house.drive(command.v, command.omega, dt)
        driven.append(house.true_pose)
        if k % 20 == 0:
            print(f"{k * dt:4.1f} s  {command.v:4.2f} m/s  {np.degrees(command.omega):5.1f} deg/s")
        if follower.finished and command.v == command.omega == 0.0:
            break

# %% [markdown]
# ## How near?

# %%
(leg,) = follower.legs
distance = float(np.linalg.norm(house.true_pose[:2] - house.target_poses[-1][:2]))
print(f"{leg.result}: {distance:.2f} m from the target")
assert distance < 0.3

# %% [markdown]
# From above:

# %%
plt.axes(aspect="equal", xlabel="x (m)", ylabel="y (m)", xlim=(1.0, 9.0), ylim=(8.0, 16.0))
for ends in house.outlines:
    plt.plot(*ends.T, "grey", lw=0.8)
plt.plot(*np.array(driven)[:, :2].T, "b", label="driven")
plt.plot(*house.target_poses[:, :2].T, "r*", ms=12, label="target")
plt.legend()
plt.savefig("drive_home.png")
