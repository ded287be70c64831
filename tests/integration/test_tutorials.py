"""Every command of the tutorials runs, in order, on rendered data; their pictures are made."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import bags
import cv2
import numpy as np
import pytest
from running import ROOT, Patch, main
from textured_room import SMALL_CAMERA_FILE, folder_of

import fgslam as fg
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.geometry import se3_exp
from scripts import make_tutorial_pictures as pictures

TUTORIALS = ROOT / "docs" / "tutorials"
FRAMES = 12
BOARD = (9, 6)
SQUARE_M = 0.06


def page(name: str) -> str:
    return (TUTORIALS / f"{name}.md").read_text(encoding="utf-8")


def commands(name: str) -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", page(name), flags=re.DOTALL)
    return [shlex.split(line) for line in "".join(blocks).splitlines()]


def seen_board(rig: fg.StereoRig, cTb: FloatArray, offset: float) -> Image:
    """A chessboard at ``cTb`` (4, 4) in the right camera, seen ``offset`` metres to its left."""
    dots = 40  # of a square
    field = np.indices((BOARD[1] + 1, BOARD[0] + 1)).sum(axis=0) % 2
    squares = np.kron(field, np.ones((dots, dots)))
    board = np.pad(30.0 + 200.0 * squares, dots, constant_values=230.0)
    height, width = board.shape
    scale = SQUARE_M / dots
    centred = np.array(
        [[scale, 0, -scale * (width - 1) / 2], [0, scale, -scale * (height - 1) / 2]]
    )
    camera = np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1.0]])
    plane = cTb[:3, [0, 1, 3]].copy()
    plane[0, 2] += offset
    map_to = camera @ plane @ np.vstack([centred, [0, 0, 1.0]])
    fine = np.diag([4.0, 4.0, 1.0]) @ map_to  # drawn four times larger: corners without steps
    size = (4 * rig.width, 4 * rig.height)
    large = cv2.warpPerspective(board, fine, size, flags=cv2.INTER_LINEAR, borderValue=120.0)
    smooth = cv2.GaussianBlur(large, (0, 0), 3.0)
    return np.asarray(np.clip(smooth[::4, ::4], 0, 255), np.uint8)


def webcams(folder: Path) -> None:
    """Twenty pairs of a chessboard, and films of a drive through the rendered laboratory."""
    recording = fg.rendered_recording("lab", FRAMES)
    rig, rng = recording.rig, np.random.default_rng(0)
    (folder / "board").mkdir()
    for k in range(20):
        turned = np.append(rng.uniform(-0.45, 0.45, 3), np.zeros(3))
        cTb = se3_exp(turned)
        cTb[:3, 3] = rng.uniform([-0.28, -0.18, 0.85], [0.18, 0.18, 1.2])
        for side, offset in (("left", rig.baseline), ("right", 0.0)):
            image = seen_board(rig, cTb, offset)
            assert cv2.imwrite(str(folder / "board" / f"{side}{k:02d}.png"), image)
    (folder / "drive").mkdir()
    films = [
        cv2.VideoWriter(
            str(folder / "drive" / f"{side}.avi"),
            cv2.VideoWriter.fourcc(*"MJPG"),
            4.0,
            (rig.width, rig.height),
        )
        for side in ("left", "right")
    ]
    for _, images, _ in recording:
        for film, image in zip(films, images or (), strict=False):
            film.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    for film in films:
        film.release()


def bag(folder: Path) -> None:
    """The laboratory's images in colours by their brightness, and its camera_info."""
    recording = fg.rendered_recording("lab", FRAMES)
    rig, written = recording.rig, list[bags.Written]()
    f, cx, cy = rig.fx, rig.cx, rig.cy
    for t, images, _ in recording:
        stamp = bags.START_NS + round(1e9 * t)
        for side, image, shift in zip(
            ("left", "right"), images or (), (0.0, -f * rig.baseline), strict=False
        ):
            fields = bags.raw_image(cv2.applyColorMap(image, cv2.COLORMAP_PINK), "bgr8")
            info = bags.camera_info(shift) | {
                "height": rig.height,
                "width": rig.width,
                "k": np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
                "p": np.array([f, 0, cx, shift, 0, f, cy, 0, 0, 0, 1, 0.0]),
            }
            written.append((f"/{side}/image_raw", stamp, "sensor_msgs/msg/Image", fields))
            written.append((f"/{side}/camera_info", stamp, "sensor_msgs/msg/CameraInfo", info))
    bags.write_bag(folder / "drive.bag", written)


def panoramas(folder: Path) -> None:
    """A way through a textured room, and the same way on another day."""
    folder_of(folder / "drive", np.arange(0.0, 3.6, 0.4))
    folder_of(folder / "again", np.arange(0.2, 3.6, 0.8))
    (folder / "camera.yaml").write_text(SMALL_CAMERA_FILE, encoding="utf-8")


DATA: dict[str, Callable[[Path], None]] = {
    "two_webcams": webcams,
    "bag_to_map": bag,
    "teach_a_route": panoramas,
}
MADE = {
    "two_webcams": ("rig.json", "understood.png", "room.ply", "path.tum"),
    "bag_to_map": ("bag.rrd", "map.ply", "drive.gif", "path.mcap", "colmap/sparse"),
    "teach_a_route": (
        "route.fgpath",
        "taught/path_images.csv",
        "runs/again/follow.csv",
        "again.mp4",
    ),
}


def test_every_tutorial_of_commands_is_run() -> None:
    """The others are made from examples, which tests/examples runs."""
    pages = {path.stem for path in TUTORIALS.glob("*.md")}
    assert {name for name in pages if "<!-- Made by" not in page(name)} == set(DATA)


@pytest.mark.parametrize("name", DATA)
def test_a_tutorial_is_short_and_its_pictures_are_small(name: str) -> None:
    text = page(name)
    assert len(text.split()) <= 500
    shown = re.findall(r"!\[.+\]\(\.\./images/(.+?)\)", text)
    assert shown
    assert set(shown) <= set(pictures.SOURCES)
    for picture in shown:
        assert (pictures.IMAGES / picture).stat().st_size < pictures.LARGEST
    assert all(command[0] == "fgslam" for command in commands(name))


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_every_command_runs_and_the_pictures_are_made(tmp_path: Path, monkeypatch: Patch) -> None:
    pytest.importorskip("rerun", reason="the extra `viewer` is not installed")
    monkeypatch.setattr("fgslam.report.pictures.DPI", 100)
    for name, make in DATA.items():
        folder = tmp_path / name
        folder.mkdir()
        make(folder)
        monkeypatch.chdir(folder)
        for command in commands(name):
            assert main(monkeypatch, *command[1:]) == 0, shlex.join(command)
        missing = [file for file in MADE[name] if not (folder / file).exists()]
        assert not missing
    rig = fg.load_rig(tmp_path / "two_webcams" / "rig.json")
    assert rig.baseline == pytest.approx(0.1, rel=0.01)  # of the laboratory's cameras
    (tmp_path / "images").mkdir()
    pictures.make(tmp_path, tmp_path / "images")
    assert {path.name for path in (tmp_path / "images").iterdir()} == set(pictures.SOURCES)
    for path in (tmp_path / "images").iterdir():
        assert path.stat().st_size < pictures.LARGEST
