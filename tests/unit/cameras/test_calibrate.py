"""Cameras found from corners of a board: simulated ones against the truth, within their sigmas."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgslam.cameras import calibrate as module
from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.calibrate import (
    BoardCalibration,
    View,
    board_pose,
    calibrate,
    coverage,
    coverage_of_circle,
    farthest_from_axis,
    held_out,
    held_out_alone,
    judged,
)
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, se3_exp, so3_exp
from fgslam.runs.calibrating import wide_verdict

BOARD = Board("chessboard", 9, 6, 0.04)
SIZE = (640, 480)
NOISE_PX = 0.1
PARAMETERS = {
    "radtan": np.array([-0.3, 0.1, 0.001, -0.0005, -0.01]),
    "equidistant": np.array([0.02, -0.01, 0.004, -0.001]),
}
POSES = (
    np.zeros(6),
    np.array([0.01, -0.02, 0.015, 0.1, 0.002, 0.001]),
    np.array([-0.02, 0.01, 0.0, 0.05, -0.09, 0.0]),
)


def rig(model: str, cameras: int) -> list[RawCamera]:
    focal = 450.0 if model == "radtan" else 210.0
    return [
        RawCamera(
            *SIZE,
            np.array([[focal + k, 0.0, 320.0 + 5 * k], [0.0, focal - k, 240.0], [0, 0, 1.0]]),
            PARAMETERS[model],
            se3_exp(turn),
            model=model,
        )
        for k, turn in enumerate(POSES[:cameras])
    ]


def seen_by(
    cameras: list[RawCamera], rng: np.random.Generator, count: int = 14, board: Board = BOARD
) -> list[View]:
    """Boards at random before the cameras; corners outside an image are not seen by it."""
    views: list[View] = []
    centred = board.points - board.points.mean(axis=0)
    while len(views) < count:
        away = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.3, 0.7)])
        points = centred @ so3_exp(rng.uniform(-0.5, 0.5, 3)).T + away
        views.append(tuple(_corners(camera, points, rng) for camera in cameras))
    return views


def _corners(camera: RawCamera, points: FloatArray, rng: np.random.Generator) -> Corners | None:
    cTf = inverse(camera.bTc)
    pixels = camera.project(points @ cTf[:3, :3].T + cTf[:3, 3])
    inside = ((pixels >= 0) & (pixels <= np.array(SIZE) - 1)).all(axis=1)
    if inside.sum() < 20:
        return None
    noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
    return Corners(np.flatnonzero(inside), noisy[inside])


def normalised_error(found: BoardCalibration, true: list[RawCamera]) -> float:
    """Mean squared error over the stated variance, of all intrinsics and positions."""
    parts = []
    for k, (camera, exact) in enumerate(zip(found.cameras, true, strict=True)):
        rows = ((0, 0), (1, 1), (0, 2), (1, 2))
        intrinsics = [camera.matrix[at] - exact.matrix[at] for at in rows]
        off = np.concatenate([intrinsics, camera.distortion - exact.distortion])
        parts.append(off / found.sigmas[k])
        if k:
            shift = inverse(camera.bTc)[:3, 3] - inverse(exact.bTc)[:3, 3]
            parts.append(shift / found.turn_sigmas[k, 3:])
    return float(np.mean(np.concatenate(parts) ** 2))


@pytest.mark.parametrize(
    ("model", "cameras"),
    [pytest.param("radtan", 3, marks=pytest.mark.slow), ("equidistant", 2)],
)
def test_cameras_are_found_and_their_uncertainty_is_honest(model: str, cameras: int) -> None:
    errors = []
    for seed in range(4):
        true = rig(model, cameras)
        views = seen_by(true, np.random.default_rng(seed))
        found = calibrate(BOARD, views, SIZE, model)
        assert found.rms == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
        assert found.left_out == 0
        errors.append(normalised_error(found, true))
    assert 0.6 < np.mean(errors) < 1.6  # 130 to 200 numbers, of which those of a lens correlate


def test_corners_that_were_found_wrongly_are_left_out() -> None:
    rng = np.random.default_rng(3)
    true = rig("radtan", 2)
    views = seen_by(true, rng)
    spoilt = 0
    for k in range(0, 14, 2):
        corners = views[k][1]
        if corners is None:
            continue
        pixels = corners.pixels.copy()
        pixels[:4] += 5.0
        spoilt += 4
        views[k] = (views[k][0], Corners(corners.ids, pixels))
    assert spoilt >= 12
    found = calibrate(BOARD, views, SIZE, "radtan")
    assert spoilt <= found.left_out <= spoilt + 3
    assert normalised_error(found, true) < 2.0


@pytest.mark.parametrize(
    ("columns", "rows", "rolled"),
    [
        (8, 6, np.pi),
        pytest.param(8, 6, 0.0, marks=pytest.mark.slow),
        pytest.param(6, 6, 0.0, marks=pytest.mark.slow),
    ],
)
def test_boards_that_look_the_same_after_a_turn_are_numbered_alike(
    columns: int, rows: int, rolled: float
) -> None:
    """The right camera, which may hang upside down, sees half of the boards turned."""
    board, rng = Board("chessboard", columns, rows, 0.04), np.random.default_rng(2)
    left, right = rig("radtan", 2)
    right = replace(right, bTc=right.bTc @ se3_exp(np.array([0, 0, rolled, 0, 0, 0])))
    ways, straight = board.renumberings, seen_by([left, right], rng, 12, board)
    turned: list[View] = []
    for k, (a, b) in enumerate(straight):
        way = ways[k % len(ways)]
        turned.append((a, None if b is None else Corners(way[b.ids], b.pixels)))
    expected, found = (calibrate(board, views, SIZE, "radtan") for views in (straight, turned))
    assert found.left_out == expected.left_out
    np.testing.assert_allclose(found.turns, expected.turns, rtol=0, atol=1e-6)
    assert np.linalg.norm(found.turns[1, 3:]) == pytest.approx(0.1, rel=0.01)
    shown = judged(board, found, found.views, 1)
    assert shown is not None
    assert shown.square == pytest.approx(0.04, rel=2e-3)


def test_held_out_images_show_rows_and_squares() -> None:
    true = rig("radtan", 2)
    views = seen_by(true, np.random.default_rng(5), count=20)
    held = held_out(BOARD, views, SIZE, "radtan")
    assert held is not None
    assert held.rows_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.3)
    assert held.square == pytest.approx(0.04, rel=2e-3)
    found = calibrate(BOARD, views, SIZE, "radtan")
    turned = replace(
        found.cameras[1], bTc=found.cameras[1].bTc @ se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))
    )
    knocked = judged(BOARD, replace(found, cameras=(found.cameras[0], turned)), views, 1)
    assert knocked is not None
    assert knocked.rows_px > 10 * held.rows_px
    assert 0.5 < coverage(views, 0, SIZE) <= 1.0


def test_too_few_images_and_cameras_that_never_see_the_board_together_are_refused() -> None:
    views = seen_by(rig("radtan", 2), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match="the left camera shows the board in 4 images"):
        calibrate(BOARD, views[:4], SIZE, "radtan")
    apart: list[View] = [(a, None) if k % 2 else (None, b) for k, (a, b) in enumerate(views)]
    with pytest.raises(CalibrationError, match="never see the board at once"):
        calibrate(BOARD, apart, SIZE, "radtan")


def test_boards_that_no_camera_saw_are_refused_in_one_line() -> None:
    """Corners at perspectives of which no two have the same focal length."""
    rng = np.random.default_rng(6)
    flat = (BOARD.points[None, :, :2] * 1000.0 + 100.0).astype(np.float32)
    edge = np.array([[0, 0], [400, 0], [400, 320], [0, 320]], np.float32)
    views: list[View] = []
    for _ in range(8):
        there = edge + rng.uniform(-40.0, 40.0, (4, 2)).astype(np.float32)
        pixels = cv2.perspectiveTransform(flat, cv2.getPerspectiveTransform(edge, there))
        views.append((Corners(np.arange(len(BOARD.points)), pixels[0].astype(np.float64)),))
    with pytest.raises(CalibrationError, match="off what radtan cameras show of a flat board"):
        calibrate(BOARD, views, SIZE, "radtan")


# --------------------------------------------------------------------------------------------
# Single wide cameras, drawn


SEEDS = range(4)
FISHEYE_F = 480.0 / np.radians(92.5)  # 185 degrees over the picture


def camera(model: str, size: tuple[int, int], numbers: list[float]) -> RawCamera:
    matrix = intrinsic_matrix(*numbers[:4])
    return RawCamera(*size, matrix, np.array(numbers[4:]), np.eye(4), model=model)


CAMERAS = {
    "mirror": camera(
        "omni", (640, 480), [250.0, 251.0, 322.0, 243.0, 0.95, -0.05, 0.01, 0.001, -0.0005]
    ),
    "unified": camera(
        "omni", (640, 480), [420.0, 419.0, 315.0, 235.0, 1.6, -0.25, 0.2, 0.001, -0.0005]
    ),
    "fisheye": camera(
        "equidistant",
        (960, 960),
        [FISHEYE_F, FISHEYE_F + 1.0, 478.0, 485.0, 0.02, -0.008, 0.002, -0.0003],
    ),
}
WIDEST_DEG = {"mirror": 105.0, "unified": 80.0, "fisheye": 92.0}


def views_of(name: str, seed: int, count: int = 16, mirrored: bool = False) -> list[View]:
    """Boards all around the camera, tilted at random; corners outside the image are not seen."""
    rng, seen_by = np.random.default_rng(seed), CAMERAS[name]
    centred = BOARD.points - BOARD.points.mean(axis=0)
    views: list[View] = []
    while len(views) < count:
        angle = np.radians(WIDEST_DEG[name]) * np.sqrt(rng.uniform())
        around = rng.uniform(0.0, 2.0 * np.pi)
        ahead = np.array(
            [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
        )
        side = np.cross(rng.normal(size=3), ahead)
        side /= np.linalg.norm(side)
        facing = np.column_stack([side, np.cross(-ahead, side), -ahead])
        tilted = centred @ so3_exp(rng.uniform(-0.5, 0.5, 3)).T @ facing.T
        pixels = seen_by.project(tilted + ahead * rng.uniform(0.25, 0.6))
        last = np.array(seen_by.size) - 1
        inside = np.isfinite(pixels).all(axis=1) & ((pixels >= 0) & (pixels <= last)).all(axis=1)
        if inside.sum() < 20:
            continue
        noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
        if mirrored:
            noisy = np.column_stack([last[0] - noisy[:, 0], noisy[:, 1]])
        views.append((Corners(np.flatnonzero(inside), noisy[inside]),))
    return views


def numbers_of(found: RawCamera) -> FloatArray:
    return np.concatenate([found.intrinsics, found.distortion])


def in_sigmas(found: BoardCalibration, name: str) -> FloatArray:
    off = numbers_of(found.cameras[0]) - numbers_of(CAMERAS[name])
    return np.asarray(off / found.sigmas[0])


@pytest.mark.parametrize(
    "name",
    ["fisheye", *(pytest.param(name, marks=pytest.mark.slow) for name in ("mirror", "unified"))],
)
def test_the_true_camera_is_found_within_its_sigmas(name: str) -> None:
    true, errors = CAMERAS[name], []
    for seed in SEEDS:
        found = calibrate(BOARD, views_of(name, seed), true.size, true.model)
        assert found.rms == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
        assert found.left_out == 0
        errors.append(in_sigmas(found, name))
    # 32 to 36 numbers, of which those of a lens correlate.
    assert 0.5 < np.mean(np.square(errors)) < 1.8
    assert np.abs(errors).max() < 4.0


def test_a_picture_in_a_mirror_gives_the_same_camera() -> None:
    """Reflected, a flat board is one seen from behind: the columns alone count backward."""
    true = CAMERAS["mirror"]
    found = calibrate(BOARD, views_of("mirror", 1, mirrored=True), true.size, true.model)
    numbers = numbers_of(found.cameras[0])
    expected = numbers_of(true)
    expected[2] = true.width - 1 - expected[2]
    expected[8] = -expected[8]  # the lens's second tangential term
    np.testing.assert_allclose((numbers - expected) / found.sigmas[0], 0.0, rtol=0, atol=4.0)


def test_held_out_images_and_coverage() -> None:
    true, views = CAMERAS["fisheye"], views_of("fisheye", 2, count=30)
    held = held_out_alone(BOARD, views, true.size, true.model)
    assert held is not None
    assert held.views.tolist() == list(range(1, 30, 2))
    assert held.off_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.25)
    assert held.each_px.max() < 3 * NOISE_PX
    assert 0.8 < coverage_of_circle(views, true) <= 1.0
    ahead: list[View] = [(corners,) for corners in [views[0][0]] * 5]
    assert coverage_of_circle(ahead, true) < 0.3
    assert 80.0 < np.degrees(farthest_from_axis(views, true)) < 115.0
    assert held_out_alone(BOARD, views[:8], true.size, true.model) is None


def test_too_few_views_and_boards_that_are_all_far_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The latter whether or not the fit has come to an end."""
    monkeypatch.setattr(module, "MOST_STEPS", 30)
    views = views_of("fisheye", 0, count=12)
    size = CAMERAS["fisheye"].size
    with pytest.raises(CalibrationError, match="the camera shows the board in 4 images"):
        calibrate(BOARD, views[:4], size, "equidistant")
    ahead = BOARD.points + np.array([0.0, 0.0, 3.0])
    rng, pixels = np.random.default_rng(0), CAMERAS["fisheye"].project(ahead)
    far: list[View] = [
        (Corners(np.arange(len(pixels)), pixels + rng.normal(0.0, NOISE_PX, pixels.shape)),)
        for _ in range(8)
    ]
    with pytest.raises(CalibrationError, match="do not determine the cameras"):
        calibrate(BOARD, far, size, "omni")


def test_an_image_without_a_pose_is_left_out_of_the_calibration() -> None:
    """Its corners lie where no ray of the camera ends."""
    true, views = CAMERAS["fisheye"], views_of("fisheye", 3, count=12)
    beyond = 4000.0 + 1e3 * BOARD.points[:, :2]
    given: list[View] = [*views[:4], (Corners(np.arange(54), beyond),), *views[4:]]
    found = calibrate(BOARD, given, true.size, true.model)
    assert found.kept[4] == (None,)
    assert found.left_out == 54
    assert np.isnan(found.boards[4]).all()
    assert [len(c) for (c,) in found.kept if c is not None] == [len(v[0]) for v in views if v[0]]
    assert numbers_of(found.cameras[0])[:4] == pytest.approx(numbers_of(true)[:4], abs=1.0)


def test_a_fit_that_does_not_converge_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_STEPS", 2)
    true = CAMERAS["fisheye"]
    with pytest.raises(CalibrationError, match="do not determine the cameras"):
        calibrate(BOARD, views_of("fisheye", 0), true.size, true.model)


def test_a_corner_that_is_left_out_counts_for_nothing() -> None:
    """The corner farthest from the axis was found 20 px farther out."""
    true, views = CAMERAS["fisheye"], views_of("fisheye", 2, count=12)
    middle, seen = true.matrix[:2, 2], [c for (c,) in views if c is not None]
    v = int(np.argmax([np.linalg.norm(c.pixels - middle, axis=1).max() for c in seen]))
    moved = seen[v].pixels.copy()
    outward = moved - middle
    corner = int(np.argmax(np.linalg.norm(outward, axis=1)))
    moved[corner] += 20.0 * outward[corner] / np.linalg.norm(outward[corner])
    given: list[View] = [*views[:v], (Corners(seen[v].ids, moved),), *views[v + 1 :]]
    found = calibrate(BOARD, given, true.size, true.model)
    assert found.left_out == 1
    (used,) = found.kept[v]
    assert used is not None
    np.testing.assert_array_equal(used.ids, np.delete(seen[v].ids, corner))
    angles = [np.degrees(farthest_from_axis(w, found.cameras[0])) for w in (given, found.kept)]
    assert angles[0] > angles[1] + 1.0
    (view, *_) = wide_verdict([], found, None)
    assert f"corners up to {angles[1]:.0f} degrees" in view


def test_a_board_beside_the_camera_has_a_pose() -> None:
    """Its middle is 90 degrees from the axis, where depth over z has no meaning."""
    true = CAMERAS["fisheye"]
    rotation = so3_exp(np.array([0.0, 1.4, 0.0]))
    expected = np.array([0.3, -0.1, 0.02])
    points = BOARD.points @ rotation.T + expected
    pixels = true.project(points)
    assert np.isfinite(pixels).all()
    cTb = board_pose(true, BOARD.points, pixels)
    assert cTb is not None
    np.testing.assert_allclose(cTb[:3, 3], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(cTb[:3, :3], rotation, rtol=0, atol=1e-6)
