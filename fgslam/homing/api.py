"""Homing as a library: the vector between two images, teaching a path, following it.

The tasks ``homing_pairs`` and ``path_following`` run the same parts; nothing is estimated here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fgslam.backend.homing.estimators import homing_settings_of, make_homing_estimator
from fgslam.backend.settings import HomingEstimatorKind
from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import ByteArray, Image
from fgslam.core.bearings import OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.checks import is_finite_number, later_time, require_seed
from fgslam.core.errors import (
    CalibrationError,
    ConfigError,
    EstimatorError,
    FrameError,
    SessionError,
    StoredMapError,
)
from fgslam.core.settings import make_settings
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.features.sift import colour_image
from fgslam.frontend.homing.vector import pair_generator, vector_between
from fgslam.frontend.settings import HomingVectorSettings, OmniFeatureSettings
from fgslam.homing.controller import HomingChain, LegOutcome
from fgslam.homing.front_end import make_front_end, unusable
from fgslam.homing.places import PathPlaces
from fgslam.homing.route import PathMemory, Teacher, with_neighbours_votes
from fgslam.homing.settings import DRIVING, FrontEndSettings, HomingBehaviourSettings
from fgslam.homing.steering import Command, Drive, DriveCommand, HomingState, PathPlace, Steering


class HomingVector:
    """The homing vector between two omnidirectional images (Goedemé et al. 2005, section III)."""

    def __init__(
        self,
        camera: OmniCamera,
        *,
        features: OmniFeatureSettings | None = None,
        seed: int = 0,
        **settings: Any,
    ) -> None:
        """Prepares the features' views for one camera.

        Args:
            camera: of all images, see :func:`fgslam.load_camera`.
            features: extraction and matching; None: the defaults.
            seed: of RANSAC's samples; the same images then give the same answer.
            settings: of :class:`fgslam.frontend.settings.HomingVectorSettings`, as under
                ``homing_vector`` of an experiment: ``samples=1000``.

        Raises:
            CalibrationError: ``camera`` is none.
            ConfigError: a setting is unknown or out of its bounds.
        """
        self._camera = _require_camera(camera, "HomingVector")
        require_seed(seed, "HomingVector")
        self._features = _require_features(features, "HomingVector")
        self._settings = make_settings(HomingVectorSettings, settings, "HomingVector")
        self._seed = seed
        self._extractor = OmniFeatureExtractor(camera, self._features)

    def between(self, image_a: npt.ArrayLike, image_b: npt.ArrayLike) -> TwoViewVector | Refusal:
        """Direction and rotation from the place of image a to that of image b.

        Bearings are counter-clockwise from the heading of a. The distance is not known: the scale
        of images is not. Both kinds of answer can be asked: ``if answer:`` is true of a vector,
        with ``direction``, ``rotation`` (radians), ``covariance`` (2, 2) of both and ``inliers``,
        and false of a refusal, with ``reason`` and ``details``. Its reason ``AT_TARGET`` means that
        both images are from one place, and ``rotation`` how they are turned.

        Args:
            image_a: (height, width, 3) RGB or (height, width) grey uint8; the present image.
            image_b: likewise; the target.

        Raises:
            FrameError: an image is not this camera's.
        """
        size = (self._camera.width, self._camera.height)
        images = colour_image(image_a, size, "image_a"), colour_image(image_b, size, "image_b")
        a, b = map(self._extractor.extract, images)
        for image, found in zip(images, (a, b), strict=True):
            refusal = unusable(image, found)
            if refusal is not None:
                return refusal
        rng = pair_generator(self._seed, 0, 1)
        return vector_between(a, b, self._features.matching, self._settings, rng)[0]


def teach(
    images: Iterable[npt.ArrayLike],
    camera: OmniCamera,
    *,
    names: Sequence[str] | None = None,
    features: OmniFeatureSettings | None = None,
    select: bool = False,
) -> PathMemory:
    """The path along target images: their features in order, to be followed or saved.

    Of each image 300 SIFT features and 100 column segments are kept, 20 kB in a file: those that
    its neighbours show, too, and the strongest all around.

    Args:
        images: (height, width, 3) RGB or (height, width) grey uint8, in the order in which they
            are to be reached; about 2 m apart in rooms.
        camera: that took them.
        names: one an image, for people; None numbers them.
        features: extraction; None: the defaults.
        select: the images are a drive's, near each other, as of a film; few of them are chosen by
            what they have in common (:mod:`fgslam.homing.route`).

    Raises:
        CalibrationError: ``camera`` is none.
        FrameError: an image is not this camera's.
        StoredMapError: there is no image, not one name an image, or, but for a drive's, an image
            is dark or shows nothing.
        ConfigError: ``features`` are no settings.
    """
    size = (_require_camera(camera, "teach").width, camera.height)
    if not isinstance(images, Iterable):
        raise FrameError(f"teach: the images are a {type(images).__name__}; give a list of arrays")
    if not isinstance(select, bool):
        raise ConfigError(f"teach: select is a {type(select).__name__}; give True or False")
    front_end = replace(DRIVING, features=_require_features(features, "teach"))
    given = (colour_image(image, size, f"image {k}") for k, image in enumerate(images))
    if select:
        teacher = Teacher(camera, front_end)
        passed_over: tuple[int, str, Image] | None = None
        k = -1
        for k, image in enumerate(given):
            if names is not None and k >= len(names):
                raise StoredMapError(f"path: {len(names)} names for more images; give one an image")
            passed_over = (k, str(k) if names is None else names[k], image)
            if k >= teacher.next:
                teacher.take(*passed_over)
                passed_over = None
        if names is not None and len(names) != k + 1:
            raise StoredMapError(f"path: {len(names)} names for {k + 1} images; give one an image")
        if passed_over is not None:  # the last one is the path's end
            teacher.take(*passed_over)
        return teacher.finish().memory
    extractor = OmniFeatureExtractor(camera, front_end.features)
    found = [_recognisable(image, k, extractor) for k, image in enumerate(given)]
    if not found:
        raise StoredMapError("path: no target image; give at least one")
    return PathMemory.of(with_neighbours_votes(found, front_end), names, camera)


def _recognisable(image: Image, number: int, extractor: OmniFeatureExtractor) -> OmniFeatures:
    """Features of a target image. Raises StoredMapError where it cannot be recognised."""
    features = extractor.extract(image)
    refusal = unusable(image, features)
    if refusal is not None:
        raise StoredMapError(
            f"path: image {number} cannot be recognised ({refusal.details}); leave it out"
        )
    return features


_SEEKING = (HomingState.INITIALISE, HomingState.WAIT, HomingState.SEARCH, HomingState.REFUSED)
_LOOK_EVERY_S = 0.5  # while the next path image is not matched
_GIVE_UP_S = 10.0  # of tries after a leg was abandoned, until the path is


class PathFollower:
    """Drives along a taught path: an image in, speed and turning rate out.

    The robot may be put down anywhere on the path, be carried off, or lose it: while the
    next path image is not matched, its place is sought among all of them.

    Followers share nothing: any number of them work side by side. Used as a context manager it is
    closed at the end.
    """

    def __init__(
        self,
        camera: OmniCamera,
        path: PathMemory,
        estimator: str | HomingEstimatorKind = "homing_graph",
        *,
        behaviour: HomingBehaviourSettings | None = None,
        front_end: FrontEndSettings = DRIVING,
        seed: int = 0,
        by: Literal["tracks", "looks"] = "tracks",
    ) -> None:
        """Begins before the first target.

        Args:
            camera: of the robot; the path may have been taught with another one.
            path: of :func:`fgslam.teach`, or loaded.
            estimator: its kind (``homing_graph``, ``homing_ekf``, ``paper_ekf``, ``alv``,
                ``snapshot``) or its settings; used with tracks.
            behaviour: control, steering (largest speed), skipping of targets; None: the defaults.
            front_end: features, matching, tracking.
            seed: of RANSAC's samples; the same images then give the same commands.
            by: ``tracks``: features are matched once a leg and tracked from then on, ten images a
                second; ``looks``: every image is matched with the path again, at any rate, whatever
                drives: of a recording, say.

        Raises:
            CalibrationError: ``camera`` is none.
            ConfigError: there is no such estimator, or no such way to follow, or settings are none.
            StoredMapError: ``path`` is none.
        """
        if not isinstance(path, PathMemory):
            raise StoredMapError(
                f"PathFollower: the path is a {type(path).__name__}; make it by "
                "fgslam.teach(images, camera), or load it by fgslam.PathMemory.load(file)"
            )
        self._camera = _require_camera(camera, "PathFollower")
        require_seed(seed, "PathFollower")
        if by not in ("tracks", "looks"):
            raise ConfigError(f"PathFollower: by is {by!r}; give 'tracks' or 'looks'")
        settings = homing_settings_of(estimator)
        behaviour = HomingBehaviourSettings() if behaviour is None else behaviour
        for given, kind in ((behaviour, HomingBehaviourSettings), (front_end, FrontEndSettings)):
            _require_kind(given, kind, "PathFollower")
        self._chain = HomingChain(
            make_front_end(camera, front_end, seed),
            path.images,
            lambda start: make_homing_estimator(start, settings),
        )
        self._tracks, self._last = by == "tracks", len(path) - 1
        self._extractor = OmniFeatureExtractor(camera, front_end.features)
        self._places = PathPlaces(path, front_end, seed)
        self._next_look = -np.inf
        self._given_up_at: float | None = None
        self._ended: Command | None = None
        self._steering = Steering(behaviour.steering)
        self._longest_step = 1.0 / behaviour.loop.images_per_s
        self._time: float | None = None
        self._closed = False

    def step(self, image: npt.ArrayLike, time: float) -> DriveCommand:
        """The command after one more image; it holds until the next one.

        Args:
            image: (height, width, 3) RGB or (height, width) grey uint8 from where the robot is.
            time: seconds, later than that of the image before.

        Raises:
            SessionError: the follower is closed.
            EstimatorError: the time is not finite, or not later. Nothing has changed then, nor by:
            FrameError: the image is not this camera's.
        """
        self._require_open()
        seconds = self._elapsed(time)
        size = (self._camera.width, self._camera.height)
        command, place = self._guided(colour_image(image, size), float(time))
        drive = self._steering.step(command, seconds)
        self._time = float(time)
        return DriveCommand(drive.speed, drive.turn_rate, command, place)

    def driven(self, v: float, omega: float, seconds: float) -> None:
        """Reports that the robot drove otherwise than commanded, as obstacle avoidance makes it.

        The time does not count as lack of progress, and the steering starts from this speed.

        Args:
            v: speed, m/s.
            omega: turning rate, rad/s, counter-clockwise.
            seconds: since the last command.

        Raises:
            SessionError: the follower is closed.
            EstimatorError: a number is not finite, or the time is negative.
        """
        self._require_open()
        if not all(map(is_finite_number, (v, omega, seconds))) or seconds < 0.0:
            raise EstimatorError(
                f"PathFollower: driven({v!r}, {omega!r}, {seconds!r}); give finite numbers, and a "
                "time that is not negative"
            )
        self._steering.driven(Drive(v, omega, overridden=True))
        self._chain.held_up(seconds)

    @property
    def finished(self) -> bool:
        """Whether the last target is reached, or the path abandoned."""
        return self._ended is not None

    @property
    def legs(self) -> tuple[LegOutcome, ...]:
        """How each leg that is over ended, in order."""
        return tuple(self._chain.outcomes)

    def close(self) -> None:
        """Ends it; the present leg, if any, ends unfinished."""
        if not self._closed and self._time is not None:
            self._chain.interrupt(self._time, "closed")
        self._closed = True

    def __enter__(self) -> PathFollower:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ----------------------------------------------------------------------------------------
    # With tracks the chain of homings drives, and the place is looked for only while the next path
    # image is not matched: at the start, after the robot was carried off, when a leg is abandoned.
    # Without tracks every image is looked at, and its homing vector is the command.

    def _guided(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        """The command after one more image, and its place if that was looked for."""
        if self._ended is not None:
            now = None if self._tracks else self._place(image)  # a recording may go on
            return replace(self._ended, time=time), None if isinstance(now, Refusal) else now
        command, place = self._tracked(image, time) if self._tracks else self._looked(image, time)
        if not self._tracks:
            over = command.state is HomingState.ARRIVED
        elif self._chain.given_up:
            over = self._given_up_at is not None and time - self._given_up_at > _GIVE_UP_S
        else:
            over = self._chain.finished
        if over:
            self._ended = command
        return command, place

    def _tracked(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        command = self._chain.step(image, time)
        if command.state not in _SEEKING:
            self._given_up_at = None
            return command, None
        if self._chain.given_up and self._given_up_at is None:
            self._given_up_at = time
        if time < self._next_look:
            return command, None
        self._next_look = time + _LOOK_EVERY_S
        place = self._place(image)
        if isinstance(place, Refusal):
            return command, None
        known = place.sure and place.vector is not None
        if known and (self._chain.given_up or place.target != self._chain.target):
            self._chain.aim(place.target, time, f"found near path image {place.nearest}")
            self._given_up_at = None
            command = self._chain.step(image, time)
        return command, place

    def _looked(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        place = self._place(image)
        if isinstance(place, Refusal):
            return Command(time, HomingState.WAIT, place.details, refusal=place), None
        target, final = place.target, place.target == self._last
        if place.reached:
            reason = "reached the path's end"
            return Command(time, HomingState.ARRIVED, reason, target=target), place
        if place.vector is None:
            lost = Refusal(RefusalReason.LOST, place.refusal)
            why = time, HomingState.WAIT, place.refusal
            return Command(*why, target=target, final=final, refusal=lost), place
        covariance = np.full((3, 3), np.nan)
        covariance[1:, 1:] = place.vector.covariance
        command = Command(
            time=time,
            state=HomingState.DRIVE,
            heading=place.vector.direction,
            remaining=place.remaining,
            rotation=place.vector.rotation,
            covariance=covariance,
            stop=False,
            reason=f"{place.vector.support} inliers",
            target=target,
            final=final,
        )
        return command, place

    def _place(self, image: ByteArray) -> PathPlace | Refusal:
        features = self._extractor.extract(image)
        refusal = unusable(image, features)
        return self._places.look(features) if refusal is None else refusal

    def _require_open(self) -> None:
        if self._closed:
            raise SessionError("PathFollower: it is closed; make a new one with the same path")

    def _elapsed(self, time: float) -> float:
        """Seconds since the last image, as far as steering may rely on the next one being near."""
        seconds = later_time(time, self._time, "PathFollower", EstimatorError)
        if self._time is None:
            return self._longest_step
        return min(seconds - self._time, self._longest_step)


def _require_camera(camera: OmniCamera, who: str) -> OmniCamera:
    if not all(hasattr(camera, name) for name in ("width", "height", "rays", "pixels")):
        raise CalibrationError(
            f"{who}: the camera is a {type(camera).__name__}; load one by "
            "fgslam.load_camera(file), or give keys of one to it"
        )
    return camera


def _require_features(settings: OmniFeatureSettings | None, who: str) -> OmniFeatureSettings:
    chosen = OmniFeatureSettings() if settings is None else settings
    _require_kind(chosen, OmniFeatureSettings, who)
    return chosen


def _require_kind(settings: object, kind: type, who: str) -> None:
    """Raises ConfigError where settings are of another kind."""
    if not isinstance(settings, kind):
        raise ConfigError(
            f"{who}: settings are a {type(settings).__name__}; give a {kind.__module__}."
            f"{kind.__name__}, or None for the defaults"
        )
