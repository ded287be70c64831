"""Watches the cameras of a rig: one that delivers old images, swapped, darker or knocked ones.

Each frame's images are compared with each other and with those of the frame before, whatever the
front-end makes of them. docs/derivations/camera_faults.md.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.core.quantiles import middle
from fgslam.core.rig_correction import IMPLAUSIBLE_PX
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.image_lag import (
    Followed,
    Lag,
    LagModel,
    LineRows,
    Shrunk,
    followed,
    spread_of,
)
from fgslam.frontend.turned_cameras import TurnWatch

_WIDE_PX = 400  # wider images are made smaller
_SURE = 5.0  # deviations: by chance once in three million frames
_WINDOW = 5  # frames that are judged together where one alone does not tell
_ALIKE = 0.25  # frames of lag: nearer to none than this, the other direction need not be asked
_KNOWN = 0.1  # nor where it is known so well
_STOP = 2.0 ** (1.0 / 3.0)
"""Ratio of grey values: a third of a stop, the step in which exposures are set. Two cameras of one
rig that differ by it do not have the same exposure."""
_DARKEST = 8.0  # grey value below which a ratio is noise
_FEWEST = 20  # points


@dataclass(slots=True)
class _Pair:
    """What is kept of the reference and one other camera.

    ``rows[0]``: the last frames' points by the reference's own motion, which tell a late other
    camera; ``rows[1]``: by the other's, which tell a late reference.
    """

    model: LagModel
    rows: Kept[tuple[list[LineRows], list[LineRows]]]
    ratios: Kept[list[float]]
    unequal: Kept[int] = 0
    swapped: Kept[bool] = False


class CameraWatch:
    """Says of each frame whether its images can be used."""

    _pairs: Kept[list[_Pair]]
    _turns: Kept[TurnWatch]
    _late: Kept[list[bool]]
    _before: Kept[Sequence[Image]]
    _sums: Kept[list[int]]
    _frames: Kept[int]

    def __init__(self, rig: CameraRig) -> None:
        """Nothing seen yet."""
        self._rig = rig
        self._factor = max(1, math.ceil(rig.width / _WIDE_PX))
        self._spread = spread_of(self._factor)
        self._pairs = [_Pair(LagModel(rig, c), ([], []), []) for c in range(1, rig.cameras)]
        self._turns = TurnWatch(rig, self._spread)
        self._late = [False] * rig.cameras
        self._before = []
        self._sums = [-1] * rig.cameras
        self._frames = 0

    def look(self, images: tuple[Image, ...], number: int | None = None) -> str:
        """Takes in a frame; what is wrong with its images, in words; empty where nothing is.

        ``number``: of the frame, as remarks give it; None counts the frames taken in.
        """
        now = Shrunk(images, self._factor)
        repeated = self._repeated(images)
        swapped = ""
        points = now.corners()
        across = [followed(now.images[0], other, points) for other in now.images[1:]]
        shown = np.logical_or.reduce([kept for _, kept in across])
        moved: Followed | None = None
        seen: list[LineRows] = []
        for camera, (pair, (found, kept)) in enumerate(zip(self._pairs, across, strict=True), 1):
            here, there = points[kept], found[kept]
            self._order(pair, self._factor * (there - here)[:, camera - 1])
            if pair.swapped and not swapped:
                swapped = (
                    f"the images of the right and the {CAMERA_NAMES[camera]} camera are swapped"
                )
            self._weigh(pair, now.grey[0], now.grey[camera], here, there)
            if repeated or swapped:
                continue
            if self._before:
                moved = moved or _followed_of(now.images[0], self._before[0], points, shown)
                since = moved[0][kept], moved[1][kept]
                seen.append(self._judge(camera, now, (here, there), since))
            else:
                seen.append(self._still(pair, here, there))
        fault = repeated or swapped or self._old()
        if not fault:
            self._turns.take(self._frames if number is None else number, seen)
        self._before, self._frames = now.images, self._frames + 1
        return fault

    @property
    def knocked(self) -> bool:
        """Whether remarks report that a camera was turned during the drive."""
        return bool(self._turns.remarks())

    def remarks(self) -> tuple[str, ...]:
        """What is to be said of images that are used all the same."""
        out = list(self._turns.remarks())
        for camera, pair in enumerate(self._pairs, 1):
            if pair.unequal:
                out.append(
                    f"the {CAMERA_NAMES[camera]} images were darker or brighter than the right "
                    f"ones by more than a third of a stop in {pair.unequal} of {self._frames} "
                    "frames; give all cameras one exposure time and gain"
                )
        return tuple(out)

    # ----------------------------------------------------------------------------------------

    def _repeated(self, images: tuple[Image, ...]) -> str:
        """That one camera's image is the last one's to the bit, while another's is not."""
        before = self._sums
        self._sums = [zlib.crc32(image.tobytes()) for image in images]
        same = [a == b for a, b in zip(before, self._sums, strict=True)]
        if not any(same) or all(same):
            return ""
        return f"{_named(same)} the image of the frame before once more"

    def _order(self, pair: _Pair, disparity: FloatArray) -> None:
        """Whether disparities (n,) have the wrong sign, beyond what a calibration explains."""
        if len(disparity) < _FEWEST:
            return
        centre = middle(disparity)
        spread = 1.4826 * middle(np.abs(disparity - centre))
        allowed = _SURE * 1.2533 * spread / math.sqrt(len(disparity))  # 1.25: of a median
        if abs(centre) > allowed + IMPLAUSIBLE_PX:
            pair.swapped = centre < 0.0

    def _weigh(
        self, pair: _Pair, right: Image, other: Image, here: FloatArray, there: FloatArray
    ) -> None:
        """Compares the grey values of the same points (n, 2); a few frames tell."""
        a, b = _grey(right, here), _grey(other, there)
        bright = np.minimum(a, b) >= _DARKEST
        if bright.sum() >= _FEWEST:
            ratio = middle(np.log(b[bright] / a[bright]))
            pair.ratios = [*pair.ratios, ratio][-_WINDOW:]
        settled = len(pair.ratios) == _WINDOW
        pair.unequal += settled and abs(middle(np.array(pair.ratios))) > math.log(_STOP)

    def _judge(
        self, camera: int, now: Shrunk, places: tuple[FloatArray, FloatArray], moved: Followed
    ) -> LineRows:
        """Judges whether the other camera, or the reference, shows an earlier moment.

        Of points in the reference and the other image; and where the reference saw them before.
        Gives the points by the reference's motion.
        """
        pair, (here, there) = self._pairs[camera - 1], places
        offset = (there - here)[:, pair.model.across]
        rows = self._shifted(moved, here, offset, there, pair)
        newest = self._take(pair, camera, 0, rows)
        sure = newest.sigma < _KNOWN and abs(newest.frames) < _ALIKE
        if not sure or any(self._late):
            moved = followed(now.images[camera], self._before[camera], there)
            of_other = self._shifted(moved, there, -offset, there, pair)
            self._take(pair, 0, 1, of_other)
        else:
            pair.rows[1].clear()
        return rows

    def _still(self, pair: _Pair, here: FloatArray, there: FloatArray) -> LineRows:
        """Points (n, 2) of a first frame, as if at rest: how far they moved is not known."""
        every = here, np.ones(len(here), np.bool_)
        offset = (there - here)[:, pair.model.across]
        return self._shifted(every, here, offset, there, pair)

    def _shifted(
        self,
        moved: Followed,
        points: FloatArray,
        offset: FloatArray,
        place: FloatArray,
        pair: _Pair,
    ) -> LineRows:
        """Offsets of the points that one camera's last image shows, too, and their shift since."""
        then, kept = moved
        shift = (then - points)[:, pair.model.across]
        size = float(self._factor)
        return LineRows(size * offset[kept], size * shift[kept], size * place[kept])

    def _take(self, pair: _Pair, suspect: int, way: int, rows: LineRows) -> Lag:
        """Books a frame's points; alone or with those before they may find the suspect late."""
        newest = pair.model.lag(self._signed(rows, way), self._spread)
        late, window = newest.late, pair.rows[way]
        if math.isnan(late):
            return newest
        window.append(rows)
        del window[:-_WINDOW]
        if not abs(late) > _SURE and len(window) > 1:
            together = LineRows.none()
            for one in window:
                together = together.join(one)
            late = pair.model.lag(self._signed(together, way), self._spread).late
        if abs(late) > _SURE and self._late[suspect] != (late > 0.0):
            self._late[suspect] = late > 0.0
            window.clear()
        return newest

    def _signed(self, rows: LineRows, way: int) -> LineRows:
        """The calibration displaces the other camera's points, from whichever it is looked at."""
        if way == 0:
            return rows
        return LineRows(-rows.offset, -rows.shift, rows.place)

    def _old(self) -> str:
        return f"{_named(self._late)} old images" if any(self._late) else ""

    # ----------------------------------------------------------------------------------------


def _named(which: list[bool]) -> str:
    names = [CAMERA_NAMES[k] for k, one in enumerate(which) if one]
    verb = "camera delivers" if len(names) == 1 else "cameras deliver"
    return f"the {' and '.join(names)} {verb}"


def _followed_of(a: Image, b: Image, points: FloatArray, which: BoolArray) -> Followed:
    """As :func:`followed`, of some points (n,); the others come back nowhere."""
    found, kept = points.copy(), np.zeros(len(points), np.bool_)
    found[which], kept[which] = followed(a, b, points[which])
    return found, kept


def _grey(image: Image, points: FloatArray) -> FloatArray:
    """Grey values (n,) at the points (n, 2)."""
    at = np.rint(points).astype(np.int64)
    rows = np.clip(at[:, 1], 0, image.shape[0] - 1)
    return image[rows, np.clip(at[:, 0], 0, image.shape[1] - 1)].astype(np.float64)
