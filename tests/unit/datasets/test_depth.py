"""Colour and depth: the view that depth makes, TUM's layout, two folders, units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dataset_builders import HEIGHT, WIDTH, picture, save

from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.sensors import CameraRig
from fgslam.datasets.depth import BASELINE_M, seen_from_the_left
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import RgbdSettings
from fgslam.frontend.settings import AppearanceSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.bare import bare_experiment

FOCAL = 250.0  # at 2 m the view is shifted by 10 px
DEPTH_M = 2.0


def opened(root: Path, **settings: Any) -> Recording:
    return open_recording(RgbdSettings(path=str(root), **settings))


def camera(root: Path, **changes: Any) -> None:
    matrix = {"fx": FOCAL, "fy": FOCAL, "cx": 15.5, "cy": 11.5, "width": WIDTH, "height": HEIGHT}
    values = {**matrix, "baseline_m": 0.1, **changes}
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")


def tum(root: Path, frames: int = 4, late: float = 0.005) -> Path:
    """TUM's layout: a wall 2 m away; depth is ``late`` seconds later; frame 2 has no depth."""
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for k in range(frames):
        for name in lines:
            stamp = f"{1305031232.1 + 0.1 * k + (late if name == 'depth' else 0.0):.6f}"
            depth = np.full((HEIGHT, WIDTH), round(5000 * DEPTH_M), np.uint16)
            colour = np.dstack([picture(10 + k)] * 3)
            if (k, name) != (2, "depth"):
                save(root / name / f"{stamp}.png", colour if name == "rgb" else depth)
                lines[name].append(f"{stamp} {name}/{stamp}.png")
    for name, listed in lines.items():
        text = "\n".join(["# timestamp filename", *listed])
        (root / f"{name}.txt").write_text(text, encoding="utf-8")
    truth = [f"{1305031232.0 + 0.05 * k:.4f} {0.01 * k} 0 0 0 0 0 1" for k in range(20)]
    (root / "groundtruth.txt").write_text("\n".join(truth), encoding="utf-8")
    camera(root)
    return root


# --------------------------------------------------------------------------------------------
# The view from the left


def test_each_pixel_is_further_right_by_its_disparity() -> None:
    image = cv2.GaussianBlur(picture(1, 80, 60), (0, 0), 1.5)
    shift = np.full(image.shape, 7.5, np.float32)
    view = seen_from_the_left(image, shift, np.ones(image.shape, bool))
    between = 0.5 * (image[:, 20:60].astype(float) + image[:, 21:61])
    assert np.abs(view[:, 28:68] - between).max() <= 1.0  # at column u + 7.5, half a pixel aside


def test_what_is_near_hides_what_is_far_and_the_unknown_has_no_texture() -> None:
    image = picture(2, 80, 60)
    shift = np.full(image.shape, 4.0, np.float32)
    shift[20:40, 30:50] = 12.0
    known = np.ones(image.shape, bool)
    known[50:] = False
    view = seen_from_the_left(image, shift, known)
    assert np.array_equal(view[20:40, 42:62], image[20:40, 30:50])
    assert np.array_equal(view[0:20, 4:], image[0:20, :-4])
    assert np.abs(np.diff(view[56:].astype(int), axis=1)).max() < 20
    assert np.abs(np.diff(image[56:].astype(int), axis=1)).max() > 150


def test_the_disparity_has_the_noise_of_the_depth_and_is_independent_of_the_place() -> None:
    rig = CameraRig(64, 48, FOCAL, FOCAL, 31.5, 23.5, 0.1, None, np.eye(4), places="reference")
    settings = StereoSettings(disparity_sigma_px=0.2)
    covariance = StereoMatcher(rig, settings, AppearanceSettings()).by_reference()[1]
    sigma2 = settings.pixel_sigma**2
    assert np.allclose(covariance, np.diag([sigma2, sigma2, 0.04]), rtol=0.0, atol=1e-15)


# --------------------------------------------------------------------------------------------
# Recordings


def test_the_layout_of_tum(tmp_path: Path) -> None:
    root = tum(tmp_path / "walk")
    assert recognise_layout(root) == {"kind": "rgbd", "path": str(root)}
    recording = opened(root)
    assert len(recording) == 3
    right, left = recording.frame(2).images
    assert np.array_equal(right, picture(13))
    assert np.array_equal(left[:, 10:], right[:, :-10])
    assert recording.rig.baseline == BASELINE_M
    truth = recording.ground_truth
    assert truth is not None
    assert np.allclose(truth.poses[:, 0, 3], [0.02, 0.04, 0.08], rtol=0.0, atol=1e-4)
    assert "1 colour images have no partner within 20 ms" in recording.notes[0]
    assert recording.notes[-1] == (
        "depth is taken as 5000 units a metre, which nothing states: its median is 2 m"
    )


@pytest.mark.parametrize("name", ["odometry.txt", "odom.csv"])
def test_odometry_beside_colour_and_depth(tmp_path: Path, name: str) -> None:
    root = tum(tmp_path / "walk")
    head = "time,speed,yaw_rate\n" if name.endswith(".csv") else "#Time px py pz ox oy oz ow vx\n"
    rows = [f"{1305031232.0 + 0.05 * k:.4f} {0.01 * k} 0 0 0 0 0 1 0.2" for k in range(20)]
    if name.endswith(".csv"):
        rows = [f"{1305031232.0 + 0.05 * k:.4f},0.2,0" for k in range(20)]
    (root / name).write_text(head + "\n".join(rows), encoding="utf-8")
    recording = opened(root)
    step = recording.odometry(1)
    assert step is not None
    assert np.allclose(step.motion[:3, 3], [0.02, 0.0, 0.0], rtol=0.0, atol=1e-6)
    assert np.allclose(recording.rig.bTc[:3, 2], [1.0, 0.0, 0.0])  # it looks where the body goes
    said = "(dataset.camera_yaw_deg and dataset.lever_arm_m say otherwise)"
    assert any(note.endswith(said) for note in recording.notes)
    placed = opened(root, lever_arm_m=(0.1, 0.0, 0.5))
    assert np.allclose(placed.rig.bTc[:3, 3], [0.1, 0.0, 0.5])
    assert "straight ahead" not in placed.notes[-1]


def test_the_noise_of_depth_is_part_of_the_experiment(tmp_path: Path) -> None:
    bare = bare_experiment(tum(tmp_path / "walk"))
    # 250 px * 0.08 m * 1.425 mm, and 0.15 px by which a point is found again.
    assert bare.values["frontend"] == {"stereo": {"disparity_sigma_px": 0.153}}
    assert bare.config.frontend.stereo.disparity_sigma_px == 0.153
    assert "walk: colour and depth, 2 cameras 32x24; 3 frames" in bare.description


@pytest.mark.parametrize(("kind", "units"), [(np.uint16, 1000.0), (np.float32, 1.0)])
def test_two_folders_in_millimetres_or_metres(tmp_path: Path, kind: Any, units: float) -> None:
    for k in (9, 10):
        save(tmp_path / "color" / f"{k}.png", picture(k))
        ending = "png" if kind == np.uint16 else "tiff"
        depth = np.full((HEIGHT, WIDTH), DEPTH_M * units, kind)
        save(tmp_path / "depth" / f"{k}.{ending}", depth)
    camera(tmp_path)
    recording = opened(tmp_path)
    assert [int(recording.frame(i).images[0][0, 0]) for i in range(2)] == [9, 10]
    right, left = recording.frame(1).images
    assert np.array_equal(left[:, 10:], right[:, :-10])
    assert f"taken as {units:g} units a metre" in recording.notes[-1]


def test_depth_in_the_wrong_unit_is_said(tmp_path: Path) -> None:
    root = tum(tmp_path)
    with pytest.raises(DatasetError, match=r"median depth is 1e\+04 m at 1 units a metre.*=1000 f"):
        opened(root, depth_scale=1.0)
    with pytest.raises(DatasetError, match=r"median depth is 0\.01 m at 1e\+06 units a metre"):
        opened(root, depth_scale=1e6)


def depths(root: Path, scale: float, nearest: float, farthest: float) -> None:
    """Another wall, seen at an angle: from ``nearest`` to ``farthest`` metres away."""
    ramp = np.linspace(nearest, farthest, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    for path in (root / "depth").iterdir():
        save(path, np.rint(scale * ramp).astype(np.uint16))


@pytest.mark.parametrize(
    ("scale", "nearest", "farthest", "sure"),
    [(5000, 0.7, 3.0, True), (1000, 0.5, 4.0, True), (5000, 0.5, 1.8, False)],
)
@pytest.mark.parametrize("lists", [True, False])
def test_the_unit_of_depth_is_what_a_camera_can_have_seen_or_in_doubt(
    tmp_path: Path, scale: float, nearest: float, farthest: float, sure: bool, lists: bool
) -> None:
    root = tum(tmp_path / "room") if lists else folders(tmp_path / "room", 1e-3)
    camera(root)
    depths(root, scale, nearest, farthest)
    *before, said = opened(root).notes
    doubt = [note for note in before if "nothing states the unit of depth" in note]
    chosen = scale if sure else 5000 if lists else 1000
    assert said.startswith(f"depth is taken as {chosen:g} units a metre, which nothing states: ")
    assert [note for note in doubt if "--set dataset.depth_scale=" in note] == doubt
    assert bool(doubt) == (not sure or lists != (scale == 5000))
    if not sure:  # both can be: the layout's own is taken
        assert "0.51 to 1.8 m" in doubt[0]
        assert "2.6 to 8.9 m" in doubt[0]
    stated = opened(root, depth_scale=scale).notes
    assert not [note for note in stated if "nothing states" in note]


def folders(root: Path, unit_m: float) -> Path:
    """Colour and depth of a wall as RealSense's tools write them, without lists."""
    for k in range(3):
        save(root / "color" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        depth = np.full((HEIGHT, WIDTH), round(DEPTH_M / unit_m), np.uint16)
        save(root / "depth" / f"{k}.png", depth)
    return root


INTRINSICS: dict[str, dict[str, Any]] = {
    "Open3D": {"intrinsic_matrix": [FOCAL, 0, 0, 0, FOCAL, 0, 15.5, 11.5, 1]},
    "librealsense": {
        "fx": FOCAL,
        "fy": FOCAL,
        "ppx": 15.5,
        "ppy": 11.5,
        "coeffs": [0, 0, 0, 0, 0],
        "model": "distortion.inverse_brown_conrady",
    },
    "by hand": {"fx": FOCAL, "fy": FOCAL, "cx": 15.5, "cy": 11.5},
}


@pytest.mark.parametrize("form", INTRINSICS)
@pytest.mark.parametrize("stated", [{"depth_scale": 1e-4}, {"DepthMapFactor": 10000.0}])
def test_intrinsics_of_depth_cameras_and_their_unit(
    tmp_path: Path, form: str, stated: dict[str, float]
) -> None:
    root = folders(tmp_path, 1e-4)
    values = {"width": WIDTH, "height": HEIGHT, **INTRINSICS[form]}
    file = root / "camera_intrinsic.json"
    file.write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"median depth is 20 m at 1000 .* 10000 for tenths"):
        opened(root)
    file.write_text(json.dumps(values | stated), encoding="utf-8")
    recording = opened(root)
    rig = recording.rig
    assert (rig.fx, rig.fy, rig.cx, rig.cy) == (FOCAL, FOCAL, 15.5, 11.5)
    assert recording.notes[-1] == "depth is taken as 10000 units a metre: its median is 2 m"


def test_distortion_that_goes_the_other_way_is_refused(tmp_path: Path) -> None:
    values = INTRINSICS["librealsense"] | {"coeffs": [0.1, 0, 0, 0, 0], "width": 32, "height": 24}
    root = folders(tmp_path, 1e-3)
    (root / "camera.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(CalibrationError, match="inverse_brown_conrady is not known with coeff"):
        opened(root)


def test_a_colour_image_without_depth_takes_its_time_along(tmp_path: Path) -> None:
    root = folders(tmp_path, 1e-3)
    camera(root)
    (root / "depth" / "1.png").unlink()
    (root / "times.txt").write_text("5.0\n5.5\n7.0", encoding="utf-8")
    assert opened(root).timestamps.tolist() == [5.0, 7.0]


def test_the_colour_camera(tmp_path: Path) -> None:
    root = tum(tmp_path / "walk")
    (root / "calib.json").rename(tmp_path / "mine.json")
    with pytest.raises(CalibrationError, match="nothing states the colour camera's focal length"):
        opened(root)
    assert opened(root, camera_file=str(tmp_path / "mine.json")).rig.fx == FOCAL
    camera(root, width=640, height=480)
    with pytest.raises(CalibrationError, match="is for images of 640x480 pixels, the images have"):
        opened(root)


def centre_of(image: Image) -> list[float]:
    """Column and row of a bright dot, by its brightness."""
    rows, columns = np.indices(image.shape)
    return [float(np.average(places, weights=image)) for places in (columns, rows)]


@pytest.mark.parametrize(
    ("name", "distortion"),
    [
        ("rgbd_dataset_freiburg1_rpy", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        ("fr2_desk", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
        ("freiburg3_office", ()),
    ],
)
def test_the_distortion_of_tums_cameras_is_taken_away(
    tmp_path: Path, name: str, distortion: tuple[float, ...]
) -> None:
    """A dot far from the middle appears where OpenCV finds that an exact lens shows it."""
    root, dot = tum(tmp_path / name), (560, 400)
    (root / "calib.json").unlink()
    for path in [*root.glob("rgb/*.png"), *root.glob("depth/*.png")]:
        image = np.full((480, 640), round(5000 * DEPTH_M), np.uint16)
        if path.parent.name == "rgb":
            image = cv2.circle(np.zeros((480, 640, 3), np.uint8), dot, 4, (255, 255, 255), -1)
        save(path, image)
    recording = opened(root)
    rig = recording.rig
    matrix = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    lens = np.array(distortion or np.zeros(5))
    expected = cv2.undistortPoints(np.array([[dot]], np.float64), matrix, lens, P=matrix).ravel()
    right, left = recording.frame(0).images
    assert centre_of(right) == pytest.approx(expected.tolist(), abs=0.2)
    assert (np.hypot(*(expected - dot)) > 3.0) == bool(distortion)
    shifted = expected + np.array([rig.fx * BASELINE_M / DEPTH_M, 0.0])
    assert centre_of(left) == pytest.approx(shifted.tolist(), abs=0.2)
    (stated,) = (note for note in recording.notes if "the camera is taken as TUM's" in note)
    assert ("k1, k2, p1, p2, k3 = 0.2" in stated) == bool(distortion)


def test_depth_that_is_not_registered_or_no_depth(tmp_path: Path) -> None:
    root = tum(tmp_path)
    depths = sorted((root / "depth").iterdir())
    save(depths[0], np.full((12, 16), 10000, np.uint16))
    save(depths[1], picture(1))
    recording = opened(root)
    with pytest.raises(FrameError, match="is 16x12, its colour image 32x24; depth must be regis"):
        recording.frame(0)
    with pytest.raises(FrameError, match="is no depth image: uint8 of 2 dimensions"):
        recording.frame(1)
    assert recording.frame(2).images[0][0, 0] == 13
    for depth in depths:
        save(depth, np.full((12, 16), 10000, np.uint16))
    with pytest.raises(DatasetError, match=r"16x12 pixels, colour images 32x24; .* resize the col"):
        opened(root)


@pytest.mark.parametrize("depth_first", [False, True])
@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize(("mark", "unit"), [(" ", 1.0), (",", 1.0), (" ", 1000.0)])
def test_a_list_of_associations_pairs_and_times(
    tmp_path: Path, depth_first: bool, counted: bool, mark: str, unit: float
) -> None:
    lines = []
    for k in range(4):
        save(tmp_path / "rgb" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        save(tmp_path / "depth" / f"{7 - k}.png", np.full((HEIGHT, WIDTH), 2000 + k, np.uint16))
        colour_at, depth_at = (
            (str(k), str(k))
            if counted
            else (f"{unit * (5.1 + k / 30)}", f"{unit * (5.105 + k / 30)}")
        )
        words = [f"{colour_at} rgb/{k}.png", f"{depth_at} depth/{7 - k}.png"]
        lines.append(" ".join(words[::-1] if depth_first else words))
    text = "\n".join(lines).replace(" ", mark)
    (tmp_path / "associations.txt").write_text(text, encoding="utf-8")
    camera(tmp_path)
    recording = opened(tmp_path, depth_scale=1000.0)
    step = np.diff(recording.timestamps)
    np.testing.assert_allclose(step, 0.1 if counted else 1 / 30, rtol=0.0, atol=1e-6)
    assert any("--fps states otherwise" in note for note in recording.notes) == counted
    # What the message advises.
    faster = opened(tmp_path, depth_scale=1000.0, fps=25.0)
    np.testing.assert_allclose(np.diff(faster.timestamps), 0.04, rtol=0.0, atol=1e-9)
    assert int(recording.frame(2).images[0][0, 0]) == 12
