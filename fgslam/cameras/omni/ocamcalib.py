"""OCamCalib's polynomial camera (Scaramuzza, Martinelli and Siegwart 2006) and its result file.

A pixel at radius rho from the centre looks along (rho cos, rho sin, f(rho)), f a polynomial. The
file's inverse polynomial is a fit of its own, good to a fraction of a pixel; pixels are found here
by solving f exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.polynomial import polynomial

from fgslam.cameras.omni.mirrors import AHEAD_IS_UP, InvertedCamera, MirrorFrame
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text

_MAX_TERMS = 64
# The file's two polynomials are fits of one another: further apart, one of them is damaged.
_MAX_DISAGREEMENT_PX = 3.0


@dataclass(frozen=True)
class OCamCamera(InvertedCamera):
    """A camera with the direct polynomial ``f(rho) = sum direct[k] rho^k``, rho in pixels.

    With the mirror above an upward-looking camera f is negative where the camera sees downward, in
    the middle, and elevation is ``atan2(f, rho)``; it must rise over the ring.
    """

    direct: tuple[float, ...]
    _turns_back = "narrow the ring to what the mirror shows"

    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations; see :class:`RadialCamera`."""
        radius = np.asarray(radius, dtype=np.float64)
        return np.asarray(np.arctan2(polynomial.polyval(radius, np.array(self.direct)), radius))

    def _value_and_slope(self, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = polynomial.polyval(radius, np.array(self.direct))
        slope = polynomial.polyval(radius, polynomial.polyder(np.array(self.direct)))
        return np.arctan2(f, radius), (slope * radius - f) / (f * f + radius * radius)


@dataclass(frozen=True, slots=True)
class OCamCalibration:
    """The contents of a ``calib_results.txt``.

    Attributes:
        source: the file, for messages.
        direct: coefficients of f, from the constant upward, pixels.
        inverse: coefficients of radius over the angle atan(f / rho), from the constant upward.
        centre: row and column, from 0.
        affine: c, d, e.
        width, height: of the calibrated picture.
        ring: inner and outer radius that the mirror shows, pixels, or None where not stated.
        cropped: columns that were cut off at the left and right before calibrating.
    """

    source: str
    direct: tuple[float, ...]
    inverse: tuple[float, ...]
    centre: tuple[float, float]
    affine: tuple[float, float, float]
    width: int
    height: int
    ring: tuple[float, float] | None = None
    cropped: tuple[int, int] = (0, 0)

    def camera(
        self,
        size: tuple[int, int] | None = None,
        ring: tuple[float, float] | None = None,
        ahead: float = AHEAD_IS_UP,
        clockwise: bool = True,
    ) -> OCamCamera:
        """The camera for pictures of a size (width, height): cropped as calibrated, or not yet.

        ``ring`` replaces the file's; where neither is known the largest circle within the picture
        is taken. Raises CalibrationError for a picture of any other size.
        """
        left, right = self.cropped
        wide = (self.width + left + right, self.height)
        size = size or (self.width, self.height)
        if size not in ((self.width, self.height), wide):
            uncropped = f" (or {wide[0]}x{wide[1]} uncropped)" if left + right else ""
            raise CalibrationError(
                f"{self.source} calibrates pictures of {self.width}x{self.height}{uncropped}, but "
                f"the picture has {size[0]}x{size[1]} pixels; scale or crop it back, or calibrate "
                "again"
            )
        shift = left if size == wide else 0
        centre = (self.centre[1] + shift, self.centre[0])
        frame = MirrorFrame(*size, centre, ahead, clockwise, self.affine)
        inner, outer = ring or self.ring or (0.0, _largest_circle(frame))
        return OCamCamera(frame, inner, outer, direct=self.direct)

    def disagreement(self, ring: tuple[float, float]) -> float:
        """How far the file's inverse polynomial is off over a ring, pixels."""
        radius = np.linspace(*ring, 200)
        angle = np.arctan2(polynomial.polyval(radius, np.array(self.direct)), radius)
        found = polynomial.polyval(angle, np.array(self.inverse))
        return float(np.abs(found - radius).max())


def _largest_circle(frame: MirrorFrame) -> float:
    column, row = frame.centre
    return min(column, row, frame.width - 1 - column, frame.height - 1 - row)


# --------------------------------------------------------------------------------------------
# The file


def read_ocamcalib(path: Path) -> OCamCalibration:
    """Reads a ``calib_results.txt``.

    Besides OCamCalib's own five entries two more are understood where their comments name them:
    the ring that the mirror shows ("ROI max min radius") and columns that were cut off before
    calibrating ("left right cropped pixel").

    Raises:
        CalibrationError: with file and line, for anything missing, malformed or contradictory.
    """
    entries = _entries(path)
    if len(entries) < 5:
        raise CalibrationError(
            f"{path} has {len(entries)} entries, an OCamCalib result has 5 (two polynomials, "
            "centre, affine parameters, size): it is truncated or another kind of file; export it "
            "again"
        )
    direct = _polynomial(path, entries[0], "direct")
    inverse = _polynomial(path, entries[1], "inverse")
    row, column = _numbers(path, entries[2], 2, "centre (row, column)")
    c, d, e = _numbers(path, entries[3], 3, "affine parameters (c, d, e)")
    height, width = _wholes(path, entries[4], "size (height, width)")
    calibration = OCamCalibration(
        str(path), direct, inverse, (row, column), (c, d, e), width, height
    )
    for entry in entries[5:]:
        calibration = _with_extra(path, entry, calibration)
    _require_sense(path, calibration)
    return calibration


@dataclass(frozen=True, slots=True)
class _Entry:
    line: int
    comment: str
    words: list[str]


def _entries(path: Path) -> list[_Entry]:
    """Lines of numbers, each with the comment before it."""
    text = read_text(path, CalibrationError, "give OCamCalib's calib_results.txt")
    entries, comment = [], ""
    for number, line in enumerate(text.splitlines(), 1):
        values, _, beside = line.replace("%", "#").partition("#")  # MATLAB's comments, too
        words = values.replace(",", " ").split()
        if words:
            entries.append(_Entry(number, comment, words))
        comment = "" if words else beside.strip(" \t#") or comment
    return entries


def _floats(path: Path, entry: _Entry, what: str) -> tuple[float, ...]:
    values = []
    for word in entry.words:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise CalibrationError(
                f"{path}, line {entry.line}: {what}: {word!r} is no finite number; correct it"
            )
        values.append(value)
    return tuple(values)


def _numbers(path: Path, entry: _Entry, count: int, what: str) -> tuple[float, ...]:
    values = _floats(path, entry, what)
    if len(values) != count:
        raise CalibrationError(
            f"{path}, line {entry.line}: {what}: {len(values)} numbers, expected {count}; correct "
            "the line"
        )
    return values


def _wholes(path: Path, entry: _Entry, what: str) -> tuple[int, int]:
    first, second = _numbers(path, entry, 2, what)
    if first != int(first) or second != int(second) or first < 0 or second < 0:
        raise CalibrationError(
            f"{path}, line {entry.line}: {what}: {first:g} and {second:g}, expected whole numbers "
            "of pixels; correct the line"
        )
    return int(first), int(second)


def _polynomial(path: Path, entry: _Entry, which: str) -> tuple[float, ...]:
    count, *coefficients = _floats(path, entry, f"{which} polynomial")
    if count != len(coefficients) or not 2 <= count <= _MAX_TERMS:
        raise CalibrationError(
            f"{path}, line {entry.line}: {which} polynomial: states {count:g} coefficients (2 to "
            f"{_MAX_TERMS}) and has {len(coefficients)}; correct the line"
        )
    return tuple(coefficients)


def _with_extra(path: Path, entry: _Entry, calibration: OCamCalibration) -> OCamCalibration:
    comment = entry.comment.lower()
    if "roi" in comment and "radius" in comment:
        outer, inner = _numbers(path, entry, 2, "ring (largest, smallest radius)")
        if not 0.0 <= inner < outer:
            raise CalibrationError(
                f"{path}, line {entry.line}: ring: largest radius {outer:g} and smallest "
                f"{inner:g}; the first must be larger"
            )
        return replace(calibration, ring=(inner, outer))
    if "crop" in comment:
        return replace(calibration, cropped=_wholes(path, entry, "cropped columns (left, right)"))
    raise CalibrationError(
        f"{path}, line {entry.line}: an entry that is not known "
        f"({entry.comment or 'without a comment'}); remove it"
    )


def _require_sense(path: Path, calibration: OCamCalibration) -> None:
    try:
        camera = calibration.camera()
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {cause}") from cause
    apart = calibration.disagreement((camera.inner_radius, camera.outer_radius))
    if not apart <= _MAX_DISAGREEMENT_PX:
        raise CalibrationError(
            f"{path}: the inverse polynomial is {apart:.3g} px off the direct one, at most "
            f"{_MAX_DISAGREEMENT_PX:g} px are credible: one of the two is damaged; export it again"
        )
