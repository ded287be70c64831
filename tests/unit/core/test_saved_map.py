"""A saved map comes back to the bit, or it is refused in one clear line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgslam
from fgslam.core import files as whole_files
from fgslam.core import geometry as g
from fgslam.core import saved_map as map_file
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MapError, OutputError
from fgslam.core.log import MeasurementLog
from fgslam.core.saved_map import SavedMap, load_map, require_rig, save_map
from fgslam.core.sensors import CameraRig
from fgslam.core.store import load_arrays
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
        trajectory=Trajectory(np.arange(4.0), poses),
        about={"recording": {"name": "lab", "identity": "ab12"}, "frames": 4, "ratio": 0.1},
        evidence=np.array([-7, 3, 8]),
    )


@pytest.fixture
def saved(rng: np.random.Generator) -> SavedMap:
    return make_map(rng, 7)


@pytest.fixture
def file(saved: SavedMap, tmp_path: Path) -> Path:
    save_map(saved, tmp_path / "lab.fgmap")
    return tmp_path / "lab.fgmap"


def assert_same(a: Any, b: Any) -> None:
    """Equal to the bit, however deep."""
    assert type(a) is type(b)
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for name in a:
            assert_same(a[name], b[name])
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    else:
        assert a == b


def write_arrays(path: Path, arrays: StateArrays) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def rewritten(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> Path:
    """The file with header and arrays changed, by one who knows how to make a checksum."""
    arrays = load_arrays(path)
    header = json.loads(str(arrays.pop("header")))
    del header["sha256"]
    change(header, arrays)
    header["sha256"] = map_file.digest(header, arrays)
    write_arrays(path, {"header": np.array(json.dumps(header))} | arrays)
    return path


def test_a_map_comes_back_to_the_bit(saved: SavedMap, file: Path) -> None:
    assert_same(load_map(file), saved)


def test_own_patches_come_back_to_the_bit(
    saved: SavedMap, rng: np.random.Generator, tmp_path: Path
) -> None:
    grey = rng.integers(0, 256, (len(saved), CUT_PIXELS)).astype(np.uint8)
    patches = LandmarkPatches(grey, rng.random(len(saved)))
    carried = replace(saved, patches=patches)
    save_map(carried, tmp_path / "m.fgmap")
    assert_same(load_map(tmp_path / "m.fgmap"), carried)
    with pytest.raises(MapError, match="landmark_patch_distance is not finite"):
        save_map(
            replace(carried, patches=LandmarkPatches(grey, np.full(len(saved), np.nan))),
            tmp_path / "m.fgmap",
        )


def test_patches_that_do_not_fit_are_refused(saved: SavedMap, tmp_path: Path) -> None:
    grey = np.zeros((len(saved), CUT_PIXELS), np.uint8)
    carried = replace(saved, patches=LandmarkPatches(grey, np.ones(len(saved))))

    def fewer(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        header["counts"]["patches"] = 5
        for name in ("landmark_patch", "landmark_patch_distance"):
            arrays[name] = arrays[name][:5]

    def alone(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        del header["counts"]["patches"], arrays["landmark_patch_distance"]

    def negative(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        arrays["landmark_patch_distance"] = -arrays["landmark_patch_distance"]

    def none(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        for name in ("landmark_patch", "landmark_patch_distance"):
            del arrays[name]

    for change in (fewer, alone, negative, none):
        save_map(carried, tmp_path / "m.fgmap")
        with pytest.raises(MapError, match="landmark_patch"):
            load_map(rewritten(tmp_path / "m.fgmap", change))


def test_evidence_that_does_not_fit_is_refused(saved: SavedMap, tmp_path: Path) -> None:
    def none(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        del header["counts"]["evidence"], arrays["evidence_frame"]

    def words(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        del header["counts"]["evidence"]
        arrays["evidence_frame"] = np.array(["a", "b"])

    for change in (none, words):
        save_map(replace(saved, evidence=np.array([3, 8])), tmp_path / "m.fgmap")
        with pytest.raises(MapError, match="evidence_frame"):
            load_map(rewritten(tmp_path / "m.fgmap", change))


def test_digests_far_apart_are_in_order(saved: SavedMap, tmp_path: Path) -> None:
    """Of 64 bits each, with a sign: their difference has 65."""
    evidence = np.array([-(2**63), -5, 2**63 - 1])
    save_map(replace(saved, evidence=evidence), tmp_path / "m.fgmap")
    assert load_map(tmp_path / "m.fgmap").evidence is not None
    with pytest.raises(MapError, match="evidence_frame is out of order"):
        save_map(replace(saved, evidence=evidence[::-1]), tmp_path / "m.fgmap")


@pytest.mark.parametrize("n", [0, 1])
def test_empty_and_one_landmark_maps_come_back_to_the_bit(
    n: int, rng: np.random.Generator, tmp_path: Path
) -> None:
    saved = make_map(rng, n)
    save_map(saved, tmp_path / "m.fgmap")
    assert_same(load_map(tmp_path / "m.fgmap"), saved)


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
        assert_same(load_map(tmp_path / "m.fgmap"), other)


def test_the_same_map_gives_the_same_bytes(saved: SavedMap, file: Path, tmp_path: Path) -> None:
    size = save_map(load_map(file), tmp_path / "again.fgmap")
    assert (tmp_path / "again.fgmap").read_bytes() == file.read_bytes()
    assert size == file.stat().st_size


def test_saving_changes_nothing_of_the_map(saved: SavedMap, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    before, same = make_map(rng, 7), make_map(np.random.default_rng(5), 7)
    save_map(before, tmp_path / "m.fgmap")
    assert_same(before, same)


@pytest.mark.parametrize("kept", [0, 1, 30, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(file: Path, kept: float) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(kept if kept in (0, 1, 30) else kept * len(content))])
    with pytest.raises(MapError, match=r"not a readable map .*truncated"):
        load_map(file)


def test_a_flipped_byte_is_refused_or_harmless(saved: SavedMap, file: Path, tmp_path: Path) -> None:
    """Some bytes of a zip say nothing (times, attributes): there the map must be the same."""
    content = file.read_bytes()
    damaged = tmp_path / "damaged.fgmap"
    refused = 0
    for at in range(0, len(content), max(1, len(content) // 300)):
        damaged.write_bytes(content[:at] + bytes([content[at] ^ 0x10]) + content[at + 1 :])
        try:
            loaded = load_map(damaged)
        except MapError:
            refused += 1
        else:
            assert_same(loaded, saved)
    assert refused > 150


def test_contents_swapped_under_a_valid_archive_are_noticed(file: Path) -> None:
    arrays = load_arrays(file)
    arrays["landmark_hits"] = arrays["landmark_hits"] + 1
    write_arrays(file, arrays)
    with pytest.raises(MapError, match="damaged: its contents do not have the checksum"):
        load_map(file)


def test_the_frames_that_are_in_a_map_come_back(saved: SavedMap, tmp_path: Path) -> None:
    frames = np.array([-5, 0, 2**62])
    save_map(replace(saved, evidence=frames), tmp_path / "b.fgmap")
    np.testing.assert_array_equal(load_map(tmp_path / "b.fgmap").evidence, frames)
    with pytest.raises(MapError, match="evidence_frame is out of order"):
        save_map(replace(saved, evidence=frames[::-1]), tmp_path / "c.fgmap")


@pytest.mark.parametrize("version", [2, 99])
def test_a_map_of_another_version_is_refused(file: Path, version: int) -> None:
    def change(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        header["version"] = version

    with pytest.raises(MapError, match="map made by another version; make the map again"):
        load_map(rewritten(file, change))


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "measurements.npz"
    write_arrays(path, MeasurementLog(RIG, {}).to_arrays())
    with pytest.raises(MapError, match="not an fgslam map; give a file"):
        load_map(path)
    path.write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(MapError, match="neither arrays nor an archive of them"):
        load_map(path)
    write_arrays(path, {"a": np.zeros(3)})
    with pytest.raises(MapError, match="not an fgslam map"):
        load_map(path)


def test_missing_files_and_folders_have_different_errors(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such file; give a file that fgslam run --map-out wrote"):
        load_map(tmp_path / "none.fgmap")
    with pytest.raises(MapError, match="is a folder"):
        load_map(tmp_path)


def _drop(name: str) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda header, arrays: arrays.pop(name)


def _set(name: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda header, arrays: arrays.update({name: value(arrays[name])})


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (_drop("landmark_hits"), "array landmark_hits is absent"),
        (_drop("landmark_covariance"), "array landmark_covariance is absent"),
        (_set("view_size", lambda a: a[:-1]), "array view_size is absent or damaged"),
        (_set("landmark_position", lambda a: a * np.nan), "landmark_position is not finite"),
        (_set("landmark_id", lambda a: a[::-1]), "landmark_id is out of order"),
        (_set("view_landmark", lambda a: a - 1000), "view_landmark is out of order"),
        (_set("pose_time", lambda a: 0.0 * a), "pose_time is out of order"),
        (_set("landmark_hits", lambda a: a.astype(float)), "landmark_hits is absent or damaged"),
        (lambda header, arrays: header.pop("about"), "header is damaged"),
        (lambda header, arrays: header.update(counts={}), "is absent or damaged"),
        (lambda header, arrays: header["rig"].pop("fx"), "names no rig"),
        (lambda header, arrays: header["rig"].update(fx=-100.0), "fx is -100.0, not a positive"),
        (_set("landmark_covariance", lambda a: -a), "landmark_covariance, row 0, is no covariance"),
        (lambda header, arrays: header.update(triangles=["pose"]), "array pose is absent"),
    ],
)
def test_a_file_whose_parts_do_not_fit_is_refused(
    file: Path, change: Callable[[dict[str, Any], dict[str, Any]], None], reported: str
) -> None:
    with pytest.raises(MapError, match=reported) as refusal:
        load_map(rewritten(file, change))
    assert str(refusal.value).startswith(str(file))
    assert "\n" not in str(refusal.value)


def test_a_map_whose_drives_count_hits_in_words_is_refused(saved: SavedMap, tmp_path: Path) -> None:
    path = tmp_path / "a.fgmap"
    save_map(replace(saved, about={"drives": [{"valid_hits": "many"}]}), path)
    with pytest.raises(MapError, match=r"valid_hits \['many'\], not whole numbers; make it anew"):
        fgslam.Map.load(path)


def test_an_inconsistent_map_is_not_written(saved: SavedMap, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="array landmark_hits"):
        save_map(replace(saved, hits=saved.hits[:-1]), tmp_path / "m.fgmap")
    with pytest.raises(MapError, match="not plain JSON"):
        save_map(replace(saved, about={"a": np.nan}), tmp_path / "m.fgmap")
    assert not list(tmp_path.iterdir())


def test_a_failure_while_writing_leaves_the_old_map(
    saved: SavedMap, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = file.read_bytes()

    def refuse(source: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(whole_files.os, "replace", refuse)
    with pytest.raises(OutputError, match="the disk is full"):
        save_map(saved, file)
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_saving_into_a_missing_folder_is_refused(saved: SavedMap, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="its folder does not exist"):
        save_map(saved, tmp_path / "none" / "m.fgmap")


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
