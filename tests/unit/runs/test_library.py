"""Recordings, replays and maps as the library offers them, and wrong use of each."""

from __future__ import annotations

import dataclasses
import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from recordings import write_recording

import fgslam as fg
from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.cameras.rectify import Rectifier
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Prediction
from fgslam.errors import (
    CalibrationError,
    ConfigError,
    DatasetError,
    EstimatorError,
    FgslamError,
    FrameError,
    MapError,
    MeasurementLogError,
    OutputError,
)
from fgslam.report.formats import read_ply
from fgslam.runs.session import override_texts

FRAMES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with images, odometry and truth, in our own layout."""
    return write_recording(tmp_path_factory.mktemp("recording"), frames=FRAMES)


@pytest.fixture(scope="module")
def driven(folder: Path) -> tuple[fg.Slam, fg.Result]:
    recording = fg.open_recording(folder)
    with fg.Slam(recording.rig, "landmark_kalman") as slam:
        for t, images, odometry in recording:
            slam.track(t, images, odometry)
    return slam, slam.result()


# --------------------------------------------------------------------------------------------
# Recordings


def test_a_recording_gives_left_right_and_top_with_odometry(folder: Path) -> None:
    recording = fg.open_recording(folder)
    frames = list(recording)
    assert len(frames) == len(recording) == FRAMES
    t, images, odometry = frames[3]
    assert t == recording.timestamps[3]
    inside = recording.sequence.frame(3).images
    assert images is not None
    assert odometry is not None
    for given, stored in zip(images, (inside[1], inside[0], inside[2]), strict=True):
        np.testing.assert_array_equal(given, stored)
    assert frames[0][2] is None
    assert recording.ground_truth is not None
    assert recording[-1][0] == frames[-1][0]


def test_an_unreadable_frame_has_no_images_and_tracking_goes_on(folder: Path) -> None:
    copy = write_recording(folder.parent / "damaged", frames=FRAMES)
    (copy / "left" / "000002.png").write_bytes(b"")
    recording = fg.open_recording(copy)
    assert [images is None for _, images, _ in recording] == [k == 2 for k in range(FRAMES)]
    slam = fg.Slam(recording.rig, "landmark_kalman")
    steps = [slam.track(t, images, odometry).status.value for t, images, odometry in recording]
    slam.close()
    assert steps[2] == "no_image"
    assert steps[3] == "ok"


def test_overrides_choose_frames(folder: Path) -> None:
    assert len(fg.open_recording(folder, {"dataset.start": 1, "dataset.stride": 2})) == 3
    assert len(fg.open_recording(folder, ["dataset.stop=2"])) == 2


# --------------------------------------------------------------------------------------------
# Logs, replays, tables


def test_a_replay_of_the_log_gives_the_live_result(
    driven: tuple[fg.Slam, fg.Result], tmp_path: Path
) -> None:
    slam, live = driven
    slam.log.save(tmp_path / "drive.npz")
    replayed = fg.replay(fg.MeasurementLog.load(str(tmp_path / "drive.npz")), "landmark_kalman")
    assert not replayed.failure
    np.testing.assert_array_equal(replayed.trajectory.poses, live.trajectory.poses)
    np.testing.assert_array_equal(replayed.covariances, live.covariances)
    np.testing.assert_array_equal(replayed.map.positions, live.map.positions)


def test_results_have_their_estimator_s_graph(driven: tuple[fg.Slam, fg.Result]) -> None:
    slam, live = driven
    graph, values, poses, landmarks = fg.replay(slam.log, "batch").graph()
    assert len(poses) == FRAMES
    assert set(landmarks) <= set(live.map.ids.tolist())
    assert graph.size() == fg.graph(slam.log).graph.size()
    assert graph.error(values) < 0.5 * graph.size() * 3
    with pytest.raises(ConfigError, match="landmark_kalman keeps no whole graph; use batch, isam2"):
        live.graph()


@pytest.mark.parametrize("kind", ["ekf", "isam2"])
def test_a_session_takes_what_other_sensors_measure(folder: Path, kind: str) -> None:
    """A beacon, and in the last frame a position that is 0.3 m off what all else says."""
    recording = fg.open_recording(folder)
    bTc = recording.rig.bTc
    beacon, gps, number = fg.RangeBearing(), fg.Position(bTc), fg.Measured.FIRST_ID + 7
    with fg.Slam(recording.rig, kind) as slam:
        for k, (t, images, odometry) in enumerate(recording):
            seen = [
                beacon.measured([[4.0, 0.1, 0.0]], 0.01 * np.eye(3), [fg.Measured.FIRST_ID + 7])
            ]
            if k == FRAMES - 1:
                there = slam.path.poses[-1][:3, 3] + [0.3, 0.0, 0.0]
                seen.append(gps.measured(there, 1e-8 * np.eye(3)))
            slam.track(t, images, odometry, seen)
        with pytest.raises(MeasurementLogError, match=r"add fgslam\.Measured\.FIRST_ID"):
            slam.track(t + 1.0, images, None, [beacon.measured([[4.0, 0, 0]], np.eye(3), [7])])
        with pytest.raises(MeasurementLogError, match=r"a float; give what model\.measured"):
            slam.track(t + 1.0, images, None, [as_any(4.0)])
    live = slam.result()
    np.testing.assert_allclose(live.trajectory.poses[-1][:3, 3], there, rtol=0, atol=0.02)
    assert live.estimate.landmarks.ids[-1] == number
    assert live.map.ids.max() < fg.Measured.FIRST_ID
    replayed = fg.replay(slam.log, kind)
    np.testing.assert_array_equal(replayed.trajectory.poses, live.trajectory.poses)
    if kind == "isam2":
        assert number in live.graph().landmarks


def test_overrides_come_second_wherever_they_are_taken() -> None:
    for function in (fg.run, fg.open_recording, fg.Slam.from_config):
        assert list(inspect.signature(function).parameters)[1] == "overrides"


def test_live_and_replayed_results_stand_in_one_table(
    driven: tuple[fg.Slam, fg.Result], folder: Path
) -> None:
    slam, live = driven
    answers: dict[str, Any] = {"live": live, "isam2": fg.replay(slam.log, "isam2")}
    table = fg.compare(answers, fg.open_recording(folder).ground_truth, full=True)
    assert table.index.tolist() == ["live", "isam2"]
    assert table["frames"].tolist() == [FRAMES, FRAMES]
    assert (table["ate_m"] < 0.05).all()
    assert (table["ms"] > 0.0).all()
    figure = fg.plot(answers)
    assert {"live", "isam2"} <= {trace.name for trace in figure.data}


class Silent(LandmarkKalman):
    """Forgets to say what its update did."""

    def update(self, increment, tracking):  # type: ignore[no-untyped-def]
        super().update(increment, tracking)


class Flat(LandmarkKalman):
    """Predicts a pose in the plane."""

    def predict(self, odometry):  # type: ignore[no-untyped-def]
        return dataclasses.replace(super().predict(odometry), wTc=np.eye(3))


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Silent, "update returned NoneType; return UpdateStats"),
        (Flat, r"predict returned a pose of shape \(3, 3\) .*return \(4, 4\) and \(6, 6\)"),
    ],
)
def test_a_slip_in_an_own_estimator_is_named(
    kind: type[LandmarkKalman], words: str, driven: tuple[fg.Slam, fg.Result]
) -> None:
    slam, _ = driven
    start = Prediction(np.eye(4), np.zeros((6, 6)))
    replayed = fg.replay(slam.log, kind(slam.rig, LandmarkKalmanSettings(), start))
    assert re.search(words, replayed.failure)
    own = fg.Slam(slam.rig, kind(slam.rig, LandmarkKalmanSettings(), start))
    with pytest.raises(EstimatorError, match=words):
        own.track(0.0, (np.zeros((slam.rig.height, slam.rig.width), np.uint8),) * slam.rig.cameras)


def test_frames_that_a_recording_does_not_have_are_named(folder: Path) -> None:
    with pytest.raises(IndexError, match=f"frame 99: the recording has {FRAMES} frames"):
        fg.open_recording(folder)[99]
    with pytest.raises(ConfigError, match="frames is 0; give at least 1"):
        fg.rendered_recording("lab", frames=0)


def test_an_estimator_brought_along_is_replayed_and_named(
    driven: tuple[fg.Slam, fg.Result],
) -> None:
    from fgslam.slam.build import chosen_estimator, made_or_given

    log = driven[0].log
    own = made_or_given(log.rig, chosen_estimator("ekf"))
    replayed, named = fg.replay(log, own), fg.replay(log, "ekf")
    assert replayed.kind == replayed.title == "ekf"
    np.testing.assert_array_equal(
        replayed.estimate.trajectory.poses, named.estimate.trajectory.poses
    )


# --------------------------------------------------------------------------------------------
# Results on disk


def test_a_trajectory_survives_its_file(driven: tuple[fg.Slam, fg.Result], tmp_path: Path) -> None:
    path = driven[1].trajectory
    path.save(tmp_path / "path.tum")
    again = fg.Trajectory.load(tmp_path / "path.tum")
    np.testing.assert_allclose(again.poses, path.poses, rtol=0, atol=1e-9)
    path.save(str(tmp_path / "path.kitti"))
    assert len((tmp_path / "path.kitti").read_text().splitlines()) == FRAMES
    with pytest.raises(OutputError, match=r"use \.tum, \.kitti or \.csv"):
        path.save(tmp_path / "path.txt")


def test_a_saved_map_locates_a_frame_and_refuses_another_rig(
    driven: tuple[fg.Slam, fg.Result], folder: Path, tmp_path: Path
) -> None:
    live = driven[1]
    live.map.save(tmp_path / "place.fgmap")
    place = fg.Map.load(tmp_path / "place.fgmap")
    np.testing.assert_array_equal(place.positions, live.map.positions)
    assert len(place.trajectory) == FRAMES
    recording = fg.open_recording(folder)
    images = recording[4][1]
    assert images is not None
    found, again = (place.locate(recording.rig, images) for _ in range(2))
    assert found.found, found.why
    np.testing.assert_allclose(found.wTc[:3, 3], live.trajectory.poses[4][:3, 3], rtol=0, atol=0.05)
    np.testing.assert_array_equal(found.wTc, again.wTc)
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    blank = tuple(np.zeros_like(image) for image in images)
    refused = place.locate(recording.rig, blank)
    assert not refused.found
    assert refused.why
    other = fg.StereoRig(width=320, height=240, fx=99, fy=99, cx=160, cy=120, baseline=0.1)
    with pytest.raises(MapError, match="another rig"):
        place.locate(other, images[:2])


# --------------------------------------------------------------------------------------------
# Overrides and wrong names


def test_overrides_are_written_as_on_the_command_line() -> None:
    given = {"seed": 3, "a.b": 1e-5, "c": None, "d": [1, 2], "e": "06", "f": np.float64(0.5)}
    texts = override_texts(given)
    assert texts == ["seed=3", "a.b=1.0e-05", "c=null", "d=[1, 2]", "e=06", "f=0.5"]
    assert override_texts(["seed=3"]) == ["seed=3"]


def test_a_session_is_configured_by_name_with_overrides(folder: Path) -> None:
    rig = fg.open_recording(folder).rig
    slam = fg.Slam.from_config(
        "kitti06", {"estimator.kind": "ekf", "dataset.start": 5, "dataset.stride": 3}, rig=rig
    )
    assert slam.pipeline.estimator.kind == "ekf"
    assert slam.numbering == (5, 3)
    assert not slam.pipeline.motion.uses_odometry


def as_any(value: object) -> Any:
    """What type checkers would refuse."""
    return value


def _rig() -> fg.StereoRig:
    return fg.StereoRig(width=320, height=240, fx=200.0, fy=200.0, cx=159.5, cy=119.5, baseline=0.1)


def wrong_uses() -> dict[str, tuple[type[FgslamError], str, Any]]:
    return {
        "experiment": (ConfigError, "comes with fgslam", lambda _: fg.run("lab_lop")),
        "file": (ConfigError, "no such file", lambda _: fg.run("nowhere/x.yaml")),
        "key": (ConfigError, "unknown key sed", lambda p: fg.run("lab_loop", {"sed": 1}, p)),
        "one text": (ConfigError, "is one value", lambda p: fg.run("lab_loop", "seed=1", p)),
        "array": (ConfigError, "seed is a ndarray", lambda p: fg.run("x", {"seed": np.ones(2)}, p)),
        "folder": (DatasetError, "is empty; give the folder", lambda p: fg.open_recording(p)),
        "no folder": (DatasetError, "no such folder", lambda p: fg.open_recording(p / "x")),
        "session": (ConfigError, "comes with fgslam", lambda _: fg.Slam.from_config("kiti06")),
        "homing": (ConfigError, "homing", lambda _: fg.Slam.from_config("homing_lab")),
        "map": (MapError, "no such file", lambda p: fg.Map.load(p / "no.fgmap")),
        "log": (MeasurementLogError, "no such file", lambda p: fg.MeasurementLog.load(p / "x.npz")),
        "path": (DatasetError, "check the path", lambda p: fg.Trajectory.load(p / "x.tum")),
        "no log": (MeasurementLogError, "slam.log", lambda _: fg.replay(as_any("x.npz"), "ekf")),
        "no names": (ConfigError, "give a dict", lambda _: fg.compare(as_any([1]))),
        "no names to plot": (ConfigError, "give a dict", lambda _: fg.plot(as_any([1]))),
        "truth": (ConfigError, "Trajectory.load", lambda _: fg.compare({}, as_any("truth.tum"))),
        "world": (ConfigError, "known: lab", lambda _: fg.rendered_recording("moon")),
        "no path": (DatasetError, "recording: the name is empty", lambda _: fg.open_recording("")),
        "None": (DatasetError, "experiment: a NoneType", lambda p: fg.run(as_any(None), out=p)),
        "existing": (
            ConfigError,
            "use one of refuse, overwrite, resume",
            lambda p: fg.run("lab_loop", out=p, existing=as_any("replace")),
        ),
        "no workers": (
            ConfigError,
            "jobs is 0; give at least 1",
            lambda p: fg.sweep("lab_trials", {"seed": [1, 2]}, p / "out", jobs=0),
        ),
        "no experiment": (ConfigError, "a sweep of no experiment", lambda p: fg.sweep([], out=p)),
        "name of no kind": (
            ConfigError,
            "estimator = 'ekf2' is not usable: give a group of keys, .*; kinds: odometry, ",
            lambda p: fg.run("lab_loop", {"estimator": "ekf2"}, p),
        ),
        "no flag": (
            ConfigError,
            "extend_map is a ndarray; give True or False",
            lambda _: fg.Slam(_rig(), extend_map=as_any(np.zeros(3))),
        ),
        "no columns": (
            ConfigError,
            "full is 2; give True or False",
            lambda _: fg.compare({}, full=as_any(2)),
        ),
        "one camera": (
            CalibrationError,
            "cameras is a int; give a list",
            lambda p: fg.load_rig(p / "calib.json", cameras=as_any(0)),
        ),
        "no angle": (
            CalibrationError,
            "fov_deg is array.*; a perspective view takes 0 to 170",
            lambda p: fg.load_rig(p / "calib.json", fov_deg=as_any(np.zeros((0, 0)))),
        ),
        "long name": (
            CalibrationError,
            "camera: x+.*: the name is too long",
            lambda _: fg.load_camera("x" * 5000),
        ),
        "begins in a map": (
            ConfigError,
            r"use\s+fgslam\.run",
            lambda _: fg.Slam.from_config("return_to_map"),
        ),
    }


@pytest.mark.parametrize("name", wrong_uses())
def test_wrong_use_is_answered_in_one_line(name: str, tmp_path: Path) -> None:
    error, words, use = wrong_uses()[name]
    with pytest.raises(error, match=words) as caught:
        use(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("left.png", "the images are a str; give a tuple"),
        ({"left": 1, "right": 2, "top": 3}, "the images are a dict; give a tuple"),
        (("a.png", "b.png", "c.png"), "left image is a str; give its pixels as an array"),
        (np.zeros((120, 160, 3), np.uint8), "one image given instead of 3"),
    ],
)
def test_what_are_no_images_is_told_by_what_it_is(folder: Path, given: Any, words: str) -> None:
    slam = fg.Slam(fg.open_recording(folder).rig)
    with pytest.raises(FrameError, match=words):
        slam.track(0.0, given)
    assert slam.numbering == fg.Slam(fg.open_recording(folder).rig).numbering  # nothing was taken


def test_files_of_a_session_with_a_checked_rig_are_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with fg.Slam(_rig()) as slam:
        for k in range(2):
            image = rng.integers(0, 256, (240, 320)).astype(np.uint8)
            slam.track(0.1 * k, (image, image))
        slam.log.save(tmp_path / "log.npz")
        slam.result().map.save(tmp_path / "place.fgmap")
    assert fg.Map.load(tmp_path / "place.fgmap").rig.baseline == 0.1
    assert fg.MeasurementLog.load(tmp_path / "log.npz").rig.baseline == 0.1


def test_a_map_has_identities_and_an_open3d_cloud(
    driven: tuple[fg.Slam, fg.Result], open3d: ModuleType
) -> None:
    made = driven[1].map
    np.testing.assert_array_equal(made.ids, driven[1].estimate.landmarks.ids)
    cloud = made.to_open3d()
    np.testing.assert_array_equal(cloud.point["positions"].numpy(), made.positions)
    np.testing.assert_array_equal(cloud.point["landmark_id"].numpy()[:, 0], made.ids)
    covariances = cloud.point["covariance"].numpy().reshape(-1, 3, 3)
    np.testing.assert_array_equal(covariances, made.covariances)
    assert isinstance(cloud, open3d.t.geometry.PointCloud)


@pytest.mark.parametrize("bits", [8, 16])
def test_landmarks_have_the_colours_of_the_images_that_began_them(
    folder: Path, bits: int, tmp_path: Path
) -> None:
    recording = fg.open_recording(folder)
    plain, coloured = (fg.Slam(recording.rig, "landmark_kalman") for _ in range(2))
    tint = np.array([1.0, 0.5, 0.25])
    for t, images, odometry in list(recording)[:2]:
        assert images is not None
        seen = [np.asarray(i[:, :, None] * tint, np.uint8) for i in images]
        given = seen if bits == 8 else [np.left_shift(i.astype(np.uint16), 8) for i in seen]
        coloured.track(t, given, odometry)
        plain.track(t, images, odometry)
    colours = coloured.result().map.colours.astype(int)
    assert len(colours) > 10
    bright = colours[colours[:, 0] > 60]
    assert np.abs(bright[:, 1] - bright[:, 0] / 2.0).max() <= 1.0
    assert np.abs(bright[:, 2] - bright[:, 0] / 4.0).max() <= 1.0
    grey = plain.result().map
    assert (grey.colours == grey.colours[:, :1]).all()
    grey.save(tmp_path / "grey.fgmap")
    assert (fg.Map.load(tmp_path / "grey.fgmap").colours == grey.colours).all()
    coloured.result().map.save(tmp_path / "map.fgmap")
    read = fg.Map.load(tmp_path / "map.fgmap")
    np.testing.assert_array_equal(read.colours, colours)
    for slam in (plain, coloured):
        slam.close()


def test_a_session_in_a_map_keeps_its_colours(
    folder: Path, driven: tuple[fg.Slam, fg.Result], rng: np.random.Generator
) -> None:
    recording, made = fg.open_recording(folder), driven[1].map
    colours = rng.integers(0, 255, (len(made), 3), np.uint8)
    coloured = dataclasses.replace(made, saved=dataclasses.replace(made.saved, colours=colours))
    with fg.Slam(recording.rig, "landmark_kalman", start_map=coloured) as slam:
        for t, images, odometry in recording:
            slam.track(t, images, odometry)
        found = slam.result().map
    before, after = np.isin(made.ids, found.ids), np.isin(found.ids, made.ids)
    assert before.sum() > 10
    np.testing.assert_array_equal(found.saved.shown[after], colours[before])


def test_images_in_one_array_or_with_one_channel_are_as_good_as_a_tuple(folder: Path) -> None:
    recording = fg.open_recording(folder)
    _, images, _ = next(iter(recording))
    assert images is not None
    rows, columns = np.indices(images[0].shape, np.float32)
    raw = Rectifier(recording.rig, ((columns, rows),) * recording.rig.cameras)
    values = {name: getattr(recording.rig, name) for name in CameraRig.__dataclass_fields__}
    found = []
    for given in (images, np.stack(images), [image[:, :, None] for image in images]):
        with fg.Slam(fg.StereoRig(**values, rectifier=raw), "landmark_kalman") as slam:
            slam.track(0.0, given)
        found.append(slam.result().map)
    assert len(found[0]) > 10
    for other in found[1:]:
        np.testing.assert_array_equal(other.positions, found[0].positions)
        np.testing.assert_array_equal(other.colours, found[0].colours)


def test_a_map_is_saved_in_the_axes_of_ros(
    driven: tuple[fg.Slam, fg.Result], tmp_path: Path
) -> None:
    made = driven[1].map
    made.save(tmp_path / "ros.ply", axes="ros")
    x, y, z = made.positions.T
    np.testing.assert_allclose(
        read_ply(tmp_path / "ros.ply").positions, np.stack([z, -x, -y], axis=1), rtol=0, atol=1e-12
    )
