"""The measurement log keeps every bit, and refuses files that are not one."""

from __future__ import annotations

import io
import json
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from simulated import assert_same_bits

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
from fgslam.core.store import load_arrays, write_arrays

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


def assert_same(a: object, b: object) -> None:
    """Equal to the bit, NaN included, however deep."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif hasattr(a, "__dataclass_fields__"):
        for item in fields(a):  # type: ignore[arg-type]
            assert_same(getattr(a, item.name), getattr(b, item.name))
    elif isinstance(a, tuple) and isinstance(b, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    else:
        assert a == b


def test_every_bit_survives(log: MeasurementLog, file: Path) -> None:
    loaded = MeasurementLog.load(file)
    assert_same(loaded.rig, log.rig)
    assert loaded.motion_model == log.motion_model
    assert len(loaded) == len(log) == 6
    for before, after in zip(log, loaded, strict=True):
        assert_same(after, before)


def test_the_same_log_gives_the_same_bytes(file: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    MeasurementLog.load(file).save(again / "measurements.npz")
    assert (again / "measurements.npz").read_bytes() == file.read_bytes()


def test_a_two_camera_rig_and_an_empty_log(tmp_path: Path) -> None:
    rig = CameraRig(64, 48, 50.0, 50.0, 31.5, 23.5, 0.2, None, np.eye(4))
    MeasurementLog(rig, {}).save(tmp_path / "measurements.npz")
    loaded = MeasurementLog.load(tmp_path / "measurements.npz")
    assert len(loaded) == 0
    assert loaded.rig.vertical_baseline is None
    assert loaded.rig.cameras == 2


@pytest.mark.parametrize("exact", [True, False])
def test_a_log_says_whether_its_rig_is_exact(exact: bool, tmp_path: Path) -> None:
    MeasurementLog(replace(RIG, exact=exact), {}).save(tmp_path / "measurements.npz")
    loaded = MeasurementLog.load(tmp_path / "measurements.npz").rig
    assert isinstance(loaded, CameraRig)
    assert loaded.exact is exact


@pytest.mark.parametrize("places", get_args(RigPlaces))
def test_a_log_says_which_images_tell_a_place(places: RigPlaces, tmp_path: Path) -> None:
    MeasurementLog(replace(RIG, places=places), {}).save(tmp_path / "measurements.npz")
    loaded = MeasurementLog.load(tmp_path / "measurements.npz").rig
    assert isinstance(loaded, CameraRig)
    assert loaded.places == places


def test_time_may_not_run_backwards(log: MeasurementLog, rng: np.random.Generator) -> None:
    late = increment(5, rng, 2, with_odometry=True)
    with pytest.raises(MeasurementLogError, match=r"does not come after .*; sort"):
        log.append(late)
    assert len(log) == 6


def test_a_file_with_times_backwards_is_refused(file: Path) -> None:
    arrays = load_arrays(file)
    arrays["timestamp"][3] = arrays["timestamp"][2]
    with pytest.raises(MeasurementLogError, match="does not come after"):
        MeasurementLog.from_arrays(arrays, "x.npz")


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(file: Path, keep: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(MeasurementLogError, match=re.escape(str(file)) + r".*truncated, run again"):
        MeasurementLog.load(file)


def test_damage_is_refused_or_harmless(file: Path, rng: np.random.Generator) -> None:
    """Any flipped byte: either one clear refusal, or a spot that carries no measurement."""
    data, whole = file.read_bytes(), MeasurementLog.load(file)
    refused = 0
    for at in rng.integers(0, len(data), 150):
        broken = bytearray(data)
        broken[at] ^= 0xFF
        file.write_bytes(bytes(broken))
        message = ""
        try:
            loaded = MeasurementLog.load(file)
        except MeasurementLogError as error:
            message = str(error)
        if message:
            refused += 1
            assert message.startswith(str(file))
            assert "\n" not in message
        else:
            for before, after in zip(whole, loaded, strict=True):
                assert_same(after, before)
    assert refused > 100


def test_missing_file_folder_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(MeasurementLogError, match="no such file"):
        MeasurementLog.load(tmp_path / "measurements.npz")
    with pytest.raises(MeasurementLogError, match="is a folder"):
        MeasurementLog.load(tmp_path)
    text = tmp_path / "text.npz"
    text.write_text("hello", encoding="utf-8")
    with pytest.raises(MeasurementLogError, match=r"not a readable measurement log"):
        MeasurementLog.load(text)
    bare = tmp_path / "bare.npz"
    with bare.open("wb") as stream:
        np.save(stream, np.eye(3))
    with pytest.raises(MeasurementLogError, match=r"not a readable measurement log"):
        MeasurementLog.load(bare)
    foreign = tmp_path / "foreign.npz"
    write_arrays(foreign, {"a": np.eye(3)})
    with pytest.raises(MeasurementLogError, match="not an fgslam measurement log"):
        MeasurementLog.load(foreign)


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (tmp_path / "exploded",)  # type: ignore[return-value]

    evil = tmp_path / "evil.npz"
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array([Bomb()], dtype=object))
    evil.write_bytes(buffer.getvalue())
    with pytest.raises(MeasurementLogError, match=r"not a readable measurement log"):
        MeasurementLog.load(evil)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("version", [1, 4, 5, 8, 99, "2", None])
def test_another_version_is_refused(file: Path, version: object) -> None:
    arrays = load_arrays(file)
    header = json.loads(str(arrays["header"])) | {"version": version}
    arrays["header"] = np.array(json.dumps(header))
    with pytest.raises(MeasurementLogError, match="made by another version; run again"):
        MeasurementLog.from_arrays(arrays, "x.npz")


@pytest.mark.parametrize(
    "change",
    [
        {"sensor": None},
        {"sensor": 7},
        {"sensor": {"kind": "stereo", "width": 3}},
        {"sensor": {"kind": "sonar", "max_range_m": 3.0}},
        {"motion": 7},
    ],
)
def test_a_header_that_lacks_something_is_refused(file: Path, change: dict[str, object]) -> None:
    arrays = load_arrays(file)
    arrays["header"] = np.array(json.dumps(json.loads(str(arrays["header"])) | change))
    with pytest.raises(MeasurementLogError, match="header"):
        MeasurementLog.from_arrays(arrays, "x.npz")


def test_each_array_must_be_there_whole_and_of_its_type(file: Path) -> None:
    whole = load_arrays(file)
    for name in whole.keys() - {"header"}:
        broken: list[dict[str, np.ndarray]] = [
            {k: v for k, v in whole.items() if k != name},
            whole | {name: whole[name][:-1]},
            whole | {name: np.full(whole[name].shape, "x")},
        ]
        for arrays in broken:
            with pytest.raises(MeasurementLogError, match=r"x\.npz: array .* absent or damaged"):
                MeasurementLog.from_arrays(arrays, "x.npz")


def test_offsets_that_step_back_are_refused(file: Path) -> None:
    arrays = load_arrays(file)
    arrays["observation_start"][1] = 15
    with pytest.raises(MeasurementLogError, match="observation_start"):
        MeasurementLog.from_arrays(arrays, "x.npz")


# --------------------------------------------------------------------------------------------
# Version 3: loop closures and relocalised frames


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
    for before, after in zip(looped, loaded, strict=True):
        assert_same(after, before)


def test_a_relocalised_frame_alone_makes_version_3(log: MeasurementLog, tmp_path: Path) -> None:
    log.increments[5] = replace(log.increments[5], relocalised=True)
    log.save(tmp_path / "measurements.npz")
    loaded = MeasurementLog.load(tmp_path / "measurements.npz")
    assert [s.relocalised for s in loaded] == [False] * 5 + [True]


def test_a_log_without_loops_stays_version_2(file: Path) -> None:
    """Older programs read it."""
    arrays = load_arrays(file)
    assert json.loads(str(arrays["header"]))["version"] == 2
    assert not [name for name in arrays if "loop" in name or "relocalised" in name]


def test_each_array_of_the_loops_must_be_there_whole_and_of_its_type(
    looped: MeasurementLog,
) -> None:
    whole = looped.to_arrays()
    names = [name for name in whole if name.startswith("loop") or name == "relocalised"]
    assert len(names) == 13
    for name in names:
        broken: list[dict[str, np.ndarray]] = [
            {k: v for k, v in whole.items() if k != name},
            whole | {name: whole[name][:-1]},
            whole | {name: np.array(0)},
            whole | {name: np.full(whole[name].shape, "x")},
        ]
        for arrays in broken:
            with pytest.raises(MeasurementLogError, match=r"x\.npz: array .* absent or damaged"):
                MeasurementLog.from_arrays(arrays, "x.npz")


@pytest.mark.parametrize("frame", [-1, 2, 5])
def test_a_loop_that_does_not_lead_back_is_refused(looped: MeasurementLog, frame: int) -> None:
    arrays = looped.to_arrays()
    arrays["loop_frame"] = np.array([frame, *arrays["loop_frame"][1:]])
    with pytest.raises(MeasurementLogError, match=f"frame 2 leads to frame {frame}"):
        MeasurementLog.from_arrays(arrays, "x.npz")


def test_corrections_of_the_rig_make_version_6(log: MeasurementLog, tmp_path: Path) -> None:
    terms = len(term_names(RIG))
    log.increments[1] = replace(
        log.increments[1],
        rig_correction=np.arange(terms, dtype=np.float64),
        settled_rig=SettledRig(np.arange(1.0, 1.0 + terms), 2, 0.3),
    )
    log.increments[2] = replace(
        log.increments[2], rig_correction=np.zeros(terms), settled_rig=SettledRig(None, 0)
    )
    log.save(tmp_path / "log.npz")
    arrays = load_arrays(tmp_path / "log.npz")
    assert json.loads(str(arrays["header"]))["version"] == 6
    back = MeasurementLog.load(tmp_path / "log.npz")
    np.testing.assert_array_equal(back.increments[0].rig_correction, np.zeros(terms))
    np.testing.assert_array_equal(back.increments[1].rig_correction, np.arange(terms))
    assert back.increments[0].settled_rig is None
    withdrawn = back.increments[2].settled_rig
    assert withdrawn is not None
    assert (withdrawn.values, withdrawn.knocks) == (None, 0)
    settled = back.increments[1].settled_rig
    assert settled is not None
    assert settled.values is not None
    assert (settled.knocks, settled.field_px) == (2, 0.3)
    np.testing.assert_array_equal(settled.values, np.arange(1.0, 1.0 + terms))
    field = arrays.pop("rig_field_px")
    with pytest.raises(MeasurementLogError, match="rig_field_px"):
        MeasurementLog.from_arrays(arrays, "x.npz")
    for wrong in (field[1:], -field, np.full_like(field, np.nan)):
        with pytest.raises(MeasurementLogError, match="rig_field_px"):
            MeasurementLog.from_arrays(arrays | {"rig_field_px": wrong}, "x.npz")
    write_arrays(tmp_path / "log.npz", arrays | {"rig_correction": arrays["rig_correction"][:, 1:]})
    with pytest.raises(MeasurementLogError, match="rig_correction"):
        MeasurementLog.load(tmp_path / "log.npz")


def test_the_bias_of_a_gyroscope_makes_version_7(log: MeasurementLog, tmp_path: Path) -> None:
    applied, left = np.array([0.01, -0.02, 0.03]), np.diag([1e-6, 2e-6, 3e-6])
    effect = BiasEffect(-0.05 * np.eye(3), 0.003, 1e-11, applied, left)
    turn = Odometry.turn(np.eye(3), 1e-6 * np.eye(3), effect)
    log.increments[1] = replace(log.increments[1], odometry=turn)
    log.save(tmp_path / "log.npz")
    arrays = load_arrays(tmp_path / "log.npz")
    assert json.loads(str(arrays["header"]))["version"] == 7
    back = [increment.odometry for increment in MeasurementLog.load(tmp_path / "log.npz")]
    assert back[1] is not None
    assert_same_bits(back[1], turn)
    assert [step is None or step.bias is None for step in (back[0], back[2])] == [True, True]
    for name, wrong, words in (
        ("gyroscope_bias", np.full((len(back), 3), np.nan), "is not finite"),
        ("gyroscope_bias_covariance", -np.tile(left, (len(back), 1, 1)), "no covariance"),
        ("gyroscope_stability", np.zeros((len(back), 2)), "no covariance"),
        ("gyroscope_jacobian", np.zeros((len(back), 3)), "absent or damaged"),
    ):
        with pytest.raises(MeasurementLogError, match=f"array {name}.* {words}"):
            MeasurementLog.from_arrays(arrays | {name: wrong}, "x.npz")


# --------------------------------------------------------------------------------------------
# Values: shapes that fit may still hold what no run wrote


def spoilt(file: Path, name: str, at: object, value: object) -> Path:
    arrays = load_arrays(file)
    arrays[name][at] = value
    write_arrays(file, arrays)
    return file


@pytest.mark.parametrize(
    ("name", "at", "value", "words"),
    [
        ("timestamp", 0, np.nan, "array timestamp is not finite"),
        ("measurement", (3, 1), np.inf, "array measurement is not finite"),
        ("measurement_covariance", (2, 0), -1.0, "row 2, is no covariance"),
        ("measurement_covariance", (2, 1), 1e6, "row 2, is no covariance"),
        ("measurement_covariance", 4, 0.0, "row 4, is no covariance"),
        ("measurement_covariance", (4, 5), np.nan, "measurement_covariance is not finite"),
        ("odometry_covariance", (1, 0, 0), -1.0, "array odometry_covariance, row 0, is no"),
        ("odometry_covariance", (1, 0, 1), 1e6, "array odometry_covariance, row 0, is no"),
        ("odometry_motion", (1, 2, 2), np.inf, "array odometry_motion is not finite"),
        ("odometry_motion", 1, 2.0 * np.eye(4), "array odometry_motion, row 0, is no rigid"),
        ("rig_bTc", (0, 0), 7.0, "the log's rig cannot be one: bTc must be a rigid motion"),
    ],
)
def test_values_that_no_run_measures_are_refused(
    name: str, at: object, value: object, words: str, file: Path
) -> None:
    with pytest.raises(MeasurementLogError, match=re.escape(words)) as caught:
        MeasurementLog.load(spoilt(file, name, at, value))
    assert str(caught.value).startswith(f"{file}: ")


def test_a_log_in_which_most_lies_behind_the_cameras_is_refused(file: Path) -> None:
    behind = load_arrays(file)["measurement"] * (1.0, 1.0, -1.0)
    some = np.where(np.arange(20)[:, None] < 9, behind, load_arrays(file)["measurement"])
    assert len(MeasurementLog.load(spoilt(file, "measurement", ..., some)))
    words = "20 of 20 disparities are not positive: left and right are swapped, or it is damaged"
    with pytest.raises(MeasurementLogError, match=words):
        MeasurementLog.load(spoilt(file, "measurement", ..., behind))


def test_an_identity_that_one_frame_sees_twice_is_refused(file: Path) -> None:
    first = load_arrays(file)["observation_id"][0]
    with pytest.raises(MeasurementLogError, match=f"observation_id holds {first} twice in part 0"):
        MeasurementLog.load(spoilt(file, "observation_id", 3, first))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("fx", -100.0, "fx is -100.0, not a positive number"),
        ("fy", "x", "fy is 'x', not a positive number"),
        ("baseline", 0, "baseline is 0, not a positive number"),
        ("width", 1.5, "width is 1.5; give the images' size"),
        ("cx", 1e9, "far from the image of 320x240"),
    ],
)
def test_a_calibration_that_cannot_be_one_is_refused(
    key: str, value: object, words: str, file: Path
) -> None:
    arrays = load_arrays(file)
    header = json.loads(str(arrays["header"]))
    header["sensor"][key] = value
    arrays["header"] = np.array(json.dumps(header))
    write_arrays(file, arrays)
    with pytest.raises(MeasurementLogError, match=re.escape(words)):
        MeasurementLog.load(file)
