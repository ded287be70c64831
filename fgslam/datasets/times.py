"""What files say of time: tables of numbers, time stamps of images, poses and pairs by time.

Errors name the file, the line and the remedy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, nearest_rows
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_lines
from fgslam.core.geometry import pose, rotation_from_quaternion
from fgslam.core.sides import without_side
from fgslam.core.types import Trajectory
from fgslam.datasets.layouts import (
    NUMBERED,
    CameraFiles,
    counts_by_one,
    natural,
    numbers_in,
    time_parts,
)
from fgslam.datasets.ledger import PAIRING, TIMES, Entry

NANOSECONDS = 1e-9

# --------------------------------------------------------------------------------------------
# Tables of numbers


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Numbers of a text file.

    Attributes:
        path: the file, or what messages call the source.
        values: (n, columns).
        lines: (n,) the line that each row came from, from 1.
        names: of the columns.
    """

    path: Path
    values: FloatArray
    lines: IntArray
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)


def read_table(
    path: Path,
    columns: Sequence[str | None],
    delimiter: str | None = None,
    error: type[DatasetError] = DatasetError,
    lines: Sequence[tuple[int, str]] | None = None,
) -> Table:
    """The numbers of every line, as many as ``columns``; further columns are ignored.

    Args:
        path: the file.
        columns: names of the columns, for the messages; None for one that is ignored.
        delimiter: what separates them; None for white space.
        error: class of the errors to raise.
        lines: numbers and texts of the lines; None for all of the file.

    Raises:
        DatasetError: (or ``error``) the file is unreadable, or a line has too few columns, a word
            that is no number, or a number that is not finite.
    """
    used = [(k, name) for k, name in enumerate(columns) if name is not None]
    rows, numbers = [], []
    for line, text in read_lines(path, error) if lines is None else lines:
        words = text.split(delimiter)
        if len(words) < len(columns):
            raise error(
                f"{path}, line {line}: {len(words)} columns, expected {len(columns)} "
                f"({', '.join(name for _, name in used)}); complete or remove the line"
            )
        where = f"{path}, line {line}: "
        rows.append([finite_number(words[k], where + name, error) for k, name in used])
        numbers.append(line)
    values = np.array(rows, np.float64).reshape(-1, len(used))
    return Table(path, values, np.array(numbers, np.int64), tuple(name for _, name in used))


def finite_number(word: str, where: str, error: type[DatasetError] = DatasetError) -> float:
    """The number that a word is. Raises ``error``: it is none, or not finite."""
    try:
        value = float(word)
    except ValueError:
        raise error(f"{where} is {word.strip()!r}, not a number; correct the line") from None
    if not np.isfinite(value):
        raise error(f"{where} is {word.strip()}, not finite; correct or remove the line")
    return value


def require_increasing(
    table: Table, stamps: FloatArray, error: type[DatasetError] = DatasetError
) -> None:
    """Raises ``error``, naming the line, unless the time stamps (n,) increase strictly."""
    bad = np.flatnonzero(np.diff(stamps) <= 0.0)
    if len(bad):
        k = int(bad[0])
        raise error(
            f"{table.path}, line {table.lines[k + 1]}: time {stamps[k + 1]:.6f} s does not come "
            f"after {stamps[k]:.6f} s of line {table.lines[k]}; put the lines in time order"
        )


# --------------------------------------------------------------------------------------------
# Trajectories


TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_QUATERNION_TOLERANCE = 0.01


def read_tum(path: Path) -> Trajectory:
    """Poses of a TUM file, ``t x y z qx qy qz qw``.

    Raises:
        DatasetError: a line is malformed, times do not increase, or a quaternion is no rotation.
    """
    lines = [(line, text.replace(",", " ")) for line, text in read_lines(path)]
    if lines and re.match(r"\s*[A-Za-z]", lines[0][1]):
        lines = lines[1:]  # names of columns
    if lines and len(lines[0][1].split()) == 12:
        raise DatasetError(
            f"{path}: its rows of 12 numbers are poses without times, as KITTI's; write "
            f"{' '.join(TUM_COLUMNS)}"
        )
    table = read_table(path, TUM_COLUMNS, lines=lines)
    require_increasing(table, table.values[:, 0])
    poses = poses_of(table, table.values[:, 1:4], table.values[:, 4:8])
    return Trajectory(table.values[:, 0], poses)


_FARTHEST_M = 1e8  # eight times the width of the Earth: beyond the coordinates of any map


def poses_of(
    table: Table,
    positions: FloatArray,
    quaternions: FloatArray,
    error: type[DatasetError] = DatasetError,
) -> FloatArray:
    """Poses (n, 4, 4) of positions (n, 3) and unit quaternions (n, 4) (x, y, z, w) of a table."""
    norms, farthest = np.linalg.norm(quaternions, axis=1), np.abs(positions).max(axis=1)
    absurd = np.flatnonzero(farthest > _FARTHEST_M)
    if len(absurd):
        k = int(absurd[0])
        raise error(
            f"{table.path}, line {table.lines[k]}: a position of {farthest[k]:.3g} m is none on "
            "Earth; give metres"
        )
    bad = np.flatnonzero(np.abs(norms - 1.0) > _QUATERNION_TOLERANCE)
    if len(bad):
        k = int(bad[0])
        raise error(
            f"{table.path}, line {table.lines[k]}: the quaternion has length {norms[k]:.3f}, not 1"
            f"; check the order of the columns ({' '.join(TUM_COLUMNS)})"
        )
    return pose(rotation_from_quaternion(quaternions), positions)


def rows_at(stamps: FloatArray, at: FloatArray, tolerance: float) -> IntArray:
    """Row of the stamps (n,) within ``tolerance`` seconds of each of ``at`` (m,), or -1."""
    nearest = nearest_rows(stamps, at)
    return np.asarray(np.where(np.abs(stamps[nearest] - at) <= tolerance, nearest, -1))


def covered(stamps: FloatArray, at: FloatArray, max_gap: float, tolerance: float) -> BoolArray:
    """Which times ``at`` (m,) the increasing stamps (n,) cover.

    A time is covered when it lies between two stamps at most ``max_gap`` seconds apart, or within
    ``tolerance`` seconds of one stamp.
    """
    if len(stamps) == 0:
        return np.zeros(len(at), np.bool_)
    after = np.clip(np.searchsorted(stamps, at), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    inside = (stamps[before] <= at) & (at <= stamps[after])
    bridged = inside & (stamps[after] - stamps[before] <= max_gap)
    nearest = np.minimum(np.abs(at - stamps[before]), np.abs(at - stamps[after]))
    return np.asarray(bridged | (nearest <= tolerance))


def interpolate_poses(trajectory: Trajectory, at: FloatArray) -> FloatArray:
    """Poses (m, 4, 4) at times (m,): positions linearly, rotations on the shortest arc.

    Times outside the trajectory get its first or last pose.
    """
    stamps = trajectory.timestamps
    if len(at) == 0:
        return np.empty((0, 4, 4))
    clipped = np.clip(at, stamps[0], stamps[-1])
    rows = nearest_rows(stamps, clipped)
    out = trajectory.poses[rows]
    between = stamps[rows] != clipped
    if between.any():
        from scipy.spatial.transform import Rotation, Slerp  # slow to load

        rotations = Slerp(stamps, Rotation.from_matrix(trajectory.poses[:, :3, :3]))
        out[between, :3, :3] = rotations(clipped[between]).as_matrix()
        for axis in range(3):
            out[between, axis, 3] = np.interp(
                clipped[between], stamps, trajectory.poses[:, axis, 3]
            )
    return out


_SAME_TIME_S = 1e-3  # of a pose and a frame


def trajectory_at_frames(
    trajectory: Trajectory, frames: FloatArray, max_gap: float = 0.1
) -> Trajectory:
    """The trajectory at those of the frames' stamps (n,) that it covers (see :func:`covered`)."""
    known = covered(trajectory.timestamps, frames, max_gap, _SAME_TIME_S)
    poses = interpolate_poses(trajectory, frames[known])
    return replace(trajectory, timestamps=frames[known], poses=poses)


# --------------------------------------------------------------------------------------------
# Pairs of images by time


AnyStamps = TypeVar("AnyStamps", FloatArray, IntArray)
"""Stamps in seconds, or in whole nanoseconds, which are compared without rounding."""

TOLERANCE_S = 0.02
"""Largest difference in time of the images of one moment."""

_NAMED_SKEW_S = 1e-3  # what synchronised cameras differ by at most


def pair_stamps(
    reference: IntArray, others: Sequence[tuple[str, str, IntArray]], name: str, side: str = "right"
) -> tuple[IntArray, tuple[str, ...], Entry]:
    """Rows (n, 1 + others) of images that are each other's nearest in time, and notes.

    Args:
        reference: stamps of the right camera in nanoseconds, increasing.
        others: side, name and stamps of each other camera.
        name: of the right camera, in messages.
        side: of the right camera.

    Returns:
        The rows, those of the reference first; notes on images left without a partner and on how
        far pairs differ; and how they were found.

    Raises:
        DatasetError: no image is left that has a partner of each camera.
    """
    rows = np.arange(len(reference))[:, None]
    notes: list[str] = []
    entry = Entry(PAIRING, f"nearest in time, within {1e3 * TOLERANCE_S:g} ms", "stamps")
    for its_side, other, stamps in others:
        right = reference[rows[:, 0]]
        kept, partner, skew = _partners(right, stamps)
        if len(kept) < _MOST_OF_ALL * min(len(right), len(stamps)) / 2 and (
            (away := _clock_offset(right, stamps)) is not None
        ):
            kept, partner, skew = _partners(right, stamps - away)
            note = (
                f"the clock of {other} is {abs(NANOSECONDS * away):.6g} s "
                f"{'ahead of' if away > 0 else 'behind'} that of {name} throughout, and is taken so"
            )
            notes.append(note)
            entry = Entry(PAIRING, "by stamps less a constant offset", note, guessed=True)
        if len(kept) == 0:
            spans = [f"{NANOSECONDS * s[0]:.3f} to {NANOSECONDS * s[-1]:.3f} s"
                     for s in (right, stamps)]  # fmt: skip
            raise DatasetError(
                f"no image of {name} ({spans[0]}) has a partner in {other} ({spans[1]}) "
                f"within {1e3 * TOLERANCE_S:g} ms, the nearest differ by {1e3 * skew.min():.4g} "
                "ms, and no constant offset of their clocks makes them pairs; record both on one "
                "clock, or put the images of each moment into left/ and right/ under one name"
            )
        notes += [
            f"{n} {camera} images have no partner within {1e3 * TOLERANCE_S:g} ms and are left out"
            for camera, n in ((side, len(right) - len(kept)), (its_side, len(stamps) - len(kept)))
            if n
        ]
        if (worst := float(skew[kept].max())) > _NAMED_SKEW_S:
            notes.append(
                f"the images of a pair differ in time by {1e3 * float(np.median(skew[kept])):.3g} "
                f"ms in the median and {1e3 * worst:.3g} ms at most: cameras that are not "
                "synchronised measure wrong depths while they turn"
            )
        rows = np.column_stack([rows[kept], partner[kept]])
    return rows, tuple(notes), entry


def _partners(right: IntArray, stamps: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows of ``right`` that have a partner; of all the nearest row, and its distance, seconds."""
    partner = nearest_rows(stamps, right)
    mutual = nearest_rows(right, stamps)[partner] == np.arange(len(right))
    skew = NANOSECONDS * np.abs(stamps[partner] - right).astype(np.float64)
    return np.flatnonzero(mutual & (skew <= TOLERANCE_S + 0.5 * NANOSECONDS)), partner, skew


_MOST_OF_ALL = 0.9  # of the images that a constant offset of two clocks must make pairs
_FIRST = 5  # images at either end, one of which has its partner among those of the other camera


def _clock_offset(right: IntArray, stamps: IntArray) -> int | None:
    """Nanoseconds that nearly all of ``stamps`` are ahead of ``right``; None without one.

    Of a steady rate an offset by a frame fits nearly as well: the best must be the only one.
    """
    ends = ((right[:_FIRST], stamps[:_FIRST]), (right[-_FIRST:], stamps[-_FIRST:]))
    offsets = np.unique(np.concatenate([(b[:, None] - a).ravel() for a, b in ends]))
    found = [len(_partners(right, stamps - each)[0]) for each in offsets]
    best = offsets[np.array(found) == max(found)]
    if max(found) < max(2.0, _MOST_OF_ALL * min(len(right), len(stamps))):
        return None
    if np.ptp(best) > 2.0 * TOLERANCE_S / NANOSECONDS:
        return None
    apart = _partners(right, stamps - best[len(best) // 2])
    return int(np.median(stamps[apart[1][apart[0]]] - right[apart[0]]))


# --------------------------------------------------------------------------------------------
# Time stamps of images: a list next to them, or their own names, in whatever unit of time


LISTS = (
    *("times.txt", "timestamps.txt", "times.csv", "timestamps.csv", "data.csv"),
    "right_images.txt",
)
"""Names of lists of times, the first that is there counts."""

ASSUMED_FPS = 10.0
_UNITS = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_SLOWEST_S = 10.0  # between two images: what makes a unit plausible


class Stamps(NamedTuple):
    """Seconds (n,) of images in their order, notes, the lists they are from, where that is stated.

    What a reader takes from the lists counts to what identifies a recording.
    """

    seconds: FloatArray
    notes: tuple[str, ...]
    lists: tuple[Path, ...]
    entry: Entry


def even_stamps(places: IntArray, fps: float | None, lacking: str = "no list of times") -> Stamps:
    """Stamps of images by their places (n,) at a rate; None where it is unknown: 10 is assumed."""
    rate = fps or ASSUMED_FPS
    entry = Entry(TIMES, f"{rate:g} Hz", "--fps", "--fps")
    note = f"{lacking}: taken as {rate:g} frames a second (--fps states otherwise)"
    if fps is None:
        entry = Entry(TIMES, "even", "nothing states them", "--fps", guessed=True)
    return Stamps(places / rate, () if fps else (note,), (), entry)


def stamps_of(
    images: Sequence[Path],
    folders: Sequence[Path],
    fps: float | None,
    every: Sequence[Path] | None = None,
) -> Stamps:
    """Stamps from a list of times in one of the folders, from names that are times, or by the rate.

    Args:
        images: one file a frame.
        folders: where a list may be.
        fps: the rate at which they were taken; None where it is unknown: 10 is assumed.
        every: all images of that camera, which lists without names and rates count; None: these.

    Raises:
        DatasetError: the list is malformed, or lacks an image.
    """
    written = written_stamps(images, folders, every) if fps is None else None
    place = {path: k for k, path in enumerate(every or images)}
    return written or even_stamps(np.array([place[path] for path in images]), fps)


def written_stamps(
    images: Sequence[Path], folders: Sequence[Path], every: Sequence[Path] | None = None
) -> Stamps | None:
    """As :func:`stamps_of`, from a list or from names; None where neither states anything."""
    for path in (folder / name for folder in folders for name in LISTS):
        if path.is_file():
            entry = Entry(TIMES, "stamps", str(path), "--fps")
            read = in_seconds(_listed(path, images, every or images), str(path))
            return Stamps(*read, (path,), entry)
    names = [image.stem for image in images]
    by_date = _dates(names)
    entry = Entry(TIMES, "stamps", "names of the images", "--fps")
    if by_date is not None:
        return Stamps(by_date, ("times are the dates in the names of the images",), (), entry)
    parts = time_parts(names) if len(names) > 1 else None
    if parts is None:
        return None
    texts = [f"{whole}.{part}" for whole, part in zip(*parts, strict=True)]
    mend = "two names of a folder are one time: remove one"
    return Stamps(*in_seconds(texts, entry.source, mend), (), entry)


def time_unit(times: FloatArray, slowest_s: float = _SLOWEST_S) -> tuple[str, float]:
    """The largest unit in which the times (n,) follow each other as a sensor's do, in seconds.

    ``slowest_s`` is the longest time that is plausible between two of them.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    known = _UNITS.items()
    return next(
        ((name, unit) for name, unit in known if step * unit <= slowest_s), ("seconds", 1.0)
    )


def in_seconds(
    texts: Sequence[str],
    where: str,
    mend: str = "put the lines in time order and remove duplicates",
) -> tuple[FloatArray, tuple[str, ...]]:
    """Times in seconds by the unit that makes the rate of a camera, and a note where not seconds.

    Raises:
        DatasetError: times do not increase.
    """
    if any("e" in text.lower() for text in texts):
        values, first = np.array([float(text) for text in texts]), 0.0
    else:  # less the first's whole part: doubles cannot hold nanoseconds since 1970
        whole = [int(text.partition(".")[0]) for text in texts]
        parts = [float(f"0.{text.partition('.')[2] or 0}") for text in texts]
        first = float(whole[0])
        values = np.array([w - whole[0] for w in whole], np.float64) + parts
    steps = np.diff(values)
    if len(steps) and steps.min() <= 0.0:
        k = int(np.argmax(steps <= 0.0))
        raise DatasetError(
            f"{where}: the time of image {k + 2} does not come after that of image {k + 1}; {mend}"
        )
    unit, note = named_unit(values, where)
    return unit * (first + values), note


def named_unit(times: FloatArray, where: str) -> tuple[float, tuple[str, ...]]:
    """The unit of a camera's times (n,) in seconds, by their rate; a note where it is another."""
    name, unit = time_unit(times)
    return unit, () if name == "seconds" else (f"times of {where} are taken as {name}",)


# Lists


_STAMPS = {
    None: (r"\d+(\.\d+)?", "seconds and a file; correct the line"),
    ",": (r"\d+", "a stamp in whole nanoseconds and a file name; correct the line, or all stamps "
          "(seconds: times 1e9)"),
}  # fmt: skip
"""By what separates the columns of a list: its stamps, and what is expected."""


def listed_files(
    path: Path, folder: Path | None = None, delimiter: str | None = None
) -> tuple[IntArray, list[Path]]:
    """Increasing stamps (n,) in nanoseconds, and files in a folder, of a list of both.

    Args:
        path: the list: TUM's of seconds, or with commas EuRoC's of nanoseconds.
        folder: of the files; None: that of the list.
        delimiter: of the columns; None for white space.

    Raises:
        DatasetError: it is missing, empty or malformed, or stamps do not increase.
    """
    stamp, expected = _STAMPS[delimiter]
    lines = read_lines(path)
    if lines and not re.search(r"\d", lines[0][1].partition(delimiter or " ")[0]):
        lines = lines[1:]  # names of columns
    stamps: list[int] = []
    files: list[Path] = []
    for line, text in lines:
        words = (text if delimiter else text.replace(",", " ")).split(delimiter)
        time, name = (*map(str.strip, words), "", "")[:2]
        if not re.fullmatch(stamp, time) or not name:
            raise DatasetError(f"{path}, line {line}: expected {expected}")
        whole, _, part = time.partition(".")
        stamps.append(int(whole) if delimiter else int(whole + part[:9].ljust(9, "0")))
        if stamps[1:] and stamps[-1] <= stamps[-2]:
            raise DatasetError(
                f"{path}, line {line}: stamp {time} does not come after that before; put the "
                "lines in time order and remove duplicates"
            )
        files.append((folder or path.parent) / name)
    if not stamps:
        raise DatasetError(f"{path} lists no image; restore the file")
    return np.array(stamps, np.int64), files


_NUMBER = re.compile(r"\d+(\.\d*)?([eE][-+]?\d+)?")
_DATE = re.compile(r"^\d{4}-\d{2}-\d{2}[ T]\d{2}:\d{2}:\d{2}")


def _listed(path: Path, images: Sequence[Path], every: Sequence[Path]) -> list[str]:
    """Times of the images by a list: a time a line, or name or number and time in either order.

    A column that names all images is looked for in the first three; another one is the time.
    """
    lines = read_lines(path)
    if lines and _DATE.match(lines[0][1]):
        rows = []
        for number, text in lines:  # 2011-09-26 13:02:25.964389445: all digits are kept
            whole, _, part = text.strip().partition(".")
            try:
                moment = datetime.fromisoformat(whole.strip()).replace(tzinfo=UTC)
            except ValueError:
                text = f"{path}, line {number}: {text!r} is no time; correct it"
                raise DatasetError(text) from None
            rows.append([f"{int(moment.timestamp())}.{part or 0}"])
    else:
        rows = [[w for w in re.split(r"[,;\s]+", text) if w] for _, text in lines]
        if rows and not any(map(_NUMBER.fullmatch, rows[0])):
            rows, lines = rows[1:], lines[1:]  # names of columns
    if not rows or any(len(row) < 2 for row in rows):
        if len(rows) < len(every):
            raise DatasetError(
                f"{path} has {len(rows)} times for {len(every)} images; leave it out and say --fps"
            )
        for row, (number, _) in zip(rows, lines, strict=True):
            if not _NUMBER.fullmatch(row[0]):
                text = f"{path}, line {number}: {row[0]!r} is no time; correct the line"
                raise DatasetError(text)
        place = {image: k for k, image in enumerate(every)}
        return [rows[place[image]][0] for image in images]
    columns = range(min(3, *map(len, rows)))
    for names in columns:
        known = {_stem(row[names]): row for row in rows}
        keys = [image.stem if image.stem in known else _stem(image.stem) for image in images]
        if not all(key in known for key in keys):
            continue
        others = ([known[key][k] for key in keys] for k in columns if k != names)
        times = [texts for texts in others if all(map(_NUMBER.fullmatch, texts))]
        # One that counts the images is their number.
        timed = [texts for texts in times if not (
            all(map(str.isdecimal, texts)) and counts_by_one([int(t) for t in texts])
        )]  # fmt: skip
        if times:
            return (timed or times)[0]
    raise DatasetError(
        f"{path}: neither column names all images ({images[0].name} to {images[-1].name}); each "
        "line must be: name or number of the image, seconds"
    )


def _stem(word: str) -> str:
    """A file's name without folder and ending; of a number its value."""
    name = re.sub(r"\.(png|jpe?g|p[gnp]m|bmp|tiff?|webp)$", "", word.rpartition("/")[2], flags=re.I)
    return str(int(name)) if name.isdecimal() else name


# Names of files that are dates


_FASTEST_S = 2e-3
_DATE_IN_NAME = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?"
    r"(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)(?:([-_.,]?)(\d{1,9}))?(?!\d)"
)
_COUNTED = 10_000  # six digits below: the first hour after midnight, or a counter


def _dates(names: Sequence[str]) -> FloatArray | None:
    """Seconds (n,) since 1970 by dates in names, UTC; None where they are no camera's times.

    What follows the seconds is their fraction, unless it counts the images: by one, or with fewer
    than three digits and no point. Neither are six digits from 000000 on that count by one.
    """
    found = [match for name in names if (match := _DATE_IN_NAME.search(name))]
    if len({match.groups()[:6] for match in found}) == 1:  # the date of the drive; another follows?
        after = [_DATE_IN_NAME.search(match.string, match.end(6)) for match in found]
        second = [match for match in after if match]
        found = second if len(second) == len(names) else found
    if len(names) < 2 or len(found) < len(names):
        return None
    try:
        dates = (datetime(*map(int, match.groups()[:6])) for match in found)  # type: ignore[arg-type]
        whole = [date.replace(tzinfo=UTC).timestamp() for date in dates]
    except ValueError:  # no date
        return None
    written = [m[8] if m[8] and (m[7] in (".", ",") or len(m[8]) > 2) else "0" for m in found]
    counts = counts_by_one([int(match[8]) for match in found if match[8]])
    parts = [0.0 if counts else float(f"0.{digits}") for digits in written]
    clock = [match[4] + match[5] + match[6] for match in found]
    joined = all(digits in match[0] for digits, match in zip(clock, found, strict=True))
    counter = joined and not any(parts) and int(clock[-1]) < _COUNTED
    if counter and counts_by_one([int(digits) for digits in clock]):
        return None
    stamps = np.array(whole) + parts
    steps = np.diff(stamps)
    return stamps if steps.min() > 0.0 and np.median(steps) >= _FASTEST_S else None


# --------------------------------------------------------------------------------------------
# Pairs of image files by their names, by time, by order


Pairs: TypeAlias = tuple[tuple[tuple[Path, Path], ...], tuple[str, ...], Entry]
"""Files (right, left) of each moment, notes on what is left out, and how they were found."""


def pair_files(found: CameraFiles, at_once: bool = True) -> Pairs:
    """Pairs (right, left) in natural order, and notes on what is left out.

    Files are paired by their names without the side; where those do not match, by the times that
    the names are; else by their order. Not ``at_once`` are images of a board that stands still:
    times say nothing then.

    Raises:
        DatasetError: names do not match, and the cameras have different numbers of images, or names
            are times and no two are near.
    """
    if (named := _by_names(found, _KEYS)) is not None:
        return named
    right, left = (
        None if found.interleaved or (written := written_stamps(files, ())) is None
        else np.rint(written[0] / NANOSECONDS).astype(np.int64)
        for files in (found.right, found.left)
    )  # fmt: skip
    if right is None or left is None:
        named = _by_names(found, _MOMENTS)
    elif at_once:
        of_left, of_right = (f"{found.folder}, {side}" for side in found.sides)
        others = [(found.sides[0], of_left, left)]
        rows, notes, entry = pair_stamps(right, others, of_right, found.sides[1])
        note = f"{' and '.join(found.sides)} images are paired by the times that their names are"
        pairs = tuple((found.right[i], found.left[j]) for i, j in rows.tolist())
        return pairs, (note, *notes), entry
    return _by_order(found) if named is None else named


_Key: TypeAlias = Callable[[str], object]

_MOMENTS: tuple[_Key, ...] = (
    *(lambda stem, split=split: natural(Path(split.sub(r"\1\3", stem))) for split in NUMBERED),
)
_KEYS: tuple[_Key, ...] = (
    lambda stem: natural(Path(stem)),
    lambda stem: natural(Path(without_side(stem))),
    lambda stem: natural(Path(without_side(stem, camera_number=True))),
)
"""What two names of a pair have in common; the first that most of them have counts."""


def _by_names(found: CameraFiles, keys: Iterable[_Key]) -> Pairs | None:
    """By the first of the keys that most names have in common; None where none is."""
    for key in keys:
        right, left = ({key(path.stem): path for path in f} for f in (found.right, found.left))
        common = [name for name in right if name in left]
        unique = len(right) == len(found.right) and len(left) == len(found.left)
        if unique and len(common) >= max(1, min(len(right), len(left)) // 2):
            counts = (len(left) - len(common), len(right) - len(common))
            alone = reversed(list(zip(found.sides, counts, strict=True)))
            notes = tuple(
                f"{n} {camera} images have no partner of their name and are left out"
                for camera, n in alone
                if n
            )
            pairs = tuple((right[name], left[name]) for name in common)
            return pairs, notes, Entry(PAIRING, "by name", "names of the images")
    return None


def _by_order(found: CameraFiles) -> Pairs:
    if len(found.right) != len(found.left):
        raise DatasetError(
            f"{found.folder}: {len(found.left)} images of the left camera and {len(found.right)} "
            f"of the right one, and their names ({found.left[0].name}, {found.right[0].name}) do "
            "not match: which belong together is unknown; name both of a pair alike"
        )
    pairs = tuple(zip(found.right, found.left, strict=True))
    if all(numbers_in(right.stem) == numbers_in(left.stem) != [] for right, left in pairs):
        # frame000012 and depth000012 are of one moment.
        return pairs, (), Entry(PAIRING, "by number", "names of the images")
    both = " and ".join(found.sides)
    note = f"{both} images are paired by their order: their names do not match"
    return pairs, (note,), Entry(PAIRING, "by their order", note, guessed=True)
