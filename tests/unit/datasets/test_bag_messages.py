"""Where the cameras of a bag are: tf_static, camera_info of a part of the image."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import (
    PERIOD_NS,
    START_NS,
    Written,
    camera_info,
    compressed_image,
    gyroscope,
    in_frames,
    odometry,
    raw_image,
    stereo,
    tf_static,
    write_bag,
)
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture, write_calibration

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA as AHEAD
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings

LEFT, RIGHT = "left_optical", "right_optical"
FRAMES = {"/cam/left": LEFT, "/cam/right": RIGHT}
BASELINE = CALIBRATION["baseline_m"]
ON_MAST = pose(so3_exp(np.array([0.0, 0.1, 0.3])), np.array([0.4, 0.1, 0.5]))


def shifted(x: float, y: float = 0.0, z: float = 0.0) -> FloatArray:
    return pose(np.eye(3), np.array([x, y, z]))


def robot() -> list[tuple[str, str, FloatArray]]:
    """base_link carries a mast, that the left camera, which the right one hangs on."""
    return [
        (LEFT, RIGHT, shifted(BASELINE)),
        ("mast", LEFT, AHEAD),
        ("/base_link", "mast", ON_MAST),
    ]


def without_baseline(messages: list[Written]) -> list[Written]:
    return [(t, s, k, camera_info(0.0) if k.endswith("Info") else f) for t, s, k, f in messages]


def moving() -> list[Written]:
    stamps = [START_NS + k * PERIOD_NS // 2 for k in range(9)]
    return odometry(stamps, np.column_stack([0.05 * np.arange(9.0), np.zeros((9, 3))]))


def opened(path: Path, **settings: Any) -> Recording:
    return open_recording(BagSettings(path=str(path), **settings), RecordedOdometrySettings())


def mosaic_of(image: Image, pattern: str) -> Image:
    """What a sensor with that pattern of colours in its first two rows sees."""
    rows, columns = np.indices(image.shape[:2])
    channel = np.array(["rgb".index(letter) for letter in pattern]).reshape(2, 2)
    return np.take_along_axis(image, channel[rows % 2, columns % 2][..., None], 2)[..., 0]


# --------------------------------------------------------------------------------------------
# On the robot


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_tf_static_says_where_the_camera_is_on_the_robot(tmp_path: Path, ending: str) -> None:
    messages = in_frames(stereo(4), FRAMES) + moving() + tf_static(robot())
    recording = opened(write_bag(tmp_path / f"a{ending}", messages))
    expected = ON_MAST @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)
    assert recording.notes[-1].startswith("by tf_static the right camera is 0.")
    assert "from base_link, whose motion /odom is" in recording.notes[-1]


def test_one_frame_for_both_cameras_is_the_left_ones(tmp_path: Path) -> None:
    messages = in_frames(stereo(4), {"/cam": LEFT}) + moving() + tf_static(robot())
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    expected = ON_MAST @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)


def test_a_unit_is_that_of_camera_info_and_frames_are_in_metres(tmp_path: Path) -> None:
    """Both cameras in the left one's frame: its distance from the right one is in millimetres."""
    far = [
        (t, s, k, f | {"p": f["p"] * ([1, 1, 1, 1000] * 3)} if k.endswith("Info") else f)
        for t, s, k, f in stereo(4)
    ]
    messages = in_frames(far, {"/cam": LEFT}) + moving() + tf_static(robot())
    recording = opened(write_bag(tmp_path / "a.bag", messages), unit_m=0.001)
    expected = ON_MAST @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)
    own = in_frames(without_baseline(stereo(4)), FRAMES) + tf_static(robot())
    recording = opened(write_bag(tmp_path / "b.bag", own), unit_m=0.001)
    assert recording.rig.baseline == pytest.approx(BASELINE, abs=1e-9)


def test_a_gyroscope_turns_in_its_own_frame(tmp_path: Path) -> None:
    stamps = [START_NS + k * PERIOD_NS // 10 for k in range(40)]
    turns = in_frames(gyroscope(stamps, np.array([0.1, 0.0, 0.0])), {"/imu": "imu"})
    imu = pose(so3_exp(np.array([0.0, 0.0, 1.0])), np.array([0.0, 0.0, 0.1]))
    frames = tf_static([*robot(), ("mast", "imu", imu)])
    recording = opened(
        write_bag(tmp_path / "a.mcap", in_frames(stereo(4), FRAMES) + turns + frames)
    )
    expected = inverse(imu) @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)


def test_a_calibration_file_is_placed_by_the_frames_as_well(tmp_path: Path) -> None:
    write_calibration(tmp_path)
    messages = in_frames(stereo(4), FRAMES) + moving() + tf_static(robot())
    recording = opened(
        write_bag(tmp_path / "a.bag", messages), camera_file=str(tmp_path / "calib.json")
    )
    expected = ON_MAST @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)


def test_a_frame_with_a_robots_axes_is_recognised(tmp_path: Path) -> None:
    """As simulators publish: x ahead, the right camera at -y."""
    frames = {"/cam/left": "left_link", "/cam/right": "right_link"}
    tree = [
        ("base_link", "left_link", ON_MAST),
        ("left_link", "right_link", shifted(0.0, -BASELINE)),
    ]
    messages = in_frames(without_baseline(stereo(4)), frames) + moving() + tf_static(tree)
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    assert recording.rig.baseline == pytest.approx(BASELINE, abs=1e-9)
    expected = ON_MAST @ shifted(0.0, -BASELINE) @ AHEAD
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)
    assert any("has the axes of a robot" in note for note in recording.notes)


def test_what_the_frames_do_not_connect_is_said_and_the_camera_looks_ahead(tmp_path: Path) -> None:
    messages = in_frames(stereo(4), FRAMES) + moving() + tf_static(robot()[:2])
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    np.testing.assert_array_equal(recording.rig.bTc, AHEAD)
    assert "tf_static has no frame base_link; it has left_optical, mast, ri" in recording.notes[-1]


@pytest.mark.parametrize("by", ["calibration", "frame"])
def test_a_gyroscope_may_have_the_axes_of_a_camera(tmp_path: Path, by: str) -> None:
    """As RealSense's: its frame is optical, or a calibration's T_cam_imu is hardly turned."""
    stamps = [START_NS + k * PERIOD_NS // 4 for k in range(16)]
    frames = {"/imu": "imu_optical" if by == "frame" else "imu"}
    messages = stereo(4) + in_frames(gyroscope(stamps, np.array([0.0, 0.3, 0.0])), frames)
    iTc = pose(so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.005, 0.01, 0.012]))
    lens = {"camera_model": "pinhole", "distortion_model": "none", "resolution": [WIDTH, HEIGHT]}
    lens["intrinsics"] = [CALIBRATION[name] for name in ("fx", "fy", "cx", "cy")]
    chain = {
        f"cam{k}": lens | {"T_cam_imu": inverse(iTc @ shifted(k * BASELINE)).tolist()}
        for k in (0, 1)
    }
    file = tmp_path / "camchain.yaml"
    file.write_text(json.dumps(chain), encoding="utf-8")
    given = {} if by == "frame" else {"camera_file": str(file)}
    recording = opened(write_bag(tmp_path / "a.mcap", messages), **given)
    expected = np.eye(4) if by == "frame" else iTc @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-6)
    said = any("imu_optical has a camera's axes" in note for note in recording.notes)
    assert said == (by == "frame")


def test_without_tf_static_what_stays_in_tf_counts(tmp_path: Path) -> None:
    """As ROS 1 publishes it, again and again; the wheels turn, the robot moves in odom."""
    turning = []
    for k in range(4):
        wheel = ("base_link", "wheel", pose(so3_exp(np.array([0.0, 0.1 * k, 0.0])), np.zeros(3)))
        on_floor = ("odom", "base_link", shifted(0.1 * k))
        stamp = START_NS + k * PERIOD_NS
        fields = {"transforms": [*robot(), wheel, on_floor]}
        turning.append(("/tf", stamp, "tf2_msgs/msg/TFMessage", fields))
    messages = in_frames(stereo(4), FRAMES) + moving() + turning
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    expected = ON_MAST @ AHEAD @ shifted(BASELINE)
    np.testing.assert_allclose(recording.rig.bTc, expected, rtol=0.0, atol=1e-9)


# --------------------------------------------------------------------------------------------
# Between the cameras


def test_tf_static_gives_the_baseline_that_camera_info_lacks(tmp_path: Path) -> None:
    messages = in_frames(without_baseline(stereo(4)), FRAMES) + tf_static(robot())
    recording = opened(write_bag(tmp_path / "a.mcap", messages))
    assert recording.rig.baseline == pytest.approx(BASELINE, abs=1e-9)
    assert "camera_info has no baseline: by tf_static right_optical is 0.2" in recording.notes[-1]
    assert int(recording.frame(1).images[0][0, 0]) == 11


def test_a_tree_in_millimetres_is_doubted_with_a_mend_that_works(tmp_path: Path) -> None:
    tree = tf_static([(LEFT, RIGHT, shifted(1000.0 * BASELINE))])
    messages = in_frames(without_baseline(stereo(2)), FRAMES) + tree
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    doubted = [note for note in recording.notes if "200 m from" in note]
    assert doubted[0].endswith("tf_static is in metres; give the calibration by --camera FILE")
    assert not any("--unit" in note for note in recording.notes)


def test_cameras_that_the_frames_swap_are_taken_as_they_stand(tmp_path: Path) -> None:
    tree = tf_static([(LEFT, RIGHT, shifted(-BASELINE))])
    messages = in_frames(without_baseline(stereo(2)), FRAMES) + tree
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    assert recording.rig.baseline == pytest.approx(BASELINE, abs=1e-9)
    assert any("left and right are swapped" in note for note in recording.notes)
    assert int(recording.frame(0).images[0][0, 0]) == 60


BAD_TREES = {
    "runs in a circle: left_optical under right_optical under left_optical": [
        (RIGHT, LEFT, shifted(-BASELINE)),
        (LEFT, RIGHT, shifted(BASELINE)),
    ],
    "does not connect left_optical with right_optical": [
        ("a", LEFT, np.eye(4)),
        ("b", RIGHT, np.eye(4)),
    ],
    "has no frame left_optical; it has a, right_optical": [("a", RIGHT, np.eye(4))],
    "the transform of left_optical is none: nan": [
        ("a", LEFT, shifted(np.nan)),
        ("a", RIGHT, np.eye(4)),
    ],
}


@pytest.mark.parametrize("words", BAD_TREES)
def test_a_tree_that_says_nothing_is_one_line(tmp_path: Path, words: str) -> None:
    messages = in_frames(without_baseline(stereo(2)), FRAMES) + tf_static(BAD_TREES[words])
    path = write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(CalibrationError, match=words) as raised:
        opened(path)
    assert "\n" not in str(raised.value)
    assert "states no baseline" in str(raised.value)
    assert "give the calibration of both by --camera FILE" in str(raised.value)
    write_calibration(tmp_path)
    assert opened(path, camera_file=str(tmp_path / "calib.json")).rig.baseline == BASELINE


# --------------------------------------------------------------------------------------------
# Calibrations of other images than those sent


def of_double_size(shift: float, **more: Any) -> dict[str, Any]:
    """camera_info of images twice as large: pixel centres stay, (2 c + 0.5)."""
    info = camera_info(shift)
    k, p = (info[name].reshape(3, -1) * 2.0 for name in "kp")
    for matrix in (k, p):
        matrix[:2, 2] += 0.5
        matrix[2, 2] = 1.0
    sizes = {"width": 2 * WIDTH, "height": 2 * HEIGHT}
    return {**info, "k": k.ravel(), "p": p.ravel(), **sizes, **more}


def larger(messages: list[Written], **more: Any) -> list[Written]:
    shifts = {"/cam/left": 0.0, "/cam/right": -CALIBRATION["fx"] * BASELINE}
    return [
        (t, s, k, of_double_size(shifts[t.removesuffix("/camera_info")], **more))
        if k.endswith("Info")
        else (t, s, k, f)
        for t, s, k, f in messages
    ]


def require_as_calibrated(recording: Recording) -> None:
    rig = recording.rig
    found = (rig.width, rig.height, rig.fx, rig.cx, rig.cy, rig.baseline)
    expected = (WIDTH, HEIGHT, *(CALIBRATION[name] for name in ("fx", "cx", "cy", "baseline_m")))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_binned_images_have_the_calibration_that_camera_info_says(tmp_path: Path) -> None:
    messages = larger(stereo(2), binning_x=2, binning_y=2)
    require_as_calibrated(opened(write_bag(tmp_path / "a.bag", messages)))


def test_a_region_of_interest_shifts_the_principal_point(tmp_path: Path) -> None:
    messages = [
        (t, s, k, {**f, "width": WIDTH + 9, "height": HEIGHT + 5, "roi": (6, 2, WIDTH, HEIGHT)})
        if k.endswith("Info")
        else (t, s, k, f)
        for t, s, k, f in stereo(2)
    ]
    rig = opened(write_bag(tmp_path / "a.bag", messages)).rig
    expected = (CALIBRATION["cx"] - 6.0, CALIBRATION["cy"] - 2.0)
    np.testing.assert_allclose((rig.cx, rig.cy), expected, rtol=0.0, atol=1e-9)


def test_a_calibration_of_larger_images_is_scaled_only_when_asked(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", larger(stereo(2)))
    with pytest.raises(
        CalibrationError, match=r"64x48 pixels, the images have 32x24; if .*resized"
    ):
        opened(path)
    require_as_calibrated(opened(path, resized=True))


def test_camera_info_without_numbers_is_no_calibration_but_without_lens_it_is(
    tmp_path: Path,
) -> None:
    def changed(**values: Any) -> list[Written]:
        return [(t, s, k, {**f, **values} if k.endswith("Info") else f) for t, s, k, f in stereo(2)]

    require_as_calibrated(opened(write_bag(tmp_path / "a.bag", changed(d=np.zeros(0)))))
    zeros = {"k": np.zeros(9), "p": np.zeros(12), "r": np.zeros(9), "d": np.zeros(0)}
    with pytest.raises(CalibrationError, match="/cam/left/camera_info is of a camera that is not"):
        opened(write_bag(tmp_path / "b.bag", changed(**zeros)))


# --------------------------------------------------------------------------------------------
# Pixels


def test_pixels_of_ten_bits_become_eight_by_one_scale_for_all(tmp_path: Path) -> None:
    """The third pair is dark: what it shows is not stretched."""

    def encode(image: Image) -> dict[str, Any]:
        share = 4 if image[0, 0] not in (12, 62) else 1
        return raw_image(image.astype(np.uint16) * share, "mono16")

    recording = opened(write_bag(tmp_path / "a.mcap", stereo(4, encode)))
    for i, code in enumerate((10, 11, 12, 13)):
        expected = picture(code) if i != 2 else picture(code) // 4
        np.testing.assert_array_equal(recording.frame(i).images[0], expected)
    assert "pixels of 16 bits hold 10: none of 4 frames looked at" in recording.notes[0]


RED = np.dstack([np.full((HEIGHT, WIDTH), v, np.uint8) for v in (200, 40, 10)])  # in R, G, B
BLUE_FIRST = RED[:, :, ::-1].copy()
COLOURS: dict[str, dict[str, Any]] = {
    "rgb8": raw_image(RED, "rgb8"),
    "bgr8": raw_image(BLUE_FIRST, "bgr8"),
    "rgba8": raw_image(np.dstack([RED, RED[:, :, 0]]), "rgba8"),
    "bgra8": raw_image(np.dstack([BLUE_FIRST, RED[:, :, 0]]), "bgra8"),
    "rgb16 of 12 bits": raw_image(RED.astype(np.uint16) * 16, "rgb16"),
    "png": compressed_image(BLUE_FIRST),
    "jpg": compressed_image(BLUE_FIRST, ".jpg"),
    "bayer_rggb8": raw_image(mosaic_of(RED, "rggb"), "bayer_rggb8"),
    "bayer_grbg8": raw_image(mosaic_of(RED, "grbg"), "bayer_grbg8"),
    "bayer_bggr16": raw_image(mosaic_of(RED, "bggr").astype(np.uint16) << 8, "bayer_bggr16"),
    "mosaic in png": {
        **compressed_image(mosaic_of(RED, "gbrg")),
        "format": "bayer_gbrg8; png compressed ",
    },
    "mosaic made colour before": {
        **compressed_image(BLUE_FIRST),
        "format": "bayer_gbrg8; png compressed bgr8",
    },
}


@pytest.mark.parametrize("name", COLOURS)
def test_colour_stays_colour(tmp_path: Path, name: str) -> None:
    recording = opened(write_bag(tmp_path / "a.mcap", stereo(1, lambda _: COLOURS[name])))
    for image in recording.colour(0):
        assert image.shape == (HEIGHT, WIDTH, 3)
        inner = image[4:-4, 4:-4].astype(int)
        assert np.abs(inner - RED[4:-4, 4:-4]).max() <= 3
    grey = 0.299 * 200 + 0.587 * 40 + 0.114 * 10
    assert np.abs(recording.frame(0).images[0][4:-4, 4:-4] - grey).max() <= 1.5


def of_planes(swapped: bool) -> Image:
    """The colour as one plane of luma and one of both chromas, by OpenCV (BT.601)."""
    planar = cv2.cvtColor(RED, cv2.COLOR_RGB2YUV_I420)
    chroma = planar[HEIGHT:].reshape(2, -1)[:: -1 if swapped else 1]
    return np.vstack([planar[:HEIGHT], chroma.T.reshape(HEIGHT // 2, WIDTH)])


def of_pairs(code: int) -> Image:
    return np.asarray(cv2.cvtColor(RED, code))


VIDEO: dict[str, dict[str, Any]] = {
    "nv12": raw_image(of_planes(False), "nv12", padding=5) | {"height": HEIGHT},
    "nv21": raw_image(of_planes(True), "nv21") | {"height": HEIGHT},
    "uyvy": raw_image(of_pairs(cv2.COLOR_RGB2YUV_UYVY), "uyvy"),
    "yuv422": raw_image(of_pairs(cv2.COLOR_RGB2YUV_UYVY), "yuv422"),
    "yuyv": raw_image(of_pairs(cv2.COLOR_RGB2YUV_YUYV), "yuyv"),
    "yuv422_yuy2": raw_image(of_pairs(cv2.COLOR_RGB2YUV_YUYV), "yuv422_yuy2"),
}


@pytest.mark.parametrize("name", VIDEO)
def test_the_encodings_of_video_have_colour(tmp_path: Path, name: str) -> None:
    recording = opened(write_bag(tmp_path / "a.mcap", stereo(1, lambda _: VIDEO[name])))
    assert np.abs(recording.colour(0)[1].astype(int) - RED).max() <= 3
    luma = cv2.cvtColor(RED, cv2.COLOR_RGB2YUV_I420)[0, 0]
    assert np.abs(recording.frame(0).images[1].astype(int) - luma).max() <= 1


def test_planes_that_are_cut_or_odd_are_refused(tmp_path: Path) -> None:
    for image in (of_planes(False)[:HEIGHT], of_planes(False)[:, 1:]):
        fields = raw_image(image, "nv12") | {"height": HEIGHT}
        bag = write_bag(tmp_path / f"{image.shape}.mcap", stereo(1, lambda _, f=fields: f))
        with pytest.raises(DatasetError, match=r"bytes are no image of 3.x24 nv12; record"):
            opened(bag)


def test_grey_images_have_no_colour(tmp_path: Path) -> None:
    recording = opened(write_bag(tmp_path / "a.bag", stereo(1)))
    np.testing.assert_array_equal(recording.colour(0)[0], picture(10))
