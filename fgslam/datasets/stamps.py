"""Time stamps of images: a list beside them, or their own names, in whatever unit of time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_lines
from fgslam.datasets.time_names import counts_by_one, time_parts

LISTS = (
    *("times.txt", "timestamps.txt", "times.csv", "timestamps.csv", "data.csv"),
    "right_images.txt",
)
"""Names of lists of times, the first that is there counts."""

_ASSUMED_FPS = 10.0
_UNITS = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_SLOWEST_S = 10.0  # between two images: what makes a unit plausible
SLOWEST_MOTION_S = 1.0
"""The same between two samples of odometry."""
_FASTEST_S = 2e-3
_DATE_IN_NAME = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?"
    r"(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)(?:([-_.,]?)(\d{1,9}))?(?!\d)"
)
_COUNTED = 10_000  # six digits below: the first hour after midnight, or a counter
_DATE = re.compile(r"^\d{4}-\d{2}-\d{2}[ T]\d{2}:\d{2}:\d{2}")


def stamps_of(
    images: Sequence[Path],
    folders: Sequence[Path],
    fps: float | None,
    every: Sequence[Path] | None = None,
) -> tuple[FloatArray, tuple[str, ...], tuple[Path, ...]]:
    """Seconds (n,) of images in their order, notes, and the list they were read from, if any.

    Taken from a list of times in one of the folders, from names that are times, or by the rate.

    Args:
        images: one file a frame.
        folders: where a list may be.
        fps: the rate at which they were taken; None where nobody knows: 10 is assumed.
        every: all images of that camera, which lists without names and rates count; None: these.

    Raises:
        DatasetError: the list is malformed, or lacks an image.
    """
    written = written_stamps(images, folders, every) if fps is None else None
    if written is not None:
        return written
    rate = fps or _ASSUMED_FPS
    note = (
        ()
        if fps
        else (f"no list of times: taken as {rate:g} frames a second (--fps says otherwise)",)
    )
    return np.array(_places(images, every)) / rate, note, ()


def _places(images: Sequence[Path], every: Sequence[Path] | None) -> list[int]:
    """Of each image its place among all of the camera."""
    if every is None:
        return list(range(len(images)))
    known = {path: k for k, path in enumerate(every)}
    return [known[path] for path in images]


def written_stamps(
    images: Sequence[Path], folders: Sequence[Path], every: Sequence[Path] | None = None
) -> tuple[FloatArray, tuple[str, ...], tuple[Path, ...]] | None:
    """As :func:`stamps_of`, from a list or from names; None where neither says anything."""
    for folder in folders:
        for path in (folder / name for name in LISTS):
            if path.is_file():
                found, unit = _in_seconds(_listed(path, images, every), str(path))
                return found, unit, (path,)
    by_date = _dates([image.stem for image in images])
    if by_date is not None:
        return by_date, ("times are the dates in the names of the images",), ()
    named = time_parts([image.stem for image in images]) if len(images) > 1 else None
    if named is not None:
        texts = [f"{whole}.{part}" for whole, part in zip(*named, strict=True)]
        mend = "two names of a folder are one time: remove one"
        found, unit = _in_seconds(_numbers(texts), "names of the images", mend)
        return found, unit, ()
    return None


def _dates(names: Sequence[str]) -> FloatArray | None:
    """Seconds (n,) since 1970 by dates in names, UTC; None where they say no camera's times.

    What follows the seconds is their fraction, unless it counts the images: by one, or with fewer
    than three digits and no point. Neither are six digits from 000000 on that count by one.
    """
    found = _dates_in(names)
    if len(names) < 2 or len(found) < len(names):
        return None
    try:
        whole = [_seconds(*map(int, match.groups()[:6])) for match in found]
    except ValueError:  # no date
        return None
    clock = [int(match[4] + match[5] + match[6]) for match in found]
    joined = all(match[4] + match[5] + match[6] in match[0] for match in found)
    parts = _fractions(found)
    if joined and not any(parts) and clock[-1] < _COUNTED and counts_by_one(clock):
        return None
    stamps = np.array(whole) + parts
    steps = np.diff(stamps)
    return stamps if steps.min() > 0.0 and np.median(steps) >= _FASTEST_S else None


def _dates_in(names: Sequence[str]) -> list[re.Match[str]]:
    """The first date in each name; the second where that is the drive's, the same in all."""
    found = [match for name in names if (match := _DATE_IN_NAME.search(name))]
    if len({match.groups()[:6] for match in found}) > 1:
        return found
    after = [_DATE_IN_NAME.search(match.string, match.end(6)) for match in found]
    second = [match for match in after if match]
    return second if len(second) == len(names) else found


def _fractions(found: Sequence[re.Match[str]]) -> list[float]:
    """Of a second, by what follows it in each name; 0 where that counts the images."""
    if counts_by_one([int(match[8]) for match in found if match[8]]):
        return [0.0] * len(found)
    written = [
        match[8] if match[8] and (match[7] in (".", ",") or len(match[8]) > 2) else ""
        for match in found
    ]
    return [float(f"0.{digits or 0}") for digits in written]


def _seconds(year: int, month: int, day: int, hour: int, minute: int, second: int) -> float:
    return datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()


def _numbers(texts: Sequence[str]) -> tuple[FloatArray, float]:
    """The numbers less the first's whole part, which doubles could not hold, and that part."""
    if any("e" in text.lower() for text in texts):
        return np.array([float(text) for text in texts]), 0.0
    whole = [int(text.partition(".")[0]) for text in texts]
    parts = [float(f"0.{text.partition('.')[2] or 0}") for text in texts]
    return np.array([w - whole[0] for w in whole], np.float64) + parts, float(whole[0])


def _in_seconds(
    numbers: tuple[FloatArray, float],
    where: str,
    mend: str = "put the lines in time order and remove duplicates",
) -> tuple[FloatArray, tuple[str, ...]]:
    """Times in seconds by the unit that makes the rate of a camera, and a note where not seconds.

    Raises:
        DatasetError: times do not increase.
    """
    values, first = numbers
    steps = np.diff(values)
    if len(steps) and steps.min() <= 0.0:
        k = int(np.argmax(steps <= 0.0))
        raise DatasetError(
            f"{where}: the time of image {k + 2} does not come after that of image {k + 1}; {mend}"
        )
    name, unit = time_unit(values)
    note = () if name == "seconds" else (f"times of {where} are taken as {name}",)
    return unit * (first + values), note


def time_unit(times: FloatArray, slowest_s: float = _SLOWEST_S) -> tuple[str, float]:
    """The largest unit in which the times (n,) follow each other as a sensor's do, in seconds.

    ``slowest_s`` is the longest time that is plausible between two of them.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    known = _UNITS.items()
    return next(
        ((name, unit) for name, unit in known if step * unit <= slowest_s), ("seconds", 1.0)
    )


def _listed(
    path: Path, images: Sequence[Path], every: Sequence[Path] | None
) -> tuple[FloatArray, float]:
    """Times of the images by a list: a time a line, or name or number and time in either order."""
    lines = read_lines(path)
    if lines and _DATE.match(lines[0][1]):
        rows = [[_seconds_of_date(path, number, text)] for number, text in lines]
    else:
        rows = [[w for w in re.split(r"[,;\s]+", text) if w] for _, text in lines]
        if rows and not any(_is_number(word) for word in rows[0]):
            rows, lines = rows[1:], lines[1:]  # names of columns
    if rows and all(len(row) >= 2 for row in rows):
        return _by_name(path, rows, images)
    count = len(every or images)
    if len(rows) < count:
        raise DatasetError(
            f"{path} has {len(rows)} times for {count} images; restore the list, or leave it "
            "out and say --fps"
        )
    for row, (number, _) in zip(rows, lines, strict=True):
        _require_number(path, number, row[0])
    return _numbers([rows[k][0] for k in _places(images, every)])


def _by_name(
    path: Path, rows: Sequence[Sequence[str]], images: Sequence[Path]
) -> tuple[FloatArray, float]:
    """By the column that names the images, one of the first three; another one is the time."""
    columns = range(min(3, *(len(row) for row in rows)))
    for names in columns:
        known = {_stem(row[names]): row for row in rows}
        keys = [image.stem if image.stem in known else _stem(image.stem) for image in images]
        if all(key in known for key in keys):
            others = (k for k in columns if k != names)
            columns_of_times = ([known[key][k] for key in keys] for k in others)
            times = [texts for texts in columns_of_times if all(map(_is_number, texts))]
            if times:
                return _numbers(next((t for t in times if not _counts(t)), times[0]))
    raise DatasetError(
        f"{path}: neither column names all images ({images[0].name} to {images[-1].name}); each "
        "line must be: name or number of the image, seconds"
    )


def _counts(texts: Sequence[str]) -> bool:
    """Whether they number the images in their order."""
    return all(text.isdecimal() for text in texts) and counts_by_one([int(t) for t in texts])


def _stem(word: str) -> str:
    """A file's name without folder and ending; of a number its value."""
    name = re.sub(r"\.(png|jpe?g|p[gnp]m|bmp|tiff?|webp)$", "", word.rpartition("/")[2], flags=re.I)
    return str(int(name)) if name.isdecimal() else name


def _is_number(word: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?([eE][-+]?\d+)?", word) is not None


def _require_number(path: Path, line: int, word: str) -> None:
    if not _is_number(word):
        raise DatasetError(f"{path}, line {line}: {word!r} is no time; correct the line")


def _seconds_of_date(path: Path, line: int, text: str) -> str:
    """``2011-09-26 13:02:25.964389445`` in seconds since 1970, as text with all its digits."""
    whole, _, part = text.strip().partition(".")
    try:
        moment = datetime.fromisoformat(whole.strip()).replace(tzinfo=UTC)
    except ValueError:
        raise DatasetError(f"{path}, line {line}: {text!r} is no time; correct it") from None
    return f"{int(moment.timestamp())}.{part or 0}"
