"""Rectified views: where points of the world fall in them, whatever the lenses and the rig."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rectify import chosen_view
from fgslam.cameras.rig import StereoRig, at_size, load_rig, read_calibration_file, rig_of
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose, so3_exp, transform_to_camera

SIZE = (160, 120)
LENSES = {
    "radtan": (120.0, [-0.28, 0.07, 2e-4, 2e-5]),
    "equidistant": (60.0, [-0.0138, 0.0217, -0.02, 0.0094]),
    "ds": (45.0, [-0.2786, 0.5607]),
}


def camera(at: tuple[float, float, float], turn: tuple[float, float, float], lens: str, name: str
           ) -> RawCamera:  # fmt: skip
    focal, parameters = LENSES[lens]
    matrix = np.array([[focal, 0.0, 79.0], [0.0, focal + 0.5, 60.5], [0.0, 0.0, 1.0]])
    bTc = pose(so3_exp(np.array(turn)), np.array(at))
    return RawCamera(*SIZE, matrix, np.array(parameters), bTc, name, lens)


def scene() -> FloatArray:
    """Points of the body's surroundings ahead (its z axis), metres."""
    rng = np.random.default_rng(5)
    z = rng.uniform(1.5, 6.0, 3000)
    return np.column_stack([rng.uniform(-1, 1, 3000) * z, rng.uniform(-1, 1, 3000) * z, z])


def sampled(rig: StereoRig, camera: int, pixels: FloatArray) -> FloatArray:
    """Where rectified pixels (n, 2) of a camera look in its raw image, bilinear."""
    assert rig.rectifier is not None
    return rig.rectifier.raw_pixels(camera, pixels)


def disagreement(rig: StereoRig, cameras: tuple[RawCamera, ...], points: FloatArray) -> FloatArray:
    """Pixels (n, cameras) between where raw cameras see points and where the maps look for them."""
    seen = rig.plain().predict(transform_to_camera(rig.bTc, points))
    views = [seen[:, :2], seen[:, :2] + np.outer(seen[:, 2], [1.0, 0.0])]
    if rig.vertical_baseline is not None:
        ratio = rig.fy * rig.vertical_baseline / (rig.fx * rig.baseline)
        views.append(seen[:, :2] + np.outer(ratio * seen[:, 2], [0.0, 1.0]))
    inside = np.all(
        [((v > 1) & (v < np.array([rig.width, rig.height]) - 2)).all(axis=1) for v in views], axis=0
    )
    assert inside.sum() > 100
    found = []
    for k, view in enumerate(views):
        one = cameras[rig.sources[k]]
        raw = one.project(transform_to_camera(one.bTc, points[inside]))
        found.append(np.linalg.norm(sampled(rig, k, view[inside]) - raw, axis=1))
    return np.stack(found, axis=1)


TURNS = ((0.02, -0.03, 0.01), (-0.03, 0.02, -0.02), (0.01, 0.03, 0.03))
Place = tuple[float, float, float]


def cameras_at(*places: Place, lens: str = "radtan") -> tuple[RawCamera, ...]:
    """Cameras a, b, c at places, turned against each other."""
    parts = zip(places, TURNS, "abc", strict=False)
    return tuple(camera(at, turn, lens, name) for at, turn, name in parts)


def rig_at(*places: Place, lens: str = "radtan") -> tuple[StereoRig, tuple[RawCamera, ...]]:
    """The rig of such cameras, and these."""
    cameras = cameras_at(*places, lens=lens)
    return rig_of(Calibration("made", "made", cameras)), cameras


@pytest.mark.parametrize("lens", LENSES)
def test_points_fall_where_the_rectified_pair_says(lens: str) -> None:
    rig, cameras = rig_at((0.0, 0.0, 0.0), (0.12, 0.003, -0.004), lens=lens)
    assert rig.sources == (1, 0)
    assert rig.baseline == pytest.approx(np.linalg.norm([0.12, 0.003, -0.004]), abs=1e-12)
    # The maps are sampled between their pixels, which at a fisheye's rim are far apart.
    assert disagreement(rig, cameras, scene()).max() < 0.02
    assert rig.rectifier is not None
    assert all(mask.all() for mask in rig.rectifier.masks)


ARRANGEMENTS = {
    "left and above": ((-0.12, 0.0), (0.0, -0.1)),
    "right and above": ((0.12, 0.0), (0.0, -0.1)),
    "left and below": ((-0.12, 0.0), (0.0, 0.1)),
    "right and below": ((0.12, 0.0), (0.0, 0.1)),
}


@pytest.mark.parametrize(
    ("kind", "lens"),
    tuple(zip(ARRANGEMENTS, ("radtan", "equidistant", "radtan", "equidistant"), strict=True)),
)
def test_three_cameras_in_an_l_share_one_view(kind: str, lens: str) -> None:
    """Whichever way the L lies, rows agree along one baseline and columns along the other."""
    beside, above = ARRANGEMENTS[kind]
    rig, cameras = rig_at((*beside, 0.0), (0.0, 0.0, 0.0), (*above, 0.0), lens=lens)
    assert rig.sources[0] == 1  # the corner
    assert sorted([rig.baseline, rig.vertical_baseline or 0.0]) == pytest.approx([0.1, 0.12])
    assert disagreement(rig, cameras, scene()).max() < 0.02


def test_equal_cameras_to_the_right_and_below_are_turned_too() -> None:
    places = ((0.12, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.1, 0.0))
    matrix = np.array([[90.0, 0.0, 79.0], [0.0, 90.0, 60.5], [0.0, 0.0, 1.0]])
    cameras = tuple(
        RawCamera(*SIZE, matrix, np.zeros(4), pose(np.eye(3), np.array(at)), "c") for at in places
    )
    rig = rig_of(Calibration("made", "made", cameras))
    assert (rig.baseline, rig.vertical_baseline) == pytest.approx((0.12, 0.1))
    assert rig.rectifier is not None
    assert disagreement(rig, cameras, scene()).max() < 0.02


@pytest.mark.parametrize("y", [-0.1, 0.1])
def test_two_cameras_above_each_other_are_rectified_by_a_quarter_turn(y: float) -> None:
    rig, cameras = rig_at((0.0, 0.0, 0.0), (0.004, y, -0.003))
    upper = int(y < 0.0)
    assert rig.sources == (1 - upper, upper)
    (remark,) = rig.remarks  # and nothing is cut off
    assert f"{'ab'[upper]} is above {'ab'[1 - upper]}" in remark
    assert disagreement(rig, cameras, scene()).max() < 0.02
    assert (rig.width, rig.height) == SIZE[::-1]


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi, -np.pi / 2])
@pytest.mark.parametrize("centre", [(2.0, 60.0), (157.0, 118.0), (79.0, -30.0), (-40.0, 3.0)])
def test_a_cropped_sensor_fills_the_view(centre: tuple[float, float], turn: float) -> None:
    """Wherever the principal point lies, in the image or beyond, and however cameras are rolled."""
    about = so3_exp(np.array([0.0, 0.0, turn]))
    cameras = tuple(
        RawCamera(*SIZE, np.array([[120.0, 0, centre[0]], [0, 120.0, centre[1]], [0, 0, 1.0]]),
                  np.array([-0.1, 0.02, 0.0, 0.0]),
                  pose(one.bTc[:3, :3] @ about, one.bTc[:3, 3]), one.name)
        for one in cameras_at((0.0, 0.0, 0.0), (0.12, 0.0, 0.0))
    )  # fmt: skip
    rig = rig_of(Calibration("made", "made", cameras))
    assert rig.overlap == 1.0
    assert 0.8 * 120.0 < rig.fx < 2.0 * 120.0
    assert disagreement(rig, cameras, scene()).max() < 0.02


def turned_apart(degrees: float) -> Calibration:
    """Two cameras of 67 x 53 degrees that look away from each other."""
    half = np.radians(0.5 * degrees)
    cameras = [
        camera((0.12 * k, 0.0, 0.0), (0.0, (2 * k - 1) * half, 0.0), "radtan", "ab"[k])
        for k in (0, 1)
    ]
    return Calibration("made", "made", tuple(cameras))


def test_the_overlap_of_a_view_is_stated_and_none_is_refused() -> None:
    narrow = rig_of(turned_apart(40.0))
    assert narrow.overlap == 1.0
    assert narrow.angles_deg[0] < 40.0
    wide = rig_of(turned_apart(40.0), fov_deg=120.0)
    assert 0.02 < wide.overlap < 0.2
    (remark,) = wide.remarks
    assert remark == f"made: cameras share {wide.overlap:.0%} of the rectified view"
    # Of the middle quarter of the sensor: 19 degrees each.
    off = np.array([[0.0, 0.0, 60.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    apart = turned_apart(44.0)
    cropped = tuple(replace(one, width=40, matrix=one.matrix - off) for one in apart.cameras)
    with pytest.raises(CalibrationError, match="made: no place of the rectified view is seen by"):
        rig_of(replace(apart, cameras=cropped))


def test_baselines_that_are_not_square_are_told() -> None:
    """What remains across the columns is the skew's share of the vertical disparity, no more."""
    skew = np.radians(2.0)
    top = (0.1 * np.sin(skew), -0.1 * np.cos(skew), 0.0)
    rig, cameras = rig_at((-0.12, 0.0, 0.0), (0.0, 0.0, 0.0), top)
    assert "the two baselines are 2.0 degrees off a right angle" in rig.remarks[0]
    points = scene()
    off = disagreement(rig, cameras, points)
    assert off[:, :2].max() < 0.02
    largest = rig.fx * 0.1 / points[:, 2].min() * np.sin(skew)
    assert 0.2 * largest < off[:, 2].max() < 1.3 * largest


def test_of_three_in_a_line_the_outer_two_are_used() -> None:
    rig, cameras = rig_at((0.0, 0.0, 0.0), (0.24, 0.0, 0.0), (0.12, 0.0, 0.0))
    assert (rig.sources, rig.cameras) == ((1, 0), 2)
    assert "c, between the others, is not used" in rig.remarks[0]
    assert disagreement(rig, cameras, scene()).max() < 0.02


def fisheyes() -> tuple[RawCamera, ...]:
    """Of 190 degrees: 60 px a radian over 199 px."""
    return tuple(
        RawCamera(
            200, 200, np.array([[60.0, 0, 99.5], [0, 60.0, 99.5], [0, 0, 1.0]]), np.zeros(4),
            pose(np.eye(3), np.array([0.1 * k, 0.0, 0.0])), f"cam{k}", "equidistant",
        )
        for k in (0, 1)
    )  # fmt: skip


def test_a_wide_fisheye_is_cut_off_and_that_is_said() -> None:
    wide = fisheyes()
    rig = rig_of(Calibration("made", "made", wide))
    (remark,) = rig.remarks
    assert "of 191 x 191 degrees the rectified view shows 120 x 120" in remark
    assert rig.fx == pytest.approx(100.0 / np.tan(np.radians(60.0)))
    assert disagreement(rig, wide, scene()).max() < 0.05
    narrow = rig_of(Calibration("made", "made", wide), 90.0)
    assert narrow.fx == pytest.approx(100.0)


def test_an_angle_that_no_plane_shows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="170; a perspective view takes 0 to 170 degrees"):
        load_rig(write_rectified(tmp_path), fov_deg=170)


def test_swapped_names_are_taken_by_geometry() -> None:
    """The camera called left is on the right: its image becomes the right one."""
    cameras = cameras_at((0.12, 0.0, 0.0), (0.0, 0.0, 0.0))
    rig = rig_of(Calibration("made", "made", cameras, sided=True))
    assert "left and right are swapped: a" in rig.remarks[0]
    called_left, called_right = (np.full(SIZE[::-1], v, np.uint8) for v in (50, 200))
    right, left = rig.rectified((called_right, called_left))
    assert (int(np.median(right)), int(np.median(left))) == (50, 200)


@pytest.mark.parametrize(
    ("places", "words"),
    [
        (((0.0, 0.0, 0.0),), "one camera alone"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.3)), "not side by side"),
        (((0.0, 0.0, 0.0), (0.2, 0.2, 0.0)), "not side by side"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 1e-4)), r"are 0\.1 mm apart, as one camera"),
        (((0.0, 0.0, 0.0),) * 4, r"4 cameras; say which .* cameras=\(0, 1\)"),
    ],
)
def test_what_is_no_rig_is_refused(
    places: tuple[tuple[float, float, float], ...], words: str
) -> None:
    cameras = tuple(camera(at, TURNS[0], "radtan", "c") for at in places)
    with pytest.raises(CalibrationError, match=words):
        rig_of(Calibration("made", "made", cameras))


# --------------------------------------------------------------------------------------------
# Chessboards: corners found in raw images, on one row when rectified, squares of their size

BOARDS = {
    # file, images, numbers, size, board, square, rms or median in px, at the focal length in px
    "opencv": ("stereo_chessboard/opencv/extrinsics.yml", "stereo_chessboard/opencv/{}{:02d}.jpg",
               (1, 4, 6, 9, 13), (640, 480), (9, 6), 1.0, ("rms", 0.30)),
    "barry": ("stereo_chessboard/barry/extrinsics.yml", "stereo_chessboard/barry/{}{:02d}.jpg",
              (2, 7, 11, 16, 21), (640, 512), (9, 6), 24.0, ("rms", 0.25)),
    "fisheye": ("stereo_fisheye/mystereocalib.yml", "stereo_fisheye/imgs/{}{}.jpg",
                (1, 3, 6, 8, 12, 13, 15), (960, 600), (9, 6), 0.02423, ("median", 0.50)),
}  # fmt: skip


@cache
def corners(path: Path, board: tuple[int, int]) -> FloatArray | None:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    found, places = cv2.findChessboardCorners(image, board)
    if not found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    refined = cv2.cornerSubPix(image, places, (5, 5), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2)


@pytest.mark.data
@pytest.mark.parametrize("kind", BOARDS)
def test_corners_lie_on_one_row_and_squares_have_their_size(shared_data: Path, kind: str) -> None:
    """As OpenCV's own rectification of the same files and images: 0.28, 0.23 px rms, 0.38 px."""
    folder = shared_data / "cameras"
    if not folder.is_dir():
        pytest.skip(f"no calibrations at {folder}")
    _, _, numbers, _, _, square, (statistic, most) = BOARDS[kind]
    away, sides, pairs = rows_and_sides(folder, kind, numbers)
    assert pairs == len(numbers)
    value = np.sqrt((away**2).mean()) if statistic == "rms" else np.median(np.abs(away))
    assert value <= most
    assert np.median(sides) == pytest.approx(square, rel=0.01)


def rows_and_sides(
    folder: Path, kind: str, numbers: Iterable[int]
) -> tuple[FloatArray, FloatArray, int]:
    """Differences of rows (n,), pixels, sides of squares (k,), and the pairs that show a board."""
    file, images, _, size, board, _, _ = BOARDS[kind]
    cameras = at_size(read_calibration_file(folder / file), size, False).cameras
    rig = load_rig(folder / file, size=size)
    rows, sides = [], []
    for number in numbers:
        paths = [folder / images.format(side, number) for side in ("left", "right")]
        seen = [corners(path, board) if path.is_file() else None for path in paths]
        if seen[0] is None or seen[1] is None:
            continue
        right, left = (rectified_pixels(rig, cameras[k], seen[k]) for k in rig.sources)
        if np.linalg.norm(right - left[::-1]) < np.linalg.norm(right - left):
            left = left[::-1]
        disparity = left[:, 0] - right[:, 0]
        assert (disparity > 0.0).all()
        rows.append(left[:, 1] - right[:, 1])
        points = rig.triangulate(np.column_stack([right, disparity]))
        grid = points.reshape(board[1], board[0], 3)
        sides += [np.linalg.norm(np.diff(grid, axis=a), axis=2).ravel() for a in (0, 1)]
    return np.concatenate(rows), np.concatenate(sides), len(rows)


def rectified_pixels(rig: StereoRig, one: RawCamera, pixels: FloatArray) -> FloatArray:
    """Raw pixels (n, 2) of a camera in the rectified view."""
    rays = one.unproject(pixels) @ one.bTc[:3, :3].T @ rig.bTc[:3, :3]
    return rig.plain().predict(rays)[:, :2]


# --------------------------------------------------------------------------------------------
# Black borders and masks


def test_a_full_view_has_no_margins_and_a_wider_one_has() -> None:
    calibration = Calibration("made", "made", cameras_at((0.0, 0.0, 0.0), (0.12, 0.0, 0.0)))
    assert rig_of(calibration).margins == ()
    wide = rig_of(calibration, 100.0)
    white = np.full(SIZE[::-1], 255, np.uint8)
    for margin, image in zip(wide.margins, wide.rectified((white, white)), strict=True):
        assert 0.2 < float(np.mean(margin == 0.0)) < 0.6
        assert (image[margin == 0.0] < 255).all()
        assert (image[margin > 1.5] == 255).all()


def test_an_asked_angle_of_view_is_shown_about_the_middle_pixel() -> None:
    size = (101, 51)
    view = chosen_view(cameras_at((0.0, 0.0, 0.0)), [np.eye(3)], size, 90.0)
    np.testing.assert_allclose(view.matrix, [[50.5, 0, 50], [0, 50.5, 25], [0, 0, 1]])


def write_rectified(folder: Path) -> Path:
    values = {"width": 160, "height": 120, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 60.0}
    (folder / "calib.json").write_text(json.dumps(values | {"baseline_m": 0.1}))
    return folder


def test_a_mask_beside_the_calibration_hides_what_is_black(tmp_path: Path) -> None:
    mask = np.full((120, 160), 255, np.uint8)
    mask[90:] = 0
    cv2.imwrite(str(write_rectified(tmp_path) / "mask_left.png"), mask)
    rig = load_rig(tmp_path)
    assert rig.remarks == ("masks hide 25 % of the left images",)
    right, left = rig.margins
    assert np.isinf(right).all()
    assert left[89, 80] == pytest.approx(1.0)
    assert left[60, 80] == pytest.approx(30.0, abs=0.5)
    image = np.arange(120 * 160, dtype=np.uint32).astype(np.uint8).reshape(120, 160)
    np.testing.assert_array_equal(rig.rectified((image, image))[1], image)


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(write_rectified(tmp_path) / "mask_right.png"), np.zeros((60, 80), np.uint8))
    with pytest.raises(CalibrationError, match=r"mask_right\.png: is 80x60, .* 160x120"):
        load_rig(tmp_path)
    (tmp_path / "mask_right.png").write_text("no picture")
    with pytest.raises(CalibrationError, match="is no picture"):
        load_rig(tmp_path)
