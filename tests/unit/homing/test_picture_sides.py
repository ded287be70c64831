"""Pictures that fit a route only mirrored or turned over are told, those that are right are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import fgslam as fg
from fgslam.cameras.omni import (
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    MirrorFrame,
    OmniCamera,
)
from fgslam.core.arrays import Image
from fgslam.homing.places import PictureSides
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import DRIVING
from tests import textured_room

FINE = textured_room.CAMERA
CAMERA = Equirectangular(301, 91, FINE.top_elevation, FINE.bottom_elevation)


def seen_at(metres: float) -> Image:
    pose = np.array([-2.0 + metres, 0.4, 0.0])
    return np.ascontiguousarray(textured_room.picture(pose)[::2, ::2])


@pytest.fixture(scope="module")
def path() -> PathMemory:
    return fg.teach([seen_at(metres) for metres in (0.5, 2.0)], CAMERA)


def told(path: PathMemory, turn: Callable[[Image], Image], count: int) -> list[str | None]:
    sides = PictureSides(CAMERA, path, DRIVING)
    found = [sides.look(turn(seen_at(0.3 + 0.5 * k))) for k in range(count)]
    assert not sides.settled
    return found


def test_a_picture_that_fits_settles_it(path: PathMemory) -> None:
    sides = PictureSides(CAMERA, path, DRIVING)
    assert sides.look(seen_at(0.7)) is None
    assert sides.settled


def test_three_pictures_tell_how_they_are_turned(path: PathMemory) -> None:
    over = "upside down: turn them by 180 degrees"
    assert told(path, lambda image: image[::-1, ::-1], 3) == [None, None, over]


def test_pictures_of_another_place_tell_nothing(path: PathMemory) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (91, 301, 3), np.uint8)
    assert told(path, lambda _: noise, 2) == [None, None]


MIRROR = HyperbolicMirror(MirrorFrame(320, 240, (150.0, 120.0)), 15.0, 110.0, 0.92, 60.0)
MATRIX = (90.0, 0.0, 160.0, 0.0, 90.0, 120.0, 0.0, 0.0, 1.0)
FISHEYE = LensCamera(320, 240, "equidistant", MATRIX, (0.0,) * 4, (0.0, 110.0))


@pytest.mark.parametrize(("camera", "key"), [(MIRROR, "clockwise"), (FISHEYE, "middle")])
def test_a_cameras_keys_that_may_be_wrong_are_tried(
    path: PathMemory, camera: OmniCamera, key: str
) -> None:
    """The room as the other camera would see it, told by its key."""
    other = (
        replace(camera, up=True)
        if isinstance(camera, LensCamera)
        else replace(camera, frame=replace(camera.frame, clockwise=False))
    )
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(240.0))
    seen = FINE.pixels(other.rays(np.column_stack([columns.ravel(), rows.ravel()])))
    inside = np.isfinite(seen).all(axis=1)
    sides, said = PictureSides(camera, path, DRIVING), None
    for metres in (0.4, 0.7, 1.8):
        room = textured_room.picture(np.array([-2.0 + metres, 0.4, 0.0]))
        image = np.zeros((320 * 240, 3), np.uint8)
        column, row = np.rint(seen[inside]).astype(int).T
        image[inside] = room[row, column]
        said = sides.look(image.reshape(240, 320, 3))
    assert said is not None
    assert key in said
