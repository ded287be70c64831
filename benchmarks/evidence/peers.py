"""Beside other programs: the same images, no odometry, no setting; error, frames located, cost."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import fgslam as fg
from benchmarks.evidence import front_ends, peer
from benchmarks.evidence.front_ends import Change, blurred, grey_of, noisy
from benchmarks.evidence.vocabulary import train_vocabulary
from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.core.arrays import Image
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.core.types import Trajectory
from fgslam.datasets.folders import write_image_folder, write_poses
from fgslam.datasets.recording import TRUTH_LEFT
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory

RECORDINGS = (
    "kitti06", "kitti_raw_0926_5hz", "euroc_v101_kf100", "euroc_v101_raw",
)  # fmt: skip
"""Folders with a truth, of pairs."""
RAW, SPOILT = "kitti_raw_0926_5hz", ("kitti06", "euroc_v101_kf100")
PIECES, PIECE = tuple(range(0, 200, 40)), 40
"""First frames of the pieces of :data:`RAW`, and how many each has."""
_TURNS = 2
EXIT_OF_FAULTS = 3
"""What `fgslam run` ends with where measurements contradict each other."""
_ALONE = ("--set", "odometry.kind=constant_velocity")


@dataclass(frozen=True)
class Course(front_ends.Course):
    """The same with frames that are left out, and images that are made smaller."""

    gap: range = range(0)
    scale: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a program did with a recording.

    Attributes:
        live: ATE of the poses given at each frame (m, SE(3) aligned).
        end: of the last estimate; NaN where the program has none.
        located: frames with a pose.
        nees: of the last poses, a degree of freedom; NaN where no covariance is stated.
        scale: of the estimate against the truth.
        cpu_s: of the whole process; loop_s: from image to pose.
        memory_mb: the largest that it held.
    """

    live: float
    end: float
    nees: float
    located: int
    scale: float
    cpu_s: float
    loop_s: float
    memory_mb: float


def tables(data: Path, only: Path | None = None) -> Iterator[Table]:
    """Of all recordings at hand, or of one."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed program has its bytecode
    vocabulary = _vocabulary(data)
    programs = dict(PROGRAMS)
    if vocabulary is None:
        del programs["ORB-SLAM3"]
        say("without ORB-SLAM3: pip install -e '.[peers]'")
    else:
        os.environ[peer.VOCABULARY] = str(vocabulary)
    rows: list[tuple[Cell, ...]] = []
    for course in [Course(only.name, str(only))] if only else list(_courses(data)):
        with tempfile.TemporaryDirectory() as folder:
            rows += _rows(course, programs, Path(folder))
    columns = ("recording", "program", *_COLUMNS)
    yield Table(
        "Beside other programs", columns, rows,
        ("ATE in m after SE(3) alignment, no odometry, no setting; scale of the estimate; CPU in s "
         "of all threads, the lesser of two turns (of fgslam the command with all that it writes; "
         "the loop through the library); memory in MB",),
    )  # fmt: skip


_COLUMNS = (
    "ATE live", "ATE end", "NEES", "located", "scale", "CPU", "CPU of the loop",
    "CPU / ORB-SLAM3's", "memory",
)  # fmt: skip


def _courses(data: Path) -> Iterator[Course]:
    for name in RECORDINGS:
        if (data / name).is_dir():
            yield Course(name, str(data / name))
    if (data / RAW).is_dir():
        for first in PIECES:
            frames = slice(first, first + PIECE)
            yield Course(f"{RAW}, frames {first}-{first + PIECE - 1}", str(data / RAW), frames)
    for name in SPOILT:
        if (data / name).is_dir():
            yield from _spoilt(name, str(data / name))


def _spoilt(name: str, folder: str) -> Iterator[Course]:
    """The same drive with its images made worse, or with fewer of them."""
    for stride, nth in ((2, "second"), (3, "third")):
        yield Course(f"{name}, each {nth} frame", folder, slice(None, None, stride))
    yield Course(f"{name}, gap of ten frames", folder, gap=range(20, 30))
    yield Course(f"{name}, 5 % of the frames missing", folder, gap=range(7, 1000, 20))
    yield Course(f"{name}, half the size", folder, scale=0.5)
    for what, change in CHANGES.items():
        yield Course(f"{name}, {what}", folder, change=change)


def _brightness(image: Image, rng: np.random.Generator) -> Image:
    return np.asarray(np.clip(image * rng.uniform(0.5, 1.5), 0, 255), np.uint8)


def _compressed(image: Image, rng: np.random.Generator) -> Image:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


CHANGES: dict[str, Change] = {
    "brightness jumps": _brightness,
    "blur of 2 px": blurred,
    "JPEG at 40": _compressed,
    "noise of 10 grey levels": noisy(10.0),
}


def _rows(course: Course, programs: dict[str, Program], folder: Path) -> Iterator[tuple[Cell, ...]]:
    truth, count = _write_images(course, folder)
    found: dict[str, Outcome] = {}
    for turn in range(_TURNS):
        for name, program in programs.items():
            say(f"{course.name}: {name}, turn {turn + 1}")
            once = program(folder, truth)
            if name not in found or once.cpu_s < found[name].cpu_s:
                found[name] = once
    base = found["ORB-SLAM3"].cpu_s if "ORB-SLAM3" in found else np.nan
    for name, one in found.items():
        located = f"{one.located} of {count}"
        yield (
            course.name, name, one.live, one.end, one.nees, located, one.scale, one.cpu_s,
            one.loop_s, one.cpu_s / base, round(one.memory_mb),
        )  # fmt: skip


def _write_images(course: Course, folder: Path) -> tuple[Trajectory, int]:
    """Rectified grey pairs, a recording that every program reads; the truth of the left camera."""
    recording = fg.open_recording(course.folder)
    rig, truth = recording.rig, recording.ground_truth
    if truth is None:
        raise fg.DatasetError(f"{course.folder}: no truth to judge programs by")
    rng, scale = np.random.default_rng(7), course.scale
    size = (round(scale * rig.width), round(scale * rig.height))
    sx, sy = size[0] / rig.width, size[1] / rig.height
    smaller = replace(
        rig, width=size[0], height=size[1], fx=sx * rig.fx, fy=sy * rig.fy,
        cx=sx * (rig.cx + 0.5) - 0.5, cy=sy * (rig.cy + 0.5) - 0.5, vertical_baseline=None,
        bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    )  # fmt: skip

    def shown(image: Image) -> Image:
        grey = np.asarray(cv2.resize(grey_of(image), size, interpolation=cv2.INTER_AREA), np.uint8)
        return grey if course.change is None else course.change(grey, rng)

    frames = course.frames
    chosen = enumerate(itertools.islice(recording, frames.start, frames.stop, frames.step))
    shots = [
        (t, [shown(image) for image in images[:2]][::-1])  # left is seen first, right is written so
        for k, (t, images, _) in chosen
        if images is not None and k not in course.gap
    ]
    write_image_folder(folder, smaller, shots)
    left = truth.of("left", rig)
    write_poses(folder / TRUTH_LEFT, left)
    return left, len(shots)


Program = Callable[[Path, Trajectory], Outcome]


def _fgslam(estimator: str) -> Program:
    """The command with everything that it writes by default."""

    def run(folder: Path, truth: Trajectory) -> Outcome:
        out = folder / "run"
        cpu = _spent([
            "-m", "fgslam", "run", str(folder), "--estimator", estimator, *_ALONE,
            "--rig-memory", "off", "--out", str(out), "--overwrite",
        ])  # fmt: skip
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        located = metrics["located"]["frames"]
        title = next(iter(metrics["estimators"]))
        own = metrics["estimators"][title]
        nees, memory = own["nees_pose_per_dof"] or np.nan, own["peak_memory_mb"]
        live, _ = _error(out / title / "online.tum", truth)
        end, scale = _error(out / title / "final.tum", truth)
        _spent(["-m", "benchmarks.evidence.peer", estimator, str(folder)])
        return Outcome(live, end, nees, located, scale, cpu, _loop(folder)["loop_s"], memory)

    return run


def _other(method: str) -> Program:
    def run(folder: Path, truth: Trajectory) -> Outcome:
        try:
            cpu = _spent(["-m", "benchmarks.evidence.peer", method, str(folder)])
        except RuntimeError as error:  # as ORB-SLAM3 on small images
            say(str(error))
            nan = float("nan")
            return Outcome(nan, nan, nan, 0, nan, nan, nan, 0.0)
        told = _loop(folder)
        live, scale = _error(folder / "live.tum", truth)
        end = np.nan
        if method == "orb_slam3":
            end, scale = _error(folder / "end.tum", truth)
        return Outcome(
            live, end, np.nan, told["located"], scale, cpu, told["loop_s"], told["memory_mb"]
        )

    return run


PROGRAMS: dict[str, Program] = {
    "fgslam": _fgslam(DEFAULT_ESTIMATOR),
    "fgslam, iSAM2": _fgslam("isam2"),
    "fgslam, Kalman": _fgslam("landmark_kalman"),
    "ORB-SLAM3": _other("orb_slam3"),
    "SIFT and PnP": _other("sift_pnp"),
    "KLT and PnP": _other("klt_pnp"),
}


def _error(path: Path, truth: Trajectory) -> tuple[float, float]:
    """ATE (m) after SE(3) alignment, and the scale of the estimate; NaN where it has no poses."""
    if len(path.read_text(encoding="utf-8").split("\n")) < 4:
        return np.nan, np.nan
    found = Trajectory.load(path)
    error = evaluate_trajectory(found, truth, Alignment.SE3).ate_rmse_m
    nearest = np.abs(found.timestamps[:, None] - truth.timestamps).argmin(axis=1)
    a, b = (
        each - each.mean(axis=0) for each in (found.poses[:, :3, 3], truth.poses[nearest, :3, 3])
    )
    scale = np.linalg.svd(b.T @ a, compute_uv=False).sum() / (b * b).sum()  # Umeyama 1991, inverse
    return (np.nan if error is None else error), float(scale)


def _loop(folder: Path) -> dict[str, Any]:
    """What a process wrote of its loop."""
    told: dict[str, Any] = json.loads((folder / "loop.json").read_text(encoding="utf-8"))
    return told


def _spent(arguments: Sequence[str]) -> float:
    """CPU seconds of a Python process.

    Raises:
        RuntimeError: it did not end well; with the end of what it printed.
    """
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen(  # noqa: S603 - this interpreter and constant arguments
            [sys.executable, *arguments], stdout=told, stderr=told
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        told.seek(0)
        if process.returncode not in (0, EXIT_OF_FAULTS):
            raise RuntimeError(f"{' '.join(arguments)}: {told.read()[-500:]}")
    return usage.ru_utime + usage.ru_stime


def _vocabulary(data: Path) -> Path | None:
    """ORB-SLAM3's vocabulary, trained once; None where the program is not installed."""
    if importlib.util.find_spec("pyorbslam3") is None:
        return None
    given = os.environ.get("PYORBSLAM3_VOCAB")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    path = Path(given) if given else cache / "fgslam" / "orb_vocabulary.txt"
    if not path.is_file():
        files = sorted(f for name in RECORDINGS for f in (data / name).rglob("*.png"))
        train_vocabulary((np.asarray(cv2.imread(str(f), 0), np.uint8) for f in files), path)
    return path
