"""What the camera saw on the way to each target, with its tracks (the pictures of fig. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray
from fgslam.core.files import make_subfolder
from fgslam.core.homing import TrackedBearings
from fgslam.homing.active_homing import ActiveHoming
from fgslam.homing.command import Command
from fgslam.homing.path_following import HomingChain
from fgslam.report.content import Picture

FOLDER = "pictures"
_TRAIL = 15  # images


@runtime_checkable
class Unwrapping(Protocol):
    """FrontEnd that can show what they see; those of landmark worlds cannot."""

    def unwrapped(self, image: ByteArray) -> ByteArray:
        """(h, w) grey view of an image."""
        ...

    def places(self, tracked: TrackedBearings) -> FloatArray:
        """(m, 2) column and row of tracked points in that view."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LegView:
    """The last image of a leg in which the target was tracked.

    Attributes:
        target: its number.
        view: (h, w) grey, unwrapped.
        trails: (k, 2) of each point, its place in the last k images, the present one last.
        caption: what the robot made of it.
    """

    target: int
    view: ByteArray
    trails: tuple[FloatArray, ...]
    caption: str


class DriveWatcher:
    """Looks over the robot's shoulder; see :data:`fgslam.homing.closed_loop.Watcher`."""

    def __init__(self, front_end: Unwrapping, follower: HomingChain) -> None:
        self._front_end, self._follower = front_end, follower
        self._homing: ActiveHoming | None = None
        self._trails: dict[int, FloatArray] = {}
        self._last: dict[int, tuple[ByteArray, dict[int, FloatArray], str]] = {}

    def __call__(self, command: Command, image: ByteArray) -> None:
        """Notes the image if the tracks are those in it."""
        homing = self._follower.controller.active
        if homing is None or homing.tracked.time != command.time:
            return
        before = self._trails if homing is self._homing else {}
        self._homing = homing
        none = np.empty((0, 2))
        places = self._front_end.places(homing.tracked)
        self._trails = {
            i: np.vstack([before.get(i, none)[1 - _TRAIL :], place])
            for i, place in zip(homing.tracked.ids.tolist(), places, strict=True)
        }
        caption = (
            f"{command.time:.1f} s, {len(places)} tracks, {command.remaining:.2f} of the leg left"
        )
        self._last[command.target] = (image, self._trails, caption)

    def views(self, most: int) -> tuple[LegView, ...]:
        """At most so many legs, spread evenly, the last one among them."""
        targets = sorted(self._last)
        count = min(most, len(targets))
        chosen = np.linspace(len(targets), 0, count, endpoint=False).round().astype(int)[::-1] - 1
        return tuple(self._view(targets[k]) for k in chosen.tolist())

    def _view(self, target: int) -> LegView:
        image, trails, caption = self._last[target]
        return LegView(target, self._front_end.unwrapped(image), tuple(trails.values()), caption)


def draw_leg_views(folder: Path, seed: int, views: Sequence[LegView]) -> tuple[Picture, ...]:
    """A picture for each view. Raises OutputError."""
    from fgslam.report.pictures.image_overlays import draw_view_tracks  # Matplotlib takes a second

    pictures = []
    for view in views:
        path = make_subfolder(folder, FOLDER) / f"leg_{view.target + 1:02d}.png"
        caption = f"Seed {seed}, leg {view.target + 1}, {view.caption}"
        draw_view_tracks(path, view.view, view.trails, caption)
        pictures.append(Picture(caption, path.read_bytes()))
    return tuple(pictures)
