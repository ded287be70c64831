"""Messages about experiments, runs and what is made of them, and what follows their advice."""

from __future__ import annotations

import atexit
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from advice import Advice
from advice_recordings import covariances_of, poses_file, with_truth
from bags import stereo, write_bag
from dataset_builders import image_folder, kitti, picture, save
from passing import PASSING_RIG, SCENE, pair_of
from recordings import BASELINE, FOCAL, write_recording
from running import ROOT, main, stop_after
from textured_room import SMALL_CAMERA_FILE, folder_of

from fgslam.core.log import MeasurementLog
from fgslam.core.saved_map import load_map, save_map
from fgslam.core.types import Trajectory
from fgslam.homing.route import PathMemory
from fgslam.runs.bare import short_config
from fgslam.runs.config import make_config, make_experiment
from fgslam.runs.folder import Owner
from fgslam.runs.run import run_experiment

SIMULATED: dict[str, Any] = {
    "name": "x",
    "dataset": {"kind": "simulated_measurements", "stop": 4},
    "estimator": {"kind": "landmark_kalman"},
    "output": {"pictures": False, "report": False},
}
ROOM = TemporaryDirectory(prefix="fgslam_advice_")
MADE: dict[str, Path] = {}
"""Run folders that were made once, by name; copied where one is needed."""


def experiment(root: Path, **changes: Any) -> Path:
    (root / "x.yaml").write_text(yaml.safe_dump(SIMULATED | changes), encoding="utf-8")
    return root / "x.yaml"


def simulated(**changes: Any) -> Callable[[Path], Path]:
    dataset = SIMULATED["dataset"] | changes
    return lambda root: experiment(root, dataset=dataset)


def run_folder(root: Path, name: str = "finished", **changes: Any) -> Path:
    """The run of a small experiment; of images it was interrupted after two frames."""
    if name not in MADE:
        folder = Path(ROOM.name) / name
        if name == "interrupted":
            images = {"kind": "image_folder", "path": str(image_folder(folder / "images"))}
            changes |= {
                "dataset": images,
                "rig_memory": "off",
                "odometry": {"kind": "constant_velocity"},
            }
        config = make_config(SIMULATED | changes, "test")
        stopped = stop_after(3) if name == "interrupted" else lambda: False
        run_experiment(config, folder / "run", "refuse", lambda *_: None, stopped)
        MADE[name] = folder / "run"
    return Path(shutil.copytree(MADE[name], root / "o"))


def with_run(root: Path) -> Path:
    run_folder(root)
    return experiment(root)


def interrupted(root: Path) -> Path:
    return run_folder(root, "interrupted") / "config.yaml"


def without_odometry(root: Path) -> Path:
    return run_folder(root, "unsteered", odometry={"kind": "constant_velocity"})


def cut_map(root: Path) -> Path:
    path = run_folder(root) / "landmark_kalman" / "map.ply"
    path.write_bytes(path.read_bytes()[:-10])
    return root / "o"


def twice(root: Path) -> Path:
    (root / "p").mkdir()
    run_folder(root / "p")
    return run_folder(root)


def begun_with(group: str, value: Any) -> Callable[[Path], Path]:
    """An interrupted run whose provenance states another value of a group."""

    def make(root: Path) -> Path:
        given = interrupted(root)
        path = root / "o" / "config.yaml"
        text = yaml.safe_load(path.read_text(encoding="utf-8"))
        held = text["provenance"]
        held[group] = held[group] | value if isinstance(value, dict) else value
        path.write_text(yaml.safe_dump(text), encoding="utf-8")
        return given

    return make


def damaged_sweep(root: Path) -> Path:
    (root / "s").mkdir()
    (root / "s" / "sweep.yaml").write_text("experiments: 3\n", encoding="utf-8")
    return experiment(root)


def damaged_state(root: Path) -> Path:
    given = interrupted(root)
    path = root / "o" / "checkpoint.npz"
    with np.load(path) as held:
        arrays = dict(held)
    np.savez(path, **dict(list(arrays.items())[:-1]))
    return given


def measurements(**changes: Any) -> Callable[[Path], Path]:
    """An experiment on what an earlier run measured."""

    def make(root: Path) -> Path:
        dataset = {"kind": "measurements", "path": str(run_folder(root))}
        return experiment(root, dataset=dataset, **changes)

    return make


def graph_file(root: Path) -> Path:
    """Three poses of a square's side, in the plane."""
    rows = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(3)]
    rows += [f"EDGE_SE2 {k} {k + 1} 1 0 0 100 0 0 100 0 100" for k in range(2)]
    (root / "graph.g2o").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return root / "graph.g2o"


def scaled(root: Path, rotation: float) -> Path:
    """Poses whose stated covariances have other rotations than they should."""
    given = with_truth(root, covariances=True)
    rows = np.loadtxt(given)
    scale = np.repeat([rotation, 1.0], 3)
    rows[:, 8:] *= np.outer(scale, scale)[np.triu_indices(6)]
    np.savetxt(given, rows, fmt="%.9f")
    return given


def in_degrees(root: Path) -> Path:
    return scaled(root, float(np.degrees(1.0)))


def different_parts(root: Path) -> Path:
    """Rotations that are ten times better known than positions, and as well estimated."""
    return scaled(root, 0.1)


def without_covariances(root: Path) -> Path:
    given = with_truth(root, covariances=True)
    rows = np.loadtxt(given)
    rows[:, 8:] = 0.0
    np.savetxt(given, rows, fmt="%.9f")
    return given


def two_estimates(root: Path) -> Path:
    poses_file(root, "other.tum", covariances=True)
    return with_truth(root, covariances=True)


def of_images(**changes: Any) -> Callable[[Path], Path]:
    """An experiment on six small images."""

    def make(root: Path) -> Path:
        dataset = {"kind": "image_folder", "path": str(image_folder(root / "images"))}
        return experiment(root, dataset=dataset, **changes)

    return make


def sweep_of_others(root: Path) -> Path:
    (root / "s").mkdir()
    (root / "s" / "sweep.yaml").write_text("experiments: {y: {}}\n", encoding="utf-8")
    return experiment(root)


def homing(root: Path) -> Path:
    return Path(shutil.copy(ROOT / "experiments" / "homing_panoramas.yaml", root / "x.yaml"))


def shorter_log(root: Path) -> Path:
    """The log of an interrupted run without its last frame."""
    given = interrupted(root)
    whole = MeasurementLog.load(root / "o" / "measurements.npz")
    log = MeasurementLog(whole.rig, whole.motion_model)
    for increment in list(whole)[:-1]:
        log.append(increment)
    log.save(root / "o" / "measurements.npz")
    return given


def of_sides(root: Path) -> Path:
    """The same trajectory of a run as that of both cameras."""
    run_folder(root)
    for side in ("left", "right"):
        exported(root, side)
    upper = np.tile(np.eye(6)[np.triu_indices(6)] * 1e-4, (SIMULATED["dataset"]["stop"], 1))
    np.savetxt(root / "covariances.txt", upper)
    return root / "left.tum"


def exported(root: Path, side: str) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        given = root / "o", "--frame", side, "--trajectory", root / f"{side}.tum", "--overwrite"
        assert main(patch, "export", *given) == 0
    return root / f"{side}.tum"


def moved_images(root: Path) -> Path:
    interrupted(root)
    path = root / "o" / "config.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(str(MADE["interrupted"].parent / "images"), "/gone"), "utf-8")
    return root / "o"


def images_of(root: Path) -> None:
    (root / "moved").symlink_to(MADE["interrupted"].parent / "images")


def read_only(root: Path) -> Path:
    root = image_folder(root / "images")
    root.chmod(0o555)
    return root


OWNERS: list[Owner] = []


def written_by_another(root: Path) -> Path:
    (root / "o").mkdir()
    OWNERS.append(Owner(root / "o"))
    OWNERS[-1].take()
    return experiment(root)


def boards(root: Path) -> Path:
    """A recording in which something can be seen, and in `m.fgmap` its map."""
    if "boards" not in MADE:
        MADE["boards"] = write_recording(Path(ROOM.name) / "boards", frames=6, top=False)
        mapped(MADE["boards"], Path(ROOM.name) / "boards_run")
    shutil.copytree(Path(ROOM.name) / "boards_run", root / "r")
    (root / "r" / "m.fgmap").rename(root / "m.fgmap")
    return Path(shutil.copytree(MADE["boards"], root / "boards"))


def mapped(recording: Path, run: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        assert (
            main(patch, "run", recording, "--out", run, "--map-out", run / "m.fgmap", *QUIET) == 0
        )


def run_of_boards(root: Path) -> Path:
    return (boards(root), root / "r")[1]


def map_of_boards(root: Path) -> Path:
    return (boards(root), root / "m.fgmap")[1]


def unstated_lens(root: Path) -> Path:
    """Four coefficients of nothing beside their matrices."""
    boards(root)
    width, height = 160, 120
    matrix = [[FOCAL, 0.0, (width - 1) / 2], [0.0, FOCAL, (height - 1) / 2], [0.0, 0.0, 1.0]]
    values = {
        f"{n}{k}": matrix if n == "K" else [0.02, 0.0, 0.0, 0.0] for n in "KD" for k in (1, 2)
    }
    values |= {"R": np.eye(3).tolist(), "T": [-BASELINE, 0.0, 0.0], "image_size": [width, height]}
    (root / "boards" / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    return root / "boards"


def elsewhere(recording: Path) -> Path:
    """The same cameras where nothing is as it was."""
    for k, image in enumerate(sorted(recording.glob("*/*.png"))):
        save(image, picture(10 + k, 160, 120))
    return recording


def rendered(**changes: Any) -> Callable[[Path], Path]:
    drive = {"path": "waypoints", "waypoints_m": [[-3, -2], [-2, -2.1]], "frames": None}
    dataset = {"kind": "rendered_lab", "stop": 2} | changes
    dataset["drive"] = drive | changes.get("drive", {})
    return lambda root: experiment(root, dataset=dataset)


def unstated_options(root: Path) -> Path:
    """A recording whose calibration lies elsewhere."""
    images = image_folder(root / "images")
    (images / "calib.json").rename(root / "mine.json")
    return images


def stated_options(root: Path) -> Path:
    text = short_config(root / "images", root / "mine.json")
    (root / "x.yaml").write_text(text, encoding="utf-8")
    return root / "x.yaml"


def taught(root: Path) -> Path:
    """A route of three views, and in `t` the run that taught it; gives the folder of views."""
    if "taught" not in MADE:
        room = Path(ROOM.name) / "routes"
        room.mkdir()
        folder_of(room / "drive", np.arange(0.0, 1.2, 0.4))
        (room / "camera.yaml").write_text(SMALL_CAMERA_FILE, encoding="utf-8")
        given = "--camera", room / "camera.yaml", "--out", room / "r.fgpath", "--report", room / "t"
        with pytest.MonkeyPatch.context() as patch:
            assert main(patch, "teach", room / "drive", *given) == 0
        MADE["taught"] = room
    shutil.copytree(MADE["taught"], root, dirs_exist_ok=True)
    return root / "drive"


def route_of(root: Path) -> Path:
    taught(root)
    PathMemory.of(PathMemory.load(root / "r.fgpath").images).save(root / "r.fgpath")
    return root / "r.fgpath"


def larger_views(root: Path) -> Path:
    for path in sorted(taught(root).glob("*.png")):
        save(path, cv2.resize(cv2.imread(str(path)), (602, 182)))
    text = SMALL_CAMERA_FILE.replace("301", "602").replace("91", "182")
    (root / "other.yaml").write_text(text, encoding="utf-8")
    return root / "r.fgpath"


def round_pictures(root: Path) -> Path:
    taught(root)
    (root / "mirror.yaml").write_text("kind: mirror\nring_px: [10, 44]\n", encoding="utf-8")
    for k in range(3):
        shown = cv2.circle(np.zeros((91, 301), np.uint8), (150, 45), 45, 255, -1)
        save(root / "photos" / f"{k}.png", np.dstack([picture(10 + k, 301, 91) & shown] * 3))
    return root / "photos"


def followed(root: Path) -> Path:
    taught(root)
    with pytest.MonkeyPatch.context() as patch:
        given = "follow", root / "r.fgpath", root / "drive", "--out", root / "f"
        assert main(patch, *given) == 0
    return root / "f"


def passing(
    root: Path,
    speed: Callable[[int], float] | None = None,
    shown: Callable[[int], tuple[Any, Any]] = lambda k: pair_of(list(SCENE), way(k), 0.0),
    frames: int = 13,
) -> Path:
    """A drive to the right past planes.

    Args:
        root: folder that gets images, calibration and odometry.
        speed: of a frame what the wheels state of the step that ends there, m/s, ahead on a robot
            that carries the cameras turned to its left; None without wheels.
        shown: left and right image of a frame.
        frames: how many.
    """
    for k in range(frames):
        for side, image in zip(("left", "right"), shown(k), strict=True):
            save(root / side / f"{k:06d}.png", image)
    times = "".join(f"{k:06d} {0.1 * k:.6f}\n" for k in range(frames))
    (root / "times.txt").write_text(times, encoding="utf-8")
    rig = PASSING_RIG
    names = ("width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(rig, name) for name in names} | {"baseline_m": rig.baseline}
    if speed is not None:
        rows = (f"{0.1 * k:.3f},{speed(max(k, 1)):.6f},0.0\n" for k in range(frames + 1))
        (root / "odom.csv").write_text("".join(rows), encoding="utf-8")
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    return root


def way(k: float) -> float:
    """Metres to the right after k frames: faster and slower."""
    return 0.05 * k + 0.05 * float(np.sin(0.8 * k))


def wheels(k: float) -> float:
    return 10.0 * (way(k) - way(k - 1))


def leap(k: int) -> float:
    """The same of a robot that is ten times as fast for three frames."""
    return 0.05 * k + 0.45 * min(max(k - 4, 0), 3)


def late_image(k: int, begins: int = 6) -> tuple[Any, Any]:
    """The left image of the frame before, from one on."""
    left, right = (pair_of(list(SCENE), way(max(j, 0)), 0.0) for j in (k - (k >= begins), k))
    return left[0], right[1]


def swapped(k: int) -> tuple[Any, Any]:
    left, right = pair_of(list(SCENE), way(k), 0.0)
    return (right, left) if k >= 6 else (left, right)


def board_passes(k: int) -> tuple[Any, Any]:
    ahead, left = 0.04 * k, -0.6 + 0.1 * k
    return pair_of([*SCENE, (1.2 + ahead, left, left + 0.5)], 0.0, ahead)


def run_of_bag(root: Path) -> Path:
    """A run on a bag without odometry: nothing states where its cameras sit."""
    write_bag(root / "drive.bag", stereo())
    with pytest.MonkeyPatch.context() as patch:
        main(patch, "run", root / "drive.bag", "--out", root / "o", *QUIET)
    return root / "o"


def body_run(root: Path) -> Path:
    """A run on images whose camera sits on a body, and beside it the poses of that body."""
    given = image_folder(root / "images")
    (given / "odom.csv").write_text("".join(f"{0.1 * k},1.0,0.1\n" for k in range(8)), "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        words = "--set", "dataset.camera_yaw_deg=0", "--set", "odometry.kind=recorded"
        main(patch, "run", given, "--out", root / "o", *words, *QUIET)
    (root / "p").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        given = root / "o", "--frame", "body", "--trajectory", root / "p" / "body.tum"
        assert main(patch, "export", *given) == 0
    taught(root)
    times = "".join(f"view_{k}.png {0.1 * k:.6f}\n" for k in range(3))
    (root / "drive" / "times.txt").write_text(times, encoding="utf-8")
    return root / "drive"


def entered(entry: Callable[[dict[str, Any]], object]) -> Callable[[Path], Path]:
    """An interrupted run that had entered a map, of which its provenance then states other."""

    def make(root: Path) -> Path:
        images = {"kind": "image_folder", "path": str(boards(root))}
        held = {"load": str(root / "m.fgmap")}
        values = SIMULATED | {"dataset": images, "map": held, "rig_memory": "off"}
        run_experiment(make_config(values, "test"), root / "o", "refuse", lambda *_: None,
                       stop_after(4))  # fmt: skip
        path = root / "o" / "config.yaml"
        text = yaml.safe_load(path.read_text(encoding="utf-8"))
        entry(text["provenance"]["map"])
        path.write_text(yaml.safe_dump(text), encoding="utf-8")
        return path

    return make


def without_trajectory(root: Path) -> Path:
    """A map that holds no poses."""
    given = boards(root)
    none = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    save_map(replace(load_map(root / "m.fgmap"), trajectory=none), root / "m.fgmap")
    return given


def foreign_units(root: Path) -> Path:
    """Simulated homings that were interrupted, whose results are of another program."""
    values = {
        "task": "homing_trials",
        "name": "x",
        "trials": 1,
        "jobs": 1,
        "outliers": [0.0],
        "estimator": {"kind": "homing_ekf"},
        "dataset": {"images_per_s": 2.0},
        "output": {"logs": 1, "report": False},
    }
    run_experiment(make_experiment(values, "test"), root / "o", "refuse", lambda *_: None,
                   lambda: True)  # fmt: skip
    (root / "o" / "units").mkdir(exist_ok=True)
    np.savez(root / "o" / "units" / "trials_000000.npz", a=np.zeros(3))
    return root / "o" / "config.yaml"


def program_of(*lines: str) -> Callable[[Path], Path]:
    """A program of the library's in a folder, `{}` in it."""

    def make(root: Path) -> Path:
        text = "\n".join(["import fgslam as fg", *lines]).replace("{}", str(root))
        (root / "program.py").write_text(text + "\n", encoding="utf-8")
        return root / "program.py"

    return make


def two_cameras(root: Path) -> Path:
    """A map of two routes, taught with different cameras, and what asks it for a place."""
    taught(root)
    other = SMALL_CAMERA_FILE.replace("54", "53")
    (root / "other.yaml").write_text(other, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        given = "--camera", root / "other.yaml", "--out", root / "s.fgpath", "--report", root / "u"
        assert main(patch, "teach", root / "drive", *given) == 0
    with pytest.MonkeyPatch.context() as patch:
        given = "--out", root / "j.fgmap", "--report", root / "v"
        assert main(patch, "join", root / "r.fgpath", root / "s.fgpath", *given) == 0
    return asking("")(root)


def asking(more: str) -> Callable[[Path], Path]:
    return program_of(
        "import cv2",
        "image = cv2.imread('{}/drive/view_0.png')",
        f"fg.RouteMap.load('{{}}/j.fgmap').locate(image{more})",
    )


def mirror_aside(root: Path) -> Path:
    round_pictures(root)
    text = "kind: mirror\ncentre: [140, 45]\nring_px: [10, 44]\n"
    (root / "mirror.yaml").write_text(text, encoding="utf-8")
    return root / "photos"


def lens_pictures(root: Path) -> Path:
    round_pictures(root)
    lens = {
        "camera_model": "omni",
        "intrinsics": [0.92, 25.0, 25.0, 150.0, 45.0],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.0] * 4,
        "resolution": [301, 91],
    }
    (root / "camchain.yaml").write_text(json.dumps({"cam0": lens}), encoding="utf-8")
    text = "kind: lens\nfile: camchain.yaml\nring_px: [10, 44]\n"
    (root / "lens.yaml").write_text(text, encoding="utf-8")
    return root / "photos"


def views_of_pairs(root: Path) -> Path:
    """An experiment on panoramas that it wants larger than they are."""
    taught(root)
    camera = {"kind": "equirectangular", "top_elevation_deg": 54, "bottom_elevation_deg": -54}
    dataset = {"kind": "panoramas", "path": str(root / "drive"), "camera": camera, "width": 999}
    values = {"task": "homing_pairs", "name": "x", "jobs": 1, "dataset": dataset}
    (root / "x.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root / "x.yaml"


def of_mirror_errors(root: Path) -> Path:
    """An experiment in the house with errors of a mirror, but no mirror."""
    dataset = {"kind": "omni_house", "path": {"legs": 1, "spacing_m": 2.0}}
    dataset |= {"camera": {"model": "equirectangular"}, "calibration": {"centre_px": 2.0}}
    values = {
        "task": "path_following",
        "name": "x",
        "jobs": 1,
        "trials": 1,
        "dataset": dataset,
        "behaviour": {"loop": {"longest_s": 0.3}},
        "output": {"pictures": 1, "report": False},
    }
    (root / "x.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root / "x.yaml"


def begin_scheduler(root: Path) -> None:
    """One of Dask's on this machine, until the tests end."""
    file, begin = root / "scheduler.json", "from distributed.cli.dask_scheduler import main; main()"
    given = "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)
    process = subprocess.Popen([sys.executable, "-c", begin, *given])  # noqa: S603
    atexit.register(process.kill)
    while not file.is_file():
        assert process.poll() is None
        time.sleep(0.1)


def stopped_at_once(patch: pytest.MonkeyPatch) -> None:
    """As by Ctrl-C while the command begins."""
    patch.setattr("fgslam.cli.main.stop_flag", lambda: nullcontext(lambda: True))


def without_screen(patch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        patch.delenv(name, raising=False)


QUIET = ("--set", "output.pictures=false", "--set", "output.report=false")
RUN = ("run", "--out {}/o")
OF_RUNS = {
    "two ways with what exists": Advice(
        with_run, r"--overwrite and (--resume) exclude each other; give one",
        command=("run", "--out {}/o --overwrite --resume"), drop="--resume", slow=True,
    ),
    "results that exist": Advice(with_run, r"or add (--overwrite) or --resume", r"\1", command=RUN),
    "nothing to resume": Advice(
        with_run, r"has finished; use (--overwrite) to run again", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "no run to resume": Advice(
        experiment, r"or start one without (--resume)",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "resumed with another seed": Advice(
        interrupted, r"or start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --set seed=9 --resume"), drop="--resume",
    ),
    "resumed with other packages": Advice(
        begun_with("versions", {"numpy": "0.1"}),
        r"numpy 0.1 -> .* or start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "resumed with another recording": Advice(
        begun_with("dataset", {"identity": "x"}),
        r"recording has changed since .* or start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "resumed with another log": Advice(
        begun_with("log", "x"), r"begun with log x, .* or start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "a damaged state": Advice(
        damaged_state, r"not a state that .* start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "a value with keys": Advice(
        experiment, r"--set (\S+)=3: name holds a value",
        command=("run", "--out {}/o --set name.a=3"), drop="--set name.a=3",
    ),
    "a map's start without a map": Advice(
        image_folder, r"map.start and map.extend mean nothing without a map",
        command=("run", "--out {}/o --set map.start=last"), drop="--set map.start=last",
    ),
    "a viewer of measurements": Advice(
        experiment, r"--live and --save-rrd show SLAM on images, .* leave them out",
        command=("run", "--out {}/o --save-rrd {}/a.rrd"), drop="--save-rrd {}/a.rrd",
    ),
    "a memory of cameras that are not corrected": Advice(
        experiment, r"--camera-out: this run takes its cameras as calibrated",
        command=("run", "--out {}/o --camera-out {}/a.json"), drop="--camera-out {}/a.json",
    ),
    "a calibration for an experiment": Advice(
        experiment, r"--camera is for a recording",
        command=("run", "--out {}/o --camera {}/a.json"), drop="--camera {}/a.json",
    ),
    "an experiment that is not there": Advice(
        lambda root: (experiment(root), root / "there.yaml")[1], r"e.g. (\w+) \(fgslam run --help",
        "--help", command=RUN,
    ),
    "no frame of a drive": Advice(
        simulated(stop=None, start=999), r"lower (dataset.start) or raise", r"--set \1=60",
        command=RUN, slow=True,
    ),
    "a path that a place has not": Advice(
        simulated(world={"place": "corridor"}), r"choose one of (\w+), or another dataset.world",
        r"--set dataset.drive.path=\1 --set dataset.drive.frames=null", command=RUN,
    ),
    "a start of measurements": Advice(
        measurements(), r"set (dataset.stop) alone", r"--set \1=3",
        command=("run", "--out {}/n --set dataset.start=1"), drop="--set dataset.start=1",
    ),
    "noise for measurements": Advice(
        measurements(odometry={"kind": "synthetic"}), r"choose (recorded) or constant_velocity",
        r"--set odometry.kind=\1", command=("run", "--out {}/n"),
    ),
    "tracks that are not there": Advice(
        lambda root: experiment(
            root, dataset={"kind": "stereo_tracks", "file": str(root / "none.txt"), "stop": 3}
        ), r"dataset.file is (\w+),", r"--set dataset.file=\1", command=RUN,
    ),
    "a seed without trials": Advice(
        run_folder, r"--seed means nothing without --trials; give both or none",
        command=("compare", "--estimators odometry --seed 3"), drop="--seed 3",
    ),
    "trials of two runs": Advice(
        twice, r"(--trials) takes one run or experiment at a time; give one",
        command=("compare", "{}/p/o --trials 2 --out {}/c"), drop="{}/p/o", slow=True,
    ),
    "trials of a file": Advice(
        experiment, r"or add (--trials) N", r"\1 2 --out {}/c", command=("compare", ""), slow=True,
    ),
    "no such estimator": Advice(
        run_folder, r"give (--estimators) with some of (\w+)", r"\1 \2",
        command=("compare", "--estimators nosuch"), drop="--estimators nosuch",
    ),
    "a setting of what was measured": Advice(
        run_folder, r"or (--trials) to run the experiment again", r"\1 2 --out {}/c",
        command=("compare", "--estimators odometry --set seed=3"),
    ),
    "a setting of no estimator": Advice(
        run_folder, r"of the form (estimators)\.NAME\.key=value with NAME one of (\w+)",
        r"--set \1.\2.label=a",
        command=("compare", "--estimators odometry --set estimators.nosuch.label=a"),
        drop="--set estimators.nosuch.label=a",
    ),
    "another kind": Advice(
        run_folder, r"use (--estimators)", r"\1 odometry",
        command=("compare", "--estimators ekf --set estimators.ekf.kind=odometry"),
        drop="--estimators ekf --set estimators.ekf.kind=odometry",
    ),
    "a comparison in the run itself": Advice(
        run_folder, r"holds the run itself; choose another", "--out {}/c",
        command=("compare", "--estimators odometry --out {}/o"), drop="--out {}/o",
    ),
    "a comparison that exists": Advice(
        twice, r"choose another --out, or add (--overwrite) or", r"\1",
        command=("compare", "--estimators odometry --out {}/p/o"),
    ),
    "two runs of one name": Advice(
        twice, r"compare them without (--out)",
        command=("compare", "{}/p/o --estimators odometry --out {}/c"), drop="--out {}/c",
    ),
    "dead reckoning of no odometry": Advice(
        without_odometry, r"--estimators odometry: .* leave it out", "--estimators landmark_kalman",
        command=("compare", "--estimators odometry,landmark_kalman"),
        drop="--estimators odometry,landmark_kalman", slow=True,
    ),
    "a filter of a pose graph": Advice(
        graph_file, r"give (--estimators) (\S+)", r"\1 \2",
        command=("compare", "--estimators ekf"), drop="--estimators ekf",
    ),
    "axes of a bag": Advice(
        run_folder, r"leave (--axes) out",
        command=("export", "--trajectory {}/a.mcap --axes camera"), drop="--axes camera",
    ),
    "nothing to export": Advice(
        run_folder, r"give (--map) FILE(.ply)", r"\1 {}/a\2", command=("export", ""),
    ),
    "an estimator that did not run": Advice(
        run_folder, r"give (--estimator) with one of (\w+)", r"\1 \2",
        command=("export", "--trajectory {}/a.tum --estimator nosuch"), drop="--estimator nosuch",
    ),
    "no values": Advice(
        experiment, r"give FIRST:END", "--set seed=0:1",
        command=("sweep", "--out {}/s --jobs 1 --set seed=3:3"), drop="--set seed=3:3",
    ),
    "an empty value": Advice(
        experiment, r"a value is empty; remove a comma", "--set seed=1",
        command=("sweep", "--out {}/s --jobs 1 --set seed=1,"), drop="--set seed=1,",
    ),
    "a value given twice": Advice(
        experiment, r"a value is given twice; remove one", "--set seed=1",
        command=("sweep", "--out {}/s --jobs 1 --set seed=1,1"), drop="--set seed=1,1",
    ),
    "a key given twice": Advice(
        experiment, r"given twice; write (seed)=A,B", r"--set \1=1,2",
        command=("sweep", "--out {}/s --jobs 1 --set seed=1 --set seed=2"),
        drop="--set seed=1 --set seed=2",
    ),
    "no values of a key": Advice(
        experiment, r"e.g. (--set seed)=0:100", r"\1=0:1",
        command=("sweep", "--out {}/s --jobs 1 --set seed"), drop="--set seed",
    ),
    "workers here and elsewhere": Advice(
        experiment, r"(--jobs) is for workers of this machine",
        command=("sweep", "--out {}/s --set seed=1 --jobs 1 --scheduler tcp://127.0.0.1:1"),
        drop="--scheduler tcp://127.0.0.1:1",
    ),
    "a sweep that cannot be read": Advice(
        damaged_sweep, r"cannot be read; start again with (--overwrite)", r"\1",
        command=("sweep", "--out {}/s --jobs 1 --set seed=1 --resume"), drop="--resume",
    ),
    "no column of a sweep": Advice(
        experiment, r"--metric nosuch: no column of numbers; known: (\w+)",
        r"--metric \1 --out {}/t",
        command=("sweep", "--jobs 1 --set seed=1 --out {}/s --metric nosuch"),
        drop="--out {}/s --metric nosuch",
    ),
    "no odometry": Advice(
        of_images(), r"has no odometry; set (odometry.kind) to (\w+)", r"--set \1=\2", command=RUN,
    ),
    "a sweep of other experiments": Advice(
        sweep_of_others, r"resume with the same experiments, or choose another (--out)",
        command=("sweep", "--jobs 1 --set seed=1 --out {}/s --resume"), drop="--out {}/s --resume",
        follow=r"\1 {}/t",
    ),
    "a sweep that saves a map": Advice(
        of_images(odometry={"kind": "constant_velocity"}, map={"save": "m.fgmap"}),
        r"leave it out, or (--set map.save=null)", r"\1",
        command=("sweep", "--jobs 1 --set seed=1 --out {}/s"),
    ),
    "trials of another task": Advice(
        homing, r"--trials needs the dataset.kind rendered_lab or simulated_meas", mend=experiment,
        command=("compare", "--trials 2 --out {}/c"), slow=True,
    ),
    "trials of a recording": Advice(
        of_images(), r"--trials needs the dataset.kind \w+ or (simulated_\w+)", mend=experiment,
        command=("compare", "--trials 2 --out {}/c"), slow=True,
    ),
    "a setting of an estimator": Advice(
        run_folder, r"did you mean (estimators.ekf.\w+)\?", r"--estimators ekf --set \1=4",
        command=("compare", "--estimators ekf --set estimators.ekf.gate_sigma=4"),
        drop="--estimators ekf --set estimators.ekf.gate_sigma=4",
    ),
    "no images to inspect": Advice(
        experiment, r"holds measurements, no images; choose a recording of images",
        mend=lambda root: image_folder(root / "images"),
    ),
    "poses of another camera than the truth": Advice(
        of_sides, r"give both of one frame: fgslam export RUN --trajectory FILE (--frame) left",
        mend=lambda root: exported(root, "right"),
        command=("judge", "--covariance {}/covariances.txt --truth {}/right.tum"),
    ),
    "a log that is shorter than its state": Advice(
        shorter_log, r"restore it, or start again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "a film of a route": Advice(
        lambda root: (interrupted(root), root / "o")[1], r"no route was followed there; leave out",
        command=("film", "{}/a.mp4 --taught {}/o"), drop="--taught {}/o",
    ),
    "images that moved": Advice(
        moved_images, r"for export and film (--recording) PATH", r"\1 {}/moved", images_of,
        command=("export", "--map {}/a.ply --colour"),
    ),
    "images of a film that moved": Advice(
        moved_images, r"for export and film (--recording) PATH", r"\1 {}/moved", images_of,
        command=("film", "{}/a.mp4"),
    ),
    "images that moved before a run goes on": Advice(
        lambda root: moved_images(root) / "config.yaml", r"is: (--set dataset.path)=PATH",
        r"\1={}/moved", images_of, command=("run", "--out {}/o --resume"),
    ),
    "a memory beside a calibration that is read-only": Advice(
        read_only, r"is read-only; (--rig-memory) FILE keeps it elsewhere",
        r"\1 {0}/memory.npz --out {0}/n",
        command=RUN, drop="--out {}/o", slow=True,
    ),
    "a memory that is none": Advice(
        lambda root: image_folder(root / "images"), r"give another FILE by (--rig-memory)",
        r"\1 {}/n.npz",
        command=("run", "--out {}/o --rig-memory {}/images/calib.json"),
        drop="--rig-memory {}/images/calib.json",
    ),
    "a run that another process writes": Advice(
        written_by_another, r"wait for it to end, or choose another (--out)", r"\1 {}/n",
        lambda root: OWNERS.pop().__exit__(None, None, None), command=RUN, drop="--out {}/o",
    ),
    "too few frames of a drive": Advice(
        simulated(stop=None, drive={"frames": 3}),
        r"(dataset.drive.frames) is 3, .* takes at least (\d+) frames",
        r"--set \1=\2", command=RUN,
    ),
    "no map to begin in": Advice(
        boards, r"no such file; give a file that fgslam run --map-out wrote",
        mend=lambda root: mapped(root / "boards", root / "s"),
        command=("run", "--out {}/o --map-in {}/s/m.fgmap"), slow=True,
    ),
    "a map that is none": Advice(
        boards, r"give a file that fgslam run --map-out wrote", r"--map-in {}/m.fgmap",
        command=("run", "--out {}/o --map-in {}/boards/calib.json"),
        drop="--map-in {}/boards/calib.json", slow=True,
    ),
    "a map that is kept and saved": Advice(
        boards, r"there is no new map to save; leave map.save out",
        command=("run", "--out {}/o --map-in {}/m.fgmap --set map.extend=false "
                 "--estimator landmark_kalman --map-out {}/n.fgmap"),
        drop="--map-out {}/n.fgmap", slow=True,
    ),
    "a map onto itself": Advice(
        boards, r"are one file; save to another name", r"--map-out {}/n.fgmap",
        command=("run", "--out {}/o --map-in {}/m.fgmap --map-out {}/m.fgmap"),
        drop="--map-out {}/m.fgmap", slow=True,
    ),
    "two maps to begin in": Advice(
        boards, r"map.load and map.made_from exclude each other; give one of them",
        command=("run", "--out {}/o --map-in {}/m.fgmap --set map.made_from.dataset.path={}/x "
                 "--set map.made_from.dataset.kind=image_folder"),
        drop="--set map.made_from.dataset.path={}/x --set map.made_from.dataset.kind=image_folder",
        slow=True,
    ),
    "a map that cannot be left as it is": Advice(
        boards, r"use (\w+) or ekf, or map.extend true", r"--estimator \1",
        command=("run", "--out {}/o --map-in {}/m.fgmap --set map.extend=false"), slow=True,
    ),
    "another place than the map's": Advice(
        lambda root: elsewhere(boards(root)), r"raise map.begin.within, or tell .* by (map.start)",
        r"--set \1=last", command=("run", "--out {}/o --map-in {}/m.fgmap"), slow=True,
    ),
    "a frame that is not selected": Advice(
        map_of_boards, r"not among the frames selected .*; choose another, or other (--start)",
        r"\1 1", command=("localize", "{}/boards --frame 1 --start 3 --out {}/l"),
        drop="--start 3", slow=True,
    ),
    "too few frames for a submap": Advice(
        map_of_boards, r"too few frames before it for a submap of 3; lower (--frames)", r"\1 2",
        command=("localize", "{}/boards --frame 1 --frames 3 --out {}/l"), drop="--frames 3",
        slow=True,
    ),
    "colours of a map": Advice(
        map_of_boards, r"give (--map) or --trajectory, or a run folder", r"\1 {}/a.ply",
        command=("export", "--map {}/a.ply --colour"), drop="--map {}/a.ply --colour", slow=True,
    ),
    "three cameras of two": Advice(
        run_of_boards, r"--cameras 3: the rig has 2; leave it out",
        command=("export", "--dense {}/a.ply --cameras 3"), drop="--cameras 3", slow=True,
    ),
    "voxels that are too fine": Advice(
        run_of_boards, r"use (--voxel [\d.e-]+), or leave it out", r"\1",
        command=("export", "--dense {}/a.ply --voxel 0.0001"), drop="--voxel 0.0001", slow=True,
    ),
    "a dense map of nothing certain": Advice(
        run_of_boards, r"use a larger (--sigma) \(([\d.e-]+)\)", r"\1 \2",
        command=("export", "--dense {}/a.ply --sigma 0.00001"), drop="--sigma 0.00001", slow=True,
    ),
    "near things": Advice(
        boards, r"(frontend.stereo.max_disparity_px) = 4 and are lost; raise it to (\d+)",
        r"--set \1=\2", command=("inspect", "--set frontend.stereo.max_disparity_px=4"), slow=True,
    ),
    "a lens that is not stated": Advice(
        unstated_lens, r"\((dataset.lens=\w+) states otherwise\)", r"--set \1", slow=True,
    ),
    "synthetic odometry of the lab": Advice(
        rendered(), r"set (odometry.kind) to (\w+) or constant_velocity", r"--set \1=\2",
        command=("run", "--out {}/o --set odometry.kind=synthetic"), slow=True,
    ),
    "noise of the lab's odometry": Advice(
        rendered(), r"their noise under (dataset.odometry); .* leave out its other keys",
        r"--set \1.noise=2",
        command=("run", "--out {}/o --set odometry.kind=recorded "
                 "--set odometry.speed_sigma_mps=0.2"),
        drop="--set odometry.speed_sigma_mps=0.2", slow=True,
    ),
    "a visit that a place has not": Advice(
        rendered(place="corridors", visit=2, drive={"path": "one_way"}),
        r"(dataset.visit) 2: .* corridors has (\d)",
        r"--set \1=\2", command=RUN, slow=True,
    ),
    "posters that a place has not": Advice(
        rendered(place="corridors"), r"means nothing in (dataset.place) .* hang in the (lab)",
        r"--set \1=\2", command=("run", "--out {}/o --set dataset.posters=identical"), slow=True,
    ),
    "a drive that a place has not": Advice(
        rendered(drive={"path": "one_way"}), r"(dataset.drive.path) one_way .* choose one of (\w+)",
        r"--set \1=\2", command=RUN, slow=True,
    ),
    "waypoints at one place": Advice(
        rendered(drive={"waypoints_m": [[0, 0]]}),
        r"add points to (dataset.drive.waypoints_m)", r"--set \1=[[-3,-2],[-2,-2.1]]", command=RUN,
        slow=True,
    ),
    "waypoints too sharp": Advice(
        rendered(drive={"waypoints_m": [[-1, 0], [1, 0], [-1, 0.01]]}),
        r"(dataset.drive.waypoints_m) turn back .* add points that lead around the turn",
        r"--set \1=[[-1,0],[0.5,-0.5],[1,0],[0.5,0.5],[-1,0.5]]", command=RUN, slow=True,
    ),
    "waypoints in a wall": Advice(
        rendered(drive={"waypoints_m": [[-1, 0], [-20, 0]]}),
        r"move the points of (dataset.drive.waypoints_m)", r"--set \1=[[-3,-2],[-2,-2.1]]",
        command=RUN, slow=True,
    ),
    "bursts of frames": Advice(
        rendered(drive={"path": "random_poses", "frames": 3, "random_poses": {"burst": 2}}),
        r"(dataset.drive.frames) is 3, no multiple of random_poses.burst 2", r"--set \1=4",
        command=RUN, slow=True,
    ),
    "a burst with no room": Advice(
        rendered(drive={"path": "random_poses", "random_poses": {"burst": 100}}),
        r"room for (dataset.drive.random_poses.burst) 100 .*; lower it", r"--set \1=2",
        command=RUN, slow=True,
    ),
    "a sweep of a recording with options": Advice(
        unstated_options, r"fgslam init \S+ with those options > x.yaml, and sweep x.yaml",
        mend=stated_options, command=("sweep", "--jobs 1 --set seed=1 --out {}/s"),
    ),
    "a route without a camera": Advice(
        taught, r"no camera is given; add (--camera) FILE", r"\1 {}/camera.yaml",
        command=("teach", "--out {}/n.fgpath --report {}/n"), slow=True,
    ),
    "panoramas that are cropped": Advice(
        taught, r"give (dataset.camera.top_\S+) and (dataset.camera.bottom_\S+)",
        r"--set \1=54 --set \2=-54 --overwrite",
        command=("teach", "--camera equirectangular --out {}/n.fgpath --report {}/n"), slow=True,
    ),
    "a route that holds no camera": Advice(
        route_of, r"give the recording's own, (--camera) FILE",
        r"\1 {}/camera.yaml", command=("follow", "{}/drive --out {}/f"), slow=True,
    ),
    "a route of another size": Advice(
        larger_views, r"give their own camera, (--camera) FILE", r"\1 {}/other.yaml",
        command=("follow", "{}/drive --out {}/f"), slow=True,
    ),
    "an estimator of a route": Advice(
        followed, r"without estimators; leave out --estimator",
        command=("film", "{}/a.mp4 --estimator ekf"), drop="--estimator ekf", slow=True,
    ),
    "a folder that taught nothing": Advice(
        followed, r"not a folder that fgslam teach wrote; give its --report", "--taught {}/t",
        command=("film", "{}/a.mp4 --taught {}/drive"), drop="--taught {}/drive", slow=True,
    ),
    "pictures that are no panoramas": Advice(
        round_pictures, r"the camera that took them, (--camera) FILE",
        r"\1 {}/mirror.yaml",
        command=("teach", "--camera equirectangular --out {}/n.fgpath --report {}/n"),
        drop="--camera equirectangular", slow=True,
    ),
    "covariances of one of two": Advice(
        two_estimates, r"judge them one by one",
        command=("judge", "{}/other.tum --covariance {}/none.txt --truth {}/truth.tum"),
        drop="{}/other.tum --covariance {}/none.txt",
    ),
    "covariances in degrees": Advice(
        in_degrees, r"state what they are: (--tangent \S+)", r"\1",
        command=("judge", "--truth {}/truth.tum --tangent rotation_first,local"),
        drop="--tangent rotation_first,local",
    ),
    "covariances in another order": Advice(
        different_parts, r"fits the errors far better; if so, (--tangent \S+)", r"\1",
        command=("judge", "--truth {}/truth.tum --tangent translation_first,local"),
        drop="--tangent translation_first,local",
    ),
    "covariances that are zero": Advice(
        without_covariances, r"or give them by (--covariance) FILE", r"\1 {}/covariances.txt",
        covariances_of, command=("judge", "--truth {}/truth.tum"),
    ),
    "wheels of a camera that looks aside": Advice(
        lambda root: passing(root, wheels),
        r"are (90) degrees off .* or (dataset.camera_yaw_deg)\)", r"--set \2=\1 --overwrite",
        command=RUN, slow=True,
    ),
    "wheels that are late": Advice(
        lambda root: passing(
            root,
            lambda k: 10.0 * (leap(k - 3) - leap(k - 4)),
            lambda k: pair_of(list(SCENE), leap(k), 0.0),
        ),
        r"by no factor that stays .* its clock \((odometry.time_offset_s)\)",
        r"--set \1=-0.3 --overwrite",
        command=("run", "--out {}/o --set dataset.camera_yaw_deg=90"), slow=True,
    ),
    "frozen cameras": Advice(
        lambda root: passing(
            root, lambda k: 2.0, lambda k: pair_of(list(SCENE), 0.2 * min(k, 5), 0.0)
        ),
        r"are not used; their poses are predicted \(mend the camera; (--set \S+) uses them all",
        r"\1 --overwrite", command=("run", "--out {}/o --set dataset.camera_yaw_deg=90"), slow=True,
    ),
    "images that are swapped underway": Advice(
        lambda root: passing(root, wheels, swapped),
        r"are predicted \(swap their images; (--set \S+) uses them all", r"\1 --overwrite",
        command=("run", "--out {}/o --set dataset.camera_yaw_deg=90"), slow=True,
    ),
    "old images of one camera": Advice(
        lambda root: passing(root, wheels, late_image),
        r"begin no landmark \(mend the camera; (--set \S+) uses them all", r"\1 --overwrite",
        command=("run", "--out {}/o --set dataset.camera_yaw_deg=90"), slow=True,
    ),
    "frames that are there twice": Advice(
        lambda root: passing(root, None, lambda k: pair_of(list(SCENE), way(k // 2), 0.0)),
        r"the recording has frames twice, .* \(leave them out: (--stride)\)",
        r"\1 2 --overwrite", command=RUN, slow=True,
    ),
    "something large that passes": Advice(
        lambda root: passing(root, None, board_passes, 6),
        r"what passes \(leave these frames out: --start, (--stop)\)", r"\1 2 --overwrite",
        command=RUN, slow=True,
    ),
    "a corrected calibration": Advice(
        boards, r"the calibration, corrected; use it by (--camera \S+)",
        r"fgslam run {0}/boards \1 --out {0}/n",
        command=("run", "--out {}/o --camera-out {}/a.json"), slow=True,
    ),
    "no screen": Advice(
        of_images(odometry={"kind": "constant_velocity"}), r"use (--save-rrd) FILE(.rrd)",
        r"\1 {}/a\2", command=("run", "--out {}/o --live"), drop="--live", where=without_screen,
    ),
    "no scheduler": Advice(
        experiment, r"no Dask scheduler answers .* start one by `dask scheduler`",
        "--scheduler {}/scheduler.json", begin_scheduler,
        ("sweep", "--out {}/s --set seed=1 --scheduler tcp://127.0.0.1:9"),
        "--scheduler tcp://127.0.0.1:9", slow=True,
    ),
    "voxels of no size": Advice(
        run_of_boards, r"--voxel is -1; give metres above 0, or leave it out",
        command=("export", "--dense {}/a.ply --voxel -1"), drop="--voxel -1", slow=True,
    ),
    "no frame of so many": Advice(
        run_of_boards, r"--every is 0; give (1) for all frames", r"--every \1",
        command=("export", "--dense {}/a.ply --every 0"), drop="--every 0", slow=True,
    ),
    "poses of a body": Advice(
        run_of_bag, r"on a body; give (--frame left)", r"\1",
        command=("export", "--trajectory {}/a.tum --frame body"), drop="--frame body",
    ),
    "poses of a body for a route": Advice(
        body_run, r"give a camera's, by fgslam export RUN (--frame) (right)",
        "--poses {}/p/right.tum",
        lambda root: main(pytest.MonkeyPatch(), "export", root / "o", "--frame", "right",
                          "--trajectory", root / "p" / "right.tum"),
        ("teach", "--camera {}/camera.yaml --out {}/n.fgpath --report {}/n --poses {}/p/body.tum"),
        "--poses {}/p/body.tum", slow=True,
    ),
    "a map that has changed": Advice(
        entered(lambda entry: entry.update(sha256="x")),
        r"has changed since the run began; .* run again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume", slow=True,
    ),
    "a run that does not state its map": Advice(
        entered(lambda entry: entry.pop("file")),
        r"does not say how the run entered its map .* run again with (--overwrite)", r"\1",
        command=("run", "--out {}/o --resume"), drop="--resume", slow=True,
    ),
    "a map without a last pose": Advice(
        without_trajectory, r"knows no last pose; use (map.start) (relocalise)", r"--set \1=\2",
        command=("run", "--out {}/o --map-in {}/m.fgmap --set map.start=last"),
        drop="--set map.start=last", slow=True,
    ),
    "a log that begins in a map": Advice(
        lambda root: (entered(lambda entry: None)(root), program_of(
            "fg.replay(fg.MeasurementLog.load('{}/o/measurements.npz'), 'landmark_kalman')")(root),
        )[1],
        r"fgslam run with map.load, then (fgslam compare) RUN",
        r"\1 {}/o --estimators landmark_kalman", command=("python", ""), slow=True,
    ),
    "a map of several cameras": Advice(
        two_cameras, r"give the image's: camera=fgslam.load_camera", mend=asking(
            ", camera=fg.load_camera('{}/camera.yaml', size=(301, 91))"
        ), command=("python", ""), slow=True,
    ),
    "results of another program": Advice(
        foreign_units, r"not a unit that this fgslam wrote .* start again with (--overwrite)",
        r"\1", command=("run", "--out {}/o --resume"), drop="--resume",
    ),
    "panoramas that are smaller": Advice(
        views_of_pairs, r"(dataset.width) is 999 .* have only (\d+) columns; give a smaller width",
        r"--set \1=\2", command=RUN, slow=True,
    ),
    "errors of no mirror": Advice(
        of_mirror_errors, r"but (dataset.camera.model) is \w+; take (mirror)", r"--set \1=\2",
        command=RUN, slow=True,
    ),
    "a mirror aside of its place": Advice(
        mirror_aside, r"off its stated centre .* rim's is \((\S+), (\S+)\); .* correct (\S+) or",
        r"--set \3.centre=[\1,\2] --overwrite",
        command=("teach", "--camera {}/mirror.yaml --out {}/n.fgpath --report {}/n"), slow=True,
    ),
    "where a lens looks": Advice(
        lens_pictures, r"taken to look down, .* \(--set (dataset.camera.middle=up)",
        r"--set \1 --overwrite",
        command=("teach", "--camera {}/lens.yaml --out {}/n.fgpath --report {}/n"),
        slow=True,
    ),
    "a route that was interrupted": Advice(
        taught, r"go on: the same command with (--overwrite)", r"\1",
        command=("teach", "--camera {}/camera.yaml --out {}/n.fgpath --report {}/n"), slow=True,
        where=stopped_at_once,
    ),
    "a scene that is far": Advice(
        boards, r"min_disparity_px = 3: the scene is far .*; use larger images",
        command=("inspect", "--set frontend.stereo.min_disparity_px=3 --set dataset.scale=0.5"),
        drop="--set dataset.scale=0.5", slow=True,
    ),
    "a map that is cut off": Advice(
        cut_map, r"is no landmark map, or cut off; run the experiment again with (--overwrite)",
        r"fgslam run {0}/o/config.yaml --out {0}/o \1", command=("export", "--map {}/a.ply"),
    ),
    "recordings that are made here": Advice(
        lambda root: root / "house", r"next: (fgslam teach .* --out) home.fgpath",
        r"\1 {0}/r.fgpath --report {0}/t", command=("data house --out", ""), slow=True,
    ),
    "recordings that are made elsewhere": Advice(
        lambda root: (kitti(root), root)[1], r"(fgslam run) DIR (--set '\S+')",
        r"\1 {0} \2 --out {0}/o", command=("data kitti_odometry --out", ""), slow=True,
    ),
}  # fmt: skip
