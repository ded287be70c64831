"""The kidnapped robot: found where it is, refused where it cannot be known."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose, so3_exp
from fgslam.core.types import Relocalisation, RelocalisationStatus, StereoFeatures
from fgslam.frontend.places import relocalisation as relocaliser
from fgslam.frontend.places.relocalisation import LEAST_INLIERS, Relocaliser
from fgslam.frontend.settings import RelocalisationSettings
from tests.known_places import RIG, Place, error, floor, planar, room, seen, things

DEFAULTS = RelocalisationSettings(map_sigma_m=0.001)


@pytest.fixture(autouse=True)
def _exact_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated features are where their landmarks are, from wherever they are seen."""
    monkeypatch.setattr(relocaliser, "VIEW_SIGMA_PX", 0.0)


def _relocaliser(
    place: Place, dof: int = 3, settings: RelocalisationSettings = DEFAULTS
) -> Relocaliser:
    made = Relocaliser(RIG, floor(dof), settings)  # type: ignore[arg-type]
    made.learn(*place.map())
    return made


def _same(a: Relocalisation, b: Relocalisation) -> bool:
    arrays = ("wTc", "covariance", "features", "ids")
    equal = all(np.array_equal(getattr(a, n), getattr(b, n), equal_nan=True) for n in arrays)
    return equal and a.why == b.why and a.status == b.status


def test_pose_on_the_floor_is_found_without_a_prior(rng: np.random.Generator) -> None:
    place, truth = room(rng), planar(1.2, -0.7, 2.1)
    view = seen(place, truth, rng, clutter=60)
    found = _relocaliser(place).locate(view, rng)
    assert found.found, found.why
    metres, degrees = error(found.wTc, truth)
    assert metres < 0.05
    assert degrees < 0.5
    assert np.array_equal(np.unique(found.ids), np.sort(found.ids))
    assert len(found.features) == len(found.ids) > 20
    assert found.wTc[1, 3] == 0.0
    assert found.covariance[4, 4] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("dof", [5, 6])
def test_pose_in_space_is_found_in_any_orientation(rng: np.random.Generator, dof: int) -> None:
    place = things(rng, np.array([-4.0, -1.5, -4.0]), np.array([4.0, 1.0, 4.0]), 2500)
    height = 0.0 if dof == 5 else -0.4
    truth = pose(so3_exp(np.array([0.3, 1.9, -0.5])), np.array([0.5, height, 1.0]))
    view = seen(place, truth, rng, clutter=60, roll=0.5)
    found = _relocaliser(place, dof).locate(view, rng)
    assert found.found, found.why
    metres, degrees = error(found.wTc, truth)
    assert metres < 0.05
    assert degrees < 0.5


def test_matches_tell_which_feature_is_which_landmark(rng: np.random.Generator) -> None:
    place, truth = room(rng), planar(0.0, 0.0, 0.3)
    view = seen(place, truth, rng)
    found = _relocaliser(place).locate(view, rng)
    landmarks, _ = place.map()
    there = landmarks.positions[landmarks.rows(found.ids)]
    here = view.position[found.features] @ truth[:3, :3].T + truth[:3, 3]
    sideways = np.linalg.norm((there - here)[:, 1])
    assert sideways < 0.1 * len(there)
    assert np.median(np.linalg.norm(there - here, axis=1)) < 0.3


def test_the_same_frame_and_seed_give_the_same_bytes(rng: np.random.Generator) -> None:
    place = room(rng)
    view = seen(place, planar(0.4, 0.4, 1.0), rng, clutter=40)
    both = [_relocaliser(place).locate(view, np.random.default_rng(5)) for _ in range(2)]
    assert _same(*both)


def test_an_unknown_place_is_refused(rng: np.random.Generator) -> None:
    view = seen(room(rng), planar(0.0, 0.0, 0.0), rng, clutter=50)
    assert not _relocaliser(room(rng)).locate(view, rng).found


def _two_posters(rng: np.random.Generator) -> tuple[Place, Place]:
    """A poster on the north wall and the same one on the same wall, six metres to the east."""
    poster = things(rng, np.array([-3.5, -0.5, 4.99]), np.array([-2.5, 0.5, 5.0]), 60)
    return poster, poster.moved(np.array([6.0, 0.0, 0.0]))


def test_alike_places_that_fill_the_view_are_ambiguous(rng: np.random.Generator) -> None:
    west, east = _two_posters(rng)
    for truth in (planar(-3.0, 3.0, 0.0), planar(3.0, 3.0, 0.0)):
        found = _relocaliser(west.join(east)).locate(seen(west.join(east), truth, rng), rng)
        assert found.status is RelocalisationStatus.AMBIGUOUS, found.why
        assert found.second > 20


def test_alike_places_are_distinguished_by_their_surroundings(rng: np.random.Generator) -> None:
    west, east = _two_posters(rng)
    place = west.join(east).join(room(rng, 900))
    made = _relocaliser(place)
    for truth in (planar(-3.0, 1.0, 0.0), planar(3.0, 1.0, 0.0)):
        found = made.locate(seen(place, truth, rng), rng)
        assert found.found, found.why
        assert error(found.wTc, truth)[0] < 0.1


def test_a_poster_carried_elsewhere_is_refused(rng: np.random.Generator) -> None:
    """The map knows the poster and its wall; the frame shows the poster on a wall unknown."""
    poster, elsewhere = _two_posters(rng)
    wall = things(rng, np.array([-5.0, -1.5, 4.9]), np.array([-1.0, 1.0, 5.1]), 200)
    small = poster.select(np.arange(0, 60, 2))
    view = seen(elsewhere.select(np.arange(0, 60, 2)), planar(3.0, 1.0, 0.0), rng, clutter=80)
    vague = replace(DEFAULTS, max_sigma_m=1.0, max_sigma_deg=20.0)  # its covariance shall not help
    found = _relocaliser(small.join(wall), settings=vague).locate(view, rng)
    assert found.status is RelocalisationStatus.CONTRADICTED, found.why


@pytest.mark.parametrize("kept", [0.95, 0.7])
def test_alike_places_stay_ambiguous_where_one_is_better_mapped(
    rng: np.random.Generator, kept: float
) -> None:
    """The map lost some landmarks of either."""
    west, east = _two_posters(rng)
    parts = (thing.select(np.flatnonzero(rng.random(60) < kept)) for thing in (west, east))
    made = _relocaliser(next(parts).join(next(parts)))
    for thing, x in ((west, -3.0), (east, 3.0)):
        found = made.locate(seen(thing, planar(x, 2.5, 0.0), rng), rng)
        assert found.status is RelocalisationStatus.AMBIGUOUS, found.why


@pytest.mark.parametrize("count", [0, 1, 2, 3])
@pytest.mark.parametrize("dof", [3, 6])
def test_few_features_are_too_few(rng: np.random.Generator, count: int, dof: int) -> None:
    place = room(rng)
    view = seen(place, planar(0.0, 0.0, 0.0), rng)
    found = _relocaliser(place, dof).locate(_first(view, count), rng)
    assert found.status in (
        RelocalisationStatus.TOO_FEW_MATCHES,
        RelocalisationStatus.TOO_FEW_INLIERS,
    )
    assert str(LEAST_INLIERS) in found.why


def test_an_empty_map_finds_nothing(rng: np.random.Generator) -> None:
    view = seen(room(rng), planar(0.0, 0.0, 0.0), rng)
    empty = Relocaliser(RIG, floor(3), DEFAULTS)
    found = empty.locate(view, rng)
    assert found.status is RelocalisationStatus.TOO_FEW_MATCHES
    assert np.isnan(found.covariance).all()
    assert not len(found.ids)


@pytest.mark.parametrize("dof", [3, 6])
def test_landmarks_on_a_vertical_line_fix_no_pose(rng: np.random.Generator, dof: int) -> None:
    """All turns about the line see the same."""
    line = things(rng, np.array([0.5, -1.0, 4.0]), np.array([0.5, 1.0, 4.0]), 60)
    found = _relocaliser(line, dof).locate(seen(line, planar(0.0, 0.0, 0.0), rng), rng)
    assert not found.found, found.why


def test_one_plane_is_enough(rng: np.random.Generator) -> None:
    wall = things(rng, np.array([-4.0, -1.5, 5.0]), np.array([4.0, 1.0, 5.0]), 300)
    truth = planar(0.3, 1.0, 0.2)
    for dof in (3, 6):
        found = _relocaliser(wall, dof).locate(seen(wall, truth, rng), rng)
        assert found.found, found.why
        assert error(found.wTc, truth)[0] < 0.05


def test_a_submap_counts_what_lies_outside_the_image(rng: np.random.Generator) -> None:
    """Features of earlier frames, in the last camera's frame, some behind it."""
    place, last = room(rng), planar(0.0, 0.0, 0.0)
    views = [seen(place, turned, rng) for turned in (planar(0.0, 0.0, 2.8), planar(0.0, 0.0, 1.6))]
    poses = [planar(0.0, 0.0, 2.8), planar(0.0, 0.0, 1.6)]
    parts = [_carried(view, at) for view, at in zip(views, poses, strict=True)]
    submap = _joined([*parts, seen(place, last, rng)])
    assert (submap.position[:, 2] < 0.0).any()
    found = _relocaliser(place).locate(submap, rng)
    assert found.found, found.why
    assert error(found.wTc, last)[0] < 0.05
    assert (submap.position[found.features, 2] < 0.0).any()


def test_nothing_handed_in_is_changed(rng: np.random.Generator) -> None:
    place = room(rng)
    landmarks, views = place.map()
    view = seen(place, planar(0.0, 0.0, 0.0), rng)
    before = [a.copy() for a in (landmarks.positions, views.descriptors, view.measurement)]
    made = Relocaliser(RIG, floor(3), DEFAULTS)
    made.learn(landmarks, views)
    made.locate(view, rng)
    after = (landmarks.positions, views.descriptors, view.measurement)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def _first(view: StereoFeatures, count: int) -> StereoFeatures:
    return view.select(np.arange(count))


def _joined(views: list[StereoFeatures]) -> StereoFeatures:
    return functools.reduce(StereoFeatures.join, views)


def _carried(view: StereoFeatures, lTc: FloatArray) -> StereoFeatures:
    """Features in the frame of another camera, where most project nowhere."""
    rotation = lTc[:3, :3]
    return replace(
        view,
        measurement=np.full_like(view.measurement, -1e4),
        position=view.position @ rotation.T + lTc[:3, 3],
        position_covariance=rotation @ view.position_covariance @ rotation.T,
    )
