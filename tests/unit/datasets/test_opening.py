"""Recordings opened by their settings, and with smaller or larger images."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import stereo, write_bag
from dataset_builders import (
    CALIBRATION,
    EUROC_SIZE,
    HEIGHT,
    WIDTH,
    euroc,
    image_folder,
    picture,
    save,
    write_calibration,
)
from pydantic import TypeAdapter, ValidationError

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import load_rig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, FgslamError, FrameError
from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig
from fgslam.datasets.opening import fit_notes, open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import (
    EurocSettings,
    ImageFolderSettings,
    OdometrySettings,
    RecordedOdometrySettings,
)
from fgslam.runs.bare import bare_experiment
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.opening import open_sequence

# --------------------------------------------------------------------------------------------
# Opening


AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def two_folders(root: Path) -> Path:
    return of_images(root, "left/{}.png", "right/{}.png")


def one_folder(root: Path) -> Path:
    return of_images(root, "{}_left.png", "{}_right.png")


def of_images(root: Path, left: str, right: str) -> Path:
    for k in range(3):
        save(root / left.format(k), picture(60 + k))
        save(root / right.format(k), picture(10 + k))
    write_calibration(root)
    return root


def films(root: Path) -> Path:
    root.mkdir()
    for name in ("left.avi", "right.avi"):
        code = cv2.VideoWriter.fourcc(*"MJPG")
        writer = cv2.VideoWriter(str(root / name), code, 20.0, (WIDTH, HEIGHT))
        for k in range(3):
            writer.write(np.dstack([picture(10 + k)] * 3))
        writer.release()
    write_calibration(root)
    return root


def bag(root: Path) -> Path:
    root.mkdir()
    write_bag(root / "walk.bag", stereo(3))
    return root


def depth(root: Path) -> Path:
    for k in range(3):
        save(root / "color" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        save(root / "depth" / f"{k}.png", np.full((HEIGHT, WIDTH), 2000, np.uint16))
    write_calibration(root)
    return root


@pytest.mark.parametrize("make", [image_folder, two_folders, one_folder, films, bag, depth])
def test_files_that_macos_hides_beside_others_are_none(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    root = make(tmp_path / "walk")
    expected = bare_experiment(root).description
    for path in [path for path in root.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X" + bytes(60))
    assert bare_experiment(root).description == expected


def test_noise_settings_reach_the_odometry(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "odom.csv").write_text("0,1,0\n0.3,1,0\n0.6,1,0\n", encoding="utf-8")
    noisy = RecordedOdometrySettings(speed_sigma_mps=7.0)
    step = open_recording(ImageFolderSettings(path=str(root)), noisy).odometry(1)
    assert step is not None
    assert np.sqrt(step.covariance[3, 3]) == pytest.approx(0.7)


def test_settings_of_odometry_refuse_nonsense() -> None:
    adapter = TypeAdapter(OdometrySettings)
    for values in (
        {"kind": "recorded", "speed_sigma_mps": 0.0},
        {"kind": "synthetic", "rotation_sigma_deg": -1.0},
        {"kind": "constant_velocity", "start_speed_sigma_mps": 1.0},
        {"kind": "wheels"},
    ):
        with pytest.raises(ValidationError):
            adapter.validate_python(values)


# --------------------------------------------------------------------------------------------
# Resized


SIDE_BY_SIDE = (pose(np.eye(3), np.zeros(3)), pose(np.eye(3), np.array([0.1, 0.0, 0.0])))


def own(root: Path) -> Path:
    """Our layout; Kalibr would state the same numbers."""
    image_folder(root, 3)
    return root


def three(root: Path) -> Path:
    return image_folder(root, 3, top=True)


def loose(root: Path) -> Path:
    for k in range(3):
        save(root / f"left_{k}.png", picture(60 + k))
        save(root / f"right_{k}.png", picture(10 + k))
    write_calibration(root)
    return root


def grow(root: Path, across: float = 2.0, down: float = 2.0) -> None:
    """The calibration of the same cameras' images enlarged; pixel centres are whole numbers."""
    path = root / "calib.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    for focal, middle, length, factor in (
        ("fx", "cx", "width", across),
        ("fy", "cy", "height", down),
    ):
        values[focal] *= factor
        values[middle] = factor * (values[middle] + 0.5) - 0.5
        values[length] = round(factor * values[length])
    path.write_text(json.dumps(values), encoding="utf-8")


def in_unit(root: Path, metres: float) -> None:
    """The calibration of the same cameras with its lengths in a unit of so many metres."""
    path = root / "calib.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    for name in {"baseline_m", "vertical_baseline_m"} & set(values):
        values[name] /= metres
    path.write_text(json.dumps(values), encoding="utf-8")


def opened(root: Path, *overrides: str) -> Recording:
    config = bare_experiment(root, overrides=overrides).config
    assert isinstance(config, ExperimentConfig)
    found = open_sequence(config)
    assert isinstance(found, Recording)
    return found


@pytest.mark.parametrize("make", [own, three, loose])
def test_a_calibration_of_larger_images_is_scaled_only_when_asked(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    root = make(tmp_path / "walk")
    before = opened(root).rig
    grow(root)
    with pytest.raises(CalibrationError) as raised:
        opened(root)
    line = str(raised.value)
    assert "\n" not in line
    assert "is for images of 64x48 pixels, the images have 32x24" in line
    assert "--set dataset.resized=true" in line
    found = opened(root, "dataset.resized=true")
    for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline", "vertical_baseline"):
        expected = getattr(before, name)
        assert getattr(found.rig, name) == (expected and pytest.approx(expected, abs=1e-9))
    assert int(found.frame(1).images[0][0, 0]) == 11


@pytest.mark.parametrize("make", [own, loose])
def test_another_shape_is_refused_even_when_asked(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    root = make(tmp_path / "walk")
    grow(root, 2.0, 1.5)
    with pytest.raises(CalibrationError, match=r"64x36 pixels cannot be scaled.*cropped"):
        opened(root, "dataset.resized=true")


@pytest.mark.parametrize(("make", "metres"), [(own, 0.001), (three, 0.025), (loose, 0.001)])
def test_lengths_in_another_unit_are_noticed_and_mended(
    tmp_path: Path, make: Callable[[Path], Path], metres: float
) -> None:
    """0.2 m are 200 m where millimetres are taken as metres, and 8 squares of 25 mm."""
    root = make(tmp_path / "walk")
    before = opened(root).rig
    in_unit(root, metres)
    (noticed,) = (note for note in opened(root).notes if "its unit is not the metre" in note)
    assert f"the baseline is {before.baseline / metres:.4g} m" in noticed
    assert "--unit 0.001 for millimetres, or the side of a square" in noticed
    found = opened(root, f"dataset.unit_m={metres}")
    assert not any("unit" in note for note in found.notes)
    for name in ("baseline", "vertical_baseline"):
        expected = getattr(before, name)
        assert getattr(found.rig, name) == (expected and pytest.approx(expected, abs=1e-9))


def test_a_unit_that_makes_one_camera_of_two_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"are 0\.2 mm apart, as one camera; .*\(--unit\)"):
        opened(own(tmp_path / "walk"), "dataset.unit_m=0.001")


def test_raw_cameras_are_scaled_as_well(tmp_path: Path) -> None:
    root = euroc(tmp_path, SIDE_BY_SIDE)
    focal = opened(root).rig.fx
    for path in sorted((root / "mav0").glob("cam?/data/*.png")):
        save(path, cv2.resize(cv2.imread(str(path), 0), None, fx=0.5, fy=0.5))
    width, height = EUROC_SIZE
    with pytest.raises(CalibrationError, match=f"{width}x{height} pixels, the images have 32x24"):
        opened(root)
    found = opened(root, "dataset.resized=true")
    assert (found.rig.width, found.rig.height) == (WIDTH, HEIGHT)
    assert found.rig.fx == pytest.approx(0.5 * focal, rel=0.03)
    assert found.frame(0).images[0].shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("make", [own, three])
def test_images_are_made_smaller_with_their_calibration(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    root = make(tmp_path / "walk")
    before, found = opened(root), opened(root, "dataset.scale=0.5")
    expected = (16, 12, 15.0, 15.5, 7.5, 5.5, before.rig.baseline, before.rig.vertical_baseline)
    rig = found.rig
    numbers = (rig.width, rig.height, rig.fx, rig.fy, rig.cx, rig.cy, rig.baseline)
    assert (*numbers, rig.vertical_baseline) == expected
    large, small = before.frame(1), found.frame(1)
    for one, other in zip(large.images, small.images, strict=True):
        mean = one.reshape(12, 2, 16, 2).astype(float).mean(axis=(1, 3))
        assert np.abs(other - mean).max() <= 0.5
    assert found.colour(1)[0].shape == (12, 16, 3)
    assert found.notes[0] == "images of 32x24 are made 16x12"
    assert np.array_equal(found.timestamps, before.timestamps)


def test_black_borders_keep_their_distance_when_images_are_made_smaller(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "walk", 3)
    hidden = np.full((HEIGHT, WIDTH), 255, np.uint8)
    hidden[:, :8] = 0
    save(root / "mask_left.png", hidden)
    large, small = opened(root).frame(0), opened(root, "dataset.scale=0.5").frame(0)
    assert large.margins[1][12, 20] == pytest.approx(13.0, abs=0.5)
    assert small.margins[1][6, 10] == pytest.approx(6.5, abs=0.3)
    assert small.margins[1].shape == small.images[1].shape


@pytest.mark.parametrize(
    ("scale", "words"), [("0.1", "images of 3x2 pixels of 32x24"), ("0", "greater than 0")]
)
def test_a_scale_that_leaves_nothing_is_refused(tmp_path: Path, scale: str, words: str) -> None:
    root = image_folder(tmp_path / "walk", 3)
    with pytest.raises(FgslamError, match=words) as raised:
        opened(root, f"dataset.scale={scale}")
    assert "dataset.scale" in str(raised.value)


def test_the_angle_of_the_rectified_view_may_be_chosen(tmp_path: Path) -> None:
    for root in (own(tmp_path / "own"), euroc(tmp_path, SIDE_BY_SIDE)):
        wide = opened(root, "dataset.fov_deg=100")
        rig = wide.rig
        assert rig.width / rig.fx == pytest.approx(2.0 * np.tan(np.radians(50.0)), abs=1e-6)
        assert wide.frame(0).images[0].shape == (rig.height, rig.width)
    with pytest.raises(FgslamError, match=r"fov_deg.*less than 170"):
        opened(root, "dataset.fov_deg=175")


@pytest.mark.parametrize(("share", "bits"), [(1, 8), (16, 12)])
def test_a_folder_of_16_bit_images_is_scaled_by_the_bits_they_hold(
    tmp_path: Path, share: int, bits: int
) -> None:
    for k in range(3):
        for name, code in (("left", 60 + k), ("right", 10 + k)):
            image = np.clip(picture(code), 0, 254).astype(np.uint16) * share
            save(tmp_path / f"{name}_{k}.png", image)
    write_calibration(tmp_path)
    found = opened(tmp_path)
    np.testing.assert_array_equal(found.frame(2).images[1], np.clip(picture(62), 0, 254))
    np.testing.assert_array_equal(found.colour(2)[1][:, :, 0], np.clip(picture(62), 0, 254))
    assert sum(f"pixels of 16 bits hold {bits}:" in note for note in found.notes) == 1


def test_sixteen_bits_that_are_used_are_no_note(tmp_path: Path) -> None:
    for name, code in (("left", 60), ("right", 10)):
        save(tmp_path / f"{name}_0.png", picture(code).astype(np.uint16) << 8 | 0x7F)
    write_calibration(tmp_path)
    found = opened(tmp_path)
    np.testing.assert_array_equal(found.frame(0).images[0], picture(10))
    assert not any("bits" in note for note in found.notes)
    assert found.rig.fx == CALIBRATION["fx"]


# --------------------------------------------------------------------------------------------
# Calibrations that do not fit the images


def pair(disparity: int, rows: int) -> tuple[Image, Image]:
    """Right and left image of a textured wall."""
    noise = np.random.default_rng(2).integers(0, 256, (60, 90), np.uint8)
    wall = np.asarray(cv2.resize(noise, (360, 240), interpolation=cv2.INTER_CUBIC), np.uint8)
    left = np.roll(wall, (rows, disparity), (0, 1))
    return wall[20:-20, 40:-40], left[20:-20, 40:-40]


def moved_by(rows: float) -> Rectifier:
    """What moves the left image of a wall down by rows, and leaves the right one."""
    rig = CameraRig(280, 200, 200.0, 200.0, 139.5, 99.5, 0.1, None, np.eye(4))
    y, x = np.mgrid[:200, :280].astype(np.float32)
    return Rectifier(rig, ((x, y), (x, y - np.float32(rows))))


@pytest.mark.parametrize(
    ("disparity", "rows", "moved", "words"),
    [
        (12, 0, 0, None),
        (12, 0, 1, None),
        (12, 1, 0, None),
        (12, 1, 1, r"matches differ by 1\.0 px once rectified .*, by 0\.0 px as they are; give"),
        (12, 6, 1, r"the rows of \d+ matches differ by 6\.0 px once rectified .*, by 5\.0 px as"),
        (-12, 0, 0, "left and right are swapped: 100 % of"),
        (-12, 6, 0, "left and right look swapped"),
    ],
)
def test_rows_and_order_are_judged(
    disparity: int, rows: int, moved: int, words: str | None
) -> None:
    """Rows that agree within the gates of matching fit as well, unless raw ones agree better."""
    notes = fit_notes(lambda _: pair(disparity, rows), 5, moved_by(moved))
    if words is None:
        assert notes == ()
        return
    (note,) = notes
    assert "\n" not in note
    assert re.search(words, note)


def test_frames_that_cannot_be_read_are_passed_over() -> None:
    def load(index: int) -> tuple[Image, ...]:
        if index < 2:
            raise FrameError("no file")
        return pair(12, 6)

    assert "in the first 3 pairs" in fit_notes(load, 8, moved_by(0))[0]
    assert fit_notes(load, 2, moved_by(0)) == ()
    assert fit_notes(lambda _: (np.zeros((60, 80), np.uint8),) * 2, 3, moved_by(0)) == ()


CHESSBOARDS = {
    "another calibration": (
        "opencv/intrinsics_opencv_samples_DOES_NOT_FIT.yml",
        "opencv/extrinsics.yml",
        (640, 480),
        False,
        "does not fit",
    ),
    "barry, swapped once more": ("barry/extrinsics.yml", None, (640, 512), True, "look swapped"),
}


@pytest.mark.data
@pytest.mark.parametrize("kind", CHESSBOARDS)
def test_real_pairs(shared_data: Path, kind: str) -> None:
    file, second, size, exchanged, words = CHESSBOARDS[kind]
    folder = shared_data / "cameras" / "stereo_chessboard"
    if not folder.is_dir():
        pytest.skip(f"no chessboard pairs at {folder}")
    rig = load_rig(folder / file, folder / second if second else None, size=size)
    sides = ("left", "right") if exchanged else ("right", "left")

    def load(index: int) -> tuple[Image, ...]:
        names = [folder / kind.split(",", 1)[0].replace("another calibration", "opencv") / f
                 for f in (f"{side}{index + 1:02d}.jpg" for side in sides)]  # fmt: skip
        images = [cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names]
        return rig.rectified(tuple(np.asarray(image, np.uint8) for image in images))

    assert rig.rectifier is not None
    notes = fit_notes(load, 3, rig.rectifier)
    assert notes == () if words is None else words in notes[0]


@pytest.mark.data
def test_a_real_drive_fits_its_calibration_and_no_other(shared_data: Path) -> None:
    """EuRoC's own sensor.yaml against that of another camera of the same size (MYNT EYE)."""
    root = shared_data / "euroc_v101_raw"
    other = shared_data / "cameras/calibrations/vins_fusion/mynteye/mynteye_stereo_imu_config.yaml"
    if not root.is_dir() or not other.is_file():
        pytest.skip(f"no raw recording at {root}, or no calibration at {other}")
    found = open_recording(EurocSettings(path=str(root), stop=3))
    assert found.rectifier is not None
    assert found.rectifier.maps
    assert not any("does not fit" in note for note in found.notes)
    wrong = open_recording(EurocSettings(path=str(root), stop=3, camera_file=str(other)))
    assert re.search(f"{other.name} does not fit these images", wrong.notes[0])


def seen_by(camera: RawCamera, wall: Image, shifts_m: FloatArray) -> Iterator[Image]:
    """A textured wall 3 m away, 5 mm a pixel, by a camera each of ``shifts_m`` to the right."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    for shift in shifts_m:
        place = (3.0 * rays[:, :2] / rays[:, 2:] + [shift, 0.0]) / 0.005 + 700.0
        u, v = place.T.reshape(2, *columns.shape).astype(np.float32)
        yield np.asarray(cv2.remap(wall, u, v, cv2.INTER_LINEAR), np.uint8)


@pytest.mark.parametrize(("model", "matrices"), [("radtan", "K"), ("equidistant", "M")])
def test_four_coefficients_are_of_the_lens_by_which_rows_agree(
    tmp_path: Path, model: str, matrices: str
) -> None:
    """Nothing in the file states it, whatever it calls the matrices."""
    lens = np.array([-0.28, 0.07, 0.004, 0.003] if model == "radtan" else [0.2, 0.1, -0.1, 0.03])
    size, distortions = (320, 240), (lens, 0.8 * lens)
    matrix = np.array([[200.0, 0.0, 155.0], [0.0, 200.0, 122.0], [0.0, 0.0, 1.0]])
    wall = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 255, (1400, 1400), dtype=np.uint8), (0, 0), 3.0
    )
    wall = cv2.normalize(wall, np.empty_like(wall), 0, 255, cv2.NORM_MINMAX)
    values: dict[str, Any] = {"image_size": size, "R": np.eye(3).tolist(), "T": [-0.2, 0.0, 0.0]}
    for k, (side, shift) in enumerate((("left", 0.0), ("right", 0.2))):
        camera = RawCamera(*size, matrix, distortions[k], np.eye(4), model=model)
        for frame, image in enumerate(seen_by(camera, wall, shift + 0.3 * np.arange(3))):
            save(tmp_path / side / f"{frame:06d}.png", image)
        values |= {f"{matrices}{k + 1}": matrix.tolist(), f"D{k + 1}": distortions[k].tolist()}
    (tmp_path / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    (tmp_path / "times.txt").write_text("".join(f"{k} {k / 10}\n" for k in range(3)), "utf-8")
    other = "equidistant" if model == "radtan" else "radtan"
    settings = ImageFolderSettings(path=str(tmp_path))
    found = open_recording(settings)
    assert f"taken as {model}, by which the rows" in found.notes[0]
    assert found.rectifier is not None
    assert found.rectifier.calibration is not None
    assert found.rectifier.calibration.cameras[0].model == model
    forced = open_recording(replace(settings, lens=other)).rectifier
    assert forced is not None
    assert forced.calibration is not None
    assert forced.calibration.cameras[0].model == other  # what the note says states otherwise
