"""The rectified camera rig and the linear model of its pixels.

Derived in docs/derivations/measurements.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import lru_cache
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray, Rows
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import (
    body_to_camera_motion,
    change_tangent_frame,
    compose_covariance,
    congruence,
    in_front,
    inverse,
)
from fgslam.core.settings import RigPlaces

# ------------------------------------------------------------------------------------------
# Measurements, as every estimator consumes them and as the log keeps them

FREE_TRANSLATION_M = 30.0
"""Standard deviation per axis of a step's translation of which nothing is known."""


class MeasurementType(str, Enum):
    """Kinds of measurement that an estimator may support; checked before a run starts."""

    ODOMETRY = "odometry"
    STEREO = "stereo"
    LOOP = "loop"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BiasEffect(Brief):
    """What the bias of a gyroscope does to a step that it measured.

    Attributes:
        jacobian: (3, 3) of the step's rotation vector, at its end, by the bias: rad by rad/s.
        start_variance: of the bias per axis before the drive, (rad/s)^2.
        walk: by how much that variance grows in the step, (rad/s)^2.
        applied: (3,) bias that the step's motion is corrected for, rad/s; zero as measured.
        left: (3, 3) covariance of what is unknown of it, which the step's covariance contains;
            zero as measured.
    """

    jacobian: FloatArray
    start_variance: float
    walk: float
    applied: FloatArray = field(default_factory=lambda: np.zeros(3))
    left: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Odometry(Brief):
    """Motion between two consecutive frames, with its uncertainty.

    Attributes:
        motion: (4, 4) ``pTn``: the pose at the new frame, in the frame of the previous one.
        covariance: (6, 6) of the tangent vector at the new pose, [rotation, translation].
        measured: by wheels or another sensor; else a motion model's stand-in, such as constant
            velocity, which belongs in no log.
        turned: its rotation alone was measured, by a gyroscope; the translation is a stand-in's, or
            free (:meth:`turn`), and ``measured`` is false.
        bias: of that gyroscope; None where nothing is known of it.
    """

    motion: FloatArray
    covariance: FloatArray
    measured: bool = True
    turned: bool = False
    bias: BiasEffect | None = None

    @staticmethod
    def turn(
        rotation: FloatArray, covariance: FloatArray, bias: BiasEffect | None = None
    ) -> Odometry:
        """A rotation (3, 3) and its covariance (3, 3); nothing is known of the translation."""
        motion, full = np.eye(4), np.diag(np.repeat([0.0, FREE_TRANSLATION_M**2], 3))
        motion[:3, :3], full[:3, :3] = rotation, covariance
        return Odometry(motion, full, measured=False, turned=True, bias=bias)


def compose_odometry(steps: Iterable[Odometry]) -> Odometry:
    """Consecutive independent steps as one; measured, or else turned, if all of them are so."""
    motion, covariance, measured, turned = np.eye(4), np.zeros((6, 6)), True, True
    for step in steps:
        covariance = compose_covariance(step.motion, covariance, step.covariance)
        motion = motion @ step.motion
        measured, turned = measured and step.measured, turned and (step.measured or step.turned)
    return Odometry(motion, covariance, measured, turned and not measured)


def odometry_of_camera(body: Odometry, bTc: FloatArray) -> Odometry:
    """Odometry of the robot's body as that of its camera, by the lever arm (Se et al. 5)."""
    motion = body_to_camera_motion(body.motion, bTc)
    return Odometry(motion, change_tangent_frame(inverse(bTc), body.covariance))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Observations(Rows):
    """Landmark observations of one frame, with their identity.

    Attributes:
        ids: (k,) landmark identities, unique within the frame.
        measurement: (k, 3) (column, row, disparity), pixels.
        covariance: (k, 3, 3) of the measurement.
        pixels: (k, 3, 2) raw pixels in right, left, top; NaN where there is no such camera, or
            its image did not show the landmark.
        is_new: (k,) True where this observation initiates the landmark (Type IV).
    """

    ids: IntArray
    measurement: FloatArray
    covariance: FloatArray
    pixels: FloatArray
    is_new: BoolArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Measured(Rows):
    """What a frame's other sensors measured, by one model (``model.measured(...)`` makes it).

    Attributes:
        kind: the model's.
        values: (k, m).
        covariance: (k, m, m) of them.
        ids: (k,) landmark identities, unique, numbered together with the camera's; none of a pose.
        model: that predicts them (:class:`fgslam.LandmarkModel`, :class:`fgslam.PoseModel`); files
            hold none.
    """

    SHARED = frozenset({"kind", "model"})
    FIRST_ID = 10**9
    """Of landmarks of other sensors in a session with cameras, which count theirs from 0."""

    kind: str
    values: FloatArray
    covariance: FloatArray
    ids: IntArray
    model: Any = field(default=None, metadata={"stored": False})

    @property
    def of_pose(self) -> bool:
        """Whether the robot's pose alone was measured."""
        return len(self.ids) < len(self.values)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopClosure(Brief):
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
            closure, it is pruned in the next frame.
    """

    frame: int
    oTc: FloatArray
    covariance: FloatArray
    observations: Observations
    merged: IntArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SettledRig(Brief):
    """Since when a rig that calibrates itself is as it is now, and what its correction leaves.

    Attributes:
        knocks: how often the rig was found to have moved before.
        since: first frame, from 0, of the rig as it is now.
        field_px: what no term of the correction follows, taken off nothing: standard deviation of
            one coordinate in each image (:mod:`fgslam.core.correction`).
    """

    knocks: int
    since: int = 0
    field_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Increment(Brief):
    """Everything that one frame adds to the problem: what the log stores, what estimators consume.

    Attributes:
        index: the recording's frame number.
        timestamp: seconds.
        odometry: camera motion since the previous increment, measured or a motion model's; None
            for the first one, and in a log where none was measured.
        observations: matched (Type III) and new (Type IV) landmarks.
        rejected: (k,) matched observations that the live run's pose rejected as outliers.
        missed_ids: landmarks expected in view and not matched (Type II).
        pruned_ids: landmarks that the database dropped after this frame; those merged into others
            because of the last frame's loop closure among them.
        loops: places recognised in this frame, verified; each estimator judges them for itself.
        relocalised: placed by its landmarks alone, without a prior; its odometry is meaningless.
        rig_correction: (p,) of the rig against its calibration
            (:func:`fgslam.core.correction.term_names`), taken off the measurements already, not
            off the raw pixels; None where the calibration was taken as it is.
        settled_rig: since when the rig is so, and what the correction leaves, as known then; None
            where the calibration was taken as it is.
        measured: by other sensors, one item a kind.
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
    rig_correction: FloatArray | None = None
    settled_rig: SettledRig | None = None
    measured: tuple[Measured, ...] = field(default=(), metadata={"sparse": True})

    @staticmethod
    def of(
        index: int, timestamp: float, odometry: Odometry | None, measured: Iterable[Measured] = ()
    ) -> Increment:
        """A frame of a robot without cameras, or of which they saw nothing."""
        none = np.empty(0, np.int64)
        numbers = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3, 2))
        seen = Observations(none, *numbers, none.astype(np.bool_))
        return Increment(
            index, timestamp, odometry, seen, seen.is_new, none, none, measured=tuple(measured)
        )

    @property
    def rig_since(self) -> int:
        """First frame, from 0, of the rig as it is in this one."""
        return 0 if self.settled_rig is None else self.settled_rig.since

    @property
    def kept(self) -> Observations:
        """The observations but for the rejected ones."""
        return self.observations.select(~self.rejected)


def moved_pixels(earlier: Increment | None, now: Increment) -> tuple[FloatArray, FloatArray]:
    """(column, row) (k, 2), before and now, of the landmarks that both frames saw and kept."""
    if earlier is None:
        return np.empty((0, 2)), np.empty((0, 2))
    before, after = earlier.kept, now.kept
    _, a, b = np.intersect1d(before.ids, after.ids, return_indices=True)
    return before.measurement[a, :2], after.measurement[b, :2]


PoseFrame: TypeAlias = Literal["left", "right", "body"]
"""What a pose is of: a rectified camera (x right, y down, z forward), or the robot's body."""


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
            what one leaves (:data:`fgslam.core.correction.SHARED`).
        places: ``all`` images tell the measured column and row, by least squares; or the
            ``reference`` alone, where the others are measured by shifts from it.
        stated: the calibration is taken as it is, and no drive corrects it: covariances contain
            what it leaves between the cameras, too (:data:`fgslam.core.correction.TERMS`).
        readout_s: deviation of the time from an image's first row to its last, about 0; 0 where all
            rows are of one moment (a global shutter).
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
    stated: bool = field(default=False, repr=False)
    readout_s: float = field(default=0.0, repr=False, metadata={"sparse": True})
    angles = ()  # none of the three is one
    nuisance = ()  # its terms are considered, or found by self-calibration

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsics: pixels of what is seen along a ray of depth one."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Horizontal and vertical angle of view around the middle of the image, degrees."""
        half = 0.5 * np.array([self.width / self.fx, self.height / self.fy])
        across, down = np.degrees(2.0 * np.arctan(half)).tolist()
        return across, down

    def plain(self) -> CameraRig:
        """The rectified rig alone, without what a subclass adds: as files hold it."""
        return CameraRig(**{name: getattr(self, name) for name in CameraRig.__dataclass_fields__})

    @property
    def cameras(self) -> int:
        """Number of cameras, 2 or 3."""
        return 2 if self.vertical_baseline is None else 3

    @property
    def numbers(self) -> dict[str, Any]:
        """Size, intrinsics and baselines, by name."""
        return {one.name: getattr(self, one.name) for one in fields(CameraRig)[:8]}

    @property
    def camera_poses(self) -> FloatArray:
        """(cameras, 4, 4) poses of right, left[, top] camera in the reference camera's frame."""
        out = np.tile(np.eye(4), (self.cameras, 1, 1))
        out[1, 0, 3] = -self.baseline
        if self.vertical_baseline is not None:
            out[2, 1, 3] = -self.vertical_baseline
        return out

    def fTc(self, frame: PoseFrame) -> FloatArray:
        """(4, 4) pose of the reference camera in another frame. ConfigError: no such frame."""
        if frame == "body":
            return self.bTc
        if frame not in get_args(PoseFrame):
            raise ConfigError(f"no frame {frame!r}; use one of {', '.join(get_args(PoseFrame))}")
        fTc = np.eye(4)
        fTc[0, 3] = self.baseline if frame == "left" else 0.0
        return fTc

    # -- what it measures of points in the reference camera's frame: a model of landmarks ------

    @property
    def unpredicted(self) -> FloatArray:
        """(3,) residual of what is not before it, as of GTSAM's factor: two focal lengths off."""
        return np.array([2.0 * self.fx, 2.0 * self.fx, 0.0])

    def predict(self, points: FloatArray) -> FloatArray:
        """(column, row, disparity) (n, 3) of points (n, 3); NaN of those not before the camera."""
        inverse_depth = 1.0 / np.where(in_front(points), points[:, 2], np.nan)
        out = np.empty_like(points)
        out[:, 0] = self.cx + self.fx * points[:, 0] * inverse_depth
        out[:, 1] = self.cy + self.fy * points[:, 1] * inverse_depth
        out[:, 2] = self.fx * self.baseline * inverse_depth
        return out

    def jacobian(self, points: FloatArray) -> FloatArray:
        """(n, 3, 3) derivatives of :meth:`predict` by the points."""
        inverse_depth = 1.0 / points[:, 2]
        inverse_depth2 = inverse_depth * inverse_depth
        out = np.zeros((len(points), 3, 3))
        out[:, 0, 0] = self.fx * inverse_depth
        out[:, 0, 2] = -self.fx * points[:, 0] * inverse_depth2
        out[:, 1, 1] = self.fy * inverse_depth
        out[:, 1, 2] = -self.fy * points[:, 1] * inverse_depth2
        out[:, 2, 2] = -self.fx * self.baseline * inverse_depth2
        return out

    def triangulate(self, measurement: FloatArray) -> FloatArray:
        """Points (n, 3) in the camera's frame from measurements (n, 3); undoes :meth:`predict`.

        The disparity must be positive (Se et al. 2.2).
        """
        depth = self.fx * self.baseline / measurement[:, 2]
        out = np.empty(measurement.shape)
        out[:, 0] = (measurement[:, 0] - self.cx) * depth / self.fx
        out[:, 1] = (measurement[:, 1] - self.cy) * depth / self.fy
        out[:, 2] = depth
        return out

    def triangulation_covariance(
        self, measurement: FloatArray, covariance: FloatArray
    ) -> FloatArray:
        """Full covariance (n, 3, 3) of triangulated points by first-order propagation.

        Keeps the off-diagonals, so that the ellipsoids lie along the rays.

        Args:
            measurement: (n, 3) column, row, disparity, pixels.
            covariance: (n, 3, 3) of the measurement, pixels squared.
        """
        d, fx, fy, baseline = measurement[:, 2], self.fx, self.fy, self.baseline
        jacobian = np.zeros((len(d), 3, 3))
        jacobian[:, 0, 0] = baseline / d
        jacobian[:, 0, 2] = -(measurement[:, 0] - self.cx) * baseline / d**2
        jacobian[:, 1, 1] = fx * baseline / (fy * d)
        jacobian[:, 1, 2] = -(measurement[:, 1] - self.cy) * fx * baseline / (fy * d**2)
        jacobian[:, 2, 2] = -fx * baseline / d**2
        return congruence(jacobian, covariance)


NO_CAMERA = CameraRig(640, 480, 500.0, 500.0, 319.5, 239.5, 0.1, None, np.eye(4), exact=True)
"""Stands for the rig of a robot without: its poses are those of the body."""

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


UNKNOWN_DISPARITY_PX = 1e4
"""Deviation of a disparity that was not measured: wider than any image, next to no information."""


def measures_one_image(covariance: FloatArray) -> BoolArray:
    """Which measurements (k,) are of one image, by covariances (k, 3, 3): the disparity unknown."""
    return np.asarray(covariance[:, 2, 2] >= UNKNOWN_DISPARITY_PX**2)


def measurement_map(kind: str, cameras: int, ratio: float) -> FloatArray:
    """Linear map (3, 2 * cameras) from pixels (c, r) per camera to (column, row, disparity).

    The covariance of the measurement follows as ``sigma^2 M M^T`` for equal independent noise on
    all coordinates. For `paper`, d is the mean of both disparities, which correlates with row and
    column; `fused` is the least-squares solution of the rig's linear model, which
    for three cameras has variances 5/12, 5/12 and 3/4 against the paper's 1, 1 and 1.
    """
    if kind == "fused":
        return partial_map(tuple(range(cameras)), cameras, ratio)
    out = np.zeros((3, 2 * cameras))
    out[0, 0] = out[1, 1] = 1.0
    # Weights inverse to the variances; one half each where both baselines are equal.
    weight = 1.0 if cameras == 2 else ratio**2 / (1.0 + ratio**2)
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

    Where the reference alone gives the places (:attr:`CameraRig.places`), its error is in all
    coordinates alike, and the other images add that of the shift.
    """
    own = np.eye(2 * cameras)
    if places == "all":
        return own
    own[2:] *= SHIFT_SHARE**2
    own[:2] = 0.0
    return own + np.tile(np.eye(2), (cameras, cameras))


@lru_cache(maxsize=64)  # inverted once: each frame asks for it several times
def partial_map(seen: tuple[int, ...], cameras: int, ratio: float) -> FloatArray:
    """The map `fused` (3, 2 * seen) from the pixels of two cameras or more of a rig's; read only.

    Args:
        seen: which: 0 right, 1 left, 2 top.
        cameras: how many the rig has.
        ratio: :func:`vertical_to_horizontal`.
    """
    model = pixel_model(cameras, ratio).reshape(cameras, 2, 3)[list(seen)]
    out = np.asarray(np.linalg.pinv(model.reshape(-1, 3)), np.float64)
    out.flags.writeable = False
    return out


_NEARLY_ITSELF = 1.0 + 2.0 * np.cos(np.deg2rad(45.0))
"""Trace of a turn by 45 degrees: rectification turns by less, a body's axes are further."""


def body_is_camera(bTc: FloatArray) -> bool:
    """Whether the body is the camera itself, raw or rectified: how it is mounted is unknown."""
    return bool(np.trace(bTc[:3, :3]) > _NEARLY_ITSELF)


def vertical_of(bTc: FloatArray) -> FloatArray:
    """(3,) the vertical in a sensor's frame, upwards: its body's z axis.

    Where the body is the camera itself, raw or rectified, nothing is known of its tilt: then it is
    taken as level, and its -y axis as the vertical.
    """
    return -bTc[1, :3] if body_is_camera(bTc) else bTc[2, :3]
