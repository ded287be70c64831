"""Bad input: either one clear line and status 2, or the run goes on and says what it tolerated."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import HEIGHT, WIDTH, experiment
from running import (
    KIND,
    Finished,
    assert_valid_results,
    bytes_of,
    main,
    metrics_of,
    run_values,
    stop_after,
    write_config,
)

from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.log import ImageSequence
from fgslam.core.types import StereoFeatures, Trajectory

Refusal = Callable[..., str]


@pytest.fixture
def refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Refusal:
    """Runs values that must be refused: status 2, one line on stderr, which is returned."""

    def refused(values: dict[str, Any], *options: object, out: Path | None = None) -> str:
        config = write_config(tmp_path / "refused.yaml", values)
        folder = out or tmp_path / "run"
        status = main(monkeypatch, "run", config, "--out", folder, *options)
        said = capfd.readouterr()
        assert status == 2
        assert said.out == ""
        lines = said.err.splitlines()
        assert len(lines) == 1, lines
        assert lines[0].startswith("fgslam: ")
        if out is None:
            assert not folder.exists(), "a refused run must leave nothing behind"
        return lines[0]

    return refused


def test_frozen_cameras_are_said_in_console_status_and_report(
    own_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for camera in ("right", "left", "top"):
        freeze(own_recording / camera)
    output = {"pictures": False, "report": True, "checkpoint_seconds": 0.0}
    config = write_config(tmp_path / "frozen.yaml", experiment(own_recording, output=output))
    status = main(monkeypatch, "run", config, "--out", tmp_path / "run")
    said = " ".join(capsys.readouterr().out.split())
    assert status == 3  # hardly anything was located
    assert "No success: 5 of 12 frames (42 %) were located in the map" in said
    assert metrics_of(tmp_path / "run")["located"] == {"frames": 5, "of": 12}
    words = "image of the frame before once more: 7 of 12 frames, from 5 to 11, are not used"
    assert words in said
    assert metrics_of(tmp_path / "run")["status_counts"]["camera_fault"] == 7
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert words in page
    assert '<p class="alarm">No success: 5 of 12 frames' in page
    assert f"{KIND} (7 poses predicted)" in page
    assert "x: a pose that no landmark measured" in page  # beside the drive from above
    found = metrics_of(tmp_path / "run")["estimators"][KIND]
    assert (found["predicted_frames"], found["predicted_rows"]) == (7, list(range(5, 12)))


def freeze(folder: Path) -> None:
    images = sorted(folder.glob("*.png"))
    for image in images[5:]:
        shutil.copyfile(images[4], image)


@pytest.mark.parametrize(("frozen", "alone"), [("left", "right"), ("right", "left")])
def test_frames_of_a_frozen_camera_are_located_by_another(
    frozen: str, alone: str, own_recording: Path, tmp_path: Path
) -> None:
    freeze(own_recording / frozen)
    run = run_values(experiment(own_recording), tmp_path / "run")
    words = (
        f"the {frozen} camera delivers the image of the frame before once more (the {alone} image"
    )
    assert any(note.startswith(words) for note in run.result.notes)
    metrics = metrics_of(tmp_path / "run")
    assert metrics["status_counts"]["one_image"] == 7
    assert metrics["estimators"][KIND]["ate_rmse_m"] < 0.01


def replace_line(path: Path, number: int, line: str) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[number - 1] = line
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


# --------------------------------------------------------------------------------------------
# Frames that cannot be used: the run goes on, odometry bridges


def remove_image(path: Path) -> str:
    path.unlink()
    return "cannot be read"


def truncate_image(path: Path) -> str:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return "truncated"


def damage_image(path: Path) -> str:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    return "is damaged"


def empty_image(path: Path) -> str:
    path.write_bytes(b"")
    return "is empty"


def resize_image(path: Path) -> str:
    assert cv2.imwrite(str(path), np.full((HEIGHT // 2, WIDTH // 2), 90, np.uint8))
    return f"is {WIDTH // 2}x{HEIGHT // 2} but the calibration states {WIDTH}x{HEIGHT}"


SPOILING = (remove_image, truncate_image, damage_image, empty_image, resize_image)


@pytest.mark.parametrize(
    ("spoil", "odometry"),
    [
        *((spoil, "recorded") for spoil in SPOILING),
        (remove_image, "constant_velocity"),
    ],
)
def test_a_frame_with_an_unusable_image_is_located_by_another(
    spoil: Callable[[Path], str],
    odometry: str,
    own_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    image = own_recording / "left" / "000006.png"
    why = spoil(image)
    config = write_config(
        tmp_path / "c.yaml", experiment(own_recording, odometry={"kind": odometry})
    )
    folder = tmp_path / "run"
    assert main(monkeypatch, "run", config, "--out", folder) == 0
    out = capfd.readouterr().out
    assert_valid_results(folder, 12)
    metrics = metrics_of(folder)
    assert metrics["status_counts"]["one_image"] == 1
    assert metrics["frames_without_image"] == 0
    (problem,) = metrics["frame_problems"]
    assert problem.startswith(f"frame 6: image {image} ")
    assert why in problem
    assert problem.endswith("the right image alone is used")
    assert "one_image 1" in out
    assert f"note        {problem}" in out
    assert metrics["estimators"][KIND]["ate_rmse_m"] < 0.01


def test_an_absent_image_is_noted_when_opening(own_recording: Path, tmp_path: Path) -> None:
    (own_recording / "top" / "000004.png").unlink()
    run = run_values(experiment(own_recording), tmp_path / "run")
    assert metrics_of(run.folder)["notes"] == ["1 of 12 frames lack an image: 4 (top)"]


def test_black_frames_are_bridged(own_recording: Path, tmp_path: Path) -> None:
    for camera in ("right", "left", "top"):
        blank = np.zeros((HEIGHT, WIDTH), np.uint8)
        assert cv2.imwrite(str(own_recording / camera / "000005.png"), blank)
    run = run_values(experiment(own_recording), tmp_path / "run")
    status = run.result.outputs.recorder.column("status").tolist()
    assert status[5] == "too_few_matches"
    assert status[6:] == ["ok"] * 6
    assert run.result.live.ate_rmse_m is not None
    assert run.result.live.ate_rmse_m < 0.01


def test_nothing_but_black_frames_leaves_the_odometry(own_recording: Path, tmp_path: Path) -> None:
    for path in own_recording.glob("*/*.png"):
        assert cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    run = run_values(experiment(own_recording), tmp_path / "run")
    assert run.result.live.landmarks == 0
    assert run.result.alarms[0] == "No success: there is no map, not one landmark was kept."
    truth = Trajectory.load(run.folder / "ground_truth.tum")
    final = Trajectory.load(run.folder / KIND / "final.tum")
    assert np.abs(final.poses[-1] - truth.poses[-1]).max() < 0.05


def test_the_first_frame_may_be_the_bad_one(own_recording: Path, tmp_path: Path) -> None:
    (own_recording / "right" / "000000.png").write_bytes(b"no image")
    run = run_values(experiment(own_recording), tmp_path / "run")
    status = run.result.outputs.recorder.column("status").tolist()
    assert status[0] == "no_image"
    assert status[2:] == ["ok"] * 10
    assert_valid_results(run.folder, 12)


def test_the_world_begins_where_something_is_seen(own_recording: Path, tmp_path: Path) -> None:
    for k in range(3):
        for path in own_recording.glob(f"*/{k:06d}.png"):
            assert cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    dataset = {"kind": "image_folder", "path": str(own_recording), "stop": 6}
    odometry = {"kind": "constant_velocity"}
    values = experiment(own_recording, dataset=dataset, odometry=odometry)
    straight = run_values(values, tmp_path / "straight")
    final = Trajectory.load(straight.folder / KIND / "final.tum")
    np.testing.assert_array_equal(final.poses[0], np.eye(4))
    metrics = metrics_of(straight.folder)
    assert metrics["located"] == {"frames": 3, "of": 6}
    assert metrics["frames_in_recording"] == 6
    assert "the first 3 frames could not be located: left out" in metrics["notes"]
    assert metrics["estimators"][KIND]["ate_rmse_m"] < 0.01
    assert [increment.index for increment in straight.result.outputs.recorder.log] == [3, 4, 5]


def test_a_bad_frame_keeps_its_own_number(own_recording: Path, tmp_path: Path) -> None:
    (own_recording / "right" / "000007.png").unlink()
    dataset = {"kind": "image_folder", "path": str(own_recording), "start": 3, "stride": 2}
    run = run_values(experiment(own_recording, dataset=dataset), tmp_path / "run")
    log = run.result.outputs.recorder.log
    assert [increment.index for increment in log] == [3, 5, 7, 9, 11]
    assert metrics_of(run.folder)["frame_problems"][0].startswith("frame 7: ")


def test_resumed_over_bad_frames(own_recording: Path, tmp_path: Path) -> None:
    (own_recording / "right" / "000004.png").unlink()
    truncate_image(own_recording / "top" / "000008.png")
    values = experiment(own_recording)
    straight = run_values(values, tmp_path / "straight")
    run_values(values, tmp_path / "run", stopped=stop_after(6))
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(straight.folder)
    problems = metrics_of(tmp_path / "run")["frame_problems"]
    assert problems == metrics_of(straight.folder)["frame_problems"]
    assert len(problems) == 2


def test_a_depth_image_that_cannot_be_read_ends_the_run_which_goes_on_later(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = finished.values

    def unreadable(sequence: ImageSequence, i: int, stereo: StereoFeatures) -> float:
        if i == 6:
            raise DatasetError("depth/000006.png: cannot be read")
        return float("nan")

    with monkeypatch.context() as patch:
        patch.setattr("fgslam.runs.tasks.slam.stereo_precision", unreadable)
        with pytest.raises(DatasetError, match="cannot be read"):
            run_values(values, tmp_path / "run")
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(finished.folder)


# --------------------------------------------------------------------------------------------
# Recordings that are refused


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("101.0 nan 0 0 0 0 0 1", "finite"),
        ("101.0 0 0 0 0 0 0 0", "quaternion"),
        ("101.0 0 0 0 0 0 1", ""),
    ],
)
def test_bad_odometry(row: str, expected: str, own_recording: Path, refusal: Refusal) -> None:
    replace_line(own_recording / "odometry.txt", 5, row)
    line = refusal(experiment(own_recording))
    assert f"{own_recording / 'odometry.txt'}, line 5" in line
    assert expected in line


def test_no_odometry_and_no_truth(own_recording: Path, refusal: Refusal) -> None:
    (own_recording / "odometry.txt").unlink()
    assert "set odometry.kind to constant_velocity" in refusal(experiment(own_recording))
    (own_recording / "gt_right_cam.txt").unlink()
    line = refusal(experiment(own_recording, odometry={"kind": "synthetic"}))
    assert "has no ground truth" in line


def test_no_such_folder(tmp_path: Path, refusal: Refusal) -> None:
    line = refusal(experiment(tmp_path / "absent"))
    assert f"{tmp_path / 'absent'} does not exist; say where it is: --set dataset.path=" in line


EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize(
    "name",
    [
        "euroc_v101",
        "kitti_raw_0926",
        "kitti06",
        "chess_trinocular",
        "starry_night",
    ],
)
def test_experiments_say_clearly_that_their_data_is_absent(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    absent = tmp_path / "absent"
    config = EXPERIMENTS / f"{name}.yaml"
    status = main(
        monkeypatch, "run", config, "--set", f"dataset.path={absent}", "--out", tmp_path / "run"
    )
    (line,) = capfd.readouterr().err.splitlines()
    assert status == 2
    assert str(absent) in line
    assert "does not exist; say where it is: --set dataset.path=" in line


def test_ranges_that_leave_nothing(recording: Path, refusal: Refusal) -> None:
    assert "choose less" in refusal(experiment(recording), "--set", "dataset.start=12")
    line = refusal(experiment(recording), "--set", "dataset.start=5", "--set", "dataset.stop=5")
    assert "choose a larger stop" in line


def test_an_unknown_key(recording: Path, refusal: Refusal) -> None:
    line = refusal(experiment(recording), "--set", "frontend.sift.max_feature=3")
    assert "unknown key frontend.sift.max_feature; did you mean frontend.sift.max_features?" in line


# --------------------------------------------------------------------------------------------
# Output


def test_a_run_folder_that_exists(recording: Path, tmp_path: Path, refusal: Refusal) -> None:
    folder = tmp_path / "earlier"
    values = experiment(recording)
    run_values(values, folder, stopped=stop_after(2))
    before = bytes_of(folder)
    line = refusal(values, out=folder)
    assert f"{folder} holds a run already" in line
    assert "--overwrite or --resume" in line
    assert bytes_of(folder) == before


def test_overwriting_replaces_the_run_and_nothing_else(recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "earlier"
    run_values(experiment(recording), folder)
    (folder / "my notes.txt").write_text("keep", encoding="utf-8")
    values = experiment(recording, seed=3)
    run_values(values, folder, "overwrite", stop_after(4))
    assert_valid_results(folder, 4)
    assert (folder / "my notes.txt").read_text(encoding="utf-8") == "keep"


def test_a_folder_of_something_else(recording: Path, tmp_path: Path, refusal: Refusal) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.txt").write_text("mine", encoding="utf-8")
    for options in ((), ("--overwrite",)):
        line = refusal(experiment(recording), *options, out=folder)
        assert f"{folder} exists and holds something else than a run" in line
    assert [path.name for path in folder.iterdir()] == ["a.txt"]


def test_a_folder_that_cannot_be_made(recording: Path, tmp_path: Path, refusal: Refusal) -> None:
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    assert "it is not a folder" in refusal(experiment(recording), out=file)
    line = refusal(experiment(recording), out=file / "run")
    assert "part of the path is a file, not a folder" in line
    line = refusal(experiment(recording), out=Path("/proc/fgslam/run"))
    assert "cannot write /proc/fgslam/run" in line


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB; skips where this user may not mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"cannot mount a small file system here: {error}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)  # noqa: S603, S607


def test_a_disk_that_fills_up(recording: Path, finished: Finished, small_disk: Path) -> None:
    """One clear error; what was written before stays whole, and goes on once there is room."""
    output = {"pictures": False, "report": False, "checkpoint_seconds": 0.0}
    values = experiment(recording, output=output)
    folder = small_disk / "run"
    with pytest.raises(OutputError, match="the disk is full; free some space") as caught:
        run_values(values, folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(folder.rglob("*partial*"))
    done = len(Trajectory.load(folder / KIND / "final.tum"))
    assert 0 < done < 12
    moved = Path(shutil.copytree(folder, small_disk.parent / "moved"))
    run_values(values, moved, "resume")
    assert bytes_of(moved) == bytes_of(finished.folder)


def test_a_read_only_disk(recording: Path, small_disk: Path, refusal: Refusal) -> None:
    remount = ["mount", "-o", "remount,ro", str(small_disk)]
    subprocess.run(remount, check=True)  # noqa: S603
    line = refusal(experiment(recording), out=small_disk / "run")
    assert f"cannot write {small_disk / 'run'}: the file system is read-only" in line
