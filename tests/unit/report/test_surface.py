"""Depth images made by hand, fused to a surface and to a grid."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OutputError
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.report.surface import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    DepthFrame,
    Fusion,
    Grid,
    Surface,
    find_up,
    make_grid,
)

MATRIX = np.array([[60.0, 0.0, 39.5], [0.0, 60.0, 29.5], [0.0, 0.0, 1.0]])
SHAPE = (60, 80)
VOXEL = 0.05
SIGMA = 0.01  # of the inverse depth
WALL_M, FLOOR_M = 2.0, 0.6  # ahead of and below the first camera
ROWS, COLUMNS = np.indices(SHAPE, np.float32)
RAYS = np.stack([(COLUMNS - 39.5) / 60.0, (ROWS - 29.5) / 60.0, np.ones_like(ROWS)], axis=-1)


def frame(wTc: FloatArray, post: bool = False) -> DepthFrame:
    """What a camera sees of a wall and the floor before it, and of a post at 1 m."""
    rays, start = RAYS @ wTc[:3, :3].T, wTc[:3, 3]
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] > 0.0, (FLOOR_M - start[1]) / rays[..., 1], np.inf)
        depth = np.minimum((WALL_M - start[2]) / rays[..., 2], floor)
        at_post = (1.0 - start[2]) / rays[..., 2]
    across = start[0] + at_post * rays[..., 0]
    depth = np.where(post & (np.abs(across) < 0.1) & (at_post < depth), at_post, depth)
    image = np.full((*SHAPE, 3), (200, 100, 50), np.uint8)
    full = np.full(SHAPE, SIGMA, np.float32)
    return DepthFrame(depth.astype(np.float32), full, image, wTc, np.full(SHAPE, 4e-4, np.float32))


def poses(count: int) -> list[FloatArray]:
    return [pose(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(count)]


def fused(frames: list[DepthFrame]) -> Surface:
    fusion = Fusion(MATRIX, VOXEL)
    for each in frames:
        fusion.add(each)
    return fusion.surface(1.5 * VOXEL)


@pytest.mark.usefixtures("open3d")
def test_a_surface_lies_where_the_depths_say_with_its_normals_colours_and_deviations() -> None:
    surface = fused([frame(wTc) for wTc in poses(4)])
    ahead = surface.normals[:, 2] < -0.9
    assert ahead.sum() > 500
    assert np.abs(surface.positions[ahead, 2] - WALL_M).max() < 0.01
    below = surface.normals[:, 1] < -0.9
    assert np.abs(surface.positions[below, 1] - FLOOR_M).max() < 0.02  # next to the wall
    assert np.abs(surface.colours.astype(int) - [200, 100, 50]).max() <= 1
    # Four depths of the wall, each known to SIGMA times its square, on a lattice.
    middle = ahead & (np.abs(surface.positions[:, 0] - 0.15) < 0.5)
    expected = np.hypot(SIGMA * WALL_M**2 / 2.0, 0.5 * VOXEL)
    assert np.median(surface.voxel_sigmas[middle]) == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(surface.shared_sigmas, 0.02, rtol=0, atol=1e-5)
    assert (surface.sigmas >= surface.shared_sigmas).all()
    a, b, c = (surface.positions[surface.triangles[:, k]] for k in range(3))
    outwards = np.einsum(
        "ij,ij->i", np.cross(b - a, c - a), surface.normals[surface.triangles[:, 0]]
    )
    assert (outwards > 0.0).mean() > 0.95


@pytest.mark.usefixtures("open3d")
def test_a_road_that_rays_graze_has_no_holes() -> None:
    frames = []
    for way in 0.15 * np.arange(10):
        start = np.array([0.0, 0.02 * way, way])
        with np.errstate(divide="ignore"):
            road = np.where(RAYS[..., 1] > 0.0, (FLOOR_M - start[1]) / RAYS[..., 1], 0.0)
        road = np.where(road < 7.0, road, 0.0).astype(np.float32)
        full, image = np.full(SHAPE, 0.002, np.float32), np.full(SHAPE, 99, np.uint8)
        wTc = pose(np.eye(3), start)
        frames.append(DepthFrame(road, full, image, wTc, np.zeros(SHAPE, np.float32)))
    seen = fused(frames).positions
    ahead = seen[(np.abs(seen[:, 0]) < 0.5) & (seen[:, 2] > 5.0) & (seen[:, 2] < 6.0)]
    cells = np.unique(np.floor(ahead[:, [0, 2]] / 0.1), axis=0)
    assert len(cells) > 0.9 * 10 * 10


@pytest.mark.usefixtures("open3d")
def test_what_is_seen_through_later_leaves_no_trail() -> None:
    def standing(surface: Surface) -> int:
        near = np.abs(surface.positions[:, 2] - 1.0) < 0.05
        return int((near & (surface.normals[:, 2] < -0.9)).sum())

    walked, gone = [frame(np.eye(4), post=True)] * 9, frame(np.eye(4))
    assert standing(fused(walked)) > 30
    assert standing(fused([*walked, gone])) < 10  # of its foot, next to the floor
    # A depth too rough for the surface shows what is free before it, not what may be behind it.
    rough = replace(gone, sigma=np.full(SHAPE, 0.06, np.float32))
    assert standing(fused([*walked, rough])) < 10
    rough = replace(gone, sigma=np.full(SHAPE, 0.3, np.float32))
    assert standing(fused([*walked, rough])) > 30


@pytest.mark.usefixtures("open3d")
def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        surface = fused([frame(wTc, post=True) for wTc in poses(3)])
        surface.save(tmp_path / f"{name}.ply", triangles=True)
        surface.save(tmp_path / f"{name}.pcd")
    for suffix in ("ply", "pcd"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


def test_other_tools_read_points_triangles_and_deviations(
    tmp_path: Path, open3d: ModuleType
) -> None:
    surface = fused([frame(np.eye(4))])
    surface.save(tmp_path / "mesh.ply", triangles=True, axes="ros", remark="of a test")
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    turned = np.asarray(mesh.vertices)
    np.testing.assert_allclose(turned, surface.positions[:, [2, 0, 1]] * [1, -1, -1], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), surface.triangles)
    assert mesh.has_vertex_colors()
    for name in ("cloud.ply", "cloud.pcd"):
        surface.save(tmp_path / name)
        read = open3d.t.io.read_point_cloud(str(tmp_path / name))
        np.testing.assert_allclose(read.point["positions"].numpy(), surface.positions, atol=1e-6)
        assert len(read.point["colors"].numpy()) == len(surface.positions)
    read = open3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    np.testing.assert_allclose(read.point["sigma"].numpy()[:, 0], surface.sigmas, atol=1e-6)
    assert b"x forward" in (tmp_path / "mesh.ply").read_bytes()[:400]


@pytest.mark.usefixtures("open3d")
def test_frames_without_depth_and_an_empty_grid_are_no_error() -> None:
    empty = frame(np.eye(4))
    empty.depth[:] = 0.0
    assert len(fused([empty]).positions) == 0
    assert len(Fusion(MATRIX, VOXEL).surface(VOXEL).triangles) == 0


def test_formats_that_hold_no_cloud_or_no_triangles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"unknown cloud format '.xyz'; use .ply or .pcd"):
        Surface.empty().save(tmp_path / "a.xyz")
    with pytest.raises(OutputError, match=r"unknown mesh format '.pcd'; use .ply"):
        Surface.empty().save(tmp_path / "a.pcd", triangles=True)
    Surface.empty().save(tmp_path / "a.ply", triangles=True)
    assert b"element vertex 0" in (tmp_path / "a.ply").read_bytes()


# ------------------------------------------------------------------------------------------
# The grid


def grid_of(wTc: FloatArray, post: bool = False, level: bool = False) -> Grid:
    """Of frames turned about one camera; the map's axes are turned by ``wTc``."""
    turns = [pose(so3_exp(np.array([0.0, a, 0.0])), np.zeros(3)) for a in (-0.3, 0.0, 0.3)] * 2
    frames = []
    for turn in turns:
        seen = frame(turn, post)
        frames.append(DepthFrame(seen.depth, seen.sigma, seen.image, wTc @ turn, seen.shared))
    surface = fused(frames)
    up = np.array([0.0, -1.0, 0.0]) if not level else wTc[:3, :3] @ [0.0, -1.0, 0.0]
    up = up if level else find_up(surface, up, 2.0 * VOXEL)
    return make_grid(surface, [(f.depth, f.wTc) for f in frames], RAYS, up, VOXEL)


def cell_at(grid: Grid, x: float, y: float) -> tuple[int, int]:
    """Row and column at x metres ahead and y to the left of the first camera."""
    column = int((x - grid.origin[0]) / grid.resolution_m)
    return len(grid.cells) - 1 - int((y - grid.origin[1]) / grid.resolution_m), column


def cell(grid: Grid, x: float, y: float) -> int:
    return int(grid.cells[cell_at(grid, x, y)])


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("level", [True, False])
def test_floor_is_free_obstacles_are_occupied_and_the_hidden_is_unknown(level: bool) -> None:
    grid = grid_of(np.eye(4), post=True, level=level)
    assert np.median(grid.ground[grid.cells == FREE]) == pytest.approx(-FLOOR_M, abs=0.02)
    assert grid.tilt_deg < 1.0
    assert cell(grid, 0.5, 0.0) == FREE
    assert cell(grid, 1.4, 0.5) == FREE
    assert {cell(grid, 1.0 + d, 0.0) for d in (-0.02, 0.03)} & {OCCUPIED}
    assert {cell(grid, WALL_M + d, 0.5) for d in (-0.02, 0.03)} & {OCCUPIED}
    assert cell(grid, 1.6, 0.0) == UNKNOWN


@pytest.mark.usefixtures("open3d")
def test_the_floor_is_found_in_a_map_that_is_tilted() -> None:
    tilted = pose(so3_exp(np.deg2rad([15.0, 0.0, 0.0])), np.zeros(3))
    grid = grid_of(inverse(tilted))
    assert grid.tilt_deg == pytest.approx(15.0, abs=0.5)
    np.testing.assert_allclose(grid.wRg[:, 2], inverse(tilted)[:3, :3] @ [0, -1, 0], atol=0.01)


RAMP_M, RISE = 1.5, 0.2  # where it begins, and how steep it is


def on_a_ramp(wTc: FloatArray, hole: bool) -> DepthFrame:
    """A level road that becomes a ramp, with a post on it at 3 m and a wall at 5 m."""
    start = wTc[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        level = (FLOOR_M - start[1]) / RAYS[..., 1]
        ramp = (FLOOR_M - start[1] - RISE * (start[2] - RAMP_M)) / (RAYS[..., 1] + RISE)
        road = np.where((level > 0.0) & (start[2] + level < RAMP_M), level, ramp)
    depth = np.minimum(5.0 - start[2], np.where(road > 0.0, road, np.inf))
    post = 3.0 - start[2]
    depth[(np.abs(start[0] + post * RAYS[..., 0] - 0.4) < 0.1) & (post < depth)] = post
    if hole:  # wrong matches that lie far below
        depth[50:52, 40:42] += 1.0
    full, image = np.full(SHAPE, SIGMA, np.float32), np.full(SHAPE, 99, np.uint8)
    return DepthFrame(depth.astype(np.float32), full, image, wTc, np.zeros(SHAPE, np.float32))


@pytest.mark.usefixtures("open3d")
def test_a_ramp_is_ground_and_what_stands_on_it_is_in_the_way() -> None:
    ways = 0.1 * np.arange(16)
    heights = -RISE * np.maximum(ways - RAMP_M, 0.0)
    places = [np.array([0.0, y, z]) for y, z in zip(heights, ways, strict=True)]
    frames = [on_a_ramp(pose(np.eye(3), place), k == 3) for k, place in enumerate(places)]
    surface = fused(frames)
    up = np.array([0.0, -1.0, 0.0])
    grid = make_grid(surface, [(f.depth, f.wTc) for f in frames], RAYS, up, VOXEL)
    for x in (1.0, 2.0, 3.0, 4.0):  # up to half a metre above the first camera's floor
        assert cell(grid, x, 0.0) == FREE
        row, column = cell_at(grid, x, 0.0)
        expected = RISE * max(x - RAMP_M, 0.0) - FLOOR_M
        assert grid.ground[row, column] == pytest.approx(expected, abs=0.06)
    assert OCCUPIED in {cell(grid, 3.0 + d, -0.4) for d in (-0.05, -0.02, 0.03)}
    assert OCCUPIED in {cell(grid, 5.0 + d, 0.5) for d in (-0.05, -0.02, 0.03)}


@pytest.mark.usefixtures("open3d")
def test_the_grid_is_what_a_map_server_reads(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    grid = grid_of(np.eye(4), post=True)
    grid.save(tmp_path / "map.yaml")
    stated = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert stated["image"] == "map.pgm"
    assert (stated["resolution"], stated["negate"]) == (VOXEL, 0)
    np.testing.assert_allclose(stated["origin"], [*grid.origin, 0.0], atol=1e-6)
    content = io.BytesIO((tmp_path / "map.pgm").read_bytes())
    assert content.readline() == b"P5\n"
    columns, rows = map(int, content.readline().split())
    assert content.readline() == b"255\n"
    cells = np.frombuffer(content.read(), np.uint8).reshape(rows, columns)
    np.testing.assert_array_equal(cells, grid.cells)
    # As nav2_map_server decides.
    occupancy = (255.0 - cells) / 255.0
    assert ((occupancy > stated["occupied_thresh"]) == (cells == OCCUPIED)).all()
    assert ((occupancy < stated["free_thresh"]) == (cells == FREE)).all()
