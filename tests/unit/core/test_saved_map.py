"""A saved map comes back to the bit; one whose parts do not fit is not written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated import assert_same_value

import fgslam
from fgslam.core import geometry as g
from fgslam.core.errors import MapError
from fgslam.core.saved_map import SavedMap, load_map, require_rig, save_map
from fgslam.core.sensors import CameraRig
from fgslam.core.types import (
    CUT_PIXELS,
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    Trajectory,
)

RIG = CameraRig(320, 240, 277.1, 277.3, 159.5, 119.5, 0.1, 0.1, np.eye(4))


def make_map(rng: np.random.Generator, n: int, rig: CameraRig = RIG) -> SavedMap:
    """A map of n landmarks, of which some have several views and one has none."""
    ids = np.sort(rng.choice(10 * n + 1, n, replace=False)).astype(np.int64)
    noise = rng.standard_normal((n, 3, 3))
    covariances = noise @ np.swapaxes(noise, 1, 2)
    owners = np.repeat(ids, rng.integers(0, 3, n))
    v = len(owners)
    direction = np.where(rng.random((v, 1)) < 0.5, np.nan, rng.standard_normal((v, 3)))
    poses = np.array([g.se3_exp(0.1 * rng.standard_normal(6)) for _ in range(4)])
    return SavedMap(
        rig=rig,
        landmarks=LandmarkMap(ids, rng.standard_normal((n, 3)), covariances),
        appearances=LandmarkAppearances(
            owners,
            rng.integers(0, 256, (v, 128)).astype(np.uint8),
            rng.random(v),
            rng.random(v),
            direction,
        ),
        hits=rng.integers(1, 90, n),
        misses=rng.integers(0, 90, n),
        permanent=rng.random(n) < 0.5,
        colour=rng.integers(0, 256, n).astype(np.uint8),
        farthest=9.0 * rng.random(n),
        trajectory=Trajectory(np.arange(4.0), poses),
        about={"recording": {"name": "lab", "identity": "ab12"}, "frames": 4, "ratio": 0.1},
        evidence=np.array([-7, 3, 8]),
    )


@pytest.fixture
def saved(rng: np.random.Generator) -> SavedMap:
    return make_map(rng, 7)


def with_patches(saved: SavedMap, distance: float = 1.0) -> SavedMap:
    """Each landmark with a patch."""
    grey = np.arange(len(saved) * CUT_PIXELS).reshape(-1, CUT_PIXELS).astype(np.uint8)
    return replace(saved, patches=LandmarkPatches(grey, np.full(len(saved), distance)))


@pytest.mark.parametrize("n", [0, 7])
@pytest.mark.parametrize("patches", [False, True])
def test_a_map_comes_back_to_the_bit(
    n: int, patches: bool, rng: np.random.Generator, tmp_path: Path
) -> None:
    saved = make_map(rng, n)
    saved = with_patches(saved) if patches else saved
    save_map(saved, tmp_path / "m.fgmap")
    assert_same_value(load_map(tmp_path / "m.fgmap"), saved)


def test_what_follows_from_other_parts_is_not_kept(saved: SavedMap, tmp_path: Path) -> None:
    words = np.zeros(len(saved.appearances), np.int16)
    fuller = replace(
        saved,
        appearances=replace(saved.appearances, words=words),
        patches=LandmarkPatches.none(len(saved), 0),
    )
    save_map(fuller, tmp_path / "m.fgmap")
    assert_same_value(load_map(tmp_path / "m.fgmap"), saved)


def test_digests_far_apart_are_in_order(saved: SavedMap, tmp_path: Path) -> None:
    """Of 64 bits each, with a sign: their difference has 65."""
    evidence = np.array([-(2**63), -5, 2**63 - 1])
    save_map(replace(saved, evidence=evidence), tmp_path / "m.fgmap")
    assert load_map(tmp_path / "m.fgmap").evidence is not None
    with pytest.raises(MapError, match="evidence is out of order"):
        save_map(replace(saved, evidence=evidence[::-1]), tmp_path / "m.fgmap")


def test_covariances_that_are_not_quite_symmetric_keep_every_bit(
    saved: SavedMap, tmp_path: Path
) -> None:
    skew = saved.landmarks.covariances.copy()
    skew[3, 0, 1] = np.nextafter(skew[3, 0, 1], 1.0)
    signed = np.zeros_like(skew)
    signed[2, 1, 0] = -0.0
    for covariances in (skew, signed):
        ids, positions = saved.landmarks.ids, saved.landmarks.positions
        other = replace(saved, landmarks=LandmarkMap(ids, positions, covariances))
        save_map(other, tmp_path / "m.fgmap")
        assert_same_value(load_map(tmp_path / "m.fgmap"), other)


def test_a_map_whose_drives_count_hits_in_words_is_refused(saved: SavedMap, tmp_path: Path) -> None:
    path = tmp_path / "a.fgmap"
    save_map(replace(saved, about={"drives": [{"valid_hits": "many"}]}), path)
    with pytest.raises(MapError, match=r"valid_hits \['many'\], not whole numbers; make it again"):
        fgslam.Map.load(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: replace(m, hits=m.hits[:-1]), r"hits: \(6,\) instead of \(7,\)"),
        (lambda m: replace(m, about={"a": np.nan}), "not plain JSON"),
        (lambda m: replace(m, rig=replace(m.rig, fx=-100.0)), "fx is -100.0, not a positive"),
        (lambda m: with_patches(m, np.nan), "distance of a patch is negative or not finite"),
        (
            lambda m: replace(m, landmarks=replace(m.landmarks, ids=m.landmarks.ids[::-1])),
            "landmark ids is out of order",
        ),
        (
            lambda m: replace(
                m, landmarks=replace(m.landmarks, covariances=-m.landmarks.covariances)
            ),
            "landmark covariances: number 0 is no covariance",
        ),
        (
            lambda m: replace(m, landmarks=replace(m.landmarks, positions=np.full((7, 3), np.nan))),
            "positions: a number is not finite",
        ),
        (
            lambda m: replace(m, appearances=replace(m.appearances, ids=m.appearances.ids - 1000)),
            "landmarks of views are out of order",
        ),
        (
            lambda m: replace(m, trajectory=Trajectory(np.zeros(4), m.trajectory.poses)),
            "times of poses is out of order",
        ),
    ],
)
def test_a_map_whose_parts_do_not_fit_is_not_written(
    change: Callable[[SavedMap], SavedMap], words: str, saved: SavedMap, tmp_path: Path
) -> None:
    with pytest.raises(MapError, match=words) as refusal:
        save_map(change(saved), tmp_path / "m.fgmap")
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.iterdir())


def test_only_the_same_rig_is_accepted(saved: SavedMap) -> None:
    require_rig(saved, replace(RIG, fx=RIG.fx * (1.0 + 1e-9)), "m")
    for other, reported in (
        (replace(RIG, width=640), "width 320, the recording's is 640"),
        (replace(RIG, baseline=0.101), "baseline 0.1, the recording's is 0.101"),
        (replace(RIG, vertical_baseline=None), "vertical_baseline 0.1, the recording's is None"),
        (replace(RIG, bTc=g.se3_exp(np.full(6, 0.01))), "mounted otherwise"),
    ):
        with pytest.raises(MapError, match=reported):
            require_rig(saved, other, "m")
