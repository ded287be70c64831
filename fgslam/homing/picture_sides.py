"""Whether pictures fit a route only when they are mirrored or turned over.

Descriptors of a mirrored picture fit nothing, or what looks alike by chance, and homing vectors
then point anywhere. So the first pictures are compared with the route both as they are and as they
would be if a side was mistaken: what they have in common with a path image tells which is right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np

from fgslam.cameras.omni import Equirectangular, LensCamera, OmniCamera, RadialCamera
from fgslam.core.arrays import Image
from fgslam.core.homing import OmniFeatures
from fgslam.frontend.features.omni_features import OmniFeatureExtractor
from fgslam.homing.continuity import in_common
from fgslam.homing.front_end import compare_views
from fgslam.homing.path_memory import PathMemory
from fgslam.homing.retrieval import VisualWords
from fgslam.homing.settings import FrontEndSettings

Turn: TypeAlias = Callable[[Image], Image]

_CANDIDATES = 6  # path images that a picture is compared with: those that look most alike
_CLEARLY = 2.0  # times the features in common; what looks alike by chance varies by its root
_AGREEING = 3  # pictures that tell the same
_STREAM = 10  # of the seed's random numbers


@dataclass(frozen=True, slots=True, eq=False)
class Mistaken:
    """A way in which pictures may be other than stated.

    Attributes:
        said: what is wrong, and the mend.
        camera: with which they would be right.
        turn: that makes them right.
    """

    said: str
    camera: OmniCamera
    turn: Turn


class PictureSides:
    """Compares pictures with a route until it is clear which way they fit.

    Attributes:
        settled: whether a picture fits as it is, so that there is nothing more to ask.
    """

    def __init__(
        self, camera: OmniCamera, path: PathMemory, settings: FrontEndSettings, seed: int = 0
    ) -> None:
        """``camera`` is that of the pictures, as stated."""
        self._path, self._settings = path, settings
        self._rng = np.random.default_rng((seed, _STREAM))
        self._words = VisualWords(path.images, self._rng)
        stated = Mistaken("", camera, lambda image: image)
        self._ways = [stated, *_mistakes(camera)]
        self._extractors = [OmniFeatureExtractor(w.camera, settings.features) for w in self._ways]
        self._votes = np.zeros(len(self._ways), np.int64)
        self.settled = False

    def look(self, image: Image) -> str | None:
        """What is wrong with the pictures, once enough of them agree; None until then."""
        common = np.array([self._common(k, image) for k in range(len(self._ways))])
        best = int(np.argmax(common))
        if best == 0:
            self.settled = bool(common[0] > 0)
        elif common[best] > _CLEARLY * common[0]:
            self._votes[best] += 1
        return self._ways[best].said if self._votes[best] >= _AGREEING else None

    def _common(self, way: int, image: Image) -> int:
        """Features in common with the path image that has most of them, on one homing vector."""
        turned = np.ascontiguousarray(self._ways[way].turn(image))
        features = self._extractors[way].extract(turned)
        alike = np.argsort(-self._words.likeness(features), kind="stable")[:_CANDIDATES]
        return max(self._inliers(features, self._path.images[k]) for k in alike)

    def _inliers(self, features: OmniFeatures, target: OmniFeatures) -> int:
        answer, matches = compare_views(features, target, self._settings, self._rng)
        return in_common(answer, matches)


def _mistakes(camera: OmniCamera) -> list[Mistaken]:
    """What may be wrong with pictures of this camera."""
    mirrored = "mirrored left to right: mirror them back"
    out = [Mistaken(mirrored, camera, lambda image: image[:, ::-1])]
    if isinstance(camera, Equirectangular):
        over = "upside down: turn them by 180 degrees"
        out.append(Mistaken(over, camera, lambda image: image[::-1, ::-1]))
        flipped = "turned over top to bottom: turn them over again"
        out.append(Mistaken(flipped, camera, lambda image: image[::-1]))
    if isinstance(camera, LensCamera):
        other: OmniCamera = replace(camera, up=not camera.up)
        over = "of a camera that looks the other way: change its key middle"
        out.append(Mistaken(over, other, lambda image: image))
    if isinstance(camera, LensCamera | RadialCamera):
        otherwise = f"{mirrored}, or change the camera's key clockwise"
        out.append(Mistaken(otherwise, _turning_otherwise(camera), lambda image: image))
    return out


def _turning_otherwise(camera: LensCamera | RadialCamera) -> OmniCamera:
    if isinstance(camera, LensCamera):
        return replace(camera, clockwise=not camera.clockwise)
    frame = replace(camera.frame, clockwise=not camera.frame.clockwise)
    return cast(OmniCamera, replace(cast(Any, camera), frame=frame))
