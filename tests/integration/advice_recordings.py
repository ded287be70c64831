"""Messages about recordings, calibrations and judged files, and what follows their advice."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import textured_room
import yaml
from advice import Advice
from bags import camera_info, in_frames, odometry, raw_image, stereo, tf_static, write_bag
from dataset_builders import (
    EUROC_SIZE,
    HEIGHT,
    PERIOD_NS,
    START_NS,
    WIDTH,
    euroc,
    image_folder,
    kitti,
    loose,
    picture,
    save,
    write_calibration,
    write_tum,
)
from running import main
from scipy.spatial.transform import Rotation
from test_calibrate_command import FISHEYE, draw_boards, draw_rings

from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig

ROOM = TemporaryDirectory(prefix="fgslam_advice_")
"""What is made once."""
APART = pose(np.eye(3), np.array([0.2, 0.0, 0.0]))


def depth(root: Path, units: int = 2000, list_: bool = False, chain: bool = False) -> Path:
    """Counters as names; 2000 units may be millimetres."""
    for k in range(3):
        save(root / "rgb" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        save(root / "depth" / f"{k}.png", np.full((HEIGHT, WIDTH), units, np.uint16))
    if list_:
        rows = (f"{k} rgb/{k}.png {k} depth/{k}.png\n" for k in range(3))
        (root / "associations.txt").write_text("".join(rows), encoding="utf-8")
    if chain:
        write_chain(root, 2, (30.0, 33.0))
    else:
        write_calibration(root)
    return root


def write_chain(root: Path, cameras: int, focal: tuple[float, ...]) -> None:
    step = {"T_cn_cnm1": np.linalg.inv(APART).tolist()}
    values = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "distortion_model": "none",
            "intrinsics": [focal[k % len(focal)]] * 2 + [15.5, 11.5],
            "resolution": [WIDTH, HEIGHT],
            **(step if k else {}),
        }
        for k in range(cameras)
    }
    (root / "camchain.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")


def pairs(root: Path, **changes: Any) -> Path:
    loose(root, lambda k: (f"left/{k}.png", f"right/{k}.png"))
    write_calibration(root, **changes)
    return root


def times_of_two(root: Path) -> Path:
    loose(root, lambda k: (f"cam0/{k}.png", f"cam1/{k}.png"))
    (root / "times.txt").write_text("0.0\n0.1\n", encoding="utf-8")
    return root


def without(name: str) -> Callable[[Path], object]:
    return lambda root: (root / name).unlink()


def opencv(root: Path, **changes: Any) -> Path:
    matrix = [[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]]
    values: dict[str, Any] = {"R": np.eye(3).tolist(), "T": [-0.2, 0.0, 0.0], **changes}
    values |= {f"{n}{k}": matrix for k in (1, 2) for n in "K"}
    values |= {f"D{k}": [0.01, 0.01, 0.0, 0.0] for k in (1, 2)}
    (root / "rig.json").write_text(json.dumps(values), encoding="utf-8")
    return root / "rig.json"


def guessed_lens(root: Path) -> Path:
    pairs(root)
    opencv(root).rename(root / "calib.json")
    return root


def bag(root: Path, written: Any) -> Path:
    write_calibration(root)
    return write_bag(root / "drive.bag", written)


def uncalibrated(root: Path) -> Path:
    return bag(root, [each for each in stereo() if not each[0].endswith("camera_info")])


def both_views(root: Path) -> Path:
    shown = [np.hstack([picture(60 + k), picture(10 + k)]) for k in range(3)]
    kind = "sensor_msgs/msg/Image"
    stamps = [START_NS + k * PERIOD_NS for k in range(3)]
    messages = [
        ("/usb/image_raw", s, kind, raw_image(i)) for s, i in zip(stamps, shown, strict=True)
    ]
    return bag(root, messages)


def unsided(root: Path) -> Path:
    return bag(root, stereo(names=("/front_eye", "/other_eye")))


def two_pairs(root: Path) -> Path:
    return bag(root, stereo() + stereo(names=("/rear/left", "/rear/right")))


def driven(root: Path, topic: str) -> Path:
    stamps = [START_NS + k * PERIOD_NS for k in range(4)]
    poses = np.column_stack([0.1 * np.arange(4), np.zeros((4, 3))])
    return bag(root, stereo() + odometry(stamps, poses, topic))


def broken_odometry(root: Path) -> Path:
    stamps = [START_NS + k * PERIOD_NS for k in range(4)]
    return bag(root, stereo() + odometry(stamps, np.full((4, 4), np.nan)))


def black_image(root: Path) -> Path:
    for side in ("left", "right"):
        save(pairs(root) / side / "0.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    return root


def uncalibrated_euroc(root: Path) -> Path:
    euroc(root, (np.eye(4), APART))
    for path in root.glob("mav0/cam*/sensor.yaml"):
        path.unlink()
    width, height = EUROC_SIZE
    write_calibration(root, width=width, height=height, cx=31.5, cy=23.5)
    (root / "calib.json").rename(root / "mine.json")
    return root


def odometry_of(root: Path, rows: Iterable[str]) -> Path:
    """Images with odometry of these lines."""
    image_folder(root)
    (root / "odom.csv").write_text("".join(rows), encoding="utf-8")
    return root


def late_odometry(root: Path) -> Path:
    return odometry_of(root, (f"{1000.0 + 0.1 * k},1.0,0.0\n" for k in range(7)))


def two_layouts(root: Path) -> Path:
    depth(root)
    for side in ("left", "right"):
        for k in range(3):
            save(root / side / f"{k}.png", picture(k + (60 if side == "left" else 10)))
    return root


def converted(root: Path) -> Path:
    (root / "out.yaml").write_text("mine", encoding="utf-8")
    write_calibration(root)
    return root / "calib.json"


def four_cameras(root: Path) -> Path:
    write_chain(root, 4, (30.0,))
    return root / "camchain.yaml"


def kitti_drive(root: Path) -> Path:
    kitti(root)
    write_calibration(root)
    return root


def stills(root: Path) -> Path:
    for k in range(3):
        save(root / f"{k}.png", np.hstack([picture(60 + k), picture(10 + k)]))
    write_calibration(root)
    return moved(root, "half.json")


def moved(root: Path, name: str) -> Path:
    (root / "calib.json").rename(root.parent / name)
    return root


def unrectified(root: Path) -> Path:
    write_chain(root.parent, 2, (30.0,))
    return pairs(root, rectified=False)


def larger_colour(root: Path) -> Path:
    depth(root)
    for k in range(3):
        save(root / "rgb" / f"{k}.png", np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8))
    write_calibration(root, width=2 * WIDTH, height=2 * HEIGHT, fx=60.0, fy=62.0, cx=31.5, cy=23.5)
    return root


def smaller_colour(root: Path) -> None:
    for k in range(3):
        save(root / "rgb" / f"{k}.png", np.dstack([picture(10 + k)] * 3))


def truthless(root: Path) -> Path:
    return image_folder(root)


def absent_recording(root: Path) -> Path:
    image_folder(root / "here")
    values = {"name": "x", "dataset": {"kind": "image_folder", "path": str(root / "gone")}}
    (root / "x.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root / "x.yaml"


def three_topics(root: Path) -> Path:
    write_chain(root, 3, (30.0,))
    return bag(root, stereo() + stereo(names=("/rear/left", "/rear/right")))


def zero_info(root: Path) -> Path:
    none = {"k": np.zeros(9), "p": np.zeros(12)}
    made = [
        (topic, stamp, kind, {**fields, **none} if topic.endswith("camera_info") else fields)
        for topic, stamp, kind, fields in stereo()
    ]
    return bag(root, made)


def without_baseline(root: Path) -> Path:
    none = {"p": np.zeros(12)}
    made = [
        (topic, stamp, kind, {**fields, **none} if topic.endswith("camera_info") else fields)
        for topic, stamp, kind, fields in stereo()
    ]
    return bag(root, made)


def four_in_a_bag(root: Path) -> Path:
    write_chain(root, 4, (30.0,))
    return bag(root, stereo())


def right_one_first(root: Path) -> Path:
    write_chain(root, 2, (30.0,))
    values = yaml.safe_load((root / "camchain.yaml").read_text(encoding="utf-8"))
    values["cam1"]["T_cn_cnm1"] = APART.tolist()
    (root / "camchain.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root / "camchain.yaml"


def poses_file(root: Path, name: str = "poses.tum", covariances: bool = False) -> Path:
    """Poses that are off by as much as their covariances state; the truth has no error."""
    rng, count = np.random.default_rng(0), 60
    path, error = (
        np.cumsum(rng.standard_normal((count, 3)), axis=0),
        rng.standard_normal((count, 6)),
    )
    error *= 0.0 if name.startswith("truth") else 0.01
    turns = Rotation.from_rotvec(0.1 * path + error[:, :3]).as_quat()
    rows = [0.1 * np.arange(count)[:, None], path + error[:, 3:], turns]
    if covariances:
        rows.append(np.tile(np.eye(6)[np.triu_indices(6)] * 1e-4, (count, 1)))
    np.savetxt(root / name, np.column_stack(rows), fmt="%.9f")
    return root / name


def with_truth(root: Path, covariances: bool = False) -> Path:
    poses_file(root, "truth.tum")
    return poses_file(root, covariances=covariances)


def covariances_of(root: Path) -> None:
    upper = np.eye(6)[np.triu_indices(6)] * 1e-4
    np.savetxt(root / "covariances.txt", np.tile(upper, (60, 1)), fmt="%.9f")


def depth_bag(root: Path, frames: tuple[str, str] = ("", ""), infos: bool = True) -> Path:
    """Colour, depth of 2 m in another frame perhaps, and a second colour camera."""
    written: list[Any] = []
    for k in range(3):
        stamp = START_NS + k * PERIOD_NS
        colour = raw_image(np.dstack([picture(10 + k)] * 3), "bgr8")
        metres = raw_image(np.full((HEIGHT, WIDTH), 2000, np.uint16), "16UC1")
        kind = "sensor_msgs/msg/Image"
        written += [
            ("/c/color/image_raw", stamp, kind, colour | {"frame": frames[0]}),
            ("/c/rgb_rear/image_raw", stamp, kind, colour | {"frame": frames[0]}),
            ("/c/depth/image_raw", stamp, kind, metres | {"frame": frames[1]}),
        ]
        if infos:
            for camera in ("color", "rgb_rear"):
                topic = f"/c/{camera}/camera_info"
                written.append((topic, stamp, "sensor_msgs/msg/CameraInfo", camera_info(0.0)))
    return bag(root, written)


def raw_drive(root: Path) -> Path:
    for camera, code in (("image_00", 60), ("image_01", 10)):
        for k in range(3):
            save(root / camera / "data" / f"{k:010d}.png", picture(code + k))
        rows = "".join(f"2011-09-26 13:02:25.{k}00000000\n" for k in range(3))
        (root / camera / "timestamps.txt").write_text(rows, encoding="utf-8")
    write_calibration(root)
    return moved(root, "its.json")


def wide(root: Path) -> Path:
    pairs(root).joinpath("calib.json").unlink()
    write_chain(root, 2, (9.0,))
    path = root / "camchain.yaml"
    text = path.read_text(encoding="utf-8").replace(
        "distortion_model: none", "distortion_model: equidistant\n  distortion_coeffs: [0, 0, 0, 0]"
    )
    path.write_text(text, encoding="utf-8")
    return root


def written_anew(root: Path) -> Path:
    """A calibration as the advice writes it, next to what is not read."""
    return opencv(root, image_size=[WIDTH, HEIGHT])


def stated_lens(root: Path) -> Path:
    return opencv(root, image_size=[WIDTH, HEIGHT], distortion_model="radtan")


def unread(name: str) -> Callable[[Path], Path]:
    return lambda root: (root / name, (root / name).write_bytes(b"\0 \1"))[0]


def of_colmap(root: Path, ending: str = "txt") -> Path:
    """Two cameras of COLMAP, whose places are not stated."""
    line = f"PINHOLE {WIDTH} {HEIGHT} 30 30 15.5 11.5"
    (root / "cameras.txt").write_text(f"1 {line}\n2 {line}\n", encoding="utf-8")
    return root / "cameras.txt"


def rigs_of_colmap(root: Path) -> Path:
    text = "1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 -0.2 0 0\n"
    (root / "rigs.txt").write_text(text, encoding="utf-8")
    return of_colmap(root)


def too_near(root: Path) -> Path:
    return opencv(root, T=[-0.0002, 0.0, 0.0], image_size=[WIDTH, HEIGHT])


def topics_of_four(root: Path, aside: bool = False) -> Path:
    """A bag of two pairs, and a calibration that names the topics of all four cameras.

    Cameras of the second one perhaps look to other sides, so that they are no pair.
    """
    write_chain(root, 4, (30.0,))
    values = yaml.safe_load((root / "camchain.yaml").read_text(encoding="utf-8"))
    names = ("/cam/left", "/cam/right", "/rear/left", "/rear/right")
    for each, topic in zip(values.values(), names, strict=True):
        each["rostopic"] = f"{topic}/image_raw"
    if aside:
        across = pose(Rotation.from_euler("y", 90.0, degrees=True).as_matrix(), np.zeros(3))
        values["cam2"]["T_cn_cnm1"] = values["cam3"]["T_cn_cnm1"] = across.tolist()
    (root / "camchain.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return bag(root, stereo() + stereo(names=("/rear/left", "/rear/right")))


def five_terms(root: Path) -> Path:
    """A fisheye's camera_info with a fifth term that is not 0."""
    odd = {"distortion_model": "equidistant", "d": np.full(5, 0.01)}
    made = [
        (topic, stamp, kind, {**fields, **odd} if topic.endswith("camera_info") else fields)
        for topic, stamp, kind, fields in stereo()
    ]
    return bag(root, made)


def one_sample(root: Path) -> Path:
    return odometry_of(root, ["0.1,1.0,0.0\n"])


def unreadable(root: Path) -> Path:
    image = next(iter(sorted((image_folder(root) / "left").iterdir())))
    image.unlink()
    image.mkdir()
    return root


def film(
    path: Path, seed: int, rate: float = 10.0, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Path:
    """Motion JPEG, five frames."""
    made = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, size)
    for k in range(5):
        made.write(np.dstack([picture(seed + k, *size)] * 3))
    made.release()
    return path


def films(*names: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        for name in names:
            film(root / f"{name}.avi", 60 if name == "left" else 10)
        write_calibration(root)
        return root

    return make


def three_cameras(root: Path) -> None:
    write_calibration(root, vertical_baseline_m=0.2)


def films_of(name: str, *names: str) -> Callable[[Path], Path]:
    """An experiment on films in a folder of that name; those named are in the folder `here`."""

    def make(root: Path) -> Path:
        (root / "here").mkdir()
        films(*names)(root / "here")
        values = {"name": "x", "dataset": {"kind": "video", "path": str(root / name)}}
        (root / "x.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
        return root / "x.yaml"

    return make


def name_sides(root: Path) -> None:
    (root / "here" / "a.avi").rename(root / "here" / "left.avi")
    (root / "here" / "b.avi").rename(root / "here" / "right.avi")


def rectangles(root: Path) -> Path:
    """Images of a board through a fisheye, made once."""
    drawn = Path(ROOM.name) / "boards"
    if not drawn.is_dir():
        drawn.mkdir()
        draw_boards(drawn, 14)
    (root / "boards").symlink_to(drawn)
    return root / "boards"


def zoomed(root: Path) -> Path:
    """The same with images of another focal length among them, which are `zoom/*` too."""
    drawn = rectangles(root)
    (root / "all").mkdir()
    zoom = Path(ROOM.name) / "zoom"
    if not zoom.is_dir():
        zoom.mkdir()
        draw_boards(zoom, 6, replace(FISHEYE, matrix=FISHEYE.matrix * [[1.5], [1.5], [1.0]]))
    for path in drawn.iterdir():
        (root / "all" / path.name).symlink_to(path)
    for path in zoom.iterdir():
        (root / "all" / f"zoom_{path.name}").symlink_to(path)
    return root / "all"


def unzoomed(root: Path) -> None:
    for path in (root / "all").glob("zoom_*"):
        path.unlink()


def markers(root: Path) -> Path:
    """Images of a board of 7x5 squares with markers of six bits."""
    (root / "boards").mkdir()
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)
    print_ = cv2.aruco.CharucoBoard((7, 5), 1.0, 0.7, known).generateImage((1400, 1000))
    draw_boards(root / "boards", 14, print_=np.asarray(print_))
    return root / "boards"


def rings(root: Path) -> Path:
    draw_rings(root / "rings.png")
    return root / "rings.png"


def uneven(root: Path) -> Path:
    """Images of which one came late."""
    image_folder(root)
    times = "".join(f"{k:06d} {0.1 * k + 2.0 * (k > 3):.6f}\n" for k in range(6))
    (root / "times.txt").write_text(times, encoding="utf-8")
    return root


def standing(root: Path) -> Path:
    """Odometry that states no motion."""
    return odometry_of(root, (f"{0.1 * k},0.0,0.0\n" for k in range(7)))


def late_against_truth(root: Path) -> Path:
    """Odometry whose stamps are 0.3 s behind those of the truth."""
    image_folder(root, frames=40)
    stamps = 0.1 * np.arange(60)
    rate = np.sin(2.0 * stamps)
    rows = (f"{t + 0.3:.6f},1.0,{w:.6f}\n" for t, w in zip(stamps, rate, strict=True))
    (root / "odom.csv").write_text("".join(rows), encoding="utf-8")
    poses = np.tile(np.eye(4), (60, 1, 1))
    for k in range(1, 60):
        turn = Rotation.from_rotvec([0.0, -0.1 * rate[k], 0.0]).as_matrix()
        poses[k] = poses[k - 1] @ pose(turn, np.array([0.0, 0.0, 0.1]))
    write_tum(root / "gt_right_cam.txt", stamps, poses)
    return root


def turning(root: Path) -> Path:
    """A drive that turns to and fro in a room, and wheels whose clock is 0.2 s behind."""
    rig = CameraRig(240, 180, 150.0, 150.0, 119.5, 89.5, 0.12, None, np.eye(4))
    stamps = 0.1 * np.arange(30)
    rate = 0.8 * np.sin(3.0 * stamps)
    yaw = np.cumsum(np.concatenate([[0.0], 0.1 * rate[1:]]))
    for k, angle in enumerate(yaw):
        right, left = textured_room.stereo(np.array([-1.0, 0.2, angle]), rig)
        save(root / "right" / f"{k:06d}.png", right)
        save(root / "left" / f"{k:06d}.png", left)
    times = "".join(f"{k:06d} {t:.6f}\n" for k, t in enumerate(stamps))
    (root / "times.txt").write_text(times, encoding="utf-8")
    write_calibration(root, width=240, height=180, fx=150.0, fy=150.0, cx=119.5, cy=89.5,
                      baseline_m=0.12)  # fmt: skip
    rows = (f"{t + 0.2:.6f},0.0,{w:.6f}\n" for t, w in zip(stamps, rate, strict=True))
    (root / "odom.csv").write_text("".join(rows), encoding="utf-8")
    return root


def pairs_by_tf(root: Path) -> Path:
    """Cameras without a baseline in camera_info, whose places tf_static states in millimetres."""
    none = {"p": np.zeros(12)}
    made = [
        (topic, stamp, kind, {**fields, **none} if topic.endswith("camera_info") else fields)
        for topic, stamp, kind, fields in stereo()
    ]
    right = np.eye(4)
    right[0, 3] = 200.0
    named = in_frames(made, {"/cam/left": "eye_left", "/cam/right": "eye_right"})
    return bag(
        root, named + tf_static([("head", "eye_left", np.eye(4)), ("head", "eye_right", right)])
    )


def round_film(root: Path) -> Path:
    """A film of round pictures, and the mirror that took them."""
    made = cv2.VideoWriter(
        str(root / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (304, 240)
    )
    for k in range(5):
        shown = cv2.circle(np.zeros((240, 304), np.uint8), (150, 118), 100, 255, -1)
        made.write(np.dstack([picture(10 + k, 304, 240) & shown] * 3))
    made.release()
    (root / "mirror.yaml").write_text("kind: mirror\nring_px: [10, 98]\n", encoding="utf-8")
    write_calibration(root)
    return root / "film.avi"


CONVERT = ("camera convert", "{}/out.yaml")
TO_ROS = ("camera convert", "{}/ros")
OF_RECORDINGS = {
    "rate of counters": Advice(depth, r"a second \((--fps) states otherwise\)", r"\1 30"),
    "counters in associations": Advice(
        lambda root: depth(root, list_=True), r"associations.txt counts .* \((--fps) s", r"\1 30"
    ),
    "times of too few images": Advice(
        times_of_two, r"leave it out and say (--fps)", r"\1 20", without("times.txt")
    ),
    "unit of depth in doubt": Advice(
        lambda root: depth(root, 9000), r"say which: (--set dataset.depth_scale=\d+) or", r"\1"
    ),
    "depth that no camera sees": Advice(
        lambda root: depth(root, 60000),
        r"say the unit: (--set dataset.depth_scale)=1000 for millimetres, (10000) for", r"\1=\2"
    ),
    "one of several cameras": Advice(
        lambda root: depth(root, chain=True), r"say it: (--set dataset.colour_camera=0) for", r"\1"
    ),
    "a camera that is not there": Advice(
        lambda root: depth(root, chain=True),
        r"dataset.colour_camera is 9, but it has cameras 0 to (\d)",
        r"--set dataset.colour_camera=\1", command=("inspect", "--set dataset.colour_camera=9"),
    ),
    "colour larger than depth": Advice(
        larger_colour, r"resize the colour images to 32x24, and say (--set dataset.resized=true)",
        r"\1", smaller_colour
    ),
    "colour without a calibration": Advice(
        lambda root: moved(depth(root), "its.json"),
        r"focal length; give one by (--camera) FILE", r"\1 {}/../its.json"
    ),
    "a bag's colour without a calibration": Advice(
        lambda root: depth_bag(root, infos=False), r"no camera_info of .* by (--camera) FILE",
        r"\1 {}/calib.json"
    ),
    "depth in another frame": Advice(
        lambda root: depth_bag(root, ("colour", "infra")),
        r"(\S+) is in the frame infra, (\S+) in colour: .* choose: (--topics) COLOUR,DEPTH",
        r"\3 \2,\1"
    ),
    "another colour camera": Advice(
        depth_bag, r"(\S+) is the depth of (/c/color\S+) \((--topics) COLOUR,DEPTH chooses others",
        r"\3 /c/rgb_rear/image_raw,\1"
    ),
    "images without a calibration": Advice(
        lambda root: moved(pairs(root), "its.json"), r"calib.json, or another one by (--camera) F",
        r"\1 {}/../its.json"
    ),
    "a drive without its calibration": Advice(
        raw_drive, r"of that date, or give one by (--camera) FILE", r"\1 {}/../its.json"
    ),
    "a view that is cut off": Advice(
        wide, r"beyond is cut off \((dataset.fov_deg), or --fov", r"--set \1=165"
    ),
    "a format that no ending names": Advice(
        converted, r"no format ends like that; known: (\.json) \(fgslam\)", r"{}/other\1",
        command=("camera convert", "{}/out.abc"), drop="{}/out.abc"
    ),
    "lens of four coefficients": Advice(guessed_lens, r"say (--set dataset.lens=\w+)", r"\1"),
    "lens of four coefficients in a file": Advice(
        written_anew, r"write distortion_model: radtan there, or say", mend=stated_lens,
        command=("camera show", ""),
    ),
    "baseline in millimetres": Advice(
        lambda root: pairs(root, baseline_m=200.0), r"give it: (--unit 0.001) for", r"\1"
    ),
    "images made smaller": Advice(
        lambda root: pairs(root, width=2 * WIDTH, height=2 * HEIGHT),
        r"say so: (--set dataset.resized=true)", r"\1"
    ),
    "images that a file is not for": Advice(
        lambda root: (pairs(root), root / "calib.json")[1], r"say so: .* (--scale) of fgslam",
        r"\1", command=("camera show", "--size 64x48"),
    ),
    "images not rectified": Advice(
        unrectified,
        r"calibration by (--camera) FILE", r"\1 {}/../camchain.yaml"
    ),
    "bag without calibration": Advice(
        uncalibrated, r"belongs to .* by (--camera) FILE", r"\1 {}/calib.json"
    ),
    "a camera that is not calibrated": Advice(
        zero_info, r"numbers are 0.* by (--camera) FILE", r"\1 {}/calib.json"
    ),
    "camera_info without baseline": Advice(
        without_baseline, r"has no baseline.* (--camera) FILE", r"\1 {}/calib.json"
    ),
    "bag of both views": Advice(both_views, r"pair of views: (--camera) FILE", r"\1 {}/calib.json"),
    "stills of both views": Advice(
        stills, r"pair of views by (--camera) FILE", r"\1 {}/../half.json"
    ),
    "topics without sides": Advice(
        unsided, r"which of (\S+), (\S+) are left and right .* say it: (--topics) LEFT,RIGHT",
        r"\3 \1,\2"
    ),
    "topics of another pair": Advice(
        two_pairs, r"also there: (\S+) with (\S+); (--topics) chooses", r"\3 \1,\2"
    ),
    "three topics without three cameras": Advice(
        three_topics, r"three topics need one .* give it by (--camera) FILE",
        r"\1 {}/camchain.yaml", command=(
            "inspect",
            "--topics /cam/left/image_raw,/cam/right/image_raw,/rear/left/image_raw",
        ),
    ),
    "truth as odometry": Advice(
        lambda root: driven(root, "/ground_truth/odom"),
        r"for odometry: (\S+) .* (--topics) LEFT,RIGHT,ODOMETRY takes one",
        r"\2 /cam/left/image_raw,/cam/right/image_raw,\1"
    ),
    "four cameras and two topics": Advice(
        four_in_a_bag, r"those two: fgslam camera convert \S+ (two.yaml --cameras 0,1)",
        r"--camera {}/two.yaml", lambda root: two_of_four(root),
        command=("inspect", "--camera {}/camchain.yaml"), drop="--camera {}/camchain.yaml",
    ),
    "one topic": Advice(
        lambda root: bag(root, stereo()), r"1 topics of images are named; name the left camera's",
        "--topics /cam/left/image_raw,/cam/right/image_raw",
        command=("inspect", "--topics /cam/left/image_raw"), drop="--topics /cam/left/image_raw",
    ),
    "odometry that is not finite": Advice(
        broken_odometry, r"not finite; set another (odometry.kind)",
        r"--set \1=constant_velocity"
    ),
    "a black image": Advice(
        black_image, r"leave them out with (dataset.start) and dataset.stop", r"--set \1=1"
    ),
    "EuRoC without calibration": Advice(
        uncalibrated_euroc, r"give a calibration by (--camera) FILE", r"\1 {}/mine.json"
    ),
    "place on the body": Advice(
        lambda root: driven(root, "/odom"), r"\((dataset.camera_yaw_deg) and", r"--set \1=0"
    ),
    "odometry on another clock": Advice(
        late_odometry, r"(--set odometry.time_offset_s=-[\d.]+) lets both begin at once", r"\1",
        command=("run", "--estimator odometry --out {}/out"),
    ),
    "several layouts": Advice(
        two_layouts, r"say which, e.g. (--set dataset.kind=\w+)", r"\1"
    ),
    "a layout that is none": Advice(
        truthless, r"dataset.kind=photos is no layout .*; use one of (\w+)",
        r"--set dataset.kind=\1", command=("inspect", "--set dataset.kind=photos"),
    ),
    "times that are stated": Advice(
        truthless, r"states its own times; leave (--fps) out",
        command=("inspect", "--fps 5"), drop="--fps 5"
    ),
    "a calibration of its own": Advice(
        kitti_drive, r"holds its own calibration; leave (--camera) out",
        command=("inspect", "--camera {}/calib.json"), drop="--camera {}/calib.json",
    ),
    "a calibration that is not there": Advice(
        pairs, r"no such calibration file; check (--camera)", r"\1 {}/calib.json",
        command=("inspect", "--camera {}/gone.json"), drop="--camera {}/gone.json",
    ),
    "a start beyond the end": Advice(
        truthless, r"(dataset.start) is 99 but .* has frames (\d+) to \d+: choose less",
        r"--set \1=\2", command=("inspect", "--set dataset.start=99"),
    ),
    "a stop before the start": Advice(
        truthless, r"(dataset.stop) \(2\) is not beyond dataset.start \((\d)\)",
        r"--set \1=5", command=("inspect", "--set dataset.start=2 --set dataset.stop=2"),
    ),
    "images of no size": Advice(
        truthless, r"(dataset.scale) 0.01 makes images .* choose a larger one",
        r"--set \1=1", command=("inspect", "--set dataset.scale=0.01"),
    ),
    "noise without truth": Advice(
        truthless, r"(odometry.kind) is synthetic but .* choose recorded or (\w+)",
        r"--set \1=\2", command=("inspect", "--set odometry.kind=synthetic"),
    ),
    "no setting": Advice(
        truthless, r"--set 3: not of the form a.b=value; e.g. (--set \S+)", r"\1",
        command=("inspect", "--set 3"), drop="--set 3"
    ),
    "a recording that moved": Advice(
        absent_recording, r"say where it is: (--set dataset.path)=PATH", r"\1={}/here"
    ),
    "an output that exists": Advice(
        converted, r"choose another name, or add (--overwrite)", r"\1", command=CONVERT
    ),
    "size that is not stated": Advice(
        opencv, r"give it: (--size) 640x480", rf"\1 {WIDTH}x{HEIGHT}", command=CONVERT
    ),
    "size that a view needs": Advice(
        opencv, r"on the command line (--size) WxH", rf"\1 {WIDTH}x{HEIGHT}",
        command=("camera show", "")
    ),
    "too many cameras for a format": Advice(
        four_cameras, r"choose them \((--cameras 0,1)\)", r"\1", command=TO_ROS
    ),
    "the right camera first": Advice(
        right_one_first, r"choose them in that order: (--cameras 1,0)", r"\1", command=TO_ROS
    ),
    "a calibration of MATLAB": Advice(
        unread("x.mat"), r"write by jsonencode a .json of M1, D1, M2, D2, R, T and image_size",
        mend=written_anew, command=("camera show", ""),
    ),
    "a calibration of COLMAP in bytes": Advice(
        unread("cameras.bin"), r"write COLMAP's as text: colmap model_converter",
        mend=rigs_of_colmap, command=("camera show", ""),
    ),
    "cameras of COLMAP without a rig": Advice(
        of_colmap, r"put the rigs.txt of COLMAP 3.12 or later next to it", mend=rigs_of_colmap,
        command=("camera show", ""),
    ),
    "cameras at one place": Advice(
        too_near, r"the unit of its lengths \((--unit)\)", r"\1 1000", command=("camera show", ""),
    ),
    "topics of four cameras": Advice(
        topics_of_four, r"say which two or three form the rig: (--topics)",
        r"\1 /cam/left/image_raw,/cam/right/image_raw",
        command=("inspect", "--camera {}/camchain.yaml"),
    ),
    "a malformed camera_info": Advice(
        five_terms, r"equidistant takes 4 .* give the calibration by (--camera) FILE",
        r"\1 {}/calib.json",
    ),
    "odometry of one sample": Advice(
        one_sample, r"another odometry.kind \((\w+), synthetic", r"--set odometry.kind=\1",
        command=("run", "--out {}/out"),
    ),
    "an image that cannot be read": Advice(
        unreadable, r"leave the frame out by (dataset.start)", r"--set \1=1",
    ),
    "no layout of that kind": Advice(
        kitti_drive, r"check dataset.path, and (dataset.kind) where", r"--set \1=kitti",
        command=("inspect", "--set dataset.kind=image_folder"),
        drop="--set dataset.kind=image_folder",
    ),
    "no drive of KITTI raw": Advice(
        lambda root: (image_folder(root / "x"), raw_drive(root))[1],
        r"holds no drive of KITTI raw; check (dataset.path)",
        r"--camera {0}/../its.json --set \1={0}",
        command=("inspect", "--set dataset.kind=kitti_raw --set dataset.path={}/x"),
        drop="--set dataset.path={}/x",
    ),
    "films without sides": Advice(
        films_of("here", "a", "b"), r"by their names \(left.mp4 and right.mp4,", mend=name_sides,
    ),
    "three films and two cameras": Advice(
        films("left", "right", "top"), r"give one of all three, (--camera) FILE",
        r"\1 {}/calib.json", three_cameras,
    ),
    "films that moved": Advice(
        films_of("gone", "left", "right"), r"say where it is: (--set dataset.path)=PATH",
        r"\1={}/here",
    ),
    "poses without covariances": Advice(
        with_truth, r"states no covariances; give them by (--covariance) FILE",
        r"\1 {}/covariances.txt", covariances_of, command=("judge", "--truth {}/truth.tum"),
    ),
    "poses without truth": Advice(
        lambda root: with_truth(root, covariances=True),
        r"which could be judged by itself; give (--truth) FILE", r"\1 {}/truth.tum",
        command=("judge", ""),
    ),
    "no words of covariances": Advice(
        lambda root: with_truth(root, covariances=True),
        r"(--tangent): no word 'sideways'; use (\w+)", r"\1 \2",
        command=("judge", "--truth {}/truth.tum --tangent sideways"), drop="--tangent sideways",
    ),
    "no numbers of a board": Advice(
        rectangles, r"(--board) nine: give columns and rows as 9x6", r"\1 6x4",
        command=("calibrate omni", "--board nine --square 0.05 --lens equidistant --out {}/c.yaml"),
        drop="--board nine", slow=True,
    ),
    "a board of another size": Advice(
        rectangles, r"board00.png shows (\d+x\d+); correct (--board)", r"\2 \1",
        command=("calibrate omni", "--board 7x5 --square 0.05 --lens equidistant --out {}/c.yaml"),
        drop="--board 7x5", slow=True,
    ),
    "another dictionary of markers": Advice(
        markers, r"squares are counted; is (--dictionary) that of the print",
        r"\1 DICT_6X6_50", command=(
            "calibrate omni",
            "--target charuco --board 7x5 --square 0.05 --lens equidistant --out {}/c.yaml",
        ), slow=True,
    ),
    "images of another focus": Advice(
        zoomed, r"is --lens that of the camera, its focus fixed", mend=unzoomed,
        command=("calibrate omni", "--board 6x4 --square 0.05 --lens equidistant --out {}/c.yaml"),
        slow=True,
    ),
    "another mount": Advice(
        rectangles, r"mirror above .*; if not, give (--mount)", r"\1 up --overwrite",
        command=("calibrate omni", "--board 6x4 --square 0.05 --lens equidistant --out {}/c.yaml"),
        slow=True,
    ),
    "elevations that are no numbers": Advice(
        rings, r"give degrees as (--elevations=)-15,-5,5,15", r"\1-15,-5,0,10,20,30,40,50",
        command=("calibrate rings", "--inner 30 --out {}/m.yaml --elevations a,b"),
        drop="--elevations a,b",
    ),
    "images that are looked at": Advice(
        lambda root: image_folder(root, frames=301), r"evenly spread; (--frames \d+) reads all",
        r"\1", slow=True,
    ),
    "the only stereo pair of four": Advice(
        lambda root: topics_of_four(root, aside=True),
        r"(\S+) and (\S+) are the only two .* form a stereo pair \((--topics) chooses",
        r"\3 \1,\2",
        command=("inspect", "--camera {}/camchain.yaml"),
    ),
    "transforms in millimetres": Advice(
        pairs_by_tf, r"which no rig has: .* give the calibration by (--camera) FILE",
        r"\1 {}/calib.json",
    ),
    "wheels of another clock": Advice(
        turning, r"by the turns that the images show .* (odometry.time_offset_s) is ([-.\d]+)",
        r"--set \1=\2 --overwrite", command=("run", "--out {}/out"), slow=True,
    ),
    "odometry of another clock than the truth": Advice(
        late_against_truth, r"shifted by (\S+) s; add that to (odometry.time_offset_s)",
        r"--set \2=\1", slow=True,
    ),
    "no folder of that kind": Advice(
        lambda root: (kitti(root), root)[1],
        r"KITTI sequence .* does not exist; check dataset.path",
        command=("inspect", "--set dataset.kind=kitti --set dataset.sequence=\"07\""),
        drop="--set dataset.sequence=\"07\"",
    ),
    "a long step": Advice(
        uneven, r"steps are longer than .*, or cut with dataset.start and (dataset.stop)",
        r"--set \1=4",
    ),
    "odometry of no motion": Advice(
        standing, r"states no motion in any .*, or set (odometry.kind) to (\w+)", r"--set \1=\2",
    ),
    "a film of round pictures": Advice(
        round_film, r"routes of such a camera: (fgslam teach \S+ --camera) FILE --out ROUTE",
        r"\1 {0}/mirror.yaml --out {0}/r.fgpath --report {0}/t", slow=True,
    ),
}  # fmt: skip


def two_of_four(root: Path) -> None:
    """What the message advises, as it is typed."""
    with pytest.MonkeyPatch.context() as patch:
        done = main(patch, "camera", "convert", root / "camchain.yaml", root / "two.yaml",
                    "--cameras", "0,1")  # fmt: skip
    assert done == 0
