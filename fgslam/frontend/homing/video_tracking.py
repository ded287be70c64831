"""Tracking through a whole recording: points that are lost are replaced by new ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.homing import TrackedBearings
from fgslam.frontend.homing.bearing_tracking import WINDOW_PX, BearingTracker, TrackerState
from fgslam.frontend.homing.trackable_points import DISTINCT_PX
from fgslam.frontend.homing.tracking_settings import OmniTrackingSettings


@dataclass(frozen=True, slots=True, eq=False)
class TrackedImage:
    """One image of a recording.

    Attributes:
        tracked: the points after replenishing.
        survivors: points of the image before that were found again.
        added: (k,) identities of the new ones.
    """

    tracked: TrackedBearings
    survivors: int
    added: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class VideoState:
    """All that goes over from one image to the next.

    Attributes:
        tracker: of the points; None before the first image.
        next: identity of the next new point.
    """

    tracker: TrackerState | None
    next: int


class ReplenishedTracker:
    """A tracker that always follows enough points."""

    def __init__(
        self, camera: OmniCamera, settings: OmniTrackingSettings, least: int, most: int
    ) -> None:
        """Fills up to ``most`` points whenever fewer than ``least`` are left."""
        self._tracker = BearingTracker(camera, settings)
        self._least, self._most = least, most
        self._next = 0
        self._started = False

    def take(self, image: Image, time: float) -> TrackedImage:
        """Tracks into the next image (h, w, 3), and adds points where too few are left.

        Raises:
            EstimatorError: time does not increase.
            FrameError: the image is not the camera's.
        """
        if not self._started:
            none = np.empty(0, np.int64)
            self._tracker.start(image, time, none, np.empty((0, 2)))
            self._started = True
            survivors = 0
            tracked = None
        else:
            tracked = self._tracker.track(image, time)
            survivors = len(tracked)
        added = self._fill(image) if survivors < self._least else np.empty(0, np.int64)
        if tracked is None or len(added):
            tracked = self._tracker.bearings()
        return TrackedImage(tracked, survivors, added)

    def state(self) -> VideoState:
        """What it takes to go on later."""
        return VideoState(self._tracker.state(), self._next)

    def restore(self, state: VideoState) -> None:
        """Goes on from :meth:`state`, to the same bits."""
        self._tracker.restore(state.tracker)
        self._next, self._started = state.next, state.tracker is not None

    def pixels(self) -> FloatArray:
        """(n, 2) where the points are in the view (:meth:`view`) of the last image."""
        return self._tracker.pixels()

    def view(self, image: Image) -> Image:
        """(height, width) the unwrapped grey view of an image (h, w, 3)."""
        return self._tracker.stabilised.grey(image)

    def _fill(self, image: Image) -> IntArray:
        """(k,) identities of the strongest corners away from the points that there are."""
        present = self._tracker.pixels()
        corners = self._corners(self._tracker.stabilised.grey(image), present)
        ids = self._next + np.arange(len(corners), dtype=np.int64)
        self._next += len(corners)
        self._tracker.add(ids, corners)
        return ids

    def _corners(self, grey: Image, present: FloatArray) -> FloatArray:
        """(k, 2) in the view; k fills up what is missing, where there is so much to see."""
        mask = np.full(grey.shape, 255, np.uint8)
        rim = WINDOW_PX // 2 + 1
        mask[:rim] = mask[-rim:] = 0
        for column, row in np.round(present).astype(int).tolist():
            cv2.circle(mask, (column, row), WINDOW_PX // 2, 0, -1)
        wanted = self._most - len(present)
        if wanted <= 0:
            return np.empty((0, 2))
        found = cv2.goodFeaturesToTrack(
            grey, wanted, 0.005, max(DISTINCT_PX, WINDOW_PX / 3.0), mask=mask,
            blockSize=WINDOW_PX,
        )  # fmt: skip
        return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
