"""Published data sets in their native layouts: EuRoC, KITTI odometry, KITTI raw.

docs/datasets/published.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.formats import (
    KITTI_RAW,
    KITTI_RAW_COLOUR,
    left_on_inertial_unit,
    pair_beside,
    read_asl_mounting,
    read_kitti,
    right_of_camera_0,
)
from fgslam.cameras.rig import StereoRig, load_rig
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.files import read_text, shown_in
from fgslam.core.geometry import inverse, pose, right_from_left_camera
from fgslam.core.sensors import body_is_camera
from fgslam.core.types import Trajectory
from fgslam.datasets.images import first_size, list_numbered_images, open_frames, require_folder
from fgslam.datasets.layouts import CameraFiles, images_in, kitti_raw_drive, natural
from fgslam.datasets.ledger import IMAGES, TIMES, Entry
from fgslam.datasets.odometry import SPEED_COLUMNS, gyroscope_odometry, motions_of, recorded_motions
from fgslam.datasets.recording import (
    Recording,
    image_recording,
    loaded_rig,
    mounted,
    numbered_frames,
    read_rig,
    with_truth,
)
from fgslam.datasets.settings import (
    EurocSettings,
    KittiRawSettings,
    KittiSettings,
    RecordedOdometrySettings,
)
from fgslam.datasets.times import (
    NANOSECONDS,
    Table,
    listed_files,
    named_unit,
    pair_files,
    pair_stamps,
    poses_of,
    read_table,
    require_increasing,
    stamps_of,
    written_stamps,
)

# --------------------------------------------------------------------------------------------
# EuRoC MAV (ASL layout), rectified on reading


_CAMERAS = ("cam0", "cam1")
_TRUTH_COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
_FASTEST_NS = 1_000_000  # a thousand frames a second; in microseconds it is one


def open_euroc(settings: EurocSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open a recording; ``settings.path`` is the folder mav0 or the one that holds it.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: a sensor.yaml is missing, not finite or impossible.
    """
    root = Path(settings.path)
    root = root / "mav0" if (root / "mav0").is_dir() else root
    folders = [root / name for name in _CAMERAS]
    for folder in folders:
        require_folder(folder, "a stereo pair needs two cameras, but the folder")
    cameras = [read_camera_frames(folder) for folder in folders]
    # By the file that is given, both sensor.yaml, or, as in TUM-VI, the camchain next to mav0.
    files: tuple[Path, ...] = tuple(folder / "sensor.yaml" for folder in folders)
    chains = (root.parent / "dso" / "camchain.yaml", root.parent / "camchain.yaml")
    if settings.camera_file is not None:
        files = (Path(settings.camera_file),)
    elif not any(path.is_file() for path in files):
        files = next(((chain,) for chain in chains if chain.is_file()), ())
    if not files:
        raise CalibrationError(
            f"{root}: neither {_CAMERAS[0]}/sensor.yaml nor, as in TUM-VI, {chains[0]} is "
            "there; restore one, or give a calibration by --camera FILE"
        )
    rig = mounted(loaded_rig(settings, *files, size=first_size(cameras[0][1])), settings)
    (at_right, right), (at_left, left) = (cameras[k] for k in rig.sources[:2])
    others = [("left", str(left[0].parent), at_left)]
    rows, paired, pairing = pair_stamps(at_right, others, str(right[0].parent))
    paths = [(right[i], left[j]) for i, j in rows.tolist()]
    images, noticed = open_frames(paths, rig, root)
    sensors = [*folders, root / "imu0"]
    defining = [folder / name for folder in sensors for name in ("sensor.yaml", "data.csv")]
    gyroscope, own = root / "imu0" / "data.csv", root / "imu0" / "sensor.yaml"
    source = None
    if gyroscope.is_file():
        of_noise = (own, root.parent / "dso" / "imu_config.yaml")
        noise = next((path for path in of_noise if path.is_file()), None)
        source = gyroscope_odometry(gyroscope, own if own.is_file() else None, noise, odometry)
    name = root.resolve().parent.name if root.name == "mav0" else root.resolve().name
    stamps = at_right[rows[:, 0]].astype(np.float64) * NANOSECONDS
    identity = (
        [path for path in defining if path.is_file()],
        [path for pair in paths for path in pair if path.is_file()],
    )
    sides = Entry(IMAGES, f"{right[0].parent.parent.name} is right", "their poses (T_BS)")
    ledger = (sides, Entry(TIMES, "stamps", "data.csv"), pairing)
    recording = image_recording(
        settings, name, rig, stamps, images, identity, (*noticed, *paired), ledger,
        odometry_source=source,
    )  # fmt: skip
    places = ("state_groundtruth_estimate0", "mocap0")  # TUM-VI tracks the gyroscope
    for place in places[: 1 if body_is_camera(rig.bTc) else 2]:
        if (body := read_body_truth(root / place)) is not None:
            return with_truth(recording, body, root / place / "data.csv", stamps)
    return recording


def read_camera_frames(folder: Path) -> tuple[IntArray, list[Path]]:
    """Increasing stamps (n,) in nanoseconds and files, under data/, that a camera's data.csv lists.

    Raises:
        DatasetError: the file is missing, empty or malformed, or stamps do not increase.
    """
    path = folder / "data.csv"
    found, paths = listed_files(path, folder / "data", ",")
    step = float(np.median(np.diff(found))) if len(found) > 1 else np.inf
    if step < _FASTEST_NS:
        raise DatasetError(
            f"{path}: as nanoseconds its stamps are {step:.0f} ns apart (median); are they micro- "
            "or milliseconds? multiply them, and those of all data.csv, by 1e3 or 1e6"
        )
    return found, paths


def read_body_truth(folder: Path) -> Trajectory | None:
    """Poses of the body by data.csv, those of the sensor and sensor.yaml; None where absent.

    Without sensor.yaml the sensor is the body.

    Raises:
        DatasetError: the file is malformed, or its stamps do not increase.
        CalibrationError: its sensor.yaml is malformed.
    """
    path = folder / "data.csv"
    if not path.is_file():
        return None
    table = read_table(path, _TRUTH_COLUMNS, ",")
    require_increasing(table, table.values[:, 0])
    poses = poses_of(table, table.values[:, 1:4], table.values[:, [5, 6, 7, 4]])
    if (folder / "sensor.yaml").is_file():
        poses = poses @ inverse(read_asl_mounting(folder / "sensor.yaml"))
    return Trajectory(table.values[:, 0] * NANOSECONDS, poses, "body")


# --------------------------------------------------------------------------------------------
# KITTI odometry: sequences/NN/{image_0,image_1,calib.txt,times.txt}, poses/NN.txt of camera 0, the
# left one; or the colour pair image_2 and image_3


_POSE_COLUMNS = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


def open_kitti(settings: KittiSettings, _: RecordedOdometrySettings) -> Recording:
    """Open one drive; ``settings.path`` is the folder that holds sequences/ and poses/.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: calib.txt is missing, malformed or impossible.
    """
    folder = Path(settings.path) / "sequences" / settings.sequence
    require_folder(folder, "the KITTI sequence")
    calibration, times = folder / "calib.txt", folder / "times.txt"
    pair = pair_beside(calibration)
    if pair is None:
        lacking = next(name for name in ("image_1", "image_0") if not (folder / name).is_dir())
        raise DatasetError(
            f"{folder} has no {lacking}/: unpack both grey cameras (image_0 left, image_1 "
            "right), or both colour cameras (image_2 left, image_3 right), there"
        )
    sides = (folder / f"image_{pair[1]}", folder / f"image_{pair[0]}")
    cameras = {side: list_numbered_images(side) for side in sides}
    table = read_table(times, ("time",))
    require_increasing(table, table.values[:, 0])
    unit, timed = named_unit(table.values[:, 0], str(times))
    stamps = unit * table.values[:, 0]
    paths, listed, ledger = numbered_frames(cameras, range(len(stamps)), times)
    size = first_size(frame[0] for frame in paths)  # which calib.txt does not state
    if size is None:
        raise DatasetError(
            f"{folder}: no frame of times.txt has a readable image of both; unpack it again"
        )
    rig = load_rig(calibration, size=size)
    images, noticed = open_frames(paths, rig, folder)
    noticed = (*timed, *noticed)
    name, files = f"KITTI {settings.sequence}", ([calibration, times], listed)
    recording = image_recording(settings, name, rig, stamps, images, files, noticed, ledger)
    poses = _kitti_poses(Path(settings.path) / "poses" / f"{settings.sequence}.txt", len(stamps))
    if poses is None:
        return recording
    poses = right_from_left_camera(poses[recording.indices], right_of_camera_0(calibration))
    return replace(recording, ground_truth=Trajectory(recording.timestamps, poses))


def _kitti_poses(path: Path, frames: int) -> FloatArray | None:
    """Left-camera poses (n, 4, 4) of poses/NN.txt, or None where there is no such file."""
    if not path.is_file():
        return None
    table = read_table(path, _POSE_COLUMNS)
    if len(table) != frames:
        raise DatasetError(
            f"{path} has {len(table)} poses but times.txt has {frames} frames; restore the file "
            "that belongs to this sequence"
        )
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :] = table.values.reshape(-1, 3, 4)
    skewed = np.abs(np.linalg.det(poses[:, :3, :3]) - 1.0) > 1e-2
    if skewed.any():
        line = table.lines[int(np.argmax(skewed))]
        raise DatasetError(f"{path}, line {line}: not a rotation and translation; restore the file")
    return poses


# --------------------------------------------------------------------------------------------
# KITTI raw: a synchronised and rectified drive


CALIBRATION = "calib_cam_to_cam.txt"
_OF_360 = Path("calibration", "perspective.txt")  # of KITTI-360
_INSIDE = ("data", "data_rect")
_PAIRS = (("image_00", "image_01"), ("image_02", "image_03"))
"""Folders of the left and the right camera: grey, else colour."""

_MAX_TRUTH_GAP_S = 0.25  # synchronised drives have a row a frame, every 0.1 s


def open_kitti_raw(settings: KittiRawSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open a drive; ``settings.path`` is its folder, or that of a date with one drive in it.

    Raises:
        DatasetError: a folder or list of times is missing or malformed, or no frame is left.
        CalibrationError: calib_cam_to_cam.txt is missing or of other images.
    """
    drive = kitti_raw_drive(Path(settings.path))
    if drive is None:
        raise DatasetError(f"{settings.path} holds no drive of KITTI raw; check dataset.path")
    names = next((pair for pair in _PAIRS if all(_raw_images(drive / n) for n in pair)), None)
    if names is None:
        raise DatasetError(
            f"{drive} has no two cameras' images (image_00 and image_01, or image_02 and image_03, "
            "each with data/ or data_rect/); unpack the drive's synced and rectified data"
        )
    left, right = (_raw_images(drive / name) for name in names)
    pairs, unpaired, pairing = pair_files(CameraFiles(left, right, drive, interleaved=False))
    stamps, assumed, lists, timing = stamps_of(
        [path for path, _ in pairs], (drive / names[1],), None, right
    )
    rig, iTc = _raw_rig(settings, drive, names, first_size(right))
    of_unit = read_oxts(drive)
    untrue = (
        "oxts is used as odometry of a camera that points ahead, and not as truth: next to "
        f"{CALIBRATION} there are no calib_imu_to_velo.txt and calib_velo_to_cam.txt"
    )
    images, noticed = open_frames(pairs, rig, drive)
    notes = (*noticed, *unpaired, *assumed, *([untrue] if of_unit and iTc is None else []))
    files = lists, (path for pair in pairs for path in pair)
    name, source = drive.resolve().name, None
    if of_unit is not None:
        truth, speeds = of_unit
        source = recorded_motions(lambda: motions_of(speeds, odometry))
    ledger = Entry(IMAGES, f"{names[1]} is right", "names of folders"), timing, pairing
    recording = image_recording(
        settings, name, rig, stamps, images, files, notes, ledger, odometry_source=source
    )
    if of_unit is None or iTc is None:
        return recording
    path, known = drive / "oxts", replace(truth, frame="body")
    if not np.array_equal(rig.bTc, iTc):  # settings have the odometry's body elsewhere
        known = Trajectory(truth.timestamps, truth.poses @ iTc).of("left", rig)
    return with_truth(recording, known, path, stamps, _MAX_TRUTH_GAP_S)


def _raw_images(camera: Path) -> tuple[Path, ...]:
    inside = next((camera / name for name in _INSIDE if (camera / name).is_dir()), None)
    return () if inside is None else tuple(images_in(inside))


def _raw_rig(
    settings: KittiRawSettings, drive: Path, names: tuple[str, str], size: tuple[int, int] | None
) -> tuple[StereoRig, FloatArray | None]:
    """The rig, and the pose (4, 4) of the right camera on the inertial unit where it is known."""
    root = drive.resolve().parent
    places = (drive / CALIBRATION, root / CALIBRATION, root / _OF_360, root.parent / _OF_360)
    path = next((p for p in places if p.is_file()), None)
    keys = KITTI_RAW if names == _PAIRS[0] else KITTI_RAW_COLOUR
    if settings.camera_file is not None:
        rig = loaded_rig(settings, Path(settings.camera_file), size=size)
    elif path is None:
        raise CalibrationError(
            f"{drive}: no {CALIBRATION} in it or next to it; unpack the calibration of that date, "
            "or give one by --camera FILE"
        )
    else:
        rig = read_rig(settings, read_kitti(path, size, keys), size)
    iTl = None if path is None else left_on_inertial_unit(path, keys)
    if iTl is None:
        return mounted(rig, settings), None
    iTc = iTl @ pose(np.eye(3), np.array([rig.baseline, 0.0, 0.0]))
    return mounted(replace(rig, bTc=iTc), settings), iTc


# GPS and inertial data, oxts/: odometry and true poses of the inertial unit (Geiger et al. 2013,
# "Vision meets robotics", and its development kit)


_LATITUDE, _LONGITUDE, _ALTITUDE, _ROLL, _PITCH, _YAW = range(6)
_FORWARD_SPEED, _YAW_RATE = 8, 22
_COLUMNS = 23  # of those that are used; a file has 30
_EARTH_RADIUS_M = 6_378_137.0


def read_oxts(drive: Path) -> tuple[Trajectory, Table] | None:
    """Poses of a drive's inertial unit, and a table of its speeds; None where it has none.

    The unit's axes are x ahead, y left, z up; the world's x points east.

    Raises:
        DatasetError: a file or the list of times is malformed.
    """
    folder = drive / "oxts"
    files = shown_in(folder / "data") if (folder / "data").is_dir() else []
    files = sorted((p for p in files if p.suffix == ".txt"), key=natural)
    if not files:
        return None
    found = written_stamps(files, (folder,)) if (folder / "timestamps.txt").is_file() else None
    if found is None:
        raise DatasetError(f"{folder} has no timestamps.txt; restore it, or remove the folder")
    values = []
    for path in files:
        try:
            row = [float(word) for word in read_text(path, DatasetError).split()[:_COLUMNS]]
        except ValueError:
            row = []
        if len(row) < _COLUMNS or not np.isfinite(row).all():
            raise DatasetError(f"{path}: expected 30 numbers; restore the file")
        values.append(row)
    rows = np.array(values)
    from scipy.spatial.transform import Rotation

    latitude, longitude = np.radians(rows[:, [_LATITUDE, _LONGITUDE]]).T
    scale = np.cos(latitude[0]) * _EARTH_RADIUS_M  # of the Mercator projection
    north = np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    where = np.column_stack([scale * longitude, scale * north, rows[:, _ALTITUDE]])
    turns = Rotation.from_euler("ZYX", rows[:, [_YAW, _PITCH, _ROLL]]).as_matrix()
    speeds = np.column_stack([found[0], rows[:, [_FORWARD_SPEED, _YAW_RATE]]])
    table = Table(folder, speeds, np.arange(1, len(rows) + 1), SPEED_COLUMNS)
    return Trajectory(found[0], pose(turns, where - where[0])), table
