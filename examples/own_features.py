# %% [markdown]
# # Features of your own
#
# A feature extractor is any function from a grey image to `fgslam.Features`
# (`fgslam.FeatureExtractor`): n positions, scales and orientations, with descriptors of any kind.
# 128 bytes are taken as they are, other bytes as packed bits (ORB, BRISK, AKAZE), other numbers as
# vectors. Everything after it, from stereo matching to the map, works on them.
#
# First RootSIFT (Arandjelovic and Zisserman, CVPR 2012): SIFT whose descriptors are compared by the
# Hellinger kernel, which is the Euclidean distance of their square roots.

# %%
import cv2
import matplotlib.pyplot as plt
import numpy as np

import fgslam as fg
from fgslam.core.arrays import Image


def root_sift(image: Image) -> fg.Features:
    """Features of a grey image (height, width) uint8; called from several threads at once."""
    sift = cv2.SIFT.create(nOctaveLayers=2, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(image, None)
    if not points:
        descriptors = np.zeros((0, 128), np.float32)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    rooted = 512.0 * np.sqrt(descriptors / total)  # a norm of 512, as SIFT's descriptors have
    return fg.Features(
        xy=np.array([point.pt for point in points], np.float64).reshape(-1, 2),
        scale=np.array([0.5 * point.size for point in points]),
        orientation=np.deg2rad([point.angle for point in points]),
        descriptors=np.clip(np.rint(rooted), 0, 255).astype(np.uint8),
    )


# %% [markdown]
# Then ORB (Rublee et al., ICCV 2011): another detector, too, corners with 256 bits. It finds them
# at whole pixels, which would cost a stereo camera its depth; `cornerSubPix` refines them.


# %%
def orb(image: Image) -> fg.Features:
    """Features of a grey image (height, width) uint8; called from several threads at once."""
    detector = cv2.ORB.create(nfeatures=1500, fastThreshold=7)
    points, descriptors = detector.detectAndCompute(image, None)
    xy = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    if points:
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
        cv2.cornerSubPix(image, xy, (3, 3), (-1, -1), enough)  # in place
    return fg.Features(
        xy=xy.astype(np.float64),
        scale=np.array([1.2**point.octave for point in points]),
        orientation=np.deg2rad([point.angle for point in points]),
        descriptors=np.zeros((0, 32), np.uint8) if descriptors is None else descriptors,
    )


# %%
recording = fg.rendered_recording("lab", frames=12)
results = {}
plt.figure(figsize=(12.0, 3.5), layout="constrained")
for name, extractor in {"SIFT": None, "RootSIFT": root_sift, "ORB": orb}.items():
    with fg.Slam(recording.rig, estimator="landmark_kalman", features=extractor) as slam:
        for t, images, odometry in recording:
            step = slam.track(t, images, odometry)
    print(f"{name:8} {len(step.matches)} matches in the last frame, {step.landmarks} landmarks")
    results[name] = slam.result()
    assert images is not None
    plt.subplot(1, 3, len(results), title=f"{name}: matched with the map", xticks=[], yticks=[])
    plt.imshow(images[1], "gray")  # the right one, in which pixels come first
    plt.plot(*step.matches.pixels[:, 0].T, "y+")
plt.savefig("own_features.png")

# %%
table = fg.compare(results, recording.ground_truth)
print(table.round(4))
assert table["ate_m"].max() < 0.02
