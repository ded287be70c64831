"""One recording as a folder, in EuRoC's layout, as ROS 1 and ROS 2 bag: one answer, in any dialect.

Dialects are what tools call a lens, the zeros they pad its parameters with, which of a
camera_info's matrices is filled, whether an image shows both views, the clock of each camera, the
unit of depth, and the sensor that measures the motion.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import yaml
from bags import (
    Written,
    camera_info,
    gyroscope,
    in_frames,
    odometry,
    raw_image,
    tf_static,
    twists,
    write_bag,
)
from dataset_builders import (
    HEIGHT,
    PERIOD_NS,
    START_NS,
    WIDTH,
    curve,
    picture,
    save,
    write_euroc_truth,
    write_tum,
)
from hypothesis import given, settings, strategies as st

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import FgslamError
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.runs.config import make_config

FRAMES = 3
CAMERAS = ("left", "right")
BROWN = (-0.03, 0.004, 0.0002, -0.0001)
FISHEYE = (-0.003, 0.04, -0.038, 0.006)
NAMES = {
    "radtan": "radtan plumb_bob radial-tangential rational_polynomial Brown_Conrady "
    "distortion.modified_brown_conrady RadialTangential",
    "equidistant": "equidistant fisheye Kannala_Brandt4 KannalaBrandt equi kb4",
    "fov": "fov FOV",
}
PARAMETERS = {"radtan": BROWN, "equidistant": FISHEYE, "fov": (0.9,)}
IMAGES = ("mono8", "bgr8", "mono16")
WHEELS = ("speeds", "poses")
STEP_M, TURN = 0.04, 0.02  # of the wheels in a frame


class Case(NamedTuple):
    """One recording.

    Attributes:
        model: of the lens; of raw images.
        name: what the tool calls it.
        zeros: that follow its parameters.
        filled: of a camera_info: K and P of raw images, K and P or P alone of rectified ones.
        focal: fx, fy, cx, cy.
        apart: pose of the right camera in the left one.
        pixels: an encoding.
        together: each image shows both views, the left one on the left or above.
        ahead_ns: of the left camera's clock.
        motion: gyroscope, speeds or poses of wheels, or none.
        rate: of the gyroscope, about its axes.
        bTl: pose of the left camera in the gyroscope's axes.
    """

    model: str
    name: str
    zeros: int
    filled: str
    focal: tuple[float, ...]
    apart: FloatArray
    pixels: str
    together: str
    ahead_ns: int
    motion: str
    rate: FloatArray
    bTl: FloatArray

    @property
    def parameters(self) -> list[float]:
        return [*PARAMETERS[self.model], *[0.0] * self.zeros] if self.filled == "raw" else [0.0] * 5

    def stamps(self, camera: str) -> list[int]:
        first = START_NS + (self.ahead_ns if camera == "left" else 0)
        return [first + k * PERIOD_NS for k in range(FRAMES)]

    def views(self, frame: int) -> dict[str, Any]:
        """Images by camera, or the one that shows both."""
        found = {name: picture(code + frame) for name, code in zip(CAMERAS, (60, 10), strict=True)}
        if self.together:
            join = np.hstack if self.together == "side by side" else np.vstack
            found = {"both": join([found["left"], found["right"]])}
        if self.pixels == "bgr8":
            return {name: np.dstack([one] * 3) for name, one in found.items()}
        wide = self.pixels == "mono16"
        return {n: one.astype(np.uint16) << 8 if wide else one for n, one in found.items()}


@st.composite
def cases(draw: st.DrawFn) -> Case:
    number = partial(st.floats, allow_subnormal=False)
    model = draw(st.sampled_from(list(NAMES)))
    filled = draw(st.sampled_from(["raw", "raw", "rectified", "P alone"]))
    together = draw(st.sampled_from(["", "", "", "side by side", "over under"]))
    turn = np.array([draw(number(-0.02, 0.02)) for _ in range(3)]) * (filled == "raw")
    fx = draw(number(45.0, 70.0))
    least = {"radtan": 1, "equidistant": 0, "fov": 0}[model]
    return Case(
        model,
        draw(st.sampled_from(NAMES[model].split())),
        draw(st.integers(least, 4)),
        filled,
        (fx, fx + 1.0, draw(number(14.0, 17.0)), draw(number(10.0, 13.0))),
        pose(so3_exp(turn), np.array([draw(number(0.05, 0.5)), 0.0, 0.0])),
        draw(st.sampled_from(IMAGES)),
        together,
        0 if together else draw(st.sampled_from([0, 0, 37_250_000_000, -3_600_000_000_000])),
        draw(st.sampled_from(["", "gyroscope", *WHEELS])),
        np.array([draw(number(-1.0, 1.0)) for _ in range(3)]),
        pose(so3_exp(np.array([draw(number(-2.0, 2.0)) for _ in range(3)])), np.full(3, 0.1)),
    )


# --------------------------------------------------------------------------------------------
# The recording in each layout


def chain(case: Case, root: Path) -> Path:
    """Kalibr's camchain."""
    poses = (case.bTl, case.bTl @ case.apart)
    values = {}
    for k, bTc in enumerate(poses):
        name = case.name if case.filled == "raw" else "none"
        values[f"cam{k}"] = {
            "camera_model": "pinhole",
            "intrinsics": list(case.focal),
            "distortion_model": name,
            "distortion_coeffs": case.parameters,
            "resolution": [WIDTH, HEIGHT],
            "T_cn_cnm1": inverse(case.apart).tolist(),
            **({"T_cam_imu": inverse(bTc).tolist()} if case.motion == "gyroscope" else {}),
        }
    (root / "camchain.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root / "camchain.yaml"


def folder(case: Case, root: Path) -> tuple[Path, dict[str, str]]:
    """Images named by their times, truth, and a file of odometry."""
    for k in range(FRAMES):
        for camera, image in case.views(k).items():
            place = root if case.together else root / camera
            save(place / f"{case.stamps(camera)[k]}.png", image)
    chain(case, root)
    seconds, wheel_poses = 1e-9 * np.array(case.stamps("right")), wheels()
    if np.array_equal(case.apart[:3, :3], np.eye(3)):  # it is of the rectified camera
        write_tum(root / "gt_left_cam.txt", seconds, truth())
    if case.motion == "poses":
        quaternions = np.column_stack(
            [np.zeros((FRAMES, 2)), np.sin(wheel_poses[:, 3] / 2), np.cos(wheel_poses[:, 3] / 2)]
        )
        rows = np.column_stack([seconds, wheel_poses[:, :3], quaternions])
        np.savetxt(root / "odometry.txt", rows, fmt="%.9f")
    elif case.motion == "speeds":
        speed, yaw_rate = speeds()
        rows = [f"{s:.9f},{speed},{yaw_rate}" for s in seconds]
        (root / "odom.csv").write_text("\n".join(["time,v,w", *rows]), encoding="utf-8")
    elif case.motion:
        x, y, z = case.rate.tolist()
        lines = [f"{s},{x!r},{y!r},{z!r}" for s in gyroscope_stamps(case)]
        (root / "imu.csv").write_text("\n".join(lines), encoding="utf-8")
    return root, {}


def euroc(case: Case, root: Path) -> tuple[Path, dict[str, str]]:
    for k, (camera, bTc) in enumerate(zip(CAMERAS, (case.bTl, case.bTl @ case.apart), strict=True)):
        place, stamps = root / "mav0" / f"cam{k}", case.stamps(camera)
        for frame, stamp in enumerate(stamps):
            save(place / "data" / f"{stamp}.png", case.views(frame)[camera])
        (place / "data.csv").write_text("".join(f"{s},{s}.png\n" for s in stamps), encoding="utf-8")
        values = {
            "T_BS": {"rows": 4, "cols": 4, "data": bTc.ravel().tolist()},
            "intrinsics": list(case.focal),
            "resolution": [WIDTH, HEIGHT],
            "distortion_model": case.name if case.filled == "raw" else "none",
            "distortion_coefficients": case.parameters,
        }
        (place / "sensor.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    # Of the body, whose axes the gyroscope has.
    write_euroc_truth(root, case.stamps("right"), truth() @ inverse(case.bTl), np.eye(4))
    if case.motion == "gyroscope":
        (root / "mav0" / "imu0").mkdir()
        rows = [",".join(map(repr, (s, *case.rate.tolist()))) for s in gyroscope_stamps(case)]
        (root / "mav0" / "imu0" / "data.csv").write_text("\n".join(rows), encoding="utf-8")
    return root, {}


def bag(ending: str, case: Case, root: Path) -> tuple[Path, dict[str, str]]:
    fx, fy, cx, cy = case.focal
    matrix = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    written: list[Written] = []
    for frame in range(FRAMES):
        for camera, image in case.views(frame).items():
            shift = -fx * float(case.apart[0, 3]) if camera == "right" else 0.0
            info = camera_info(shift) | {
                "k": np.zeros(9) if case.filled == "P alone" else matrix,
                "p": np.array([fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
                "d": np.array(case.parameters),
                "distortion_model": case.name if case.filled == "raw" else "plumb_bob",
            }
            if case.filled == "raw":  # the places of the cameras are in tf_static
                info["p"] = np.zeros(12)
            stamp, topic = case.stamps(camera)[frame], f"/{camera}"
            kind = "image_raw" if case.filled == "raw" else "image_rect"
            fields = raw_image(image, case.pixels)
            written.append((f"{topic}/{kind}", stamp, "sensor_msgs/msg/Image", fields))
            if not case.together:
                written.append((f"{topic}/camera_info", stamp, "sensor_msgs/msg/CameraInfo", info))
    stamps, (speed, yaw_rate) = case.stamps("right"), speeds()
    written += {
        "": list,
        "gyroscope": lambda: gyroscope(gyroscope_stamps(case), case.rate),
        "speeds": lambda: twists(stamps, speed, yaw_rate),
        "poses": lambda: odometry(stamps, wheels()),
    }[case.motion]()
    frames = {"/both": "left_optical", **{f"/{camera}": f"{camera}_optical" for camera in CAMERAS}}
    places = [("left_optical", "right_optical", case.apart)]
    if case.motion == "gyroscope":
        places.append(("imu", "left_optical", case.bTl))
    path = write_bag(root / f"one{ending}", in_frames(written, frames | {"/imu": "imu"})
                     + tf_static(places))  # fmt: skip
    return path, {"camera_file": str(chain(case, root))} if case.together else {}


def truth() -> FloatArray:
    """Poses of the left camera."""
    return curve(FRAMES, 0.1)


def wheels() -> FloatArray:
    """x, y, z and heading."""
    along = np.arange(FRAMES)
    return np.column_stack([STEP_M * along, np.zeros((FRAMES, 2)), TURN * along])


def speeds() -> tuple[float, float]:
    return STEP_M / (1e-9 * PERIOD_NS), TURN / (1e-9 * PERIOD_NS)


def gyroscope_stamps(case: Case) -> list[int]:
    first = case.stamps("right")[0]
    return [first + k * PERIOD_NS // 4 for k in range(-2, 4 * FRAMES)]


LAYOUTS: Mapping[str, Callable[[Case, Path], tuple[Path, dict[str, str]]]] = {
    "folder": folder,
    "EuRoC": euroc,
    "ROS 1": partial(bag, ".bag"),
    "ROS 2": partial(bag, ".mcap"),
}


def opened(root: Path, write: Callable[[], tuple[Path, dict[str, Any]]]) -> Recording:
    root.mkdir()
    path, more = write()
    keys = recognise_layout(path) | more
    return open_recording(make_config({"name": "x", "dataset": keys}, str(root)).dataset)  # type: ignore[arg-type]


# --------------------------------------------------------------------------------------------
# One answer


def answers(recording: Recording) -> dict[str, FloatArray]:
    """Everything that a run takes from it; of truth and odometry what it has."""
    rig, stamps = recording.rig, recording.timestamps
    steps = [recording.odometry(k) for k in range(1, len(recording))]
    found = {
        "rig": np.array([rig.fx, rig.fy, rig.cx, rig.cy, rig.baseline, rig.width, rig.height]),
        "stamps": stamps - stamps[0],
        "images": np.array([recording.frame(k).images for k in range(len(recording))], np.float64),
        "odometry": np.array([s.motion for s in steps if s]),
        "noise of odometry": np.array([s.covariance for s in steps if s]),
    }
    if any(steps):  # else nothing rests on it
        found["place on the body"] = rig.bTc
    if recording.ground_truth is not None:
        found["truth"] = recording.ground_truth.poses
    if recording.load_depth is not None:
        found["depth"] = np.array([recording.load_depth(k) for k in range(len(recording))])
    return found


def require_one_answer(found: dict[str, dict[str, FloatArray]], case: object) -> None:
    first, *others = found
    for layout in others:
        for what, value in found[layout].items():
            if what not in found[first] or not len(value):
                continue  # what one of the layouts has no place for
            # A grey level: maps of a rectification are the same up to rounding.
            within = 1.0 if what == "images" else 2e-5
            np.testing.assert_allclose(
                value,
                found[first][what],
                rtol=0.0,
                atol=within,
                err_msg=f"{what}: {layout}, {case}",
            )


def check(case: Case) -> None:
    found = {}
    recordings = {}
    with tempfile.TemporaryDirectory() as place:
        for layout, write in LAYOUTS.items():
            if case.together and layout == "EuRoC":
                continue
            root = Path(place, layout.replace(" ", ""))
            try:
                recordings[layout] = opened(root, lambda w=write, r=root: w(case, r))  # type: ignore[misc]
                found[layout] = answers(recordings[layout])
            except FgslamError as fault:
                raise AssertionError(f"{layout}, {case}: {fault}") from fault
        require_one_answer(found, case)
    first = found["folder"]
    assert first["rig"][4] == pytest.approx(case.apart[0, 3], abs=1e-9)
    np.testing.assert_allclose(
        first["stamps"], 1e-9 * PERIOD_NS * np.arange(FRAMES), rtol=0.0, atol=1e-6
    )
    assert len(first["odometry"]) == (FRAMES - 1 if case.motion else 0)
    for recording in recordings.values():
        said = any("the clock of" in note for note in recording.notes)
        assert said == (case.ahead_ns != 0)
        pairing = next(e for e in recording.ledger if e.what == "clock and pairing")
        assert pairing.guessed == (case.ahead_ns != 0)


@settings(max_examples=3)
@given(cases())
def test_one_recording_has_one_answer(case: Case) -> None:
    check(case)


@pytest.mark.slow
@settings(max_examples=150)
@given(cases())
def test_any_recording_has_one_answer(case: Case) -> None:
    check(case)


# --------------------------------------------------------------------------------------------
# Colour and depth


class Depths(NamedTuple):
    """A recording of colour and depth: metres of its surface, and how a unit is stated."""

    nearest: float
    unit: str
    lens: str

    def metres(self) -> FloatArray:
        slope = np.linspace(self.nearest, 1.5 * self.nearest, WIDTH * HEIGHT)
        return np.asarray(np.round(slope.reshape(HEIGHT, WIDTH), 2))


UNITS = {"millimetres": 1000.0, "tenths": 10000.0, "floats": 1.0}


@st.composite
def depths(draw: st.DrawFn) -> Depths:
    unit = draw(st.sampled_from(list(UNITS)))
    nearest = draw(st.floats(0.5, 4.0, allow_subnormal=False))
    return Depths(nearest, unit, draw(st.sampled_from(["K", "P alone"])))


def stored(case: Depths) -> Any:
    if case.unit == "floats":
        return case.metres().astype(np.float32)
    return np.rint(UNITS[case.unit] * case.metres()).astype(np.uint16)


def colour_image(k: int) -> Any:
    return np.dstack([picture(10 + k)] * 3)


def depth_folder(case: Depths, root: Path) -> tuple[Path, dict[str, Any]]:
    for k in range(FRAMES):
        stamp = START_NS + k * PERIOD_NS
        save(root / "rgb" / f"{stamp}.png", colour_image(k))
        ending = "tiff" if case.unit == "floats" else "png"
        path = root / "depth" / f"{stamp}.{ending}"
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), stored(case))
    values = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 30.0, "ppx": 15.5, "ppy": 11.5}
    if case.unit != "floats":
        values["depth_scale"] = 1.0 / UNITS[case.unit]
    (root / "camera.json").write_text(json.dumps(values), encoding="utf-8")
    return root, {}


def depth_bag(ending: str, case: Depths, root: Path) -> tuple[Path, dict[str, Any]]:
    viewer = "/device_0/sensor_0/Depth_0"  # RealSense's viewer states the unit
    named = {"millimetres": "/camera/aligned_depth_to_color/image_raw"}.get(
        case.unit, f"{viewer}/image/data"
    )
    colour = "/camera/color" if case.unit == "millimetres" else "/device_0/sensor_0/Color_0"
    plain = "/image_rect_color" if case.lens == "P alone" else "/image_raw"
    image = f"{colour}{plain if case.unit == 'millimetres' else '/image/data'}"
    info = camera_info(0.0) | {
        "k": np.array([30.0, 0.0, 15.5, 0.0, 30.0, 11.5, 0.0, 0.0, 1.0]),
        "p": np.array([30.0, 0.0, 15.5, 0.0, 0.0, 30.0, 11.5, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    if case.lens == "P alone":
        info["k"] = np.zeros(9)
    near = f"{colour}/camera_info" if case.unit == "millimetres" else f"{colour}/info/camera_info"
    written: list[Written] = []
    for k in range(FRAMES):
        stamp = START_NS + k * PERIOD_NS
        fields = raw_image(stored(case), "32FC1" if case.unit == "floats" else "16UC1")
        written += [
            (image, stamp, "sensor_msgs/msg/Image", raw_image(colour_image(k), "bgr8")),
            (near, stamp, "sensor_msgs/msg/CameraInfo", info),
            (named, stamp, "sensor_msgs/msg/Image", fields),
        ]
    if case.unit != "millimetres":
        unit = {"data": 1.0 / UNITS[case.unit]}
        topic = "/device_0/sensor_0/option/Depth_Units/value"
        written.append((topic, START_NS, "std_msgs/msg/Float32", unit))
    return write_bag(root / f"one{ending}", written), {}


def check_depth(case: Depths) -> None:
    layouts = {"folder": depth_folder, "ROS 1": partial(depth_bag, ".bag"),
               "ROS 2": partial(depth_bag, ".mcap")}  # fmt: skip
    found = {}
    with tempfile.TemporaryDirectory() as place:
        for layout, write in layouts.items():
            root = Path(place, layout.replace(" ", ""))
            try:
                recording = opened(root, lambda w=write, r=root: w(case, r))  # type: ignore[misc]
                found[layout] = answers(recording)
            except FgslamError as fault:
                raise AssertionError(f"{layout}, {case}: {fault}") from fault
            unit = next(e for e in recording.ledger if e.what == "unit of depth")
            assert not unit.guessed
        require_one_answer(found, case)
    np.testing.assert_allclose(found["folder"]["depth"][0], case.metres(), rtol=0.0, atol=1e-3)


@settings(max_examples=3)
@given(depths())
def test_colour_and_depth_have_one_answer(case: Depths) -> None:
    check_depth(case)


@pytest.mark.slow
@settings(max_examples=100)
@given(depths())
def test_any_colour_and_depth_have_one_answer(case: Depths) -> None:
    check_depth(case)
