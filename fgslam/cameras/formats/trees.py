"""Calibration files as keys and values: YAML, JSON and XML, with OpenCV's matrices as arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import yaml

from fgslam.core.array_files import UNREADABLE, require_plain
from fgslam.core.arrays import FloatArray
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text, require_file
from fgslam.core.geometry import is_rigid, pose, rotation_from_quaternion
from fgslam.core.yaml_text import PlainLoader

Tree: TypeAlias = Mapping[str, Any]
"""Keys and values of a file; OpenCV's matrices are arrays."""

_MATRICES = ("opencv-matrix", "opencv-nd-matrix")
_TIGHT = re.compile(r"^(\s*[\w.]+):(?=[^\s:/\\])")
_CAMERA_INFO = re.compile(r"^distortion_model:", re.MULTILINE)
_MESSAGE_END = re.compile(r"^---[ \t]*$", re.MULTILINE)
_ARCHIVE = ".npz"
_LARGEST_ARCHIVE = 100_000_000  # bytes; points of a board may be in it
_DEEPEST = 20  # levels of nesting: no calibration has ten


class _Loader(PlainLoader):
    """The loader of plain values, with OpenCV's matrices as what they hold."""

    most_values = 1_000_000


def _plain(loader: yaml.SafeLoader, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


for _tag in _MATRICES:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _plain)


def read_tree(path: Path) -> Tree | None:
    """Keys and values of a file; None where it is none of YAML, JSON, XML and NumPy's archive.

    Raises:
        CalibrationError: it cannot be read, or is meant to be one of them and is malformed.
    """
    if path.suffix.lower() == _ARCHIVE:
        return _of_archive(path)
    text = read_text(path, CalibrationError).lstrip("\ufeff \t\r\n")
    if text.startswith("{"):
        return _of_json(path, text)
    if text.startswith("<"):
        return _of_xml(path)
    return _of_yaml(path, text)


def _of_archive(path: Path) -> Tree:
    """The arrays of ``numpy.savez``; what is no array of numbers is left out."""
    require_file(path, CalibrationError, "restore the file", _LARGEST_ARCHIVE)
    try:
        with np.load(path, allow_pickle=False) as found:
            require_plain(found)
            arrays = {key: _loaded(found, key) for key in found.files}
    except UNREADABLE as cause:
        reason = " ".join(str(cause).split())
        raise CalibrationError(f"{path} is no archive of NumPy ({reason}); save it again") from None
    return {key: value for key, value in arrays.items() if value is not None}


def _loaded(archive: Any, key: str) -> Any:
    try:
        value = archive[key]
    except ValueError:  # Python's objects
        return None
    if value.dtype.kind not in "fiu":
        return str(value) if value.ndim == 0 else None
    return float(value) if value.ndim == 0 else np.asarray(value, np.float64)


def _of_json(path: Path, text: str) -> Tree:
    try:
        return _with_arrays(path, json.loads(text))
    except RecursionError:
        raise CalibrationError(f"{path} is nested too deeply; correct the file") from None
    except ValueError as cause:
        raise CalibrationError(f"{path} is not JSON: {cause}; correct the file") from None


def _of_yaml(path: Path, text: str) -> Tree | None:
    lines = _first_message(text).splitlines()
    if text.startswith("%YAML"):
        # OpenCV writes a directive that is no YAML, and reads "key:value" without a space.
        lines = [_TIGHT.sub(r"\1: ", line) for line in lines if not line.startswith("%YAML")]
    try:
        values = _Loader("\n".join(lines)).get_single_data()
    except RecursionError:
        raise CalibrationError(f"{path} is nested too deeply; correct the file") from None
    except (yaml.YAMLError, ValueError) as cause:
        if not text.startswith("%YAML") and path.suffix.lower() not in (".yaml", ".yml"):
            return None
        reason = " ".join(str(cause).split())
        raise CalibrationError(f"{path} is not YAML: {reason}; correct the file") from None
    return _with_arrays(path, values) if isinstance(values, dict) else None


def is_camera_text(text: str) -> bool:
    """Whether a text may be a ROS camera_info, as ``rostopic echo`` writes it too."""
    return _CAMERA_INFO.search(text) is not None


def _first_message(text: str) -> str:
    """The first message of an echo of a topic, each of which ends in a line of dashes."""
    if text.startswith("%YAML") or not is_camera_text(text):
        return text.rstrip().removesuffix("\n---")
    return _MESSAGE_END.split(text.removeprefix("---\n"), maxsplit=1)[0]


def _of_xml(path: Path) -> Tree:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        root = storage.root()
        values = {name: _of_node(root.getNode(name), 0) for name in root.keys()}  # noqa: SIM118
        storage.release()
    except (cv2.error, SystemError) as error:  # its constructor wraps the one in the other
        cause = " ".join(str(error.__cause__ or error).split())
        raise CalibrationError(f"{path} is malformed: {cause}; write the file again") from None
    return _with_arrays(path, values)


def _of_node(node: cv2.FileNode, depth: int) -> Any:
    if depth > _DEEPEST:
        return None
    if node.isMap():
        names = node.keys()
        return {name: _of_node(node.getNode(name), depth + 1) for name in names}
    if node.isSeq():
        return [_of_node(node.at(k), depth + 1) for k in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None


def _with_arrays(path: Path, values: Mapping[Any, Any]) -> Tree:
    """The same with what has rows, columns and data as arrays; keys are texts."""
    return {str(key): _arrays(path, str(key), value, 0) for key, value in values.items()}


def _arrays(path: Path, key: str, value: Any, depth: int) -> Any:
    if depth > _DEEPEST:
        raise CalibrationError(f"{path} is nested too deeply; correct the file")
    if isinstance(value, list):
        return [_arrays(path, key, one, depth + 1) for one in value]
    if not isinstance(value, dict):
        return value
    if {"rows", "cols", "data"} <= value.keys():
        return _array(path, key, value)
    if {"sizes", "dt", "data"} <= value.keys():
        return _array_of_sizes(path, key, value)
    return {str(k): _arrays(path, str(k), v, depth + 1) for k, v in value.items()}


def _array(path: Path, key: str, block: Mapping[str, Any]) -> FloatArray:
    rows, columns, given = block["rows"], block["cols"], block["data"]
    data = flat_numbers(given)
    whole = all(is_finite_number(count) and count >= 0 for count in (rows, columns))
    cells = round(rows * columns) if whole else 0
    if data is None or not whole or len(data) % max(cells, 1) or bool(cells) != bool(len(data)):
        raise CalibrationError(
            f"{path}: {key} must be {rows} rows of {columns} finite numbers; correct the file"
        )
    shape = (round(rows), round(columns))
    # Points have several numbers a cell.
    return data.reshape(shape if len(data) == cells else (*shape, -1))


def _array_of_sizes(path: Path, key: str, block: Mapping[str, Any]) -> FloatArray:
    """An array of any number of axes: OpenCV 5 writes a row of numbers with one."""
    sizes, data = flat_numbers(block["sizes"]), flat_numbers(block["data"])
    if sizes is None or data is None or np.prod(sizes) != len(data) or (sizes < 0.0).any():
        raise CalibrationError(f"{path}: {key} must be finite numbers of its sizes; correct it")
    return data.reshape(tuple(np.rint(sizes).astype(int)))


# --------------------------------------------------------------------------------------------
# Numbers in them


def flat_numbers(value: Any, depth: int = 0) -> FloatArray | None:
    """All numbers of lists in lists, or of an array, in order; None where one is no number."""
    if isinstance(value, np.ndarray):
        return np.asarray(value, np.float64).ravel()
    if depth > _DEEPEST:
        return None
    found: list[float] = []
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, list | np.ndarray):
            inner = flat_numbers(one, depth + 1)
            if inner is None:
                return None
            found.extend(inner.tolist())
            continue
        number = _number(one)
        if number is None:
            return None
        found.append(number)
    return np.array(found, np.float64)


def _number(value: Any) -> float | None:
    if isinstance(value, str):  # YAML 1.1 takes 1e-05 for a text
        try:
            value = float(value)
        except ValueError:
            return None
    return float(value) if is_finite_number(value) else None


class Values:
    """The values of a part of a file, asked for by key; what is wrong is named with the file."""

    def __init__(self, path: Path, tree: Any, where: str = "") -> None:
        """``tree`` is that part; ``where`` leads to it and is part of messages."""
        self.path, self.where = path, where
        self.tree: Tree = tree if isinstance(tree, Mapping) else {}

    def __contains__(self, key: str) -> bool:
        return self.tree.get(key) is not None

    def inside(self, key: str) -> Values:
        """The part under a key, empty where there is none."""
        return Values(self.path, self.tree.get(key), f"{self.where}{key}.")

    def text(self, key: str, default: str = "") -> str:
        """The value as lower-case text."""
        return str(self.tree.get(key, default)).strip().lower()

    def listed(self, key: str) -> list[Any]:
        """A list. Raises CalibrationError where there is none."""
        value = self.tree.get(key)
        if not isinstance(value, list):
            raise self.refuse(f"{key} must be a list, one entry a camera; correct the file")
        return value

    def numbers(self, key: str, count: int | None = None) -> FloatArray:
        """(count,) finite numbers, or as many as there are. Raises CalibrationError otherwise."""
        given = self.tree.get(key)
        if isinstance(given, dict) and "data" in given:  # a matrix without its shape
            key, given = f"{key}.data", given["data"]
        found = None if given is None else flat_numbers(given)
        if found is None or count not in (None, len(found)):
            many = "" if count is None else f"{count} "
            raise self.refuse(
                f"{key} is {_short(given)}, expected {many}finite "
                f"number{'' if count == 1 else 's'}; correct the file"
            )
        return found

    def number(self, key: str, default: float | None = None) -> float:
        """One number; the default, if there is one, where the key is missing."""
        if default is not None and key not in self:
            return default
        return float(self.numbers(key, 1)[0])

    def named(self, keys: Iterable[str], default: float | None = None) -> FloatArray:
        """One number for each key."""
        return np.array([self.number(key, default) for key in keys])

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        """(rows, columns) numbers."""
        return self.numbers(key, rows * columns).reshape(rows, columns)

    def motion(self, key: str) -> FloatArray:
        """(4, 4) rigid motion, of 16 or of 12 numbers."""
        found = self.numbers(key)
        rows = found if len(found) == 12 else self.numbers(key, 16)
        motion = np.append(rows, np.zeros(16 - len(rows))).reshape(4, 4)
        if not motion[3].any():  # written by tools that never look at it
            motion[3, 3] = 1.0
        if not is_rigid(motion):
            raise self.refuse(f"{key} is not a rigid motion; correct the file")
        return motion

    def size(self, width: str, height: str) -> tuple[int, int]:
        """Width and height, by two keys, or by one that holds both where these are equal."""
        found = self.numbers(width, 2) if width == height else self.named((width, height))
        return round(found[0]), round(found[1])

    def refuse(self, text: str) -> CalibrationError:
        """An error that names file and part."""
        return CalibrationError(f"{self.path}: {self.where}{text}")


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """(3, 3) of focal lengths and principal point."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def motion_of(position: FloatArray, quaternion: FloatArray) -> FloatArray:
    """(4, 4) of a position and a quaternion (x, y, z, w) of any length but 0."""
    return pose(rotation_from_quaternion(quaternion / np.linalg.norm(quaternion)), position)
