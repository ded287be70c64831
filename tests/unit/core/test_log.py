"""The measurement log keeps every bit, and what no run measures is refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from simulated import assert_same_value

from fgslam.core.correction import term_names
from fgslam.core.errors import MeasurementLogError
from fgslam.core.geometry import se3_exp
from fgslam.core.log import MeasurementLog
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

RIG = CameraRig(320, 240, 277.1, 277.3, 159.5, 119.5, 0.1, 0.1, np.eye(4))


def increment(k: int, rng: np.random.Generator, seen: int, with_odometry: bool) -> Increment:
    noise = rng.standard_normal((seen, 3, 3))
    covariance = noise @ np.swapaxes(noise, 1, 2)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2.0 + 0.1 * np.eye(3)
    step, motion = rng.standard_normal((6, 6)), se3_exp(rng.standard_normal(6))
    return Increment(
        index=3 * k,
        timestamp=0.1 + k / 3.0,
        odometry=Odometry(motion, step @ step.T) if with_odometry else None,
        observations=Observations(
            rng.permutation(1000)[:seen].astype(np.int64),
            rng.standard_normal((seen, 3)) + np.array([0.0, 0.0, 9.0]),
            covariance,
            np.where(rng.random((seen, 3, 2)) < 0.2, np.nan, rng.standard_normal((seen, 3, 2))),
            rng.random(seen) < 0.5,
        ),
        rejected=rng.random(seen) < 0.3,
        missed_ids=rng.integers(0, 2**40, k % 3),
        pruned_ids=rng.integers(0, 2**40, (k + 1) % 4),
    )


@pytest.fixture
def log(rng: np.random.Generator) -> MeasurementLog:
    """Frames with many, one and no observation, with and without odometry."""
    out = MeasurementLog(RIG, {"kind": "recorded", "stand_in": {"sigma": [0.1, 1e-17]}})
    for k, seen in enumerate((7, 0, 1, 0, 12, 0)):
        out.append(increment(k, rng, seen, with_odometry=k > 0 and k != 3))
    return out


@pytest.fixture
def file(log: MeasurementLog, tmp_path: Path) -> Path:
    log.save(tmp_path / "measurements.npz")
    return tmp_path / "measurements.npz"


def test_every_bit_survives(log: MeasurementLog, file: Path) -> None:
    loaded = MeasurementLog.load(file)
    assert len(loaded) == len(log) == 6
    assert_same_value(loaded, log)


@pytest.mark.parametrize(
    "change",
    [{}, {"vertical_baseline": None}, {"exact": True}]
    + [{"places": places} for places in get_args(RigPlaces)],
)
def test_an_empty_log_keeps_its_rig(change: dict[str, Any], tmp_path: Path) -> None:
    log = MeasurementLog(replace(RIG, **change), {})
    log.save(tmp_path / "measurements.npz")
    assert_same_value(MeasurementLog.load(tmp_path / "measurements.npz"), log)


def test_time_may_not_run_backwards(log: MeasurementLog, rng: np.random.Generator) -> None:
    late = increment(5, rng, 2, with_odometry=True)
    with pytest.raises(MeasurementLogError, match=r"does not come after .*; sort"):
        log.append(late)
    assert len(log) == 6


def loop(frame: int, rng: np.random.Generator, seen: int, merged: int) -> LoopClosure:
    step = rng.standard_normal((6, 6))
    return LoopClosure(
        frame=frame,
        oTc=rng.standard_normal((4, 4)),
        covariance=step @ step.T,
        observations=increment(0, rng, seen, with_odometry=False).observations,
        merged=rng.integers(0, 2**40, (merged, 2)),
    )


@pytest.fixture
def looped(log: MeasurementLog, rng: np.random.Generator) -> MeasurementLog:
    """Frames with two loops, one, and none; one relocalised."""
    changed = {
        2: {"loops": (loop(0, rng, 3, 2), loop(1, rng, 0, 0))},
        4: {"loops": (loop(3, rng, 5, 1),), "relocalised": True},
    }
    return MeasurementLog(
        log.rig, log.motion_model, [replace(s, **changed.get(k, {})) for k, s in enumerate(log)]
    )


def test_every_bit_of_loops_survives(looped: MeasurementLog, tmp_path: Path) -> None:
    looped.save(tmp_path / "measurements.npz")
    loaded = MeasurementLog.load(tmp_path / "measurements.npz")
    assert [len(s.loops) for s in loaded] == [0, 0, 2, 0, 1, 0]
    assert [s.relocalised for s in loaded] == [False] * 4 + [True, False]
    assert_same_value(loaded, looped)


TERMS = len(term_names(RIG))
BIAS = BiasEffect(
    -0.05 * np.eye(3), 0.003, 1e-11, np.array([0.01, -0.02, 0.03]), np.diag([1e-6, 2e-6, 3e-6])
)
TURN = Odometry.turn(np.eye(3), 1e-6 * np.eye(3), BIAS)


@pytest.mark.parametrize(
    "change",
    [
        {"odometry": TURN},
        {"rig_correction": np.arange(float(TERMS)), "settled_rig": SettledRig(0)},
        {
            "rig_correction": np.arange(float(TERMS)),
            "settled_rig": SettledRig(2, 7, 0.3),
        },
    ],
)
def test_gyroscope_and_corrections_survive(
    log: MeasurementLog, tmp_path: Path, change: dict[str, Any]
) -> None:
    log.increments[1] = replace(log.increments[1], **change)
    log.save(tmp_path / "log.npz")
    assert_same_value(MeasurementLog.load(tmp_path / "log.npz"), log)


# --------------------------------------------------------------------------------------------
# Values that no run measures


def spoilt(array: np.ndarray[Any, Any], at: object, value: object) -> Any:
    out = array.copy()
    out[at] = value
    return out


def seen(name: str, at: object, value: object) -> Callable[[Increment], Increment]:
    def change(step: Increment) -> Increment:
        array = spoilt(getattr(step.observations, name), at, value)
        return replace(step, observations=replace(step.observations, **{name: array}))

    return change


def moved(**change: Any) -> Callable[[Increment], Increment]:
    return lambda step: replace(step, odometry=replace(step.odometry, **change))


def turned(**change: Any) -> Callable[[Increment], Increment]:
    turn = replace(TURN, bias=replace(BIAS, **change))
    return lambda step: replace(step, odometry=turn)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda step: replace(step, timestamp=np.nan), "timestamp: a number is not finite"),
        (lambda step: replace(step, timestamp=0.0), "timestamp is out of order"),
        (seen("measurement", (3, 1), np.inf), "measurement: a number is not finite"),
        (seen("covariance", (2, 0, 0), -1.0), "measurement: number 10 is no covariance"),
        (seen("measurement", (slice(None), 2), -9.0), "left and right are swapped"),
        (seen("ids", slice(0, 2), 7), "observes a landmark twice"),
        (moved(covariance=-np.eye(6)), "odometry: number 2 is no covariance"),
        (moved(motion=np.full((4, 4), np.inf)), "odometry: number 2 is no rigid motion"),
        (turned(applied=np.full(3, np.nan)), "gyroscope: a number is not finite"),
        (turned(left=-np.eye(3)), "gyroscope: number 0 is no covariance"),
        (turned(start_variance=0.0), "gyroscope: number 0 is no covariance"),
        (lambda step: replace(step, rejected=np.zeros(2, bool)), "differ in length"),
        (lambda step: replace(step, rig_correction=np.zeros(2)), "rig_correction has not"),
        (lambda step: replace(step, settled_rig=SettledRig(0, 0, -1.0)), "field_px is -1.0"),
    ],
)
def test_values_that_no_run_measures_are_refused(
    change: Callable[[Increment], Increment], words: str, log: MeasurementLog, tmp_path: Path
) -> None:
    log.increments[4] = change(log.increments[4])
    log.save(tmp_path / "log.npz")
    with pytest.raises(MeasurementLogError, match=re.escape(words)) as caught:
        MeasurementLog.load(tmp_path / "log.npz")
    assert str(caught.value).startswith(f"{tmp_path / 'log.npz'}: ")
    assert str(caught.value).endswith("; run again")


@pytest.mark.parametrize("frame", [-1, 2, 5])
def test_a_loop_that_does_not_lead_back_is_refused(
    looped: MeasurementLog, frame: int, tmp_path: Path
) -> None:
    step = looped.increments[2]
    looped.increments[2] = replace(step, loops=(replace(step.loops[0], frame=frame),))
    looped.save(tmp_path / "log.npz")
    with pytest.raises(MeasurementLogError, match=f"frame 2 leads to frame {frame}"):
        MeasurementLog.load(tmp_path / "log.npz")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("fx", -100.0, "fx is -100.0, not a positive number"),
        ("baseline", 0, "baseline is 0"),
        ("width", 1.5, "width is 1.5; give the images' size"),
        ("cx", 1e9, "cx is 1000000000.0, far from the image of 320x240"),
        ("bTc", 2.0 * np.eye(4), "bTc must be a rigid motion"),
    ],
)
def test_a_calibration_that_cannot_be_one_is_refused(
    key: str, value: Any, words: str, tmp_path: Path
) -> None:
    MeasurementLog(replace(RIG, **{key: value}), {}).save(tmp_path / "log.npz")
    expected = re.escape(f"the log's rig cannot be one: {words}")
    with pytest.raises(MeasurementLogError, match=expected):
        MeasurementLog.load(tmp_path / "log.npz")
