"""Maps as point clouds: exact there and back, and the same points in Open3D."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import DatasetError, OutputError
from fgslam.report.formats import MapPoints, read_ply, write_map, write_pcd, write_ply


def a_map(n: int = 200, seed: int = 1) -> MapPoints:
    rng = np.random.default_rng(seed)
    root = rng.normal(scale=0.05, size=(n, 3, 3))
    return MapPoints(
        ids=np.sort(rng.choice(100_000, n, replace=False)).astype(np.int64),
        positions=rng.normal(scale=4.0, size=(n, 3)),
        covariances=root @ np.swapaxes(root, 1, 2),
        colours=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        hits=rng.integers(1, 300, n),
        misses=rng.integers(0, 300, n),
        valid=rng.random(n) < 0.5,
        permanent=rng.random(n) < 0.2,
    )


@pytest.fixture(scope="module")
def open3d():
    try:
        from fgslam.worlds.open3d_library import load_open3d
    except ImportError:
        return pytest.importorskip("open3d", exc_type=ImportError, reason="Open3D cannot be loaded")
    from fgslam.core.errors import MissingDependencyError

    try:
        return load_open3d()
    except MissingDependencyError as error:
        pytest.skip(f"Open3D cannot be loaded: {error}")


def test_ply_there_and_back_is_exact(tmp_path: Path) -> None:
    written = a_map()
    write_ply(tmp_path / "map.ply", written)
    read = read_ply(tmp_path / "map.ply")
    for field in dataclasses.fields(MapPoints):
        if field.name != "covariances":
            np.testing.assert_array_equal(getattr(read, field.name), getattr(written, field.name))
    upper = np.triu_indices(3)
    np.testing.assert_array_equal(
        read.covariances[:, upper[0], upper[1]], written.covariances[:, upper[0], upper[1]]
    )
    np.testing.assert_array_equal(read.covariances, np.swapaxes(read.covariances, 1, 2))


def test_ply_header_names_every_property(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", a_map(3))
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    expected = (
        "x y z red green blue landmark_id hits misses cxx cxy cxz cyy cyz czz valid permanent"
    )
    assert " ".join(names) == expected
    assert "element vertex 3" in header
    assert "metres" in header


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("n", [0, 1, 50])
def test_same_map_same_bytes(tmp_path: Path, suffix: str, n: int) -> None:
    for name in ("a", "b"):
        write_map(tmp_path / f"{name}{suffix}", a_map(n))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_empty_map_there_and_back(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", a_map(0))
    assert len(read_ply(tmp_path / "map.ply")) == 0


def test_open3d_reads_the_ply(tmp_path: Path, open3d) -> None:
    points = a_map()
    write_ply(tmp_path / "map.ply", points)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_array_equal(np.asarray(cloud.points), points.positions)
    np.testing.assert_allclose(np.asarray(cloud.colors), points.colours / 255.0)
    tensors = open3d.t.io.read_point_cloud(str(tmp_path / "map.ply")).point
    np.testing.assert_array_equal(tensors["landmark_id"].numpy()[:, 0], points.ids)
    np.testing.assert_array_equal(tensors["cyz"].numpy()[:, 0], points.covariances[:, 1, 2])


def test_open3d_reads_the_pcd(tmp_path: Path, open3d) -> None:
    points = a_map()
    write_pcd(tmp_path / "map.pcd", points)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "map.pcd"))
    np.testing.assert_array_equal(np.asarray(cloud.points), points.positions.astype(np.float32))
    np.testing.assert_allclose(np.asarray(cloud.colors), points.colours / 255.0)


def test_selection_keeps_rows_together() -> None:
    points = a_map()
    valid = points.select(points.valid)
    assert len(valid) == points.valid.sum()
    row = int(np.flatnonzero(points.valid)[3])
    np.testing.assert_array_equal(valid.positions[3], points.positions[row])
    assert valid.ids[3] == points.ids[row]


def test_unknown_format_and_landmarks_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"use \.ply or \.pcd"):
        write_map(tmp_path / "map.xyz", a_map(1))
    broken = a_map(5)
    broken.positions[3, 1] = np.nan
    with pytest.raises(OutputError, match=f"landmark {broken.ids[3]} is not finite"):
        write_map(tmp_path / "map.ply", broken)
    with pytest.raises(OutputError, match="ids must lie"):
        write_map(tmp_path / "map.pcd", dataclasses.replace(a_map(1), ids=np.array([2**31])))
    assert list(tmp_path.iterdir()) == []


def test_columns_of_different_length_are_a_fault_of_ours() -> None:
    with pytest.raises(ValueError, match="hits has shape"):
        dataclasses.replace(a_map(4), hits=np.zeros(3, np.int64))


def test_foreign_and_broken_ply_files(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    with pytest.raises(DatasetError, match="No such file"):
        read_ply(path)
    path.write_text("OFF\n")
    with pytest.raises(DatasetError, match=r"not a \.ply"):
        read_ply(path)
    write_ply(path, a_map(5))
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    with pytest.raises(DatasetError, match="cut off"):
        read_ply(path)
    path.write_bytes(whole.replace(b" hits\n", b" hots\n"))
    with pytest.raises(DatasetError, match="no property 'hits'"):
        read_ply(path)
    path.write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(DatasetError, match="little-endian"):
        read_ply(path)
    path.write_bytes(whole.replace(b"property double x", b"property list uchar int x"))
    with pytest.raises(DatasetError, match="maps do not have"):
        read_ply(path)
