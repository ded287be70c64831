"""EuRoC, KITTI odometry and KITTI raw in their native layouts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from dataset_builders import (
    CALIBRATION,
    EUROC_SIZE,
    HEIGHT,
    PERIOD_NS,
    START_NS,
    WIDTH,
    curve,
    euroc,
    kitti,
    picture,
    save,
    sensor_yaml,
    write_euroc_truth,
)
from scipy.spatial.transform import Rotation

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import load_rig, read_calibration_file
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError
from fgslam.core.geometry import inverse, pose, se3_exp, so3_exp, transform_to_camera
from fgslam.core.log import ImageSequence
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import EurocSettings, KittiRawSettings, KittiSettings
from fgslam.runs.bare import bare_experiment

# --------------------------------------------------------------------------------------------
# Euroc


# Two cameras that look along the body's x axis, slightly turned against each other, 11 cm apart.


AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


LEFT = pose(so3_exp(np.array([0.02, -0.01, 0.03])) @ AHEAD, np.array([0.1, 0.06, 0.02]))


RIGHT = pose(so3_exp(np.array([-0.01, 0.02, 0.035])) @ AHEAD, np.array([0.103, -0.05, 0.021]))


def opened(root: Path, **settings: object) -> Recording:
    return open_recording(EurocSettings(path=str(root), **settings))  # type: ignore[arg-type]


def seen_raw(camera: RawCamera, points: FloatArray) -> FloatArray:
    """Raw, distorted pixels (n, 2) of body points (n, 3)."""
    cTb = inverse(camera.bTc)
    vector, _ = cv2.Rodrigues(cTb[:3, :3])
    pixels, _ = cv2.projectPoints(
        points, vector, cTb[:3, 3], camera.matrix, np.asarray(camera.distortion)
    )
    return np.asarray(pixels[:, 0], np.float64)


def rectifier_of(root: Path) -> Rectifier:
    found = load_rig(root).rectifier
    assert found is not None
    return found


def sample(values: FloatArray, pixels: FloatArray) -> FloatArray:
    """Map values at real-valued (column, row) pixels (n, 2), bilinear."""
    columns, rows = (pixels[:, k].astype(np.float32)[:, None] for k in (0, 1))
    return np.asarray(cv2.remap(values, columns, rows, cv2.INTER_LINEAR)[:, 0], np.float64)


def test_rectified_pixels_look_where_the_raw_cameras_saw_the_points(tmp_path: Path) -> None:
    """Independent check of maps, intrinsics, baseline and mounting at once.

    A point of the world, projected by the rectified rig, must sample the raw images exactly at
    the pixels where the raw, distorted cameras saw it.
    """
    root = euroc(tmp_path, (LEFT, RIGHT))
    left, right = read_calibration_file(root).cameras
    raw = rectifier_of(root)
    rng = np.random.default_rng(7)
    points = np.column_stack(
        [rng.uniform(2, 9, 400), rng.uniform(-2, 2, 400), rng.uniform(-2, 2, 400)]
    )
    image = raw.rig.predict(transform_to_camera(raw.rig.bTc, points))
    inside = np.all((image[:, :2] > 2) & (image[:, :2] < np.array(EUROC_SIZE) - 3), axis=1)
    inside &= image[:, 0] + image[:, 2] < EUROC_SIZE[0] - 3
    points, image = points[inside], image[inside]
    assert len(points) > 100
    on_left = np.column_stack([image[:, 0] + image[:, 2], image[:, 1]])
    for camera, index, pixels in ((right, 0, image[:, :2]), (left, 1, on_left)):
        sampled = np.column_stack([sample(m, pixels) for m in raw.maps[index]])  # type: ignore[arg-type]
        np.testing.assert_allclose(sampled, seen_raw(camera, points), atol=0.03)


@pytest.mark.parametrize("swapped", [False, True])
def test_left_and_right_are_found_whatever_their_numbers(tmp_path: Path, swapped: bool) -> None:
    recording = opened(euroc(tmp_path, (RIGHT, LEFT) if swapped else (LEFT, RIGHT)))
    assert isinstance(recording, ImageSequence)
    assert recording.rig.baseline == pytest.approx(np.linalg.norm(LEFT[:3, 3] - RIGHT[:3, 3]))
    np.testing.assert_allclose(recording.rig.bTc[:3, 3], RIGHT[:3, 3], atol=1e-12)
    # Stamps are those of the right camera: cam1 is 1 ms late.
    late = 0 if swapped else 1_000_000
    expected = (START_NS + late + PERIOD_NS * np.arange(4)) * 1e-9
    np.testing.assert_allclose(recording.timestamps, expected, atol=1e-6)


def test_images_are_the_raw_ones_remapped(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    maps = rectifier_of(root).maps
    frame = opened(root).frame(2)
    for k, code in enumerate((52, 2)):
        expected = cv2.remap(picture(code, *EUROC_SIZE), *maps[k], cv2.INTER_LINEAR)
        np.testing.assert_array_equal(frame.images[k], expected)


def test_truth_is_interpolated_and_carried_to_the_rectified_right_camera(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    # The body turns and moves at constant rate; truth at 100 Hz, frames 1 ms off its stamps.
    twist = np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.3])
    offsets = np.arange(-2, 20) * 10_000_000

    def body(seconds: float) -> FloatArray:
        return pose(so3_exp(twist[:3] * seconds), twist[3:] * seconds)

    bTs = se3_exp(np.array([0.1, 0.2, -0.3, 0.05, 0.06, 0.07]))
    poses = np.array([body(1e-9 * t) @ bTs for t in offsets])
    write_euroc_truth(root, [START_NS + int(t) for t in offsets], poses, bTs)
    recording = opened(root)
    truth = recording.ground_truth
    assert truth is not None
    assert len(truth) == 4
    for k in range(4):
        expected = body(1e-9 * (k * PERIOD_NS + 1_000_000)) @ recording.rig.bTc
        np.testing.assert_allclose(truth.poses[k], expected, atol=2e-5)


def test_frames_beyond_the_truth_have_none(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    stamps = [START_NS + PERIOD_NS * k for k in range(3)]
    write_euroc_truth(root, stamps, curve(3), np.eye(4))
    truth = opened(root).ground_truth
    assert truth is not None
    # Frame 2 is 1 ms after the last true pose, within tolerance; frame 3 is 51 ms after it.
    assert len(truth) == 3


def test_images_without_partner_are_left_out_and_noted(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    path = root / "mav0" / "cam0" / "data.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], *lines[3:]]))
    recording = opened(root)
    assert len(recording) == 3
    assert recording.notes == ("1 right images have no partner within 20 ms and are left out",)
    assert recording.frame(1).index == 1
    np.testing.assert_allclose(np.diff(recording.timestamps), [0.1, 0.05], atol=1e-6)


def test_names_of_columns_need_no_hash(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    before = opened(root).timestamps
    for camera in ("cam0", "cam1"):
        path = root / "mav0" / camera / "data.csv"
        path.write_text(path.read_text().replace("#timestamp", "timestamp"), newline="\r\n")
    np.testing.assert_array_equal(opened(root).timestamps, before)


def test_path_may_be_mav0_itself(tmp_path: Path) -> None:
    root = euroc(tmp_path / "V1_01", (LEFT, RIGHT))
    assert opened(root / "mav0").identity == opened(root).identity
    assert opened(root / "mav0").name == opened(root).name == "V1_01"


def changed_sensor(**changes: object) -> object:
    def spoil(mav: Path) -> None:
        values = {**sensor_yaml(LEFT), **changes}
        (mav / "cam0" / "sensor.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")

    return spoil


def mounted(bTc: FloatArray) -> object:
    return changed_sensor(T_BS={"data": bTc.ravel().tolist()})


def text(name: str, content: str) -> object:
    return lambda mav: (mav / name).write_text(content, encoding="utf-8")


def mono(mav: Path) -> None:
    (mav / "cam1").rename(mav / "camera1")


def scattered_stamps(mav: Path) -> None:
    path = mav / "cam1" / "data.csv"
    head, *rows = path.read_text().splitlines()
    rows = [f"{1503 * 10**15 + k**2 * 10**10},{r.partition(',')[2]}" for k, r in enumerate(rows)]
    path.write_text("\n".join([head, *rows]))


ABOVE = pose(LEFT[:3, :3], LEFT[:3, 3] + [0.0, -0.01, 0.2])


SCALED = np.diag([1.1, 1.1, 1.1, 1.0]) @ LEFT


UPWARDS = pose(so3_exp(np.array([0.0, 1.2, 0.0])) @ AHEAD, LEFT[:3, 3])


BAD = [
    (mono, DatasetError, ["two cameras", "cam1", "does not exist"]),
    (text("cam0/sensor.yaml", "a: ["), CalibrationError, ["cam0/sensor.yaml", "not YAML"]),
    (
        changed_sensor(distortion_model="kb9"),
        CalibrationError,
        ["distortion_model kb9 is not known", "known: radtan"],
    ),
    (
        changed_sensor(intrinsics=[float("nan"), 1.0, 2.0, 3.0]),
        CalibrationError,
        ["intrinsics", "nan", "4 finite numbers"],
    ),
    (changed_sensor(intrinsics=[0.0, 1.0, 2.0, 3.0]), CalibrationError, ["must be positive"]),
    (changed_sensor(resolution=[32, 24]), CalibrationError, ["32x24", "64x48", "one resolution"]),
    (mounted(SCALED), CalibrationError, ["T_BS is not a rigid motion"]),
    (mounted(ABOVE), CalibrationError, ["not side by side", "check T_BS"]),
    (mounted(RIGHT), CalibrationError, ["are 0 mm apart, as one camera", "--unit"]),
    (mounted(UPWARDS), CalibrationError, ["45 degrees apart", "check T_BS"]),
    (text("cam0/data.csv", "#empty\n"), DatasetError, ["cam0/data.csv", "no image", "restore"]),
    (text("cam0/data.csv", "12.5,a.png\n"), DatasetError, ["line 1", "nanoseconds", "times 1e9"]),
    (text("cam0/data.csv", "1000,a.png\n51000,b.png\n"), DatasetError, ["50000 ns apart", "micro"]),
    (scattered_stamps, DatasetError, ["no image", "partner", "20 ms", "no constant offset"]),
]


def test_tum_vi_has_its_calibration_in_a_camchain_beside(tmp_path: Path) -> None:
    """Wide lenses, no sensor.yaml, images of 16 bits."""
    root = euroc(tmp_path, (LEFT, RIGHT))
    native = opened(root)
    chain = {}
    for k, camera in enumerate(("cam0", "cam1")):
        (root / "mav0" / camera / "sensor.yaml").unlink()
        chain[camera] = {
            "camera_model": "pinhole",
            "intrinsics": [30.0, 30.0, 31.5, 23.5],
            "distortion_model": "equidistant",
            "distortion_coeffs": [0.003, 0.0007, -0.0002, 0.00002],
            "resolution": list(EUROC_SIZE),
        }
        for path in (root / "mav0" / camera / "data").iterdir():
            save(path, picture(50 * k, *EUROC_SIZE).astype(np.uint16) << 8)
    step = np.eye(4)
    step[0, 3] = -0.101
    chain["cam1"]["T_cn_cnm1"] = step.tolist()
    with pytest.raises(CalibrationError):
        opened(root)
    (root / "dso").mkdir()
    (root / "dso" / "camchain.yaml").write_text(yaml.safe_dump(chain), encoding="utf-8")
    recording = opened(root)
    assert recording.rig.baseline == pytest.approx(0.101, abs=1e-9)
    assert np.array_equal(recording.timestamps, native.timestamps)
    assert recording.frame(0).images[0].dtype == np.uint8
    given = opened(root, camera_file=str(root / "dso" / "camchain.yaml"))
    assert given.rig.fx == recording.rig.fx


@pytest.mark.parametrize(("spoil", "error", "words"), BAD)
def test_bad_recording_is_refused_in_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: list[str]
) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    opened(root)
    spoil(root / "mav0")  # type: ignore[operator]
    with pytest.raises(error) as raised:
        opened(root)
    assert type(raised.value) is error
    assert "\n" not in str(raised.value)
    for part in words:
        assert part in str(raised.value)


# --------------------------------------------------------------------------------------------
# Kitti


def kitti_opened(root: Path, **settings: object) -> Recording:
    return open_recording(KittiSettings(path=str(root), **{"sequence": "06", **settings}))  # type: ignore[arg-type]


def test_native_layout(tmp_path: Path) -> None:
    root, left = kitti(tmp_path)
    recording = kitti_opened(root)
    assert isinstance(recording, ImageSequence)
    assert recording.name == "KITTI 06"
    assert [int(image[0, 0]) for image in recording.frame(3).images] == [13, 63]
    rig = recording.rig
    assert (rig.width, rig.height, rig.fx, rig.fy, rig.cx, rig.cy) == (32, 24, 30, 31, 15.5, 11.5)
    assert rig.baseline == pytest.approx(0.4)
    assert rig.cameras == 2
    np.testing.assert_allclose(recording.timestamps, 0.1 * np.arange(5))
    assert recording.ground_truth is not None
    offsets = np.linalg.inv(left) @ recording.ground_truth.poses
    np.testing.assert_allclose(offsets[:, :3, 3], np.tile([0.4, 0.0, 0.0], (5, 1)), atol=1e-8)
    assert recording.odometry(1) is None
    assert recording.notes == ()


@pytest.mark.parametrize("half_of_grey", [False, True])
def test_colour_cameras_have_lines_and_a_place_of_their_own(
    tmp_path: Path, half_of_grey: bool
) -> None:
    root, left = kitti(tmp_path)
    folder = root / "sequences" / "06"
    for grey, colour in (("image_0", "image_2"), ("image_1", "image_3")):
        (folder / grey).rename(folder / colour)
    if half_of_grey:
        (folder / "image_1").mkdir()
    with (folder / "calib.txt").open("a", encoding="utf-8") as file:
        for key, shift in (("P2", 1.5), ("P3", -13.5)):
            file.write(f"{key}: 30.0 0 15.5 {shift} 0 31.0 11.5 0 0 0 1 0\n")
    recording = kitti_opened(root)
    assert recording.rig.baseline == pytest.approx(0.5)
    assert [int(image[0, 0]) for image in recording.frame(3).images] == [13, 63]
    assert recording.ground_truth is not None
    offsets = np.linalg.inv(left) @ recording.ground_truth.poses
    np.testing.assert_allclose(offsets[:, :3, 3], np.tile([0.45, 0.0, 0.0], (5, 1)), atol=1e-8)


def replaced(name: str, old: str, new: str) -> object:
    def spoil(folder: Path) -> None:
        path = folder / name
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")

    return spoil


def kitti_mono(folder: Path) -> None:
    (folder / "image_1").rename(folder / "image_7")


def other_size(folder: Path) -> None:
    for k in range(5):
        save(folder / "image_1" / f"{k:06d}.png", picture(k, 16, 12))


KITTI_BAD = [
    (kitti_mono, DatasetError, ["no image_1/", "both grey cameras", "unpack"]),
    (other_size, DatasetError, ["differ in size", "right 16x12", "left 32x24"]),
    (replaced("calib.txt", "P1:", "P9:"), CalibrationError, ["calib.txt", "P1 is missing"]),
    (replaced("calib.txt", "-12.0", "nan"), CalibrationError, ["calib.txt: P1 is", "12 finite"]),
    (replaced("calib.txt", "-12.0", "12.0"), CalibrationError, ["baseline is -0.4", "swapped"]),
    (
        replaced("calib.txt", "P1: 30.0", "P1: 33.0"),
        CalibrationError,
        ["P0 and P1", "not rectified"],
    ),
    (replaced("../../poses/06.txt", "e", "x"), DatasetError, ["06.txt, line 1", "not a number"]),
]


@pytest.mark.parametrize(("spoil", "error", "words"), KITTI_BAD)
def test_kitti_bad_recording_is_refused_in_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: list[str]
) -> None:
    root, _ = kitti(tmp_path)
    kitti_opened(root)
    spoil(root / "sequences" / "06")  # type: ignore[operator]
    with pytest.raises(error) as raised:
        kitti_opened(root)
    assert "\n" not in str(raised.value)
    for part in words:
        assert part in str(raised.value)


def test_absent_sequence(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    with pytest.raises(DatasetError, match="sequences/07 does not exist"):
        kitti_opened(root, sequence="07")


def test_too_few_poses(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    path = root / "poses" / "06.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:3]), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"has 3 poses but times.txt has 5 frames; restore"):
        kitti_opened(root)


def test_pose_that_is_no_rotation_names_the_line(tmp_path: Path) -> None:
    root, left = kitti(tmp_path)
    left[2, :3, :3] *= 2.0
    np.savetxt(root / "poses" / "06.txt", left[:, :3].reshape(5, 12))
    with pytest.raises(DatasetError, match=r"06\.txt, line 3: not a rotation"):
        kitti_opened(root)


# --------------------------------------------------------------------------------------------
# Oxts


FRAMES, PERIOD = 12, 0.1


SPEED, TURN = 8.0, 0.4  # m/s, rad/s to the left


RADIUS = 6_378_137.0


TO_SCANNER = pose(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([-0.81, 0.32, -0.80]))


AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


TO_CAMERA = pose(AXES @ so3_exp(np.array([0.0, 0.01, 0.0])), np.array([0.0, -0.08, -0.27]))


UPRIGHT = pose(so3_exp(np.array([0.004, 0.007, -0.01])), np.zeros(3))


def driven(times: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of the unit in a circle, tilted, from a heading of 0.7."""
    yaw = 0.7 + TURN * times
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    angles = np.column_stack([yaw, np.full_like(yaw, 0.03), np.full_like(yaw, -0.02)])
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    radius = SPEED / TURN
    poses[:, 0, 3] = radius * (np.sin(yaw) - np.sin(0.7))
    poses[:, 1, 3] = radius * (np.cos(0.7) - np.cos(yaw))
    return poses


def row(wTi: FloatArray) -> str:
    """The numbers of a moment; places by the inverse of Mercator's projection at 49 degrees."""
    latitude = np.radians(49.0)
    scale = np.cos(latitude) * RADIUS
    north = np.log(np.tan(0.25 * np.pi + 0.5 * latitude)) + wTi[1, 3] / scale
    yaw, pitch, roll = Rotation.from_matrix(wTi[:3, :3]).as_euler("ZYX")
    values = np.zeros(30)
    values[0] = np.degrees(2.0 * np.arctan(np.exp(north)) - 0.5 * np.pi)
    values[1] = 8.0 + np.degrees(wTi[0, 3] / scale)
    values[2] = 110.0 + wTi[2, 3]
    values[3:6] = roll, pitch, yaw
    values[8], values[22] = SPEED, TURN
    return " ".join(f"{v:.15g}" for v in values)


def stamps(times: FloatArray) -> str:
    return "".join(f"2011-09-26 13:02:{5.0 + t:013.10f}\n" for t in times)


def motion(path: Path, aTb: FloatArray) -> None:
    words = " ".join(f"{v:.12g}" for v in aTb[:3, :3].ravel())
    place = " ".join(f"{v:.12g}" for v in aTb[:3, 3])
    path.write_text(f"calib_time: 1-Jan-2012 00:00:00\nR: {words}\nT: {place}\n", encoding="utf-8")


def drive(root: Path) -> Path:
    date = root / "2011_09_26"
    out = date / "2011_09_26_drive_0005_sync"
    frames = PERIOD * np.arange(FRAMES)
    for number, code in (("00", 60), ("01", 10)):
        for k in range(FRAMES):
            save(out / f"image_{number}" / "data" / f"{k:010d}.png", picture(code + k))
        text = stamps(frames + 0.01)
        (out / f"image_{number}" / "timestamps.txt").write_text(text, encoding="utf-8")
    data = out / "oxts" / "data"
    data.mkdir(parents=True)
    for k, wTi in enumerate(driven(frames)):
        (data / f"{k:010d}.txt").write_text(row(wTi), encoding="utf-8")
    (out / "oxts" / "timestamps.txt").write_text(stamps(frames), encoding="utf-8")
    focal = CALIBRATION["fx"]
    upright = " ".join(f"{v:.12g}" for v in UPRIGHT[:3, :3].ravel())
    lines = [f"R_rect_00: {upright}"]
    for number, shift in (("00", 0.0), ("01", -0.4 * focal)):
        lines.append(f"S_rect_{number}: {WIDTH} {HEIGHT}")
        lines.append(f"P_rect_{number}: {focal} 0 15.5 {shift} 0 {focal} 11.5 0 0 0 1 0")
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines), encoding="utf-8")
    motion(date / "calib_imu_to_velo.txt", TO_SCANNER)
    motion(date / "calib_velo_to_cam.txt", TO_CAMERA)
    return out


def oxts_opened(path: Path) -> Recording:
    return open_recording(KittiRawSettings(path=str(path)))


def test_oxts_are_odometry_and_truth_of_the_camera(tmp_path: Path) -> None:
    path = drive(tmp_path)
    recording = oxts_opened(path)
    right = pose(np.eye(3), np.array([0.4, 0.0, 0.0]))
    iTc = inverse(UPRIGHT @ TO_CAMERA @ TO_SCANNER) @ right
    np.testing.assert_allclose(recording.rig.bTc, iTc, rtol=0.0, atol=1e-9)
    truth = recording.ground_truth
    assert truth is not None
    # The last image is 10 ms after the last row: it has none.
    assert len(truth) == FRAMES - 1
    expected = driven(PERIOD * np.arange(FRAMES - 1) + 0.01) @ iTc
    expected = inverse(expected[0]) @ expected
    found = inverse(truth.poses[0]) @ truth.poses
    # Poses between rows are interpolated: a chord of 0.8 m is 2 mm off the circle.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=3e-3)
    step = recording.odometry(3)
    assert step is not None
    assert np.linalg.norm(step.motion[:3, 3]) == pytest.approx(SPEED * PERIOD, abs=1e-3)
    assert np.arctan2(step.motion[1, 0], step.motion[0, 0]) == pytest.approx(0.04, abs=1e-6)
    assert "; odometry; truth, for evaluation only" in bare_experiment(path).description


def test_without_its_place_on_the_car_it_is_odometry_alone(tmp_path: Path) -> None:
    path = drive(tmp_path)
    (path.parent / "calib_imu_to_velo.txt").unlink()
    recording = oxts_opened(path)
    assert recording.ground_truth is None
    assert recording.odometry(1) is not None
    assert "and not as truth: next to calib_cam_to_cam.txt there are no" in recording.notes[-1]


def cut(path: Path) -> None:
    file = path / "oxts" / "data" / "0000000003.txt"
    file.write_text(file.read_text(encoding="utf-8")[:40], encoding="utf-8")


def no_times(path: Path) -> None:
    (path / "oxts" / "timestamps.txt").unlink()


def turned(path: Path) -> None:
    (path.parent / "calib_velo_to_cam.txt").write_text("R: 1 0 0\nT: 0 0 0\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("spoil", "error", "words"),
    [
        (cut, DatasetError, r"0000000003\.txt: expected 30 numbers; restore"),
        (no_times, DatasetError, r"oxts has no timestamps\.txt; restore it"),
        (turned, CalibrationError, "R is .*, expected 9 finite numbers"),
    ],
)
def test_bad_inertial_data_are_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: str
) -> None:
    path = drive(tmp_path)
    spoil(path)  # type: ignore[operator]
    with pytest.raises(error, match=words) as raised:
        oxts_opened(path)
    assert "\n" not in str(raised.value)
