"""Images of two cameras in folders with any names: which files they are, and which are pairs.

Needs no image library: layouts are recognised by it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from fgslam.core.errors import DatasetError
from fgslam.core.files import shown_in
from fgslam.core.sides import camera_pairs, differ_in_number, is_view, without_side
from fgslam.datasets.time_names import time_parts

if TYPE_CHECKING:
    from fgslam.core.arrays import IntArray

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm", ".bmp", ".tif", ".tiff", ".webp"),
)
_INSIDE = "data"  # where EuRoC and KITTI keep a camera's images


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """Image files of both cameras, each in natural order.

    Attributes:
        left, right: the files.
        folder: that of all.
        interleaved: both cameras' files lie in one folder, and their names say which is which.
        others: further pairs of folders, which are not taken.
    """

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    folder: Path
    interleaved: bool
    others: tuple[tuple[str, str], ...] = ()

    @property
    def numbered(self) -> bool:
        """Whether numbers tell the cameras, as in a calibration's file, and not sides."""
        left, right = (str(files[0].relative_to(self.folder)) for files in (self.left, self.right))
        if not self.interleaved:
            left, right = (name.partition("/")[0] for name in (left, right))
        return differ_in_number(left, right)


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Sorts names with numbers by their values, so that 10 comes after 9; words as they are."""
    words = re.split(r"(\d+)", path.name)
    return tuple((int(w), "") if w.isdecimal() else (-1, w) for w in words)


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder, in natural order; by time where all names are times."""
    files = (p for p in shown_in(folder) if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    found = sorted(files, key=natural)
    times = time_parts([path.stem for path in found])
    if times is None:
        return found
    # Digits behind the point sort as text: .98 comes after .1234567.
    return [path for _, _, path in sorted(zip(*times, found, strict=True))]


def one_camera(root: Path) -> Path | None:
    """The only folder with images, this one or one in it; None where there are none or more."""
    inside = [path for path in shown_in(root) if path.is_dir()]
    places = [root, *inside, *(path / _INSIDE for path in inside)]
    found = [path for path in places if path.is_dir() and images_in(path)]
    return found[0] if len(found) == 1 else None


def find_cameras(root: Path, files: Sequence[Path] | None = None) -> CameraFiles | None:
    """The files of a left and a right camera; None where there is no such pair.

    Two folders side by side (left and right, image_0 and image_1, cam0 and cam1), or one folder in
    which names differ in the side alone, or end in the camera's number (12_0 and 12_1), or have it
    behind the word image (image_0_12 and image_1_12).

    Args:
        root: the folder.
        files: of it, only these; None for all.
    """
    if files is None:
        folders = _two_folders(root)
        if folders is not None:
            used, others = folders
            left, right = (tuple(images_in(folder)) for folder in used)
            return CameraFiles(left, right, root, interleaved=False, others=others)
        files = [path for path in images_in(root) if is_view(path.stem)]
    named = {path.name: path for path in files}
    pairs = camera_pairs(named, any_number=False)
    if not pairs:
        return next(filter(None, (_by_number(files, root, split) for split in _NUMBERED)), None)
    left, right = (tuple(sorted({named[p[k]] for p in pairs}, key=natural)) for k in (0, 1))
    return CameraFiles(left, right, root, interleaved=True)


def _by_number(files: Sequence[Path], root: Path, split: re.Pattern[str]) -> CameraFiles | None:
    """Both cameras by a number in the names, where that is one of two for all of them."""
    ends = {path: int(match[2]) for path in files if (match := split.match(path.stem))}
    numbers = sorted(set(ends.values()))
    if len(ends) < len(files) or len(files) < _FEWEST_NUMBERED or len(numbers) != 2:
        return None
    if numbers[1] != numbers[0] + 1 or numbers[0] not in (0, 1):
        return None
    left, right = (tuple(path for path in files if ends[path] == n) for n in numbers)
    moments = [{_moment(path.stem, split) for path in paths} for paths in (left, right)]
    if len(moments[0] & moments[1]) * 2 < len(left):
        return None
    return CameraFiles(left, right, root, interleaved=True)


_NUMBERED = (
    re.compile(r"(.*\d)[_-](\d+)()$"),
    re.compile(r"(.*?(?:image|img)[_-]?)(\d+)([_-].*\d.*)$", re.IGNORECASE),
)
"""A name with the camera's number at its end, or in it: what is before and behind."""

_FEWEST_NUMBERED = 4  # files: of two pairs


def _moment(stem: str, split: re.Pattern[str]) -> str:
    """A name without the camera's number."""
    return split.sub(r"\1\3", stem)


def _two_folders(root: Path) -> tuple[tuple[Path, Path], tuple[tuple[str, str], ...]] | None:
    """Folders of images whose names differ in the side, and further pairs of them."""
    with_images = {}
    for folder in (path for path in shown_in(root) if path.is_dir() and is_view(path.name)):
        for place in (folder, folder / _INSIDE):
            if place.is_dir() and (found := images_in(place)):
                if not _of_both_cameras(found):
                    with_images[folder.name] = place
                break
    pairs = camera_pairs(with_images) or _with_a_second(with_images)
    if not pairs:
        return None
    words = [pair for pair in pairs if not re.search(r"\d", pair[0])]
    left, right = (words or list(pairs))[0]
    others = tuple(pair for pair in pairs if not {left, right} & set(pair))
    return (with_images[left], with_images[right]), others


def _with_a_second(names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Names of a first and a second camera, of which the first one has no number: rgb and rgb2."""
    known = set(names)
    return tuple((name, f"{name}2") for name in sorted(known) if f"{name}2" in known)


def _of_both_cameras(files: Sequence[Path]) -> bool:
    """Whether most files of a folder have a partner of the other side in it."""
    pairs = camera_pairs([path.name for path in files], any_number=False)
    return len({name for pair in pairs for name in pair}) * 2 > len(files)


Pairs: TypeAlias = tuple[tuple[tuple[Path, Path], ...], tuple[str, ...]]
"""Files (right, left) of each moment, and notes on what is left out."""

TOLERANCE_MS = 20.0


def pair_files(found: CameraFiles, tolerance_ms: float | None = TOLERANCE_MS) -> Pairs:
    """Pairs (right, left) in natural order, and notes on what is left out.

    Files are paired by their names without the side; where those do not match, by the times that
    the names are, at most ``tolerance_ms`` apart; else by their order. None as tolerance: images
    that were not taken at once, as of a board that stands still; times say nothing then.

    Raises:
        DatasetError: names do not match, and the cameras have different numbers of images, or names
            are times and no two are near.
    """
    named = _by_names(found, _KEYS)
    if named is not None:
        return named
    times = None if found.interleaved else _times(found)
    if times is None:
        named = _by_names(found, _MOMENTS)
    elif tolerance_ms is not None:
        named = _by_time(found, times, tolerance_ms)
    return _by_order(found) if named is None else named


def _by_names(found: CameraFiles, keys: Sequence[Callable[[str], object]]) -> Pairs | None:
    """By the first of the keys that most names have in common; None where none is."""
    for key in keys:
        right, left = ({key(path.stem): path for path in f} for f in (found.right, found.left))
        common = [name for name in right if name in left]
        unique = len(right) == len(found.right) and len(left) == len(found.left)
        if unique and len(common) >= max(1, min(len(right), len(left)) // 2):
            alone = (("right", len(right) - len(common)), ("left", len(left) - len(common)))
            notes = tuple(
                f"{n} {camera} images have no partner of their name and are left out"
                for camera, n in alone
                if n
            )
            return tuple((right[name], left[name]) for name in common), notes
    return None


def _by_order(found: CameraFiles, why: str = "their names do not match") -> Pairs:
    if len(found.right) != len(found.left):
        raise DatasetError(
            f"{found.folder}: {len(found.left)} images of the left camera and {len(found.right)} "
            f"of the right one, and their names ({found.left[0].name}, {found.right[0].name}) do "
            "not match: which belong together cannot be told; name both of a pair alike"
        )
    note = f"left and right images are paired by their order: {why}"
    numbers = [[_numbers(path.stem) for path in files] for files in (found.right, found.left)]
    alike = numbers[0] == numbers[1] and all(numbers[0])
    return tuple(zip(found.right, found.left, strict=True)), () if alike else (note,)


def _numbers(stem: str) -> list[int]:
    """The numbers of a name: frame000012 and depth000012 are of one moment."""
    return [int(n) for n in re.findall(r"\d+", stem)]


def _times(found: CameraFiles) -> tuple[IntArray, IntArray] | None:
    """Nanoseconds (n,), (m,) of right and left files whose names are times; None otherwise."""
    import numpy as np  # layouts are recognised without arrays

    from fgslam.datasets.pairing import NANOSECONDS
    from fgslam.datasets.stamps import written_stamps

    written = [written_stamps(files, ()) for files in (found.right, found.left)]
    right, left = (
        None if each is None else np.rint(each[0] / NANOSECONDS).astype(np.int64)
        for each in written
    )
    return None if right is None or left is None else (right, left)


def _by_time(found: CameraFiles, times: tuple[IntArray, IntArray], tolerance_ms: float) -> Pairs:
    """The nearest in time; by order where each camera has a clock of its own that goes alike."""
    import numpy as np

    from fgslam.datasets.pairing import NANOSECONDS, pair_stamps

    right, left = times
    names = (f"{found.folder}, right", f"{found.folder}, left")
    try:
        (rows, partners), notes = pair_stamps(right, left, 1e-3 * tolerance_ms, names)
    except DatasetError:
        apart = NANOSECONDS * (left - right) if len(left) == len(right) else np.array([np.inf])
        if not np.ptp(apart) <= 1e-3 * tolerance_ms:
            raise
        away = abs(float(np.median(apart)))
        return _by_order(found, f"the times that their names are lie {away:.6g} s apart throughout")
    chosen = zip(rows.tolist(), partners.tolist(), strict=True)
    note = "left and right images are paired by the times that their names are"
    return tuple((found.right[i], found.left[j]) for i, j in chosen), (note, *notes)


_MOMENTS: tuple[Callable[[str], object], ...] = (
    *(lambda stem, split=split: natural(Path(_moment(stem, split))) for split in _NUMBERED),
)
_KEYS: tuple[Callable[[str], object], ...] = (
    lambda stem: natural(Path(stem)),
    lambda stem: natural(Path(without_side(stem))),
    lambda stem: natural(Path(without_side(stem, camera_number=True))),
)
"""What two names of a pair have in common; the first that most of them have counts."""
