"""The same recording through the library, frame by frame, through `run` and the command line."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from fgslam.errors import (
    ConfigError,
    FrameError,
    MapError,
    MeasurementLogError,
    OutputError,
    SessionError,
)
from fgslam.runs.session import slam_config

QUIET = {"output.pictures": False, "output.report": False, "output.checkpoint_seconds": 3600}
FILES = {"trajectory": "final.tum", "map": "map.ply"}


def pushed(experiment: str, overrides: dict[str, object], out: Path) -> Path:
    """Files of a session that was pushed frame by frame."""
    slam = fg.Slam.from_config(experiment, overrides)
    recording = fg.open_recording(experiment, overrides)
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
    slam.close()
    result = slam.result()
    out.mkdir()
    result.trajectory.of(recording.sequence.truth_frame, recording.rig).save(out / "final.tum")
    result.map.save(out / "map.ply")
    result.map.save(out / "map.fgmap")
    slam.log.save(out / "measurements.npz")
    return out


def by_command(experiment: str, overrides: dict[str, object], out: Path) -> Path:
    sets = [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    command = [sys.executable, "-m", "fgslam", "run", experiment, "--out", str(out), *sets]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    return out


def assert_same_files(live: Path, runs: list[Path], estimator: str) -> None:
    for run in runs:
        for name in FILES.values():
            assert (live / name).read_bytes() == (run / estimator / name).read_bytes(), (run, name)
        log = "measurements.npz"
        assert (live / log).read_bytes() == (run / log).read_bytes(), run


@pytest.mark.slow
def test_rendered_frames_give_the_same_bytes_on_every_way_in(tmp_path: Path) -> None:
    overrides = QUIET | {"dataset.stop": 8, "estimator.kind": "isam2", "compare": []}
    live = pushed("lab_loop", overrides, tmp_path / "live")
    run = fg.run("lab_loop", overrides, tmp_path / "run")
    assert run.status == "finished"
    assert run.metrics["frames"] == 8
    command = by_command("lab_loop", overrides, tmp_path / "command")
    assert_same_files(live, [run.folder, command], "isam2")


@pytest.mark.parametrize("extend", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_session_in_a_saved_map_gives_the_bytes_of_the_configured_run(
    tmp_path: Path, extend: bool
) -> None:
    lab = QUIET | {"compare": [], "estimator.kind": "landmark_kalman"}
    first = pushed("lab_loop", lab | {"dataset.stop": 9}, tmp_path / "first")
    place = tmp_path / "first" / "map.fgmap"
    assert (first / "map.ply").is_file()
    later = lab | {"dataset.start": 3, "dataset.stop": 8, "map.load": place, "map.extend": extend}
    live = pushed("lab_loop", later, tmp_path / "live")
    run = fg.run("lab_loop", later, tmp_path / "run")
    assert_same_files(live, [run.folder], "landmark_kalman")

    config = lab | {"dataset.start": 3, "dataset.stop": 8}
    recording = fg.open_recording("lab_loop", config)
    settings = slam_config("lab_loop", config)
    slam = fg.Slam(
        recording.rig,
        "landmark_kalman",
        frontend=settings.frontend,
        odometry=settings.odometry,
        seed=settings.seed,
        start_map=fg.Map.load(place),
        extend_map=extend,
    )
    for t, images, odometry in recording:
        assert slam.track(t, images, odometry).status.measured
    slam.result().trajectory.save(tmp_path / "given.tum")
    assert (tmp_path / "given.tum").read_bytes() == (live / "final.tum").read_bytes()


def test_frames_that_cannot_be_located_have_no_pose_and_are_left_out(tmp_path: Path) -> None:
    recording = fg.rendered_recording("lab", frames=8)
    with fg.Slam(recording.rig, "landmark_kalman") as slam:
        for t, images, odometry in recording:
            slam.track(t, images, odometry)
    place = slam.result().map
    hits, positions = place.saved.hits.copy(), place.positions.copy()
    back = fg.Slam(recording.rig, "landmark_kalman", start_map=place)
    blank = tuple(np.full_like(image, 128) for image in recording[0][1])
    for k, images in enumerate((blank, None)):
        step = back.track(0.1 * k, images)
        assert (step.status.value, step.index, step.landmarks) == ("not_located", -1, len(place))
        assert np.isnan(step.wTc).all()
        assert np.isnan(step.covariance).all()
    with pytest.raises(SessionError, match="none of 2 frames could be located in the map: no im"):
        back.result()
    with pytest.raises(FrameError, match="does not come after"):
        back.track(0.1, recording[3][1])
    found = [back.track(0.2 + 0.1 * k, *recording[3 + k][1:]) for k in range(3)]
    assert [step.index for step in found] == [0, 1, 2]
    assert found[0].status.value == "relocalised"
    np.testing.assert_allclose(
        found[2].wTc[:3, 3], slam.result().trajectory.poses[5, :3, 3], rtol=0.0, atol=0.05
    )
    result = back.result()
    assert len(result.trajectory) == 3
    assert "the first 2 frames could not be located: left out" in result.remarks
    assert [increment.index for increment in back.log] == [2, 3, 4]
    assert [drive["name"] for drive in result.map.saved.about["drives"]] == ["session"] * 2
    np.testing.assert_array_equal(place.saved.hits, hits)
    np.testing.assert_array_equal(place.positions, positions)
    # Frames 3, 4 and 5 of the recording are in both: they are the same evidence.
    assert len(place.saved.evidence) == 8
    np.testing.assert_array_equal(result.map.saved.evidence, place.saved.evidence)
    with pytest.raises(MeasurementLogError, match="begins in a saved map, which it does not hold"):
        fg.replay(back.log, "ekf")


def test_a_map_of_other_cameras_or_an_own_estimator_is_refused_before_the_first_frame() -> None:
    recording = fg.rendered_recording("lab", frames=2)
    with fg.Slam(recording.rig, "landmark_kalman") as slam:
        slam.track(*recording[0])
    place = slam.result().map
    with pytest.raises(MapError, match="another rig"):
        fg.Slam(dataclasses.replace(recording.rig, baseline=0.2), start_map=place)
    with pytest.raises(ConfigError, match="cannot begin in a saved map"):
        fg.Slam(recording.rig, "fixed_lag", start_map=place)
    with pytest.raises(ConfigError, match="cannot leave a map as it is"):
        fg.Slam(recording.rig, "isam2", start_map=place, extend_map=False)
    with pytest.raises(ConfigError, match="give a kind or its settings"):
        fg.Slam(recording.rig, slam.pipeline.estimator, start_map=place)
    with pytest.raises(MapError, match=r"start_map is a str; give fgslam\.Map\.load"):
        fg.Slam(recording.rig, start_map="place.fgmap")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="without a start_map"):
        fg.Slam(recording.rig, extend_map=False)
    with pytest.raises(ConfigError, match=r"frontend: nonsense"):
        place.locate(recording.rig, recording[0][1], {"nonsense": 1})
    with pytest.raises(ConfigError, match="or Slam"):
        fg.Slam.from_config("return_to_map", rig=recording.rig)


@pytest.mark.data
def test_recorded_frames_give_the_same_bytes_on_every_way_in(
    shared_data: Path, tmp_path: Path
) -> None:
    """Constant velocity, no odometry; frames from the middle, every second one."""
    overrides = QUIET | {
        "dataset.path": shared_data / "kitti06",
        "dataset.start": 4,
        "dataset.stop": 12,
        "dataset.stride": 2,
        "estimator.kind": "landmark_kalman",
        "compare": [],
    }
    live = pushed("kitti06", overrides, tmp_path / "live")
    run = fg.run("kitti06", overrides, tmp_path / "run")
    command = by_command("kitti06", overrides, tmp_path / "command")
    assert_same_files(live, [run.folder, command], "landmark_kalman")


def test_a_run_is_not_overwritten_unasked(tmp_path: Path) -> None:
    overrides = QUIET | {"dataset.stop": 2, "compare": []}
    fg.run("lab_loop", overrides, tmp_path / "run")
    with pytest.raises(OutputError, match="holds a run already"):
        fg.run("lab_loop", overrides, tmp_path / "run")
    again = fg.run("lab_loop", overrides, tmp_path / "run", existing="overwrite")
    assert again.metrics["frames"] == 2
