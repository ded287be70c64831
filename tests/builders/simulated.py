"""A simulated drive without images: points, exact poses, noisy measurements with identities.

Identities behave as the landmark database makes them: given in the order of first sight, kept
through misses, gone after too many in a row, new when the point is seen again. With ``noise=0``
the measurements are exact while the covariances stay, so that estimators must find the truth.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from benchmarks import feature_world
from benchmarks.feature_world import visible
from fgslam.backend.protocol import Estimator
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig, Increment, Observations, Odometry
from fgslam.core.store import pack
from fgslam.core.types import EgoMotion, EgoMotionStatus, Prediction, UpdateStats
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.replay import replay_frame
from fgslam.worlds.driving import Drive as RobotDrive, drive_along
from fgslam.worlds.lab import place_path
from fgslam.worlds.settings import LabDriveSettings
from fgslam.worlds.simulated_measurements import IdentityBook

RIG = CameraRig(
    width=320,
    height=240,
    fx=277.0,
    fy=277.0,
    cx=159.5,
    cy=119.5,
    baseline=0.1,
    vertical_baseline=0.1,
    bTc=g.BODY_FORWARD_LEFT_UP_FROM_CAMERA,
)
"""The paper's rig: 320x240, 60 degrees, 10 cm baselines."""

BORDER_PX = 5.0
TURN_AND_GO = (0.0, 0.03, 0.0, 0.01, 0.0, 0.08)


@dataclass(frozen=True)
class Drive:
    """What to simulate; standard deviations are those of the covariances handed out."""

    frames: int = 12
    points: int = 150
    twist: tuple[float, ...] = TURN_AND_GO
    period_s: float = 0.5
    sigma_px: tuple[float, float, float] = (0.3, 0.3, 0.2)
    odometry_sigma: tuple[float, ...] = (0.005, 0.005, 0.005, 0.01, 0.01, 0.01)
    depth_m: tuple[float, float] = (1.5, 6.0)
    miss_rate: float = 0.15
    prune_after: int = 20
    noise: float = 1.0
    rig: CameraRig = RIG


@dataclass(frozen=True)
class Simulation:
    """The truth and the measurements: poses (n, 4, 4), point (3,) of each identity (m, 3)."""

    drive: Drive
    poses: FloatArray
    points_by_id: FloatArray
    increments: list[Increment]


def simulate(
    drive: Drive, rng: np.random.Generator, twists: FloatArray | None = None
) -> Simulation:
    """Drives with a constant twist, or twists (frames - 1, 6), past points over all its views."""
    constant = np.tile(np.array(drive.twist), (drive.frames - 1, 1))
    steps = [g.se3_exp(twist) for twist in (constant if twists is None else twists)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(g.reorthonormalise(poses[-1] @ step))
    points = points_in_views(drive, poses, rng)
    book = Identities(drive, points)
    to = [np.eye(4), *steps]
    increments = [book.increment(k, wTc, to[k], rng) for k, wTc in enumerate(poses)]
    return Simulation(drive, np.array(poses), points[book.book.point_of_id], increments)


def points_in_views(drive: Drive, poses: list[FloatArray], rng: np.random.Generator) -> FloatArray:
    """Points (n, 3), each uniformly in the image and depth range of a random pose."""
    which = rng.integers(len(poses), size=drive.points)
    local = points_in_view(drive.rig, drive.points, drive.depth_m, rng)
    chosen = np.array(poses)[which]
    return np.asarray(np.einsum("nij,nj->ni", chosen[:, :3, :3], local) + chosen[:, :3, 3])


def points_in_view(
    rig: CameraRig, count: int, depth_m: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Points (n, 3) in the camera's frame, uniform in image and depth."""
    depth = rng.uniform(*depth_m, count)
    column = rng.uniform(BORDER_PX + 1, rig.width - BORDER_PX - 2, count)
    row = rng.uniform(BORDER_PX + 1, rig.height - BORDER_PX - 2, count)
    return np.column_stack(
        [(column - rig.cx) * depth / rig.fx, (row - rig.cy) * depth / rig.fy, depth]
    )


class Identities:
    """Measures the points and keeps the book of their identities, frame after frame."""

    def __init__(self, drive: Drive, points: FloatArray) -> None:
        self._drive = drive
        self._points = points
        self.book = IdentityBook(len(points), drive.prune_after)

    def increment(
        self, k: int, wTc: FloatArray, step: FloatArray, rng: np.random.Generator
    ) -> Increment:
        drive = self._drive
        local = g.transform_to_camera(wTc, self._points)
        in_view = visible(drive.rig, local)
        seen = in_view & (rng.uniform(size=len(in_view)) >= drive.miss_rate)
        sightings = self.book.take(seen, in_view)
        local[~in_view] = 1.0
        noise = drive.noise * np.array(drive.sigma_px) * rng.standard_normal(local.shape)
        measured = drive.rig.predict(local) + noise
        both = np.concatenate([sightings.matched, sightings.new])
        ids = np.concatenate([sightings.matched_ids, sightings.new_ids])
        is_new = np.arange(len(both)) >= len(sightings.matched)
        return Increment(
            index=2 * k,
            timestamp=drive.period_s * k,
            odometry=None if k == 0 else noisy_odometry(drive, step, rng),
            observations=observations(ids, measured[both], np.array(drive.sigma_px), is_new),
            rejected=np.zeros(len(both), np.bool_),
            missed_ids=sightings.missed_ids,
            pruned_ids=sightings.pruned_ids,
        )


def noisy_odometry(drive: Drive, step: FloatArray, rng: np.random.Generator) -> Odometry:
    """The step with noise of the stated covariance, in the tangent space at its end."""
    return noisy_odometry_of(step, np.array(drive.odometry_sigma), drive.noise, rng)


def noisy_odometry_of(
    step: FloatArray, sigma: FloatArray, noise: float, rng: np.random.Generator
) -> Odometry:
    """A step with noise of standard deviations ``sigma`` (6,), drawn ``noise`` times as large."""
    drawn = g.se3_exp(noise * sigma * rng.standard_normal(6))
    return Odometry(step @ drawn, np.diag(sigma**2))


def observations(
    ids: IntArray, measured: FloatArray, sigma_px: FloatArray, is_new: BoolArray
) -> Observations:
    """Observations of (column, row, disparity) (n, 3), raw pixels of equal baselines."""
    right, disparity = measured[:, :2], measured[:, 2]
    left = right + np.outer(disparity, [1.0, 0.0])
    top = right + np.outer(disparity, [0.0, 1.0])
    return Observations(
        ids=np.asarray(ids, np.int64),
        measurement=measured,
        covariance=np.tile(np.diag(sigma_px**2), (len(ids), 1, 1)),
        pixels=np.stack([right, left, top], axis=1),
        is_new=np.asarray(is_new, np.bool_),
    )


def play(
    estimator: Estimator,
    increments: list[Increment],
    settings: EgoMotionSettings | None = None,
    rig: CameraRig = RIG,
) -> list[UpdateStats]:
    """Gives increments to an estimator as the replay of a log does."""
    solver = EgoMotionSolver(rig, settings or EgoMotionSettings())
    motion = ConstantVelocityMotion()
    return [
        replay_frame(increment, estimator, solver, motion, increment.index // 2).stats
        for increment in increments
    ]


def play_directly(
    estimator: Estimator, increments: list[Increment], settings: EgoMotionSettings | None = None
) -> list[UpdateStats]:
    """The same by the estimator's own three calls: predict, landmarks, update."""
    solver = EgoMotionSolver(RIG, settings or EgoMotionSettings())
    stats = []
    for increment in increments:
        prediction = estimator.predict(increment.odometry)
        matched = increment.observations.select(~increment.observations.is_new)
        if increment.odometry is None:
            first = tracked_at(prediction, len(matched))
            tracking = dataclasses.replace(first, status=EgoMotionStatus.FIRST)
        else:
            problem = PoseProblem.of(estimator.landmarks(), matched)
            tracking = solver.solve(prediction, problem)
        stats.append(estimator.update(increment, tracking))
    return stats


def tracked_at(prediction: Prediction, matches: int) -> EgoMotion:
    """A tracking result at a known pose that used all matches."""
    return EgoMotion(
        wTc=prediction.wTc.copy(),
        covariance=prediction.covariance.copy(),
        inliers=np.ones(matches, np.bool_),
        residuals=np.zeros(matches),
        status=EgoMotionStatus.OK,
        iterations=1,
    )


def arrays_of(value: object) -> list[FloatArray]:
    """All arrays inside dataclasses, dictionaries, lists and tuples, in a fixed order."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, dict):
        return [array for key in sorted(value) for array in arrays_of(value[key])]
    if isinstance(value, list | tuple):
        return [array for item in value for array in arrays_of(item)]
    if dataclasses.is_dataclass(value):
        return arrays_of(tuple(getattr(value, f.name) for f in dataclasses.fields(value)))
    return []


def assert_same_bits(first: object, second: object) -> None:
    """All arrays of both are equal to the last bit, NaN included, and there are some."""
    a, b = arrays_of(first), arrays_of(second)
    assert len(a) == len(b) > 0
    for x, y in zip(a, b, strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def assert_same_value(first: object, second: object) -> None:
    """Both are packed to the same names, numbers and bits."""
    a, b = pack(first), pack(second)
    assert a.keys() == b.keys()
    for name in a:
        assert (a[name].dtype, a[name].tobytes()) == (b[name].dtype, b[name].tobytes()), name


class FeatureWorld(feature_world.FeatureWorld):
    """As the project's own; by default of the paper's rig."""

    def __init__(self, points: FloatArray, rng: np.random.Generator, rig: CameraRig = RIG) -> None:
        super().__init__(points, rng, rig)


def plan_drive(settings: LabDriveSettings) -> RobotDrive:
    """Path and time stamps of a drive in the lab. Raises ConfigError where it cannot be driven."""
    return drive_along(place_path("lab", settings), settings, settings.frames)
