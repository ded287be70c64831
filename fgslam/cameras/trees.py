"""Calibration files as keys and values, and the tables that say which key holds which number.

A :class:`Row` of a format's table states where a camera's size, intrinsics and lens are;
:func:`camera_of` reads them. Files are YAML, JSON and XML, with OpenCV's matrices as arrays.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import yaml

from fgslam.cameras.lenses import RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text
from fgslam.core.geometry import is_rigid
from fgslam.core.yaml_text import PlainLoader

Size: TypeAlias = tuple[int, int]
Tree: TypeAlias = Mapping[str, Any]
"""Keys and values of a file; OpenCV's matrices are arrays."""

FOCAL = ("fx", "fy", "cx", "cy")
BROWN = ("k1", "k2", "p1", "p2")
KANNALA = ("k1", "k2", "k3", "k4")
ORIGIN = np.eye(4)


class Row(NamedTuple):
    """Where a camera's numbers are: key paths, whose parts are joined by dots.

    Attributes:
        size: of width and height, or one of both.
        lenses: by the texts under ``kind``: our model, and the keys of its parameters: one of all,
            or one of each; without keys there are none. A key that ends in `?` may be missing: 0.
        kind: of the texts that name the lens; none: the only one.
        focal: of fx, fy, cx, cy, or one of all four.
        matrix: of the intrinsic matrix, where that is stated instead.
    """

    size: tuple[str, ...]
    lenses: Mapping[str, tuple[str, tuple[str, ...]]]
    kind: tuple[str, ...] = ()
    focal: tuple[str, ...] = FOCAL
    matrix: str = ""


_NAMES = {
    "radtan": "radtan radialtangential plumbbob brown brownconrady modifiedbrownconrady rational "
    "rationalpolynomial radtan8 thinprism opencv fullopencv pinhole perspective 1 4",
    "equidistant": "equidistant equi fisheye opencvfisheye kannalabrandt kannalabrandt4 "
    "kannalabrandt8 kb kb4 kb8 5",
    "fov": "fov atan",
    "omni": "omni omnidirectional mei",
    "ds": "ds doublesphere",
    "eucm": "eucm",
}
_LENSES = {"": "radtan"} | {name: lens for lens, names in _NAMES.items() for name in names.split()}
"""Our model by what tools call it (of RealSense also its numbers), in small letters alone."""


def listed_lenses(key: str, *models: str, **named: str) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Lenses of a row whose parameters are all under one key; ``named``: our models by texts."""
    known = {model: model for model in models} | named
    return {text: (model, (key,)) for text, model in known.items()}


def lens_named(text: str) -> str:
    """Our model of a lens by any tool's name for it; empty where that is not known."""
    return _LENSES.get(re.sub(r"[^a-z0-9]|^(rs2_)?distortion[._]", "", text.lower()), "")


def camera_of(part: Values, row: Row, bTc: FloatArray = ORIGIN, name: str = "") -> RawCamera:
    """The camera that a part of a file holds by a row. Raises CalibrationError."""
    model, keys = row.lenses[kind_of(part, row.kind, row.lenses)]
    parameters = part.values(keys) if keys else np.zeros(4)
    size = part.size(*row.size)
    matrix = part.matrix(row.matrix, 3, 3) if row.matrix else part.intrinsics(row.focal)
    return checked_camera(RawCamera(*size, matrix, parameters, bTc, name or part.name, model))


def kind_of(part: Values, keys: Sequence[str], known: Iterable[str]) -> str:
    """The texts under some keys, joined by `-`; the last may be any name of a lens (`lens_named`).

    Raises:
        CalibrationError: they are not known.
    """
    texts = [part.text(key, "none") for key in keys]
    named = "-".join([*texts[:-1], lens_named(texts[-1])] if texts else texts)
    if "-".join(texts) not in known and named in known:
        return named
    if "-".join(texts) not in known:
        stated = " with ".join(f"{key} {text}" for key, text in zip(keys, texts, strict=True))
        raise part.refuse(f"{stated} is not known; known: {', '.join(known)}")
    return "-".join(texts)


# --------------------------------------------------------------------------------------------
# Keys and values


_TIGHT = re.compile(r"^(\s*[\w.]+):(?=[^\s:/\\])", re.MULTILINE)
_CAMERA_INFO = re.compile(r"^distortion_model:", re.MULTILINE)
_MESSAGE_END = re.compile(r"^---[ \t]*$", re.MULTILINE)
_DEEPEST = 20  # levels of nesting: no calibration has ten


class _Loader(PlainLoader):
    """The loader of plain values, with OpenCV's matrices as what they hold."""

    most_values = 1_000_000


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_tag}", partial(_Loader.construct_mapping, deep=True)
    )


def read_tree(path: Path) -> Tree | None:
    """Keys and values of a file; None where it is none of YAML, JSON and XML.

    Raises:
        CalibrationError: it cannot be read, or is meant to be one of them and is malformed.
    """
    text = read_text(path, CalibrationError).lstrip("\ufeff \t\r\n")
    if text.startswith("<"):
        try:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            values = _of_node(storage.root(), 0)
            storage.release()
        except (cv2.error, SystemError) as error:  # its constructor wraps the one in the other
            cause = " ".join(str(error.__cause__ or error).split())
            raise CalibrationError(f"{path} is malformed: {cause}; write the file again") from None
    else:
        values = read_json(path, text) if text.startswith("{") else _of_yaml(path, text)
    if not isinstance(values, dict):
        return None
    return {str(key): _with_arrays(path, str(key), value, 0) for key, value in values.items()}


def read_json(path: Path, text: str) -> Any:
    """The values of a JSON text. Raises CalibrationError: it is none."""
    try:
        return json.loads(text)
    except RecursionError:
        raise CalibrationError(f"{path} is nested too deeply; correct the file") from None
    except ValueError as cause:
        raise CalibrationError(f"{path} is not JSON: {cause}; correct the file") from None


def _of_yaml(path: Path, text: str) -> Any:
    if text.startswith("%YAML"):
        # OpenCV writes a head that is no YAML, and reads "key:value" without a space.
        text = _TIGHT.sub(r"\1: ", text.partition("\n")[2])
    elif is_camera_text(text):  # the first message of an echo of a topic
        text = _MESSAGE_END.split(text.removeprefix("---\n"), maxsplit=1)[0]
    try:
        return _Loader(text.rstrip().removesuffix("\n---")).get_single_data()
    except RecursionError:
        raise CalibrationError(f"{path} is nested too deeply; correct the file") from None
    except (yaml.YAMLError, ValueError) as cause:
        if path.suffix.lower() not in (".yaml", ".yml"):
            return None
        reason = " ".join(str(cause).split())
        raise CalibrationError(f"{path} is not YAML: {reason}; correct the file") from None


def is_camera_text(text: str) -> bool:
    """Whether a text may be a ROS camera_info, as ``rostopic echo`` writes it too."""
    return _CAMERA_INFO.search(text) is not None


def _of_node(node: cv2.FileNode, depth: int) -> Any:
    if depth > _DEEPEST:
        return None
    if node.isMap():
        return {name: _of_node(node.getNode(name), depth + 1) for name in node.keys()}  # noqa: SIM118 - no mapping
    if node.isSeq():
        return [_of_node(node.at(k), depth + 1) for k in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None


def _with_arrays(path: Path, key: str, value: Any, depth: int) -> Any:
    """The value with what has rows, columns and data as arrays; keys are texts."""
    if depth > _DEEPEST:
        raise CalibrationError(f"{path} is nested too deeply; correct the file")
    if isinstance(value, list):
        return [_with_arrays(path, key, one, depth + 1) for one in value]
    if not isinstance(value, dict):
        return value
    if "data" not in value or not ("sizes" in value or {"rows", "cols"} <= value.keys()):
        return {str(k): _with_arrays(path, str(k), v, depth + 1) for k, v in value.items()}
    # OpenCV 5 writes a row of numbers with one axis; points have several numbers a cell.
    sizes = flat_numbers(value.get("sizes", [value.get("rows"), value.get("cols")]))
    data = flat_numbers(value["data"])
    shape = tuple(np.rint(np.empty(0) if sizes is None else sizes).astype(int).tolist())
    cells = math.prod(shape)
    if (
        data is None
        or not shape
        or min(shape) < 0
        or len(data) % max(cells, 1)
        or bool(cells) != bool(len(data))
    ):
        wanted = " x ".join(map(str, shape))
        raise CalibrationError(
            f"{path}: {key} must be a matrix of {wanted} finite numbers; correct the file"
        )
    return data.reshape(shape if len(data) == cells else (*shape, -1))


def flat_numbers(value: Any) -> FloatArray | None:
    """All numbers of lists in lists, or of an array, in order; None where one is no number."""
    try:  # YAML 1.1 takes 1e-05 for a text
        found = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        return None
    return found if np.isfinite(found).all() else None


class Values:
    """The values of a part of a file, asked for by key; what is wrong is named with the file."""

    def __init__(self, path: Path, tree: Any, where: str = "") -> None:
        """``tree`` is that part; ``where`` leads to it and is part of messages."""
        self.path, self.where = path, where
        self.tree: Tree = tree if isinstance(tree, Mapping) else {}

    @property
    def name(self) -> str:
        """Of the file and the part."""
        part = self.where.rstrip(" .:")
        return f"{self.path.name}: {part}" if part else self.path.name

    def _at(self, key: str) -> Any:
        if key in self.tree or "." not in key:
            return self.tree.get(key)
        first, _, rest = key.partition(".")
        return self.inside(first)._at(rest)

    def __contains__(self, key: str) -> bool:
        return self._at(key) is not None

    def inside(self, key: str) -> Values:
        """The part under a key, empty where there is none."""
        return Values(self.path, self.tree.get(key), f"{self.where}{key}.")

    def text(self, key: str, default: str = "") -> str:
        """The value as lower-case text."""
        return str(self.tree.get(key, default)).strip().lower()

    def numbers(self, key: str, count: int | None = None) -> FloatArray:
        """(count,) finite numbers, or as many as there are. Raises CalibrationError otherwise."""
        given = self._at(key)
        if isinstance(given, dict) and "data" in given:  # a matrix without its shape
            key, given = f"{key}.data", given["data"]
        found = None if given is None else flat_numbers(given)
        if found is None or count not in (None, len(found)):
            many = "" if count is None else f"{count} "
            text = "missing" if given is None else " ".join(repr(given).split())
            raise self.refuse(
                f"{key} is {text if len(text) <= 60 else text[:57] + '...'}, expected {many}finite "
                f"number{'' if count == 1 else 's'}; correct the file"
            )
        return found

    def number(self, key: str, default: float | None = None) -> float:
        """One number; the default, if there is one, where the key is missing."""
        if default is not None and key not in self:
            return default
        return float(self.numbers(key, 1)[0])

    def values(self, keys: Sequence[str]) -> FloatArray:
        """One number for each key, 0 for a missing one that ends in `?`; of one key alone all."""
        if len(keys) == 1:
            return self.numbers(keys[0])
        return np.array([self.number(k.rstrip("?"), 0.0 if k[-1] == "?" else None) for k in keys])

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        """(rows, columns) numbers."""
        return self.numbers(key, rows * columns).reshape(rows, columns)

    def intrinsics(self, keys: Sequence[str]) -> FloatArray:
        """(3, 3) of fx, fy, cx, cy by their keys, or by one key of all four."""
        return intrinsic_matrix(
            *(self.numbers(keys[0], 4) if len(keys) == 1 else self.values(keys))
        )

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

    def size(self, *keys: str) -> Size:
        """Width and height, by two keys, or by one that holds both."""
        width, height = self.numbers(keys[0], 2) if len(keys) == 1 else self.values(keys)
        return round(width), round(height)

    def refuse(self, text: str) -> CalibrationError:
        """An error that names file and part."""
        return CalibrationError(f"{self.path}: {self.where}{text}")


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """(3, 3) of focal lengths and principal point."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
