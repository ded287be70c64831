"""Damaged and odd inputs by the thousand: `make fuzz`, or `python -m scripts.fuzz --help`.

Each case is made from a seed and handed to what reads such an input. It has to be read, or refused
by one line. Counted as faults: other exceptions, more than ten seconds, more than two gigabytes, a
refusal of several lines, and bytes that were changed and read as other values without a word.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when it is imported

import cv2

import fgslam as fg
from fgslam.core.array_files import write_arrays
from fgslam.core.errors import FgslamError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Observations, Odometry
from fgslam.core.sensors import CameraRig
from fgslam.core.trajectories import Trajectory
from fgslam.datasets.image_folder import open_image_folder
from fgslam.datasets.images import read_grey_image
from fgslam.datasets.settings import ImageFolderSettings
from fgslam.runs.config import load_experiment
from fgslam.runs.named_experiments import experiment_names, experiments_folder

HANGS_AFTER_S = 10
MOST_MB = 2000.0
_LONGEST = 1600
Rng = np.random.Generator

ODD = (
    "", "~", "-1", "0", "1e999", "-.inf", ".nan", "9" * 30, "9" * 5000, "0x", "0b_", "!!int x",
    "2020-99-99", "[]", "{}", "[[[[]]]]", "{a: {b: c}}", "'", '"', "\0", "\x1b[31m", "\ud800",
    "true", "no", "*x", "&x [*x]", "<<: 1", "x" * 5000, "../../etc", "/dev/zero", "é", "\u202e",
    "1:60:70", "!!python/object:os.system x", "---", "...", "? x", "- -", "\t", "%YAML 9", "1_0",
)  # fmt: skip
"""Texts that configurations, calibrations and tables stumble over."""


@dataclass(frozen=True)
class Kind:
    """A sort of input.

    Attributes:
        name: as for --kind.
        make: writes one case into a folder; where it is.
        read: what reads it.
        same: whether what was read equals the undamaged original; None where it need not.
    """

    name: str
    make: Callable[[Rng, Path], Any]
    read: Callable[[Any], Any]
    same: Callable[[Any], bool] | None = None


class Hang(BaseException):
    """A case took too long."""


# --------------------------------------------------------------------------------------------
# Damage


def damaged_text(rng: Rng, text: str) -> str:
    """A text with one to three changes of lines, values or characters."""
    lines = text.splitlines() or [""]
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        odd = ODD[rng.integers(len(ODD))]
        head, colon, _ = lines[at].partition(":")
        choice = rng.integers(6)
        if choice == 0:
            lines[at] = f"{head}{colon} {odd}" if colon else odd
        elif choice == 1:
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        elif choice == 2 and len(lines) > 1:
            del lines[at]
        elif choice == 3:
            lines[at] = lines[at][: rng.integers(len(lines[at]) + 1)]
        elif choice == 4:
            lines[at] = f"{odd}{colon}{lines[at]}"
        else:
            words = lines[at].split(" ")
            words[int(rng.integers(len(words)))] = odd
            lines[at] = " ".join(words)
    return "\n".join(lines) + "\n"


def damaged_bytes(rng: Rng, data: bytes) -> bytes:
    """Bytes cut off, flipped, doubled, or with others put in."""
    at, more = (int(k) for k in np.sort(rng.integers(0, len(data) + 1, 2)))
    choice = rng.integers(4)
    if choice == 0:
        return data[:at]
    if choice == 1:
        return data[:at] + rng.bytes(int(rng.integers(1, 9))) + data[at:]
    if choice == 2:
        return data[:at] + data[more:]
    flipped = bytearray(data)
    for place in rng.integers(0, len(data), rng.integers(1, 4)):
        flipped[place] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def written(path: Path, content: str | bytes) -> Path:
    """The path, with this content."""
    data = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    path.write_bytes(data)
    return path


# --------------------------------------------------------------------------------------------
# Kinds of input


def configuration(rng: Rng, folder: Path) -> Path:
    """An experiment of the package, damaged."""
    names = experiment_names()
    text = (experiments_folder() / f"{names[rng.integers(len(names))]}.yaml").read_text("utf-8")
    if rng.random() < 0.1:
        return written(folder / "c.yaml", damaged_bytes(rng, text.encode()))
    return written(folder / "c.yaml", damaged_text(rng, text))


def override(rng: Rng, _: Path) -> tuple[Path, list[str]]:
    """An experiment of the package and an odd override of one of its keys."""
    keys = ("seed", "name", "dataset.stop", "dataset", "odometry.kind", "frontend.sift", "x.y", "")
    texts = [f"{keys[rng.integers(len(keys))]}={ODD[rng.integers(len(ODD))]}" for _ in range(2)]
    names = experiment_names()
    return experiments_folder() / f"{names[rng.integers(len(names))]}.yaml", texts


_CALIBRATIONS = (
    json.dumps(
        {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 159.5, "cy": 119.5,
         "baseline_m": 0.1}, indent=1),
    "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 200., 0., 160., 0., 200., 120., 0., 0., 1. ]\nD1: !!opencv-matrix\n   rows: 1\n"
    "   cols: 5\n   dt: d\n   data: [ 0., 0., 0., 0., 0. ]\n",
    "cam0:\n  camera_model: pinhole\n  intrinsics: [200.0, 200.0, 160.0, 120.0]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n"
    "  resolution: [320, 240]\ncam1:\n  camera_model: pinhole\n"
    "  intrinsics: [200.0, 200.0, 160.0, 120.0]\n  distortion_model: radtan\n"
    "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [320, 240]\n"
    "  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n"
    "  - [0.0, 0.0, 1.0, 0.0]\n  - [0.0, 0.0, 0.0, 1.0]\n",
)  # fmt: skip


def calibration(rng: Rng, folder: Path) -> Path:
    """A rig's file of one of several tools, damaged."""
    k = int(rng.integers(len(_CALIBRATIONS)))
    path = folder / ("calib.json" if k == 0 else "calib.yaml")
    return written(path, damaged_text(rng, _CALIBRATIONS[k]))


def a_log() -> MeasurementLog:
    """A small measurement log."""
    rng = np.random.default_rng(3)
    rig = CameraRig(320, 240, 200.0, 200.0, 159.5, 119.5, 0.1, None, np.eye(4))
    log = MeasurementLog(rig, {"kind": "recorded"})
    for k in range(4):
        seen = Observations(
            np.arange(10 * k, 10 * k + 5),
            rng.uniform(1.0, 100.0, (5, 3)),
            np.tile(np.eye(3), (5, 1, 1)),
            np.full((5, 3, 2), np.nan),
            np.ones(5, bool),
        )
        empty = np.zeros(0, np.int64)
        odometry = Odometry(np.eye(4), np.eye(6)) if k else None
        log.append(Increment(k, 0.1 * k, odometry, seen, np.zeros(5, bool), empty, empty))
    return log


_LOG = {name: array.tobytes() for name, array in a_log().to_arrays().items()}


def log_of_damaged_bytes(rng: Rng, folder: Path) -> Path:
    """A measurement log with some bytes changed."""
    a_log().save(folder / "log.npz")
    return written(folder / "log.npz", damaged_bytes(rng, (folder / "log.npz").read_bytes()))


def same_log(log: MeasurementLog) -> bool:
    """Whether a log is the undamaged one to the bit."""
    return {name: array.tobytes() for name, array in log.to_arrays().items()} == _LOG


def log_of_odd_values(rng: Rng, folder: Path) -> Path:
    """A whole archive with one array changed in type, shape or value."""
    arrays = a_log().to_arrays()
    name = list(arrays)[int(rng.integers(len(arrays)))]
    array = arrays[name]
    if array.dtype.kind in "fi" and array.size and rng.random() < 0.6:
        flat = array.copy().reshape(-1)
        odd = (0, -1, 2**31) if array.dtype.kind == "i" else (np.nan, np.inf, -1e300, 1e-300, -1.0)
        flat[rng.integers(flat.size)] = odd[rng.integers(len(odd))]
        arrays[name] = flat.reshape(array.shape)
    elif rng.random() < 0.5:
        arrays[name] = (
            array.astype("U" if rng.random() < 0.5 else "c16", copy=True)
            if (array.dtype.kind in "fib")
            else np.array("{" * int(rng.integers(1, 3000)))
        )
    else:
        arrays[name] = array.reshape(-1)[: rng.integers(array.size + 1)]
    write_arrays(folder / "log.npz", arrays)
    return folder / "log.npz"


def trajectory(rng: Rng, folder: Path) -> Path:
    """A TUM file, damaged."""
    text = "".join(f"{k}.0 {k} 0 0 0 0 0 1\n" for k in range(5))
    return written(folder / "a.tum", damaged_text(rng, text))


def _picture() -> np.ndarray[Any, Any]:
    return np.add.outer(np.arange(30), np.arange(40)).astype(np.uint8)


def image(rng: Rng, folder: Path) -> Path:
    """An image file, damaged."""
    suffix = (".png", ".jpg", ".bmp", ".tif", ".pgm")[rng.integers(5)]
    data = bytes(cv2.imencode(suffix, _picture())[1])
    return written(folder / f"a{suffix}", damaged_bytes(rng, data))


def png(rng: Rng, folder: Path) -> Path:
    """A PNG, whose chunks have checksums, damaged."""
    return written(folder / "a.png", damaged_bytes(rng, bytes(cv2.imencode(".png", _picture())[1])))


def recording(rng: Rng, folder: Path) -> Path:
    """A folder of images of which one file is damaged or gone."""
    for side in ("left", "right"):
        (folder / side).mkdir(exist_ok=True)
        for k in range(3):
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), _picture())
    written(folder / "times.txt", "".join(f"{k:06d} {k}.0\n" for k in range(3)))
    values = json.loads(_CALIBRATIONS[0]) | {"width": 40, "height": 30, "cx": 20.0, "cy": 15.0}
    written(folder / "calib.json", json.dumps(values, indent=1))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[int(rng.integers(len(files)))]
    if rng.random() < 0.2:
        path.unlink()
    elif path.suffix in (".txt", ".json"):
        written(path, damaged_text(rng, path.read_text("utf-8")))
    else:
        written(path, damaged_bytes(rng, path.read_bytes()))
    return folder


def read_recording(folder: Path) -> None:
    """All frames of a folder; those that cannot be read are refused one by one."""
    sequence = open_image_folder(ImageFolderSettings(path=str(folder)))
    for i in range(len(sequence)):
        try:
            sequence.frame(i)
        except FgslamError as error:
            _require_one_line(error)


def call(rng: Rng, _: Path) -> tuple[str, Any]:
    """A call of the library with an odd argument."""
    odd: tuple[Any, ...] = (
        None, "x", -1, 0, 1.5, np.nan, np.inf, 10**30, [], {}, np.zeros(3), np.full((4, 4), np.nan),
        np.zeros((240, 320), np.uint8), np.zeros((0, 0), np.uint8), np.zeros((240, 320, 7)), b"x",
        object(), True, (1, 2, 3), "x" * 5000,
    )  # fmt: skip
    return ("t", "images", "odometry", "fx", "estimator")[rng.integers(5)], odd[
        rng.integers(len(odd))
    ]


def read_call(given: tuple[str, Any]) -> None:
    """One frame of a session with the odd argument in place of the right one."""
    name, value = given
    values: dict[str, Any] = {
        "t": 0.0, "images": [np.zeros((240, 320), np.uint8)] * 2, "odometry": None, "fx": 200.0,
        "estimator": "landmark_kalman",
    } | {name: value}  # fmt: skip
    rig = fg.StereoRig(
        width=320, height=240, fx=values["fx"], fy=200.0, cx=159.5, cy=119.5, baseline=0.1
    )
    slam = fg.Slam(rig, estimator=values["estimator"])
    slam.track(values["t"], values["images"], values["odometry"])


KINDS = (
    Kind("configuration", configuration, load_experiment),
    Kind("override", override, lambda given: load_experiment(*given)),
    Kind("calibration", calibration, lambda path: fg.load_rig(path)),
    Kind("log_bytes", log_of_damaged_bytes, MeasurementLog.load, same_log),
    Kind("log_values", log_of_odd_values, MeasurementLog.load),
    Kind("trajectory", trajectory, Trajectory.load),
    Kind("image", image, read_grey_image),
    Kind("png", png, read_grey_image, lambda found: np.array_equal(found, _picture())),
    Kind("recording", recording, read_recording),
    Kind("call", call, read_call),
)

# --------------------------------------------------------------------------------------------
# Trying them


def _require_one_line(error: FgslamError) -> None:
    message = str(error)
    if "\n" in message or len(message) > _LONGEST or not message:
        raise AssertionError(f"no single short line: {message[:200]!r}")


@contextmanager
def _time_limit() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(HANGS_AFTER_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(kind: Kind, seed: int) -> str:
    """What became of one case: `read`, `refused`, or a fault in words."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    with tempfile.TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        given = kind.make(rng, Path(scratch))
        try:
            with _time_limit():
                found = kind.read(given)
        except FgslamError as error:
            try:
                _require_one_line(error)
            except AssertionError as wrong:
                return str(wrong)
            return "refused"
        except Hang:
            return f"more than {HANGS_AFTER_S} s"
        except Exception as error:
            return f"{type(error).__name__}: {str(error)[:150]}"
        if kind.same is not None and not kind.same(found):
            return "other values without a word"
    return "read"


def faults(kind: Kind, seeds: range) -> tuple[Counter[str], list[str]]:
    """How many cases were read and refused, and a line for each fault."""
    counts: Counter[str] = Counter()
    lines = []
    for seed in seeds:
        how = outcome(kind, seed)
        counts[how if how in ("read", "refused") else "fault"] += 1
        if how not in ("read", "refused"):
            lines.append(f"{kind.name} {seed}: {how}")
    return counts, lines


def main() -> None:
    """Tries cases of each kind; exits with 1 where there is a fault."""
    parser = argparse.ArgumentParser(description="damaged and odd inputs by the thousand")
    parser.add_argument("--cases", type=int, default=200, help="of each kind")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case")
    parser.add_argument("--kind", choices=[kind.name for kind in KINDS], help="default: all")
    given = parser.parse_args()
    wrong: list[str] = []
    for kind in KINDS:
        if given.kind not in (None, kind.name):
            continue
        began = time.monotonic()
        counts, lines = faults(kind, range(given.seed, given.seed + given.cases))
        wrong += lines
        print(f"{kind.name:14} {dict(counts)} in {time.monotonic() - began:.0f} s", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(*wrong, f"{len(wrong)} faults, {peak:.0f} MB at most", sep="\n")
    sys.exit(bool(wrong) or peak > MOST_MB)


if __name__ == "__main__":
    main()
