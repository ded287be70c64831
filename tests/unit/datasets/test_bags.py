"""ROS bags: every format, encoding and fault, against bags that rosbags has written."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bags import (
    PERIOD_NS,
    START_NS,
    camera_info,
    compressed_image,
    gyroscope,
    in_frames,
    odometry,
    raw_image,
    stereo,
    twists,
    write_bag,
)
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture, write_calibration

from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, DatasetError, FrameError, OdometryError
from fgslam.core.geometry import pose, so3_exp
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings
from fgslam.runs.bare import bare_experiment
from fgslam.runs.calibrating import Asked, convert_calibration
from fgslam.runs.inspect import check_odometry

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


def test_a_bag_is_a_bare_recording(tmp_path: Path) -> None:
    found = bare_experiment(write_bag(tmp_path / "walk.bag", stereo()))
    assert found.said.startswith("walk: ROS bag, 2 cameras 32x24; 4 frames at 10 Hz; no odometry")
    assert found.values["name"] == "walk"


def colour(image: Image) -> Image:
    return np.dstack([image, image, image])


ENCODINGS: dict[str, Any] = {
    "bgr8": lambda image: raw_image(colour(image), "bgr8"),
    "rgb8, rows padded": lambda image: raw_image(colour(image), "rgb8", padding=7),
    "bgra8": lambda image: raw_image(np.dstack([colour(image), image]), "bgra8"),
    "mono16": lambda image: raw_image(image.astype(np.uint16) << 8 | 0x7F, "mono16"),
    "png": compressed_image,
    "png of 16 bits": lambda image: compressed_image(image.astype(np.uint16) << 8),
    "yuv422": lambda image: raw_image(np.dstack([np.full_like(image, 128), image]), "yuv422"),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_encodings_become_the_same_grey(tmp_path: Path, name: str) -> None:
    recording = opened(write_bag(tmp_path / "walk.mcap", stereo(1, ENCODINGS[name])))
    assert np.array_equal(recording.frame(0).images[0], picture(10))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_are_read_in_the_right_order(tmp_path: Path, pattern: str) -> None:
    """A red image: grey of pure red, 0.299 * 200, wherever the mosaic has its red pixels."""
    rows, columns = np.indices((24, WIDTH))
    letters = np.array(list(pattern)).reshape(2, 2)[rows % 2, columns % 2]
    mosaic = np.where(letters == "r", 200, 0).astype(np.uint8)
    encode = lambda image: raw_image(mosaic, f"bayer_{pattern}8")  # noqa: E731 - one line
    grey = opened(write_bag(tmp_path / "a.bag", stereo(1, encode))).frame(0).images[0]
    assert np.abs(grey[4:-4, 4:-4].astype(float) - 59.8).max() <= 1.0


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
        (("/cam/left/camera_info",), "is sensor_msgs/msg/CameraInfo, which is no image"),
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
    assert f"note: topics by rostopic of camchain.yaml: {named}\n" in found.said + "\n"
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
    convert_calibration(Asked(Path(file)), written)
    assert codes(opened(path, camera_file=str(written)), 0) == (10, 60)


TRIO = {"top": "/t/image", "left": "/l/image", "right": "/r/image"}


def test_three_cameras(tmp_path: Path) -> None:
    """Their topics by the file's rostopics, by --topics, or by consecutive numbers in names."""
    images = dict(zip(TRIO.values(), (110, 60, 10), strict=True))
    path = write_bag(tmp_path / "a.bag", views(images)[:-1])  # the last image of the right one
    file = camchain(tmp_path, TRIO)
    found = bare_experiment(path, Path(file))
    assert found.said.startswith("a: ROS bag, 3 cameras 32x24; 1 frames")
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
    with pytest.raises(DatasetError, match=r"need one calibration of all three cameras \(none\)"):
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
    with pytest.raises(CalibrationError, match="states no baseline"):
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


def test_an_image_of_another_size_is_one_lost_frame(tmp_path: Path) -> None:
    messages = stereo(3)
    k = next(i for i, m in enumerate(messages) if m[0] == "/cam/left/image_raw" and i > 3)
    messages[k] = (*messages[k][:3], raw_image(picture(1, 16, 12)))
    recording = opened(write_bag(tmp_path / "a.bag", messages))
    with pytest.raises(FrameError, match="is 16x12 but the calibration states 32x24"):
        recording.frame(1)
    assert codes(recording, 2) == (12, 62)


def test_a_first_message_that_is_cut_is_one_lost_frame(tmp_path: Path, ending: str) -> None:
    messages = stereo(3)
    k = next(i for i, m in enumerate(messages) if m[0] == "/cam/left/image_raw")
    messages[k] = (*messages[k][:3], {**messages[k][3], "kept_bytes": 40})
    recording = opened(write_bag(tmp_path / f"a{ending}", messages))
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
    assert "; odometry; " in bare_experiment(path).said


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
    with pytest.raises(OdometryError, match="/odom covers none of the frames"):
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
