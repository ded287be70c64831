from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from dataset_builders import (
    EUROC_SIZE,
    PERIOD_NS,
    START_NS,
    curve,
    euroc,
    picture,
    save,
    sensor_yaml,
    write_euroc_truth,
)

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import load_rig, read_calibration_file
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError, FrameError
from fgslam.core.geometry import inverse, pose, project, se3_exp, so3_exp, transform_to_camera
from fgslam.core.log import ImageSequence
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import EurocSettings

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
    image = project(raw.rig, transform_to_camera(raw.rig.bTc, points))
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


def test_rectified_images_of_a_scene_agree_row_by_row(tmp_path: Path) -> None:
    """Bright points rendered into the raw images appear on one row, at the right disparity."""
    root = euroc(tmp_path, (LEFT, RIGHT), frames=1)
    cameras = dict(enumerate(read_calibration_file(root).cameras))
    point = np.array([[4.0, 0.1, -0.2]])
    for k, camera in cameras.items():
        column, row = seen_raw(camera, point)[0]
        x, y = np.meshgrid(np.arange(EUROC_SIZE[0]), np.arange(EUROC_SIZE[1]))
        blob = 250.0 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * 2.0**2))
        (path,) = (root / "mav0" / f"cam{k}" / "data").iterdir()
        save(path, np.round(blob).astype(np.uint8))
    recording = opened(root)
    centres = []
    for image in recording.frame(0).images:
        weight = image.astype(np.float64)
        y, x = np.indices(weight.shape)
        centres.append([(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()])
    expected = project(recording.rig, transform_to_camera(recording.rig.bTc, point))[0]
    (right, left) = centres
    assert left[1] - right[1] == pytest.approx(0.0, abs=0.05)
    assert left[0] - right[0] == pytest.approx(expected[2], abs=0.05)
    assert right == pytest.approx(expected[:2], abs=0.1)


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


def test_missing_image(tmp_path: Path) -> None:
    root = euroc(tmp_path, (LEFT, RIGHT))
    (root / "mav0" / "cam0" / "data" / f"{START_NS + PERIOD_NS}.png").unlink()
    recording = opened(root)
    assert recording.notes == ("1 of 4 frames lack an image: 1 (left)",)
    with pytest.raises(FrameError, match=r"cam0/data/.* cannot be read"):
        recording.frame(1)


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


def shifted_stamps(mav: Path) -> None:
    path = mav / "cam1" / "data.csv"
    path.write_text(path.read_text().replace("\n1403", "\n1503"))


ABOVE = pose(LEFT[:3, :3], LEFT[:3, 3] + [0.0, -0.01, 0.2])
SCALED = np.diag([1.1, 1.1, 1.1, 1.0]) @ LEFT
UPWARDS = pose(so3_exp(np.array([0.0, 1.2, 0.0])) @ AHEAD, LEFT[:3, 3])

BAD = [
    (mono, DatasetError, ["two cameras", "cam1", "does not exist"]),
    (text("cam0/sensor.yaml", "a: ["), CalibrationError, ["cam0/sensor.yaml", "not YAML"]),
    (text("cam0/sensor.yaml", "- 1"), CalibrationError, ["cam0/sensor.yaml", "keys and values"]),
    (
        changed_sensor(distortion_model="kb9"),
        CalibrationError,
        ["distortion_model kb9 is not known", "known: radial-tangential"],
    ),
    (
        changed_sensor(intrinsics=[float("nan"), 1.0, 2.0, 3.0]),
        CalibrationError,
        ["intrinsics", "nan", "4 finite numbers"],
    ),
    (changed_sensor(intrinsics=[0.0, 1.0, 2.0, 3.0]), CalibrationError, ["must be positive"]),
    (changed_sensor(resolution=[64]), CalibrationError, ["resolution", "2 finite numbers"]),
    (changed_sensor(resolution=[32, 24]), CalibrationError, ["32x24", "64x48", "one resolution"]),
    (changed_sensor(T_BS=7), CalibrationError, ["T_BS is 7", "16 finite numbers"]),
    (mounted(SCALED), CalibrationError, ["T_BS is not a rigid motion"]),
    (mounted(ABOVE), CalibrationError, ["not side by side", "check T_BS"]),
    (mounted(RIGHT), CalibrationError, ["are 0 mm apart, as one camera", "--unit"]),
    (mounted(UPWARDS), CalibrationError, ["45 degrees apart", "check T_BS"]),
    (text("cam0/data.csv", "#empty\n"), DatasetError, ["cam0/data.csv", "no image", "restore"]),
    (text("cam0/data.csv", "12.5,a.png\n"), DatasetError, ["line 1", "nanoseconds", "times 1e9"]),
    (text("cam0/data.csv", "1000,a.png\n51000,b.png\n"), DatasetError, ["50000 ns apart", "micro"]),
    (text("cam0/data.csv", "#\n20,a.png\n20,b.png\n"), DatasetError, ["line 3", "time order"]),
    (shifted_stamps, DatasetError, ["no image", "partner", "20 ms", "restore the stamps"]),
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
