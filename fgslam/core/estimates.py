"""Estimates: poses, trajectories, maps, and how each was found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray, Rows
from fgslam.core.trajectories import Trajectory

__all__ = [
    "EgoMotion",
    "EgoMotionStatus",
    "Estimate",
    "LandmarkMap",
    "Prediction",
    "Relocalisation",
    "RelocalisationStatus",
    "Trajectory",
    "UpdateStats",
    "correlation",
]


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

    def without(self, ids: IntArray) -> LandmarkMap:
        """The map but for these landmarks, as a new value."""
        return self.select(~np.isin(self.ids, ids))

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        rows = np.searchsorted(self.ids, ids)
        if len(ids) and (rows.max() >= len(self.ids) or not np.array_equal(self.ids[rows], ids)):
            raise KeyError(f"landmarks not in the map: {np.setdiff1d(ids, self.ids)[:5].tolist()}")
        return rows


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Prediction(Brief):
    """Pose expected before the frame's observations: ``wTc`` (4, 4) and its covariance (6, 6)."""

    wTc: FloatArray
    covariance: FloatArray


class EgoMotionStatus(str, Enum):
    """How the pose of a frame was found."""

    FIRST = "first"
    OK = "ok"
    CAPPED = "capped"
    RELOCALISED = "relocalised"
    TOO_FEW_MATCHES = "too_few_matches"
    DIVERGED = "diverged"
    NO_IMAGE = "no_image"
    CAMERA_FAULT = "camera_fault"
    NOT_LOCATED = "not_located"

    @property
    def measured(self) -> bool:
        """Whether landmarks contributed to the pose (otherwise it is the odometry's)."""
        return self in (
            EgoMotionStatus.OK,
            EgoMotionStatus.CAPPED,
            EgoMotionStatus.RELOCALISED,
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
        misfit: the same, as the median of its matches' residuals has it; NaN where none says.
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
    """

    trajectory: Trajectory
    covariances: FloatArray
    landmarks: LandmarkMap
    remarks: tuple[str, ...] = ()
    noise_factor: float | None = None
    gyroscope: GyroscopeBias | None = None
