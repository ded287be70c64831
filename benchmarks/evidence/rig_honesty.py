"""Self-calibration beside what it states: pieces of one drive, simulated roads, knocks, ATE."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fgslam as fg
from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.backend.self_calibration import SelfCalibration
from fgslam.cameras.rectify import rectifier_of
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import (
    RigCorrection,
    displacements,
    field_displacements,
    field_modes,
    prior_information,
    term_names,
)
from fgslam.core.sensors import CameraRig, Increment, Observations, pixel_model, rig_map
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory

RIG = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
SIGMA_PX, NOISE = 0.3, 0.5  # stated deviation of a coordinate; the drawn one over it
SHAKE_PX, BASELINE, FIELD_PX = 0.02, 4e-3, 0.1
KNOCK_DEG, KNOCK_AT = 0.25, 45
SEEDS, KNOCK_SEEDS = range(6), range(4)
_ROAD_FRAMES, _POINTS, _NEAR_M, _FAR_M = 40, 900, 4.0, 60.0
_PIECE = 40
_DIRECTION = np.array(["baseline" in name for name in term_names(RIG)])
_RAW = "kitti_raw_0926_5hz"
COURSES = {
    **{f"piece {first}": (_RAW, slice(first, first + _PIECE)) for first in range(0, 200, _PIECE)},
    "`kitti06`": ("kitti06", slice(None)),
    "`kitti_raw_0926`": (_RAW, slice(None)),
    "`euroc_v101`": ("euroc_v101_kf100", slice(None)),
}


def turned(degrees: float) -> FloatArray:
    """(p,) correction of a left camera turned in yaw."""
    yaw = np.array([name == "left.yaw" for name in term_names(RIG)])
    return np.asarray(np.deg2rad(degrees) * yaw)


def drawn_terms(seed: int, spoilt: bool) -> FloatArray:
    """(p,) as far off as calibrations are taken to be; in the baseline's direction if spoilt."""
    rng = np.random.default_rng(seed)
    spread = np.linalg.cholesky(np.linalg.inv(prior_information(RIG)))
    out = np.asarray(spread @ rng.standard_normal(len(spread)), np.float64)
    out[_DIRECTION] = spoilt * BASELINE * rng.standard_normal(_DIRECTION.sum())
    return out


def road(
    seed: int, wrong: FloatArray, spoilt: bool, frames: int = _ROAD_FRAMES, knock: float = 0.0
) -> Iterator[tuple[Increment, FloatArray]]:
    """A winding road as a rig off by ``wrong`` (p,) sees it, and poses known to a centimetre.

    ``spoilt``: by shaking images and a field; ``knock`` degrees of yaw
    come in the middle of it.
    """
    rng, model, fuse = np.random.default_rng([seed, 5]), pixel_model(2, 1.0), rig_map(RIG)
    points = rng.uniform([-12.0, -4.0, 0.0], [12.0, 1.6, frames + _FAR_M], (_POINTS, 3))
    modes = spoilt * FIELD_PX * rng.standard_normal(field_modes(RIG))
    size, centre = np.array([RIG.width, RIG.height]), np.array([RIG.cx, RIG.cy])
    wTc, born = np.eye(4), np.zeros(_POINTS, np.bool_)
    for k in range(frames):
        local = g.transform_to_camera(wTc, points)
        ids = np.flatnonzero((local[:, 2] > _NEAR_M) & (local[:, 2] < _FAR_M))
        exact = RIG.predict(local[ids])
        at = (exact @ model.T).reshape(-1, 2, 2)
        inside = ((at >= 0.0) & (at < size)).all(axis=(1, 2))
        ids, exact, at = ids[inside], exact[inside], at[inside]
        off = displacements(RIG, at) @ (wrong + turned(knock * (k >= KNOCK_AT)))
        off += field_displacements(RIG, at) @ modes
        ray = (at[:, 1] - centre) / RIG.fx
        column, row, roll, zoom = spoilt * SHAKE_PX * rng.standard_normal(4)
        off[:, 2:] += [column, row]
        off[:, 2:] += roll * ray[:, ::-1] * [-1.0, 1.0] + zoom * ray
        pixels = np.full((len(ids), 3, 2), np.nan)
        noise = NOISE * SIGMA_PX * rng.standard_normal(at.shape)
        pixels[:, :2] = at + off.reshape(at.shape) + noise
        measured = pixels[:, :2].reshape(-1, 4) @ fuse.T
        unit = np.tile(np.eye(3), (len(ids), 1, 1))
        seen = Observations(ids, measured, unit, pixels, ~born[ids])
        born[ids] = True
        none, good = np.empty(0, np.int64), np.zeros(len(ids), np.bool_)
        error = np.array([2e-3] * 3 + [1e-2] * 3) * rng.standard_normal(6)
        yield (
            Increment(k, 0.1 * k, None, seen, good, none, none),
            g.reorthonormalise(wTc @ g.se3_exp(error)),
        )
        step = g.se3_exp(np.array([0.0, 0.02 * np.sin((k + 1) / 5.0), 0.0, 0.0, 0.0, 1.0]))
        wTc = g.reorthonormalise(wTc @ step)


def nees(off: FloatArray, covariance: FloatArray) -> float:
    """Squared error over its covariance, a degree of freedom."""
    return float(off @ np.linalg.solve(covariance, off)) / len(off)


@one_blas_thread()
def simulated_table() -> Table:
    """NEES of the terms, what is applied to rigs that are exact, and when a knock is found."""
    rows: list[tuple[Cell, ...]] = []
    for spoilt, seed in itertools.product((True, False), SEEDS):
        say(f"road {seed}, {'spoilt' if spoilt else 'clean'}")
        wrong, found = drawn_terms(seed, spoilt), SelfCalibration(RIG, SIGMA_PX)
        alone, knocked = SelfCalibration(RIG, SIGMA_PX), SelfCalibration(RIG, SIGMA_PX)
        for increment, wTc in road(seed, wrong, spoilt):
            found.observe(increment, wTc)
        for increment, wTc in road(seed, wrong * _DIRECTION, spoilt):
            alone.observe(increment, wTc)
        after = -1
        drive = road(seed, wrong, spoilt, 90, KNOCK_DEG) if seed in KNOCK_SEEDS else ()
        for increment, wTc in drive:
            knocked.observe(increment, wTc)
            if knocked.knocks and after < 0:
                after = increment.index + 1 - KNOCK_AT
        known = found.found.estimated
        left = alone.found.applied.rms_px()
        judged = nees(known.values - wrong, known.covariance)
        rows.append(("spoilt" if spoilt else "clean", seed, judged, left, found.knocks, after))
    columns = ("road", "seed", "NEES", "exact: applied, px", "false knocks", "knock found after")
    return Table("Simulated roads", columns, rows)


class Driven(NamedTuple):
    """ATE on the way and at the end (m), the rig as found, frames at which a knock was counted."""

    live: float
    end: float
    rig: RigCorrection | None
    knocks: tuple[int, ...]


@one_blas_thread()
def driven(data: Path, name: str, calibrates: bool, knock_at: int | None = None) -> Driven:
    """One course; from a frame on, its left images can be turned."""
    folder, frames = COURSES[name]
    recording = fg.open_recording(str(data / folder))
    bent = rectifier_of(recording.rig, -turned(KNOCK_DEG))
    slam: Any = fg.Slam(recording.rig, "isam2", frontend={"self_calibration": calibrates})
    times, poses = [], []
    knocks: list[int] = []
    for k, (t, images, _) in enumerate(itertools.islice(recording, frames.start, frames.stop)):
        if knock_at is not None and images is not None and k >= knock_at:
            images = (bent.rectify(1, images[0]), *images[1:])
        times.append(t)
        poses.append(slam.track(t, images).wTc)
        steps = slam.pipeline.calibration.knocks if calibrates else 0
        knocks += [k] * (steps - len(knocks))
    result, live = slam.result(), Trajectory(np.array(times), np.array(poses))
    slam.close()
    live_m, end_m = (_ate(each, recording.ground_truth) for each in (live, result.trajectory))
    return Driven(live_m, end_m, result.rig and result.rig.estimated, tuple(knocks))


def _ate(found: Trajectory, truth: Trajectory | None) -> float:
    error = evaluate_trajectory(found, truth, Alignment.SE3).ate_rmse_m
    return np.nan if error is None else error


def real_tables(data: Path) -> Iterator[Table]:
    """ATE with and without self-calibration, knocks; NEES between pieces."""
    rows: list[tuple[Cell, ...]] = []
    pieces: list[RigCorrection] = []
    errors: list[tuple[float, ...]] = []
    for name in COURSES:
        say(name)
        off, on = (driven(data, name, calibrates) for calibrates in (False, True))
        errors.append((off.live, off.end, on.live, on.end))
        rows.append((name, *errors[-1], len(on.knocks)))
        pieces += [on.rig] if name.startswith("piece") and on.rig else []
    columns = ("recording", "off: live", "off: end", "on: live", "on: end", "knocks")
    means = np.exp(np.mean(np.log(errors), axis=0))
    rows.append(("geometric mean", *means.tolist(), None))
    yield Table("ATE, m", columns, rows)
    pairs = [
        nees(a.values - b.values, a.covariance + b.covariance)
        for a, b in itertools.combinations(pieces, 2)
    ]
    yaw = [next(iter(piece.changes().values())) for piece in pieces]
    told = ", ".join(f"{value:.3f} +- {sigma:.3f}" for value, sigma in yaw)
    yield Table(
        "Pieces of one drive against each other", ("NEES, mean", "largest", "yaw, degrees"),
        [(float(np.mean(pairs)), max(pairs), told)],
    )  # fmt: skip
    hit = driven(data, "`kitti_raw_0926`", True, 60)
    yield Table(
        f"A knock of {KNOCK_DEG} degrees at frame 60", ("knocks at", "live", "end"),
        [(str(hit.knocks), hit.live, hit.end)],
    )  # fmt: skip


def tables(data: Path) -> Iterator[Table]:
    """Simulated, then real."""
    yield simulated_table()
    yield from real_tables(data)
