"""Errors that fgslam raises on purpose.

Every error a user can cause descends from :class:`FgslamError`. Its message is one line: what is
wrong, where, and how to correct it. The command line catches the root once and exits with status 2.
"""

from __future__ import annotations


class FgslamError(Exception):
    """Root of all errors with a message meant for the user."""


class ConfigError(FgslamError):
    """The experiment's configuration cannot be used."""


class DatasetError(FgslamError):
    """A recording is missing, malformed, or lacks what the method needs."""


class FrameError(DatasetError):
    """One frame cannot be read; the sequence as a whole may still be usable."""


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


class EstimatorError(FgslamError):
    """An estimator was given input that it cannot accept (time running backwards, unknown type)."""


class SessionError(FgslamError):
    """A session of SLAM or a path follower was used after it was closed, or after it had failed."""


class MissingDependencyError(FgslamError):
    """A library of the system or an optional package is absent."""
