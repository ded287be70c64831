"""Tracking of features from image to image: KLT on a stabilised view (Goedemé et al. IV-A).

Eq. 2's matrix is summed over the window. A point is lost for good when it cannot be tracked
back to where it came from, when it no longer appears as it did when its tracking began
(:mod:`fgslam.frontend.features.patches`), or when it leaves the view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from fgslam.cameras.omni import Equirectangular, OmniCamera, require_own_image, unwrap_maps
from fgslam.core.arrays import BoolArray, Float32, FloatArray, Image, IntArray
from fgslam.core.bearings import BearingMatches, FeatureKind, OmniFeatures, TrackedBearings
from fgslam.core.checks import later_time
from fgslam.core.errors import EstimatorError, FrameError
from fgslam.core.geometry import wrap
from fgslam.core.store import Kept
from fgslam.frontend.features.omni import pixels_a_radian, wrapping_period
from fgslam.frontend.features.patches import ReferencePatches, align, anchor

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
"""Of a point's patch with its first one, gain and offset taken out; a point that resembles it less
is lost."""

_PATCH_NOISE_GREY = 4.0  # sigma of its grey values: noise, and what no affine map does
PATCH_PX = 13  # side of the patch that holds a point in place
DISTINCT_PX = 3.0  # of two trackable points nearer than this one is kept
MIN_EIGENVALUE = 1e-4  # smaller eigenvalue of eq. 2 over the window, a pixel, grey values 0 to 1
_MAX_BACK_PX = 1.0  # a point tracked back that misses its origin by more is lost
_PRECISION_PX = 0.03  # a smaller step ends the iteration
_ITERATIONS = 15  # of Newton's method on each level
_PYRAMID_LEVELS = 2  # halvings of the view above the view itself

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

    state: Kept[TrackerState | None]

    def __init__(self, camera: OmniCamera) -> None:
        self.stabilised = StabilisedView(camera, _MAX_VIEW_WIDTH, WINDOW_PX, _PYRAMID_LEVELS)
        self.state = None

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


class ReplenishedTracker:
    """A tracker that always follows enough points."""

    _tracker: Kept[BearingTracker]
    _next: Kept[int]

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


# --------------------------------------------------------------------------------------------
# The view that points are tracked in: unwrapped, continued over its seam, and held stabilised
#
# On an unwrapped view a turn of the robot is a shift of the whole picture. It is measured from the
# picture as a whole and undone, so that what is left for the tracker are the small motions of
# parallax; and since columns then stand still, hardly a point ever crosses the seam.


_BANDS = 8  # of rows, averaged, from which the common shift is estimated
_PROBED = np.deg2rad(np.arange(-89.0, 90.0, 1.0))
_HIGHEST = np.deg2rad(60.0)  # beyond, a panorama's rows are stretched many times


@dataclass(frozen=True, slots=True, eq=False)
class StabilisedImage:
    """One image's view.

    Attributes:
        grey: (height, period + 2 margin) view, its rows continued on both sides.
        bands: (bands, period) complex spectra of bands of rows, of the view *before* any shift.
        shift: columns by which the view was moved to the right, modulo the period.
        light: mean and standard deviation of the grey values.
    """

    grey: Image
    bands: npt.NDArray[np.complex128]
    shift: int
    light: tuple[float, float]


class StabilisedView:
    """Makes views of one camera's images."""

    def __init__(self, camera: OmniCamera, max_width: int, window: int, levels: int) -> None:
        self._camera = camera
        resolution = pixels_a_radian(camera)
        longest = min(max_width, round(2.0 * np.pi * resolution)) - 1
        # Fourier transforms are fast for it; at most a few columns shorter.
        width = next(n for n in range(longest, 0, -1) if next_fast_len(n) == n) + 1
        bottom, top = _seen_elevations(camera)
        height = max(round((top - bottom) * (width - 1) / (2.0 * np.pi)) + 1, 2)
        self.view = Equirectangular(width, height, top, bottom)
        self.margin = window * 2**levels
        self.period = width - 1
        columns, rows = unwrap_maps(camera, self.view)
        # Without the view's last column, which shows what the first does.
        period = (columns[:, :-1].copy(), rows[:, :-1].copy())
        self._maps = cv2.convertMaps(*period, cv2.CV_16SC2)
        wraps = wrapping_period(camera) is not None
        self._border = cv2.BORDER_WRAP if wraps else cv2.BORDER_CONSTANT

    def grey(self, image: Image) -> Image:
        """(height, period) grey view of an image (h, w, 3) in R, G, B; not shifted.

        Raises:
            FrameError: the image is not the camera's.
        """
        require_own_image(self._camera, image)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        view = cv2.remap(grey, *self._maps, cv2.INTER_LINEAR, borderMode=self._border)
        return np.asarray(view, dtype=np.uint8)

    def make(
        self, image: Image, before: StabilisedImage | None, max_shift: float
    ) -> StabilisedImage:
        """The view of an image, shifted as the image before was, and by the turn since.

        Args:
            image: (h, w, 3).
            before: what came before, or None.
            max_shift: largest turn, in columns.
        """
        grey = self.grey(image)
        bands = _spectra(grey)
        shift = 0
        if before is not None:
            turned = _common_shift(before.bands, bands, self.period, max_shift)
            # The picture moved right by `turned` columns: undo it on top of what was undone before.
            shift = (before.shift - turned) % self.period
        view = self._continued(grey, (-shift - self.margin) % self.period)
        mean, spread = cv2.meanStdDev(view)
        return StabilisedImage(view, bands, shift, (float(mean[0, 0]), float(spread[0, 0])))

    def _continued(self, grey: Image, first: int) -> Image:
        """(height, period + 2 margin) columns from the ``first`` on, the view over and over."""
        wanted, parts = self.period + 2 * self.margin, []
        while wanted > 0:
            parts.append(grey[:, first : first + wanted])
            wanted -= parts[-1].shape[1]
            first = 0
        return np.concatenate(parts, axis=1)

    def to_stabilised(self, pixels: FloatArray, image: StabilisedImage) -> FloatArray:
        """(n, 2) places in the padded view of places (n, 2) in the view itself."""
        columns = (pixels[:, 0] + image.shift) % self.period + self.margin
        return np.column_stack([columns, pixels[:, 1]])

    def from_stabilised(self, places: FloatArray, image: StabilisedImage) -> FloatArray:
        """The inverse of :meth:`to_stabilised`."""
        columns = (places[:, 0] - self.margin - image.shift) % self.period
        return np.column_stack([columns, places[:, 1]])


def _seen_elevations(camera: OmniCamera) -> tuple[float, float]:
    """Lowest and highest elevation that the camera sees all around, radians."""
    around = np.linspace(-np.pi, np.pi, 16, endpoint=False)
    level = np.cos(_PROBED)[:, None]
    rays = np.stack(
        [
            level * np.cos(around),
            level * np.sin(around),
            np.broadcast_to(np.sin(_PROBED)[:, None], (len(_PROBED), len(around))),
        ],
        axis=-1,
    )
    seen = np.isfinite(camera.pixels(rays.reshape(-1, 3))[:, 0]).reshape(len(_PROBED), -1)
    whole = _PROBED[np.all(seen, axis=1) & (np.abs(_PROBED) <= _HIGHEST)]
    if len(whole) < 2:
        raise FrameError("the camera sees no elevation all around; check its model and centre")
    return float(whole[0]), float(whole[-1])


def _spectra(grey: Image) -> npt.NDArray[np.complex128]:
    """(bands, frequencies) spectra of the mean rows of bands, without their own means."""
    bands = min(_BANDS, len(grey))
    edges = [len(grey) * k // bands for k in range(bands + 1)]
    means = [
        cv2.reduce(grey[low:high], 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F)
        for low, high in pairwise(edges)
    ]
    spectra = np.fft.rfft(np.concatenate(means).astype(np.float64), axis=1)
    spectra[:, 0] = 0.0
    return np.asarray(spectra)


def _common_shift(
    before: npt.NDArray[np.complex128],
    now: npt.NDArray[np.complex128],
    period: int,
    max_shift: float,
) -> int:
    """Columns by which the picture moved to the right, by phase correlation of all bands."""
    cross = now * np.conj(before)
    # Half-way between plain and phase correlation: blur and noise have no say, edges keep theirs.
    cross = np.sum(cross / np.sqrt(np.maximum(np.abs(cross), 1e-9)), axis=0)
    score = np.fft.irfft(cross, n=period)
    most = min(int(max_shift), (period - 1) // 2)
    score[most + 1 : period - most] = -np.inf
    best = int(np.argmax(score))
    return best if best <= most else best - period


# --------------------------------------------------------------------------------------------
# From wide-baseline features to points that can be tracked (Goedemé et al. IV-A)
#
# Features that are recognised from afar are rarely the points that are tracked best. Near each one
# the point is chosen whose gradient matrix (eq. 2, summed over the window) has the largest smaller
# eigenvalue. In the target image that point was not looked for: it lies where the own frame of the
# feature puts it, as if its surroundings were a plane seen alike from both places.


_PLANE_ERROR = 0.2
"""Part of the offset from the feature's centre by which its place in the target view is uncertain:
features are not flat, nor seen head on."""

_SEARCH_PX = 3.0
"""The best trackable point is sought within the feature's scale, at least this far from its centre
and at most three times as far."""


def move_to_trackable(
    grey: Image,
    view: Equirectangular,
    matches: BearingMatches,
    features: tuple[OmniFeatures, OmniFeatures],
) -> tuple[IntArray, FloatArray, BearingMatches]:
    """Replaces features by trackable points.

    Args:
        grey: (height, width - 1) view of the start image; its rows continue over the seam.
        view: its camera.
        matches: of start and target.
        features: of start and target, those that the matches index.

    Returns:
        Rows (m,) of ``matches`` that have such a point, the points (m, 2) in the view, and the
        matches (m) of the points.
    """
    if not len(matches):
        return np.empty(0, dtype=np.int64), np.empty((0, 2)), matches
    radius = _search_radius(matches, features[0], view)
    centres = _in_view(matches, view)
    strength = _strength(grey, WINDOW_PX)
    points, strongest = _best_near(strength, centres, radius)
    rim = max(WINDOW_PX, PATCH_PX) / 2.0
    good = (strongest >= MIN_EIGENVALUE) & (points[:, 1] >= rim)
    good &= points[:, 1] <= view.height - 1 - rim
    good &= _distinct(points, strongest, DISTINCT_PX)
    rows = np.flatnonzero(good)
    ratio = _scale_ratio(matches, *features)
    moved = _moved(matches, points - centres, ratio, view)
    chosen = points[rows]
    chosen[:, 0] %= view.width - 1
    return rows, chosen, moved.select(rows)


def _search_radius(
    matches: BearingMatches, features: OmniFeatures, view: Equirectangular
) -> FloatArray:
    """(n,) pixels: a feature's own size, within bounds."""
    a_radian = (view.width - 1) / (2.0 * np.pi)
    size = np.zeros(len(matches))
    sift = matches.kind == int(FeatureKind.SIFT)
    size[sift] = features.sift.scale[matches.index_a[sift]] * a_radian
    return np.clip(size, _SEARCH_PX, 3.0 * _SEARCH_PX)


def _in_view(matches: BearingMatches, view: Equirectangular) -> FloatArray:
    """(n, 2) pixels of the features in the start's view."""
    columns = (np.pi - matches.bearing_a) * (view.width - 1) / (2.0 * np.pi)
    a_row = (view.top_elevation - view.bottom_elevation) / (view.height - 1)
    return np.column_stack([columns, (view.top_elevation - matches.elevation_a) / a_row])


def _strength(grey: Image, window: int) -> FloatArray:
    """(h, w) smaller eigenvalue of eq. 2, a pixel of the window; the seam is continued."""
    padded = cv2.copyMakeBorder(grey, 0, 0, window, window, cv2.BORDER_WRAP)
    strength = cv2.cornerMinEigenVal(padded, window, ksize=3)
    return np.asarray(strength[:, window:-window], dtype=np.float64)


def _best_near(
    strength: FloatArray, centres: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Strongest whole pixel within a radius of each centre, and its strength; -1 where none is."""
    height, period = strength.shape
    reach = int(np.ceil(np.max(radius)))
    down, across = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    nearest = np.rint(centres).astype(np.int64)
    rows = nearest[:, 1, None] + down.ravel()
    columns = nearest[:, 0, None] + across.ravel()
    distance = np.hypot(columns - centres[:, :1], rows - centres[:, 1:])
    inside = (rows >= 0) & (rows < height) & (distance <= radius[:, None])
    value = strength[np.clip(rows, 0, height - 1), columns % period]
    value = np.where(inside, value, -1.0)
    best = np.argmax(value, axis=1)
    at = np.arange(len(centres))
    points = np.column_stack([columns[at, best], rows[at, best]]).astype(np.float64)
    return points, value[at, best]


def _distinct(points: FloatArray, strength: FloatArray, apart: float) -> BoolArray:
    """(n,) the strongest of each cluster of points; of equals the first."""
    kept = np.zeros(len(points), dtype=np.bool_)
    free = np.ones(len(points), dtype=np.bool_)
    near = np.hypot(*(points[:, None] - points).transpose(2, 0, 1)) < apart
    for k in np.argsort(-strength, kind="stable"):
        if free[k]:
            kept[k] = True
            free &= ~near[k]
    return kept


def _scale_ratio(matches: BearingMatches, a: OmniFeatures, b: OmniFeatures) -> FloatArray:
    """(n,) size of a feature in the target over its size in the start image."""
    ratio = np.ones(len(matches))
    sift = matches.kind == int(FeatureKind.SIFT)
    of_a, of_b = matches.index_a[sift], matches.index_b[sift]
    ratio[sift] = b.sift.scale[of_b] / a.sift.scale[of_a]
    of_a, of_b = matches.index_a[~sift], matches.index_b[~sift]
    length_a, length_b = np.ptp(a.columns.tangents[of_a], 1), np.ptp(b.columns.tangents[of_b], 1)
    ratio[~sift] = length_b / length_a
    return ratio


def _moved(
    matches: BearingMatches,
    offset: FloatArray,
    ratio: FloatArray,
    view: Equirectangular,
) -> BearingMatches:
    """Matches of points at pixel offsets (n, 2) from the features."""
    a_column = 2.0 * np.pi / (view.width - 1)
    a_row = (view.top_elevation - view.bottom_elevation) / (view.height - 1)
    left, up = -offset[:, 0] * a_column, -offset[:, 1] * a_row
    # The point is a pixel of the start image, known as well as a track; in the target it has the
    # feature's own uncertainty, and that of its offset.
    off_plane = _PLANE_ERROR * ratio * np.hypot(left, up)
    sigma = matches.sigma.copy()
    sigma[:, 0], sigma[:, 1] = SIGMA_PX * a_column, SIGMA_PX * a_row
    sigma[:, 2:] = np.hypot(sigma[:, 2:], off_plane[:, None])
    return replace(
        matches,
        bearing_a=wrap(matches.bearing_a + left),
        elevation_a=matches.elevation_a + up,
        bearing_b=wrap(matches.bearing_b + ratio * left),
        elevation_b=matches.elevation_b + ratio * up,
        sigma=sigma,
    )
