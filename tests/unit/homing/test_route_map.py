"""Routes taught on their own: where they are joined, where not, the way, the place of an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgslam as fg
from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, StoredMapError
from fgslam.homing.topological_map import RouteMap, route_of
from tests import textured_room

FINE = textured_room.CAMERA
CAMERA = Equirectangular(301, 91, FINE.top_elevation, FINE.bottom_elevation)
"""Every other pixel of the room's."""
POSTER = slice(150, 250), slice(60, 130)  # of the texture: 1.75 m wide, on one wall


def picture(x: float, y: float, heading: float = 0.0) -> Image:
    pose = np.array([x, y, heading + 1e-3])  # no ray along a wall
    return np.ascontiguousarray(textured_room.picture(pose)[::2, ::2])


def taught(places: Sequence[tuple[float, float]], heading: float) -> fg.PathMemory:
    return fg.teach([picture(x, y, heading) for x, y in places], CAMERA)


def other_texture() -> FloatArray:
    """Another room's walls, but for one poster that hangs in both."""
    shifted = np.roll(textured_room.TEXTURE[::-1, ::-1], 333, axis=1)
    shifted[POSTER] = textured_room.TEXTURE[POSTER]
    return shifted


COUNT = 5
EAST = [(x, 0.1) for x in np.linspace(-2.0, 2.0, COUNT)]
NORTH = [(0.2, y) for y in np.linspace(-2.0, 2.0, COUNT)]


@pytest.fixture(scope="module")
def routes() -> dict[str, fg.PathMemory]:
    """Two that cross in the middle of one room, and a third in another room."""
    there = {"east": taught(EAST, 0.0), "north": taught(NORTH, np.pi / 2)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textured_room, "TEXTURE", other_texture())
        return {**there, "elsewhere": taught(EAST[1:], 0.0)}


@pytest.fixture(scope="module")
def joined(routes: dict[str, fg.PathMemory]) -> RouteMap:
    return RouteMap.join(routes)


def test_routes_that_cross_are_joined_by_true_links(joined: RouteMap) -> None:
    poses = np.array([(x, y, 0.0) for x, y in EAST] + [(x, y, np.pi / 2) for x, y in NORTH])
    between = [link for link in joined.topology.links if link.a < COUNT <= link.b < 2 * COUNT]
    assert len(between) >= 3
    for link in between:
        way = poses[link.b, :2] - poses[link.a, :2]
        off = np.exp(1j * (link.direction - np.arctan2(way[1], way[0])))
        assert np.hypot(*way) < 0.3 or abs(np.angle(off)) < np.deg2rad(6.0)
        assert link.rotation == pytest.approx(np.pi / 2, abs=np.deg2rad(3.0))
    assert {"east/2", "north/2"} <= set(joined.crossroads)


def test_rooms_that_share_a_poster_are_not_joined(joined: RouteMap) -> None:
    assert [len(part) for part in joined.topology.components()] == [2 * COUNT, COUNT - 1]
    with pytest.raises(StoredMapError, match="no way from east/0 to elsewhere/3"):
        joined.way("east/0", "elsewhere")


def test_the_way_turns_off_at_the_crossroads_and_leads_back(joined: RouteMap) -> None:
    way = joined.way("east/0", "north")
    assert (way.names[0], way.names[-1]) == ("east/0", "north/4")
    kinds = [route_of(name) for name in way.names]
    assert kinds == sorted(kinds)  # once from one to the other
    assert len(way) <= 8
    assert joined.way("north", "east/0").names == way.names[::-1]
    assert way.camera == CAMERA
    follower = fg.PathFollower(CAMERA, way, by="looks")
    command = follower.step(picture(-2.0, 0.1), 0.0)
    assert command.place is not None
    assert command.place.nearest == 0


def test_an_image_finds_its_place_and_its_way(joined: RouteMap) -> None:
    place = joined.locate(picture(-1.5, 0.0, 0.7))
    assert place
    assert place.name in ("east/0", "east/1")
    assert place.inliers >= 50
    assert all(link.back_covariance[0, 0] < np.deg2rad(5.0) ** 2 for link in place.links)
    assert joined.way(place, "east/2").names[-1] == "east/2"
    assert joined.way(place, "north").names[-1] == "north/4"


def test_an_image_from_nowhere_is_refused(joined: RouteMap) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (91, 301, 3), np.uint8)
    assert not joined.locate(noise)
    black = joined.locate(np.zeros((91, 301, 3), np.uint8))
    assert not black
    assert "grey" in black.details


def test_a_gap_in_a_route_is_a_way_of_last_resort(routes: dict[str, fg.PathMemory]) -> None:
    """Two rooms on one route: nothing in common there, but somebody drove it."""
    one, other = routes["east"], routes["elsewhere"]
    through = fg.PathMemory(one.images[:3] + other.images[:3], tuple("abcdef"), CAMERA)
    joined = RouteMap.join({"through": through})
    link = joined.link("through/c", "through/d")
    assert link.support == 0
    assert np.isnan(link.direction)
    assert joined.way("through/a", "through").names[-1] == "through/f"
    assert joined.topology.costs.max() > 20.0


def test_a_map_survives_its_file(joined: RouteMap, tmp_path: Path) -> None:
    joined.save(tmp_path / "house.fgmap")
    again = RouteMap.load(tmp_path / "house.fgmap")
    assert again.names == joined.names
    assert again.crossroads == joined.crossroads
    assert again.way("east/0", "north").names == joined.way("east/0", "north").names
    assert again.topology.camera == CAMERA


def test_wrong_routes_and_places_are_refused(
    joined: RouteMap, routes: dict[str, fg.PathMemory]
) -> None:
    with pytest.raises(StoredMapError, match="no route"):
        RouteMap.join({})
    with pytest.raises(StoredMapError, match="no place cellar; its routes are east, north"):
        joined.way("east/0", "cellar")
    with pytest.raises(StoredMapError, match="slash"):
        RouteMap.join({"a/b": routes["east"]})
    alike = fg.PathMemory(routes["east"].images, ("0",) * COUNT, CAMERA)
    with pytest.raises(StoredMapError, match="two path images are called a/0"):
        RouteMap.join({"a": alike})
    few = fg.PathMemory(routes["east"].images[:2], ("0", "1"), None)
    mixed = RouteMap.join({"a": few, "b": fg.PathMemory(few.images, few.names, CAMERA)})
    with pytest.raises(CalibrationError, match="give the image's"):
        mixed.locate(picture(0.0, 0.0))


SPOILED = [
    ("link_cost", lambda a: a * np.nan, "array link_cost"),
    ("link_cost", lambda a: -a, "array link_cost"),
    ("link_support", lambda a: a - 10_000, "array link_support"),
    ("link_ends", lambda a: a[:, ::-1].copy(), "array link_ends"),
    ("link_ends", lambda a: np.repeat(a[:1], len(a), axis=0), "array link_ends"),
    ("link_angles", lambda a: a * [1.0, np.nan, 1.0], "array link_angles"),
    ("link_covariances", lambda a: -a, "array link_covariances, row 0, is no covariance"),
    ("column_tangents", lambda a: a * np.float32(np.inf), "array column_tangents is not finite"),
    ("sift_elevation", lambda a: np.full_like(a, 32767), "array sift_elevation"),
]


@pytest.mark.parametrize(("name", "spoil", "said"), SPOILED)
def test_values_that_no_map_has_are_refused(
    joined: RouteMap, tmp_path: Path, name: str, spoil: Callable[[Any], Any], said: str
) -> None:
    joined.save(tmp_path / "house.fgmap")
    with np.load(tmp_path / "house.fgmap") as file:
        arrays = dict(file)
    with np.errstate(invalid="ignore"):
        arrays[name] = spoil(arrays[name]).astype(arrays[name].dtype)
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(StoredMapError, match=said):
        RouteMap.load(tmp_path / "bad.npz")


def test_places_of_one_name_are_refused(joined: RouteMap, tmp_path: Path) -> None:
    replace(joined.topology, names=("a/0",) * len(joined)).save(tmp_path / "bad.fgmap")
    with pytest.raises(StoredMapError, match="two places have one name"):
        RouteMap.load(tmp_path / "bad.fgmap")
