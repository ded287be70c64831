"""The measurement log: everything that estimators consume, replayable without images.

One uncompressed ``.npz`` of plain arrays (no pickle). Ragged rows are stored flat with offsets:
rows of frame ``k`` are ``start[k]:start[k + 1]``.
"""

from __future__ import annotations

import itertools
import json
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.errors import MeasurementLogError
from fgslam.types import (
    CameraRig,
    FloatArray,
    Increment,
    IntArray,
    Observations,
    Odometry,
    RangeBearingSensor,
    Sensor,
    StateArrays,
)

FORMAT = "fgslam measurement log"
VERSION = 2
_READABLE = (1, 2)
"""Version 1 knew cameras only."""
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
        """Adds one frame; its time must come after the last one's."""
        if self.increments and not increment.timestamp > self.increments[-1].timestamp:
            raise MeasurementLogError(
                f"frame {increment.index}: time stamp {increment.timestamp:.9f} s does not come "
                f"after {self.increments[-1].timestamp:.9f} s; sort the measurements by time"
            )
        self.increments.append(increment)

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        kind = "stereo" if isinstance(self.rig, CameraRig) else "range_bearing"
        sensor = {"kind": kind} | {name: getattr(self.rig, name) for name in _SENSOR_KEYS[kind]}
        header = {"format": FORMAT, "version": VERSION, "sensor": sensor}
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
        return out | self._observation_arrays()

    def _observation_arrays(self) -> StateArrays:
        seen = [s.observations for s in self]
        return {
            **_ragged("observation", [o.ids for o in seen]),
            "measurement": _concatenate([o.measurement for o in seen], (3,)),
            "measurement_covariance": _concatenate(
                [o.covariance[:, _UPPER[0], _UPPER[1]] for o in seen], (6,)
            ),
            "pixels": _concatenate([o.pixels for o in seen], (3, 2)),
            "is_new": _concatenate([o.is_new for o in seen], (), np.bool_),
            "rejected": _concatenate([s.rejected for s in self], (), np.bool_),
        }

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> MeasurementLog:
        """The log back from its arrays; ``where`` names the source in messages."""
        header = _read_header(arrays, where)
        _require_consistent(arrays, where)
        log = MeasurementLog(_sensor(header["sensor"], arrays["rig_bTc"]), header["motion"])
        observed = _split_observations(arrays)
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
    for name, (kind, shape) in expected.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind != kind or array.shape != shape:
            raise MeasurementLogError(f"{where}: array {name} is absent or damaged; run again")
    for name in ("observation", "missed", "pruned"):
        start, ids = arrays[f"{name}_start"], arrays.get(f"{name}_id", np.empty(0))
        if ids.dtype.kind != "i" or not _covers(start, len(ids)):
            raise MeasurementLogError(f"{where}: array {name}_id is absent or damaged; run again")


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
    sizes = np.array([0, *(len(p) for p in parts)], np.int64)
    return {
        f"{name}_start": np.cumsum(sizes),
        f"{name}_id": _concatenate(parts, (), np.int64),
    }


def _split(arrays: StateArrays, name: str) -> list[IntArray]:
    return np.split(arrays[f"{name}_id"], arrays[f"{name}_start"][1:-1])


def _split_observations(arrays: StateArrays) -> list[Observations]:
    upper = arrays["measurement_covariance"]
    covariance = np.empty((len(upper), 3, 3))
    covariance[:, _UPPER[0], _UPPER[1]] = upper
    covariance[:, _UPPER[1], _UPPER[0]] = upper
    everything = Observations(
        arrays["observation_id"],
        arrays["measurement"],
        covariance,
        arrays["pixels"],
        arrays["is_new"],
    )
    start = arrays["observation_start"]
    return [everything.select(np.arange(a, b)) for a, b in itertools.pairwise(start)]
