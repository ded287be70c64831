"""EuRoC MAV in its native (ASL) layout, rectified on reading (docs/datasets/euroc.md)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from fgslam.cameras.formats import read_asl_mounting
from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_lines
from fgslam.core.geometry import inverse
from fgslam.core.sensors import CameraRig, body_is_camera
from fgslam.datasets.calibrated import loaded_rig, mounted
from fgslam.datasets.gyroscope import recorded_gyroscope
from fgslam.datasets.images import (
    RawImages,
    StereoFiles,
    check_sizes,
    first_size,
    missing_notes,
    require_folder,
)
from fgslam.datasets.odometry import recorded_motions
from fgslam.datasets.pairing import NANOSECONDS, pair_stamps
from fgslam.datasets.recording import (
    OdometrySource,
    Recording,
    recording_identity,
    select_frames,
)
from fgslam.datasets.settings import EurocSettings, RecordedOdometrySettings
from fgslam.datasets.tables import (
    Table,
    poses_from_quaternions,
    read_table,
    require_increasing,
    require_unit_quaternions,
    trajectory_at_frames,
)

CAMERA_FOLDERS = ("cam0", "cam1")
_MAX_TRUTH_GAP_S = 0.1


_DEFAULT_LIMITS = RecordedOdometrySettings()


def open_euroc(
    settings: EurocSettings, odometry: RecordedOdometrySettings = _DEFAULT_LIMITS
) -> Recording:
    """Open a recording; ``settings.path`` is the folder mav0 or the one that holds it.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: a sensor.yaml is missing, not finite or impossible.
    """
    root = Path(settings.path)
    root = root / "mav0" if (root / "mav0").is_dir() else root
    folders = [root / name for name in CAMERA_FOLDERS]
    for folder in folders:
        require_folder(folder, "a stereo pair needs two cameras, but the folder")
    rig = _rig(settings, root, folders)
    right_folder, left_folder = (folders[k] for k in rig.sources)
    stamps, files, notes = _pairs(right_folder, left_folder, rig, settings)
    chosen = select_frames(len(stamps), settings)
    check_sizes(files, root)
    files, held = files.with_bits()
    return Recording(
        name=root.resolve().parent.name if root.name == "mav0" else root.resolve().name,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[chosen],
        identity=_identity(root, folders, files),
        ground_truth=_true_poses(root, rig, stamps[chosen]),
        notes=rig.remarks + held + notes + missing_notes(files, stamps),
        indices=chosen,
        load_images=RawImages(files, rig).load,
        load_colour=RawImages(files, rig).load_colour,
        odometry_source=_gyroscope(root, odometry),
    )


def _gyroscope(root: Path, settings: RecordedOdometrySettings) -> OdometrySource | None:
    """Turns by imu0, read when they are first needed; None where there is none."""
    path = root / "imu0" / "data.csv"
    if not path.is_file():
        return None
    own = root / "imu0" / "sensor.yaml"
    noise = next((p for p in (own, root.parent / "dso" / "imu_config.yaml") if p.is_file()), None)
    mounting = own if own.is_file() else None
    read = partial(recorded_gyroscope, path, mounting, noise, settings)
    return recorded_motions(str(path), read, settings)


def _rig(settings: EurocSettings, root: Path, folders: list[Path]) -> StereoRig:
    """By the file that is given, both sensor.yaml, or, as in TUM-VI, the camchain beside mav0."""
    given: tuple[Path, ...] = tuple(folder / "sensor.yaml" for folder in folders)
    chains = (root.parent / "dso" / "camchain.yaml", root.parent / "camchain.yaml")
    if settings.camera_file is not None:
        given = (Path(settings.camera_file),)
    elif not any(path.is_file() for path in given):
        given = next(((chain,) for chain in chains if chain.is_file()), ())
    if not given:
        raise CalibrationError(
            f"{root}: neither {folders[0].name}/sensor.yaml nor, as in TUM-VI, {chains[0]} is "
            "there; restore one, or give a calibration by --camera FILE"
        )
    size = first_size(read_camera_frames(folders[0]).paths)
    return mounted(loaded_rig(settings, *given, size=size), settings)


def _pairs(
    right_folder: Path, left_folder: Path, rig: StereoRig, settings: EurocSettings
) -> tuple[FloatArray, StereoFiles, tuple[str, ...]]:
    """Stamps (n,) in seconds of the right images, files of the pairs, and notes."""
    right, left = read_camera_frames(right_folder), read_camera_frames(left_folder)
    names = (str(right.paths[0].parent), str(left.paths[0].parent))
    tolerance = 1e-3 * settings.pairing_tolerance_ms
    (rows, partners), notes = pair_stamps(right.stamps, left.stamps, tolerance, names)
    paths = tuple((right.paths[i], left.paths[j]) for i, j in zip(rows, partners, strict=True))
    files = StereoFiles(paths, *rig.image_size)
    stamps = right.stamps[rows].astype(np.float64) * NANOSECONDS
    return stamps, files, notes


def _identity(root: Path, folders: list[Path], files: StereoFiles) -> str:
    sensors = [*folders, root / "imu0"]
    named = [folder / name for folder in sensors for name in ("sensor.yaml", "data.csv")]
    defining = [path for path in named if path.is_file()]
    images = [path for pair in files.paths for path in pair if path.is_file()]
    return recording_identity(defining, images)


def _true_poses(root: Path, rig: CameraRig, frames: FloatArray) -> Trajectory | None:
    """True poses of the rectified right camera, interpolated at the frames' stamps (n,)."""
    body = read_body_truth(root / "state_groundtruth_estimate0")
    if body is None and not body_is_camera(rig.bTc):  # TUM-VI tracks the gyroscope
        body = read_body_truth(root / "mocap0")
    if body is None:
        return None
    at_frames = trajectory_at_frames(body, frames, _MAX_TRUTH_GAP_S)
    return Trajectory(at_frames.timestamps, at_frames.poses @ rig.bTc)


# --------------------------------------------------------------------------------------------
# Files of the ASL layout: data.csv of a camera, data.csv and sensor.yaml of the truth


_TRUTH_COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrames:
    """Images listed in a camera's data.csv: stamps (n,) in nanoseconds, increasing, and files."""

    stamps: IntArray
    paths: tuple[Path, ...]


def read_camera_frames(folder: Path) -> CameraFrames:
    """Images that a camera's data.csv lists (``stamp in ns, file name``), under data/.

    Raises:
        DatasetError: the file is missing, empty or malformed, or stamps do not increase.
    """
    path = folder / "data.csv"
    stamps: list[int] = []
    paths: list[Path] = []
    for number, (line, text) in enumerate(read_lines(path)):
        words = [word.strip() for word in text.split(",")]
        if number == 0 and not any(digit in words[0] for digit in "0123456789"):
            continue  # names of columns
        if len(words) < 2 or not words[0].isdecimal() or not words[1]:
            raise DatasetError(
                f"{path}, line {line}: expected a stamp in whole nanoseconds and a file name; "
                "correct the line, or all stamps (seconds: times 1e9)"
            )
        if stamps and int(words[0]) <= stamps[-1]:
            raise DatasetError(
                f"{path}, line {line}: stamp {words[0]} does not come after {stamps[-1]}; put the "
                "lines in time order and remove duplicates"
            )
        stamps.append(int(words[0]))
        paths.append(folder / "data" / words[1])
    if not stamps:
        raise DatasetError(f"{path} lists no image; restore the file")
    found = np.array(stamps, np.int64)
    _require_nanoseconds(path, found)
    return CameraFrames(found, tuple(paths))


_FASTEST_NS = 1_000_000  # a thousand frames a second; in microseconds it is one


def _require_nanoseconds(path: Path, stamps: IntArray) -> None:
    """Raises DatasetError where stamps (n,) follow each other as no camera's nanoseconds do."""
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
    if step < _FASTEST_NS:
        raise DatasetError(
            f"{path}: as nanoseconds its stamps are {step:.0f} ns apart (median); are they micro- "
            "or milliseconds? multiply them, and those of all data.csv, by 1e3 or 1e6"
        )


def read_body_truth(folder: Path) -> Trajectory | None:
    """Body poses of ``state_groundtruth_estimate0`` or ``mocap0``, stamps in seconds; or None.

    The file gives the pose of its own sensor; sensor.yaml says where that sits on the body.

    Raises:
        DatasetError: the file is malformed, or its stamps do not increase.
        CalibrationError: its sensor.yaml is malformed.
    """
    path = folder / "data.csv"
    if not path.is_file():
        return None
    table = read_table(path, _TRUTH_COLUMNS, ",")
    require_increasing(table, table.column(0))
    stamps = table.column(0) * NANOSECONDS
    poses = _sensor_poses(table)
    if (folder / "sensor.yaml").is_file():
        mounting = folder / "sensor.yaml"
        poses = poses @ inverse(read_asl_mounting(mounting))
    return Trajectory(stamps, poses)


def _sensor_poses(table: Table) -> FloatArray:
    quaternions = table.values[:, [5, 6, 7, 4]]
    require_unit_quaternions(table, quaternions)
    return poses_from_quaternions(table.values[:, 1:4], quaternions)
