# %% [markdown]
# # A camera of your own
#
# A camera source is anything that gives times and images, one frame after the other: `track` asks
# for nothing else. Here two webcams of OpenCV, raw images, rectified by what `fgslam calibrate`
# wrote. So that it runs without them, two films stand in; on your desk it is
# `TwoWebcams(0, 1)` and your own `calib.json`.

# %%
import time
from collections.abc import Iterator

import cv2
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.core.arrays import Image


class TwoWebcams:
    """Pairs of images (left, right) with their time, as fast as the cameras give them."""

    def __init__(self, left: int | str, right: int | str) -> None:
        self.cameras = [cv2.VideoCapture(left), cv2.VideoCapture(right)]
        if not all(camera.isOpened() for camera in self.cameras):
            raise SystemExit("a camera cannot be opened; is it plugged in, or in use?")

    def __iter__(self) -> Iterator[tuple[float, tuple[Image, ...]]]:
        """Both are asked for an image first, and then decoded: so they are of one moment."""
        while all(camera.grab() for camera in self.cameras):
            t = time.monotonic()
            images = [camera.retrieve()[1] for camera in self.cameras]
            yield t, tuple(np.asarray(image[..., ::-1], np.uint8) for image in images)  # RGB


# %% [markdown]
# The stand-ins: left and right images of the rendered laboratory, as films.

# %%
recording = fg.rendered_recording("lab", frames=12)
size = recording.rig.width, recording.rig.height
films = [
    cv2.VideoWriter(f"{name}.avi", cv2.VideoWriter.fourcc(*"MJPG"), 4.0, size)
    for name in ("left", "right")
]
for _time, rendered, _odometry in recording:
    for film, image in zip(films, rendered or (), strict=False):  # the third is the top camera's
        film.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
for film in films:
    film.release()

# %% [markdown]
# The cameras: of your own two, `rig = fg.load_rig("calib.json")`.

# %%
lab = recording.rig
rig = fg.StereoRig(lab.width, lab.height, lab.fx, lab.fy, lab.cx, lab.cy, lab.baseline)
slam = fg.Slam(rig, estimator="landmark_kalman")
for t, pair in TwoWebcams("left.avi", "right.avi"):
    step = slam.track(t, pair)
    print(f"{step.status.value:6} {len(step.matches):4} matches, {step.landmarks} landmarks")

# %%
result = slam.result()
result.map.save("desk.ply")
assert len(result.trajectory) == 12

# %% [markdown]
# The last image of the right camera: landmarks that it sees again, and new ones.

# %%
plt.imshow(pair[1])
plt.plot(*step.matches.pixels[:, 0].T, "y+", label="seen again")
plt.plot(*step.new.pixels[:, 0].T, "r+", label="new")
plt.legend()
plt.savefig("own_camera.png")
