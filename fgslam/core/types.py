"""Estimates: poses, trajectories, maps, and how each was found."""

from __future__ import annotations

import io
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, Brief, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import as_path, read_text, write_text
from fgslam.core.geometry import (
    change_tangent_frame,
    congruence,
    inverse,
    pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    so3_exp,
)
from fgslam.core.sensors import CameraRig, Observations, PoseFrame, vertical_of
from fgslam.core.store import from_upper

# ------------------------------------------------------------------------------------------
# Features of images, features matched over the rig, and appearances of landmarks


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Features(Rows):
    """Features of one image.

    Attributes:
        xy: (n, 2) sub-pixel (column, row).
        scale: (n,) standard deviation of the Gaussian at which the feature was found, in pixels.
        orientation: (n,) radians, clockwise from the image's x axis, in [0, 2 pi).
        descriptors: (n, 128) uint8; as an own extractor gives them, (n, d) of any kind.
    """

    xy: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StereoFeatures(Rows):
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
        complete: (n,) found in every image of the rig, complete ones first; None if all are. The
            others may be a landmark known already; they start none.
    """

    measurement: FloatArray
    measurement_covariance: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    position: FloatArray
    position_covariance: FloatArray
    pixels: FloatArray
    complete: BoolArray | None = None

    @property
    def whole(self) -> StereoFeatures:
        """Those found in every image, under the same numbers."""
        if self.complete is None:
            return self
        found = self.select(np.flatnonzero(self.complete))
        return replace(found, complete=None)

    def noisier(self, factors: FloatArray) -> StereoFeatures:
        """The same with variances that are larger by factors (n,)."""
        by = factors[:, None, None]
        return replace(
            self,
            measurement_covariance=by * self.measurement_covariance,
            position_covariance=by * self.position_covariance,
        )

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


Words = npt.NDArray[np.int16]
"""(v,) the cell of the vocabulary (``frontend/features/vocabulary.npz``) of each descriptor."""


PATCH_PX = 15
"""Side of a landmark's patch."""
WHOLE_PX = 6
"""Reach of a patch from its middle, pixels: what lies beyond has a fifteenth of its weight."""
CUT_PIXELS = (PATCH_PX + 2) ** 2
"""Grey values of a patch with the rim that its slopes need."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkPatches(Rows):
    """Landmarks' own patches: what the reference image showed around each when it was first seen.

    Attributes:
        grey: (n, :data:`CUT_PIXELS`) grey values; (n, 0) where none are kept.
        distances: (n,) by which sizes shrink, metres, when it was seen so; 0 without a patch.
    """

    grey: ByteArray
    distances: FloatArray

    @staticmethod
    def none(count: int, pixels: int = CUT_PIXELS) -> LandmarkPatches:
        """Of landmarks without a patch."""
        return LandmarkPatches(np.zeros((count, pixels), np.uint8), np.zeros(count))

    @property
    def kept(self) -> bool:
        """Whether there is room for any."""
        return int(self.grey.shape[1]) > 0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkAppearances(Rows):
    """Appearances of landmarks, one row a stored view; there may be several (Se et al. 6.3).

    Attributes:
        ids: (v,) identity of the landmark that each view belongs to, ascending.
        descriptors: (v, 128) uint8.
        size: (v,) physical size, scale times depth: pixels times metres.
        orientation: (v,) radians, as in the image.
        direction: (v, 3) unit vector from the camera to the landmark, world; NaN where unknown.
        words: (v,) of the descriptors, where they are at hand; None where they must be found. No
            part of what is known: they follow from the descriptors.
    """

    ids: IntArray
    descriptors: ByteArray
    size: FloatArray
    orientation: FloatArray
    direction: FloatArray
    words: Words | None = None

    def of(self, ids: IntArray) -> LandmarkAppearances:
        """Only the views of the named landmarks (any order; unknown ones give none)."""
        return self.select(np.isin(self.ids, ids))


# ------------------------------------------------------------------------------------------
# The floor that a wheeled robot keeps to: which camera motions it allows (Se et al. 5)

DegreesOfFreedom: TypeAlias = Literal[3, 5, 6]


@dataclass(frozen=True, eq=False)
class Floor:
    """A horizontal floor under the camera.

    Attributes:
        dof: 6 no floor; 5 the camera's height is fixed (the paper's); 3 pitch and roll, too.
        down: (3,) unit vector of the world's vertical.
        hard: whether the floor is exact; soft, each frame may leave it by the deviations below.
        height_sigma_m: soft: standard deviation of the camera's height, metres.
        tilt_sigma_rad: soft: standard deviation of pitch and of roll, radians.
    """

    dof: DegreesOfFreedom
    down: FloatArray
    hard: bool = True
    height_sigma_m: float = 0.0
    tilt_sigma_rad: float = 0.0

    @staticmethod
    def under(rig: CameraRig, dof: DegreesOfFreedom) -> Floor:
        """The exact floor that is level with the robot's body in the first camera frame.

        Where nothing is known of how the camera is mounted, it is taken as level.
        """
        return Floor(dof, -vertical_of(rig.bTc))

    @property
    def rigid_dof(self) -> DegreesOfFreedom:
        """Degrees of freedom that remain exactly: 6 where the floor is soft."""
        return self.dof if self.hard else 6

    @cached_property
    def horizontal(self) -> FloatArray:
        """(3, 2) orthonormal horizontal directions of the world."""
        return np.asarray(np.linalg.svd(self.down[None, :])[2][1:].T)

    def constrain(self, wTc: FloatArray) -> FloatArray:
        """The nearest pose that the floor allows, as if it were hard."""
        if self.dof == 6:
            return wTc
        translation = wTc[:3, 3] - self.down * (self.down @ wTc[:3, 3])
        rotation = wTc[:3, :3]
        if self.dof == 3:  # the turn about the vertical that is nearest
            n = self.down
            twice = rotation - rotation.T
            sine = n @ np.array([twice[2, 1], twice[0, 2], twice[1, 0]])
            cosine = np.trace(rotation) - n @ rotation @ n
            rotation = so3_exp(n * np.arctan2(sine, cosine))
        return pose(rotation, translation)

    def basis(self, wTc: FloatArray) -> FloatArray:
        """Columns (6, dof) span the tangent directions at ``wTc`` that the floor allows."""
        if self.dof == 6:
            return np.eye(6)
        cRw = wTc[:3, :3].T
        rotations = np.eye(3) if self.dof == 5 else (cRw @ self.down)[:, None]
        out = np.zeros((6, rotations.shape[1] + 2))
        out[:3, : rotations.shape[1]] = rotations
        out[3:, rotations.shape[1] :] = cRw @ self.horizontal
        return out

    def allowed_part(self, wTc: FloatArray, covariance: FloatArray) -> FloatArray:
        """A covariance (6, 6) without the directions that a hard floor excludes."""
        if self.rigid_dof == 6:
            return covariance
        basis = self.basis(wTc)
        return congruence(basis @ basis.T, covariance)


# ------------------------------------------------------------------------------------------
# Trajectories, and their files: TUM and KITTI files, and the covariances of their poses as CSV

_EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
)
_UPPER = np.triu_indices(6)
_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
_COVARIANCE_NAMES = [f"c_{_TANGENT[i]}_{_TANGENT[j]}" for i, j in zip(*_UPPER, strict=True)]
_COVARIANCE_HEADER = f"timestamp,{','.join(_COVARIANCE_NAMES)}\n"
_NAMED: dict[PoseFrame, tuple[str, str]] = {
    "right": ("wTc", "right camera"),
    "left": ("wTl", "left camera"),
    "body": ("wTb", "body"),
}
"""Of each frame the symbol of its poses, and what they are of: as files name them."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory(Brief):
    """Stamped poses of the reference camera, the right one, or of another frame of its rig.

    Attributes:
        timestamps: (n,) seconds, increasing.
        poses: (n, 4, 4) ``wTc``, metres.
        frame: what they are of; the world stays that of the reference camera.
    """

    timestamps: FloatArray
    poses: FloatArray
    frame: PoseFrame = field(default="right", metadata={"stored": False})

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def named(self) -> str:
        """What the poses are of, in words: as files state it."""
        symbol, what = _NAMED[self.frame]
        return f"{symbol}: pose of the {what}"

    def of(self, frame: PoseFrame, rig: CameraRig) -> Trajectory:
        """The same drive as poses of another frame, in the same world; of its own as it is.

        Args:
            frame: `left` or `right`, the rectified cameras, or `body`, the robot's.
            rig: where they sit.

        Raises:
            ConfigError: no such frame.
        """
        fTc = rig.fTc(frame)
        if frame == self.frame:
            return self
        wTc = self.poses @ rig.fTc(self.frame)
        return Trajectory(self.timestamps, wTc @ inverse(fTc), frame)

    def save(self, path: str | Path, remark: str = "") -> None:
        """Writes the poses in the format that the suffix names: `.tum`, `.kitti` or `.csv` (EuRoC).

        Args:
            path: the file, written whole or not at all. A comment line states what the poses are
                of; `.kitti` knows neither times nor comments.
            remark: put into a comment line.

        Raises:
            OutputError: the suffix is another one, a pose is not finite, or writing failed.
        """
        path = Path(path)
        bad = ~np.isfinite(self.poses).all(axis=(1, 2)) | ~np.isfinite(self.timestamps)
        if bad.any():
            row = int(np.argmax(bad))
            raise OutputError(
                f"cannot write {path}: pose {row} (t = {self.timestamps[row]:.9f} s) is not "
                "finite; the estimator diverged there, check its input before that time"
            )
        text = f"# {remark}\n" if remark else ""
        text += f"# {self.named}\n"
        match path.suffix.lower():
            case ".tum":
                rows = np.column_stack([self.timestamps, pose_rows(self.poses, decimals=12)])
                text += _rows_text(rows, "%.9f" + 7 * " %.12f")
            case ".kitti":
                text = _rows_text(self.poses[:, :3].reshape(-1, 12) + 0.0, " ".join(12 * ["%.12e"]))
            case ".csv":
                rows = pose_rows(self.poses, decimals=12)[:, [0, 1, 2, 6, 3, 4, 5]]
                lines = _rows_text(rows, ",".join(7 * ["%.12f"])).splitlines()
                stamps = np.rint(self.timestamps * 1e9).astype(np.int64).tolist()
                pairs = zip(stamps, lines, strict=True)
                text += _EUROC_HEADER + "".join(f"{stamp},{line}\n" for stamp, line in pairs)
            case suffix:
                raise OutputError(
                    f"cannot write {path}: unknown trajectory format '{suffix}'; use .tum, .kitti "
                    "or .csv"
                )
        write_text(path, text)

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """Reads a TUM file: `timestamp tx ty tz qx qy qz qw` a line, seconds and metres.

        Poses are of what a comment line states, as :meth:`save` writes it; else the right camera.

        Raises:
            DatasetError: the file is missing, a line is malformed, a quaternion is zero, or the
                time stamps do not increase. The message names the line.
        """
        path = as_path(path, DatasetError)
        expected = "timestamp tx ty tz qx qy qz qw on each line"
        text = read_text(path, remedy=f"check the path; it has {expected}")
        values, lines = parse_rows(path, text, 8, expected)
        backwards = np.concatenate([[False], values[1:, 0] <= values[:-1, 0]])
        for bad, what in (
            (~np.isfinite(values).all(axis=1), "a number is not finite; repair or remove the line"),
            (
                np.linalg.norm(values[:, 4:], axis=1) < 0.5,
                "the quaternion has no length; repair or remove the line",
            ),
            (backwards, "the time stamp does not increase; sort or repair the file"),
        ):
            if bad.any():
                raise DatasetError(f"{path}, line {lines[int(np.argmax(bad))]}: {what}")
        poses = np.empty((len(values), 4, 4))
        for out, row in zip(poses, values, strict=True):
            out[:] = pose(rotation_from_quaternion(row[4:]), row[1:4])
        stated = (f for f, names in _NAMED.items() if "# {}: pose of the {}".format(*names) in text)
        return Trajectory(values[:, 0].copy(), poses, next(stated, "right"))


def pose_rows(poses: FloatArray, decimals: int | None = None) -> FloatArray:
    """(n, 7) x y z qx qy qz qw of poses (n, 4, 4), w not negative.

    ``decimals``: rounded as they are printed, without negative zeros.
    """
    rows = np.empty((len(poses), 7))
    rows[:, :3] = poses[:, :3, 3]
    for row, aTb in zip(rows, poses, strict=True):
        quaternion = quaternion_from_rotation(aTb[:3, :3])
        row[3:] = -quaternion if quaternion[3] < 0.0 else quaternion
    return rows if decimals is None else np.asarray(np.round(rows, decimals) + 0.0)


# --------------------------------------------------------------------------------------------
# Covariances


def write_covariances(
    path: Path, trajectory: Trajectory, covariances: FloatArray, remark: str = ""
) -> None:
    """Write the upper triangles of pose covariances, row by row, with a header naming the frame.

    Args:
        path: the file to write, atomically.
        trajectory: the n poses.
        covariances: (n, 6, 6), [rotation, translation], in the tangent space at the estimate.
        remark: put into a further comment line.
    """
    upper = covariances[:, _UPPER[0], _UPPER[1]]
    rows = _rows_text(np.column_stack([trajectory.timestamps, upper + 0.0]), "%.9f" + 21 * ",%.9e")
    symbol, what = _NAMED[trajectory.frame]
    axes = "" if trajectory.frame == "body" else " (x right, y down, z forward)"
    lines = [remark] if remark else []
    lines.append(
        f"covariance of xi in {symbol} = {symbol}_estimate * Exp(xi), tangent [rotation, "
        f"translation] in the frame of the {what} at the estimate{axes}; rad, m"
    )
    write_text(path, "".join(f"# {line}\n" for line in lines) + _COVARIANCE_HEADER + rows)


def read_covariances(path: Path) -> tuple[FloatArray, FloatArray]:
    """Time stamps (n,) and covariances (n, 6, 6) of a covariance.csv; NaN where unknown.

    Raises:
        DatasetError: the file is missing, or a line is malformed; the message names the line.
    """
    text = read_text(path, remedy="give a covariance.csv").replace(_COVARIANCE_HEADER, "", 1)
    columns = 1 + len(_COVARIANCE_NAMES)
    expected = "timestamp and 21 covariances, separated by commas"
    values, _ = parse_rows(path, text.replace(",", " "), columns, expected)
    return values[:, 0].copy(), from_upper(values[:, 1:], 6)


# --------------------------------------------------------------------------------------------
# Rows of numbers


def _rows_text(rows: FloatArray, row_format: str) -> str:
    buffer = io.StringIO()
    np.savetxt(buffer, rows, fmt=row_format)
    return buffer.getvalue()


def parse_rows(path: Path, text: str, columns: int, expected: str) -> tuple[FloatArray, IntArray]:
    """Numbers (n, columns) and the line number (n,) of each row; `#` starts a comment."""
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.partition("#")[0].split()
        if not cells:
            continue
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError as error:
            raise DatasetError(f"{path}, line {number}: {error}; give {expected}") from error
        if len(cells) != columns:
            raise DatasetError(
                f"{path}, line {number}: {len(cells)} numbers instead of {columns}; give {expected}"
            )
        lines.append(number)
    values = np.array(rows, dtype=np.float64).reshape(-1, columns)
    return values, np.array(lines, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkMap(Rows):
    """Landmark positions of an estimator, ids ascending.

    Attributes:
        ids: (n,) ascending.
        positions: (n, 3) world, metres.
        covariances: (n, 3, 3), metres squared.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray

    def below(self, identity: int) -> LandmarkMap:
        """The landmarks of smaller identities; a view."""
        n = np.searchsorted(self.ids, identity)
        return LandmarkMap(self.ids[:n], self.positions[:n], self.covariances[:n])

    def without(self, ids: IntArray) -> LandmarkMap:
        """The map but for these landmarks, as a new value."""
        return self.select(~np.isin(self.ids, ids))

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        rows = np.searchsorted(self.ids, ids)
        if len(ids) and (rows.max() >= len(self.ids) or not np.array_equal(self.ids[rows], ids)):
            raise KeyError(f"landmarks not in the map: {np.setdiff1d(ids, self.ids)[:5].tolist()}")
        return rows


NO_LANDMARKS = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
"""A map without any."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Prediction(Brief):
    """Pose expected before the frame's observations: ``wTc`` (4, 4) and its covariance (6, 6)."""

    wTc: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Remark:
    """What was found on a drive, as data; ``report.content`` makes its sentence.

    Attributes:
        code: key of the sentence.
        frames: numbers of the frames that it is about, ascending.
        values: numbers and names in the sentence.
    """

    code: str
    frames: tuple[int, ...] = ()
    values: Mapping[str, float | str] = field(default_factory=dict)


class EgoMotionStatus(str, Enum):
    """How the pose of a frame was found."""

    FIRST = "first"
    OK = "ok"
    CAPPED = "capped"
    RELOCALISED = "relocalised"
    CONTRADICTED = "contradicted"
    TOO_FEW_MATCHES = "too_few_matches"
    DIVERGED = "diverged"
    NO_IMAGE = "no_image"
    CAMERA_FAULT = "camera_fault"
    ONE_IMAGE = "one_image"
    NOT_LOCATED = "not_located"

    @property
    def measured(self) -> bool:
        """Whether landmarks contributed to the pose (otherwise it is the odometry's)."""
        return self in (
            EgoMotionStatus.OK,
            EgoMotionStatus.CAPPED,
            EgoMotionStatus.RELOCALISED,
            EgoMotionStatus.CONTRADICTED,
            EgoMotionStatus.ONE_IMAGE,
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EgoMotion(Brief):
    """Result of the least-squares pose (Se et al. 3.3).

    Attributes:
        wTc: (4, 4) estimated pose.
        covariance: (6, 6) in the tangent space at ``wTc``.
        inliers: (k,) which of the given matches were used in the last iteration.
        residuals: (k,) image residual E of every match at ``wTc``, pixels.
        status: how it ended.
        iterations: Newton steps taken.
        weighted_at: (4, 4) pose at which the last minimisation's weights were evaluated; None
            where nothing was minimised.
        noise: variance over the stated one that its measurements were taken to have.
        misfit: the same, as the median of its matches' residuals has it; NaN where there are none.
    """

    wTc: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    residuals: FloatArray
    status: EgoMotionStatus
    iterations: int
    weighted_at: FloatArray | None = None
    noise: float = 1.0
    misfit: float = np.nan

    @property
    def coherent(self) -> bool:
        """Whether most of what was matched was used; a pose that was not measured uses nothing."""
        return not self.status.measured or 2 * int(self.inliers.sum()) >= len(self.inliers)


def correlation(covariance: FloatArray) -> FloatArray:
    """Correlations (..., n, n) of covariances (..., n, n); 0 for what has no variance.

    Of a pose's the known one is that of sideways motion and yaw (Se et al. 5).
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


class RelocalisationStatus(str, Enum):
    """How a search for a pose without a prior ended."""

    FOUND = "found"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_INLIERS = "too_few_inliers"
    AMBIGUOUS = "ambiguous"
    CONTRADICTED = "contradicted"
    INACCURATE = "inaccurate"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Relocalisation(Brief):
    """The pose of a frame in a map, found without a prior, and why it is accepted or refused.

    Attributes:
        status: FOUND, or why the best pose is refused.
        wTc: (4, 4) best pose; the identity where there is none.
        covariance: (6, 6) of it, in the tangent space at ``wTc``; NaN where there is none.
        features: (k,) indices of the frame's features that agree with the pose.
        ids: (k,) the landmarks that they match, unique.
        candidates: tentative matches by appearance.
        expected: landmarks that the pose should see.
        residual_px: root mean square image residual of the inliers; NaN where there are none.
        second: inliers of the second-best pose elsewhere in the map, 0 where there is none.
        why: the status in words with its numbers.
    """

    status: RelocalisationStatus
    wTc: FloatArray
    covariance: FloatArray
    features: IntArray
    ids: IntArray
    candidates: int
    expected: int
    residual_px: float
    second: int
    why: str

    @property
    def found(self) -> bool:
        """Whether the pose is accepted."""
        return self.status is RelocalisationStatus.FOUND


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UpdateStats(Brief):
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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class GyroscopeBias(Brief):
    """Bias of the gyroscope that measured the turns, at the end of the drive.

    Attributes:
        rates: (3,) rad/s about the axes of the body.
        covariance: (3, 3) of it.
    """

    rates: FloatArray
    covariance: FloatArray

    @property
    def words(self) -> str:
        """In degrees/s, with its standard deviations."""
        rates = np.degrees(self.rates)
        sigmas = np.degrees(np.sqrt(np.diagonal(self.covariance)))
        pairs = zip("xyz", rates, sigmas, strict=True)
        axes = ", ".join(f"{axis} {rate:+.3f} +- {sigma:.3f}" for axis, rate, sigma in pairs)
        return f"bias of the gyroscope at the end, degrees/s: {axes}"


LAGS = (1, 5, 20)
"""Frames over which motions are judged by their own covariances."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimate(Brief):
    """An estimator's whole answer.

    Attributes:
        trajectory: all poses as known now.
        covariances: (n, 6, 6) their marginals; NaN where one cannot be had.
        landmarks: the map, with marginal covariances.
        remarks: what the estimator had to correct or leave out, in words.
        noise_factor: what the stated deviations of landmark measurements were multiplied by when
            they were weighed; None where none was.
        gyroscope: bias of the gyroscope; None where none is estimated.
        relative: by :data:`LAGS`, of those that are known, (n - lag, 6, 6) covariances of the
            motions over so many frames, by the joint covariance of both poses, in the tangent space
            at the motion's end; NaN where one is not known.
        online_relative: the same of motions between poses as they were first estimated.
    """

    trajectory: Trajectory
    covariances: FloatArray
    landmarks: LandmarkMap
    remarks: tuple[str, ...] = ()
    noise_factor: float | None = None
    gyroscope: GyroscopeBias | None = None
    relative: Mapping[int, FloatArray] = field(default_factory=dict)
    online_relative: Mapping[int, FloatArray] = field(default_factory=dict)

    def of(self, frame: PoseFrame, rig: CameraRig) -> Estimate:
        """The same with poses and their covariances of another frame (:meth:`Trajectory.of`)."""
        trajectory = self.trajectory.of(frame, rig)
        if trajectory is self.trajectory:
            return self
        gTf = rig.fTc(frame) @ inverse(rig.fTc(self.trajectory.frame))
        covariances = change_tangent_frame(gTf, self.covariances)
        relative, online = (
            {lag: change_tangent_frame(gTf, one) for lag, one in known.items()}
            for known in (self.relative, self.online_relative)
        )
        return replace(
            self,
            trajectory=trajectory,
            covariances=covariances,
            relative=relative,
            online_relative=online,
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class Outcome(Brief, ABC):
    """What an estimator made of a drive, live or of its log: what it is evaluated by.

    Attributes:
        kind: which estimator it is.
        estimate: trajectory, covariances and landmarks as known now, or at the end (of what was
            computed, on failure).
        online: each pose as it was first estimated, at its own time.
        online_covariances: (n, 6, 6) of those.
        closed: of the loop closures offered so far, in their order, whether it took them.
        failure: empty, or at which frame and why the estimator ended early.
        final_ms: time for the final estimate after the last frame; NaN where not timed apart.
        memory_before_mb: resident memory of the process before the estimator was made.
        peak_memory_mb: its largest since the process began, the final estimate included.
    """

    kind: str
    estimate: Estimate
    online: Trajectory
    online_covariances: FloatArray
    closed: tuple[bool, ...] = ()
    failure: str = ""
    final_ms: float = math.nan
    memory_before_mb: float | None = None
    peak_memory_mb: float | None = None

    @abstractmethod
    def column(self, name: str) -> npt.NDArray[Any]:
        """(n,) one number of every frame: `status`, `nis`, `nis_dof`, `update_ms`, `solve_ms`."""
