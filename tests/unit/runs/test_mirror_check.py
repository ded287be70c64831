"""A mirror that lies off the stated centre is reported with the measured offset."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import textured_room

from fgslam.cameras.omni import HyperbolicMirror, MirrorFrame
from fgslam.cameras.settings import (
    EquirectangularSettings,
    HyperbolicMirrorSettings,
    OCamCalibSettings,
)
from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError
from fgslam.datasets.omni import camera_notes
from fgslam.datasets.opening import open_checked, open_omni
from fgslam.datasets.settings import OmniPathSettings, PanoramasSettings

SIZE = (320, 240)
CENTRE = (162.0, 118.0)
RADIUS = 110.0


def picture(holder: bool = False) -> Image:
    """A bright mirror with stripes on a dark ground, perhaps in a bright ring that holds it."""
    mirror = HyperbolicMirror(MirrorFrame(*SIZE, CENTRE), 15.0, RADIUS, xi=0.92, focal_px=60.0)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    rays = mirror.rays(pixels)
    levels = 120.0 + 50.0 * np.sign(np.sin(9.0 * np.arctan2(rays[:, 1], rays[:, 0])))
    levels = np.where(np.isfinite(levels), levels, 12.0)
    if holder:
        radius = np.hypot(*(pixels - CENTRE).T)
        levels = np.where((radius > 1.06 * RADIUS) & (radius < 1.1 * RADIUS), 250.0, levels)
    noisy = levels + np.random.default_rng(0).normal(0.0, 2.0, len(levels))
    grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8).reshape(SIZE[1], SIZE[0])
    return np.repeat(grey[..., None], 3, axis=2)


def notes(
    folder: Path, image: Image, centre: tuple[float, float], equirectangular: bool = False
) -> tuple[str, ...]:
    assert cv2.imwrite(str(folder / "m1.png"), image)
    mirror = HyperbolicMirrorSettings(centre=centre, focal_px=60.0, ring_px=(15.0, RADIUS))
    camera = EquirectangularSettings() if equirectangular else mirror
    return open_checked(OmniPathSettings(path=str(folder), camera=camera)).notes


@pytest.mark.parametrize("off", [(0.0, 0.0), (1.5, -1.5)])
def test_of_a_mirror_in_its_place_is_told_where_its_rim_was_found(
    tmp_path: Path, off: tuple[float, float]
) -> None:
    (note,) = notes(tmp_path, picture(), (CENTRE[0] + off[0], CENTRE[1] + off[1]))
    found = re.fullmatch(r"the mirror's rim is found, ([\d.]+) px from where it is stated", note)
    assert found is not None
    assert float(found[1]) == pytest.approx(np.hypot(*off), abs=0.5)


def test_of_a_camera_by_ocamcalib_is_told_that_it_is_taken_to_look_down(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "m1.png"), picture())
    radii = np.linspace(15.0, RADIUS, 50)
    angles = np.arctan2(-60.0 + 0.006 * radii**2, radii)
    inverse = " ".join(map(str, np.polynomial.Polynomial.fit(angles, radii, 6).convert().coef))
    lines = ("3 -60 0 0.006", f"7 {inverse}", f"{CENTRE[1]} {CENTRE[0]}", "1 0 0")
    text = "\n".join([*lines, f"{SIZE[1]} {SIZE[0]}"])
    (tmp_path / "calib_results.txt").write_text(text, encoding="utf-8")
    camera = OCamCalibSettings(file=str(tmp_path / "calib_results.txt"), ring_px=(15.0, RADIUS))
    recording = open_omni(OmniPathSettings(path=str(tmp_path), camera=camera))
    told = camera_notes(recording)
    assert told[0].startswith("the picture's middle is taken to look down")
    assert len(told) == 2
    assert camera_notes(recording, stated=False) == ()  # a route's own camera


@pytest.mark.parametrize(("off", "holder"), [((3.0, 4.0), False), ((-24.0, 18.0), True)])
def test_a_mirror_off_its_place_is_reported_with_the_offset(
    tmp_path: Path, off: tuple[float, float], holder: bool
) -> None:
    stated = (CENTRE[0] + off[0], CENTRE[1] + off[1])
    (note,) = notes(tmp_path, picture(holder), stated)
    reported = re.search(r"lies ([\d.]+) px off .* rim's is \(([\d.]+), ([\d.]+)\)", note)
    assert reported is not None
    found = [float(number) for number in reported.groups()]
    np.testing.assert_allclose(found, [np.hypot(*off), *CENTRE], atol=0.5)


@pytest.mark.parametrize(
    ("off", "hole", "told"), [(0.0, 15.0, False), (6.0, 15.0, True), (6.0, 0.0, False)]
)
def test_the_rim_of_a_mirror_by_a_calibration_of_its_own_is_checked(
    tmp_path: Path, off: float, hole: float, told: bool
) -> None:
    """A ring without a hole is that of a lens, whose image may end at the picture."""
    assert cv2.imwrite(str(tmp_path / "m1.png"), picture())
    lens = {
        "camera_model": "omni",
        "intrinsics": [0.92, 60.0, 60.0, CENTRE[0] + off, CENTRE[1]],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.0] * 4,
        "resolution": list(SIZE),
    }
    (tmp_path / "camchain.yaml").write_text(json.dumps({"cam0": lens}), encoding="utf-8")
    camera = {"kind": "lens", "file": str(tmp_path / "camchain.yaml"), "ring_px": (hole, RADIUS)}
    settings = OmniPathSettings.__pydantic_validator__.validate_python(
        {"path": str(tmp_path), "camera": camera}
    )
    assert ("px off its stated centre" in " ".join(open_checked(settings).notes)) is told


def test_a_rim_that_cannot_be_found_is_reported(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, np.full((*SIZE[::-1], 3), 90, np.uint8), CENTRE)
    assert note == "the mirror's rim is not found in m1.png, so its centre is unchecked"


def test_panoramas_have_no_mirror_but_rows_as_fine_as_columns(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, picture(), CENTRE, equirectangular=True)
    assert note.startswith("pictures of 320x240 pixels over 360 x 180 degrees have 0.9 columns but")
    limits = EquirectangularSettings(top_elevation_deg=60.0, bottom_elevation_deg=-75.0)
    for camera, rows in ((EquirectangularSettings(), 160), (limits, 120)):
        assert cv2.imwrite(str(tmp_path / "m1.png"), picture()[:rows])
        assert open_checked(PanoramasSettings(path=str(tmp_path), camera=camera)).notes == ()


def beside(image: Image, columns: int) -> Image:
    """The same size, narrower by black columns at both sides."""
    height, width = image.shape[:2]
    out = np.zeros_like(image)
    out[:, columns:-columns] = cv2.resize(image, (width - 2 * columns, height))
    return out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda image: image, None),
        (lambda image: np.roll(image, 77, axis=1), None),
        (lambda image: image[:, 90:-90], "the right and left ends of the pictures do not meet"),
        (lambda image: beside(image, 40), "80 columns of the pictures are black at the sides"),
    ],
)
def test_pictures_whose_ends_do_not_meet_are_no_whole_panoramas(
    tmp_path: Path, change: Callable[[Image], Image], said: str | None
) -> None:
    """Damaged ones are not asked."""
    for k in range(3):
        seen = textured_room.picture(np.array([0.5 * k, 0.4, 0.0]))[:, :-1]
        assert cv2.imwrite(str(tmp_path / f"m{k}.png"), change(seen))
    (tmp_path / "m1.png").write_bytes((tmp_path / "m1.png").read_bytes()[:900])
    limits = EquirectangularSettings(top_elevation_deg=54.0, bottom_elevation_deg=-54.0)
    found = open_checked(PanoramasSettings(path=str(tmp_path), camera=limits)).notes
    ends = [note for note in found if "no panoramas of all 360 degrees" in note]
    assert len(ends) == (said is not None)
    assert all(f": {said}: " in note for note in ends)


def panorama(k: int, width: int = 720) -> Image:
    """All around and from pole to pole, of a world whose grey values vary smoothly with the ray."""
    bearing = np.linspace(-np.pi, np.pi, width)
    elevation = np.linspace(0.5 * np.pi, -0.5 * np.pi, width // 2)[:, None]
    level = np.cos(elevation)
    x, y, z = level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation) + 0.0 * bearing
    waves = np.random.default_rng(0).normal(0.0, 9.0, (12, 3))
    grey = sum(np.sin(w[0] * x + w[1] * y + w[2] * z + k) for w in waves)
    image = np.clip(128.0 + 15.0 * np.asarray(grey), 40.0, 255.0).astype(np.uint8)
    return np.repeat(image[..., None], 3, axis=2)


def night(image: Image) -> Image:
    """The same with a black sky."""
    return np.where(np.arange(len(image))[:, None, None] > len(image) // 3, image, 0)


def two_fisheyes(image: Image) -> Image:
    """The same size, black outside two circles side by side."""
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    away = np.hypot(rows - 0.5 * height, np.mod(columns, width // 2) - 0.25 * width)
    return np.where((away < 0.5 * height)[..., None], image, 0).astype(np.uint8)


def cut(image: Image, degrees: float) -> Image:
    """The same size, without so many degrees next to the last column."""
    height, width = image.shape[:2]
    kept = round(width * (1.0 - degrees / 360.0))
    return np.asarray(cv2.resize(image[:, :kept], (width, height)), np.uint8)


def checked(folder: Path, change: Callable[[Image], Image]) -> tuple[str, ...]:
    for k in range(4):
        assert cv2.imwrite(str(folder / f"m{k}.png"), change(panorama(k)))
    return open_checked(PanoramasSettings(path=str(folder))).notes


def test_of_panoramas_355_degrees_are_told_and_whole_ones_pass(tmp_path: Path) -> None:
    assert checked(tmp_path, lambda image: image) == ()
    assert checked(tmp_path, night) == ()
    (note,) = checked(tmp_path, lambda image: cut(image, 5.0))
    assert "the right and left ends of the pictures do not meet" in note


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (two_fisheyes, r"their corners are black, .* two side by side; stitch them first"),
        (
            lambda image: cv2.resize(image[100:190, 100:280], (720, 360)),
            r"their right and left ends do not meet, .* or give the camera that took them",
        ),
    ],
)
def test_pictures_that_are_no_panoramas_are_refused(
    tmp_path: Path, change: Callable[[Image], Image], said: str
) -> None:
    """Two fisheyes, whose ends meet in black; a part of the view, which has no poles."""
    with pytest.raises(DatasetError, match=said):
        checked(tmp_path, change)
