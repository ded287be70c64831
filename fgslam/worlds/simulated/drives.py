"""Drives for worlds without images: the lab's own, rounds, sharp turns, and long corridors.

Room frame as in :mod:`fgslam.worlds.driving.paths`: x east, y north, metres; heading
counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.worlds.driving.paths import (
    PlanarPath,
    drive_along,
    paper_loop,
    planar_poses,
    room_laps,
    straights_and_turns,
)
from fgslam.worlds.settings import MeasurementDriveSettings

CORRIDOR_WIDTH_M = 2.4

_ROUND_M = (16.0, 10.0)  # centre line of the closed corridor
_LEGS_M = (12.0, 8.0, 15.0, 7.0)  # of the long one, over and over
_LEAST_WAY_M = 200.0  # in the long one
_BEND_M = 2.5  # way over which a corridor's corner is driven
_PLACES_OF_PATHS = {
    "room": ("lab_loop", "laps", "sharp_turns"),
    "corridor": ("laps", "exploring"),
}

# Half a round of sharp turns: (metres, degrees). Turned by half a turn, it closes upon itself.
_SHARP_START = (-1.9, -1.16, 0.0)
_SHARP_HALF = ((1.9, 0.0), (0.0, 360.0), (1.9, 0.0), (0.5, 90.0), (1.2, 0.0), (0.0, -270.0))
_CRUISE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class PlannedDrive:
    """Where the robot is when.

    Attributes:
        timestamps: (n,) seconds from 0.
        body: (n, 4, 4) ``wTb`` in the room's frame, on the floor.
        corners: (k, 2) centre line of the corridor, metres; None in the room.
    """

    timestamps: FloatArray
    body: FloatArray
    corners: FloatArray | None


def plan_measured_drive(settings: MeasurementDriveSettings, place: str) -> PlannedDrive:
    """The drive that the settings name, in a place.

    Raises:
        ConfigError: the path does not exist in the place, or not in so few frames.
    """
    if settings.path not in _PLACES_OF_PATHS[place]:
        raise ConfigError(
            f"dataset.drive.path {settings.path} does not exist in a {place}; choose one of "
            f"{', '.join(_PLACES_OF_PATHS[place])}, or another dataset.world.place"
        )
    if settings.path == "sharp_turns":
        planar = _sharp_turns(settings)
        stamps = np.arange(len(planar)) / settings.frame_rate_hz
        return PlannedDrive(stamps, planar_poses(planar), None)
    corners = None
    if place == "room":
        path = paper_loop() if settings.path == "lab_loop" else room_laps(settings.laps)
    elif settings.path == "laps":
        path, corners = _closed_corridor(settings.laps)
    else:
        path, corners = _long_corridor()
    drive = drive_along(path, settings, settings.frames)
    return PlannedDrive(drive.timestamps, drive.body_poses(drive.timestamps), corners)


# --------------------------------------------------------------------------------------------
# Corridors


def _closed_corridor(laps: int) -> tuple[PlanarPath, FloatArray]:
    """``laps`` rounds of a rectangle, from the middle of its first side."""
    a, b = _ROUND_M
    cut = _bend_cut()
    half, long, short = a / 2 - cut, a - 2 * cut, b - 2 * cut
    turn = (_BEND_M, np.pi / 2)
    lap = [(half, 0.0), turn, (short, 0.0), turn, (long, 0.0), turn, (short, 0.0), turn]
    path = straights_and_turns((a / 2, 0.0, 0.0), [*lap, (half, 0.0)] * laps, closed=True)
    return path, np.array([[0.0, 0.0], [a, 0.0], [a, b], [0.0, b], [0.0, 0.0]])


def _long_corridor() -> tuple[PlanarPath, FloatArray]:
    """Stairs seen from above, left and right in turns: it never meets itself."""
    legs: list[float] = []
    while sum(legs) < _LEAST_WAY_M:
        legs.append(_LEGS_M[len(legs) % len(_LEGS_M)])
    cut = _bend_cut()
    segments: list[tuple[float, float]] = []
    for i, leg in enumerate(legs):
        inner = 0 < i < len(legs) - 1
        segments.append((leg - cut - (cut if inner else 1.0), 0.0))
        segments.append((_BEND_M, np.pi / 2 if i % 2 == 0 else -np.pi / 2))
    along = np.array([[1.0, 0.0] if i % 2 == 0 else [0.0, 1.0] for i in range(len(legs))])
    corners = np.vstack([[0.0, 0.0], np.cumsum(along * np.array(legs)[:, None], axis=0)])
    return straights_and_turns((1.0, 0.0, 0.0), segments[:-1], closed=False), corners


def _bend_cut() -> float:
    """How far before and after a corner a bend of 90 degrees begins and ends, metres."""
    bend = straights_and_turns((0.0, 0.0, 0.0), [(_BEND_M, np.pi / 2)], closed=False)
    return float(bend.xy[-1, 0])


# --------------------------------------------------------------------------------------------
# Sharp turns


def _sharp_turns(settings: MeasurementDriveSettings) -> FloatArray:
    """(n, 3) x, y, heading: spins on the spot and tight bends, round after round."""
    step = _CRUISE * settings.max_speed_m_s / settings.frame_rate_hz
    turn = np.deg2rad(settings.turn_deg_per_frame)
    segments = []
    for way, degrees in _SHARP_HALF:  # in equal chords and turns, each within step and turn
        angle = np.deg2rad(degrees)
        count = int(np.ceil(max(way / step, abs(angle) / turn) - 1e-9))
        segments.append(np.tile([way / count, angle / count], (count, 1)))
    moves = np.vstack([*segments, *segments])
    wanted = len(moves) + 1 if settings.frames is None else settings.frames
    moves = np.tile(moves, (-(-wanted // len(moves)), 1))[: wanted - 1]
    out = np.zeros((wanted, 3))
    out[:, 2] = _SHARP_START[2] + np.concatenate([[0.0], np.cumsum(moves[:, 1])])
    middle = out[:-1, 2] + 0.5 * moves[:, 1]
    steps = moves[:, :1] * np.column_stack([np.cos(middle), np.sin(middle)])
    out[:, :2] = _SHARP_START[:2]
    out[1:, :2] += np.cumsum(steps, axis=0)
    return out
