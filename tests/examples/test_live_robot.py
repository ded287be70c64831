"""examples/live_robot.py on a bag that another process plays at its own speed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bags
import numpy as np
import pytest
import textured_wall

import fgslam as fg
from fgslam.core.sensors import CameraRig

SCRIPT = Path(__file__).parents[2] / "examples" / "live_robot.py"
HANGS_AFTER_S = 300.0
_POSE = re.compile(r"\s*(\d+\.\d\d) s  ")
_ENDED = re.compile(r"(\d+) frames, (\d+) left out, (\d+) landmarks")
_IN_TIME = re.compile(r"(\d+) % of the poses within the frame time, (\d+) ms")
_LEFT_OUT = re.compile(r"(\d+) % of the frames that came were left out")


def written_bag(folder: Path, frames: int, period_s: float) -> Path:
    """A drive along a textured wall, 1 cm a frame, as a ROS 2 bag of two cameras."""
    rig, out = textured_wall.RIG, list[bags.Written]()
    for k in range(frames):
        stamp = bags.START_NS + round(1e9 * period_s * k)
        seen = textured_wall.pictures(np.array([0.01 * k, 0.0, 0.0]))
        for side, image, shift in (("left", seen[1], 0.0), ("right", seen[0], -rig.baseline)):
            fields = bags.raw_image(image)
            out.append((f"/{side}/image_raw", stamp, "sensor_msgs/msg/Image", fields))
            info = camera_info(rig, shift)
            out.append((f"/{side}/camera_info", stamp, "sensor_msgs/msg/CameraInfo", info))
    return bags.write_bag(folder / "drive.mcap", out)


def camera_info(rig: CameraRig, shift: float) -> dict[str, object]:
    f, cx, cy = rig.fx, rig.cx, rig.cy
    return bags.camera_info(0.0) | {
        "height": rig.height,
        "width": rig.width,
        "k": np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
        "p": np.array([f, 0, cx, f * shift, 0, f, cy, 0, 0, 0, 1, 0.0]),
    }


def started(bag: Path, folder: Path) -> subprocess.Popen[str]:
    """The example in a group of processes of its own, as a terminal starts it."""
    return subprocess.Popen(  # noqa: S603 -- our own script
        [sys.executable, "-u", str(SCRIPT), str(bag)], cwd=folder, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def times(lines: list[str]) -> list[float]:
    return [float(match[1]) for line in lines if (match := _POSE.match(line))]


def numbers(pattern: re.Pattern[str], said: str) -> list[int]:
    match = pattern.search(said)
    assert match, said
    return [int(one) for one in match.groups()]


@pytest.mark.slow
def test_ctrl_c_saves_the_map_while_the_bag_plays(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    bag = written_bag(tmp_path, frames=80, period_s=0.5)
    robot = started(bag, tmp_path)
    assert robot.stdout is not None
    lines = [robot.stdout.readline() for _ in range(3)]
    os.killpg(robot.pid, signal.SIGINT)  # as a terminal does: to the camera, too
    rest, errors = robot.communicate(timeout=HANGS_AFTER_S)
    assert robot.returncode == 0, errors
    assert "Traceback" not in errors
    assert "stopped" in rest
    frames, _, landmarks = numbers(_ENDED, rest)
    shown = times(lines + rest.splitlines())
    assert len(shown) >= 3
    assert shown == sorted(shown)
    assert 0 <= frames - len(shown) <= 1  # the one that it was tracking
    assert frames < 80  # the bag was playing
    saved = fg.Map.load(tmp_path / "live.fgmap")
    assert len(saved) == landmarks > 50
    share, frame_ms = numbers(_IN_TIME, rest)
    assert (frame_ms, 0 <= share <= 100) == (500, True)
    record_property("share_within_frame_time", share)


@pytest.mark.slow
def test_late_frames_are_left_out_not_queued(tmp_path: Path) -> None:
    """Two hundred frames a second, which no robot tracks: the newest one is taken, to the last."""
    bag = written_bag(tmp_path, frames=60, period_s=0.005)
    robot = started(bag, tmp_path)
    said, errors = robot.communicate(timeout=HANGS_AFTER_S)
    assert robot.returncode == 0, errors
    frames, left_out, _ = numbers(_ENDED, said)
    shown = times(said.splitlines())
    assert len(shown) == frames
    assert frames + left_out == 60
    assert left_out > 0
    assert numbers(_LEFT_OUT, said) == [round(100.0 * left_out / 60)]
    recorded = fg.open_recording(bag).timestamps
    assert shown[-1] == pytest.approx(float(recorded[-1]), abs=0.006)
    assert fg.Map.load(tmp_path / "live.fgmap")
