"""Images, and recordings that consist of them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

import fgslam as fg
from fgslam.core.errors import FgslamError
from scripts.fuzz.damage import Rng, damaged_bytes, damaged_text, require_one_line, written
from scripts.fuzz.texts import CALIBRATION


def _picture() -> np.ndarray[Any, Any]:
    return np.add.outer(np.arange(30), np.arange(40)).astype(np.uint8)


def image(rng: Rng, folder: Path) -> Path:
    """An image file, damaged."""
    suffix = (".png", ".jpg", ".bmp", ".tif", ".pgm")[rng.integers(5)]
    data = bytes(cv2.imencode(suffix, _picture())[1])
    return written(folder / f"a{suffix}", damaged_bytes(rng, data))


def png(rng: Rng, folder: Path) -> Path:
    """A PNG, whose chunks have checksums, damaged."""
    return written(folder / "a.png", damaged_bytes(rng, bytes(cv2.imencode(".png", _picture())[1])))


def is_picture(found: np.ndarray[Any, Any]) -> bool:
    """Whether an image is the undamaged one."""
    return np.array_equal(found, _picture())


def recording(rng: Rng, folder: Path) -> Path:
    """A folder of images of which one file is damaged or gone."""
    for side in ("left", "right"):
        (folder / side).mkdir(exist_ok=True)
        for k in range(3):
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), _picture())
    written(folder / "times.txt", "".join(f"{k:06d} {k}.0\n" for k in range(3)))
    values = json.loads(CALIBRATION) | {"width": 40, "height": 30, "cx": 20.0, "cy": 15.0}
    written(folder / "calib.json", json.dumps(values, indent=1))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[int(rng.integers(len(files)))]
    if rng.random() < 0.2:
        path.unlink()
    elif path.suffix in (".txt", ".json"):
        written(path, damaged_text(rng, path.read_text("utf-8")))
    else:
        written(path, damaged_bytes(rng, path.read_bytes()))
    return folder


def read_recording(path: Path) -> None:
    """All frames of a recording; those that cannot be read are refused one by one."""
    sequence = fg.open_recording(path).sequence
    for i in range(len(sequence)):
        try:
            sequence.frame(i)
        except FgslamError as error:
            require_one_line(error)


_BAGS = (".bag", ".mcap", ".db3")
_SHIFT = -20.0  # fx times the baseline, pixel metres


def bag(rng: Rng, folder: Path) -> Path:
    """A ROS bag of two cameras, damaged."""
    ending = _BAGS[rng.integers(len(_BAGS))]
    return written(folder / f"drive{ending}", damaged_bytes(rng, _bag(ending)))


@cache
def _bag(ending: str) -> bytes:
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ending == ".bag" else Stores.ROS2_HUMBLE)
    pack = store.serialize_ros1 if ending == ".bag" else store.serialize_cdr
    with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        if ending == ".bag":
            path = Path(scratch) / "drive.bag"
            writer: Any = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if ending == ".mcap" else None
            folder = Path(scratch) / "drive"
            path = folder / f"drive{ending}"
            writer = rosbag2.Writer(
                folder, version=9, storage_plugin=plugin or rosbag2.StoragePlugin.SQLITE3
            )
        with writer:
            for topic, kind, messages in _topics(store, ending == ".bag"):
                connection = writer.add_connection(topic, kind, typestore=store)
                for stamp, message in messages:
                    writer.write(connection, stamp, pack(message, kind))
        return path.read_bytes()


def _topics(store: Any, ros1: bool) -> list[tuple[str, str, list[tuple[int, Any]]]]:
    kinds = store.types
    out = []
    for name, shift in (("left", 0.0), ("right", _SHIFT)):
        images, infos = [], []
        for k in range(3):
            stamp = 10**18 + k * 10**8
            time = kinds["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            header = kinds["std_msgs/msg/Header"](
                stamp=time, frame_id=name, **({"seq": 0} if ros1 else {})
            )
            pixels = _picture().ravel()
            image = kinds["sensor_msgs/msg/Image"](header, 30, 40, "mono8", 0, 40, pixels)
            images.append((stamp, image))
            infos.append((stamp, _camera_info(kinds, header, shift, ros1)))
        out.append((f"/{name}/image_raw", "sensor_msgs/msg/Image", images))
        out.append((f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", infos))
    return out


def _camera_info(kinds: Any, header: Any, shift: float, ros1: bool) -> Any:
    matrices = {
        "d": np.zeros(5),
        "k": np.array([200.0, 0, 20, 0, 200, 15, 0, 0, 1]),
        "r": np.eye(3).ravel(),
        "p": np.array([200.0, 0, 20, shift, 0, 200, 15, 0, 0, 0, 1, 0]),
    }
    return kinds["sensor_msgs/msg/CameraInfo"](
        header=header,
        height=30,
        width=40,
        distortion_model="plumb_bob",
        **{name.upper() if ros1 else name: values for name, values in matrices.items()},
        binning_x=0,
        binning_y=0,
        roi=kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )


def film(rng: Rng, folder: Path) -> Path:
    """A film of two images side by side and its calibration; one of them damaged."""
    text = json.dumps(json.loads(CALIBRATION) | {"width": 64, "height": 48, "cx": 32.0, "cy": 24.0})
    data = _film()
    if rng.random() < 0.2:
        text = damaged_text(rng, text)
    else:
        data = damaged_bytes(rng, data)
    written(folder / "calib.json", text)
    return written(folder / "drive.avi", data)


@cache
def _film() -> bytes:
    with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        path = Path(scratch) / "drive.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (128, 48))
        for k in range(5):
            writer.write(np.full((48, 128, 3), 20 * k, np.uint8))
        writer.release()
        return path.read_bytes()
