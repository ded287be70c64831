"""What is remembered of a path, and the file it is kept in."""

from __future__ import annotations

import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    MirrorFrame,
    OCamCamera,
    OmniCamera,
    RadialPolynomial,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import StoredMapError
from fgslam.core.homing import ColumnSegments, OmniFeatures, UprightFeatures
from fgslam.homing.features import pack_features
from fgslam.homing.route import FILE, PathMemory
from tests.landmark_world import no_columns


def some_features(seed: int, sift: int = 300, columns: int = 150) -> OmniFeatures:
    """Random ones of the sizes and ranges of real ones."""
    rng = np.random.default_rng(seed)
    spread = rng.normal(0.0, 0.004, (sift, 2, 2))
    found = UprightFeatures(
        pixels=rng.uniform(0.0, 300.0, (sift, 2)),
        bearing=rng.uniform(-np.pi, np.pi, sift),
        elevation=rng.uniform(-1.0, 1.0, sift),
        covariance=spread @ spread.transpose(0, 2, 1) + 1e-6 * np.eye(2),
        scale=rng.uniform(0.005, 0.2, sift),
        descriptors=rng.integers(0, 256, (sift, 128)).astype(np.uint8),
        colour=rng.uniform(0.8, 2.0, (sift, 3)),
    )
    segments = ColumnSegments(
        bearing=rng.uniform(-np.pi, np.pi, columns),
        sigma_bearing=rng.uniform(0.001, 0.02, columns),
        tangents=np.sort(rng.uniform(-1.0, 1.0, (columns, 2)), axis=1),
        sigma_tangents=rng.uniform(0.001, 0.02, (columns, 2)),
        descriptors=rng.normal(0.0, 1.0, (columns, 11)),
    )
    return OmniFeatures(found, segments)


EMPTY = OmniFeatures(some_features(0, 0).sift, no_columns())


def test_features_come_back_within_their_rounding(tmp_path: Path) -> None:
    """Descriptors to the bit, angles to half a step, deviations and sizes to 3 %."""
    memory = PathMemory.of([some_features(1), EMPTY, some_features(2, 40, 0)], ["a", "b", "ü"])
    memory.save(tmp_path / "path.npz")
    again = PathMemory.load(tmp_path / "path.npz")
    assert again.names == ("a", "b", "ü")
    assert [len(i.sift) for i in again.images] == [300, 0, 40]
    for before, after in zip(memory.images, again.images, strict=True):
        assert np.array_equal(after.sift.descriptors, before.sift.descriptors)
        assert after.sift.descriptors.dtype == np.uint8
        for name in ("bearing", "elevation"):
            given, read = getattr(before.sift, name), getattr(after.sift, name)
            assert read == pytest.approx(given, abs=0.5 * np.pi / 32767.0 + 1e-9)
            assert read.dtype == np.float64
        assert after.sift.scale == pytest.approx(before.sift.scale, rel=0.03)
        assert after.sift.colour == pytest.approx(before.sift.colour, rel=8e-3)
        sigma = np.sqrt(before.sift.covariance[:, [0, 1], [0, 1]])
        read_sigma = np.sqrt(after.sift.covariance[:, [0, 1], [0, 1]])
        assert read_sigma == pytest.approx(sigma, rel=0.03)
        assert _correlation(after.sift) == pytest.approx(_correlation(before.sift), abs=0.005)
        assert after.columns.bearing == pytest.approx(before.columns.bearing, abs=5e-5)
        assert after.columns.tangents == pytest.approx(before.columns.tangents, rel=7e-5)
        assert after.columns.descriptors == pytest.approx(before.columns.descriptors, rel=7e-5)


def _correlation(features: UprightFeatures) -> FloatArray:
    c = features.covariance
    return np.asarray(c[:, 0, 1] / np.sqrt(c[:, 0, 0] * c[:, 1, 1]))


def test_a_file_of_version_1_is_refused(tmp_path: Path) -> None:
    header = np.array('{"format": "fgslam path memory", "version": 1, "names": ["a"]}')
    np.savez(tmp_path / "old.npz", allow_pickle=False, header=header)
    with pytest.raises(StoredMapError, match="made by another version"):
        PathMemory.load(tmp_path / "old.npz")


CAMERAS = (
    Equirectangular(640, 320, 1.2, -1.1),
    Cylinder(640, 200, -0.8, 0.9),
    HyperbolicMirror(MirrorFrame(320, 240, (159.1, 118.7)), 20.0, 110.0, xi=0.92, focal_px=90.0),
    RadialPolynomial(MirrorFrame(320, 240, (160.0, 120.0), 0.3, False), 20.0, 110.0, (-0.9, 0.01)),
    OCamCamera(
        MirrorFrame(320, 240, (160.0, 120.0), affine=(1.01, 0.001, -0.002)),
        20.0,
        110.0,
        direct=(-60.0, 0.0, 0.006),
    ),
)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: type(camera).__name__)
def test_the_camera_comes_back_to_the_bit(tmp_path: Path, camera: OmniCamera) -> None:
    PathMemory.of([EMPTY], camera=camera).save(tmp_path / "path.npz")
    assert PathMemory.load(tmp_path / "path.npz").camera == camera


def test_a_damaged_camera_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "path.npz"
    PathMemory.of([EMPTY], camera=CAMERAS[0]).save(path)
    with np.load(path) as file:
        arrays = dict(file)
    header = str(arrays["header"])
    for damaged in (header.replace('"model"', '"modal"'), header.replace("320", '"tall"')):
        np.savez(path, allow_pickle=False, **{**arrays, "header": np.array(damaged)})
        with pytest.raises(StoredMapError, match="camera"):
            PathMemory.load(path)


def test_no_pixels_are_kept(tmp_path: Path) -> None:
    """Neither the image's nor where features lay in it; a second saving changes nothing."""
    PathMemory.of([some_features(1)]).save(tmp_path / "one.npz")
    again = PathMemory.load(tmp_path / "one.npz")
    assert np.isnan(again.images[0].sift.pixels).all()
    again.save(tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    arrays = pack_features(again.images)
    size = sum(a.nbytes for name, a in arrays.items() if name.startswith("sift_b"))
    assert size == 2 * 300
    assert not any("pixel" in name for name in arrays)
    # All that features have is kept, but for that.
    kept = {name.removeprefix("sift_") for name in arrays if name.startswith("sift_")}
    assert {f.name for f in fields(UprightFeatures)} - kept == {"pixels", "covariance"}
    assert kept - {f.name for f in fields(UprightFeatures)} == {"start", "spread", "correlation"}


def test_saving_returns_kilobytes_an_image(tmp_path: Path) -> None:
    """The file's size over its images; a fraction of an image of 320 x 240 in colour."""
    memory = PathMemory.of([some_features(k) for k in range(3)])
    kilobytes = memory.save(tmp_path / "path.npz")
    assert kilobytes == pytest.approx((tmp_path / "path.npz").stat().st_size / 3000.0)
    assert kilobytes < 0.4 * 230.4


def written(path: Path) -> bytes:
    """A good file's bytes."""
    PathMemory.of([some_features(k) for k in range(2)]).save(path)
    return path.read_bytes()


@pytest.mark.parametrize("kept", [0, 10, 1000, -1000, -1])
def test_truncated_file_is_refused(tmp_path: Path, kept: int) -> None:
    """Wherever it was cut."""
    whole = written(tmp_path / "path.npz")
    (tmp_path / "path.npz").write_bytes(whole[:kept])
    with pytest.raises(StoredMapError, match=r"path\.npz"):
        PathMemory.load(tmp_path / "path.npz")


def test_every_flipped_bit_is_detected_or_harmless(tmp_path: Path) -> None:
    """The archive's CRCs: damage is reported, and never gives other features."""
    path = tmp_path / "path.npz"
    whole = written(path)
    good = pack_features(PathMemory.load(path).images)
    rng = np.random.default_rng(3)
    refused = 0
    for position in rng.integers(0, len(whole), 60):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        try:
            read = pack_features(PathMemory.load(path).images)
        except StoredMapError:
            refused += 1
            continue
        assert all(np.array_equal(read[name], good[name]) for name in good)
    assert refused > 50


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    """Another npz, another version, no file, a folder, arrays that do not fit together."""
    path = tmp_path / "path.npz"
    np.savez(path, a=np.arange(3))
    with pytest.raises(StoredMapError, match=f"not an {FILE.name}"):
        PathMemory.load(path)
    with pytest.raises(StoredMapError, match="no such file"):
        PathMemory.load(tmp_path / "none.npz")
    with pytest.raises(StoredMapError, match="folder"):
        PathMemory.load(tmp_path)
    written(path)
    with np.load(path) as file:
        arrays = dict(file)
    newer = str(arrays["header"]).replace('"version": 2', '"version": 9')
    np.savez(path, **{**arrays, "header": np.array(newer)})
    with pytest.raises(StoredMapError, match="made by another version"):
        PathMemory.load(path)
    for name in sorted(set(arrays) - {"header"}):
        np.savez(path, **{k: v for k, v in arrays.items() if k != name})
        with pytest.raises(StoredMapError, match="absent or damaged"):
            PathMemory.load(path)
        np.savez(path, **{**arrays, name: arrays[name][:-1]})
        with pytest.raises(StoredMapError, match=r"damaged|one name an image"):
            PathMemory.load(path)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    """An object array would run what the file says; it is refused unread."""
    path = tmp_path / "path.npz"
    np.savez(path, header=np.array({"format": FILE.name}, dtype=object))
    assert zipfile.is_zipfile(path)
    with pytest.raises(StoredMapError, match="neither arrays nor an archive"):
        PathMemory.load(path)


def test_names_must_fit() -> None:
    """One an image."""
    with pytest.raises(StoredMapError, match="2 names for 1 images"):
        PathMemory.of([EMPTY], ["a", "b"])
