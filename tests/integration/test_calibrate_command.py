"""`fgslam calibrate` as a user meets it: on real boards, and with what is wrong."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import Capture, Patch, main, mistake
from scipy.optimize import least_squares

import fgslam as fg
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.omni import LensCamera, MirrorFrame, RadialPolynomial
from fgslam.cameras.rig import read_calibration_file
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import so3_exp, so3_log

# Facts of the files' SOURCE.md: the square, metres, and the baseline that other programs found.
SETS = {
    "opencv": ("stereo_chessboard/opencv", "9x6", 0.025, "chessboard", "radtan", 0.0829),
    "barry": ("stereo_chessboard/barry", "9x6", 0.024, "chessboard", "radtan", 0.09205),
    # Turned by hand where the two cameras number the board from opposite ends, OpenCV's own.
    "half turns": (
        "camera_info/uby56_imx219_stereo",
        "8x6",
        0.025,
        "chessboard",
        "radtan",
        0.06925,
    ),
    "fisheye": ("stereo_fisheye/imgs", "9x6", 0.02423, "chessboard", "equidistant", 0.10996),
}


def calibrated(
    monkeypatch: Patch, capfd: Capture, data: Path, name: str, out: Path
) -> tuple[str, fg.StereoRig]:
    folder, board, square, target, lens, _ = SETS[name]
    arguments = ("--board", board, "--square", square, "--target", target, "--lens", lens)
    images = data / "cameras" / folder
    if not images.is_dir():
        pytest.skip(f"no images of a board at {images}")
    assert main(monkeypatch, "calibrate", "stereo", images, *arguments, "--out", out) == 0
    return capfd.readouterr().out, fg.load_rig(out)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_real_boards_give_the_baseline_that_others_found(
    shared_data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture, name: str
) -> None:
    told, rig = calibrated(monkeypatch, capfd, shared_data, name, tmp_path / "rig.json")
    assert rig.baseline == pytest.approx(SETS[name][-1], rel=0.005)
    assert (tmp_path / "rig.png").is_file()
    assert ("are swapped" in told) == (name in ("barry", "half turns"))
    held = next(line for line in told.splitlines() if line.startswith("held out"))
    square = float(held.partition("squares of ")[2].split()[0])
    assert square == pytest.approx(1e3 * SETS[name][2], rel=0.01)


@pytest.mark.data
@pytest.mark.slow
def test_euroc_tags_give_its_published_cameras(
    shared_data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """Kalibr's target of 6x6 tags of 88 mm; the published calibration used it, and more images."""
    images = shared_data / "cameras/stereo_aprilgrid"
    published = shared_data / "euroc_v101_raw/mav0"
    if not (images.is_dir() and published.is_dir()):
        pytest.skip(f"no images of EuRoC's target at {images}, or no calibration at {published}")
    out = tmp_path / "rig.json"
    arguments = ("--board", "6x6", "--square", "0.088", "--target", "aprilgrid", "--out", out)
    assert main(monkeypatch, "calibrate", "stereo", images, *arguments) == 0
    told = capfd.readouterr().out
    assert "verdict     good for mapping" in told
    found, expected = read_calibration_file(out), read_calibration_file(published)
    for camera, exact in zip(found.cameras, expected.cameras, strict=True):
        ours, theirs = camera.matrix, exact.matrix
        assert np.abs(np.diag(ours)[:2] / np.diag(theirs)[:2] - 1.0).max() < 0.006
        assert np.abs(ours[:2, 2] - theirs[:2, 2]).max() < 2.0
        assert median_apart_px(camera, exact) < 0.5
    steps = [rig.offset(1, 0) for rig in (found, expected)]
    assert np.linalg.norm(steps[0][:3, 3]) == pytest.approx(
        np.linalg.norm(steps[1][:3, 3]), rel=0.002
    )
    turned = np.degrees(np.linalg.norm(so3_log(steps[0][:3, :3].T @ steps[1][:3, :3])))
    assert turned < 0.15
    rows = list(csv.DictReader((tmp_path / "rig_images.csv").open(encoding="utf-8")))
    assert len(rows) == 2 * 26
    assert all(0.05 < float(row["rms_px"]) < 0.5 for row in rows)


def median_apart_px(camera: RawCamera, other: RawCamera, widest_deg: float = 180.0) -> float:
    """How far apart two cameras show the same rays, up to an angle, turned to agree at best."""
    columns, rows = np.meshgrid(*(np.linspace(0, side - 1, 30) for side in camera.size))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = camera.unproject(pixels)
    seen = np.isfinite(other.project(rays)).all(axis=1)
    seen &= rays[:, 2] >= np.cos(np.radians(widest_deg))

    def off(turn: np.ndarray) -> np.ndarray:
        shown = other.project(rays[seen] @ so3_exp(turn).T) - pixels[seen]
        return np.nan_to_num(shown, nan=10.0).ravel()

    found = least_squares(off, np.zeros(3), loss="soft_l1").x
    return float(np.median(np.linalg.norm(off(found).reshape(-1, 2), axis=1)))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_real_fisheye_alone_agrees_with_its_pair(
    shared_data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture, side: str
) -> None:
    images = shared_data / "cameras/stereo_fisheye/imgs"
    stated = shared_data / "cameras/stereo_fisheye/mystereocalib.yml"
    if not images.is_dir():
        pytest.skip(f"no images of a board at {images}")
    folder = tmp_path / side
    folder.mkdir()
    for image in images.glob(f"{side}*"):
        (folder / image.name).symlink_to(image)
    out = tmp_path / "camera.yaml"
    arguments = ("--board", "9x6", "--square", "0.02423", "--lens", "equidistant", "--out", out)
    assert main(monkeypatch, "calibrate", "omni", folder, *arguments) == 0
    told = capfd.readouterr().out
    (camera,) = read_calibration_file(tmp_path / "camera_lens.json").cameras
    pair = read_calibration_file(stated, size=camera.size).cameras[side == "right"]
    # The pair's calibrations differ by 0.9 %: 226.4 stated, 228.4 by calibrate stereo (right).
    assert camera.focal_px == pytest.approx(pair.focal_px, rel=0.015)
    assert median_apart_px(camera, pair, 60.0) < 2.0
    assert "held out" in told
    assert isinstance(fg.load_camera(out), LensCamera)


@pytest.mark.data
@pytest.mark.slow
def test_a_few_real_images_calibrate_and_are_called_few(
    shared_data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    images = shared_data / "cameras" / SETS["opencv"][0]
    if not images.is_dir():
        pytest.skip(f"no images of a board at {images}")
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        for number in (1, 3, 5, 7, 9, 13):
            name = f"{camera}{number:02d}.jpg"
            (tmp_path / camera / name).symlink_to(images / name)
    out = tmp_path / "rig.json"
    folders = (tmp_path / "left", tmp_path / "right")
    sizes = ("--board", "9x6", "--square", "0.025", "--out", out)
    assert main(monkeypatch, "calibrate", "stereo", *folders, *sizes) == 0
    told = capfd.readouterr().out
    assert "verdict     doubtful" in told
    assert "only 6 moments" in told
    assert fg.load_rig(out).baseline == pytest.approx(0.0829, rel=0.02)
    assert [camera["model"] for camera in json.loads(out.read_text())["cameras"]] == ["radtan"] * 2


def test_mistakes_of_calibrate(tmp_path: Path, monkeypatch: Patch, capfd: Capture) -> None:
    def reported(*arguments: object) -> str:
        return mistake(capfd, monkeypatch, "calibrate", *arguments)

    for name in ("left1.png", "right1.png"):
        cv2.imwrite(str(tmp_path / name), np.full((120, 160), 90, np.uint8))
    sizes = ("--board", "9x6", "--square", "0.025")
    assert main(monkeypatch, "calibrate", "stereo", tmp_path, *sizes) == 2
    assert "no image of 1 moments shows a chessboard of 9x6" in capfd.readouterr().err
    assert "no such folder" in reported("stereo", tmp_path / "gone", *sizes)
    one, other = tmp_path / "left1.png", tmp_path / "right1.png"
    assert "left1.png: is a file; give the folder" in reported("stereo", one, other, *sizes)
    said = reported("stereo", one, one, other, other, *sizes)
    assert "4 folders or files were given; give the folder of all images" in said
    wrong = ("--board", "nine", "--square", "0.025")
    assert "give columns and rows as 9x6" in reported("stereo", tmp_path, *wrong)
    assert "is not known" in reported("stereo", tmp_path, *sizes, "--target", "circles")
    assert "lens 'pinhole' is not known" in reported(
        "stereo", tmp_path, *sizes, "--lens", "pinhole"
    )
    text = ("--out", tmp_path / "rig.txt")
    assert "is written as .json" in reported("stereo", tmp_path, *sizes, *text)
    (tmp_path / "empty").mkdir()
    assert "cannot be distinguished" in reported("stereo", tmp_path / "empty", *sizes)
    three = [tmp_path, tmp_path, tmp_path / "empty"]
    assert "different numbers of images" in reported("trinocular", *three, *sizes)
    markers = ("--target", "charuco", "--dictionary", "DICT_9X9")
    same = [tmp_path, tmp_path, tmp_path]
    assert main(monkeypatch, "calibrate", "trinocular", *same, *sizes, *markers) == 2
    assert "markers 'DICT_9X9' are not known" in capfd.readouterr().err


FISHEYE = RawCamera(
    720,
    720,
    np.array([[225.0, 0.0, 361.0], [0.0, 225.5, 358.0], [0.0, 0.0, 1.0]]),
    np.array([0.01, -0.004, 0.001, 0.0]),
    np.eye(4),
    model="equidistant",
)


def draw_boards(
    folder: Path, count: int, camera: RawCamera = FISHEYE, print_: np.ndarray | None = None
) -> None:
    """Chessboards of 6x4 corners of 50 mm through a fisheye of 180 degrees, off its axis too.

    Or another print of 7x5 squares, grey (rows, columns).
    """
    fine = (np.arange(1440.0) + 0.5) / 2.0 - 0.5  # four rays a pixel
    columns, rows = np.meshgrid(fine, fine)
    rays = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    rng = np.random.default_rng(2)
    for number in range(count):
        tilt, off_axis = rng.uniform(-0.4, 0.4, 3), rng.uniform(-0.5, 0.5, 2)
        turn = so3_exp(np.array([*off_axis, 0.0])) @ so3_exp(tilt)
        middle = so3_exp(np.array([*off_axis, 0.0])) @ np.array([0.0, 0.0, 0.24])
        away = middle - turn @ np.array([0.125, 0.075, 0.0])
        depth = (turn[:, 2] @ away) / (rays @ turn[:, 2])
        flat = (rays * np.where(depth > 0.0, depth, np.nan)[:, None] - away) @ turn / 0.05
        across, down = np.floor(flat[:, 0]) + 1.0, np.floor(flat[:, 1]) + 1.0
        on = (across >= 0) & (across <= 6) & (down >= 0) & (down <= 4)
        dark = (across + down) % 2 == 0
        if print_ is not None:
            texels = (np.nan_to_num(flat[:, :2] + 1.0) / (7, 5) * print_.shape[::-1]).astype(int)
            column, row = np.clip(texels, 0, np.array(print_.shape[::-1]) - 1).T
            dark = print_[row, column] < 128
        image = np.where(on & dark, 30.0, 200.0).reshape(1440, 1440)
        image = cv2.resize(
            cv2.GaussianBlur(image, (0, 0), 1.4), (720, 720), None, 0, 0, cv2.INTER_AREA
        )
        cv2.imwrite(str(folder / f"board{number:02d}.png"), image.astype(np.uint8))


def flat_board(columns: int, rows: int) -> np.ndarray:
    """A chessboard of so many corners that fills an image, 0 to 1."""
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    return np.pad(np.kron(squares, np.ones((24, 24))), 40, constant_values=1.0)


@pytest.mark.slow
def test_a_fisheye_is_calibrated_from_images_of_a_board(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    out, drawn_boards = tmp_path / "camera.yaml", tmp_path / "boards"
    drawn_boards.mkdir()
    draw_boards(drawn_boards, 14)
    siblings = ("camera.json", "camera.png", "camera_images.csv", "camera_parameters.csv")
    for name in siblings:
        (tmp_path / name).write_text("a rig", encoding="utf-8")
    board = ("--board", "6x4", "--square", "0.05", "--lens", "equidistant", "--mount", "up")
    assert main(monkeypatch, "calibrate", "omni", drawn_boards, *board, "--out", out) == 0
    told = capfd.readouterr().out
    for word in ("corners ", "camera ", "equidistant: k1", "worst ", "held out", "verdict", "up: "):
        assert word in told
    (camera,) = read_calibration_file(tmp_path / "camera_lens.json").cameras
    # Unrefined, corners that OpenCV finds far from the axis gave 0.9 % and 1.2 px.
    assert camera.focal_px == pytest.approx(FISHEYE.focal_px, rel=0.005)
    assert median_apart_px(camera, FISHEYE, 60.0) < 0.3
    assert (tmp_path / "camera_lens.png").read_bytes().startswith(b"\x89PNG")
    images = list(csv.DictReader((tmp_path / "camera_lens_images.csv").open(encoding="utf-8")))
    assert [row["image"] for row in images] == [f"board{k:02d}.png" for k in range(14)]
    assert all(0.0 < float(row["rms_px"]) < 1.0 for row in images if row["rms_px"])
    assert sum(bool(row["rms_px"]) for row in images) >= 5
    parameters = list(
        csv.DictReader((tmp_path / "camera_lens_parameters.csv").open(encoding="utf-8"))
    )
    names = ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert [row["parameter"] for row in parameters] == names
    assert all(float(row["sigma"]) > 0.0 for row in parameters)
    read = fg.load_camera(out)
    above = read.pixels(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(above, camera.matrix[None, :2, 2], rtol=0, atol=1e-6)
    with pytest.raises(CalibrationError, match=r"how the camera is mounted; give the \.yaml"):
        fg.load_camera(tmp_path / "camera_lens.json")
    assert all((tmp_path / name).read_text(encoding="utf-8") == "a rig" for name in siblings)


def test_mistakes_of_calibrate_omni(tmp_path: Path, monkeypatch: Patch, capfd: Capture) -> None:
    def reported(*arguments: object) -> str:
        return mistake(capfd, monkeypatch, "calibrate", "omni", *arguments)

    few = tmp_path / "few"
    few.mkdir()
    for name in ("board02.png", "board03.png"):
        cv2.imwrite(str(few / name), (200 * flat_board(6, 4)).astype(np.uint8))
    board = ("--board", "6x4", "--square", "0.05", "--out", tmp_path / "camera.yaml")
    assert main(monkeypatch, "calibrate", "omni", few, *board) == 2
    assert "the camera shows the board in 2 images" in capfd.readouterr().err
    wrong = ("--board", "7x4", "--square", "0.05")
    assert main(monkeypatch, "calibrate", "omni", few, *wrong) == 2
    assert "shows a chessboard of 7x4; board02.png shows 6x4" in capfd.readouterr().err
    said = reported(few / "board02.png", *board)
    assert "is a file; give the folder" in said
    assert "fgslam calibrate rings" in said
    (tmp_path / "empty").mkdir()
    assert "holds no images" in reported(tmp_path / "empty", *board)
    assert "no such folder" in reported(tmp_path / "gone", *board)
    assert "lens 'radtan' is not known; use omni or" in reported(few, *board, "--lens", "radtan")
    assert "mount 'wall' is not known" in reported(few, *board, "--mount", "wall")
    text = ("--board", "6x4", "--square", "0.05", "--out", tmp_path / "camera.txt")
    assert "is written as .yaml" in reported(few, *text)
    assert not (tmp_path / "camera.yaml").exists()


def test_a_board_in_ten_bits_is_seen_as_a_run_sees_it(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """A dim board and a lamp: the upper eight of sixteen bits are black but for the lamp."""
    image = (100.0 + 150.0 * flat_board(7, 5)).astype(np.uint16)
    image[:8, :8] = 900
    for name in ("left1.png", "right1.png"):
        cv2.imwrite(str(tmp_path / name), image)
    sizes = ("--board", "7x5", "--square", "0.025")
    assert main(monkeypatch, "calibrate", "stereo", tmp_path, *sizes) == 2
    assert "shows the board in 1 images" in capfd.readouterr().err


BORDERS_DEG = (-15.0, -5.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)


def draw_rings(path: Path) -> RadialPolynomial:
    """Rings around a camera as a mirror shows them, which is returned."""
    centre, outer = (161.0, 118.5), 100.0
    mirror = RadialPolynomial(MirrorFrame(320, 240, centre), 25.0, outer, (0.2, 0.7, 0.1))
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    radius = np.hypot(column - centre[0], row - centre[1])
    elevation = mirror.elevation(radius.ravel()).reshape(radius.shape)
    bands = np.where(np.searchsorted(np.radians(BORDERS_DEG), elevation) % 2, 60.0, 200.0)
    image = cv2.GaussianBlur(np.where(radius < outer, bands, 5.0), (0, 0), 0.7)
    cv2.imwrite(str(path), image.astype(np.uint8))
    return mirror


def test_a_mirror_is_calibrated_from_an_image_of_rings(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """The picture is drawn by a known mirror; the calibration gives its elevations back."""
    mirror = draw_rings(tmp_path / "rings.png")
    out = tmp_path / "mirror.yaml"
    elevations = "--elevations=" + ",".join(f"{a:.0f}" for a in BORDERS_DEG)
    arguments = (tmp_path / "rings.png", elevations, "--inner", "30", "--out", out)
    assert main(monkeypatch, "calibrate", "rings", *arguments) == 0
    assert "calibration" in capfd.readouterr().out
    found = fg.load_camera(out)
    radii = np.linspace(35.0, 90.0, 12)
    np.testing.assert_allclose(
        found.elevation(radii), mirror.elevation(radii), rtol=0, atol=np.radians(0.5)
    )
