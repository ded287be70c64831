"""ROS bags: every format, encoding and fault, against bags that rosbags has written."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
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
    twists,
    write_bag,
)
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture, write_calibration

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import (
    CalibrationError,
    DatasetError,
    FrameError,
    OdometryError,
    OneImageError,
)
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA as AHEAD, inverse, pose, so3_exp
from fgslam.datasets.depth import BASELINE_M
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings
from fgslam.runs.bare import bare_experiment
from fgslam.runs.calibrating import convert_calibration, read_calibration
from fgslam.runs.inspect import check_odometry

# --------------------------------------------------------------------------------------------
# Bags


KINDS = (".bag", ".db3", ".mcap")


def opened(path: Path, **settings: Any) -> Recording:
    return open_recording(BagSettings(path=str(path), **settings), RecordedOdometrySettings())


def codes(recording: Recording, i: int) -> tuple[int, ...]:
    return tuple(int(image[0, 0]) for image in recording.frame(i).images)


@pytest.fixture(params=KINDS)
def ending(request: pytest.FixtureRequest) -> str:
    return str(request.param)


# --------------------------------------------------------------------------------------------
# What is read


def test_every_format_gives_the_same_pixels_stamps_and_rig(tmp_path: Path, ending: str) -> None:
    recording = opened(write_bag(tmp_path / f"walk{ending}", stereo()))
    assert len(recording) == 4
    assert recording.rig.baseline == pytest.approx(0.2, abs=1e-12)
    assert [codes(recording, i) for i in (0, 3, 1, 2)] == [(10, 60), (13, 63), (11, 61), (12, 62)]
    assert np.array_equal(recording.frame(2).images[1], picture(62))
    expected = 1e-9 * (START_NS + PERIOD_NS * np.arange(4))
    assert np.allclose(recording.timestamps, expected, rtol=0.0, atol=1e-6)
    assert recording.notes == ()


def test_a_folder_and_a_pattern_are_bags_too(tmp_path: Path, ending: str) -> None:
    file = write_bag(tmp_path / f"walk{ending}", stereo())
    for given in (file, file.parent, file.parent / f"w*{ending}"):
        assert recognise_layout(given)["kind"] == "bag"
        assert len(opened(given)) == 4
    (file.parent / "metadata.yaml").unlink(missing_ok=True)
    assert len(opened(file.parent)) == 4


def colour(image: Image) -> Image:
    return np.dstack([image, image, image])


ENCODINGS: dict[str, Any] = {
    "rgb8, rows padded": lambda image: raw_image(colour(image), "rgb8", padding=7),
    "mono16": lambda image: raw_image(image.astype(np.uint16) << 8 | 0x7F, "mono16"),
    "png of 16 bits": lambda image: compressed_image(image.astype(np.uint16) << 8),
    "yuv422": lambda image: raw_image(np.dstack([np.full_like(image, 128), image]), "yuv422"),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_encodings_become_the_same_grey(tmp_path: Path, name: str) -> None:
    recording = opened(write_bag(tmp_path / "walk.mcap", stereo(1, ENCODINGS[name])))
    assert np.array_equal(recording.frame(0).images[0], picture(10))


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    encode = partial(raw_image, encoding="32FC7")
    recording_path = write_bag(tmp_path / "a.bag", stereo(1, encode))
    with pytest.raises(DatasetError, match=r"encoding '32FC7' is not read; known: .*bgr8.*bayer"):
        opened(recording_path)


# --------------------------------------------------------------------------------------------
# Pairs and topics


def test_pairs_within_the_tolerance_and_what_was_dropped(tmp_path: Path) -> None:
    messages = stereo(5, skew_ns=4_000_000)
    lonely = [m for m in messages if not (m[0] == "/cam/left/image_raw" and m[3]["data"][0] == 62)]
    recording = opened(write_bag(tmp_path / "a.bag", lonely))
    assert [codes(recording, i) for i in range(4)] == [(10, 60), (11, 61), (13, 63), (14, 64)]
    assert "1 right images have no partner within 20 ms" in recording.notes[0]
    assert "differ in time by 4 ms" in recording.notes[1]


def test_topics_may_be_named_and_depth_is_no_view(tmp_path: Path) -> None:
    messages = stereo(2) + stereo(2, names=("/rear/cam0", "/rear/cam1"))
    messages += [(m[0].replace("cam/left", "depth/left"), *m[1:]) for m in stereo(2)]
    path = write_bag(tmp_path / "a.mcap", messages)
    assert "also there: /rear/cam0/image_raw with /rear/cam1/image_raw" in opened(path).notes[0]
    named = opened(path, topics=("/rear/cam0/image_raw", "/rear/cam1/image_raw"))
    assert named.notes == ()
    for topics, message in (
        (("/nothing",), r"has no topic /nothing with messages; it has /cam/left/camera_info"),
        (("/cam/left/image_raw",), "1 topics of images are named; name the left camera's and"),
        (("/cam/left/camera_info",), "is sensor_msgs/msg/CameraInfo, no image or odometry"),
    ):
        with pytest.raises(DatasetError, match=message):
            opened(path, topics=topics)


def test_headers_without_stamps(tmp_path: Path) -> None:
    messages = [(topic, 0, kind, fields) for topic, _, kind, fields in stereo(1)]
    recording = opened(write_bag(tmp_path / "a.db3", messages))
    assert len(recording) == 1


# --------------------------------------------------------------------------------------------
# Calibration


def test_swapped_names_are_told_by_the_calibration(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", stereo(2, names=("/cam/right", "/cam/left")))
    recording = opened(path)
    assert codes(recording, 0) == (10, 60)
    assert "by their camera_info /cam/left/image_raw is the right camera" in recording.notes[0]


def test_a_definition_of_its_own_is_one_line(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.mcap", stereo(2))
    renamed = path.read_bytes().replace(b"string distortion_model", b"string distortion_motel")
    path.write_bytes(renamed)
    with pytest.raises(DatasetError, match="is without a field of its type"):
        opened(path)


def test_one_camera_info_is_not_enough_but_a_file_is(tmp_path: Path) -> None:
    messages = [m for m in stereo(2) if m[0] != "/cam/right/camera_info"]
    path = write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(CalibrationError, match=r"no camera_info belongs to /cam/right/image_raw, "):
        opened(path)
    write_calibration(tmp_path)
    assert opened(path, camera_file=str(tmp_path / "calib.json")).rig.baseline == 0.2


PLACES = {"right": (0.0, 0.0), "left": (-0.2, 0.0), "top": (0.0, -0.15), "far": (-0.4, 0.0)}


def camchain(folder: Path, topics: Mapping[str, str]) -> str:
    """Kalibr's file of these cameras in this order, each with its topic, or with none."""
    chain: dict[str, dict[str, Any]] = {}
    for k, (name, topic) in enumerate(topics.items()):
        before = PLACES[list(topics)[max(k - 1, 0)]]
        step = np.eye(4)
        step[:2, 3] = np.subtract(before, PLACES[name])
        chain[f"cam{k}"] = {
            "camera_model": "pinhole",
            "intrinsics": [CALIBRATION[key] for key in ("fx", "fy", "cx", "cy")],
            "distortion_model": "radtan",
            "distortion_coeffs": [0.0] * 4,
            "resolution": [WIDTH, HEIGHT],
            **({"T_cn_cnm1": step.tolist()} if k else {}),
            **({"rostopic": topic} if topic else {}),
        }
    file = folder / "camchain.yaml"
    file.write_text(yaml.safe_dump(chain), encoding="utf-8")
    return str(file)


def views(codes: Mapping[str, int], frames: int = 2) -> list[Any]:
    """Images of cameras whose corner pixel is their code and the frame's number."""
    made = [(name, code, k) for k in range(frames) for name, code in codes.items()]
    return [
        (name, START_NS + k * PERIOD_NS, "sensor_msgs/msg/Image", raw_image(picture(code + k)))
        for name, code, k in made
    ]


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_a_camchain_says_which_topics_are_its_cameras(
    tmp_path: Path, order: tuple[str, str]
) -> None:
    """Also which of them is the right one, whatever the names say."""
    images = {"/a/cam1": 60, "/b/cam0": 10, "/cam0/image_raw": 110, "/cam1/image_raw": 120}
    path = write_bag(tmp_path / "a.bag", views(images))
    topics = {"left": "/a/cam1", "right": "/b/cam0"}
    file = camchain(tmp_path, {name: topics[name] for name in order})
    found = bare_experiment(path, Path(file))
    named = ", ".join(topics[name] for name in order)
    assert f"note: topics by rostopic of camchain.yaml: {named}\n" in found.description + "\n"
    assert codes(opened(path, camera_file=file), 1) == (11, 61)
    chosen = opened(path, camera_file=file, topics=("/a/cam1", "/b/cam0"))
    assert codes(chosen, 1) == (11, 61)
    assert not any("rostopic" in note for note in chosen.notes)
    other = camchain(tmp_path, {"left": "/elsewhere", "right": "/b/cam0"})
    by_name = opened(path, camera_file=other)
    assert codes(by_name, 0) == (120, 110)
    assert "no images here of /elsewhere, the rostopic in camchain.yaml" in by_name.notes[0]


def test_the_images_may_be_compressed_that_a_camchain_names(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.mcap", stereo(1, compressed_image, ("/x", "/y")))
    file = camchain(tmp_path, {"left": "/x/image_raw", "right": "y/image_raw"})
    assert codes(opened(path, camera_file=file), 0) == (10, 60)
    written = tmp_path / "again.yaml"
    convert_calibration(read_calibration(Path(file)), written)
    assert codes(opened(path, camera_file=str(written)), 0) == (10, 60)


TRIO = {"top": "/t/image", "left": "/l/image", "right": "/r/image"}


def test_three_cameras(tmp_path: Path) -> None:
    """Their topics by the file's rostopics, by --topics, or by consecutive numbers in names."""
    images = dict(zip(TRIO.values(), (110, 60, 10), strict=True))
    path = write_bag(tmp_path / "a.bag", views(images)[:-1])  # the last image of the right one
    file = camchain(tmp_path, TRIO)
    found = bare_experiment(path, Path(file))
    assert found.description.startswith("a: ROS bag, 3 cameras 32x24; 1 frames")
    recording = opened(path, camera_file=file)
    assert codes(recording, 0) == (10, 60, 110)
    assert recording.rig.vertical_baseline == pytest.approx(0.15)
    assert "1 top images have no partner within 20 ms" in " ".join(recording.notes)
    two = opened(path, camera_file=file, topics=("/l/image", "/r/image"))
    assert codes(two, 0) == (10, 60)
    blank = camchain(tmp_path, dict.fromkeys(TRIO, ""))
    named = opened(path, camera_file=blank, topics=tuple(TRIO.values()))
    assert codes(named, 0) == (10, 60, 110)
    numbered = {f"/cam{k}/image_raw": code for k, code in enumerate(images.values())}
    by_name = opened(write_bag(tmp_path / "b.bag", views(numbered)), camera_file=blank)
    assert codes(by_name, 1) == (11, 61, 111)


def test_three_cameras_need_a_calibration_of_three(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", views(dict.fromkeys(TRIO.values(), 10)))
    topics = tuple(TRIO.values())
    with pytest.raises(DatasetError, match=r"need one calibration of three cameras \(none\)"):
        opened(path, topics=topics)
    pair = camchain(tmp_path, {"left": "", "right": ""})
    with pytest.raises(DatasetError, match=r"\(camchain\.yaml is of 2\); give it by --camera FILE"):
        opened(path, topics=topics, camera_file=pair)


def test_of_four_cameras_some_must_be_chosen(tmp_path: Path) -> None:
    four = {**TRIO, "far": "/f/image"}
    images = dict(zip(four.values(), (110, 60, 10, 160), strict=True))
    path, file = write_bag(tmp_path / "a.bag", views(images)), camchain(tmp_path, four)
    with pytest.raises(DatasetError, match=r"names the topics of 4 cameras, .*: --topics"):
        opened(path, camera_file=file)
    far = opened(path, camera_file=file, topics=("/f/image", "/l/image"))
    assert codes(far, 0) == (60, 160)


def test_of_five_cameras_the_only_stereo_pair_is_taken(tmp_path: Path) -> None:
    """Two look ahead, as of Hilti's, but here not the first ones."""
    images = {f"/cam{k}/image_raw": 40 * k for k in range(5)}
    path = write_bag(tmp_path / "a.bag", views(images))
    file = Path(camchain(tmp_path, dict.fromkeys(PLACES, "")))
    chain = yaml.safe_load(file.read_text())
    chain["cam4"] = dict(chain["cam3"])
    for k, topic in enumerate(images):
        angle = 0.0 if k == 2 else 0.5 * np.pi  # against the camera before: 1 and 2 are alike
        turned = pose(so3_exp(np.array([0.0, angle, 0.0])), np.array([0.2, 0.0, 0.0]))
        chain[f"cam{k}"].update({"T_cn_cnm1": turned.tolist()} if k else {})
        chain[f"cam{k}"].update({"rostopic": topic})
    file.write_text(yaml.safe_dump(chain), encoding="utf-8")
    recording = opened(path, camera_file=str(file))
    assert set(codes(recording, 0)) == {40, 80}
    assert recording.rig.baseline == pytest.approx(0.2)
    assert "only two of them that form a" in recording.notes[0]
    other = ("/cam0/image_raw", "/cam2/image_raw")
    with pytest.raises(CalibrationError, match="look more than 45 degrees apart"):
        opened(path, camera_file=str(file), topics=other)


def test_many_cameras_that_names_do_not_number(tmp_path: Path) -> None:
    file = camchain(tmp_path, dict.fromkeys(PLACES, ""))
    with pytest.raises(CalibrationError, match=r"holds 4 cameras, .* --cameras 0,1"):
        opened(write_bag(tmp_path / "a.bag", stereo(2)), camera_file=file)


def test_cameras_that_look_ahead_come_first(tmp_path: Path) -> None:
    """Spot's others look sideways; a rank by endings would take those."""
    names = ("back", "right", "left", "frontright", "frontleft")
    images = {
        f"/{name}/image{'' if 'front' in name else '_raw'}": 20 * k for k, name in enumerate(names)
    }
    file = camchain(tmp_path, dict.fromkeys(("left", "right"), ""))
    recording = opened(write_bag(tmp_path / "a.bag", views(images)), camera_file=file)
    assert codes(recording, 0) == (60, 80)
    assert "also there: /left/image_raw with /right/image_raw" in recording.notes[0]


def test_a_camera_info_without_baseline(tmp_path: Path) -> None:
    messages = [
        (t, s, k, camera_info(0.0) if k.endswith("CameraInfo") else f) for t, s, k, f in stereo(2)
    ]
    with pytest.raises(CalibrationError, match="has no baseline"):
        opened(write_bag(tmp_path / "a.bag", messages))


def test_a_camera_info_in_millimetres(tmp_path: Path) -> None:
    """The last column of P is -fx times the baseline."""
    far = [
        (t, s, k, f | {"p": f["p"] * ([1, 1, 1, 1000] * 3)} if k.endswith("Info") else f)
        for t, s, k, f in stereo()
    ]
    path = write_bag(tmp_path / "a.bag", far)
    assert any("the baseline is 200 m; if its unit" in note for note in opened(path).notes)
    assert opened(path, unit_m=0.001).rig.baseline == pytest.approx(0.2, abs=1e-9)


def test_rectified_topics_are_not_rectified_again(tmp_path: Path) -> None:
    info = {"d": np.array([-0.3, 0.1, 0.0, 0.0, 0.0])}
    messages = [
        (
            t.replace("image_raw", "image_rect"),
            s,
            k,
            {**f, **(info if k.endswith("CameraInfo") else {})},
        )
        for t, s, k, f in stereo(1)
    ]
    rectified = opened(write_bag(tmp_path / "a.bag", messages))
    assert np.array_equal(rectified.frame(0).images[0], picture(10))


def test_a_first_message_that_is_cut_is_one_lost_frame(tmp_path: Path) -> None:
    messages = stereo(3)
    k = next(i for i, m in enumerate(messages) if m[0] == "/cam/left/image_raw")
    messages[k] = (*messages[k][:3], {**messages[k][3], "kept_bytes": 40})
    recording = opened(write_bag(tmp_path / "a.mcap", messages))
    with pytest.raises(FrameError, match=r"of /cam/left/image_raw .* cannot be decoded"):
        recording.frame(0)
    assert codes(recording, 2) == (12, 62)


# --------------------------------------------------------------------------------------------
# Odometry


def test_poses_of_odometry(tmp_path: Path, ending: str) -> None:
    stamps = [START_NS + k * PERIOD_NS // 2 for k in range(9)]
    poses = np.column_stack([0.05 * np.arange(9.0), np.zeros((9, 2)), np.zeros(9)])
    path = write_bag(tmp_path / f"a{ending}", stereo(4) + odometry(stamps, poses))
    recording = opened(path)
    step = recording.odometry(2)
    assert step is not None
    assert np.allclose(step.motion[:3, 3], [0.1, 0.0, 0.0], rtol=0.0, atol=1e-6)
    # The body looks along x, the camera along z.
    assert np.array_equal(recording.rig.bTc[:3, 2], [1.0, 0.0, 0.0])
    assert "taken to look straight ahead" in recording.notes[-1]
    assert "; odometry; " in bare_experiment(path).description


def test_odometry_that_never_moves_is_told(tmp_path: Path) -> None:
    stamps = [START_NS + k * PERIOD_NS // 2 for k in range(9)]
    bag = write_bag(tmp_path / "a.mcap", stereo() + odometry(stamps, np.ones((9, 4))))
    found = check_odometry(opened(bag))
    assert "states no motion in any of 3 steps; if the robot moved" in found[-1].text
    moving = np.column_stack([np.linspace(0.0, 0.1, 9), np.zeros((9, 3))])
    bag = write_bag(tmp_path / "b.mcap", stereo() + odometry(stamps, moving))
    assert len(check_odometry(opened(bag))) == 1


def test_a_twist_is_speed_and_yaw_rate(tmp_path: Path) -> None:
    stamps = [START_NS + k * PERIOD_NS // 4 for k in range(20)]
    recording = opened(write_bag(tmp_path / "a.mcap", stereo(4) + twists(stamps, 1.0, 0.5)))
    step = recording.odometry(1)
    assert step is not None
    assert np.arctan2(step.motion[1, 0], step.motion[0, 0]) == pytest.approx(0.05, abs=1e-6)


def test_truth_is_no_odometry_and_another_clock_is_said(tmp_path: Path) -> None:
    poses = np.zeros((4, 4))
    stamps = [START_NS + k * PERIOD_NS for k in range(4)]
    truth = odometry(stamps, poses, "/ground_truth/state")
    recording = opened(write_bag(tmp_path / "a.bag", stereo(4) + truth))
    assert recording.odometry_source is None
    assert "not taken for odometry: /ground_truth/state (truth by its name)" in recording.notes[0]
    late = odometry([stamp + 10**12 for stamp in stamps], poses)
    other = opened(write_bag(tmp_path / "b.bag", stereo(4) + late))
    with pytest.raises(OdometryError, match=r"/odom: from .* covers none of the frames"):
        other.odometry(1)


@pytest.mark.parametrize(
    ("topic", "frame", "reason"),
    [
        ("/odometry", "world", "in the global frame world"),
        ("/mavros/local_position/odom", "map", "in the global frame map"),
        ("/leica/pose", "odom", "truth by its name"),
        ("/carla/car/odometry", "odom", "truth of a simulator, by /carla/car/odometry"),
        ("/odometry", "odom", ""),
        ("/wheel/odometry", "world", ""),
    ],
)
def test_poses_that_no_wheel_states_are_told_and_used_only_when_named(
    tmp_path: Path, topic: str, frame: str, reason: str
) -> None:
    stamps = [START_NS + k * PERIOD_NS for k in range(4)]
    poses = in_frames(odometry(stamps, np.zeros((4, 4)), topic), {topic: frame})
    bag = write_bag(tmp_path / "a.mcap", stereo(4) + poses)
    recording = opened(bag)
    assert (recording.odometry_source is None) == bool(reason)
    text = f"not taken for odometry: {topic} ({reason}); --topics LEFT,RIGHT,ODOMETRY takes one"
    assert (text in recording.notes) == bool(reason)
    named = opened(bag, topics=("/cam/left/image_raw", "/cam/right/image_raw", topic))
    assert named.odometry_source is not None


def test_beside_pictures_of_objects_odometry_is_a_simulators_truth(tmp_path: Path) -> None:
    stamps = [START_NS + k * PERIOD_NS for k in range(4)]
    objects = [
        (t.replace("image_raw", "segmentation"), *rest)
        for t, *rest in stereo(4)
        if "image_raw" in t
    ]
    poses = odometry(stamps, np.zeros((4, 4)), "/odometry")
    turns = gyroscope(stamps, np.array([0.0, 0.0, 0.5]))
    recording = opened(write_bag(tmp_path / "a.mcap", stereo(4) + objects + poses + turns))
    reason = "/odometry (truth of a simulator, by /cam/left/segmentation)"
    assert any(reason in note for note in recording.notes)
    assert recording.odometry_source is not None  # the gyroscope's


# --------------------------------------------------------------------------------------------
# Damage


REPAIRS = {
    ".bag": "rosbag reindex walk.bag",
    ".mcap": "mcap recover walk.mcap -o mended.mcap",
    ".db3": r"sqlite3 walk.db3 .recover \| sqlite3 mended.db3",
}


def test_a_bag_without_an_index_names_the_command_that_repairs_it(
    tmp_path: Path, ending: str
) -> None:
    content = write_bag(tmp_path / f"whole{ending}", stereo(60)).read_bytes()
    cut = tmp_path / f"walk{ending}"
    cut.write_bytes(content[: int(0.7 * len(content))])
    with pytest.raises(DatasetError, match=rf"index is missing, which {REPAIRS[ending]} writes"):
        opened(cut)


def test_a_folder_with_broken_metadata_names_the_command_that_repairs_it(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "walk.mcap", stereo(2)).parent
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {")
    with pytest.raises(DatasetError, match="index is missing, which ros2 bag reindex walk writes"):
        opened(folder)


@pytest.mark.parametrize("kind", [".bag", "packed.bag", "packed.mcap"])
def test_the_messages_before_a_damage_are_used(tmp_path: Path, kind: str) -> None:
    # Several chunks, of 1 MB in ROS 1 and 4 MB in MCAP: some are whole before the damage.
    rng = np.random.default_rng(1)
    large = [
        (
            topic,
            stamp,
            name,
            {**fields, "data": rng.integers(0, 255, 60_000, np.uint8), "height": 1875},
        )
        if "image" in topic
        else (topic, stamp, name, {**fields, "height": 1875})
        for topic, stamp, name, fields in stereo(120)
    ]
    file = write_bag(tmp_path / f"walk{Path(f'a{kind}').suffix}", large, packed="packed" in kind)
    content = bytearray(file.read_bytes())
    middle = int(0.7 * len(content))
    content[middle : middle + 300_000] = bytes(300_000)
    damaged = tmp_path / f"damaged{file.suffix}"
    damaged.write_bytes(content)
    recording = opened(damaged)
    assert 30 < len(recording) < 120
    assert "messages before the damage are used" in recording.notes[0]
    assert recording.frame(len(recording) - 1).images[0].shape == (1875, WIDTH)


@pytest.mark.parametrize(("side", "left_over"), [("left", 0), ("right", 1)])
def test_a_damaged_image_leaves_the_other_one_of_its_frame(
    tmp_path: Path, side: str, left_over: int
) -> None:
    messages = [
        (topic, stamp, name, {**fields, "data": fields["data"][:9]})
        if f"{side}/image" in topic and stamp == START_NS + 2 * PERIOD_NS
        else (topic, stamp, name, fields)
        for topic, stamp, name, fields in stereo(4)
    ]
    recording = opened(write_bag(tmp_path / "walk.bag", messages))
    whole = opened(write_bag(tmp_path / "whole.bag", stereo(4)))
    with pytest.raises(OneImageError, match=f"/cam/{side}/image_raw") as caught:
        recording.frame(2)
    frame = caught.value.frame
    assert frame.alone == left_over
    np.testing.assert_array_equal(frame.images[left_over], whole.frame(2).images[left_over])
    assert not frame.images[1 - left_over].any()
    assert len(recording.frame(3).images) == 2


def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, ending: str) -> None:
    for content in (b"", b"nonsense" * 1000, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"):
        path = tmp_path / f"a{ending}"
        path.write_bytes(content)
        with pytest.raises(DatasetError, match="cannot be read as a ROS bag to its end") as e:
            opened(path)
        assert "\n" not in str(e.value)


def test_bags_without_a_pair(tmp_path: Path) -> None:
    for messages, line in (
        ([m for m in stereo(2) if "left" in m[0]], "has images of one camera only, /cam/left/ima"),
        ([m for m in stereo(2) if "info" in m[0]], "has no topic of camera images .*; it has /cam"),
        (stereo(2, names=("/front", "/back")), "is unknown by their names; say it: --topics"),
    ):
        path = write_bag(tmp_path / f"{len(line)}.bag", messages)
        with pytest.raises(DatasetError, match=line):
            opened(path)


# --------------------------------------------------------------------------------------------
# Bag messages


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
    assert "has no baseline" in str(raised.value)
    assert "give the calibration by --camera FILE" in str(raised.value)
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
    "yuv422": raw_image(of_pairs(cv2.COLOR_RGB2YUV_UYVY), "yuv422"),
    "yuyv": raw_image(of_pairs(cv2.COLOR_RGB2YUV_YUYV), "yuyv"),
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


# --------------------------------------------------------------------------------------------
# Bag depth


SHIFT = 10  # pixels, by which what is seen from the left is further right


DEPTH_M = CALIBRATION["fx"] * BASELINE_M / SHIFT


COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"


def in_millimetres(metres: FloatArray) -> dict[str, Any]:
    return raw_image((1000.0 * metres).round().astype(np.uint16), "16UC1")


def in_metres(metres: FloatArray) -> dict[str, Any]:
    return raw_image(metres.astype(np.float32), "32FC1", padding=8)


def packed(metres: FloatArray) -> dict[str, Any]:
    """As compressed_depth_image_transport packs integers: a header, then PNG."""
    data = cv2.imencode(".png", (1000.0 * metres).round().astype(np.uint16))[1].tobytes()
    return compressed("16UC1; compressedDepth png", bytes(12) + data)


def packed_floats(metres: FloatArray) -> dict[str, Any]:
    """Floats are coded by their inverse, with the two numbers in the header."""
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    coded = np.where(metres > 0.0, a / np.where(metres > 0.0, metres, 1.0) + b, 0.0)
    data = cv2.imencode(".png", coded.astype(np.uint16))[1].tobytes()
    return compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + data)


def compressed(form: str, data: bytes) -> dict[str, Any]:
    return {"format": form, "data": np.frombuffer(data, np.uint8)}


def image(topic: str, k: int, fields: dict[str, Any]) -> Written:
    kind = "CompressedImage" if "format" in fields else "Image"
    return topic, START_NS + k * PERIOD_NS, f"sensor_msgs/msg/{kind}", fields


def walk(encode: Any = in_millimetres, names: tuple[str, str] = (COLOUR, DEPTH)) -> list[Written]:
    """Three frames of a wall; of frame k the colours' corner pixel is 10 + k."""
    wall = np.full((HEIGHT, WIDTH), DEPTH_M)
    out = []
    for k in range(3):
        out.append(image(names[0], k, raw_image(np.dstack([picture(10 + k)] * 3), "bgr8")))
        out.append(image(names[1], k, encode(wall)))
        info = names[0].rpartition("/")[0] + "/camera_info"
        stamp = START_NS + k * PERIOD_NS
        out.append((info, stamp, "sensor_msgs/msg/CameraInfo", camera_info(0.0)))
    return out


FORMS = {
    "millimetres, ROS 1": (
        ".bag",
        in_millimetres,
        ("/camera/rgb/image_color", "/camera/depth/image"),
    ),
    "metres": (".mcap", in_metres, ("/camera/rgb/image_color", "/camera/depth/image")),
    "packed": (".mcap", packed, (COLOUR, f"{DEPTH}/compressedDepth")),
    "packed floats": (
        ".mcap",
        packed_floats,
        ("/rgb/image_raw", "/depth_to_rgb/image_raw/compressedDepth"),
    ),
    "a camera called depth": (
        ".mcap",
        in_metres,
        ("/depth_cam/image_raw", "/depth_cam/depth/image_raw"),
    ),
    "DepthAI": (".db3", in_millimetres, ("/oak/rgb/image_raw", "/oak/stereo/image_raw")),
}


@pytest.mark.parametrize("name", FORMS)
def test_colour_and_depth_are_a_pair(tmp_path: Path, name: str) -> None:
    ending, encode, names = FORMS[name]
    recording = opened(write_bag(tmp_path / f"walk{ending}", walk(encode, names)))
    assert len(recording) == 3
    assert recording.rig.baseline == BASELINE_M
    right, left = recording.frame(2).images
    assert np.array_equal(right, picture(12))
    # Coded inverses are whole numbers, which shifts pixels of noise by a few thousandths.
    most = 2 if name == "packed floats" else 0
    assert np.abs(left[:, SHIFT:].astype(int) - right[:, :-SHIFT]).max() <= most
    assert f"{names[1]} is the depth of {names[0]}" in recording.notes[0]


def test_registered_depth_is_taken_and_other_depth_only_by_name(tmp_path: Path) -> None:
    own = "/camera/depth/image_rect_raw"
    raw = [image(own, k, in_metres(np.full((HEIGHT, WIDTH), 9.0))) for k in range(3)]
    frames = {COLOUR: "colour", DEPTH: "colour", own: "depth"}
    both = write_bag(tmp_path / "both.mcap", in_frames([*walk(), *raw], frames))
    assert DEPTH in opened(both).notes[0]
    alone = [each for each in in_frames([*walk(), *raw], frames) if each[0] != DEPTH]
    bag = write_bag(tmp_path / "alone.mcap", alone)
    with pytest.raises(DatasetError, match=r"in the frame depth, .* in colour: depth must be r"):
        opened(bag)
    assert "as it was chosen by --topics" in opened(bag, topics=(COLOUR, own)).notes[0]


def test_what_realsenses_viewer_records(tmp_path: Path) -> None:
    """Depth is that of the first infrared camera; the colour sensor sees from another place."""
    sensor = "/device_0/sensor_0"
    names = (f"{sensor}/Infrared_1/image/data", f"{sensor}/Depth_0/image/data")
    written = [
        (t.replace("/image/camera_info", "/info/camera_info"), *rest)
        for t, *rest in walk(names=names)
    ]
    assert len(opened(write_bag(tmp_path / "infra.bag", written))) == 3
    colour = [(t.replace("sensor_0/Infra", "sensor_1/Infra"), *rest) for t, *rest in written]
    with pytest.raises(DatasetError, match=r"are of two sensors: depth must be registered"):
        opened(write_bag(tmp_path / "colour.bag", colour))


def test_the_largest_integer_is_no_depth(tmp_path: Path) -> None:
    def marked(metres: FloatArray) -> dict[str, Any]:
        millimetres = (1000.0 * metres).round().astype(np.uint16)
        millimetres[:, :16] = 65535
        return raw_image(millimetres, "16UC1")

    right, left = opened(write_bag(tmp_path / "a.mcap", walk(marked))).frame(0).images
    assert np.array_equal(left[:, 26:], right[:, 16:-10])
    assert left[:, 8:16].std() < 0.2 * right[:, 8:16].std(), "unknown, not at infinity"


def test_what_is_no_depth_is_said(tmp_path: Path) -> None:
    def as_jpeg(metres: FloatArray) -> dict[str, Any]:
        return compressed("jpeg", cv2.imencode(".jpg", (99 * metres).astype(np.uint8))[1].tobytes())

    def as_rvl(metres: FloatArray) -> dict[str, Any]:
        return compressed("16UC1; compressedDepth rvl", bytes(40))

    def too_small(metres: FloatArray) -> dict[str, Any]:
        return in_millimetres(metres[::2, ::2])

    for encode, words in (
        (as_jpeg, "images of uint8 are no depth; record them as PNG"),
        (as_rvl, "depth in the format RVL is not read"),
        (too_small, "depth images are 16x12 pixels, colour images 32x24; depth must"),
    ):
        bag = write_bag(tmp_path / f"{encode.__name__}.mcap", walk(encode))
        with pytest.raises(DatasetError, match=words):
            opened(bag)
    bag = write_bag(tmp_path / "view.mcap", walk())
    with pytest.raises(DatasetError, match=r"dataset\.unit_m is for two cameras"):
        opened(bag, unit_m=0.001)
    uncalibrated = [each for each in walk() if not each[0].endswith("camera_info")]
    with pytest.raises(CalibrationError, match=f"no camera_info of {COLOUR}; give the calibration"):
        opened(write_bag(tmp_path / "bare.mcap", uncalibrated))


# --------------------------------------------------------------------------------------------
# What drivers and recorders do


def changed_infos(written: list[Written], **changes: Any) -> list[Written]:
    return [(*m[:3], m[3] | changes) if m[2].endswith("CameraInfo") else m for m in written]


def test_a_rectified_stream_may_state_its_projection_alone(tmp_path: Path) -> None:
    rectified = [(m[0].replace("image_raw", "image_rect"), *m[1:]) for m in stereo()]
    usual = opened(write_bag(tmp_path / "usual.mcap", rectified)).rig
    numbers = (usual.fx, usual.fy, usual.cx, usual.cy, usual.baseline)
    written = changed_infos(rectified, k=np.zeros(9), d=np.zeros(8))
    found = opened(write_bag(tmp_path / "zero.mcap", written)).rig
    assert (found.fx, found.fy, found.cx, found.cy, found.baseline) == numbers
    spoilt = changed_infos(stereo(), k=np.zeros(9), d=np.array([0.1, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(CalibrationError, match="not calibrated"):
        opened(write_bag(tmp_path / "raw.mcap", spoilt))


def test_a_fault_in_a_bag_names_it_and_asks_for_no_file(tmp_path: Path) -> None:
    five = np.array([0.1, 0.0, 0.0, 0.0, 0.5])
    written = changed_infos(stereo(), d=five, distortion_model="equidistant")
    bag = write_bag(tmp_path / "five.mcap", written)
    with pytest.raises(CalibrationError, match=r"five\.mcap:/cam/left/camera_info: equi.*--camera"):
        opened(bag)
    write_calibration(tmp_path)
    assert len(opened(bag, camera_file=str(tmp_path / "calib.json"))) == 4


def test_one_topic_may_show_both_views(tmp_path: Path) -> None:
    for name, join in (("wide", np.hstack), ("high", np.vstack)):
        shown = [join([picture(60 + k), picture(10 + k)]) for k in range(3)]
        written = [image("/usb_cam/image_raw", k, raw_image(each)) for k, each in enumerate(shown)]
        bag = write_bag(tmp_path / f"{name}.mcap", written)
        with pytest.raises(DatasetError, match=r"shows both views.*--camera FILE"):
            opened(bag)
        write_calibration(tmp_path)
        recording = opened(bag, camera_file=str(tmp_path / "calib.json"))
        assert [codes(recording, k) for k in range(3)] == [(10, 60), (11, 61), (12, 62)]
        assert "is taken as both views" in recording.notes[0]


VIEWER = ("/device_0/sensor_0/Infrared_0/image/data", "/device_0/sensor_0/Depth_0/image/data")


@pytest.mark.parametrize("topic", ["Depth_Units/value", "Depth Units", None])
def test_the_unit_of_depth_is_the_one_that_the_viewer_states(
    tmp_path: Path, topic: str | None
) -> None:
    unit = 0.00025
    written = walk(lambda m: raw_image((m / unit).round().astype(np.uint16), "16UC1"), VIEWER)
    written = [(m[0].replace("image/camera_info", "info/camera_info"), *m[1:]) for m in written]
    if topic:
        name = f"/device_0/sensor_0/option/{topic}"
        written.append((name, START_NS, "std_msgs/msg/Float32", {"data": unit}))
    bag = write_bag(tmp_path / "viewer.bag", written)
    settings = {} if topic else {"depth_scale": 4000.0}
    note = next(n for n in opened(bag, **settings).notes if "units a metre" in n)
    assert note == f"depth is taken as 4000 units a metre: its median is {DEPTH_M:.3g} m"


def test_the_colour_camera_of_several_is_the_one_of_the_topic(tmp_path: Path) -> None:
    chain = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "distortion_model": "none",
            "intrinsics": [300.0 + k, 300.0 + k, 15.0, 11.0],
            "resolution": [WIDTH, HEIGHT],
            "rostopic": topic,
            **({"T_cn_cnm1": pose(np.eye(3), np.array([-0.1, 0.0, 0.0])).tolist()} if k else {}),
        }
        for k, topic in enumerate(("/camera/infra1/image_rect_raw", COLOUR))
    }
    path = tmp_path / "chain.yaml"
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    bag = write_bag(tmp_path / "walk.mcap", walk())
    assert opened(bag, camera_file=str(path)).rig.fx == 301.0
    for each in chain.values():
        each["rostopic"] = ""
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"--set dataset\.colour_camera=0 for chain"):
        opened(bag, camera_file=str(path))
    assert opened(bag, camera_file=str(path), colour_camera=1).rig.fx == 301.0
