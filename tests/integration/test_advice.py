"""Every message that names an option, a key or a file: provoked, its advice followed, and gone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from bags import odometry, raw_image, stereo, write_bag
from dataset_builders import (
    EUROC_SIZE,
    HEIGHT,
    PERIOD_NS,
    START_NS,
    WIDTH,
    euroc,
    image_folder,
    loose,
    picture,
    save,
    write_calibration,
)
from running import Capture, Patch, main

from fgslam.core.geometry import pose

APART = pose(np.eye(3), np.array([0.2, 0.0, 0.0]))


class Advice(NamedTuple):
    """A message and what follows its advice.

    Attributes:
        make: what makes the input in a folder, and gives what a command is given.
        message: words of the message, the advice among them.
        follow: words added to the command, `{}` for the folder; each option is in the message.
        mend: what the advice changes in the folder, if anything.
        command: words before what is given, and behind.
    """

    make: Callable[[Path], Path]
    message: str
    follow: str = ""
    mend: Callable[[Path], object] = lambda root: None
    command: tuple[str, str] = ("inspect", "")


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


def uncalibrated_euroc(root: Path) -> Path:
    euroc(root, (np.eye(4), APART))
    for path in root.glob("mav0/cam*/sensor.yaml"):
        path.unlink()
    width, height = EUROC_SIZE
    write_calibration(root, width=width, height=height, cx=31.5, cy=23.5)
    (root / "calib.json").rename(root / "mine.json")
    return root


def late_odometry(root: Path) -> Path:
    image_folder(root)
    rows = "".join(f"{1000.0 + 0.1 * k},1.0,0.0\n" for k in range(7))
    (root / "odom.csv").write_text(rows, encoding="utf-8")
    return root


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


CONVERT = ("camera convert", "{}/out.yaml")
ADVICE = {
    "rate of counters": Advice(depth, "frames a second (--fps states otherwise)", "--fps 30"),
    "counters in associations": Advice(
        lambda root: depth(root, list_=True), "(--fps states otherwise)", "--fps 30"
    ),
    "times of too few images": Advice(
        times_of_two, "leave it out and say --fps", "--fps 20", without("times.txt")
    ),
    "unit of depth in doubt": Advice(
        lambda root: depth(root, 9000),
        "--set dataset.depth_scale=5000 or 1000",
        "--set dataset.depth_scale=5000",
    ),
    "depth that no camera sees": Advice(
        lambda root: depth(root, 60000),
        "--set dataset.depth_scale=1000",
        "--set dataset.depth_scale=10000",
    ),
    "one of several cameras": Advice(
        lambda root: depth(root, chain=True),
        "--set dataset.colour_camera=0",
        "--set dataset.colour_camera=1",
    ),
    "lens of four coefficients": Advice(
        guessed_lens, "--set dataset.lens=radtan", "--set dataset.lens=radtan"
    ),
    "baseline in millimetres": Advice(
        lambda root: pairs(root, baseline_m=200.0), "--unit 0.001", "--unit 0.001"
    ),
    "images made smaller": Advice(
        lambda root: pairs(root, width=2 * WIDTH, height=2 * HEIGHT),
        "--set dataset.resized=true",
        "--set dataset.resized=true",
    ),
    "bag without calibration": Advice(uncalibrated, "--camera FILE", "--camera {}/calib.json"),
    "bag of both views": Advice(both_views, "--camera FILE", "--camera {}/calib.json"),
    "topics without sides": Advice(
        unsided, "--topics LEFT,RIGHT", "--topics /front_eye/image_raw,/other_eye/image_raw"
    ),
    "topics of another pair": Advice(
        two_pairs, "--topics chooses", "--topics /rear/left/image_raw,/rear/right/image_raw"
    ),
    "truth as odometry": Advice(
        lambda root: driven(root, "/ground_truth/odom"),
        "--topics LEFT,RIGHT,ODOMETRY takes one",
        "--topics /cam/left/image_raw,/cam/right/image_raw,/ground_truth/odom",
    ),
    "EuRoC without calibration": Advice(
        uncalibrated_euroc, "give a calibration by --camera FILE", "--camera {}/mine.json"
    ),
    "place on the body": Advice(
        lambda root: driven(root, "/odom"),
        "dataset.camera_yaw_deg and lever_arm_m",
        "--set dataset.camera_yaw_deg=0",
    ),
    "odometry on another clock": Advice(
        late_odometry,
        "--set odometry.time_offset_s=SECONDS",
        "--set odometry.time_offset_s=-1000",
        command=("run", "--estimator odometry --out {}/out"),
    ),
    "several layouts": Advice(
        two_layouts, "--set dataset.kind=rgbd", "--set dataset.kind=loose_images"
    ),
    "an output that exists": Advice(converted, "add --overwrite", "--overwrite", command=CONVERT),
    "size that is not stated": Advice(
        opencv, "give it: --size 640x480", f"--size {WIDTH}x{HEIGHT}", command=CONVERT
    ),
}


@pytest.mark.parametrize("name", ADVICE)
def test_advice_works_when_it_is_followed(
    tmp_path: Path, capfd: Capture, monkeypatch: Patch, name: str
) -> None:
    advice = ADVICE[name]
    root = tmp_path / "in"
    root.mkdir()
    given = advice.make(root)
    before, behind = ([w.format(root) for w in part.split()] for part in advice.command)

    def told(*more: str) -> tuple[int, str]:
        code = main(monkeypatch, *before, given, *behind, *more)
        said = capfd.readouterr()
        return code, " ".join((said.out + said.err).split())

    _, said = told()
    assert advice.message in said
    assert "Traceback" not in said
    follow = advice.follow.format(root).split()
    for option in (word for word in follow if word.startswith("--") and word != "--set"):
        assert option in said  # the table follows what the message names
    advice.mend(root)
    code, said = told(*follow)
    assert advice.message not in said
    assert code != 2, said  # 1 or 3: what noise shows of cameras and places
