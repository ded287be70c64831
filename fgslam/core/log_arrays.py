"""Frames of a measurement log as plain arrays, and back: the layout of its file.

A log is of the first version that has a place for all that is in it (:func:`version_of`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.measurements import (
    BiasEffect,
    Increment,
    LoopClosure,
    Observations,
    Odometry,
    SettledRig,
)
from fgslam.core.rig_checks import rig_fault
from fgslam.core.rig_correction import term_names
from fgslam.core.sensors import CameraRig
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
)

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
