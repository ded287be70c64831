"""Files for other tools: maps, graphs, COLMAP models, ROS 2 bags, read back by these tools."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pycolmap
import pytest
from rosbags.highlevel import AnyReader
from simulated import Drive, simulate

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    rotation_from_quaternion,
    se3_exp,
    transform_to_camera,
)
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig, PoseFrame
from fgslam.core.types import Trajectory
from fgslam.report.formats import (
    FRAME,
    TOPIC,
    ImageModel,
    MapPoints,
    PoseLandmarkGraph,
    g2o_information,
    read_ply,
    write_colmap,
    write_g2o,
    write_map,
    write_mcap,
    write_trajectory,
)
from fgslam.runs.export import Tints, build_graph, build_model, with_normals


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
        from fgslam.core.open3d_library import load_open3d
    except ImportError:
        return pytest.importorskip("open3d", exc_type=ImportError, reason="Open3D cannot be loaded")
    from fgslam.core.errors import MissingDependencyError

    try:
        return load_open3d()
    except MissingDependencyError as error:
        pytest.skip(f"Open3D cannot be loaded: {error}")


def test_ply_there_and_back_is_exact(tmp_path: Path) -> None:
    written = a_map()
    write_map(tmp_path / "map.ply", written)
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
    write_map(tmp_path / "map.ply", a_map(3))
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    expected = (
        "x y z red green blue landmark_id hits misses cxx cxy cxz cyy cyz czz valid permanent"
    )
    assert " ".join(names) == expected
    assert "element vertex 3" in header
    assert "metres" in header


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_same_map_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        write_map(tmp_path / f"{name}{suffix}", a_map(50))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_open3d_reads_the_ply(tmp_path: Path, open3d) -> None:
    points = a_map()
    write_map(tmp_path / "map.ply", points)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_array_equal(np.asarray(cloud.points), points.positions)
    np.testing.assert_allclose(np.asarray(cloud.colors), points.colours / 255.0)
    tensors = open3d.t.io.read_point_cloud(str(tmp_path / "map.ply")).point
    np.testing.assert_array_equal(tensors["landmark_id"].numpy()[:, 0], points.ids)
    np.testing.assert_array_equal(tensors["cyz"].numpy()[:, 0], points.covariances[:, 1, 2])


def test_open3d_reads_the_pcd(tmp_path: Path, open3d) -> None:
    points = a_map()
    write_map(tmp_path / "map.pcd", points)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "map.pcd"))
    np.testing.assert_array_equal(np.asarray(cloud.points), points.positions.astype(np.float32))
    np.testing.assert_allclose(np.asarray(cloud.colors), points.colours / 255.0)


def test_unknown_format_and_landmarks_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"use \.ply or \.pcd"):
        write_map(tmp_path / "map.xyz", a_map(1))
    broken = a_map(5)
    broken.positions[3, 1] = np.nan
    with pytest.raises(OutputError, match="positions 3 is not finite"):
        write_map(tmp_path / "map.ply", broken)
    with pytest.raises(OutputError, match="ids must lie"):
        write_map(tmp_path / "map.pcd", dataclasses.replace(a_map(1), ids=np.array([2**31])))
    assert list(tmp_path.iterdir()) == []


def test_foreign_and_broken_ply_files(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    with pytest.raises(DatasetError, match="No such file"):
        read_ply(path)
    path.write_text("OFF\n")
    with pytest.raises(DatasetError, match="no landmark map, or cut off"):
        read_ply(path)
    write_map(path, a_map(5))
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    with pytest.raises(DatasetError, match="cut off"):
        read_ply(path)
    path.write_bytes(whole.replace(b" hits\n", b" hots\n"))
    with pytest.raises(DatasetError, match="no landmark map"):
        read_ply(path)
    path.write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(DatasetError, match="no landmark map"):
        read_ply(path)
    path.write_bytes(whole.replace(b"property double x", b"property list uchar int x"))
    with pytest.raises(DatasetError, match="no landmark map"):
        read_ply(path)


Lines = dict[str, list[list[float]]]


def parse(path: Path) -> Lines:
    """Numbers of each line by its tag; comments left out."""
    out: Lines = {}
    for line in path.read_text(encoding="ascii").splitlines():
        tag, *cells = line.split()
        if tag != "#":
            out.setdefault(tag, []).append([float(cell) for cell in cells])
    return out


def from_upper(values: list[float], n: int) -> FloatArray:
    out = np.zeros((n, n))
    out[np.triu_indices(n)] = values
    return out + np.triu(out, 1).T


def pose_of(seven: list[float]) -> FloatArray:
    return pose(rotation_from_quaternion(np.array(seven[3:])), np.array(seven[:3]))


def exact_graph(
    rng: np.random.Generator, noise: float = 0.0
) -> tuple[PoseLandmarkGraph, MeasurementLog, IntArray]:
    """Of a simulated drive, started at the truth; the log; the landmarks that the map holds."""
    drive = dataclasses.replace(Drive(), frames=8, points=60, noise=noise, prune_after=3)
    simulation = simulate(drive, rng)
    log = MeasurementLog(drive.rig, {}, simulation.increments)
    stamps = np.array([increment.timestamp for increment in log])
    held = np.arange(0, len(simulation.points_by_id), 2)
    trajectory = Trajectory(stamps, simulation.poses)
    return build_graph(log, trajectory, held, simulation.points_by_id[held]), log, held


def test_every_measurement_agrees_with_the_truth_in_the_file(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Noise-free: from each edge's own vertices follows exactly what the edge measured."""
    graph, log, _ = exact_graph(rng)
    path = tmp_path / "exact.g2o"
    write_g2o(path, graph, ["a remark"])
    lines = parse(path)
    poses = {int(row[0]): pose_of(row[1:]) for row in lines["VERTEX_SE3:QUAT"]}
    points = {int(row[0]): np.array(row[1:]) for row in lines["VERTEX_TRACKXYZ"]}
    assert lines["FIX"] == [[0.0]]
    assert lines["PARAMS_SE3OFFSET"] == [[0, 0, 0, 0, 0, 0, 0, 1]]
    assert not poses.keys() & points.keys()
    assert len(lines["EDGE_SE3:QUAT"]) == len(log) - 1
    for a, b, *numbers in lines["EDGE_SE3:QUAT"]:
        between = inverse(poses[int(a)]) @ poses[int(b)]
        np.testing.assert_allclose(between, pose_of(numbers[:7]), atol=1e-10)
    assert len(lines["EDGE_SE3_TRACKXYZ"]) == sum(len(s.observations) for s in log)
    for a, b, offset, *numbers in lines["EDGE_SE3_TRACKXYZ"]:
        assert offset == 0
        local = inverse(poses[int(a)]) @ np.append(points[int(b)], 1.0)
        np.testing.assert_allclose(local[:3], numbers[:3], atol=1e-8)
        assert np.linalg.eigvalsh(from_upper(numbers[3:], 3)).min() > 0.0


def test_information_weighs_a_motion_as_our_covariance_does(rng: np.random.Generator) -> None:
    """g2o's error (translation, quaternion's vector part) of a small motion, by its own matrix."""
    root = rng.standard_normal((6, 6)) * np.array([0.01, 0.02, 0.01, 0.1, 0.2, 0.05])[:, None]
    covariance = root @ root.T
    information = g2o_information(covariance[None])[0]
    for _ in range(5):
        xi = 1e-5 * rng.standard_normal(6)
        error = se3_exp(xi)
        quaternion = gtsam.Rot3(error[:3, :3]).toQuaternion()
        vector = np.array([quaternion.x(), quaternion.y(), quaternion.z()])
        theirs = np.concatenate([error[:3, 3], vector])
        ours = xi @ np.linalg.solve(covariance, xi)
        assert theirs @ information @ theirs == pytest.approx(ours, rel=1e-4)


def test_gtsam_reads_poses_and_motions(tmp_path: Path, rng: np.random.Generator) -> None:
    graph, _, _ = exact_graph(rng, noise=1.0)
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph)
    factors, values = gtsam.readG2o(str(path), True)
    # It turns a seen point into bearing and range, after all motions.
    assert factors.size() == len(graph.motions) + len(graph.points)
    for row, wTc in enumerate(graph.poses):
        np.testing.assert_allclose(values.atPose3(row).matrix(), wTc, atol=1e-10)
    for row in range(len(graph.motions)):
        factor = factors.at(row)
        assert list(factor.keys()) == [graph.motion_from[row], graph.motion_to[row]]
        np.testing.assert_allclose(factor.measured().matrix(), graph.motions[row], atol=1e-10)
        # It takes the quaternion's vector part for the whole rotation vector: four times.
        theirs = factor.noiseModel().information()
        ours = np.linalg.inv(graph.motion_covariances[row])
        np.testing.assert_allclose(theirs[:3, :3], 4.0 * ours[:3, :3], rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(theirs[3:, 3:], ours[3:, 3:], rtol=1e-6, atol=1e-3)
    for row in range(len(graph.motions), factors.size()):
        at, landmark = factors.at(row).keys()
        which = gtsam.Symbol(landmark).index() - len(graph.poses)
        seen = graph.points[(graph.seen_from == at) & (graph.seen == which)][0]
        assert factors.at(row).measured().range() == pytest.approx(np.linalg.norm(seen), rel=1e-9)


def test_landmarks_start_on_the_map_or_where_first_seen(rng: np.random.Generator) -> None:
    graph, log, held = exact_graph(rng, noise=1.0)
    ids = np.unique(np.concatenate([increment.observations.ids for increment in log]))
    first = {}
    for row, which, point in zip(graph.seen_from, graph.seen, graph.points, strict=True):
        first.setdefault(which, graph.poses[row, :3, :3] @ point + graph.poses[row, :3, 3])
    forgotten = np.flatnonzero(~np.isin(ids, held))
    assert len(forgotten) > 5
    for which in forgotten:
        np.testing.assert_allclose(graph.landmarks[which], first[which], atol=1e-12)
    mapped = np.flatnonzero(np.isin(ids, held))
    assert not np.allclose(graph.landmarks[mapped], [first[which] for which in mapped], atol=1e-3)


def test_rejected_and_placeless_observations_and_gaps_are_left_out(
    rng: np.random.Generator,
) -> None:
    _, log, held = exact_graph(rng)
    increments = list(log)
    seen = increments[3].observations
    rejected = np.zeros(len(seen), np.bool_)
    rejected[:2] = True
    measurement = seen.measurement.copy()
    measurement[2, 2] = -1.0  # a wrong match: the point would be behind the camera
    increments[3] = dataclasses.replace(
        increments[3],
        rejected=rejected,
        odometry=None,
        observations=dataclasses.replace(seen, measurement=measurement),
    )
    increments[5] = dataclasses.replace(increments[5], relocalised=True)  # it was carried there
    spoilt = MeasurementLog(log.rig, {}, increments)
    stamps = np.array([s.timestamp for s in log])[:-1]  # the last frame has no pose
    trajectory = Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    graph = build_graph(spoilt, trajectory, held, np.zeros((len(held), 3)))
    everything = sum(len(s.observations) for s in increments[:-1])
    assert len(graph.points) == everything - 3
    assert graph.motion_to.tolist() == [1, 2, 4, 6]


def test_an_empty_log_has_a_graph(tmp_path: Path, rng: np.random.Generator) -> None:
    _, log, _ = exact_graph(rng)
    nothing = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    empty = MeasurementLog(log.rig, {}, [])
    graph = build_graph(empty, nothing, np.empty(0, np.int64), np.empty((0, 3)))
    write_g2o(tmp_path / "empty.g2o", graph)
    assert parse(tmp_path / "empty.g2o").keys() == {"PARAMS_SE3OFFSET"}


def test_refusals_name_the_fix(tmp_path: Path, rng: np.random.Generator) -> None:
    graph, _, _ = exact_graph(rng)
    with pytest.raises(OutputError, match=r"unknown graph format '\.txt'; use \.g2o"):
        write_g2o(tmp_path / "graph.txt", graph)
    landmarks = graph.landmarks.copy()
    landmarks[4, 1] = np.nan
    with pytest.raises(OutputError, match="landmarks 4 is not finite"):
        write_g2o(tmp_path / "graph.g2o", dataclasses.replace(graph, landmarks=landmarks))
    assert list(tmp_path.iterdir()) == []


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
    with pytest.raises(OutputError, match="positions 0 is not finite"):
        write_colmap(tmp_path, broken)


def test_poses_are_in_the_axes_of_ros(tmp_path: Path) -> None:
    """One metre forward, turned to the right: x = 1, and a negative turn about z, which is up."""
    turned = se3_exp(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))  # about the camera's y, down
    turned[:3, 3] = 0.0, 0.0, 1.0
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    path = tmp_path / "t.mcap"
    trajectory = Trajectory(np.array([1.25, 2.5]), np.array([np.eye(4), turned]))
    write_mcap(path, trajectory, np.array([covariance, np.full((6, 6), np.nan)]))
    with AnyReader([path]) as bag:
        assert [c.topic for c in bag.connections] == [TOPIC]
        read = [(t, bag.deserialize(raw, c.msgtype)) for c, t, raw in bag.messages()]
    assert [t for t, _ in read] == [1_250_000_000, 2_500_000_000]
    first, second = (message for _, message in read)
    assert first.header.frame_id == FRAME
    # Translation first; forward is the camera's z, left minus its x, up minus its y.
    assert np.diag(first.pose.covariance.reshape(6, 6)).tolist() == [6, 4, 5, 3, 1, 2]
    assert not second.pose.covariance.any()  # unknown
    place, turn = second.pose.pose.position, second.pose.pose.orientation
    np.testing.assert_allclose([place.x, place.y, place.z], [1, 0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        [turn.x, turn.y, turn.z, turn.w],
        [0, 0, -np.sin(0.15), np.cos(0.15)],
        rtol=0,
        atol=1e-12,
    )


RIG = CameraRig(
    *(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None), BODY_FORWARD_LEFT_UP_FROM_CAMERA
)


@pytest.mark.parametrize("frame", ["left", "right", "body"])
def test_map_and_trajectory_in_the_axes_of_ros_overlay(tmp_path: Path, frame: PoseFrame) -> None:
    """Landmarks lie before the camera where they did; a body that looks ahead has ROS's axes."""
    turned = se3_exp(np.array([0.1, 0.3, -0.2, 0.5, -0.1, 1.0]))
    moved = Trajectory(np.arange(2.0), np.array([np.eye(4), turned])).of(frame, RIG)
    points = a_map(20)
    write_trajectory(tmp_path / "t.tum", moved, axes="ros")
    write_map(tmp_path / "m.ply", points, axes="ros")
    assert "axes of REP 103: x forward, y left, z up" in (tmp_path / "t.tum").read_text()
    assert b"x forward, y left, z up" in (tmp_path / "m.ply").read_bytes()
    read, found = Trajectory.load(tmp_path / "t.tum"), read_ply(tmp_path / "m.ply")
    assert read.frame == frame
    local = transform_to_camera(moved.poses[1], points.positions)
    if frame != "body":  # forward is the camera's z, left minus its x, up minus its y
        local = local[:, [2, 0, 1]] * [1.0, -1.0, -1.0]
    seen = transform_to_camera(read.poses[1], found.positions)
    np.testing.assert_allclose(seen, local, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(found.covariances), np.linalg.eigvalsh(points.covariances), atol=1e-12
    )


def test_a_bag_has_the_poses_of_a_body_in_its_own_axes(tmp_path: Path) -> None:
    camera = Trajectory(np.arange(2.0), np.array([np.eye(4), se3_exp(np.full(6, 0.1))]))
    body, covariances = camera.of("body", RIG), np.tile(np.eye(6), (2, 1, 1))
    write_trajectory(tmp_path / "t.mcap", body, covariances)
    write_trajectory(tmp_path / "t.tum", body, axes="ros")
    expected = Trajectory.load(tmp_path / "t.tum").poses[1]
    with AnyReader([tmp_path / "t.mcap"]) as bag:
        read = [bag.deserialize(raw, c.msgtype).pose.pose for c, _, raw in bag.messages()]
    place, turn = read[1].position, read[1].orientation
    np.testing.assert_allclose([place.x, place.y, place.z], expected[:3, 3], atol=1e-9)
    found = rotation_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
    np.testing.assert_allclose(found, expected[:3, :3], atol=1e-9)
