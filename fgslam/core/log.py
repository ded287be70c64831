"""Recordings: of images, as a sequence of frames, and of measurements, as a finished log."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, Brief, FloatArray, Image, IntArray, Rows, StateArrays
from fgslam.core.checks import is_finite_number
from fgslam.core.correction import term_names
from fgslam.core.errors import DatasetError, MeasurementLogError
from fgslam.core.files import as_path, write_text
from fgslam.core.geometry import is_rigid
from fgslam.core.sensors import (
    BiasEffect,
    CameraRig,
    Increment,
    LoopClosure,
    Observations,
    Odometry,
    SettledRig,
)
from fgslam.core.settings import RigPlaces
from fgslam.core.store import (
    ArrayFile,
    Items,
    from_upper,
    joined,
    of_rows,
    offsets,
    require_covariances,
    require_finite,
    require_motions,
    require_single,
    rows_of,
    split,
    write_arrays,
)
from fgslam.core.types import Trajectory

# ------------------------------------------------------------------------------------------
# Whether numbers can be those of a camera rig, wherever they come from

_FOCAL_RANGE = 1000.0
"""Of focal length and image size: at one end a telescope, at the other no picture."""


def rig_fault(rig: CameraRig) -> str:
    """Why the numbers cannot be those of a rig, and what to give; empty where they can."""
    for name in ("width", "height"):
        value = getattr(rig, name)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value <= 0:
            return f"{name} is {value!r}; give the images' size in pixels"
    for name in ("fx", "fy", "baseline", "vertical_baseline"):
        if fault := _length_fault(rig, name):
            return fault
    for name in ("fx", "fy"):
        value, size = getattr(rig, name), max(rig.width, rig.height)
        if not size / _FOCAL_RANGE <= value <= size * _FOCAL_RANGE:
            return (
                f"{name} is {value!r} for images of {rig.width}x{rig.height} pixels; give the "
                "focal length in pixels of these images"
            )
    for name, extent in (("cx", rig.width), ("cy", rig.height)):
        value = getattr(rig, name)
        # Cropped images may have it outside, but hardly by more than their own size.
        if not is_finite_number(value) or not -extent <= value <= 2 * extent:
            return (
                f"{name} is {value!r}, far from the image of {rig.width}x{rig.height} pixels; "
                "give the principal point (column, row) in pixels of these images"
            )
    return _mounting_fault(rig)


def _mounting_fault(rig: CameraRig) -> str:
    if not isinstance(rig.exact, bool | np.bool_):
        return f"exact is {rig.exact!r}; give True for a rig known without error, as a rendered one"
    if rig.places not in get_args(RigPlaces):
        return f"places is {rig.places!r}; give {' or '.join(get_args(RigPlaces))}"
    if not is_rigid(np.asarray(rig.bTc, np.float64)):
        return (
            "bTc must be a rigid motion (4, 4), the pose of the right camera in the body; "
            "correct it, or leave it out"
        )
    return ""


def _length_fault(rig: CameraRig, name: str) -> str:
    value = getattr(rig, name)
    if name == "vertical_baseline" and value is None:
        return ""
    if is_finite_number(value) and value > 0.0:
        return ""
    what = (
        "the distance between the cameras in metres; one camera alone cannot measure depth, "
        "and a negative one means that left and right are swapped"
        if "baseline" in name
        else "the focal length in pixels"
    )
    return f"{name} is {value!r}, not a positive number; give {what}"


# ------------------------------------------------------------------------------------------
# Frames of a measurement log as plain arrays, and back: the layout of its file

LOG = ArrayFile(
    name="fgslam measurement log",
    # 2: without loops, 3: without corrections of the rig, 6: without the bias of a gyroscope.
    versions=(2, 3, 6, 7),
    error=MeasurementLogError,
    give="give a run folder's measurements.npz",
    again="run again",
)
BEFORE_LOOPS, WITH_LOOPS, WITH_CORRECTIONS, WITH_EVERYTHING = LOG.versions
CORRECTIONS, SENSOR_POSE = "rig_correction", "rig_bTc"

# Arrays by the count that their first axis has, with type and the shape of an item.
PER_FRAME: Items = {
    "frame_index": ("i", ()),
    "timestamp": ("f", ()),
    "odometry_motion": ("f", (4, 4)),
    "odometry_covariance": ("f", (6, 6)),
}
PER_OBSERVATION: Items = {
    "observation_id": ("i", ()),
    "measurement": ("f", (3,)),
    "measurement_covariance": ("f", (6,)),
    "pixels": ("f", (3, 2)),
    "is_new": ("b", ()),
    "rejected": ("b", ()),
}
LOOPS = "loop_"  # before the names of the arrays of the loops' own observations
PER_LOOP: Items = {
    "loop_frame": ("i", ()),
    "loop_oTc": ("f", (4, 4)),
    "loop_covariance": ("f", (6, 6)),
}
PER_TURN: Items = {
    "gyroscope_jacobian": ("f", (3, 3)),
    "gyroscope_bias": ("f", (3,)),
    "gyroscope_bias_covariance": ("f", (3, 3)),
    "gyroscope_stability": ("f", (2,)),
}

_UPPER = np.triu_indices(3)
_UNSETTLED = -1  # number of knocks of a frame that knows nothing of its rig
_RIG = ("width", "height", "fx", "fy", "cx", "cy", "baseline", "vertical_baseline")
_DEFAULTS: dict[str, Any] = {"exact": False, "places": "all"}
"""Of a rig: written where it is otherwise."""


def arrays_of(
    sensor: CameraRig, motion_model: dict[str, Any], frames: Sequence[Increment]
) -> StateArrays:
    """Frames as the arrays of a log's file, of the first version that has a place for them."""
    version = _version_of(frames)
    about = {"kind": "stereo"} | {name: getattr(sensor, name) for name in _RIG}
    stated = {name: type(usual)(getattr(sensor, name)) for name, usual in _DEFAULTS.items()}
    about |= {name: value for name, value in stated.items() if value != _DEFAULTS[name]}
    out = LOG.header(version, sensor=about, motion=motion_model) | {
        SENSOR_POSE: sensor.bTc,
        "frame_index": np.array([s.index for s in frames], np.int64),
        "timestamp": np.array([s.timestamp for s in frames], np.float64),
        "odometry_motion": _stack([_motion(s) for s in frames], (4, 4)),
        "odometry_covariance": _stack([_motion_covariance(s) for s in frames], (6, 6)),
    }
    out |= _ragged("missed", [s.missed_ids for s in frames])
    out |= _ragged("pruned", [s.pruned_ids for s in frames])
    out |= _observation_arrays([s.observations for s in frames], "")
    out["rejected"] = joined([s.rejected for s in frames], (), np.bool_)
    if version >= WITH_LOOPS:
        out |= _loop_arrays(frames)
    if version >= WITH_CORRECTIONS:
        out |= _correction_arrays(frames, len(term_names(sensor)))
    if version >= WITH_EVERYTHING:
        out |= _bias_arrays(frames)
    return out


def _version_of(frames: Sequence[Increment]) -> int:
    """The first version that has a place for all that is there."""
    steps = [s.odometry for s in frames if s.odometry is not None]
    if any(step.bias is not None for step in steps):
        return WITH_EVERYTHING
    if any(step.turned for step in steps) or any(s.rig_correction is not None for s in frames):
        return WITH_CORRECTIONS
    return WITH_LOOPS if any(s.loops or s.relocalised for s in frames) else BEFORE_LOOPS


def frames_of(arrays: StateArrays, where: str) -> tuple[CameraRig, dict[str, Any], list[Increment]]:
    """Sensor, motion model and frames from their arrays.

    Args:
        arrays: of a log's file.
        where: names the source in messages.

    Raises:
        MeasurementLogError: they are damaged, foreign, or hold what no run measures.
    """
    header = _read_header(arrays, where)
    _require_consistent(arrays, where)
    _require_sound(arrays, where)
    loops, relocalised = _loops(arrays, header["version"], where)
    sensor = _sensor(header["sensor"], arrays[SENSOR_POSE], where)
    _require_ahead(arrays, where)
    corrections = _corrections(arrays, header["version"], sensor, where)
    settled = _settled(arrays, header["version"], corrections, where)
    biases = _biases(arrays, header["version"], where)
    observed = _split_observations(arrays, "")
    missed, pruned = _split(arrays, "missed"), _split(arrays, "pruned")
    start = arrays["observation_start"]
    frames = [
        Increment(
            index=int(index),
            timestamp=float(arrays["timestamp"][k]),
            odometry=_odometry(arrays, k, biases[k]),
            observations=observed[k],
            rejected=arrays["rejected"][start[k] : start[k + 1]],
            missed_ids=missed[k],
            pruned_ids=pruned[k],
            loops=loops[k],
            relocalised=bool(relocalised[k]),
            rig_correction=corrections[k],
            settled_rig=settled[k],
        )
        for k, index in enumerate(arrays["frame_index"])
    ]
    return sensor, header["motion"], frames


def _loop_arrays(frames: Sequence[Increment]) -> StateArrays:
    loops = [loop for s in frames for loop in s.loops]
    return {
        "relocalised": np.array([s.relocalised for s in frames], np.bool_),
        "loop_start": offsets([len(s.loops) for s in frames]),
        "loop_frame": np.array([loop.frame for loop in loops], np.int64),
        "loop_oTc": _stack([loop.oTc for loop in loops], (4, 4)),
        "loop_covariance": _stack([loop.covariance for loop in loops], (6, 6)),
        "loop_merged_start": offsets([len(loop.merged) for loop in loops]),
        "loop_merged": joined([loop.merged for loop in loops], (2,), np.int64),
    } | _observation_arrays([loop.observations for loop in loops], LOOPS)


def _correction_arrays(frames: Sequence[Increment], terms: int) -> StateArrays:
    known = any(s.rig_correction is not None for s in frames)
    none, unknown = np.full(terms, 0.0 if known else np.nan), np.full(terms, np.nan)
    corrections = [s.rig_correction for s in frames]
    settled = [s.settled_rig or SettledRig(None, _UNSETTLED) for s in frames]
    return {
        CORRECTIONS: _stack([none if c is None else c for c in corrections], (terms,)),
        "rig_settled": _stack(
            [unknown if s.values is None else s.values for s in settled], (terms,)
        ),
        "rig_knocks": np.array([s.knocks for s in settled], np.int64),
        "rig_field_px": np.array([s.field_px for s in settled], np.float64),
    }


def _bias_arrays(frames: Sequence[Increment]) -> StateArrays:
    matrix = np.full((3, 3), np.nan)
    none = BiasEffect(matrix, np.nan, np.nan, matrix[0], matrix)
    known = [none if s.odometry is None else s.odometry.bias or none for s in frames]
    return {
        "gyroscope_jacobian": _stack([bias.jacobian for bias in known], (3, 3)),
        "gyroscope_bias": _stack([bias.applied for bias in known], (3,)),
        "gyroscope_bias_covariance": _stack([bias.left for bias in known], (3, 3)),
        "gyroscope_stability": np.array([(b.start_variance, b.walk) for b in known]).reshape(-1, 2),
    }


def _read_header(arrays: StateArrays, where: str) -> dict[str, Any]:
    header = LOG.read_header(arrays, where)
    sensor = header.get("sensor")
    given = sensor if isinstance(sensor, dict) else {}
    if given.get("kind") != "stereo" or given.keys() - _DEFAULTS != {"kind", *_RIG}:
        raise MeasurementLogError(f"{where}: the log's header names no rig; run again")
    if not isinstance(header.get("motion"), dict):
        raise MeasurementLogError(f"{where}: the log's header has no motion model; run again")
    return header


SENSOR_ARRAYS = ("header", SENSOR_POSE)


def sensor_of(arrays: StateArrays, where: str) -> CameraRig:
    """The sensor that :data:`SENSOR_ARRAYS` tell of. Raises MeasurementLogError."""
    header = _read_header(arrays, where)
    LOG.require(arrays, {SENSOR_POSE: ("f", (4, 4))}, where)
    require_finite(LOG, arrays, (SENSOR_POSE,), where)
    return _sensor(header["sensor"], arrays[SENSOR_POSE], where)


def _sensor(values: dict[str, Any], bTc: FloatArray, where: str) -> CameraRig:
    numbers = {name: value for name, value in values.items() if name != "kind"}
    rig = CameraRig(**numbers, bTc=bTc)
    if fault := rig_fault(rig):
        raise MeasurementLogError(f"{where}: the log's rig cannot be one: {fault}; run again")
    return rig


def _require_sound(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError for values that no run measures."""
    require_finite(LOG, arrays, ("timestamp", SENSOR_POSE, "measurement"), where)
    covariances = from_upper(arrays["measurement_covariance"], 3)
    require_covariances(LOG, "measurement_covariance", covariances, where)
    known = ~np.isnan(arrays["odometry_motion"][:, 0, 0])
    motions = {"odometry_motion": _with_translation(arrays["odometry_motion"][known])}
    require_finite(LOG, motions, ("odometry_motion",), where)
    require_motions(LOG, "odometry_motion", motions["odometry_motion"], where)
    moved = arrays["odometry_covariance"][known]
    require_covariances(LOG, "odometry_covariance", moved, where, definite=False)
    ids, start = arrays["observation_id"], arrays["observation_start"]
    require_single(LOG, "observation_id", ids, start, where)


def _require_ahead(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError where most disparities are not positive.

    Single ones are noise about what is far away.
    """
    measured = arrays["measurement"][:, 2]
    if len(measured) and not np.median(measured) > 0.0:
        raise MeasurementLogError(
            f"{where}: {int((measured <= 0.0).sum())} of {len(measured)} disparities are not "
            "positive: left and right are swapped, or it is damaged; run again"
        )


def _require_consistent(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError unless all arrays are there, of the right type and size."""
    frames = rows_of(arrays, "frame_index")
    expected = {SENSOR_POSE: ("f", (4, 4))} | of_rows(frames, PER_FRAME)
    for name in ("observation", "missed", "pruned"):
        rows = LOG.require_offsets(arrays, f"{name}_start", frames, where)
        expected |= of_rows(
            rows, PER_OBSERVATION if name == "observation" else {f"{name}_id": ("i", ())}
        )
    LOG.require(arrays, expected, where)


def _loops(
    arrays: StateArrays, version: int, where: str
) -> tuple[list[tuple[LoopClosure, ...]], BoolArray]:
    """Loop closures of each frame, and which frames (n,) were relocalised; none before version 3.

    Raises MeasurementLogError where their arrays do not fit together, or a loop leads nowhere.
    """
    frames = len(arrays["frame_index"])
    if version < WITH_LOOPS:
        return [()] * frames, np.zeros(frames, np.bool_)
    _require_consistent_loops(arrays, where)
    observed = _split_observations(arrays, LOOPS)
    merged = split(arrays["loop_merged"], arrays["loop_merged_start"])
    of_all = [
        LoopClosure(int(frame), arrays["loop_oTc"][i], arrays["loop_covariance"][i], seen, pairs)
        for i, (frame, seen, pairs) in enumerate(
            zip(arrays["loop_frame"], observed, merged, strict=True)
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
    frames = rows_of(arrays, "frame_index")
    count = LOG.require_offsets(arrays, "loop_start", frames, where)
    seen = LOG.require_offsets(arrays, "loop_observation_start", count, where)
    merged = LOG.require_offsets(arrays, "loop_merged_start", count, where)
    of_loops = {LOOPS + name: item for name, item in PER_OBSERVATION.items() if name != "rejected"}
    expected = {"relocalised": ("b", (frames,)), "loop_merged": ("i", (merged, 2))}
    LOG.require(arrays, expected | of_rows(count, PER_LOOP) | of_rows(seen, of_loops), where)


def _corrections(
    arrays: StateArrays, version: int, rig: CameraRig, where: str
) -> list[FloatArray | None]:
    """The rig's correction in each frame; None before version 6, and in a log of NaN.

    Raises MeasurementLogError where they are not there, or of another rig.
    """
    frames = len(arrays["frame_index"])
    if version < WITH_CORRECTIONS:
        return [None] * frames
    LOG.require(arrays, {CORRECTIONS: ("f", (frames, len(term_names(rig))))}, where)
    rows = arrays[CORRECTIONS]
    return [None] * frames if np.isnan(rows[:, :1]).all() else list(rows)


def _settled(
    arrays: StateArrays, version: int, corrections: Sequence[FloatArray | None], where: str
) -> list[SettledRig | None]:
    """What each frame with a correction knew for all frames alike; None before version 6.

    Raises MeasurementLogError where it is not there, or of another rig.
    """
    frames = len(arrays["frame_index"])
    terms = next((len(row) for row in corrections if row is not None), 0)
    if version < WITH_CORRECTIONS or not terms:
        return [None] * frames
    expected: Items = {
        "rig_settled": ("f", (frames, terms)),
        "rig_knocks": ("i", (frames,)),
        "rig_field_px": ("f", (frames,)),
    }
    LOG.require(arrays, expected, where)
    field = arrays["rig_field_px"]
    if not (np.isfinite(field) & (field >= 0.0)).all():
        raise LOG.damaged("rig_field_px", where)
    rows = zip(arrays["rig_settled"], arrays["rig_knocks"].tolist(), field.tolist(), strict=True)
    found = [SettledRig(row if np.isfinite(row).all() else None, n, px) for row, n, px in rows]
    return [None if one.knocks == _UNSETTLED else one for one in found]


def _biases(arrays: StateArrays, version: int, where: str) -> list[BiasEffect | None]:
    """What the gyroscope's bias does to each step; None before version 7, and where unknown.

    Raises MeasurementLogError where its arrays are not there, or hold what no run measures.
    """
    frames = len(arrays["frame_index"])
    if version < WITH_EVERYTHING:
        return [None] * frames
    LOG.require(arrays, of_rows(frames, PER_TURN), where)
    known = ~np.isnan(arrays["gyroscope_jacobian"][:, 0, 0])
    given = {name: arrays[name][known] for name in PER_TURN}
    require_finite(LOG, given, tuple(given), where)
    name = "gyroscope_bias_covariance"
    require_covariances(LOG, name, given[name], where, definite=False)
    variances = given["gyroscope_stability"][:, :, None, None]
    require_covariances(LOG, "gyroscope_stability", variances[:, 0], where)
    require_covariances(LOG, "gyroscope_stability", variances[:, 1], where, definite=False)
    rows = zip(*(arrays[name] for name in PER_TURN), known, strict=True)
    return [
        BiasEffect(jacobian, float(start), float(walk), applied, left) if ok else None
        for jacobian, applied, left, (start, walk), ok in rows
    ]


def _motion(increment: Increment) -> FloatArray:
    """(4, 4); NaN where nothing was measured, and as translation of a mere turn."""
    odometry = increment.odometry
    if odometry is None:
        return np.full((4, 4), np.nan)
    return odometry.motion + (_NO_TRANSLATION if odometry.turned else 0.0)


_NO_TRANSLATION = np.zeros((4, 4))
_NO_TRANSLATION[:3, 3] = np.nan


def _with_translation(motions: FloatArray) -> FloatArray:
    """Motions (n, 4, 4), mere turns without translation."""
    out = np.array(motions)
    out[np.isnan(motions[:, :3, 3]).all(axis=1), :3, 3] = 0.0
    return out


def _motion_covariance(increment: Increment) -> FloatArray:
    if increment.odometry is None:
        return np.full((6, 6), np.nan)
    return increment.odometry.covariance


def _odometry(arrays: StateArrays, k: int, bias: BiasEffect | None) -> Odometry | None:
    motion, covariance = arrays["odometry_motion"][k], arrays["odometry_covariance"][k]
    if np.isnan(motion[0, 0]):
        return None
    if np.isnan(motion[0, 3]):
        return Odometry.turn(motion[:3, :3], covariance[:3, :3], bias)
    return Odometry(motion, covariance)


def _stack(parts: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(parts, np.float64).reshape(len(parts), *shape)


def _ragged(name: str, parts: list[IntArray]) -> StateArrays:
    return {
        f"{name}_start": offsets([len(p) for p in parts]),
        f"{name}_id": joined(parts, (), np.int64),
    }


def _observation_arrays(seen: list[Observations], prefix: str) -> StateArrays:
    return {
        **_ragged(f"{prefix}observation", [o.ids for o in seen]),
        f"{prefix}measurement": joined([o.measurement for o in seen], (3,)),
        f"{prefix}measurement_covariance": joined(
            [o.covariance[:, _UPPER[0], _UPPER[1]] for o in seen], (6,)
        ),
        f"{prefix}pixels": joined([o.pixels for o in seen], (3, 2)),
        f"{prefix}is_new": joined([o.is_new for o in seen], (), np.bool_),
    }


def _split(arrays: StateArrays, name: str) -> list[IntArray]:
    return split(arrays[f"{name}_id"], arrays[f"{name}_start"])


def _split_observations(arrays: StateArrays, prefix: str) -> list[Observations]:
    everything = Observations(
        arrays[f"{prefix}observation_id"],
        arrays[f"{prefix}measurement"],
        from_upper(arrays[f"{prefix}measurement_covariance"], 3),
        arrays[f"{prefix}pixels"],
        arrays[f"{prefix}is_new"],
    )
    start = arrays[f"{prefix}observation_start"]
    return [everything.select(np.arange(a, b)) for a, b in itertools.pairwise(start)]


# ------------------------------------------------------------------------------------------
# The measurement log: everything that estimators consume, replayable without images


@dataclass(slots=True, eq=False, repr=False)
class MeasurementLog(Brief):
    """Measurements of a run, frame by frame.

    Attributes:
        rig: the cameras, with the lever arm.
        motion_model: how odometry came about, and the stand-in's numbers where there was none
            (plain JSON values): replays need it to predict as the live run did.
        increments: one a frame, time increasing.
    """

    rig: CameraRig
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
        increment = dataclasses.replace(increment, odometry=_without_stand_in(increment.odometry))
        self.increments.append(increment)

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array([s.timestamp for s in self], np.float64)

    @property
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""
        return np.array([s.index for s in self], np.int64)

    @property
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""
        return sum(s.relocalised for s in self)

    @property
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All loop closures, with the position of the frame that offered each."""
        return [(k, loop) for k, step in enumerate(self) for loop in step.loops]

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        return arrays_of(self.rig, self.motion_model, self.increments)

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> MeasurementLog:
        """The log back from its arrays; ``where`` names the source in messages."""
        sensor, motion_model, frames = frames_of(arrays, where)
        log = MeasurementLog(sensor, motion_model)
        for frame in frames:
            log.append(frame)
        return log

    def save(self, path: str | Path) -> None:
        """Writes the log, whole or not at all. Raises OutputError when it cannot be written."""
        write_arrays(Path(path), self.to_arrays())

    @staticmethod
    def load_sensor(path: Path) -> CameraRig:
        """What a log's file was measured with. Raises MeasurementLogError as :meth:`load` does."""
        return sensor_of(LOG.load(path, SENSOR_ARRAYS), str(path))

    @staticmethod
    def load(path: str | Path) -> MeasurementLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return MeasurementLog.from_arrays(LOG.load(as_path(path, MeasurementLogError)), str(path))


def _without_stand_in(odometry: Odometry | None) -> Odometry | None:
    """What of a step was measured: all of it, its turn, or nothing."""
    if odometry is None or odometry.measured:
        return odometry
    if odometry.turned:
        turn = odometry.motion[:3, :3], odometry.covariance[:3, :3]
        return Odometry.turn(*turn, odometry.bias)
    return None


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The images of one instant, in the order right, left[, top]; grey, uint8, (height, width).

    ``index`` counts the recording's own frames (before ``start``/``stop``/``stride``). ``margins``
    are (height, width) of each camera: how far a pixel is from what shows nothing, a black border
    or what a mask hides, in pixels; empty where all images are full.
    """

    index: int
    timestamp: float
    images: tuple[Image, ...]
    margins: tuple[npt.NDArray[np.float32], ...] = ()

    def digest(self) -> int:
        """64 bits of the images' contents: by them a frame is known again in any recording."""
        content = hashlib.blake2b(digest_size=8)
        for image in self.images:
            content.update(np.ascontiguousarray(image).data)
        return int.from_bytes(content.digest(), "little", signed=True)


def clearance(margin: npt.NDArray[np.float32], places: FloatArray) -> FloatArray:
    """How far (n,) places (n, 2) (column, row) are from what shows nothing, pixels.

    Args:
        margin: (height, width) of the image, as in :class:`Frame`.
        places: those outside the image are judged by its nearest pixel.
    """
    height, width = margin.shape
    column, row = np.rint(places).astype(np.int64).T
    return np.asarray(margin[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])


@runtime_checkable
class ImageSequence(Protocol):
    """A recording: calibrated frames in time order, perhaps with odometry and ground truth.

    Indices ``i`` run over the *selected* frames (after start, stop and stride), from 0.
    """

    @property
    def name(self) -> str:
        """Short name for titles."""
        ...

    @property
    def rig(self) -> CameraRig:
        """The calibrated cameras, rectified."""
        ...

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds, strictly increasing."""
        ...

    @property
    def identity(self) -> str:
        """Hexadecimal digest of what defines the recording, for the run folder."""
        ...

    def __len__(self) -> int: ...

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``. Raises FrameError when they are missing or corrupt."""
        ...

    def odometry(self, i: int) -> Odometry | None:
        """Body motion from frame ``i - 1`` to ``i``, or None where none was recorded."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses ``wTc`` of the reference camera in a world of the recording's choice."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What was tolerated when opening the recording, in words (missing frames and the like)."""
        ...


@dataclass(frozen=True, eq=False)
class LandmarkTruth(Rows):
    """True landmark positions, in the frame of the ground-truth trajectory.

    Attributes:
        ids: (n,) identities as in the log, ascending.
        positions: (n, 3) metres.
    """

    ids: IntArray
    positions: FloatArray


LANDMARK_TRUTH_FILE = "ground_truth_landmarks.csv"
_HEADER = "id,x,y,z,sigma_m"


def write_landmark_truth(path: Path, truth: LandmarkTruth, sigma_m: FloatArray) -> None:
    """Write id, x, y, z (m, the world of ground_truth.tum) and sigma_m: the truth's own error.

    Args:
        path: the file, written atomically.
        truth: n positions.
        sigma_m: (n,) standard error of each; 0 where it is exact.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [_HEADER]
    for landmark, (x, y, z), sigma in zip(truth.ids, truth.positions + 0.0, sigma_m, strict=True):
        lines.append(f"{landmark},{x:.9f},{y:.9f},{z:.9f},{sigma:.9f}")
    write_text(path, "\n".join(lines) + "\n")


def read_landmark_truth(path: Path) -> tuple[LandmarkTruth, FloatArray]:
    """The positions, ids ascending, and their own standard errors (n,).

    Raises:
        DatasetError: the file is missing or is no such table; the message names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path} ({error}); run the experiment again") from error
    if not lines or lines[0] != _HEADER:
        raise DatasetError(f"{path}, line 1: not '{_HEADER}'; run the experiment again")
    ids, values = np.empty(len(lines) - 1, np.int64), np.empty((len(lines) - 1, 4))
    for k, line in enumerate(lines[1:]):
        try:
            first, *numbers = line.split(",")
            ids[k], values[k] = int(first), [float(number) for number in numbers]
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {k + 2}: {error}; run the experiment again"
            ) from error
    if not (np.isfinite(values).all() and (np.diff(ids) > 0).all()):
        raise DatasetError(
            f"{path}: ids do not increase or a number is not finite; run the experiment again"
        )
    return LandmarkTruth(ids, values[:, :3].copy()), values[:, 3].copy()


@dataclass(frozen=True, eq=False)
class MeasurementRecording:
    """Measurements with identities, replayable by any estimator without a front-end.

    Attributes:
        name: short name for titles.
        identity: hexadecimal digest of what defines the recording.
        log: sensor, motion model and one increment a frame.
        ground_truth: true ``wTc`` of the reference camera or sensor, in a world of the
            recording's choice; None where there is none.
        landmark_truth: true landmark positions in that same world, or None. A landmark that moves
            during the recording is not in it.
        notes: what was tolerated, left out or simulated, in words.
    """

    name: str
    identity: str
    log: MeasurementLog
    ground_truth: Trajectory | None
    landmark_truth: LandmarkTruth | None
    notes: tuple[str, ...]
