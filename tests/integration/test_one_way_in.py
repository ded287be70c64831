"""The same recording through the library, frame by frame, through `run` and the command line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import fgslam as fg
from fgslam.errors import OutputError

QUIET = {"output.pictures": False, "output.report": False, "output.checkpoint_seconds": 3600}
FILES = {"trajectory": "final.tum", "map": "map.ply"}


def pushed(experiment: str, overrides: dict[str, object], out: Path) -> Path:
    """Files of a session that was pushed frame by frame."""
    slam = fg.Slam.from_config(experiment, overrides)
    for t, images, odometry in fg.open_recording(experiment, overrides):
        slam.track(t, images, odometry)
    slam.close()
    result = slam.result()
    out.mkdir()
    result.trajectory.save(out / "final.tum")
    result.map.save(out / "map.ply")
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


def test_rendered_frames_give_the_same_bytes_on_every_way_in(tmp_path: Path) -> None:
    overrides = QUIET | {"dataset.stop": 8, "estimator.kind": "isam2", "compare": []}
    live = pushed("lab_loop", overrides, tmp_path / "live")
    run = fg.run("lab_loop", tmp_path / "run", overrides)
    assert run.status == "finished"
    assert run.metrics["frames"] == 8
    command = by_command("lab_loop", overrides, tmp_path / "command")
    assert_same_files(live, [run.folder, command], "isam2")


@pytest.mark.data
def test_recorded_frames_give_the_same_bytes_on_every_way_in(
    shared_data: Path, tmp_path: Path
) -> None:
    """Constant velocity, no odometry; frames from the middle, every second one."""
    overrides = QUIET | {
        "dataset.path": shared_data / "kitti06",
        "dataset.start": 4,
        "dataset.stop": 20,
        "dataset.stride": 2,
        "estimator.kind": "landmark_kalman",
        "compare": [],
    }
    live = pushed("kitti06", overrides, tmp_path / "live")
    run = fg.run("kitti06", tmp_path / "run", overrides)
    command = by_command("kitti06", overrides, tmp_path / "command")
    assert_same_files(live, [run.folder, command], "landmark_kalman")


def test_a_run_is_not_overwritten_unasked(tmp_path: Path) -> None:
    overrides = QUIET | {"dataset.stop": 2, "compare": []}
    fg.run("lab_loop", tmp_path / "run", overrides)
    with pytest.raises(OutputError, match="holds a run already"):
        fg.run("lab_loop", tmp_path / "run", overrides)
    again = fg.run("lab_loop", tmp_path / "run", overrides, existing="overwrite")
    assert again.metrics["frames"] == 2
