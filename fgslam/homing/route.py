"""Which images of a drive become path images: few, but each seen well from the one before.

From the last path image on, later images are compared with it. As long as enough features are
common and the direction between both places is known well, the way may be left to one leg; where
that ends, the last image for which it held becomes the next path image. A leg is driven straight:
it ends, too, where the way that was driven bends away from it. An image with too little parallax
adds nothing and is passed over. So the spacing follows the place: far apart in a hall,
near each other at a corner. Images are taken in once, in their order; of a film that moves slowly
only some are looked at.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fgslam.cameras.omni import OmniCamera
from fgslam.cameras.omni_files import KnownCamera, storable
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import BearingMatches, OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.errors import StoredMapError
from fgslam.core.geometry import circular_median, is_rigid, wrap
from fgslam.core.store import FileKind, require_covariances, require_finite
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.vector import pair_generator
from fgslam.homing.active import parallax
from fgslam.homing.features import CoarseFeatures, Votes, compacted
from fgslam.homing.front_end import compare_views, unusable
from fgslam.homing.settings import FrontEndSettings

COMMON = 80
"""Features that two neighbouring path images must share. A third of them is left in 20 kB and from
next to the path; homing needs eight."""

DIRECTION_DEG = 4.0  # deviation of the direction from one path image to the next
PARALLAX_DEG = 2.0
"""Median of the common features between two path images; below, one of both is superfluous: the
direction between them would depend on noise."""

_BEND = 0.2
"""Of the straight line between two path images, in its length, that the way between them may keep
away: 0.4 m on a leg of 2 m, half the corridor that a wheelchair needs."""
_BEND_SIGMAS = 2.0  # by which it must be farther

_MISSES = 3  # images one after another without enough in common end a leg: one may be blurred
_SKIPPED = 0.15  # of the images since the last path image: so many are passed over unseen
_WEIGHT_BEFORE = 1.0  # vote of the path image before, against all votes of the images after it

START, FULL, BEND, GAP, END = "start", "common features", "bend", "gap", "end"


@dataclass(frozen=True, slots=True)
class TaughtImage:
    """Why an image became a path image, and what it has in common with the one before.

    Attributes:
        number: of the image in the recording.
        name: its name.
        reason: ``start`` and ``end`` of the recording; ``common features``: the last one with
            enough of them in common with the path image before; ``bend``: the last one to which
            the way was straight; ``gap``: it has too little in common, and there is none between.
        common: inliers of the homing vector from the path image before; 0 where it is refused.
        parallax_deg: their median parallax.
        direction_deg: of this image from the one before; NaN where it is not known.
        sigma_deg: its deviation.
        refusal: why there is no homing vector; empty where there is one.
    """

    number: int
    name: str
    reason: str
    common: int = 0
    parallax_deg: float = float("nan")
    direction_deg: float = float("nan")
    sigma_deg: float = float("nan")
    refusal: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Taught:
    """A path, and how its images were chosen.

    Attributes:
        memory: the path.
        rows: one a path image.
        seen: images that were compared.
        unusable: images that were too dark, empty or not to be read, in words.
    """

    memory: PathMemory
    rows: tuple[TaughtImage, ...]
    seen: int
    unusable: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    number: int
    name: str
    features: OmniFeatures


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """A later image against the last path image."""

    view: _View
    row: TaughtImage
    inliers: BearingMatches | None
    near: bool
    bent: bool = False

    @property
    def enough(self) -> bool:
        """Whether both could be neighbours on the path."""
        return self.common and not self.bent

    @property
    def common(self) -> bool:
        """Whether one can be seen well from the other."""
        if self.row.common < COMMON:
            return self.near
        return self.row.parallax_deg < PARALLAX_DEG or self.row.sigma_deg <= DIRECTION_DEG

    @property
    def apart(self) -> bool:
        """Whether it lies far enough from the last path image to be one."""
        return not self.near and self.row.parallax_deg >= PARALLAX_DEG


@dataclass(slots=True, eq=False)
class _Leg:
    """What was seen since the last path image."""

    begin: _View
    votes: Votes
    way: list[TaughtImage] = field(default_factory=list)
    best: _Compared | None = None
    misses: list[_Compared] = field(default_factory=list)


class Teacher:
    """Takes the images of a drive in their order, and keeps the path images.

    Attributes:
        next: number of the next image that is worth having; those before it may be left unread.
    """

    def __init__(self, camera: OmniCamera, settings: FrontEndSettings, seed: int = 0) -> None:
        """Begins before the first image."""
        self._camera, self._settings, self._seed = camera, settings, seed
        self._extractor = OmniFeatureExtractor(camera, settings.features)
        self._leg: _Leg | None = None
        self._last: _View | None = None
        self._kept: list[tuple[_View, OmniFeatures]] = []
        self._rows: list[TaughtImage] = []
        self._unusable: list[str] = []
        self._seen = 0
        self.next = 0

    @property
    def begun(self) -> bool:
        """Whether an image could be used so far: the path has a beginning."""
        return self._leg is not None

    def take(self, number: int, name: str, image: Image) -> None:
        """Looks at one more image (height, width, 3). Raises FrameError if not the camera's."""
        features = self._extractor.extract(image)
        self.next = number + 1
        self._seen += 1
        refusal = unusable(image, features)
        if refusal is not None:
            self._unusable.append(f"{name}: {refusal.details}")
        else:
            self._last = _View(number, name, features)
            self._look(self._last)

    def leave_out(self, number: int, why: str) -> None:
        """Goes on after an image that could not be read, or is not the camera's."""
        self._unusable.append(why)
        self.next = number + 1

    def finish(self) -> Taught:
        """The path; its last image is the last one seen that lies apart from the one before.

        Raises:
            StoredMapError: not one image could be used.
        """
        while self._leg is not None and self._leg.misses:
            for view in self._end_leg(self._leg):
                self._compare(self._leg, view)
        if self._leg is None:
            why = f" ({self._unusable[0]})" if self._unusable else ""
            raise StoredMapError(f"path: no image that can be used{why}; give at least one")
        self._go_to_the_end(self._leg)
        self._keep(self._leg)
        names = [view.name for view, _ in self._kept]
        memory = PathMemory.of([found for _, found in self._kept], names, self._camera)
        return Taught(memory, tuple(self._rows), self._seen, tuple(self._unusable))

    # ----------------------------------------------------------------------------------------

    def _look(self, view: _View) -> None:
        if self._leg is None:
            self._rows.append(TaughtImage(view.number, view.name, START))
            self._leg = _Leg(view, Votes.none(view.features))
            return
        waiting = deque([view])
        while waiting:
            self._compare(self._leg, waiting.popleft())
            if len(self._leg.misses) >= _MISSES:
                waiting.extendleft(reversed(self._end_leg(self._leg)))
        since = view.number - self._leg.begin.number
        self.next = view.number + 1 + (0 if self._leg.misses else int(_SKIPPED * since))

    def _compare(self, leg: _Leg, view: _View) -> None:
        found = self._compared(leg.begin, view)
        if found.inliers is not None:
            leg.votes = leg.votes.plus(found.inliers, 1.0, second=False)
            found = replace(found, bent=found.apart and _bends(leg.way, found.row))
            leg.way.append(found.row)
        if not found.enough:
            leg.misses.append(found)
            return
        leg.misses.clear()
        if found.apart:
            leg.best = found

    def _end_leg(self, leg: _Leg) -> list[_View]:
        """Begins the next leg at the best image, else at the first that has too little in common.

        Returns:
            Later images, to be compared with it.
        """
        misses = [miss.view for miss in leg.misses]
        first = leg.misses[0]
        if leg.best is not None:
            self._begin(leg.best, BEND if first.common else FULL)
            return [view for view in misses if view.number > leg.best.view.number]
        self._begin(first, BEND if first.common else GAP)
        return misses[1:]

    def _go_to_the_end(self, leg: _Leg) -> None:
        """Makes the last image the path's last one, or the last that lies apart from the others."""
        if leg.best is not None and self._last is not None and leg.best.view is not self._last:
            self._begin(leg.best, FULL)
            leg.best = self._compared(leg.best.view, self._last)
        if leg.best is not None and leg.best.apart:
            self._begin(leg.best, END)

    def _begin(self, chosen: _Compared, reason: str) -> None:
        if self._leg is not None:
            self._keep(self._leg)
        row = chosen.row
        self._rows.append(
            TaughtImage(
                row.number, row.name, reason, row.common, row.parallax_deg, row.direction_deg,
                row.sigma_deg, row.refusal,
            )
        )  # fmt: skip
        votes = Votes.none(chosen.view.features)
        if chosen.inliers is not None:
            votes = votes.plus(chosen.inliers, _WEIGHT_BEFORE, second=True)
        self._leg = _Leg(chosen.view, votes)

    def _keep(self, leg: _Leg) -> None:
        self._kept.append((leg.begin, compacted(leg.begin.features, leg.votes)))

    def _compared(self, first: _View, view: _View) -> _Compared:
        rng = pair_generator(self._seed, first.number, view.number)
        vector, matches = compare_views(first.features, view.features, self._settings, rng)
        if isinstance(vector, Refusal):
            row = TaughtImage(view.number, view.name, "", refusal=vector.details)
            return _Compared(view, row, None, is_near(vector, matches))
        inliers = matches.select(vector.inliers)
        return _Compared(view, _row_of(view, vector, inliers), inliers, False)


def is_near(refusal: Refusal, matches: BearingMatches) -> bool:
    """Whether there is no homing vector because there is no way to speak of, only a turn."""
    if refusal.reason in (RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN):
        turn = circular_median(wrap(matches.bearing_a - matches.bearing_b))
        return bool(parallax(matches, turn) < np.deg2rad(PARALLAX_DEG))
    return refusal.reason is RefusalReason.AT_TARGET


def _row_of(view: _View, vector: TwoViewVector, inliers: BearingMatches) -> TaughtImage:
    return TaughtImage(
        number=view.number,
        name=view.name,
        reason="",
        common=len(inliers),
        parallax_deg=float(np.rad2deg(parallax(inliers, vector.rotation))),
        direction_deg=float(np.rad2deg(vector.direction)),
        sigma_deg=float(np.rad2deg(np.sqrt(vector.covariance[0, 0]))),
    )


def _bends(way: Sequence[TaughtImage], end: TaughtImage) -> bool:
    """Whether images on the way lie clearly off the straight line to the image at its end.

    Their distances are those of their parallax, in parts of the line: about, but that is enough.
    """
    if not way:
        return False
    seen = np.array([[one.parallax_deg, one.direction_deg, one.sigma_deg] for one in way])
    far = seen[:, 0] / end.parallax_deg
    turned = np.deg2rad(seen[:, 1] - end.direction_deg)
    along, across = far * np.cos(turned), far * np.sin(turned)
    off = np.hypot(along - np.clip(along, 0.0, 1.0), across)
    sigma = far * np.deg2rad(np.hypot(seen[:, 2], end.sigma_deg))
    # Nearer the line is noise: the legs on both sides of a bend must have their parallax.
    least = max(_BEND, 2.0 * PARALLAX_DEG / end.parallax_deg)
    return bool(np.any(off - _BEND_SIGMAS * sigma > least))


def with_neighbours_votes(
    images: Sequence[OmniFeatures], settings: FrontEndSettings, seed: int = 0
) -> list[OmniFeatures]:
    """What is kept of path images that were chosen by the caller: what neighbours show, too."""
    votes = [Votes.none(one) for one in images]
    for k in range(len(images) - 1):
        rng = pair_generator(seed, k, k + 1)
        vector, matches = compare_views(images[k], images[k + 1], settings, rng)
        if isinstance(vector, TwoViewVector):
            inliers = matches.select(vector.inliers)
            votes[k] = votes[k].plus(inliers, 1.0, second=False)
            votes[k + 1] = votes[k + 1].plus(inliers, 1.0, second=True)
    return [compacted(one, vote) for one, vote in zip(images, votes, strict=True)]


# --------------------------------------------------------------------------------------------
# A path as it is remembered: the features of its images, in order, and nothing else


@dataclass(frozen=True, slots=True, eq=False)
class MetricPoses:
    """Poses of path images, as SLAM on the same drive found them.

    Attributes:
        poses: (n, 4, 4) ``wTc`` of a camera of the SLAM run; NaN where not known.
        covariances: (n, 6, 6) in the tangent space at them; NaN where not known.
    """

    poses: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PathMemory:
    """Target images of a path.

    Attributes:
        images: their features, in the order in which they are to be reached.
        names: of the images, for people; as many.
        camera: that took them; None where it is not known.
        metric: their poses; None where there are none.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]
    camera: OmniCamera | None = None
    metric: MetricPoses | None = None

    @staticmethod
    def of(
        images: Sequence[OmniFeatures],
        names: Sequence[str] | None = None,
        camera: OmniCamera | None = None,
    ) -> PathMemory:
        """A memory; images without names are numbered.

        Raises:
            StoredMapError: there is not one name an image.
        """
        chosen = (
            tuple(str(k) for k in range(len(images))) if names is None else tuple(map(str, names))
        )
        if len(chosen) != len(images):
            raise StoredMapError(
                f"path: {len(chosen)} names for {len(images)} images; give one name an image"
            )
        return PathMemory(tuple(images), chosen, camera)

    def __len__(self) -> int:
        return len(self.images)

    def save(self, path: str | Path) -> float:
        """Writes the memory atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
            CalibrationError: the camera is a model of the user's own.
        """
        return FILE.save(path, StoredPath.of(self)) / 1000.0 / max(len(self), 1)

    @staticmethod
    def load(path: str | Path) -> PathMemory:
        """Reads a memory; pixel positions of features are NaN.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        return FILE.load(path).memory()


@dataclass(frozen=True, slots=True, eq=False)
class StoredPath:
    """A path memory as files keep it."""

    images: tuple[CoarseFeatures, ...]
    names: tuple[str, ...]
    camera: KnownCamera | None
    metric: MetricPoses | None

    @staticmethod
    def of(memory: PathMemory) -> StoredPath:
        """The memory, rounded. Raises CalibrationError: the camera is a user's own model."""
        images = tuple(CoarseFeatures.of(image) for image in memory.images)
        return StoredPath(images, memory.names, storable(memory.camera), memory.metric)

    def memory(self) -> PathMemory:
        """The memory back."""
        images = tuple(image.features() for image in self.images)
        return PathMemory(images, self.names, self.camera, self.metric)

    def require_sound(self) -> None:
        """Raises ValueError for names or poses of other images, and poses that SLAM cannot find."""
        if len(self.names) != len(self.images):
            raise ValueError("not one name an image")
        for k, one in enumerate(self.images):
            for values in (one.sift.colour, one.columns.tangents, one.columns.descriptors):
                require_finite(f"features of image {k}", values)
        if self.metric is None:
            return
        poses, covariances, n = self.metric.poses, self.metric.covariances, len(self.images)
        if poses.shape != (n, 4, 4) or covariances.shape != (n, 6, 6):
            raise ValueError("metric poses: not one an image")
        if not all(is_rigid(pose) for pose in poses if not np.isnan(pose).all()):
            raise ValueError("metric poses: one is no rigid motion")
        known = covariances[~np.isnan(covariances).all(axis=(1, 2))]
        require_covariances("metric poses", known, definite=False)


PACKED = "biufU"
"""Kinds of arrays that are compressed: floats, too, as theirs end in zeros."""

FILE = FileKind(
    StoredPath,
    "fgslam path memory",
    version=4,
    error=StoredMapError,
    give="give a file that holds one, as fgslam teach writes it",
    again="write it again",
    check=StoredPath.require_sound,
    packed=PACKED,
)
