"""Errors that fgslam raises on purpose.

Every error a user can cause descends from :class:`FgslamError`. Its message is one line: what is
wrong, where, and how to correct it. The command line catches the root once and exits with status 2.
"""

from __future__ import annotations

import re

TYPE_CHECKING = False  # as in typing, whose import takes as long as all else of fgslam
if TYPE_CHECKING:
    from typing import Any

_ECHOED = 200
"""Characters of what was given that a message repeats at most."""
_LONGEST = 1500
_LONG_WORD = re.compile(rf"\S{{{_ECHOED + 1},}}")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def shortened(text: str, most: int = _ECHOED) -> str:
    """The start and the end of a text that is longer than ``most`` characters."""
    if len(text) <= most:
        return text
    kept = (most - 5) // 2
    return f"{text[:kept]} ... {text[-kept:]}"


def one_line(message: str) -> str:
    """A message as it may be shown: long names shortened, nothing that moves the cursor."""
    plain = _CONTROL.sub(lambda found: repr(found[0])[1:-1], message)
    return shortened(_LONG_WORD.sub(lambda found: shortened(found[0]), plain), _LONGEST)


class FgslamError(Exception):
    """Root of all errors with a message meant for the user: one line of limited length."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class ConfigError(FgslamError):
    """The experiment's configuration cannot be used."""


class DatasetError(FgslamError):
    """A recording is missing, malformed, or lacks what the method needs."""


class FrameError(DatasetError):
    """One frame cannot be read; the sequence as a whole may still be usable."""


class OneImageError(FrameError):
    """Not all images of a frame can be read; ``frame`` has black ones in place of the others."""

    frame: Any


class CalibrationError(DatasetError):
    """A camera calibration is missing, not finite, or geometrically impossible."""


class OdometryError(DatasetError):
    """An odometry increment is not finite or absurdly large."""


class MeasurementLogError(FgslamError):
    """A measurement log is truncated, foreign, or of an unknown version."""


class StoredMapError(FgslamError):
    """A path memory or a topological map is truncated, foreign, or of an unknown version."""


class MapError(FgslamError):
    """A saved map cannot be used: truncated, foreign, damaged, newer, or of another rig."""


class OutputError(FgslamError):
    """The run folder cannot be written, or it exists already."""


class MemoryShortageError(FgslamError):
    """There is no memory left, or a library needs more than the process may use."""


class EstimatorError(FgslamError):
    """An estimator was given input that it cannot accept (time running backwards, unknown type)."""


class SessionError(FgslamError):
    """A session of SLAM or a path follower was used after it was closed, or after it had failed."""


class MissingDependencyError(FgslamError):
    """A library of the system or an optional package is absent."""
