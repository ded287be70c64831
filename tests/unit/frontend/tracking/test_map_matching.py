"""Which landmarks are expected in view, and their matches (Se et al. 3.1 and 4.4)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import RIG
from test_landmarks import database_of, landmark_map

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.geometry import transform_to_camera, wrap
from fgslam.core.sensors import CameraRig
from fgslam.core.types import StereoFeatures
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import (
    AppearanceSettings,
    DatabaseSettings,
    MapMatchingSettings,
    SiftSettings,
)
from fgslam.frontend.tracking import map_matching
from fgslam.frontend.tracking.map_matching import (
    BORDER_PX,
    CONE_DEG,
    ExpectedLandmarks,
    FieldOfView,
    MapMatcher,
    MapMatches,
    lean,
)

# ------------------------------------------------------------------------------------------
# Which landmarks are in view: the quick selection is that of a full scan, at any size of map


MAX_DISPARITY = 40.0
TWO_CAMERAS = dataclasses.replace(RIG, vertical_baseline=None)
SETTINGS = {
    "image": DatabaseSettings(),
    "cone": DatabaseSettings(field_of_view="cone"),
}


def full_scan(
    rig: CameraRig, settings: DatabaseSettings, points: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Points (n, 3) of the camera's frame that may be and that are in view, one by one."""
    possible, certain = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    for k, point in enumerate(points):
        if point[2] <= 0.1:
            continue
        column, row, disparity = rig.predict(point[None])[0]
        top = disparity if rig.vertical_baseline is not None else 0.0
        if disparity > MAX_DISPARITY:
            continue
        if settings.field_of_view == "cone":
            tangent = np.tan(np.deg2rad(CONE_DEG))
            possible[k] = certain[k] = bool((np.abs(point[:2]) < tangent * point[2]).all())
            continue
        for out, border in ((possible, -BORDER_PX), (certain, BORDER_PX)):
            out[k] = (
                column >= border
                and column + disparity <= rig.width - 1 - border
                and row >= border
                and row + top <= rig.height - 1 - border
            )
    return possible, certain


@pytest.mark.parametrize("rig", [RIG, TWO_CAMERAS], ids=["three cameras", "two"])
@pytest.mark.parametrize("how", SETTINGS)
def test_the_selection_is_that_of_a_full_scan(how: str, rig: CameraRig) -> None:
    rng = np.random.default_rng(4)
    settings = SETTINGS[how]
    for _ in range(5):
        wTc = g.se3_exp(rng.standard_normal(6))
        # Half of them anywhere, half around the edges of the images, where it matters.
        edge = np.column_stack(
            [
                rng.choice([-8.0, 0.0, 8.0, 311.0, 319.0, 327.0], 400) + rng.normal(0, 0.5, 400),
                rng.uniform(-20.0, 260.0, 400),
                rng.uniform(0.5, 45.0, 400),
            ]
        )
        local = np.concatenate([rng.uniform(-6.0, 6.0, (400, 3)), rig.triangulate(edge)])
        positions = g.transform_to_world(wTc, local)
        found = FieldOfView(rig, settings, MAX_DISPARITY).select(wTc, positions)
        seen_from_there = g.transform_to_camera(wTc, positions)
        possible, certain = full_scan(rig, settings, seen_from_there)
        np.testing.assert_array_equal(found.rows, np.flatnonzero(possible))
        np.testing.assert_array_equal(found.certain, certain[possible])
        np.testing.assert_array_equal(found.points, seen_from_there[possible])
        np.testing.assert_array_equal(found.measurement, rig.predict(found.points))
        assert 10 < len(found.rows) < 700  # a cone is a small part of a cylinder


def test_an_edge_of_the_image_is_inside() -> None:
    """Exactly on the border: neither test may lose it to rounding."""
    at = np.array([[-8.0, 100.0, 10.0], [100.0, -8.0, 10.0], [8.0, 100.0, 10.0]])
    rig = dataclasses.replace(RIG, fx=256.0, fy=256.0, cx=160.0, cy=120.0, baseline=0.125)
    found = FieldOfView(rig, SETTINGS["image"], MAX_DISPARITY).select(
        np.eye(4), rig.triangulate(at)
    )
    assert found.rows.tolist() == [0, 1, 2]
    assert found.certain.tolist() == [False, False, True]


def test_what_is_too_small_to_be_found_is_not_expected() -> None:
    points = RIG.triangulate(np.array([[100.0, 80.0, 10.0], [200.0, 120.0, 20.0]]))
    database = database_of(points, DatabaseSettings(least_scale_px=2.0))
    first_scale = 3.0  # pixels, seen from the origin
    for back, count in ((0.0, 2), (2.0, 1), (6.0, 0)):
        wTc = g.pose(np.eye(3), np.array([0.0, 0.0, -back]))
        scale = first_scale * points[:, 2] / (points[:, 2] + back)
        found = database.expected(landmark_map(points), wTc)
        assert found.ids.tolist() == np.flatnonzero(scale >= 2.0).tolist()
        assert len(found.ids) == count
        np.testing.assert_allclose(found.scale, scale[found.ids])


# ------------------------------------------------------------------------------------------
# Matching features to predicted landmarks (Se et al. 3.1)


PAPER = AppearanceSettings(mode="paper")
DESCRIPTOR = AppearanceSettings(mode="descriptor")
FIXED = MapMatchingSettings(widen_sigmas=0.0, refine=False, rescue=False)
AT = (100.0, 80.0, 10.0)


@pytest.fixture(autouse=True)
def _limited_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_matching, "MAX_WINDOW_PX", 30.0)


def _columns(rows: object, scale: float, orientation_deg: float, descriptors: FloatArray | None):
    measured = np.asarray(rows, np.float64).reshape(-1, 3)
    count = len(measured)
    if descriptors is None:
        descriptors = np.full((count, 128), 45, np.uint8)
    return (
        measured,
        np.full(count, scale),
        np.full(count, np.deg2rad(orientation_deg)),
        np.asarray(descriptors, np.uint8),
    )


def landmarks(
    rows: object = AT, scale=2.0, orientation_deg=30.0, descriptors=None
) -> ExpectedLandmarks:
    measured, scales, orientations, described = _columns(rows, scale, orientation_deg, descriptors)
    ids = 10 + np.arange(len(measured))
    certain = np.ones(len(ids), np.bool_)
    return ExpectedLandmarks(ids, ids - 10, measured, scales, orientations, described, certain)


def features(rows: object, scale=2.0, orientation_deg=30.0, descriptors=None) -> StereoFeatures:
    measured, scales, orientations, described = _columns(rows, scale, orientation_deg, descriptors)
    count = len(measured)
    return StereoFeatures(
        measured,
        np.tile(np.eye(3), (count, 1, 1)),
        scales,
        orientations,
        described,
        np.ones((count, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3, 2)),
    )


def match(
    expected: ExpectedLandmarks,
    found: StereoFeatures,
    appearance: AppearanceSettings = PAPER,
    uncertainty: FloatArray | None = None,
    **changes: object,
) -> MapMatches:
    matcher = MapMatcher(dataclasses.replace(FIXED, **changes), appearance)
    return matcher.match(expected, found, uncertainty)


GATES = {
    "window, right": ((102.49, 80.0, 10.0), (102.51, 80.0, 10.0)),
    "window, left": ((97.51, 80.0, 10.0), (97.49, 80.0, 10.0)),
    "window, down": ((100.0, 82.49, 10.0), (100.0, 82.51, 10.0)),
    "window, up": ((100.0, 77.51, 10.0), (100.0, 77.49, 10.0)),
    "disparity, more": ((100.0, 80.0, 11.99), (100.0, 80.0, 12.01)),
    "disparity, less": ((100.0, 80.0, 8.01), (100.0, 80.0, 7.99)),
}


@pytest.mark.parametrize("appearance", [PAPER, DESCRIPTOR], ids=["paper", "descriptor"])
@pytest.mark.parametrize("gate", GATES)
def test_window_and_disparity(gate: str, appearance: AppearanceSettings) -> None:
    for row, count in zip(GATES[gate], (1, 0), strict=True):
        found = match(landmarks(), features(row), appearance)
        assert len(found.landmarks) == len(found.features) == count
        assert found.had_candidates.tolist() == [bool(count)]


@pytest.mark.parametrize(
    ("scale", "orientation_deg", "count"),
    [
        (2.99, 30.0, 1),
        (3.01, 30.0, 0),
        (1.34, 30.0, 1),
        (1.33, 30.0, 0),
        (2.0, 49.9, 1),
        (2.0, 50.1, 0),
        (2.0, 370.1, 1),
        (2.0, 9.9, 0),
    ],
)
def test_scale_and_orientation(scale: float, orientation_deg: float, count: int) -> None:
    assert len(match(landmarks(), features(AT, scale, orientation_deg)).landmarks) == count


def test_paper_mode_refuses_ambiguity_but_starts_no_new_tracks_there() -> None:
    found = match(landmarks(), features([AT, (101.0, 81.0, 10.5), (200.0, 80.0, 10.0)]))
    assert len(found.landmarks) == 0
    assert found.had_candidates.tolist() == [True, True, False]
    # Two landmarks that want one feature.
    found = match(landmarks([AT, (101.0, 81.0, 10.5)]), features(AT))
    assert len(found.landmarks) == 0
    assert found.had_candidates.tolist() == [True]


def test_descriptors_settle_ambiguity() -> None:
    mine, other = np.zeros((1, 128), np.uint8), np.zeros((1, 128), np.uint8)
    mine[0, 0], other[0, 0] = 10, 120
    found = match(
        landmarks(descriptors=np.zeros((1, 128), np.uint8)),
        features([AT, (101.0, 81.0, 10.5)], descriptors=np.vstack([other, mine])),
        DESCRIPTOR,
    )
    assert found.landmarks.tolist() == [0]
    assert found.features.tolist() == [1]
    assert found.had_candidates.all()


def test_uncertainty_widens_each_gate_by_itself() -> None:
    """Half a window of 2.5 px and 2 px of disparity, and three sigmas of each coordinate."""
    sigma = np.array([[2.0, 1.0, 0.5]])
    inside = [(108.4, 80.0, 10.0), (100.0, 85.4, 10.0), (100.0, 80.0, 13.4)]
    outside = [(108.6, 80.0, 10.0), (100.0, 85.6, 10.0), (100.0, 80.0, 13.6)]
    for row in inside:
        assert len(match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=sigma).features)
    for row in outside:
        found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=sigma)
        assert len(found.features) == 0


def test_widening_is_per_landmark() -> None:
    two = landmarks([AT, (200.0, 80.0, 10.0)])
    sigma = np.array([[3.0, 3.0, 3.0], [0.0, 0.0, 0.0]])
    away = features([(106.0, 80.0, 10.0), (206.0, 80.0, 10.0)])
    found = match(two, away, widen_sigmas=3.0, uncertainty=sigma)
    assert found.landmarks.tolist() == [0]


def test_widening_has_a_limit_but_never_narrows(monkeypatch: pytest.MonkeyPatch) -> None:
    vast = np.full((1, 3), 1e3)
    for offset, count in ((14.9, 1), (15.1, 0)):
        row = (100.0 + offset, 80.0, 10.0)
        found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=vast)
        assert len(found.features) == count
    # A limit below the paper's window leaves that as it is.
    monkeypatch.setattr(map_matching, "MAX_WINDOW_PX", 2.0)
    row = (102.4, 80.0, 10.0)
    found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=vast)
    assert len(found.features) == 1


def test_anywhere_searches_the_largest_window() -> None:
    matcher = MapMatcher(FIXED, DESCRIPTOR)
    for offset, count in ((14.9, 1), (15.1, 0)):
        row = (100.0, 80.0 - offset, 10.0)
        assert len(matcher.match(landmarks(), features(row)).features) == 0
        assert len(matcher.match_anywhere(landmarks(), features(row)).features) == count


def test_matching_without_landmarks_or_features_finds_nothing() -> None:
    none, one = np.empty((0, 3)), [AT]
    for rows, seen in ((none, none), (none, one), (one, none)):
        for appearance in (PAPER, DESCRIPTOR):
            found = match(landmarks(rows), features(seen), appearance)
            assert len(found.landmarks) == len(found.features) == 0
            assert found.had_candidates.shape == (len(seen),)
            assert not found.had_candidates.any()


def test_a_feature_that_resembles_no_landmark_is_new() -> None:
    other = np.full((1, 128), 200, np.uint8)
    found = match(
        landmarks(descriptors=np.zeros((1, 128), np.uint8)),
        features(AT, descriptors=other),
        DESCRIPTOR,
    )
    assert len(found.features) == 0
    assert not found.had_candidates.any()


def test_incomplete_features_are_matched_where_nothing_complete_resembles() -> None:
    apart = np.zeros((2, 128), np.uint8)
    apart[1, 0] = 200
    expected = landmarks([AT, (200.0, 80.0, 10.0)], descriptors=apart)
    near = (101.0, 80.0, 10.0)
    complete = features([near, AT, (200.0, 80.0, 10.0)], descriptors=apart[[0, 0, 1]])
    found = match(
        expected,
        dataclasses.replace(complete, complete=np.array([True, False, False])),
        DESCRIPTOR,
    )
    # The incomplete one at the very place neither replaces the complete one nor makes it ambiguous.
    assert found.landmarks.tolist() == [0, 1]
    assert found.features.tolist() == [0, 2]


def test_an_ambiguous_landmark_is_not_given_to_an_incomplete_feature() -> None:
    described = np.zeros((3, 128), np.uint8)
    described[:2, 0] = 100
    rows = [(99.0, 80.0, 10.0), (101.0, 80.0, 10.0), AT]
    found = dataclasses.replace(
        features(rows, descriptors=described), complete=np.array([True, True, False])
    )
    assert len(match(landmarks(descriptors=described[2:]), found, DESCRIPTOR).landmarks) == 0


# ------------------------------------------------------------------------------------------
# Predicted orientations of features where the camera rolls and pitches


def rig_of(width: int, height: int) -> CameraRig:
    return CameraRig(
        fx=float(width), fy=float(width), cx=(width - 1) / 2, cy=(height - 1) / 2, width=width,
        height=height, baseline=0.2, vertical_baseline=None, bTc=np.eye(4),
    )  # fmt: skip


RIG = rig_of(320, 240)
GATE = np.deg2rad(20.0)


def turned(euler_deg: tuple[float, float, float]) -> FloatArray:
    """(4, 4) pose of a camera that yaws, pitches and rolls about its axes (y, x, z), degrees."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("YXZ", euler_deg, degrees=True).as_matrix()
    return pose


def pixels(points: FloatArray) -> FloatArray:
    return np.asarray(points[:, :2] / points[:, 2:] * RIG.fx)


@pytest.mark.parametrize("angles", [(0, 0, 25), (30, 0, 25), (20, -15, -40), (-60, 30, 10)])
def test_lean_is_how_a_short_upright_line_is_turned(angles: tuple[float, float, float]) -> None:
    wTc = turned(angles)
    points = np.random.default_rng(1).uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    ends = points + 1e-5 * wTc[1, :3]  # a little down in the world
    along = pixels(ends) - pixels(points)
    expected = np.arctan2(along[:, 1], along[:, 0]) - 0.5 * np.pi
    np.testing.assert_allclose(wrap(lean(RIG, wTc, points) - expected), 0.0, rtol=0, atol=1e-4)


@pytest.mark.data
@pytest.mark.parametrize("roll_deg", [-25.0, 45.0])
def test_a_rolled_view_keeps_its_features_within_the_gate(
    shared_data: Path, roll_deg: float
) -> None:
    """A view of the chess grid, and the same turned about its middle: a camera that rolls."""
    path = shared_data / "stanford_chess_grid" / "r08_c08.png"
    if not path.is_file():
        pytest.skip(f"no picture {path}: this test needs it")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    height, width = image.shape
    rig = rig_of(width, height)
    extractor = SiftExtractor(SiftSettings(), "descriptor")
    wTc = turned((0.0, 0.0, roll_deg))
    level = extractor.extract(image)
    # What the camera sees turns the other way.
    seen = cv2.warpAffine(
        image, cv2.getRotationMatrix2D((rig.cx, rig.cy), roll_deg, 1.0), (width, height)
    )
    rolled = extractor.extract(seen)
    rays = np.column_stack([(level.xy - [rig.cx, rig.cy]) / width, np.ones(len(level.xy))])
    points = transform_to_camera(wTc, rays)
    places = points[:, :2] / points[:, 2:] * width + [rig.cx, rig.cy]
    apart = np.linalg.norm(places[:, None] - rolled.xy, axis=2)
    like = np.abs(np.log(level.scale[:, None] / rolled.scale)) < np.log(1.2)
    i, j = np.nonzero((apart < 1.0) & like)  # one place may have features of several orientations
    turn = rolled.orientation[j] - level.orientation[i]
    within = np.abs(wrap(turn - lean(rig, wTc, points)[i])) < GATE
    unturned = np.abs(wrap(turn)) < GATE
    found = len(np.unique(i))
    assert found > 100
    assert len(np.unique(i[within])) > 0.9 * found
    assert len(np.unique(i[unturned])) < 0.25 * found
