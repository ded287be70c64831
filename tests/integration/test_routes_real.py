"""Routes on real pictures: a mirror camera's film, and panoramas of a dim school floor.

Truth is the order of the pictures: of one that was not taught the nearest path image is the one
nearest in number, be it the one before or after where both are as near.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.geometry import wrap
from fgslam.homing.route import PathMemory
from fgslam.runs.bare import following, teaching
from fgslam.runs.run import run_experiment

pytestmark = pytest.mark.data


class Followed(NamedTuple):
    """What came out of a recording, of the pictures that were not taught.

    Attributes:
        off: (n,) by how many path images the place is off.
        sure: (n,) whether it counts as known.
        directions: (n,) to the next path image, radians; NaN where refused.
        path_images: how many there are.
        kilobytes: of each.
    """

    off: FloatArray
    sure: BoolArray
    directions: FloatArray
    path_images: int
    kilobytes: float

    @property
    def jumps(self) -> FloatArray:
        """(m,) degrees by which the direction turns from one answered picture to the next."""
        known = self.directions[np.isfinite(self.directions)]
        return np.abs(np.rad2deg(wrap(np.diff(known))))


def followed(
    recordings: tuple[Path, Path], camera: str, frames: tuple[Sequence[str], Sequence[str]],
    folder: Path,
) -> Followed:  # fmt: skip
    """Teaches from one recording and follows it with the other."""
    route = folder / "route.fgpath"
    run_experiment(teaching(recordings[0], camera, route, frames[0]), folder / "taught")
    run_experiment(following(route, recordings[1], None, frames[1]), folder / "run")
    path = PathMemory.load(route)
    nodes = np.array([_number(name) for name in path.names])
    with (folder / "run" / "follow.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if _number(row["name"]) not in nodes]
    away = np.abs(np.array([_number(row["name"]) for row in rows])[:, None] - nodes)
    nearest = away == away.min(axis=1, keepdims=True)
    # A frame without a place is as far off as can be.
    places = np.array([float(row["path_image"] or "inf") for row in rows])
    off = np.abs(np.arange(len(nodes)) - places[:, None])
    return Followed(
        off=np.where(nearest, off, np.inf).min(axis=1),
        sure=np.array([float(row["probability"] or 0.0) >= 0.9 for row in rows]),
        directions=np.deg2rad([float(row["direction_deg"] or "nan") for row in rows]),
        path_images=len(path),
        kilobytes=route.stat().st_size / 1000.0 / len(path),
    )


def _number(name: str) -> int:
    return int("".join(letter for letter in name if letter.isdecimal()))


def bloggie(root: Path) -> tuple[Path, str]:
    film, camera = root / "omni_mirror/bloggie_walk.mp4", root / "omni_mirror/bloggie_settings.txt"
    if not film.exists():
        pytest.skip(f"no {film.name} in {root}: this test needs it")
    return film, str(camera)


@pytest.mark.slow
def test_two_seconds_of_a_walk_are_taught_and_followed(shared_data: Path, tmp_path: Path) -> None:
    film, camera = bloggie(shared_data)
    part = ["dataset.start=200", "dataset.stop=260", "output.report=false", "output.pictures=0"]
    found = followed((film, film), camera, (part, [*part, "dataset.stride=7"]), tmp_path)
    assert 2 <= found.path_images <= 4
    assert found.kilobytes <= 20.0
    assert (found.off <= 1).all()
    assert found.sure.mean() >= 0.8
    assert np.isfinite(found.directions).mean() >= 0.7
    assert (found.jumps <= 30.0).all()


@pytest.mark.slow
def test_the_whole_walk_is_followed(shared_data: Path, tmp_path: Path) -> None:
    film, camera = bloggie(shared_data)
    found = followed((film, film), camera, ([], []), tmp_path)
    assert found.path_images <= 20
    assert found.kilobytes <= 20.0
    assert (found.off <= 1).mean() >= 0.98
    assert (found.jumps > 30.0).mean() <= 0.02
    assert not (found.sure & (found.off > 1)).any()


@pytest.mark.slow
def test_every_other_panorama_of_a_dim_floor_finds_its_place(
    shared_data: Path, tmp_path: Path
) -> None:
    """Many pairs of neighbours have no homing vector; the route's order brings the place."""
    pictures = sorted((shared_data / "omni_corridors").glob("wp_*.jpg"))
    if not pictures:
        pytest.skip(f"no omni_corridors in {shared_data}: this test needs them")
    for name, of_it in (("even", pictures[1::2]), ("odd", pictures[0::2])):
        (tmp_path / name).mkdir()
        for one in of_it:
            os.symlink(one, tmp_path / name / one.name)
    found = followed((tmp_path / "even", tmp_path / "odd"), "equirectangular", ([], []), tmp_path)
    assert (found.off <= 1).mean() >= 0.9
    assert not (found.sure & (found.off > 1)).any()
