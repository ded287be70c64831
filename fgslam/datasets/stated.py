"""Poses and covariances as other programs state them: text files of numbers, and ROS bags.

A row is known by its length: a pose, then perhaps two 3x3 blocks or the 6x6 of its covariance.
Order and tangent space are known where a header or a type of message states them, else left open.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_text
from fgslam.core.store import from_upper
from fgslam.core.types import Trajectory, correlation, parse_rows
from fgslam.datasets.layouts import is_bag
from fgslam.datasets.times import (
    NANOSECONDS,
    Table,
    poses_of,
    require_increasing,
    rows_at,
    time_unit,
)

TANGENT_WORDS = (
    *("rotation_first", "translation_first", "local", "global", "split_local", "split_global"),
    *("radians", "degrees"),
)
"""What comments, headers and users state of covariances (:mod:`fgslam.evaluation.credibility`)."""

_HEADERS = {
    r"tangent \[rotation, translation\]": ("rotation_first", "local", "radians"),  # ours
    r"\bpr11\b": ("rotation_first", "split_local", "radians"),  # OpenVINS
    r"\b[pt]xx\b": ("translation_first", "radians"),  # cnspy, and its types of error
    **{rf"\btype{k}\b": (TANGENT_WORDS[1 + k if k < 3 else k - 1],) for k in (1, 2, 5, 6)},
    **{rf"\b{word}\b": (word,) for word in TANGENT_WORDS},
}

_POSE = 8
_SIZES = (12, 21, 36)
_MATRICES = "12 numbers (two 3x3 blocks, upper triangles), 21 (upper triangle of a 6x6) or 36"
_POSES = f"timestamp tx ty tz qx qy qz qw in each row, alone or with {_MATRICES} after it"
_ROWS = f"{_MATRICES} in each row, with or without the time before it"
_EUROC = _POSE + 9  # velocity and biases follow
_SAME_TIME_S = 1e-3
_STATED = ("geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry")
_STAMPED = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
_INDEFINITE = -0.01  # smallest eigenvalue of correlations: more is rounding in a file


@dataclass(frozen=True, slots=True, eq=False)
class StatedPoses:
    """Poses of a file, and their covariances in its own order and tangent space.

    Attributes:
        trajectory: the poses.
        covariances: (n, 6, 6); NaN in rows without; None where it has none at all.
        words: of :data:`TANGENT_WORDS`, what it states.
        usual: the space that its kind is defined in; empty: there is none.
        frame_stated: whether a comment states what the poses are of.
        notes: what was assumed.
    """

    trajectory: Trajectory
    covariances: FloatArray | None = None
    words: frozenset[str] = frozenset()
    usual: str = ""
    frame_stated: bool = False
    notes: tuple[str, ...] = ()


def read_stated(source: str | Path, covariance: Path | None = None) -> StatedPoses:
    """The poses of a TUM, EuRoC, OpenVINS or cnspy file, or of a topic: ``BAG``, ``BAG:/topic``.

    Args:
        source: the file.
        covariance: matrices in a file of their own, a row a pose.

    Raises:
        DatasetError: a file is missing or malformed, a matrix is no covariance, or both files do
            not belong together.
    """
    path, _, topic = str(source).partition(":/")
    if is_bag(Path(path)) or Path(path, "metadata.yaml").is_file():
        found = _of_bag(Path(path), topic and f"/{topic}", own=covariance is None)
    else:
        found = _of_text(Path(source), own=covariance is None)
    return found if covariance is None else _joined(found, Path(source), covariance)


def _of_text(path: Path, own: bool) -> StatedPoses:
    """Poses, and with their ``own`` covariances where the file has some."""
    table, head = _numbers(path, (_POSE, _EUROC, *(_POSE + n for n in _SIZES)), _POSES)
    values = table.values
    bad = np.flatnonzero(~np.isfinite(values[:, :_POSE]).all(axis=1))
    if len(bad):
        line = table.lines[bad[0]]
        raise DatasetError(f"{path}, line {line}: a pose is not finite; remove the line")
    unit, seconds = time_unit(values[:, 0])
    times = seconds * values[:, 0]
    require_increasing(table, times)
    # EuRoC's rows have commas and w first; others' headers with commas name x first.
    w_first = bool(re.search(r"q\w*_?w\b.*q\w*_?x\b", head)) or head == ","
    poses = poses_of(table, values[:, 1:4], values[:, [5, 6, 7, 4] if w_first else [4, 5, 6, 7]])
    frame = re.search(r"pose of the (left|right|body)", head)
    trajectory = Trajectory(times, poses, frame[1] if frame else "right")  # type: ignore[arg-type]
    stated = own and values.shape[1] not in (_POSE, _EUROC)
    covariances = _matrices(table, _POSE) if stated else None
    notes = () if seconds == 1.0 else (f"times of {path} are read as {unit}",)
    words = _words(head) if stated else frozenset()
    return StatedPoses(trajectory, covariances, words, "", frame is not None, notes)


def _joined(found: StatedPoses, path: Path, file: Path) -> StatedPoses:
    """The poses with the covariances of another file: by time where it has one, else row by row."""
    table, head = _numbers(file, (*_SIZES, *(1 + n for n in _SIZES)), _ROWS)
    times, timed = found.trajectory.timestamps, table.values.shape[1] not in _SIZES
    matrices = _matrices(table, int(timed))
    if not timed and len(table) != len(times):
        raise DatasetError(
            f"{file}: {len(table)} rows without times for the {len(times)} poses of {path}; give a "
            "row for each pose, or the time first in each row"
        )
    if timed:
        stamps = table.values[:, 0] * time_unit(table.values[:, 0])[1]
        require_increasing(table, stamps)
        rows = rows_at(stamps, times, _SAME_TIME_S)
        if (rows < 0).all():
            raise DatasetError(
                f"{file}: from {stamps[0]:.3f} to {stamps[-1]:.3f} s, the poses of {path} from "
                f"{times[0]:.3f} to {times[-1]:.3f} s: no time is the same; write the poses' times"
            )
        matrices = np.where(rows[:, None, None] < 0, np.nan, matrices[rows])
    return replace(found, covariances=matrices, words=_words(head))


def _words(head: str) -> frozenset[str]:
    return frozenset(w for sign, words in _HEADERS.items() if re.search(sign, head) for w in words)


def _numbers(path: Path, widths: Iterable[int], expected: str) -> tuple[Table, str]:
    """The rows of a file, and its comments and header in small letters; a comma without these."""
    text = read_text(path, remedy="give a file of poses, or BAG:/topic")
    lines = text.splitlines()
    heads = [bool(re.match(r"\s*(#|(?!nan\b)[a-z_\"]+[,\s])", line, re.I)) for line in lines]
    head = " ".join(line.lower() for line, is_head in zip(lines, heads, strict=True) if is_head)
    rows = ["" if is_head else line for line, is_head in zip(lines, heads, strict=True)]
    first = next(filter(str.strip, rows), "")
    width = len(first.replace(",", " ").split())
    if width not in widths:
        raise DatasetError(f"{path}: {width} numbers in a row; give {expected}")
    values, numbers = parse_rows(path, "\n".join(rows).replace(",", " "), width, expected)
    return Table(path, values, numbers), head or ("," if "," in first else "")


def _matrices(table: Table, start: int) -> FloatArray:
    """(n, 6, 6) of the numbers from a column on, checked."""
    numbers = table.values[:, start:]
    if numbers.shape[1] == 12:
        out = np.zeros((len(numbers), 6, 6))
        out[:, :3, :3] = from_upper(numbers[:, :6], 3)
        out[:, 3:, 3:] = from_upper(numbers[:, 6:], 3)
    else:
        full = numbers.shape[1] == 36
        out = numbers.reshape(-1, 6, 6) if full else from_upper(numbers, 6)
    return _checked(out, table.path, table.lines, "line")


def _checked(matrices: FloatArray, path: Path, places: IntArray, place: str) -> FloatArray:
    """Symmetric covariances. Raises DatasetError where they are none."""
    known = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    found = np.where(known[:, None, None], matrices, np.eye(6))
    scale = np.abs(found).max(axis=(1, 2))
    if not (scale[known] > 0.0).any():
        raise DatasetError(
            f"{path}: all its covariances are zero or not known; let the program fill them, or "
            "give them by --covariance FILE"
        )
    even = 0.5 * (found + np.swapaxes(found, 1, 2))
    lowest = np.minimum(
        np.linalg.eigvalsh(correlation(even))[:, 0],
        np.diagonal(found, axis1=1, axis2=2).min(axis=1) / np.maximum(scale, 1e-300),
    )
    for what, bad in (
        ("symmetric", np.abs(found - even).max(axis=(1, 2)) > 1e-3 * scale),
        ("positive definite", lowest < _INDEFINITE),
    ):
        if np.any(bad):
            raise DatasetError(
                f"{path}, {place} {places[int(np.argmax(bad))]}: the covariance is not {what}, nor "
                f"are {int(np.sum(bad)) - 1} others; correct what wrote it, or write nan in place "
                "of its numbers to leave it out"
            )
    return np.where(known[:, None, None], even, np.nan)


def _of_bag(path: Path, topic: str, own: bool) -> StatedPoses:
    from fgslam.datasets.bags import Bag, paths_of  # rosbags and OpenCV

    bag = Bag(paths_of(path))
    known = [one for one in bag.topics if one.kind in (*_STATED, *_STAMPED) and one.count]
    chosen = [t for t in known if (t.name == topic if topic else t.kind in _STATED)] or known
    if len(chosen) != 1 or (topic and chosen[0].name != topic):
        names = ", ".join(f"{path}:{one.name}" for one in known)
        raise DatasetError(
            f"{path}: {f'no topic {topic}' if topic else f'{len(known)} topics'} of poses; "
            + (f"give one of {names}" if names else f"record one of {', '.join(_STATED)}")
        )
    rows, matrices = [], []
    for message in bag.decoded(chosen[0].name):
        stamp = message.header.stamp
        held: Any = getattr(message, "pose", None) or message.transform
        held, covariance = getattr(held, "pose", held), getattr(held, "covariance", None)
        p = getattr(held, "position", None) or held.translation
        q = getattr(held, "orientation", None) or held.rotation
        seconds = stamp.sec + NANOSECONDS * stamp.nanosec
        rows.append([seconds, p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        matrices.append(np.full(36, np.nan) if covariance is None else covariance)
    values, numbers = np.array(rows, np.float64), np.arange(1, len(rows) + 1)
    table = Table(Path(f"{path}:{chosen[0].name}, messages"), values, numbers)
    require_increasing(table, values[:, 0])
    trajectory = Trajectory(values[:, 0], poses_of(table, values[:, 1:4], values[:, 4:]))
    if not own or chosen[0].kind not in _STATED:
        return StatedPoses(trajectory)
    stated = _checked(np.reshape(matrices, (-1, 6, 6)), table.path, numbers, "message")
    return StatedPoses(
        trajectory, stated, frozenset({"translation_first", "radians"}), "split_global"
    )
