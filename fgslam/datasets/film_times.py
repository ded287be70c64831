"""When frames of films are shown, and which belong together (docs/datasets/video.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.datasets.pairing import NANOSECONDS, pair_all
from fgslam.datasets.video_frames import VideoFrames

_UNEVEN = 0.1  # of the time of a frame: less is the rounding of files that count milliseconds

_SIDES = ("right", "third")  # of the films after the first one

_LASTING = 15  # frames over which films part, not only jitter: at most half of the film


@dataclass(frozen=True, slots=True)
class Moments:
    """What is shown when.

    Attributes:
        numbers: (n, films) of the frames of each film.
        times: (n,) seconds, from the first film's beginning on.
        notes: how that was found, and what was left out.
    """

    numbers: IntArray
    times: FloatArray
    notes: tuple[str, ...]


def moments_of(
    films: list[VideoFrames], rate: float, stated: bool, tolerance: float = 0.0
) -> Moments:
    """Frames of one film, or of several those of one number, or of one time where that is another.

    Args:
        films: one, or those of the left and of the right camera, and of a third one.
        rate: frames a second of the first.
        stated: that rate is the user's, in place of each film's own times.
        tolerance: largest time between frames of two films, seconds.

    Raises:
        DatasetError: no two frames are shown at one time.
    """
    own = [None if stated else film.stamps() for film in films]
    if len(films) == 1:
        return _by_number(films, own, rate)
    either = (film.even() if its is None else its for film, its in zip(films, own, strict=True))
    known = [times for times in either if times is not None]
    if stated or len(known) < len(films) or not any(_part(known[0], its) for its in known[1:]):
        how, moments = "number", _by_number(films, own, rate)
    else:
        how, moments = "time", _by_time(films, known, tolerance)
    count, all_ = ("two", "both") if len(films) == 2 else ("three", "all")
    how = f"frames of the {count} films are paired by their {how}: {all_} must begin at one time"
    differ = (note for film, side in zip(films[1:], _SIDES, strict=False)
              for note in _differences(films[0], film, side))  # fmt: skip
    return replace(moments, notes=(how, *differ, *moments.notes))


def _part(left: FloatArray, right: FloatArray) -> bool:
    """Whether frames of one number come to lie nearer to frames of another one, and stay there.

    Single frames may be late: by the time alone they would lose their partners.
    """
    count = min(len(left), len(right))
    if count < 2:
        return False
    apart = sliding_window_view(left[:count] - right[:count], min(_LASTING, count // 2))
    step = min(times[-1] / (len(times) - 1) for times in (left, right))
    return bool(np.abs(np.median(apart, axis=1)).max() > 0.5 * step)


def _differences(left: VideoFrames, right: VideoFrames, side: str) -> tuple[str, ...]:
    """What two films that should run together differ in."""
    notes = []
    if left.count != right.count:
        notes.append(f"the left film has {left.count} frames, the {side} one {right.count}")
    if abs(left.rate - right.rate) > 1e-3 * left.rate:
        notes.append(f"the left film has {left.rate:g} frames a second, the {side} {right.rate:g}")
    return tuple(notes)


def _by_time(films: list[VideoFrames], known: list[FloatArray], tolerance: float) -> Moments:
    """Frames of the films that are each other's nearest."""
    left, right, *third = (np.rint(each / NANOSECONDS).astype(np.int64) for each in known)
    sides = zip(("left", "third"), (films[0], *films[2:]), (left, *third), strict=False)
    others = [(side, film.name, stamps) for side, film, stamps in sides]
    rows, notes = pair_all(right, others, tolerance, films[1].name)
    numbers = rows[:, [1, 0, *range(2, len(films))]]
    return Moments(numbers, known[0][numbers[:, 0]], notes)


def _by_number(films: list[VideoFrames], own: list[FloatArray | None], rate: float) -> Moments:
    """Frames at the rate, or each at its time in the first film where these are uneven."""
    count = min(film.count for film in films)
    even = np.arange(count, dtype=np.int64) / rate
    numbers = np.repeat(np.arange(count, dtype=np.int64)[:, None], len(films), axis=1)
    shown = [times[:count] for times in own if times is not None]
    if count < 2 or len(shown) < len(films):
        return Moments(numbers, even, ())
    notes: tuple[str, ...] = ()
    apart = max((float(np.abs(shown[0] - its).max()) for its in shown[1:]), default=0.0)
    if apart > _UNEVEN / rate:
        notes = (f"frames of one number differ in time by up to {1e3 * apart:.0f} ms in the films",)
    if np.abs(shown[0] - even).max() <= _UNEVEN / rate:
        return Moments(numbers, even, notes)
    steps = 1e3 * np.diff(shown[0])
    note = f"frames are {steps.min():.0f} to {steps.max():.0f} ms apart: each has its own time"
    return Moments(numbers, shown[0], (note, *notes))
