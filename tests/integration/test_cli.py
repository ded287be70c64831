"""The command line as a user meets it: help, exit statuses, one line for each mistake, exports."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from evo.tools import file_interface
from recordings import experiment
from running import (
    HANGS_AFTER_S,
    KIND,
    Capture,
    Finished,
    Patch,
    assert_valid_results,
    call,
    command,
    main,
    mistake,
    run_values,
    stop_after,
    write_config,
)

import fgslam
from fgslam.core.geometry import transform_to_camera
from fgslam.core.log import MeasurementLog
from fgslam.core.types import Trajectory
from fgslam.report.formats import read_ply
from fgslam.runs.config import Experiment
from fgslam.runs.engine import RunResult

# --------------------------------------------------------------------------------------------
# Help and usage


@pytest.mark.parametrize("program", [[sys.executable, "-m", "fgslam"], command()])
def test_version_is_printed_by_program_and_module(program: list[str]) -> None:
    said = subprocess.run([*program, "--version"], capture_output=True, text=True, check=True)  # noqa: S603
    assert said.stdout == f"fgslam {fgslam.__version__}\n"


def test_shells_complete_commands_and_names_of_experiments() -> None:
    for words, expected in (("fgslam ins", "inspect"), ("fgslam run kitti0", "kitti06")):
        given = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        completed = subprocess.run(  # noqa: S603
            command(),
            env=os.environ | given | {"_FGSLAM_COMPLETE": "complete_bash"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert expected in completed.stdout.split()


def test_demo_is_the_loop_of_the_paper(monkeypatch: Patch, tmp_path: Path) -> None:
    ran: list[tuple[str, Path, str]] = []

    def noted(config: Experiment, folder: Path, existing: str, *rest: object) -> RunResult:
        ran.append((config.name, folder, existing))
        return RunResult(config, folder, "finished")

    monkeypatch.setattr("fgslam.runs.run.run_experiment", noted)
    assert main(monkeypatch, "demo", "--out", tmp_path / "demo") == 0
    assert ran == [("lab_loop", tmp_path / "demo", "overwrite")]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("run",), "fgslam run: Missing argument 'RECORDING|EXPERIMENT'; see fgslam run --help"),
        (("run", "c.yaml", "--outt", "x"), "No such option: --outt (Possible options: --out)"),
        (("run", "c.yaml", "--foo"), "fgslam run: No such option: --foo; see fgslam run --help"),
        (("compare", "nothere"), "nothere: no such folder; give a run folder"),
        (("run", "nothing"), "e.g. lab_loop (fgslam run --help lists them)"),
        (("rum",), "fgslam: No such command 'rum'"),
        (("--version-please",), "fgslam: No such option: --version-please"),
        (("inspect", "x", "--frames", "many"), "fgslam inspect: Invalid value for '--frames'"),
        (("run", "lab_loop", "--resume", "--overwrite"), "exclude each other; give one of them"),
        (("run", "absent.yaml"), "absent.yaml: no such file"),
        (
            ("run", "lab_lop"),
            "lab_lop: no such file or folder; the experiment lab_loop comes with fgslam",
        ),
    ],
)
def test_mistyped_commands(
    arguments: tuple[str, ...], expected: str, monkeypatch: Patch, capfd: Capture
) -> None:
    assert expected in mistake(capfd, monkeypatch, *arguments)


# --------------------------------------------------------------------------------------------
# run


def test_run_as_a_process(recording: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    """Statuses, streams and the lines that name the results."""
    config = write_config(tmp_path / "c.yaml", experiment(recording))
    folder = tmp_path / "run"
    status, out, error = call("run", config, "--out", folder, "--set", "dataset.stop=8")
    assert status == 0, error
    assert_valid_results(folder, 8)
    for name in (f"{KIND}/final.tum", f"{KIND}/map.ply", "metrics.json"):
        assert str(folder / name) in out
    assert "8 of 8" in out
    assert "tracking" in error
    status, out, error = call("run", config, "--out", folder)
    assert (status, out) == (2, "")
    assert error.count("\n") == 1
    assert "add --overwrite or --resume" in error
    few = ("--set", "dataset.stop=3")
    assert main(monkeypatch, "run", config, "--out", folder, "--overwrite", *few) == 0
    assert_valid_results(folder, 3)


def test_the_default_folder_is_named_by_the_experiment(
    recording: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = write_config(tmp_path / "c.yaml", experiment(recording))
    assert main(monkeypatch, "run", config, "--set", "dataset.stop=2") == 0
    assert_valid_results(tmp_path / "runs" / "boards", 2)


def test_synthetic_odometry_is_marked_everywhere(
    recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    config = write_config(tmp_path / "c.yaml", experiment(recording))
    folder = tmp_path / "run"
    options = ("--set", "odometry.kind=synthetic", "--out", folder)
    assert main(monkeypatch, "run", config, *options) == 0
    assert "SYNTHETIC" in capfd.readouterr().out
    for name in ("metrics.json", f"{KIND}/final.tum", f"{KIND}/covariance.csv", f"{KIND}/map.ply"):
        assert b"SYNTHETIC" in (folder / name).read_bytes(), name
    for suffix in (".ply", ".pcd", ".tum", ".kitti"):
        file = tmp_path / f"exported{suffix}"
        option = "--trajectory" if suffix in (".tum", ".kitti") else "--map"
        assert main(monkeypatch, "export", folder, option, file) == 0
        assert "SYNTHETIC" in capfd.readouterr().out
        # KITTI's format has no comments; the line printed has to do there.
        assert (b"SYNTHETIC" in file.read_bytes()) is (suffix != ".kitti"), suffix


def test_a_closed_pipe_is_no_fault() -> None:
    """``fgslam --help | head -1`` ends quietly."""
    process = subprocess.Popen(  # noqa: S603
        command("--help"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=dict(os.environ)
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    error = process.stderr.read()
    process.stderr.close()
    process.wait(timeout=HANGS_AFTER_S)
    assert b"Traceback" not in error


def test_closed_standard_streams_are_no_fault() -> None:
    """As a daemon or a job of cron may be started."""
    line = shlex.join(command("--version")) + " <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", line], check=False).returncode == 0  # noqa: S603, S607


def test_a_current_folder_that_has_been_deleted_is_told(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    line = f"cd {tmp_path}/gone && rmdir {tmp_path}/gone && " + shlex.join(command("--version"))
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)  # noqa: S603, S607
    assert done.returncode == 2
    assert done.stderr.startswith("fgslam: the current folder has been deleted")
    assert done.stderr.count("\n") == 1


def test_the_resolved_configuration_repeats_the_run(
    finished: Finished, tmp_path: Path, monkeypatch: Patch
) -> None:
    resolved = finished.folder / "config.yaml"
    assert main(monkeypatch, "run", resolved, "--out", tmp_path / "again") == 0
    for name in (f"{KIND}/final.tum", "measurements.npz"):
        assert (tmp_path / "again" / name).read_bytes() == (finished.folder / name).read_bytes()


# --------------------------------------------------------------------------------------------
# export


@pytest.mark.parametrize("suffix", ["ply", "pcd", "PLY"])
def test_export_of_the_map(
    suffix: str, finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    file = tmp_path / f"map.{suffix}"
    count = len(read_ply(finished.folder / KIND / "map.ply"))
    assert main(monkeypatch, "export", finished.folder, "--map", file) == 0
    assert capfd.readouterr().out == f"{file}: {count} landmarks\n"
    head = file.read_bytes()[:600]
    expected = {
        "ply": f"element vertex {count}\n",
        "pcd": f"POINTS {count}\n",
    }
    assert expected[suffix.lower()].encode() in head


def test_export_of_valid_landmarks_only(
    finished: Finished, tmp_path: Path, monkeypatch: Patch
) -> None:
    points = read_ply(finished.folder / KIND / "map.ply")
    file = tmp_path / "map.ply"
    assert main(monkeypatch, "export", finished.folder, "--map", file, "--valid-only") == 0
    kept = read_ply(file)
    assert 0 < len(kept) == int(points.valid.sum()) < len(points)
    assert kept.valid.all()
    assert (kept.hits >= 3).all()


def test_export_of_the_trajectory(finished: Finished, tmp_path: Path, monkeypatch: Patch) -> None:
    tum, kitti, euroc = (tmp_path / f"t.{suffix}" for suffix in ("tum", "kitti", "csv"))
    assert main(monkeypatch, "export", finished.folder, "--trajectory", tum) == 0
    assert main(monkeypatch, "export", finished.folder, "--trajectory", euroc) == 0
    assert main(monkeypatch, "export", finished.folder, "--trajectory", tmp_path / "t.mcap") == 0
    assert main(monkeypatch, "export", finished.folder, "--trajectory", kitti) == 0
    truth = Trajectory.load(finished.folder / KIND / "final.tum")
    np.testing.assert_allclose(Trajectory.load(tum).poses, truth.poses, atol=1e-11)
    np.testing.assert_allclose(np.loadtxt(kitti).reshape(-1, 3, 4), truth.poses[:, :3], atol=1e-11)
    read = file_interface.read_euroc_csv_trajectory(euroc)  # evo's own
    np.testing.assert_allclose(read.timestamps, truth.timestamps, rtol=0, atol=1e-9)
    np.testing.assert_allclose(read.poses_se3, truth.poses, rtol=0, atol=1e-11)


def test_exports_of_a_frame_and_of_axes_overlay(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """A landmark of the map is seen from the exported left camera where it was measured."""
    tum, ply = tmp_path / "t.tum", tmp_path / "m.ply"
    given = ("--trajectory", tum, "--map", ply, "--frame", "left", "--axes", "ros")
    assert main(monkeypatch, "export", finished.folder, *given) == 0
    assert "12 poses, wTl: pose of the left camera\n" in capfd.readouterr().out
    assert "# wTl: pose of the left camera\n" in tum.read_text()
    log, points = MeasurementLog.load(finished.folder / "measurements.npz"), read_ply(ply)
    seen = log.increments[-1].kept
    seen = seen.select(np.isin(seen.ids, points.ids))
    places = points.positions[np.searchsorted(points.ids, seen.ids)]
    ahead, left, up = transform_to_camera(Trajectory.load(tum).poses[-1], places).T
    rig = log.rig
    pixels = np.column_stack([rig.cx - rig.fx * left / ahead, rig.cy - rig.fy * up / ahead])
    measured = seen.measurement[:, :2] + seen.measurement[:, 2:] * [1.0, 0.0]
    assert np.median(np.linalg.norm(pixels - measured, axis=1)) < 1.0


def test_axes_of_a_bag_are_those_of_ros(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    bag, run = ("--trajectory", tmp_path / "t.mcap"), finished.folder
    line = mistake(capfd, monkeypatch, "export", run, *bag, "--axes", "camera")
    assert "leave --axes out" in line
    assert not (tmp_path / "t.mcap").exists()
    assert main(monkeypatch, "export", run, *bag, "--frame", "body") == 0


def test_export_of_the_graph(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """Of a run, and of a comparison's folder inside it, which has no log of its own."""
    graph, again = tmp_path / "a.g2o", tmp_path / "b.g2o"
    assert main(monkeypatch, "export", finished.folder, "--graph", graph) == 0
    assert "a.g2o: 12 poses" in capfd.readouterr().out
    run = Path(shutil.copytree(finished.folder, tmp_path / "run"))
    shutil.copytree(run / KIND, run / "compare" / KIND)
    for name in ("config.yaml", "metrics.json"):
        shutil.copy(run / name, run / "compare")
    assert main(monkeypatch, "export", run / "compare", "--graph", again) == 0
    assert graph.read_bytes() == again.read_bytes()


def test_export_of_images_for_photogrammetry_and_of_a_coloured_map(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    folder, file = tmp_path / "model", tmp_path / "map.ply"
    arguments = ("--images", folder, "--map", file, "--colour")
    assert main(monkeypatch, "export", finished.folder, *arguments) == 0
    assert "36 images" in capfd.readouterr().out
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    assert "images/left/000011.png" in names
    assert "sparse/0/images.txt" in names
    points = read_ply(file)
    assert points.normals is not None
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1.0, rtol=0, atol=1e-6)


def test_film_of_a_run_shows_every_frame(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    film = tmp_path / "run.mp4"
    assert main(monkeypatch, "film", finished.folder, film) == 0
    assert "12 frames" in capfd.readouterr().out
    shown = cv2.VideoCapture(str(film))
    frames = [frame for ok, frame in iter(shown.read, (False, None)) if ok]
    assert len(frames) == 12
    moved = np.abs(frames[-1].astype(int) - frames[0]).max(axis=2) > 60
    half = moved.shape[1] // 2
    assert moved[:, :half].any()  # the image on the left
    assert moved[:, half:].any()  # the map on the right


def test_a_faster_film_leaves_out_what_no_screen_shows(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    film = tmp_path / "run.mp4"
    given = ("film", finished.folder, film, "--speed", "30", "--width", "400")
    assert main(monkeypatch, *given) == 0
    assert "3 frames" in capfd.readouterr().out
    shown = cv2.VideoCapture(str(film))
    assert shown.get(cv2.CAP_PROP_FRAME_WIDTH) == 400
    assert shown.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0, rel=0.1)


def test_mistakes_of_film(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    assert "use .mp4 or .gif" in mistake(
        capfd, monkeypatch, "film", finished.folder, tmp_path / "run.avi"
    )
    assert "no estimator 'x'" in mistake(
        capfd, monkeypatch, "film", finished.folder, tmp_path / "a.gif", "--estimator", "x"
    )
    assert "no route was followed there; leave out --taught" in mistake(
        capfd, monkeypatch, "film", finished.folder, tmp_path / "a.gif", "--taught", tmp_path
    )
    assert not list(tmp_path.iterdir())


def test_export_of_images_says_where_the_recording_is_gone(
    finished: Finished, recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    run = Path(shutil.copytree(finished.folder, tmp_path / "run"))
    config = run / "config.yaml"
    text = config.read_text()
    config.write_text(re.sub(r"path: .*", "path: /gone", text))
    text = mistake(capfd, monkeypatch, "export", run, "--images", tmp_path / "model")
    assert "the recording /gone does not exist" in text
    assert "--recording PATH" in text
    given = ("--images", tmp_path / "model", "--recording", recording)
    assert main(monkeypatch, "export", run, *given) == 0


def test_a_run_that_was_moved_with_its_recording_finds_it(
    finished: Finished, recording: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    """Beside the run, or above it; from any folder."""
    run = Path(shutil.copytree(finished.folder, tmp_path / "runs" / "one"))
    shutil.copytree(recording, tmp_path / recording.name)
    config = run / "config.yaml"
    config.write_text(re.sub(r"path: .*", f"path: /gone/{recording.name}", config.read_text()))
    monkeypatch.chdir(tmp_path / "runs")
    assert main(monkeypatch, "export", run, "--images", tmp_path / "model") == 0


def test_export_of_a_dense_map_as_cloud_mesh_and_grid(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture, open3d: ModuleType
) -> None:
    files = [tmp_path / name for name in ("cloud.ply", "mesh.ply", "map.yaml")]
    given = ("--dense", files[0], "--mesh", files[1], "--grid", files[2], "--every", 4)
    assert main(monkeypatch, "export", finished.folder, *given) == 0
    said = capfd.readouterr().out
    assert "points in" in said
    assert "% free" in said
    cloud = open3d.t.io.read_point_cloud(str(files[0]))
    assert len(cloud.point["sigma"]) == len(open3d.io.read_triangle_mesh(str(files[1])).vertices)
    assert (tmp_path / "map.pgm").is_file()


def test_mistakes_of_dense_export(
    finished: Finished, recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    def reported(*arguments: object) -> str:
        return mistake(capfd, monkeypatch, "export", finished.folder, *arguments)

    cloud = tmp_path / "cloud.ply"
    assert "--voxel is 0; give metres above 0" in reported("--dense", cloud, "--voxel", 0)
    assert "unknown cloud format '.obj'; use .ply" in reported("--dense", tmp_path / "a.obj")
    assert "unknown mesh format '.pcd'; use .ply" in reported("--mesh", tmp_path / "a.pcd")
    assert "a .yaml with a .pgm next to it" in reported("--grid", tmp_path / "map.png")
    inside = recording / "cloud.ply"
    inside.write_text("")
    assert f"it is part of {recording}, which is read" in reported("--dense", inside)
    inside.unlink()
    (tmp_path / "map.pgm").write_text("")
    assert "map.pgm: is there already" in reported("--grid", tmp_path / "map.yaml")
    assert "a grid is a .yaml" in reported("--grid", tmp_path / "map.png")  # said first


def test_an_export_never_replaces_the_run_itself(
    finished: Finished, monkeypatch: Patch, capfd: Capture
) -> None:
    own = finished.folder / KIND / "map.ply"
    before = own.read_bytes()
    given = ("export", finished.folder, "--map", own, "--valid-only")
    for more in ((), ("--overwrite",)):
        text = mistake(capfd, monkeypatch, *given, *more)
        assert f"it is part of {finished.folder}, which is read; choose another name" in text
    assert own.read_bytes() == before


def test_export_of_an_interrupted_run(
    recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    run = run_values(experiment(recording), tmp_path / "run", stopped=stop_after(5))
    assert main(monkeypatch, "export", run.folder, "--trajectory", tmp_path / "t.tum") == 0
    assert capfd.readouterr().out.endswith("t.tum: 5 poses, wTc: pose of the right camera\n")


def test_mistakes_of_export(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    def reported(*arguments: object) -> str:
        return mistake(capfd, monkeypatch, "export", *arguments)

    run = finished.folder
    nothing = "nothing to export; give --map FILE.ply, --trajectory FILE.tum, --graph FILE.g2o, "
    assert nothing in reported(run)
    assert "use .tum, .kitti or .csv" in reported(run, "--trajectory", tmp_path / "t.txt")
    assert "use .g2o" in reported(run, "--graph", tmp_path / "t.graph")
    line = reported(run, "--map", tmp_path / "map.xyz")
    assert all(suffix in line for suffix in (".ply", ".pcd", "xyz"))
    absent = tmp_path / "absent"
    assert f"{absent}: no such folder" in reported(absent, "--map", tmp_path / "m.ply")
    line = reported(run, "--map", tmp_path / "m.ply", "--estimator", "isam2")
    assert f"no estimator 'isam2'; give --estimator with one of {KIND}" in line
    assert "its folder does not exist" in reported(run, "--map", tmp_path / "absent" / "m.ply")
    assert list(tmp_path.iterdir()) == []


def test_export_of_damaged_results(
    recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    run = run_values(experiment(recording), tmp_path / "run", stopped=stop_after(2)).folder
    (run / KIND / "map.ply").write_bytes((run / KIND / "map.ply").read_bytes()[:700])
    line = mistake(capfd, monkeypatch, "export", run, "--map", tmp_path / "m.ply")
    assert str(run / KIND / "map.ply") in line
    (run / KIND / "final.tum").write_text("1 2 3\n", encoding="utf-8")
    line = mistake(capfd, monkeypatch, "export", run, "--trajectory", tmp_path / "t.tum")
    assert f"{run / KIND / 'final.tum'}, line 1" in line
