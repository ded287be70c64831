# %% [markdown]
# # Which way is home?
#
# Two images of an omnidirectional camera say in which direction the place of the second lies from
# the first, and how the camera was turned there: the *homing vector* of Goedemé et al. (2005). The
# distance is not known, since images have no scale. Where two images do not show one place well
# enough, there is no vector but a refusal with its reason.
#
# This script opens as a notebook (jupytext, VS Code) and runs alone, offline, in some seconds. Its
# images are rendered in a simulated house, by a hyperbolic mirror on a wheelchair.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.datasets.opening import open_house
from fgslam.worlds.settings import HousePathSettings, OmniHouseSettings

house = open_house(OmniHouseSettings(path=HousePathSettings(legs=6, spacing_m=2.0)), seed=0)
camera = house.camera  # your own: fg.load_camera("calib_results.txt")
here, there, other_room = (house.reference_poses[k] for k in (0, 1, 6))
image, target, elsewhere = (
    house.picture(pose, k) for k, pose in enumerate((here, there, other_room))
)

# %% [markdown]
# ## The vector, with its uncertainty

# %%
homing = fg.HomingVector(camera)
answer = homing.between(image, target)
assert isinstance(answer, fg.TwoViewVector), answer
direction, rotation = np.degrees([answer.direction, answer.rotation])
sigma = np.degrees(np.sqrt(np.diag(answer.covariance)))
print(f"home lies at {direction:.1f} +- {sigma[0]:.1f} degrees, counter-clockwise from ahead")
print(f"there the camera is turned by {rotation:.1f} +- {sigma[1]:.1f} degrees")
print(f"{answer.support} matches agree on that")

# %% [markdown]
# The renderer knows the truth:

# %%
to_target = there[:2] - here[:2]
true_direction = np.degrees(np.arctan2(to_target[1], to_target[0]) - here[2])
true_rotation = np.degrees(there[2] - here[2])
errors = [
    (found - true + 180.0) % 360.0 - 180.0
    for found, true in ((direction, true_direction), (rotation, true_rotation))
]
print(f"errors: {errors[0]:.2f} and {errors[1]:.2f} degrees")
assert np.all(np.abs(errors) < 5.0)

# %% [markdown]
# As the camera sees it, and from above in the house:

# %%
figure, (view, plan) = plt.subplots(1, 2, figsize=(10.0, 5.0), layout="constrained")
view.imshow(image, "gray")
ahead = np.array([np.cos(answer.direction), np.sin(answer.direction), 0.0])
view.plot(*camera.pixels(np.outer(1.0, ahead)).T, "rx", ms=15, mew=3, label="home lies there")
view.legend(loc="lower left")
for ends in house.outlines:
    plan.plot(*ends.T, "grey", lw=0.8)
bearing = here[2] + answer.direction
plan.quiver(*here[:2], np.cos(bearing), np.sin(bearing), color="r", label="homing vector")
plan.plot(*here[:2], "o", label="here")
plan.plot(*there[:2], "*", ms=12, label="home")
plan.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", xlim=(1.0, 9.0), ylim=(8.0, 16.0))
plan.legend()
figure.savefig("homing_vector.png")

# %% [markdown]
# ## A refusal
#
# The third image was taken in another room. A refusal is false, so that `if answer:` asks whether
# there is a vector.

# %%
refusal = homing.between(image, elsewhere)
assert not refusal
print(f"{refusal.reason.value}: {refusal.details}")

# %% [markdown]
# ## Driving home
#
# Followed image by image, the same vector steers a robot: `fg.teach` remembers the path along some
# images, and `fg.PathFollower` turns each new image into a speed and a turning rate.

# %%
path = fg.teach([target], camera)
with fg.PathFollower(camera, path, estimator="homing_graph") as follower:
    for k in range(10):
        command = follower.step(house.image(0.1 * k), 0.1 * k)
        house.drive(command.v, command.omega, 0.1)
print(f"{command.state.value}: v = {command.v:.2f} m/s, omega = {command.omega:.2f} rad/s")
print(f"{command.remaining:.0%} of the way left, after one second")
assert command.remaining < 1.0
