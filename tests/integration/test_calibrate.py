"""`fgslam calibrate` as a user meets it: on real boards, and with what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import Capture, Patch, main, mistake

import fgslam as fg
from fgslam.cameras.omni.mirrors import MirrorFrame, RadialPolynomial

# Facts of the files' SOURCE.md: the square, metres, and the baseline that other programs found.
SETS = {
    "opencv": ("stereo_chessboard/opencv", "9x6", 0.025, "chessboard", "radtan", 0.0829),
    "barry": ("stereo_chessboard/barry", "9x6", 0.024, "chessboard", "radtan", 0.09205),
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
    assert ("are swapped" in told) == (name == "barry")
    held = next(line for line in told.splitlines() if line.startswith("held out"))
    square = float(held.partition("squares of ")[2].split()[0])
    assert square == pytest.approx(1e3 * SETS[name][2], rel=0.01)


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
    assert "only 5 moments" in told
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
    assert "not told apart" in reported("stereo", tmp_path / "empty", *sizes)
    three = [tmp_path, tmp_path, tmp_path / "empty"]
    assert "different numbers of images" in reported("trinocular", *three, *sizes)


def test_a_board_in_ten_bits_is_seen_as_a_run_sees_it(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """A dim board and a lamp: the upper eight of sixteen bits are black but for the lamp."""
    squares = np.indices((6, 8)).sum(axis=0) % 2
    board = np.pad(np.kron(squares, np.ones((24, 24))), 40, constant_values=1.0)
    image = (100.0 + 150.0 * board).astype(np.uint16)
    image[:8, :8] = 900
    for name in ("left1.png", "right1.png"):
        cv2.imwrite(str(tmp_path / name), image)
    sizes = ("--board", "7x5", "--square", "0.025")
    assert main(monkeypatch, "calibrate", "stereo", tmp_path, *sizes) == 2
    assert "shows the board in 1 images" in capfd.readouterr().err


def test_a_mirror_is_calibrated_from_an_image_of_rings(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """The picture is drawn by a known mirror; the calibration gives its elevations back."""
    centre, outer, inner = (161.0, 118.5), 100.0, 25.0
    frame = MirrorFrame(320, 240, centre)
    mirror = RadialPolynomial(frame, inner, outer, (0.2, 0.7, 0.1))
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    radius = np.hypot(column - centre[0], row - centre[1])
    elevation = mirror.elevation(radius.ravel()).reshape(radius.shape)
    borders = np.radians([-15.0, -5.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0])
    bands = np.where(np.searchsorted(borders, elevation) % 2, 60.0, 200.0)
    image = cv2.GaussianBlur(np.where(radius < outer, bands, 5.0), (0, 0), 0.7)
    cv2.imwrite(str(tmp_path / "rings.png"), image.astype(np.uint8))
    out = tmp_path / "mirror.yaml"
    elevations = "--elevations=" + ",".join(f"{a:.0f}" for a in np.degrees(borders))
    arguments = (tmp_path / "rings.png", elevations, "--inner", "30", "--out", out)
    assert main(monkeypatch, "calibrate", "omni", *arguments) == 0
    assert "calibration" in capfd.readouterr().out
    found = fg.load_camera(out)
    radii = np.linspace(35.0, 90.0, 12)
    np.testing.assert_allclose(
        found.elevation(radii), mirror.elevation(radii), rtol=0, atol=np.radians(0.5)
    )
