"""Measurements without images: a folder with a log, GTSAM's stereo tracks, a simulated drive.

docs/datasets/published.md, docs/datasets/rendered.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.core.files import read_lines
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    reorthonormalise,
    right_from_left_camera,
)
from fgslam.core.log import (
    LANDMARK_TRUTH_FILE,
    LandmarkTruth,
    MeasurementLog,
    MeasurementRecording,
    read_landmark_truth,
)
from fgslam.core.sensors import CameraRig, Increment, Observations, Odometry, measurement_map
from fgslam.core.types import Trajectory
from fgslam.datasets.recording import select_frames
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    MeasurementFilesSettings,
    OdometrySettings,
    SimulatedMeasurementsSettings,
    StereoTracksSettings,
    SyntheticOdometrySettings,
)
from fgslam.datasets.times import Table, read_table

LOG_FILE, GROUND_TRUTH_FILE = "measurements.npz", "ground_truth.tum"
_STAMP_STEP_S = 1e-9  # of a trajectory's file
_NONE: IntArray = np.empty(0, np.int64)


def open_measurement_files(
    settings: MeasurementFilesSettings, odometry: OdometrySettings, _: int = 0
) -> MeasurementRecording:
    """Opens a folder with a log: a run folder, or what `scripts/convert` wrote.

    Raises:
        DatasetError: the folder is missing, or a file of it is damaged.
        MeasurementLogError: the log is.
        ConfigError: synthetic odometry is asked for, or other frames than the first ones.
    """
    if settings.start or settings.stride != 1:
        raise ConfigError(
            "measurements build upon those of earlier frames: set dataset.stop alone, without "
            "dataset.start and dataset.stride"
        )
    root = Path(settings.path)
    path, truth, landmarks = (
        root / name for name in (LOG_FILE, GROUND_TRUTH_FILE, LANDMARK_TRUTH_FILE)
    )
    log = MeasurementLog.load(path)
    count = len(select_frames(len(log), settings, str(path)))
    log = make_log(log.rig, list(log)[:count], odometry)
    stated = Trajectory.load(truth) if truth.is_file() else None
    poses = None if stated is None else stated.of("right", log.rig)
    if poses is not None:
        within = poses.timestamps < log.timestamps[-1] + _STAMP_STEP_S
        poses = Trajectory(poses.timestamps[within], poses.poses[within])
    files = [one for one in (path, truth, landmarks) if one.is_file()]
    name, identity = root.resolve().name, files_identity(files, asdict(settings))
    known = read_landmark_truth(landmarks)[0] if landmarks.is_file() else None
    frame = "right" if stated is None else stated.frame
    return MeasurementRecording(name, identity, log, poses, known, (), frame)


# --------------------------------------------------------------------------------------------
# What all share: landmark identities and the motion model of logs


MeasuredFrame: TypeAlias = tuple[int, float, Odometry | None, IntArray, tuple[FloatArray, ...]]
"""Number, time in seconds, motion since the last frame of the selection, numbers (k,) of the
landmarks, and what :class:`Observations` holds of them: measurement, covariance, raw pixels."""


def make_increments(frames: Iterable[MeasuredFrame]) -> list[Increment]:
    """Increments in which a landmark is new when first seen, never missed and never pruned.

    Matched landmarks come first, then the new ones, each by ascending number.
    """
    known: set[int] = set()
    out = []
    for index, timestamp, odometry, ids, (measurement, covariance, pixels) in frames:
        is_new = np.array([i not in known for i in ids.tolist()], np.bool_)
        order = np.lexsort((ids, is_new))
        seen = Observations(ids, measurement, covariance, pixels, is_new).select(order)
        known.update(ids.tolist())
        accepted = np.zeros(len(order), np.bool_)
        out.append(Increment(index, timestamp, odometry, seen, accepted, _NONE, _NONE))
    return out


def files_identity(files: Iterable[Path], settings: Mapping[str, Any]) -> str:
    """SHA-256 of files by their content, and of what the settings (as values) make of them."""
    values = {k: v for k, v in settings.items() if k not in ("path", "file")}
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode())
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def make_log(
    sensor: CameraRig, increments: list[Increment], odometry: OdometrySettings
) -> MeasurementLog:
    """A log whose motion model is what the settings of odometry ask for.

    Under ``constant_velocity`` the recording's own odometry is left out. A recording without any
    is predicted by constant velocity, whatever the kind: nothing else could be.

    Raises:
        ConfigError: synthetic odometry is asked for.
    """
    if isinstance(odometry, SyntheticOdometrySettings):
        raise ConfigError(
            "odometry.kind synthetic needs a recording of images; measurements bring their own "
            "odometry: choose recorded or constant_velocity"
        )
    motion = "constant_velocity"
    if isinstance(odometry, ConstantVelocitySettings):
        increments = [replace(increment, odometry=None) for increment in increments]
    elif any(increment.odometry is not None for increment in increments):
        motion = "recorded"
    log = MeasurementLog(sensor, {"kind": motion})
    for increment in increments:
        log.append(increment)
    return log


# --------------------------------------------------------------------------------------------
# GTSAM's stereo tracks of KITTI drives: text inside the installed wheel, GTSAM is not loaded


_INSIDE = {"00s": "00s", "00": "00", "large": "_large"}
_PREFIX = "VO_stereo_factors"
_COLUMNS = ("pose", "landmark", "uL", "uR", "v", "X", "Y", "Z")
_CALIBRATION = ("fx", "fy", "skew", "cx", "cy", "baseline")
FRAME_PERIOD_S = 0.1  # of KITTI; the files lack times
_NOT_RIGID = 1e-3  # the files give six digits


def open_stereo_tracks(
    settings: StereoTracksSettings, odometry: OdometrySettings, _: int = 0
) -> MeasurementRecording:
    """Opens one of the files.

    Raises:
        DatasetError: it is missing, or malformed.
        CalibrationError: its calibration is.
    """
    path = Path(settings.file)
    if settings.file in _INSIDE:
        name = f"gtsam/Data/{_PREFIX}{_INSIDE[settings.file]}.txt"
        path = Path(str(distribution("gtsam").locate_file(name)))
    if not path.is_file():
        raise DatasetError(
            f"{path}: no such file; dataset.file is {', '.join(_INSIDE)} or a file {_PREFIX}*.txt"
        )
    suffix = path.stem.removeprefix(_PREFIX)
    calibration = path.with_name(f"VO_calibration{suffix}.txt")
    if not calibration.exists():
        calibration = path.with_name("VO_calibration.txt")  # of the `_large` one
    poses = path.with_name(f"VO_camera_poses{suffix}.txt")
    tracks, renumbered = _renumbered(read_table(path, _COLUMNS))
    rows, notes = _usable(tracks)
    notes = (*renumbered, *notes)
    numbers = np.unique(tracks.values[rows, 0]).astype(np.int64)
    numbers = numbers[select_frames(len(numbers), settings, str(path))]
    rig = _read_rig(calibration, tracks.values[rows])
    truth = _read_poses(poses, rig, numbers)
    if truth is not None:
        notes += ("the reference poses are estimates from the same images, not measured truth",)
    increments = make_increments(_frames(tracks.values[rows], numbers, settings))
    listed = [file for file in (path, calibration, poses) if file.exists()]
    name = f"stereo tracks {suffix.removeprefix('_')}"
    identity = files_identity(listed, asdict(settings) | {"frame_period_s": FRAME_PERIOD_S})
    log = make_log(rig, increments, odometry)
    return MeasurementRecording(name, identity, log, truth, None, notes, "left")


_SPARSE = 10  # times as many as landmarks: arrays by number would be mostly empty


def _renumbered(tracks: Table) -> tuple[Table, tuple[str, ...]]:
    """Tracks whose landmarks count from 0, in order, where the file's numbers are much larger.

    So are keys of GTSAM and hashes, whole numbers of 64 bits: a float holds 53 of them.
    """
    words = [text.split()[1] for _, text in read_lines(tracks.path)]
    try:
        numbers = [int(word) for word in words]
    except ValueError:  # refused with its line
        return tracks, ()
    known = {number: k for k, number in enumerate(sorted(set(numbers)))}
    if not known or (min(known) >= 0 and max(known) < max(1000, _SPARSE * len(known))):
        return tracks, ()
    values = tracks.values.copy()
    values[:, 1] = [known[number] for number in numbers]
    note = f"landmarks have numbers up to {max(known)}: they are counted from 0 in their order"
    return replace(tracks, values=values), (note,)


def _usable(tracks: Table) -> tuple[IntArray, tuple[str, ...]]:
    """Rows with positive disparity, by frame and landmark; and what was left out."""
    values = tracks.values
    bad = np.flatnonzero((values[:, :2] != np.rint(values[:, :2])).any(axis=1) | (values[:, 0] < 0))
    if len(bad):
        raise DatasetError(
            f"{tracks.path}, line {tracks.lines[bad[0]]}: pose and landmark must be whole numbers "
            f"from 0; expected columns {' '.join(_COLUMNS)}"
        )
    order = np.lexsort((values[:, 1], values[:, 0]))
    twice = np.flatnonzero((np.diff(values[order, :2], axis=0) == 0.0).all(axis=1))
    if len(twice):
        line = tracks.lines[order[twice[0] + 1]]
        raise DatasetError(
            f"{tracks.path}, line {line}: the landmark is measured twice in one frame; remove one"
        )
    positive = values[order, 2] > values[order, 3]
    left_out = int((~positive).sum())
    notes = (f"{left_out} observations without disparity left out",) if left_out else ()
    return order[positive], notes


def _read_rig(path: Path, values: FloatArray) -> CameraRig:
    """The calibration; the image, whose size the files lack, is what holds all measurements."""
    table = read_table(path, _CALIBRATION, error=CalibrationError)
    if len(table) != 1:
        raise CalibrationError(
            f"{path}: {len(table)} lines, expected one of {' '.join(_CALIBRATION)}; restore it"
        )
    fx, fy, skew, cx, cy, baseline = table.values[0].tolist()
    if skew != 0.0 or min(fx, fy, baseline) <= 0.0:
        raise CalibrationError(
            f"{path}: fx, fy and baseline must be positive and skew 0; correct the line"
        )
    width, height = (int(np.ceil(values[:, k].max())) + 1 for k in ([2, 3], 4))
    bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA
    return CameraRig(width, height, fx, fy, cx, cy, baseline, None, bTc)


def _read_poses(path: Path, rig: CameraRig, numbers: IntArray) -> Trajectory | None:
    """Reference poses of the right camera at the frames, in the left one's first; None if absent.

    Lines hold the frame and the left camera's ``wTl``, row by row.
    """
    if not path.exists():
        return None
    columns = ("pose", *(f"T{i}{j}" for i in range(4) for j in range(4)))
    table = read_table(path, columns)
    at = {int(number): k for k, number in enumerate(table.values[:, 0])}
    chosen = [at[n] for n in numbers.tolist() if n in at]
    left = table.values[chosen, 1:].reshape(-1, 4, 4)
    for k, wTl in zip(chosen, left, strict=True):
        off = np.abs(wTl[:3, :3] @ wTl[:3, :3].T - np.eye(3)).max()
        if off > _NOT_RIGID or not np.array_equal(wTl[3], [0.0, 0.0, 0.0, 1.0]):
            raise DatasetError(f"{path}, line {table.lines[k]}: not a rigid pose; correct the line")
    stamps = table.values[chosen, 0] * FRAME_PERIOD_S
    return Trajectory(stamps, right_from_left_camera(reorthonormalise(left), rig.baseline))


def _frames(
    values: FloatArray, numbers: IntArray, settings: StereoTracksSettings
) -> Iterator[MeasuredFrame]:
    """The chosen frames; the left camera's (uL, v) is measured from the right one, our reference.

    The files' one row stands for both images', so it is not averaged: independent noise on
    uR, uL and v gives var(d) twice the variance of one, and cov(column, d) = -sigma^2.
    """
    fuse = measurement_map("paper", 2, 1.0)[:, :3]  # of columns and row: uR, v, uL
    covariance = settings.pixel_sigma**2 * (fuse @ fuse.T)
    start = np.searchsorted(values[:, 0], numbers)
    end = np.searchsorted(values[:, 0], numbers, side="right")
    for number, a, b in zip(numbers.tolist(), start, end, strict=True):
        left, right, row = values[a:b, 2:5].T
        pixels = np.full((b - a, 3, 2), np.nan)
        pixels[:, 0] = np.column_stack([right, row])
        pixels[:, 1] = np.column_stack([left, row])
        measurement = np.column_stack([right, row, left - right])
        seen = measurement, np.tile(covariance, (b - a, 1, 1)), pixels
        yield number, number * FRAME_PERIOD_S, None, values[a:b, 1].astype(np.int64), seen


# --------------------------------------------------------------------------------------------
# Simulated measurements


SIMULATION_VERSION = 2
"""Part of the identity: raised whenever the same settings and seed give other measurements."""


def open_simulation(
    settings: SimulatedMeasurementsSettings, odometry: OdometrySettings, seed: int
) -> MeasurementRecording:
    """Simulates the drive.

    Raises:
        ConfigError: the drive cannot be driven, or the selection leaves no frame of it.
    """
    from fgslam.worlds.renderer import content_hash
    from fgslam.worlds.simulated_measurements import simulate_measurements

    simulated = simulate_measurements(settings, seed)
    notes = ["the measurements are simulated"]
    if settings.detection.noise_scale != 1.0:
        notes.append(f"noise drawn at {settings.detection.noise_scale:g} times what is stated")
    if settings.outlier_fraction:
        notes.append(f"{simulated.wrong_matches} matched observations are wrong")
    if (fault := settings.odometry_fault) is not None:
        notes.append(f"odometry off by a factor of {fault.scale:g} for {fault.frames} frames")
    if settings.blackout is not None:
        notes.append(f"cameras blocked for {settings.blackout.frames} frames")
    name = f"simulated measurements, {settings.drive.path.replace('_', ' ')}"
    of_settings = {"settings": asdict(settings), "seed": seed, "simulation": SIMULATION_VERSION}
    log = make_log(simulated.rig, list(simulated.increments), odometry)
    landmarks = LandmarkTruth(simulated.landmark_ids, simulated.landmark_positions)
    known = simulated.truth, landmarks, tuple(notes)
    return MeasurementRecording(name, content_hash(of_settings), log, *known)
