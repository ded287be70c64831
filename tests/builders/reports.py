"""Made-up reports: a level loop with noise, as a run's page would get it."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
from PIL import Image

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose, so3_exp
from fgslam.core.types import LandmarkMap, Trajectory
from fgslam.report.content import Column, Picture, TextTable
from fgslam.report.results import EstimatorReport, ReportData

HOSTILE = "<script>alert('%{x}')</script> & \"quotes\" </style>"


def loop(frames: int) -> Trajectory:
    """Once around a circle of 2 m radius in the plane y = 0, looking ahead, from the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, frames)
    places = 2.0 * np.column_stack([1.0 - np.cos(angle), np.zeros(frames), np.sin(angle)])
    turns = [so3_exp(np.array([0.0, a, 0.0])) for a in angle]
    times = np.asarray(100.0 + 0.25 * np.arange(frames), np.float64)
    return Trajectory(times, np.array([*map(pose, turns, places)]))


def estimator_report(
    title: str,
    truth: Trajectory,
    rng: np.random.Generator,
    *,
    sigma_m: float = 0.02,
    landmarks: int = 300,
) -> EstimatorReport:
    """The truth with noise that grows along the way, and covariances that tell so."""
    n = len(truth)
    growth = np.sqrt(np.arange(n) / n)
    noise = sigma_m * growth[:, None] * rng.standard_normal((n, 3))
    final, online = truth.poses.copy(), truth.poses.copy()
    final[:, :3, 3] += noise
    online[:, :3, 3] += 2.0 * noise
    covariances = np.zeros((n, 6, 6))
    covariances[:, 3:, 3:] = (sigma_m * growth)[:, None, None] ** 2 * np.eye(3)
    errors = np.linalg.norm(noise, axis=1)
    nees = np.divide(
        errors**2, 3.0 * (sigma_m * growth) ** 2, out=np.full(n, np.nan), where=growth > 0.0
    )
    return EstimatorReport(
        title=title,
        kind=title,
        timestamps=truth.timestamps,
        final_poses=final,
        online_poses=online,
        covariances=covariances,
        landmarks=landmark_map(landmarks, rng),
        final_error_m=errors,
        online_error_m=2.0 * errors,
        nees=nees,
        update_ms=5.0 + rng.random(n),
        predicted=np.zeros(n, np.bool_),
        nees_band=(0.07, 3.12),
        ate_m=float(np.sqrt(np.mean(errors**2))),
        nees_per_dof=float(np.nanmean(nees)),
        verdict="consistent",
    )


def landmark_map(count: int, rng: np.random.Generator) -> LandmarkMap:
    points = rng.uniform([-2.0, -1.5, -4.0], [6.0, 0.5, 4.0], (count, 3))
    return LandmarkMap(np.arange(count), points, np.tile(1e-4 * np.eye(3), (count, 1, 1)))


def picture(rng: np.random.Generator, width: int = 64, height: int = 48) -> bytes:
    out = io.BytesIO()
    Image.fromarray(rng.integers(0, 255, (height, width), dtype=np.uint8)).save(out, "PNG")
    return out.getvalue()


def full_report(frames: int = 60, landmarks: int = 300) -> ReportData:
    """Three estimators, one of them failed, with everything that a page can show."""
    rng = np.random.default_rng(3)
    truth = loop(frames)
    estimators = (
        estimator_report("landmark_kalman", truth, rng, landmarks=landmarks),
        estimator_report("isam2", truth, rng, sigma_m=0.01, landmarks=landmarks),
        EstimatorReport.failed("ekf", "ekf", "the map of 4,000 landmarks needs 1.2 GB"),
    )
    columns = (
        Column("ATE (cm)", "absolute trajectory error, SE3 aligned"),
        Column("NEES", "normalised error squared of the poses per degree of freedom"),
    )
    rows = (("landmark_kalman", ("2.1", "1.0")), ("isam2", ("1.0", "1.0")), ("ekf", ("-", "-")))
    return ReportData(
        title="loop",
        subtitle=f"{frames} frames",
        estimators=estimators,
        truth=truth,
        notes=("a note on the recording",),
        tables=(TextTable("comparison", "Comparison", "estimator", columns, rows),),
        pictures=(Picture("flow in frame 60", picture(rng)),),
        config_yaml="name: loop\n",
        versions={"fgslam": "0.1", "open3d": None},
        views={0: picture(rng)},
        about=(("isam2", "iSAM2 over all poses and landmarks."),),
        commands=("fgslam film loop run.mp4",),
    )


def without_truth(data: ReportData) -> ReportData:
    """The same where nothing true is known."""

    def blind(estimator: EstimatorReport) -> EstimatorReport:
        unknown: FloatArray = np.full(len(estimator), np.nan)
        return dataclasses.replace(
            estimator,
            final_error_m=unknown,
            online_error_m=unknown,
            nees=unknown,
            nees_band=None,
            ate_m=None,
            nees_per_dof=None,
            verdict=None,
        )

    return dataclasses.replace(data, truth=None, estimators=tuple(map(blind, data.estimators)))
