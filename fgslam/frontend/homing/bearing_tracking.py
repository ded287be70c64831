"""Tracking of features from image to image: KLT on a stabilised view (Goedemé et al. IV-A).

Eq. 2's matrix is summed over the window. A point is lost for good when it cannot be tracked
back to where it came from, when it no longer looks as it did when its tracking began
(:mod:`fgslam.frontend.features.patches`), or when it leaves the view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray
from fgslam.core.checks import later_time
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import TrackedBearings
from fgslam.frontend.features.patches import ReferencePatches, align, anchor
from fgslam.frontend.homing.stabilised_view import StabilisedImage, StabilisedView

_MAX_VIEW_WIDTH = 720  # columns: half a degree; coarser cameras get fewer
SIGMA_PX = 0.2  # of a tracked point, in pixels of the view
_SIGMA_DEFORMED_PX = 1.0
"""Pixels of sigma for each unit of a patch's deformation, added in squares: measured on the
rendered house."""

_MAX_DEFORMATION = 1.0
"""A point whose patch is stretched and sheared by more (Frobenius norm of the affine map less one)
is lost."""

_PATCH_DEFORMATION = 0.05  # sigma of its stretching and shearing from image to image
WINDOW_PX = 9  # side of the tracked window, in the view
_MIN_CORRELATION = 0.7
"""Of a point's patch with its first one, gain and offset taken out; a point that looks less like it
is lost."""

_PATCH_NOISE_GREY = 4.0  # sigma of its grey values: noise, and what no affine map does
PATCH_PX = 13  # side of the patch that holds a point in place
DISTINCT_PX = 3.0  # of two trackable points nearer than this one is kept
MIN_EIGENVALUE = 1e-4  # smaller eigenvalue of eq. 2 over the window, a pixel, grey values 0 to 1
_MAX_BACK_PX = 1.0  # a point tracked back that misses its origin by more is lost
_PRECISION_PX = 0.03  # a smaller step ends the iteration
_ITERATIONS = 15  # of Newton's method on each level
_PYRAMID_LEVELS = 2  # halvings of the view above the view itself

Float32 = npt.NDArray[np.float32]

_GAIN = (0.2, 5.0)  # from one exposure to the next
_SAME_GAIN, _SAME_LEVEL = 0.02, 1.0  # less is left as it is: rounding would be worse
_MAX_TURN = np.deg2rad(60.0)  # between two images; 40 deg/s of a wheelchair seen 5 times a second


@dataclass(frozen=True, slots=True, eq=False)
class TrackerState:
    """All that a tracker knows of the images before.

    Attributes:
        last: the last image.
        places: (n, 2) of the points in it.
        patches: what the points looked like at first.
        ids: (n,) ascending.
        time: of the last image, seconds.
    """

    last: StabilisedImage
    places: FloatArray
    patches: ReferencePatches
    ids: IntArray
    time: float


class BearingTracker:
    """Tracks points over one camera's images and gives their bearings.

    Attributes:
        stabilised: makes the view that points are tracked in.
        state: all that is carried over; None before the first image. A tracker that is given
            another one's state goes on from there, to the same bits.
    """

    def __init__(self, camera: OmniCamera) -> None:
        self.stabilised = StabilisedView(camera, _MAX_VIEW_WIDTH, WINDOW_PX, _PYRAMID_LEVELS)
        self.state: TrackerState | None = None

    @property
    def view(self) -> OmniCamera:
        """The camera whose pixels the tracked points are."""
        return self.stabilised.view

    def start(self, image: Image, time: float, ids: IntArray, pixels: FloatArray) -> None:
        """Tracks these points from now on, instead of any before.

        Args:
            image: (h, w, 3) that they are seen in.
            time: seconds.
            ids: (n,) ascending.
            pixels: (n, 2) in the view.
        """
        last = self.stabilised.make(image, None, 0.0)
        places = self.stabilised.to_stabilised(pixels, last)
        self.state = TrackerState(last, places, _anchored(last, places), ids.copy(), time)

    def add(self, ids: IntArray, pixels: FloatArray) -> None:
        """Tracks these points of the last image, too; identities above those before."""
        state = self._started()
        places = self.stabilised.to_stabilised(pixels, state.last)
        self.state = replace(
            state,
            places=np.vstack([state.places, places]),
            patches=state.patches.join(_anchored(state.last, places)),
            ids=np.concatenate([state.ids, ids]),
        )

    def track(self, image: Image, time: float) -> TrackedBearings:
        """Finds the points in the next image; those not found are forgotten.

        Raises:
            EstimatorError: tracking was not started, or time does not increase.
            FrameError: the image is not the camera's.
        """
        before = self._started()
        later_time(time, before.time, "tracking", EstimatorError)
        turn = _MAX_TURN * self.stabilised.period / (2.0 * np.pi)
        now = self.stabilised.make(image, before.last, turn)
        found = replace(before, last=now, time=time)
        if len(before.ids):
            places, kept = self._follow(before, now)
            found = self._settled(replace(found, places=places), kept)
        self.state = found
        return self.bearings()

    def _started(self) -> TrackerState:
        if self.state is None:
            raise EstimatorError(
                "no image was tracked yet: start before tracking, or adding points"
            )
        return self.state

    def pixels(self) -> FloatArray:
        """(n, 2) where the points are in the view of the last image."""
        if self.state is None:
            return np.empty((0, 2))
        return self.stabilised.from_stabilised(self.state.places, self.state.last)

    def _settled(self, state: TrackerState, kept: BoolArray) -> TrackerState:
        """The points ``kept``, each aligned with its first patch, that still look like it."""
        patches, places, correlation = align(
            state.patches.select(kept), state.last.grey, state.places[kept]
        )
        good = (correlation >= _MIN_CORRELATION) & (patches.deformation() <= _MAX_DEFORMATION)
        good &= self._inside(places)
        return replace(
            state,
            places=self._centred(places[good]),
            patches=patches.select(good),
            ids=state.ids[kept][good],
        )

    def _centred(self, places: FloatArray) -> FloatArray:
        """Places between the margins; a point that crossed the seam goes on at the other end."""
        margin, period = self.stabilised.margin, self.stabilised.period
        return np.column_stack([(places[:, 0] - margin) % period + margin, places[:, 1]])

    def _follow(self, state: TrackerState, now: StabilisedImage) -> tuple[FloatArray, BoolArray]:
        """(n, 2) places in the new view, and (n,) whether the way back confirms them."""
        before, origin = state.last, state.places.astype(np.float32)
        window = (WINDOW_PX, WINDOW_PX)
        kinds = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT
        criteria = (kinds, _ITERATIONS, _PRECISION_PX)
        start = np.empty_like(origin)  # not read without the flag
        alike = _in_light_of(before, now)
        found, good, _ = cv2.calcOpticalFlowPyrLK(
            before.grey, alike, origin, start, None, None,
            window, _PYRAMID_LEVELS, criteria, 0, MIN_EIGENVALUE,
        )  # fmt: skip
        # The way back starts at its end, so that the finest level alone does: it costs a third.
        back, good_back, _ = cv2.calcOpticalFlowPyrLK(
            alike, before.grey, found, origin.copy(), None, None,
            window, 0, criteria, cv2.OPTFLOW_USE_INITIAL_FLOW, MIN_EIGENVALUE,
        )  # fmt: skip
        ends = np.asarray(found, np.float32)
        missed = np.hypot(*(np.asarray(back, np.float32) - origin).T)
        kept = np.asarray((good[:, 0] == 1) & (good_back[:, 0] == 1) & (missed <= _MAX_BACK_PX))
        kept &= self._inside(ends)
        return ends.astype(np.float64), kept

    def _inside(self, places: Float32 | FloatArray) -> BoolArray:
        """(n,) whether a point's window lies mostly in the view; rows have no continuation."""
        rim, rows = WINDOW_PX / 4.0, self.stabilised.view.height
        good = (places[:, 1] >= rim) & (places[:, 1] <= rows - 1 - rim)
        columns = 2 * self.stabilised.margin + self.stabilised.period
        return np.asarray(good & (places[:, 0] >= 0.0) & (places[:, 0] <= columns - 1.0))

    def bearings(self) -> TrackedBearings:
        """The points as the last image shows them."""
        state, view, pixels = self._started(), self.stabilised.view, self.pixels()
        a_column = 2.0 * np.pi / self.stabilised.period
        a_row = (view.top_elevation - view.bottom_elevation) / (view.height - 1)
        sigma = np.hypot(SIGMA_PX, _SIGMA_DEFORMED_PX * state.patches.deformation())
        return TrackedBearings(
            time=state.time,
            ids=state.ids.copy(),
            bearing=np.pi - pixels[:, 0] * a_column,
            sigma_bearing=sigma * a_column,
            elevation=view.top_elevation - pixels[:, 1] * a_row,
            sigma_elevation=sigma * a_row,
        )


def _anchored(image: StabilisedImage, places: FloatArray) -> ReferencePatches:
    return anchor(image.grey, places, PATCH_PX, _PATCH_NOISE_GREY, _PATCH_DEFORMATION)


def _in_light_of(before: StabilisedImage, now: StabilisedImage) -> Image:
    """The present view with mean and contrast of the one before.

    OpenCV's tracker takes a brighter exposure for motion wherever contrast is low.
    """
    (mean, spread), (mean_now, spread_now) = before.light, now.light
    gain = float(np.clip(spread / max(spread_now, 1.0), *_GAIN))
    offset = mean - gain * mean_now
    if abs(gain - 1.0) < _SAME_GAIN and abs(offset + (gain - 1.0) * mean_now) < _SAME_LEVEL:
        return now.grey
    levels = np.clip(np.round(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(now.grey, levels), dtype=np.uint8)


# --------------------------------------------------------------------------------------------
# Tracking through a whole recording: points that are lost are replaced by new ones


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

    def __init__(self, camera: OmniCamera, least: int, most: int) -> None:
        """Fills up to ``most`` points whenever fewer than ``least`` are left."""
        self._tracker = BearingTracker(camera)
        self._least, self._most = least, most
        self._next = 0

    def take(self, image: Image, time: float) -> TrackedImage:
        """Tracks into the next image (h, w, 3), and adds points where too few are left.

        Raises:
            EstimatorError: time does not increase.
            FrameError: the image is not the camera's.
        """
        if self._tracker.state is None:
            none = np.empty(0, np.int64)
            self._tracker.start(image, time, none, np.empty((0, 2)))
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
        return VideoState(self._tracker.state, self._next)

    def restore(self, state: VideoState) -> None:
        """Goes on from :meth:`state`, to the same bits."""
        self._tracker.state, self._next = state.tracker, state.next

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
