"""Path following by a robot that may be anywhere: homings, and the place on the path.

With tracks the chain of homings drives, and the place is looked for only while the next path image
is not matched: at the start, after the robot was carried off, when a leg is given up. Without
tracks every image is looked at, and its homing vector is the command.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import ByteArray
from fgslam.core.checks import later_time
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import Refusal, RefusalReason
from fgslam.frontend.features.omni_features import OmniFeatureExtractor
from fgslam.homing.command import Command, HomingState, PathPlace
from fgslam.homing.front_end import unusable
from fgslam.homing.path_following import HomingChain
from fgslam.homing.path_memory import PathMemory
from fgslam.homing.path_places import PathPlaces
from fgslam.homing.settings import FrontEndSettings

_SEEKING = (HomingState.INITIALISE, HomingState.WAIT, HomingState.SEARCH, HomingState.REFUSED)
_LOOK_EVERY_S = 0.5  # while the next path image is not matched
_GIVE_UP_S = 10.0  # of looks after a leg was given up, until the path is


class GuidedHoming:
    """A chain of homings that knows its place on the path.

    Attributes:
        chain: the homings.
    """

    def __init__(
        self,
        chain: HomingChain,
        path: PathMemory,
        front_end: tuple[OmniCamera, FrontEndSettings, int],
        *,
        tracks: bool,
    ) -> None:
        """Begins before the first image.

        Args:
            chain: fresh; of the same path.
            path: taught.
            front_end: camera of the images, settings, and the seed of everything random.
            tracks: whether the chain drives.
        """
        camera, settings, seed = front_end
        self.chain = chain
        self._tracks, self._last = tracks, len(path) - 1
        self._extractor = OmniFeatureExtractor(camera, settings.features)
        self._places = PathPlaces(path, settings, seed)
        self._time: float | None = None
        self._next_look = -np.inf
        self._given_up_at: float | None = None
        self._ended: Command | None = None

    @property
    def finished(self) -> bool:
        """Whether the path's end is reached, or the path given up."""
        return self._ended is not None

    def step(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        """The command after one more image, and its place if that was looked for.

        Raises:
            EstimatorError: time does not increase; nothing has changed then.
        """
        self._time = later_time(time, self._time, "homing", EstimatorError)
        if self._ended is not None:
            return replace(self._ended, time=time), None if self._tracks else self._where(image)
        command, place = self._tracked(image, time) if self._tracks else self._looked(image, time)
        if self._is_end(command):
            self._ended = command
        return command, place

    def _is_end(self, command: Command) -> bool:
        if not self._tracks:
            return command.state is HomingState.ARRIVED
        if self.chain.given_up:
            began = self._given_up_at
            return began is not None and command.time - began > _GIVE_UP_S
        return self.chain.finished

    # ----------------------------------------------------------------------------------------

    def _tracked(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        command = self.chain.step(image, time)
        if command.state not in _SEEKING:
            self._given_up_at = None
            return command, None
        if self.chain.given_up and self._given_up_at is None:
            self._given_up_at = time
        if time < self._next_look:
            return command, None
        self._next_look = time + _LOOK_EVERY_S
        place = self._place(image)
        if isinstance(place, Refusal):
            return command, None
        known = place.sure and place.vector is not None
        if known and (self.chain.given_up or place.target != self.chain.target):
            self.chain.aim(place.target, time, f"found near path image {place.nearest}")
            self._given_up_at = None
            command = self.chain.step(image, time)
        return command, place

    def _looked(self, image: ByteArray, time: float) -> tuple[Command, PathPlace | None]:
        place = self._place(image)
        if isinstance(place, Refusal):
            return _standing(time, place), None
        target, final = place.target, place.target == self._last
        if place.reached:
            arrived = _standing(time, Refusal(RefusalReason.AT_TARGET, "reached the path's end"))
            state = HomingState.ARRIVED
            return replace(arrived, state=state, target=target, refusal=None), place
        if place.vector is None:
            why = _standing(time, Refusal(RefusalReason.LOST, place.refusal))
            return replace(why, target=target, final=final), place
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

    def _where(self, image: ByteArray) -> PathPlace | None:
        """The place of an image after the end: a recording may go on."""
        place = self._place(image)
        return None if isinstance(place, Refusal) else place

    def _place(self, image: ByteArray) -> PathPlace | Refusal:
        features = self._extractor.extract(image)
        refusal = unusable(image, features)
        return self._places.look(features) if refusal is None else refusal


def _standing(time: float, refusal: Refusal) -> Command:
    return Command(
        time=time,
        state=HomingState.WAIT,
        heading=0.0,
        remaining=1.0,
        rotation=float("nan"),
        covariance=np.full((3, 3), np.nan),
        stop=True,
        reason=refusal.details,
        refusal=refusal,
    )
