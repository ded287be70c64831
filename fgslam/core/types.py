"""Values that cross the border between two stages.

All are frozen dataclasses of plain NumPy arrays. Frames and units, everywhere in the package:

* ``wTc`` takes a point from camera to world coordinates; poses are 4x4 homogeneous matrices.
* The camera is the rig's *reference* camera: the right one, as in Se, Lowe and Little (2001, 2.2).
* Camera axes: x right, y down, z forward. The world is the reference camera's first frame.
* Metres, radians, seconds, pixels; the centre of the top-left pixel is (0, 0).
* Tangent vectors and 6x6 covariances are ordered [rotation, translation] and live in the
  tangent space at the estimate: ``T = T_estimate * Exp(xi)``, as in GTSAM.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
ByteArray: TypeAlias = npt.NDArray[np.uint8]
Image: TypeAlias = npt.NDArray[np.uint8]
StateArrays: TypeAlias = dict[str, npt.NDArray[Any]]


# --------------------------------------------------------------------------------------------
# Cameras and recordings


@dataclass(frozen=True, slots=True, eq=False)
class CameraRig:
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

    @property
    def cameras(self) -> int:
        """Number of cameras, 2 or 3."""
        return 2 if self.vertical_baseline is None else 3


@dataclass(frozen=True, slots=True, eq=False)
class RangeBearingSensor:
    """Measures (azimuth, elevation, range) of landmarks: radians, metres; axes as a camera's.

    ``azimuth = atan2(x, z)`` is positive to the right, ``elevation = atan2(-y, hypot(x, z))`` up.

    Attributes:
        max_range_m: farthest landmark seen.
        bTc: (4, 4) pose of the sensor in the robot's body frame.
    """

    max_range_m: float
    bTc: FloatArray


Sensor: TypeAlias = CameraRig | RangeBearingSensor
"""What measures landmarks; each by three numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The images of one instant, in the order right, left[, top]; grey, uint8, (height, width).

    ``index`` counts the recording's own frames (before ``start``/``stop``/``stride``).
    """

    index: int
    timestamp: float
    images: tuple[Image, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Motion between two consecutive frames, with its uncertainty.

    Attributes:
        motion: (4, 4) ``pTn``: the pose at the new frame, in the frame of the previous one.
        covariance: (6, 6) of the tangent vector at the new pose, [rotation, translation].
    """

    motion: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Stamped poses of the reference camera: timestamps (n,) increasing, ``wTc`` (n, 4, 4)."""

    timestamps: FloatArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.timestamps)


# --------------------------------------------------------------------------------------------
# Front-end


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """SIFT features of one image.

    Attributes:
        xy: (n, 2) sub-pixel (column, row).
        scale: (n,) standard deviation of the Gaussian at which the feature was found, in pixels.
        orientation: (n,) radians, clockwise from the image's x axis, in [0, 2 pi).
        descriptors: (n, 128) uint8.
    """

    xy: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray

    def __len__(self) -> int:
        return len(self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class StereoFeatures:
    """Features matched over the rig: the paper's [r, c, s, o, d, X, Y, Z] (Se et al. 3).

    Attributes:
        measurement: (n, 3) (column, row, disparity) in the reference image, pixels.
        measurement_covariance: (n, 3, 3) of the above, pixels squared.
        scale: (n,) mean over the images, pixels.
        orientation: (n,) circular mean over the images, radians.
        descriptors: (n, 128) uint8, of the reference image.
        position: (n, 3) in the reference camera's frame, metres.
        position_covariance: (n, 3, 3), metres squared.
        pixels: (n, 3, 2) raw (column, row) in right, left and top image; NaN without a top camera.
    """

    measurement: FloatArray
    measurement_covariance: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    position: FloatArray
    position_covariance: FloatArray
    pixels: FloatArray

    def __len__(self) -> int:
        return len(self.scale)

    def observations(self, which: IntArray, ids: IntArray, is_new: bool) -> Observations:
        """Some of the features as observations of the landmarks ``ids``."""
        return Observations(
            ids,
            self.measurement[which],
            self.measurement_covariance[which],
            self.pixels[which],
            np.full(len(which), is_new),
        )

    @staticmethod
    def empty() -> StereoFeatures:
        """No feature at all."""
        return StereoFeatures(
            measurement=np.empty((0, 3)),
            measurement_covariance=np.empty((0, 3, 3)),
            scale=np.empty(0),
            orientation=np.empty(0),
            descriptors=np.empty((0, 128), np.uint8),
            position=np.empty((0, 3)),
            position_covariance=np.empty((0, 3, 3)),
            pixels=np.empty((0, 3, 2)),
        )


class EgoMotionStatus(str, Enum):
    """How the pose of a frame was found."""

    FIRST = "first"
    OK = "ok"
    CAPPED = "capped"
    RELOCALISED = "relocalised"
    TOO_FEW_MATCHES = "too_few_matches"
    DIVERGED = "diverged"
    NO_IMAGE = "no_image"

    @property
    def measured(self) -> bool:
        """Whether the landmarks had a say in the pose (otherwise it is the odometry's)."""
        return self in (
            EgoMotionStatus.OK,
            EgoMotionStatus.CAPPED,
            EgoMotionStatus.RELOCALISED,
        )


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotion:
    """Result of the least-squares pose (Se et al. 3.3).

    Attributes:
        wTc: (4, 4) estimated pose.
        covariance: (6, 6) in the tangent space at ``wTc``.
        inliers: (k,) which of the given matches were used in the last iteration.
        residuals: (k,) image residual E of every match at ``wTc``, pixels (range sensor: radians).
        status: how it ended.
        iterations: Newton steps taken.
        weighted_at: (4, 4) pose at which the last minimisation's weights were evaluated; None
            where nothing was minimised.
    """

    wTc: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    residuals: FloatArray
    status: EgoMotionStatus
    iterations: int
    weighted_at: FloatArray | None = None

    @property
    def coherent(self) -> bool:
        """Whether most of what was matched was used; a pose that was not measured uses nothing."""
        return not self.status.measured or 2 * int(self.inliers.sum()) >= len(self.inliers)

    @property
    def correlation(self) -> FloatArray:
        """(6, 6) correlations of the pose, [rotation, translation]; 0 where motion is excluded.

        The known one is that of sideways motion and yaw (Se et al. 5).
        """
        return correlation(self.covariance)


def correlation(covariance: FloatArray) -> FloatArray:
    """Correlations (..., n, n) of covariances (..., n, n); 0 for what has no variance."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


# --------------------------------------------------------------------------------------------
# Measurements, as every estimator consumes them and as the log keeps them


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Landmark observations of one frame, with their identity.

    Attributes:
        ids: (k,) landmark identities, unique within the frame.
        measurement: (k, 3) (column, row, disparity), pixels; of a range-bearing sensor
            (azimuth, elevation, range), radians and metres.
        covariance: (k, 3, 3) of the measurement.
        pixels: (k, 3, 2) raw pixels in right, left, top; NaN where there is no such camera.
        is_new: (k,) True where this observation initiates the landmark (Type IV).
    """

    ids: IntArray
    measurement: FloatArray
    covariance: FloatArray
    pixels: FloatArray
    is_new: BoolArray

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: BoolArray | IntArray) -> Observations:
        """The chosen rows, as a new value."""
        return Observations(
            self.ids[keep],
            self.measurement[keep],
            self.covariance[keep],
            self.pixels[keep],
            self.is_new[keep],
        )

    def join(self, other: Observations) -> Observations:
        """Both, one after the other."""
        return Observations(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.measurement, other.measurement]),
            np.concatenate([self.covariance, other.covariance]),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.is_new, other.is_new]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A place seen again: the frame sees landmarks of an earlier frame, under new identities.

    Attributes:
        frame: position in the log of the earlier frame (0 is the log's first). Of a part of a saved
            map that the run has yet to see: that in which it entered the map, held still between.
        oTc: (4, 4) pose of the present camera in the earlier frame's camera.
        covariance: (6, 6) of ``oTc``, [rotation, translation], in the tangent space at it.
        observations: the earlier landmarks as the present frame measures them, under their old
            identities.
        merged: (m, 2) pairs (identity that ends, identity that stays) of landmarks that are one if
            this is the same place; the frame observes the first. Where the live estimator took the
            closure, it is pruned in the next frame (older logs: in this one).
    """

    frame: int
    oTc: FloatArray
    covariance: FloatArray
    observations: Observations
    merged: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Increment:
    """Everything that one frame adds to the problem: what the log stores, what estimators consume.

    Attributes:
        index: the recording's frame number.
        timestamp: seconds.
        odometry: camera motion since the previous increment; None for the first one.
        observations: matched (Type III) and new (Type IV) landmarks.
        rejected: (k,) matched observations that the live run's pose rejected as outliers.
        missed_ids: landmarks expected in view and not matched (Type II).
        pruned_ids: landmarks that the database dropped after this frame; those merged into others
            because of the last frame's loop closure among them.
        loops: places recognised in this frame, verified; each estimator judges them for itself.
        relocalised: placed by its landmarks alone, without a prior; its odometry tells nothing.
    """

    index: int
    timestamp: float
    odometry: Odometry | None
    observations: Observations
    rejected: BoolArray
    missed_ids: IntArray
    pruned_ids: IntArray
    loops: tuple[LoopClosure, ...] = ()
    relocalised: bool = False


class MeasurementType(str, Enum):
    """Kinds of measurement that an estimator may support; checked before a run starts."""

    ODOMETRY = "odometry"
    STEREO = "stereo"
    RANGE_BEARING = "range_bearing"
    LOOP = "loop"


# --------------------------------------------------------------------------------------------
# Estimates


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Pose expected before the frame's observations: ``wTc`` (4, 4) and its covariance (6, 6)."""

    wTc: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """Landmark positions of an estimator, ids ascending.

    Attributes:
        ids: (n,) ascending.
        positions: (n, 3) world, metres.
        covariances: (n, 3, 3), metres squared.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: BoolArray | IntArray) -> LandmarkMap:
        """The chosen rows, ascending, as a new value."""
        return LandmarkMap(self.ids[keep], self.positions[keep], self.covariances[keep])

    def without(self, ids: IntArray) -> LandmarkMap:
        """The map but for these landmarks, as a new value."""
        return self.select(~np.isin(self.ids, ids))

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        rows = np.searchsorted(self.ids, ids)
        if len(ids) and (rows.max() >= len(self.ids) or not np.array_equal(self.ids[rows], ids)):
            raise KeyError(f"landmarks not in the map: {np.setdiff1d(ids, self.ids)[:5].tolist()}")
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class UpdateStats:
    """What an update did: pose afterwards and the numbers that tests of consistency need.

    Attributes:
        wTc: (4, 4) pose of the frame just processed.
        covariance: (6, 6) its marginal.
        landmarks: number of landmarks in the estimator.
        nis: normalised innovation squared of the matched observations, or NaN.
        nis_dof: degrees of freedom of ``nis``.
        closed: for each of the increment's loops whether the estimator took it (or met it already).
    """

    wTc: FloatArray
    covariance: FloatArray
    landmarks: int
    nis: float
    nis_dof: int
    closed: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """An estimator's whole answer.

    Attributes:
        trajectory: all poses as known now.
        covariances: (n, 6, 6) their marginals; NaN where one cannot be had.
        landmarks: the map, with marginal covariances.
        remarks: what the estimator had to mend or leave out, in words.
    """

    trajectory: Trajectory
    covariances: FloatArray
    landmarks: LandmarkMap
    remarks: tuple[str, ...] = ()
