"""The rectified camera rig and the linear model of its pixels.

Derived in docs/derivations/stereo_measurement.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from fgslam.core.arrays import Brief, FloatArray
from fgslam.core.settings import RigPlaces


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CameraRig(Brief):
    """Two or three rectified pinhole cameras with equal intrinsics; the right one is the reference.

    The left camera sits ``baseline`` metres along the reference camera's -x axis, the top camera
    (if any) ``vertical_baseline`` metres along its -y axis (Se et al. 2.2). Hence a point at depth
    Z has disparities ``d = c_left - c_right = fx * baseline / Z`` and
    ``r_top - r_right = fy * vertical_baseline / Z``, both positive.

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels.
        baseline: horizontal baseline in metres.
        vertical_baseline: vertical baseline in metres, or None for a two-camera rig.
        bTc: (4, 4) pose of the reference camera in the robot's body frame (the lever arm).
        exact: the calibration has no error, as that of a rendered rig; else covariances contain
            what one leaves (:data:`fgslam.core.rig_correction.SHARED`).
        places: ``all`` images tell the measured column and row, by least squares; or the
            ``reference`` alone, where the others are measured by shifts from it.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    vertical_baseline: float | None
    bTc: FloatArray
    exact: bool = False
    places: RigPlaces = field(default="all", repr=False)

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Horizontal and vertical angle of view around the middle of the image, degrees."""
        half = 0.5 * np.array([self.width / self.fx, self.height / self.fy])
        across, down = np.degrees(2.0 * np.arctan(half)).tolist()
        return across, down

    @property
    def cameras(self) -> int:
        """Number of cameras, 2 or 3."""
        return 2 if self.vertical_baseline is None else 3


CAMERA_NAMES = ("right", "left", "top")
"""Of a rig's cameras in their order, the reference first."""

# --------------------------------------------------------------------------------------------
# The rig's linear model: raw pixels of its images and (column, row, disparity)


def vertical_to_horizontal(rig: CameraRig) -> float:
    """What vertical disparity is multiplied by to give horizontal; 1 for the paper's rig."""
    if rig.vertical_baseline is None:
        return 1.0
    return rig.fx * rig.baseline / (rig.fy * rig.vertical_baseline)


def pixel_model(cameras: int, ratio: float) -> FloatArray:
    """Linear map (2 * cameras, 3) from (column, row, disparity) to pixels (c, r) per camera.

    ``ratio`` is :func:`vertical_to_horizontal`.
    """
    model = np.zeros((2 * cameras, 3))
    model[0::2, 0] = 1.0  # columns of right, left, top
    model[1::2, 1] = 1.0  # rows
    model[2, 2] = 1.0  # the left camera's column grows by the disparity
    if cameras == 3:
        model[5, 2] = 1.0 / ratio  # and the top camera's row
    return model


def measurement_map(kind: str, cameras: int, ratio: float) -> FloatArray:
    """Linear map (3, 2 * cameras) from pixels (c, r) per camera to (column, row, disparity).

    The covariance of the measurement follows as ``sigma^2 M M^T`` for equal independent noise on
    all coordinates. For `paper`, d is the mean of both disparities, which correlates with row and
    column; `fused` is the least-squares solution of the rig's linear model, which
    for three cameras has variances 5/12, 5/12 and 3/4 against the paper's 1, 1 and 1.
    """
    if kind == "fused":
        return partial_map(range(cameras), cameras, ratio)
    out = np.zeros((3, 2 * cameras))
    out[0, 0] = out[1, 1] = 1.0
    # Weights inverse to the variances; one half each where both baselines are equal.
    weight = 1.0 if cameras == 2 else _horizontal_weight(ratio)
    out[2, 2], out[2, 0] = weight, -weight
    if cameras == 3:
        out[2, 5] = (1.0 - weight) * ratio
        out[2, 1] = -out[2, 5]
    return out


def rig_map(rig: CameraRig) -> FloatArray:
    """:func:`measurement_map` of what a rig measures, by ``rig.places``."""
    kind = "fused" if rig.places == "all" else "paper"
    return measurement_map(kind, rig.cameras, vertical_to_horizontal(rig))


SHIFT_SHARE = 0.9
"""Sigma of a patch's shift to another image over that of a SIFT coordinate (pixel_sigma). Rows of
both images disagree by 0.09 to 0.19 px, those of SIFT's matches by 0.16 to 0.27."""


def pixel_covariance(cameras: int, places: RigPlaces) -> FloatArray:
    """(2 * cameras, 2 * cameras) of (c, r) per camera, by the variance of a SIFT coordinate.

    Where the reference alone tells the places (:attr:`CameraRig.places`), its error is in all
    coordinates alike, and the other images add that of the shift.
    """
    own = np.eye(2 * cameras)
    if places == "all":
        return own
    own[2:] *= SHIFT_SHARE**2
    own[:2] = 0.0
    return own + np.tile(np.eye(2), (cameras, cameras))


def partial_map(seen: Sequence[int], cameras: int, ratio: float) -> FloatArray:
    """The map `fused` (3, 2 * seen) from the pixels of two cameras or more of a rig's; read only.

    Args:
        seen: which: 0 right, 1 left, 2 top.
        cameras: how many the rig has.
        ratio: :func:`vertical_to_horizontal`.
    """
    return _fused_map(tuple(seen), cameras, ratio)


@lru_cache(maxsize=64)
def _fused_map(seen: tuple[int, ...], cameras: int, ratio: float) -> FloatArray:
    """Inverted once: each frame asks for it several times."""
    model = pixel_model(cameras, ratio).reshape(cameras, 2, 3)[list(seen)]
    out = np.asarray(np.linalg.pinv(model.reshape(-1, 3)), np.float64)
    out.flags.writeable = False
    return out


def _horizontal_weight(ratio: float) -> float:
    squared = ratio**2
    return squared / (1.0 + squared)


_NEARLY_ITSELF = 1.0 + 2.0 * np.cos(np.deg2rad(45.0))
"""Trace of a turn by 45 degrees: rectification turns by less, a body's axes are further."""


def body_is_camera(bTc: FloatArray) -> bool:
    """Whether the body is the camera itself, raw or rectified: nothing says how it is mounted."""
    return bool(np.trace(bTc[:3, :3]) > _NEARLY_ITSELF)


def vertical_of(bTc: FloatArray) -> FloatArray:
    """(3,) the vertical in a sensor's frame, upwards: its body's z axis.

    Where the body is the camera itself, raw or rectified, nothing is known of its tilt: then it is
    taken as level, and its -y axis as the vertical.
    """
    return -bTc[1, :3] if body_is_camera(bTc) else bTc[2, :3]
