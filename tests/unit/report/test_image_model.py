"""Images with poses and points, as COLMAP itself and nerfstudio's conventions read them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from simulated import Drive, simulate

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OutputError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurement_log import MeasurementLog
from fgslam.report.formats import ImageModel, MapPoints, write_colmap
from fgslam.runs.export import Tints, build_model, with_normals


def map_of(positions: FloatArray) -> MapPoints:
    n = len(positions)
    zeros, flags = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    colours = np.arange(3 * n).reshape(n, 3).astype(np.uint8)
    return MapPoints(
        np.arange(n), positions, np.zeros((n, 3, 3)), colours, zeros, zeros, flags, flags
    )


@pytest.fixture(scope="module")
def model() -> ImageModel:
    """A noisy drive of the trinocular rig with the true map."""
    drive = Drive(frames=8, points=60)
    simulation = simulate(drive, np.random.default_rng(3))
    log = MeasurementLog(drive.rig, {}, simulation.increments)
    stamps = np.array([increment.timestamp for increment in log])
    points = map_of(simulation.points_by_id)
    return build_model(log, Trajectory(stamps, simulation.poses), points)


def test_colmap_reads_the_model(model: ImageModel, tmp_path: Path) -> None:
    write_colmap(tmp_path, model)
    read = pycolmap.Reconstruction(str(tmp_path))
    assert read.num_reg_images() == len(model.names) == 8 * model.rig.cameras
    assert read.num_points3D() == len(model.ids)
    read.update_point_3d_errors()  # COLMAP's own projection of what it read
    ours = float(model.point_errors().mean())
    assert ours > 0.1
    assert read.compute_mean_reprojection_error() == pytest.approx(ours, rel=0.01)
    image = read.image(model.rig.cameras + 2)  # the second frame's left camera
    assert image.name == "left/000001.png"
    iTw = image.cam_from_world().matrix()
    wTi = model.poses[model.rig.cameras + 1]
    np.testing.assert_allclose(iTw[:, :3], wTi[:3, :3].T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(iTw @ wTi[:, 3], 0.0, rtol=0, atol=1e-12)
    first = read.point3D(1)
    np.testing.assert_allclose(first.xyz, model.positions[0], rtol=0, atol=1e-12)
    assert first.color.tolist() == model.colours[0].tolist()


def test_the_left_camera_is_a_baseline_away_from_the_right_one(model: ImageModel) -> None:
    right, left = model.poses[:2]
    np.testing.assert_allclose(
        np.linalg.inv(right) @ left[:, 3], [-model.rig.baseline, 0, 0, 1], rtol=0, atol=1e-12
    )


def test_normals_are_those_of_the_surface_and_face_the_camera(model: ImageModel) -> None:
    across = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), -1).reshape(-1, 2)
    wall = map_of(np.column_stack([across, np.full(len(across), 4.0)]))
    normals = with_normals(wall, model).normals
    assert normals is not None
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, -1.0], (400, 1)), rtol=0, atol=1e-9)


def test_the_map_takes_the_mean_colour_of_what_the_reference_camera_shows(
    model: ImageModel,
) -> None:
    shape = (model.rig.height, model.rig.width, 3)
    red, blue = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    red[..., 0], blue[..., 2] = 200, 100
    tints = Tints(len(model.ids))
    tints.sample(model, 0, red)
    tints.sample(model, model.rig.cameras, blue)  # the second frame's right camera
    first, second = (np.unique(model.point[model.image == row]) for row in (0, model.rig.cameras))
    points = map_of(model.positions)
    renamed = replace(model, ids=points.ids)
    colours = tints.on(points, renamed).colours
    both, neither = (
        np.intersect1d(first, second),
        np.setdiff1d(points.ids, np.union1d(first, second)),
    )
    assert len(both) > 5
    assert len(neither) > 1
    assert (colours[both] == [100, 0, 50]).all()
    assert (colours[np.setdiff1d(first, second)] == [200, 0, 0]).all()
    assert (colours[neither] == points.colours[neither]).all()


@pytest.mark.parametrize("channels", [(), (3,)])
def test_an_image_that_shows_no_landmark_colours_none(
    model: ImageModel, channels: tuple[int, ...]
) -> None:
    seen = model.image != 0
    dark = replace(
        model, image=model.image[seen], point=model.point[seen], pixels=model.pixels[seen]
    )
    tints = Tints(len(model.ids))
    tints.sample(dark, 0, np.zeros((model.rig.height, model.rig.width, *channels), np.uint8))
    points = map_of(model.positions)
    np.testing.assert_array_equal(tints.on(points, dark).colours, points.colours)


def test_a_model_that_is_not_finite_is_refused(model: ImageModel, tmp_path: Path) -> None:
    bad = model.positions.copy()
    bad[0, 0] = np.nan
    broken = replace(model, positions=bad)
    with pytest.raises(OutputError, match="positions are not all finite"):
        write_colmap(tmp_path, broken)
