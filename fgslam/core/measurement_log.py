"""The measurement log: everything that estimators consume, replayable without images.

One uncompressed ``.npz`` of plain arrays (no pickle). Ragged rows are stored flat with offsets:
rows of frame ``k`` are ``start[k]:start[k + 1]``.

A log without loop closures and relocalised frames is written as version 2, to the same bytes as
before there were any; one that has them is version 3. All three versions are read.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.measurements import Increment, LoopClosure, Observations, Odometry
from fgslam.core.sensors import CameraRig, RangeBearingSensor, Sensor

FORMAT = "fgslam measurement log"
VERSION = 3
_READABLE = (1, 2, 3)
"""Version 1 knew cameras only; version 2 no loops."""
_UPPER = np.triu_indices(3)
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    NotImplementedError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What NumPy and zipfile raise on truncated, damaged and foreign files."""

# Arrays by the count that their first axis has, with type and the shape of an item.
_PER_FRAME: dict[str, tuple[str, tuple[int, ...]]] = {
    "frame_index": ("i", ()),
    "timestamp": ("f", ()),
    "odometry_motion": ("f", (4, 4)),
    "odometry_covariance": ("f", (6, 6)),
}
_PER_OBSERVATION: dict[str, tuple[str, tuple[int, ...]]] = {
    "observation_id": ("i", ()),
    "measurement": ("f", (3,)),
    "measurement_covariance": ("f", (6,)),
    "pixels": ("f", (3, 2)),
    "is_new": ("b", ()),
    "rejected": ("b", ()),
}
_LOOPS = "loop_"  # before the names of the arrays of the loops' own observations
_PER_LOOP: dict[str, tuple[str, tuple[int, ...]]] = {
    "loop_frame": ("i", ()),
    "loop_oTc": ("f", (4, 4)),
    "loop_covariance": ("f", (6, 6)),
}
_RIG = ("width", "height", "fx", "fy", "cx", "cy", "baseline", "vertical_baseline")
_SENSOR_KEYS = {"stereo": _RIG, "range_bearing": ("max_range_m",)}


@dataclass(slots=True, eq=False)
class MeasurementLog:
    """Measurements of a run, frame by frame.

    Attributes:
        rig: the cameras, or the range-bearing sensor; with the lever arm.
        motion_model: how odometry came about, and the stand-in's numbers where there was none
            (plain JSON values): replays need it to predict as the live run did.
        increments: one a frame, time increasing.
    """

    rig: Sensor
    motion_model: dict[str, Any]
    increments: list[Increment] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.increments)

    def __iter__(self) -> Iterator[Increment]:
        return iter(self.increments)

    def append(self, increment: Increment) -> None:
        """Adds one frame without a motion model's stand-in: a replay derives its own.

        Raises MeasurementLogError where its time does not come after the last one's.
        """
        if self.increments and not increment.timestamp > self.increments[-1].timestamp:
            raise MeasurementLogError(
                f"frame {increment.index}: time stamp {increment.timestamp:.9f} s does not come "
                f"after {self.increments[-1].timestamp:.9f} s; sort the measurements by time"
            )
        odometry = increment.odometry
        if odometry is not None and not odometry.measured:
            increment = dataclasses.replace(increment, odometry=None)
        self.increments.append(increment)

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        kind = "stereo" if isinstance(self.rig, CameraRig) else "range_bearing"
        sensor = {"kind": kind} | {name: getattr(self.rig, name) for name in _SENSOR_KEYS[kind]}
        version = VERSION if self._has_loops() else 2
        header = {"format": FORMAT, "version": version, "sensor": sensor}
        header["motion"] = self.motion_model
        out: StateArrays = {
            "header": np.array(json.dumps(header, sort_keys=True)),
            "rig_bTc": self.rig.bTc,
            "frame_index": np.array([s.index for s in self], np.int64),
            "timestamp": np.array([s.timestamp for s in self], np.float64),
            "odometry_motion": _stack([_motion(s) for s in self], (4, 4)),
            "odometry_covariance": _stack([_motion_covariance(s) for s in self], (6, 6)),
        }
        out |= _ragged("missed", [s.missed_ids for s in self])
        out |= _ragged("pruned", [s.pruned_ids for s in self])
        out |= _observation_arrays([s.observations for s in self], "")
        out["rejected"] = _concatenate([s.rejected for s in self], (), np.bool_)
        return out | (self._loop_arrays() if version == VERSION else {})

    def _has_loops(self) -> bool:
        """Whether anything is there that version 2 had no place for."""
        return any(s.loops or s.relocalised for s in self)

    def _loop_arrays(self) -> StateArrays:
        loops = [loop for s in self for loop in s.loops]
        return {
            "relocalised": np.array([s.relocalised for s in self], np.bool_),
            "loop_start": _starts([len(s.loops) for s in self]),
            "loop_frame": np.array([loop.frame for loop in loops], np.int64),
            "loop_oTc": _stack([loop.oTc for loop in loops], (4, 4)),
            "loop_covariance": _stack([loop.covariance for loop in loops], (6, 6)),
            "loop_merged_start": _starts([len(loop.merged) for loop in loops]),
            "loop_merged": _concatenate([loop.merged for loop in loops], (2,), np.int64),
        } | _observation_arrays([loop.observations for loop in loops], _LOOPS)

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> MeasurementLog:
        """The log back from its arrays; ``where`` names the source in messages."""
        header = _read_header(arrays, where)
        _require_consistent(arrays, where)
        loops, relocalised = _loops(arrays, header["version"], where)
        log = MeasurementLog(_sensor(header["sensor"], arrays["rig_bTc"]), header["motion"])
        observed = _split_observations(arrays, "")
        missed = _split(arrays, "missed")
        pruned = _split(arrays, "pruned")
        start = arrays["observation_start"]
        for k, index in enumerate(arrays["frame_index"]):
            log.append(
                Increment(
                    index=int(index),
                    timestamp=float(arrays["timestamp"][k]),
                    odometry=_odometry(arrays, k),
                    observations=observed[k],
                    rejected=arrays["rejected"][start[k] : start[k + 1]],
                    missed_ids=missed[k],
                    pruned_ids=pruned[k],
                    loops=loops[k],
                    relocalised=bool(relocalised[k]),
                )
            )
        return log

    @staticmethod
    def load(path: Path) -> MeasurementLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return MeasurementLog.from_arrays(load_arrays(path), str(path))


def load_arrays(path: Path) -> StateArrays:
    """All arrays of an ``.npz`` file, never unpickled."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except IsADirectoryError:
        raise MeasurementLogError(f"{path}: is a folder; give the .npz file itself") from None
    except FileNotFoundError:
        raise MeasurementLogError(f"{path}: no such file; give the run folder's own") from None
    except _UNREADABLE as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        if "pickle" in cause:  # NumPy advises to unpickle, which would run what the file says
            cause = "neither arrays nor an archive of them"
        raise MeasurementLogError(
            f"{path}: not a readable .npz file ({cause}); it may be truncated, run again"
        ) from None


def _read_header(arrays: StateArrays, where: str) -> dict[str, Any]:
    try:
        header = json.loads(str(arrays["header"]))
    except (KeyError, json.JSONDecodeError):
        header = {}
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MeasurementLogError(f"{where}: not an fgslam measurement log; give measurements.npz")
    if header.get("version") not in _READABLE:
        raise MeasurementLogError(
            f"{where}: measurement log of version {header.get('version')}, this fgslam reads "
            f"versions {_READABLE[0]} to {VERSION}; repeat the run or use the matching fgslam"
        )
    if header["version"] == 1:
        rig = header.get("rig")
        header["sensor"] = {"kind": "stereo", **rig} if isinstance(rig, dict) else None
    sensor = header.get("sensor")
    keys = _SENSOR_KEYS.get(str(sensor.get("kind"))) if isinstance(sensor, dict) else None
    if keys is None or set(sensor or ()) != {"kind", *keys}:
        raise MeasurementLogError(f"{where}: the log's header names no sensor; run again")
    if not isinstance(header.get("motion"), dict):
        raise MeasurementLogError(f"{where}: the log's header has no motion model; run again")
    return header


def _sensor(values: dict[str, Any], bTc: FloatArray) -> Sensor:
    numbers = {name: value for name, value in values.items() if name != "kind"}
    if values["kind"] == "stereo":
        return CameraRig(**numbers, bTc=bTc)
    return RangeBearingSensor(**numbers, bTc=bTc)


def _require_consistent(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError unless all arrays are there, of the right type and size."""
    frames = len(arrays["frame_index"]) if "frame_index" in arrays else 0
    seen = len(arrays["observation_id"]) if "observation_id" in arrays else 0
    expected: dict[str, tuple[str, tuple[int, ...]]] = {"rig_bTc": ("f", (4, 4))}
    expected |= {name: (kind, (frames, *item)) for name, (kind, item) in _PER_FRAME.items()}
    expected |= {name: (kind, (seen, *item)) for name, (kind, item) in _PER_OBSERVATION.items()}
    for name in ("observation", "missed", "pruned"):
        expected[f"{name}_start"] = ("i", (frames + 1,))
    _require_arrays(arrays, expected, where)
    for name in ("observation", "missed", "pruned"):
        start, ids = arrays[f"{name}_start"], arrays.get(f"{name}_id", np.empty(0))
        if ids.dtype.kind != "i" or not _covers(start, len(ids)):
            raise MeasurementLogError(f"{where}: array {name}_id is absent or damaged; run again")


def _loops(
    arrays: StateArrays, version: int, where: str
) -> tuple[list[tuple[LoopClosure, ...]], BoolArray]:
    """Loop closures of each frame, and which frames (n,) were relocalised; none before version 3.

    Raises MeasurementLogError where their arrays do not fit together, or a loop leads nowhere.
    """
    frames = len(arrays["frame_index"])
    if version < VERSION:
        return [()] * frames, np.zeros(frames, np.bool_)
    _require_consistent_loops(arrays, where)
    observed = _split_observations(arrays, _LOOPS)
    merged = np.split(arrays["loop_merged"], arrays["loop_merged_start"][1:-1])
    of_all = [
        LoopClosure(int(frame), arrays["loop_oTc"][i], arrays["loop_covariance"][i], seen, pairs)
        for i, (frame, seen, pairs) in enumerate(
            zip(arrays["loop_frame"], observed, merged, strict=False)
        )
    ]
    out = [tuple(of_all[a:b]) for a, b in itertools.pairwise(arrays["loop_start"])]
    for k, loops in enumerate(out):
        astray = [loop.frame for loop in loops if not 0 <= loop.frame < k]
        if astray:
            raise MeasurementLogError(
                f"{where}: a loop closure of frame {k} leads to frame {astray[0]}, which does not "
                "come before it; run again"
            )
    return out, arrays["relocalised"]


def _require_consistent_loops(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError unless the loops' arrays are there, of the right type and size."""
    frames, count = len(arrays["frame_index"]), _length(arrays, "loop_frame")
    seen, merged = _length(arrays, "loop_observation_id"), _length(arrays, "loop_merged")
    expected: dict[str, tuple[str, tuple[int, ...]]] = {
        "relocalised": ("b", (frames,)),
        "loop_start": ("i", (frames + 1,)),
        "loop_observation_start": ("i", (count + 1,)),
        "loop_merged_start": ("i", (count + 1,)),
        "loop_merged": ("i", (merged, 2)),
    }
    expected |= {name: (kind, (count, *item)) for name, (kind, item) in _PER_LOOP.items()}
    for name, (kind, item) in _PER_OBSERVATION.items():
        if name != "rejected":
            expected[_LOOPS + name] = (kind, (seen, *item))
    _require_arrays(arrays, expected, where)
    ends = {"loop_start": count, "loop_observation_start": seen, "loop_merged_start": merged}
    for name, total in ends.items():
        if not _covers(arrays[name], total):
            raise MeasurementLogError(f"{where}: array {name} is absent or damaged; run again")


def _length(arrays: StateArrays, name: str) -> int:
    """Rows of an array; 0 where it is absent or a scalar."""
    array = arrays.get(name)
    return 0 if array is None or array.ndim == 0 else len(array)


def _require_arrays(
    arrays: StateArrays, expected: dict[str, tuple[str, tuple[int, ...]]], where: str
) -> None:
    for name, (kind, shape) in expected.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind != kind or array.shape != shape:
            raise MeasurementLogError(f"{where}: array {name} is absent or damaged; run again")


def _covers(start: IntArray, count: int) -> bool:
    """Whether the offsets run from 0 to ``count`` without a step back."""
    return bool(start[0] == 0 and start[-1] == count and (np.diff(start) >= 0).all())


def _motion(increment: Increment) -> FloatArray:
    return np.full((4, 4), np.nan) if increment.odometry is None else increment.odometry.motion


def _motion_covariance(increment: Increment) -> FloatArray:
    if increment.odometry is None:
        return np.full((6, 6), np.nan)
    return increment.odometry.covariance


def _odometry(arrays: StateArrays, k: int) -> Odometry | None:
    motion = arrays["odometry_motion"][k]
    if np.isnan(motion[0, 0]):
        return None
    return Odometry(motion, arrays["odometry_covariance"][k])


def _stack(parts: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(parts, np.float64).reshape(len(parts), *shape)


def _concatenate(
    parts: list[Any], shape: tuple[int, ...], dtype: type = np.float64
) -> np.ndarray[Any, Any]:
    return np.concatenate([np.empty((0, *shape), dtype), *parts])


def _ragged(name: str, parts: list[IntArray]) -> StateArrays:
    return {
        f"{name}_start": _starts([len(p) for p in parts]),
        f"{name}_id": _concatenate(parts, (), np.int64),
    }


def _starts(sizes: list[int]) -> IntArray:
    """Offsets (n + 1,) of parts of these sizes."""
    return np.cumsum(np.array([0, *sizes], np.int64))


def _observation_arrays(seen: list[Observations], prefix: str) -> StateArrays:
    return {
        **_ragged(f"{prefix}observation", [o.ids for o in seen]),
        f"{prefix}measurement": _concatenate([o.measurement for o in seen], (3,)),
        f"{prefix}measurement_covariance": _concatenate(
            [o.covariance[:, _UPPER[0], _UPPER[1]] for o in seen], (6,)
        ),
        f"{prefix}pixels": _concatenate([o.pixels for o in seen], (3, 2)),
        f"{prefix}is_new": _concatenate([o.is_new for o in seen], (), np.bool_),
    }


def _split(arrays: StateArrays, name: str) -> list[IntArray]:
    return np.split(arrays[f"{name}_id"], arrays[f"{name}_start"][1:-1])


def _split_observations(arrays: StateArrays, prefix: str) -> list[Observations]:
    upper = arrays[f"{prefix}measurement_covariance"]
    covariance = np.empty((len(upper), 3, 3))
    covariance[:, _UPPER[0], _UPPER[1]] = upper
    covariance[:, _UPPER[1], _UPPER[0]] = upper
    everything = Observations(
        arrays[f"{prefix}observation_id"],
        arrays[f"{prefix}measurement"],
        covariance,
        arrays[f"{prefix}pixels"],
        arrays[f"{prefix}is_new"],
    )
    start = arrays[f"{prefix}observation_start"]
    return [everything.select(np.arange(a, b)) for a, b in itertools.pairwise(start)]
