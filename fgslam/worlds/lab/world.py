"""The rendered world: place, light, cameras, and the person, put together from the settings."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgslam.core import geometry
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.worlds.lab.person import Stance, person
from fgslam.worlds.lab.places import PlaceChoice, build_place, build_textures
from fgslam.worlds.lab.settings import LabRigSettings
from fgslam.worlds.rendering.lighting import bake, flat_light
from fgslam.worlds.rendering.patches import stack
from fgslam.worlds.rendering.raycaster import RayCaster
from fgslam.worlds.rendering.renderer import Renderer
from fgslam.worlds.rendering.scene import Body, Layer
from fgslam.worlds.rendering.texture_bank import GreyBank
from fgslam.worlds.rendering.views import PinholeView

Float32 = npt.NDArray[np.float32]


def make_rig(settings: LabRigSettings) -> CameraRig:
    """The calibrated cameras that the settings describe."""
    focal = settings.width / 2.0 / np.tan(np.deg2rad(settings.horizontal_fov_deg) / 2.0)
    tilt = np.deg2rad(settings.tilt_deg)
    bTc = geometry.BODY_FORWARD_LEFT_UP_FROM_CAMERA @ geometry.pose(
        geometry.so3_exp(np.array([tilt, 0.0, 0.0])), np.zeros(3)
    )
    bTc[:3, 3] = settings.ahead_m, settings.aside_m, settings.above_m
    return CameraRig(
        width=settings.width,
        height=settings.height,
        fx=float(focal),
        fy=float(focal),
        cx=(settings.width - 1) / 2.0,
        cy=(settings.height - 1) / 2.0,
        baseline=settings.baseline_m,
        vertical_baseline=settings.vertical_baseline_m,
        bTc=bTc,
    )


def camera_offsets(rig: CameraRig) -> list[FloatArray]:
    """Poses (4, 4) of right, left[, top] camera in the reference camera's frame."""
    offsets = [(0.0, 0.0, 0.0), (-rig.baseline, 0.0, 0.0)]
    if rig.vertical_baseline is not None:
        offsets.append((0.0, -rig.vertical_baseline, 0.0))
    return [geometry.pose(np.eye(3), np.array(offset)) for offset in offsets]


class Room:
    """A furnished place with its light and textures, as at one visit; the same for every rig.

    Attributes:
        low, high: (2,) corners of the floor, metres.
        things: name of each object identity; the person's is the last.
        caster: of the room without the person.
        bank: all textures, the person's among them.
        layer: the room, ready to be shaded.
    """

    def __init__(self, choice: PlaceChoice) -> None:
        """Builds textures, furniture and light.

        Raises:
            ConfigError: there is no such place.
            MissingDependencyError: Open3D is absent.
        """
        place = build_place(choice)
        patches = stack(place.things)
        self.low, self.high = place.low, place.high
        self.things = (*(thing.name for thing in place.things), "person")
        self.caster = RayCaster(patches)
        self.bank = GreyBank(build_textures(choice))
        rng = np.random.default_rng([choice.seed, 3])
        spacing, reach = place.light_spacing_m, place.light_reach_m
        light = bake(patches, self.caster, place.lamps, rng, spacing, reach)
        self.layer = Layer(patches, self.caster, light, self.bank)


@lru_cache(maxsize=2)
def open_room(choice: PlaceChoice) -> Room:
    """The place, kept for the next sequence that is rendered in it (some 70 MB each)."""
    return Room(choice)


class World:
    """A room seen by a rig's cameras; safe to share between threads."""

    def __init__(self, rig: CameraRig, room: Room) -> None:
        self.room = room
        view = PinholeView((rig.height, rig.width), rig.fx, rig.cx, rig.cy)
        self._renderer = Renderer(view, room.bank)

    def bodies(self, stance: Stance | None) -> list[Body]:
        """The person standing in the room where there is one."""
        if stance is None:
            return []
        patches = stack([person(stance)], first_thing=len(self.room.things) - 1)
        light = flat_light(patches, np.array([0.3, -0.2, 1.0]))
        layer = Layer(patches, RayCaster(patches), light, self.room.bank)
        return [Body(layer, np.eye(4), np.inf)]

    def image(self, pose: FloatArray, bodies: list[Body]) -> Float32:
        """(h, w) grey levels, not yet rounded, from a camera's pose (4, 4) in the room."""
        return self._renderer.image(self.room.layer, pose, bodies)[..., 0]

    def depth(self, pose: FloatArray, bodies: list[Body]) -> FloatArray:
        """(h, w) exact depth Z in metres at pixel centres; infinite for nothing."""
        return self._renderer.distances(self.room.layer, pose, bodies)

    def object_ids(self, pose: FloatArray, bodies: list[Body]) -> IntArray:
        """(h, w) index into ``room.things`` at pixel centres; -1 for nothing."""
        return self._renderer.things(self.room.layer, pose, bodies)
