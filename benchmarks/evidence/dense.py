"""Dense maps of the rendered lab and of EuRoC V1_01 (docs/results): error, completeness, grid."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import fgslam
from benchmarks.runs import experiment, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse
from fgslam.core.open3d_library import load_open3d
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.report.surface import FREE, KEPT_SIGMA_VOXELS, Surface
from fgslam.runs.dense import DenseMap, DenseSettings
from fgslam.runs.export import dense_map
from fgslam.runs.opening import open_sequence
from fgslam.worlds.people import WALK_FRAMES

VOXEL_M = 0.04
WIDE_M = 0.15
_SAMPLES = 300_000
_FAR_M = 0.15  # of the room's surfaces: a vertex there is of the person
_HEIGHTS_M = np.arange(0.15, 1.95, 0.1)


def tables(data: Path) -> list[Table]:
    """The lab with two and three cameras, its grid, a person in it; the floor of V1_01."""
    with tempfile.TemporaryDirectory() as folder:
        run = _run("lab_loop", Path(folder))
        lab, truth = _open("lab_loop"), None
        rows: list[tuple[Cell, ...]] = []
        for cameras, sigma_m in ((3, None), (3, WIDE_M), (2, None), (2, WIDE_M)):
            say(f"lab, {cameras} cameras")
            how = DenseSettings(VOXEL_M, cameras=cameras, sigma_m=sigma_m)
            found = dense_map(run, how=how)
            truth = _seen(lab, found.range_m) if truth is None else truth
            kept = 100.0 * (sigma_m or KEPT_SIGMA_VOXELS * VOXEL_M)
            rows.append((f"{cameras} cameras, {kept:.0f} cm", *_judged(found.surface, lab, truth)))
            if (cameras, sigma_m) == (3, None):
                grid = _judged_grid(found, lab)
        how = DenseSettings(VOXEL_M)
        trail = _trail("without a person", dense_map(run, how=how), lab)
        with_person = dense_map(_run("lab_person", Path(folder)), how=how)
        trail += _trail("with one", with_person, _open("lab_person"))
        out = [
            Table("The lab, voxels of 4 cm", ("", *_COLUMNS), rows),
            Table("The lab's grid, and a person", ("", "value"), [*grid, *trail]),
        ]
        euroc = data / "euroc_v101_kf100"
        if euroc.is_dir():
            floor = dense_map(_run(str(euroc), Path(folder)), how=DenseSettings(every=1))
            rows = [("thickness of the floor in cells of 0.6 m, median, mm", _thickness(floor))]
            out.append(Table("EuRoC V1_01", ("", "value"), rows))
    return out


def _run(name: str, folder: Path) -> Path:
    say(f"runs {name}")
    return fgslam.run(name, out=folder / Path(name).name).folder


def _open(name: str) -> RenderedLabSequence:
    sequence = open_sequence(experiment(name, ()))
    if not isinstance(sequence, RenderedLabSequence):
        raise ValueError(f"{name} is not rendered")
    return sequence


_COLUMNS = (
    *("error median mm", "90 % mm", "complete 2 cm %", "5 cm %", "10 cm %"),
    *("within 1 sigma %", "2 sigma %"),
)


def _judged(surface: Surface, lab: RenderedLabSequence, truth: FloatArray) -> tuple[Cell, ...]:
    """Error of points sampled by area; completeness of what the cameras saw."""
    points, sigmas = _sampled(surface)
    error = _to_room(points, lab)
    o3c, scene = load_open3d().core, load_open3d().t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3c.Tensor(surface.positions), o3c.Tensor(surface.triangles.astype(np.uint32))
    )
    missed = scene.compute_distance(o3c.Tensor(truth.astype(np.float32)), nthreads=1).numpy()
    complete = [100.0 * float((missed < m).mean()) for m in (0.02, 0.05, 0.1)]
    within = [100.0 * float((error < k * sigmas).mean()) for k in (1.0, 2.0)]
    errors = (1000.0 * np.percentile(error, (50.0, 90.0))).tolist()
    return (*errors, *complete, *within)


def _sampled(surface: Surface) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    corners = surface.positions[surface.triangles].astype(np.float64)
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    chosen = rng.choice(len(areas), _SAMPLES, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), _SAMPLES)
    sigmas = surface.voxel_sigmas[surface.triangles[chosen]]
    points = np.einsum("nk,nkj->nj", weights, corners[chosen])
    return points, np.asarray((weights * sigmas).sum(axis=1))


def _to_room(points: FloatArray, lab: RenderedLabSequence) -> FloatArray:
    """(n,) distances to the room's surfaces without the person, metres."""
    rTw = lab.room_from_world
    return lab._open_world().room.caster.distance(points @ rTw[:3, :3].T + rTw[:3, 3])


def _seen(lab: RenderedLabSequence, range_m: float) -> FloatArray:
    """Points (n, 3) of all surfaces seen nearer than that, one in each cell of 2 cm."""
    rig, found = lab.rig, []
    rows, columns = np.indices((rig.height, rig.width))
    rays = np.stack([(columns - rig.cx) / rig.fx, (rows - rig.cy) / rig.fy, 0 * rows + 1.0], -1)
    for i in range(0, len(lab), 4):
        depth, wTc = lab.depth(i), lab.ground_truth.poses[i]
        points = (rays * depth[..., None])[depth < range_m]
        found.append(points @ wTc[:3, :3].T + wTc[:3, 3])
    every = np.concatenate(found)
    first = np.unique(np.floor(every / 0.02).astype(np.int64), axis=0, return_index=True)[1]
    return np.asarray(every[first])


def _judged_grid(found: DenseMap, lab: RenderedLabSequence) -> list[tuple[Cell, ...]]:
    """Share of free cells in which something stands."""
    grid = found.grid
    row, column = np.nonzero(grid.cells == FREE)
    x = grid.origin[0] + (column + 0.5) * grid.resolution_m
    y = grid.origin[1] + (len(grid.cells) - row - 0.5) * grid.resolution_m
    stands = np.zeros(len(x), np.bool_)
    for height in _HEIGHTS_M:
        points = (
            np.stack([x, y, np.full_like(x, grid.ground[row, column] + height)], 1) @ grid.wRg.T
        )
        stands |= _to_room(points, lab) < 0.5 * grid.resolution_m
    return [("free cells that are occupied, %", 100.0 * float(stands.mean()))]


def _trail(name: str, found: DenseMap, lab: RenderedLabSequence) -> list[tuple[Cell, ...]]:
    """Vertices far from the room's surfaces, and of these those that later frames see through."""
    vertices = found.surface.positions.astype(np.float64)
    far = vertices[_to_room(vertices, lab) > _FAR_M]
    through = np.zeros(len(far), np.bool_)
    rig = lab.rig
    for i in range(20 + WALK_FRAMES, len(lab), 4):
        cTw = inverse(lab.ground_truth.poses[i])
        x, y, z = (far @ cTw[:3, :3].T + cTw[:3, 3]).T
        ahead = np.maximum(z, 0.1)
        u = np.rint(rig.fx * x / ahead + rig.cx).astype(int)
        v = np.rint(rig.fy * y / ahead + rig.cy).astype(int)
        shown = (z > 0.1) & (u >= 0) & (v >= 0) & (u < rig.width) & (v < rig.height)
        depth = lab.depth(i)[v.clip(0, rig.height - 1), u.clip(0, rig.width - 1)]
        through |= shown & (depth > z + 4.0 * found.voxel_m) & (z < found.range_m)
    shares = [100.0 * count / len(vertices) for count in (len(far), int(through.sum()))]
    return [
        (f"{name}: vertices far from the room's surfaces, %", shares[0]),
        (f"{name}: those of them that are seen through later, %", shares[1]),
    ]


def _thickness(found: DenseMap) -> float:
    grid, surface = found.grid, found.surface
    points = surface.positions @ grid.wRg
    level = surface.normals @ grid.wRg[:, 2] > 0.94
    floor_m = float(np.median(grid.ground[grid.cells == FREE]))
    points = points[level & (np.abs(points[:, 2] - floor_m) < 0.1)]
    cells = np.unique(np.floor(points[:, :2] / 0.6), axis=0, return_inverse=True)[1].ravel()
    spread = [points[cells == k, 2].std() for k in range(cells.max() + 1)]
    return 1000.0 * float(np.median(spread))
