"""Sub-maps: what is far waits on disk, comes back as it was, and is found again by its looks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rings import IMAGES, ROUND, SETTINGS, drive, error_m, on_ring, pipeline_of, walls
from simulated import RIG, FeatureWorld, assert_same_bits

from fgslam.backend.protocol import INPUTS
from fgslam.backend.settings import (
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    LandmarkKalmanSettings,
)
from fgslam.backend.smoothers import recorded_inputs
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import ConfigError, MapError, OutputError, SessionError
from fgslam.core.estimates import EgoMotionStatus
from fgslam.core.features import CUT_PIXELS, LandmarkPatches
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import Frame
from fgslam.core.saved_map import load_map
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.slam.arrival import saved_map
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.replay import replay
from fgslam.slam.results import RunRecorder
from fgslam.slam.session import Session
from fgslam.slam.submaps.files import file_of, read_submap
from fgslam.slam.submaps.making import make_submaps
from fgslam.slam.submaps.memory import ActiveArea, SubMaps

RADIUS_M = 1.2
FRAMES = ROUND + 18
HALF = 40  # frames: some sub-maps are on disk, and some come back later
MOTION = ConstantVelocityMotion(ConstantVelocitySettings()).description()


def frames(poses: list[FloatArray], start: int = 0) -> Iterator[FeatureFrame]:
    """A sparse wall around the ring; each frame's noise is its own."""
    rng = np.random.default_rng(3)
    world = FeatureWorld(walls(rng)[::4], rng)
    for i, wTc in enumerate(poses[start:], start):
        rng.bit_generator.state = np.random.default_rng(i).bit_generator.state
        yield FeatureFrame(i, Frame(i, float(i), IMAGES), world.features(wTc, 0.1), "", 0.0, 0.0)


ESTIMATORS: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "fixed_lag": FixedLagSettings(lag_frames=5),
}


def with_submaps(
    poses: list[FloatArray], folder: Path, estimator: str = "landmark_kalman"
) -> SlamPipeline:
    """The loop on a ring, with what is far on disk."""
    pipeline = pipeline_of(poses, 0.0, estimator=ESTIMATORS[estimator])
    area = ActiveArea(RADIUS_M, folder, resumable=True)
    pipeline.submaps = make_submaps(area, RIG, SETTINGS, pipeline, seed=0)
    return pipeline


def submaps_of(pipeline: SlamPipeline) -> SubMaps:
    assert pipeline.submaps is not None
    return pipeline.submaps


@dataclass(frozen=True)
class Driven:
    """A round and a quarter, and the state in the middle of it."""

    estimator: str
    poses: list[FloatArray]
    pipeline: SlamPipeline
    reports: list[FrameReport]
    in_memory: list[int]
    recorder: RunRecorder
    half: StateArrays
    folder: Path
    files_at_half: dict[str, bytes]


@pytest.fixture(scope="module", params=ESTIMATORS)
def driven(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    """Of a smoother only so many inputs are in memory that most of them are in files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded_inputs, "BLOCK", 7)
        return drive_round(request.param, tmp_path_factory)


def drive_round(estimator: str, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    folder = tmp_path_factory.mktemp("ring") / "submaps"
    poses = [on_ring(k) for k in range(FRAMES)]
    pipeline = with_submaps(poses, folder, estimator)
    recorder = RunRecorder(MeasurementLog(RIG, MOTION))
    reports, in_memory, half, files = [], [], {}, {}
    for found in frames(poses):
        reports.append(step(pipeline, found))
        recorder.add(reports[-1], 0.0, float("nan"))
        in_memory.append(len(pipeline.tracker.database))
        if found.i == HALF - 1:
            half = states(pipeline)
            files = {path.name: path.read_bytes() for path in folder.iterdir()}
    return Driven(estimator, poses, pipeline, reports, in_memory, recorder, half, folder, files)


def step(pipeline: SlamPipeline, found: FeatureFrame) -> FrameReport:
    """One frame; what is new gets a patch, as if there were images."""
    report = pipeline.process(found, found.i, float(found.i))
    seen = report.increment.observations
    new = seen.ids[seen.is_new]
    pipeline.tracker.database.keep_patches(new, own_patches(new))
    return report


def own_patches(ids: IntArray) -> LandmarkPatches:
    """(n,) that tell landmarks apart."""
    grey = np.tile((ids % 251)[:, None], CUT_PIXELS).astype(np.uint8)
    return LandmarkPatches(grey, 1.0 + ids)


def states(pipeline: SlamPipeline) -> StateArrays:
    parts = {
        "database": pipeline.tracker.database.state(),
        "estimator": pipeline.estimator.state(),  # type: ignore[attr-defined]
        "parts": pipeline.tracker.parts.state(),
        "submaps": submaps_of(pipeline).state(),
    }
    assert pipeline.places is not None
    parts["places"] = pipeline.places.state()
    return {f"{part}/{name}": a for part, arrays in parts.items() for name, a in arrays.items()}


def part(state: StateArrays, name: str) -> StateArrays:
    return {key.removeprefix(f"{name}/"): a for key, a in state.items() if key.startswith(name)}


def test_what_is_far_leaves_memory_and_comes_back_with_the_robot(driven: Driven) -> None:
    submaps = submaps_of(driven.pipeline)
    whole = driven.pipeline.estimate().landmarks
    assert len(whole) == driven.in_memory[-1] + submaps.landmarks
    assert max(driven.in_memory) < 0.75 * len(whole)
    assert submaps.came_near > 5
    again = [report.increment.observations for report in driven.reports[ROUND + 8 :]]
    old = np.mean([np.mean(seen.ids < 150) for seen in again])
    assert old > 0.5  # found again, not begun anew
    errors = [error_m(r, true) for r, true in zip(driven.reports, driven.poses, strict=True)]
    assert max(errors) < 0.02


def test_memory_and_disk_hold_each_landmark_once(driven: Driven) -> None:
    database, estimator = driven.pipeline.tracker.database, driven.pipeline.estimator
    np.testing.assert_array_equal(database.ids, estimator.landmarks().ids)
    ids = driven.pipeline.book.ids
    assert (np.diff(ids) > 0).all()
    assert len(ids) == len(database) + submaps_of(driven.pipeline).landmarks


def test_the_whole_map_is_that_of_one_map_fed_the_same_measurements(driven: Driven) -> None:
    assert not any(any(report.stats.closed) for report in driven.reports)
    solved = SETTINGS.ego_motion
    one = replay(driven.recorder.log, ESTIMATORS[driven.estimator], solved).estimate
    ours = driven.pipeline.estimate()
    np.testing.assert_array_equal(ours.trajectory.poses, one.trajectory.poses)
    np.testing.assert_array_equal(ours.landmarks.ids, one.landmarks.ids)
    np.testing.assert_array_equal(ours.landmarks.positions, one.landmarks.positions)
    np.testing.assert_array_equal(ours.landmarks.covariances, one.landmarks.covariances)


def test_the_whole_map_has_the_looks_that_memory_and_files_have(driven: Driven) -> None:
    pipeline = driven.pipeline
    database, submaps = pipeline.tracker.database, submaps_of(pipeline)
    saved = saved_map(pipeline, RIG, pipeline.estimate(), {})
    assert_same_bits(saved.appearances.of(database.ids), database.appearances())
    number = int(submaps.state()["numbers"][0, 0])
    stored = load_map(file_of(driven.folder, number))
    assert_same_bits(saved.appearances.of(stored.landmarks.ids), stored.appearances)
    kept = np.isin(saved.landmarks.ids, stored.landmarks.ids)
    np.testing.assert_array_equal(saved.hits[kept], stored.hits)
    for one in (saved, stored):
        assert one.patches is not None
        assert_same_bits(one.patches, own_patches(one.landmarks.ids))


def test_a_resumed_drive_ends_with_the_same_bytes(
    driven: Driven, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_inputs, "BLOCK", 7)
    folder = tmp_path / "submaps"
    folder.mkdir()
    for name, content in driven.files_at_half.items():
        (folder / name).write_bytes(content)
    (folder / "000999.fgmap").write_bytes(b"of a later frame")
    pipeline = with_submaps(driven.poses, folder, driven.estimator)
    log = MeasurementLog(RIG, MOTION)
    for increment in driven.recorder.log.increments[:HALF]:
        log.append(increment)
    pipeline.tracker.database.restore(part(driven.half, "database"))
    pipeline.estimator.restore(part(driven.half, "estimator"))  # type: ignore[attr-defined]
    pipeline.tracker.parts.restore(part(driven.half, "parts"))
    assert pipeline.places is not None
    pipeline.places.restore(part(driven.half, "places"), log)
    submaps_of(pipeline).restore(part(driven.half, "submaps"))
    assert not (folder / "000999.fgmap").exists()
    for found in frames(driven.poses, HALF):
        step(pipeline, found)
    ended, meant = states(pipeline), states(driven.pipeline)
    assert ended.keys() == meant.keys()
    for name, array in meant.items():
        np.testing.assert_array_equal(ended[name], array, err_msg=name)
    submaps_of(pipeline).tidy()
    left = {path.name: path.read_bytes() for path in folder.glob("*.fgmap")}
    numbers = submaps_of(pipeline).state()["numbers"][:, 0]
    if driven.estimator == "fixed_lag":  # its inputs are on disk, too
        assert len(list(folder.glob(INPUTS))) > 5
    assert sorted(left) == [f"{n:06d}.fgmap" for n in numbers]
    assert all((driven.folder / name).read_bytes() == content for name, content in left.items())


def test_a_robot_carried_off_is_found_by_looks_in_a_sub_map(tmp_path: Path) -> None:
    away = 48
    poses = [*(on_ring(k) for k in range(away)), *(on_ring(2 + k) for k in range(8))]
    pipeline = with_submaps(poses, tmp_path / "submaps")
    reports = drive(pipeline, frames(poses))
    assert submaps_of(pipeline).recognised > 0
    statuses = [report.tracking.status for report in reports[away:]]
    assert EgoMotionStatus.RELOCALISED in statuses or statuses[-1].measured
    assert error_m(reports[-1], poses[-1]) < 0.02


def test_asking_where_a_frame_is_changes_nothing(driven: Driven) -> None:
    submaps, before = submaps_of(driven.pipeline), states(driven.pipeline)
    numbers = before["submaps/numbers"][:, 0].tolist()
    asked = [on_ring(k + 0.5) for k in range(0, ROUND, 3)]
    stereo, found = driven.pipeline.stereo, {}
    for seen in frames(asked):
        features = stereo.match(None, seen.features)
        found[seen.i] = submaps.recognise(features, lost=True)
    known = {k: position for k, (number, position) in found.items() if number in numbers}
    assert len(known) >= 4, "the others are in memory, or looked past a sparse sub-map"
    for k, position in known.items():
        np.testing.assert_allclose(position, asked[k][:3, 3], rtol=0, atol=0.05)
    for k in found.keys() - known.keys():
        assert found[k][0] == -1
        assert np.isnan(found[k][1]).all()
    after = states(driven.pipeline)
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array, err_msg=name)


def test_a_damaged_or_foreign_or_missing_sub_map_is_one_line(
    driven: Driven, tmp_path: Path
) -> None:
    numbers = submaps_of(driven.pipeline).state()["numbers"]
    (number, landmarks, _), (other, *_) = numbers[0].tolist(), numbers[1].tolist()
    path = file_of(tmp_path, number)
    content = file_of(driven.folder, number).read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(MapError, match=rf"^{path}: .*truncated") as truncated:
        read_submap(path, landmarks)
    path.write_bytes(file_of(driven.folder, other).read_bytes())
    with pytest.raises(MapError, match=rf"^{path}: not the sub-map") as foreign:
        read_submap(path, landmarks)
    path.unlink()
    with pytest.raises(MapError, match=rf"^{path}: no such file") as missing:
        read_submap(path, landmarks)
    assert all("\n" not in str(found.value) for found in (truncated, foreign, missing))
    pipeline = with_submaps(driven.poses, tmp_path, driven.estimator)
    pipeline.estimator.restore(pipeline.estimator.state())  # type: ignore[attr-defined]
    with pytest.raises(OutputError, match=rf"^{tmp_path}/\d+\.fgmap: .*missing; restore"):
        submaps_of(pipeline).restore(part(driven.half, "submaps"))


def test_wrong_use_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match="estimator ekf keeps every landmark in memory; use"):
        Session(RIG, EkfSettings()).keep_near(20.0)
    with pytest.raises(ConfigError, match="give a positive number of metres"):
        Session(RIG, "landmark_kalman").keep_near(float("nan"))
    session = Session(RIG, "landmark_kalman")
    session.track(0.0, None)
    with pytest.raises(SessionError, match="before the first frame"):
        session.keep_near(20.0)
