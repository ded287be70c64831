"""The rendered house as a world to act in: images, ranges, driving, truth, and target images.

Everything random comes from the world's seed: the same seed and the same commands give the same
bytes. What is asked for does not change what comes later: an image's noise depends on the seed and
the time alone.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.cameras.omni.mirrors import HyperbolicMirror
from fgslam.cameras.omni.panoramas import Equirectangular
from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.worlds.buildings.house import DEPTH, WIDTH, build_house
from fgslam.worlds.driving.floor_space import FloorSpace
from fgslam.worlds.driving.range_scan import RangeSensor
from fgslam.worlds.driving.reference_paths import PathPlanner
from fgslam.worlds.driving.wheelchair import RADIUS_M, Wheelchair
from fgslam.worlds.house import disturbances
from fgslam.worlds.house.people import PERSON_RADIUS, People
from fgslam.worlds.house.settings import (
    HouseCameraSettings,
    HousePanoramaSettings,
    OmniHouseSettings,
)
from fgslam.worlds.rendering.colour_textures import build_colour_library
from fgslam.worlds.rendering.lighting import bake
from fgslam.worlds.rendering.patches import stack
from fgslam.worlds.rendering.raycaster import RayCaster
from fgslam.worlds.rendering.renderer import Renderer, surface_points, visible
from fgslam.worlds.rendering.scene import Layer
from fgslam.worlds.rendering.texture_bank import ColourBank
from fgslam.worlds.rendering.views import OmniView

# Coarser than in the lab: the mirror's pixels are wider.
_LIGHT_SPACING_M = 0.2
# Smoothing a border costs four rays a pixel: weaker contrast, summed over the three channels, is
# not worth it.
_EDGE_CONTRAST = 24.0
_PEOPLE_STEPS, _PEOPLE_STEP_M, _PEOPLE_CLEARANCE_M = 16, 0.7, 0.45
CAMERA_HEIGHT_M = 1.2
"""Of the viewpoint above the floor: on a pole behind the passenger's head."""
# Of the straight line from a target to the next: the wheelchair's radius and a hand more each side.
_PATH_CLEARANCE_M = 0.55
# Nearer than this to an obstacle's coarse distance, contact is decided exactly; metres.
_CONTACT_M = 0.06
# Between the mirror's rim and the nearest border of the image.
_MARGIN_PX = 0.5


class HouseModel:
    """The house itself, the same for all worlds in it; safe to share, never changed.

    Attributes:
        house: things, lamps and doors.
        space: where the wheelchair can stand.
        layer: the scene in full light, ready to be shaded; ``evening``: its other light.
        bank: all textures.
    """

    def __init__(self, seed: int) -> None:
        """Builds everything, some seconds. Raises MissingDependencyError without Open3D."""
        self.house = build_house(np.random.default_rng([seed, 2]))
        patches = stack(self.house.things)
        caster = RayCaster(patches)
        self.bank = ColourBank(build_colour_library(np.random.default_rng([seed, 1])))
        lamps = self.house.lamps
        lights = [
            bake(patches, caster, chosen, np.random.default_rng([seed, 3]), _LIGHT_SPACING_M)
            for chosen in (lamps, lamps[::2])
        ]
        self.layer = Layer(patches, caster, lights[0], self.bank)
        self.evening = lights[1].values
        self.space = FloorSpace(patches, np.zeros(2), np.array([WIDTH, DEPTH]))


@lru_cache(maxsize=2)
def open_house(seed: int) -> HouseModel:
    """The house, kept for the next world in it (some 100 MB each)."""
    return HouseModel(seed)


def make_house_camera(settings: HouseCameraSettings) -> OmniCamera:
    """The camera model that images of the house obey.

    Raises:
        CalibrationError: the mirror cannot show what is asked for.
    """
    if isinstance(settings, HousePanoramaSettings):
        return Equirectangular(settings.width, settings.height)
    bottom, top = np.deg2rad([settings.bottom_elevation_deg, settings.top_elevation_deg])
    size = (settings.width, settings.height)
    return HyperbolicMirror.with_view(
        size, settings.xi, (float(bottom), float(top)), margin_px=_MARGIN_PX
    )


class OmniWorld:
    """A wheelchair with an omnidirectional camera in the house.

    Attributes:
        settings: as given.
        camera: the model that the images obey.
        reference_poses: (legs + 1, 3) planar poses of the path; the first is the start.
        wheelchair: the vehicle, with its truth.
    """

    def __init__(self, settings: OmniHouseSettings, seed: int) -> None:
        """Opens the house, lays the reference path and puts the wheelchair at its start.

        Raises:
            DatasetError: no reference path of that kind is found.
            MissingDependencyError: Open3D cannot be loaded.
        """
        self.settings, self._seed = settings, seed
        self.model = open_house(settings.house_seed)
        self.camera: OmniCamera = make_house_camera(settings.camera)
        self._renderer = Renderer(OmniView(self.camera), self.model.bank, _EDGE_CONTRAST)
        planner = PathPlanner(self.model.space, _PATH_CLEARANCE_M)
        within = None if settings.path.rooms == "house" else settings.path.rooms
        self.reference_poses = planner.reference_path(
            settings.path.spacing_m, settings.path.legs, self._rng(0), within
        )
        self._people = People(
            self._people_routes(), self._rng(1), self.model.bank, self._lets_people_stand
        )
        self._tilt = disturbances.CameraTilt(settings.tilt, self._rng(2))
        self._sensor = RangeSensor(self.model.layer.caster)
        self._scene = disturbances.lit(self.model.layer, self.model.evening, settings.light)
        self.put(self.reference_poses[0])

    # ---------------------------------------------------------------------------- acting

    def put(self, pose: FloatArray) -> None:
        """Puts the wheelchair elsewhere (3,), standing still: all begins anew at time 0."""
        self.wheelchair = Wheelchair(self.settings.wheelchair, pose, self._rng(3), self._touches)
        self._scan_rng = self._rng(4)
        self._people.restart()

    def drive(self, speed: float, turn_rate: float, dt: float) -> None:
        """Commands (m/s, rad/s) and lets ``dt`` seconds pass for everybody."""
        self.wheelchair.command(speed, turn_rate)
        self.wheelchair.advance(dt)
        self._people.advance(dt, self.wheelchair.pose[:2])

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self.wheelchair.time

    @property
    def true_pose(self) -> FloatArray:
        """(3,) planar pose in the house."""
        return self.wheelchair.pose.copy()

    @property
    def collided(self) -> bool:
        """Whether an obstacle stopped the wheelchair in the last :meth:`drive`."""
        return self.wheelchair.collided

    # ---------------------------------------------------------------------------- sensing

    def image(self, time: float) -> Image:
        """(h, w, 3) red, green, blue from where the wheelchair is.

        Args:
            time: seconds, for exposure, swaying and noise.
        """
        s = self.settings
        tilt = self._tilt.angles(time)
        pose = disturbances.camera_pose(self.wheelchair.pose, CAMERA_HEIGHT_M, tilt)
        levels = self._renderer.levels(self._scene, pose, self._people.bodies())
        levels *= disturbances.white_balance(s.light)
        levels = disturbances.exposed(levels, s.exposure, time)
        name = (self._seed, 1, round(abs(time) * 1e6))
        return self._renderer.assemble(disturbances.noisy(levels, s.noise_grey, name))

    def scan(self) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) in the robot's axes, radians, and ranges (n,), metres."""
        places = self._people.places()
        discs = np.column_stack([places, np.full(len(places), PERSON_RADIUS)])
        return self._sensor.scan(self.wheelchair.pose, discs, self._scan_rng)

    # ---------------------------------------------------------------------------- targets

    @property
    def target_poses(self) -> FloatArray:
        """(legs, 3) where the target images were taken."""
        return self.reference_poses[1:].copy()

    @cached_property
    def targets(self) -> tuple[Image, ...]:
        """The target images, taken at another time: other light and noise, nobody about."""
        tilt = disturbances.CameraTilt(self.settings.tilt, self._rng(5))
        return tuple(
            self.picture(pose, k, tilt.angles(10.0 * k)) for k, pose in enumerate(self.target_poses)
        )

    def picture(self, pose: FloatArray, number: int, tilt: FloatArray | None = None) -> Image:
        """(h, w, 3) as target images are taken, from any planar pose (3,); ``number`` seeds it."""
        s = self.settings
        scene = disturbances.lit(self.model.layer, self.model.evening, s.target_light)
        upright = np.zeros(2) if tilt is None else tilt
        seen_from = disturbances.camera_pose(pose, CAMERA_HEIGHT_M, upright)
        levels = self._renderer.levels(scene, seen_from)
        levels *= disturbances.white_balance(s.target_light)
        levels = disturbances.exposed(levels, s.target_exposure, 0.0)
        name = (self._seed, 2, number)
        return self._renderer.assemble(disturbances.noisy(levels, s.noise_grey, name))

    # ---------------------------------------------------------------------------- truth

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) metres from places (n, 2) to the nearest obstacle of the house."""
        return self.model.space.clearance(points)

    @property
    def outlines(self) -> tuple[FloatArray, ...]:
        """Lines (2, 2) of walls and furniture from above, metres."""
        return tuple(self.model.space.outlines)

    def seen(self, pose: FloatArray, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points (n, 3) from an untilted pose (3,), and whether they show."""
        return visible(self.model.layer, self.camera, self._untilted(pose), points)

    def points(self, pose: FloatArray, pixels: FloatArray) -> FloatArray:
        """(n, 3) what pixels (n, 2) show from an untilted pose (3,); NaN outside the field."""
        return surface_points(self.model.layer, self.camera, self._untilted(pose), pixels)

    def ranges(self, pose: FloatArray) -> FloatArray:
        """(h, w) distance from the viewpoint in metres, from an untilted pose (3,)."""
        return self._renderer.distances(self.model.layer, self._untilted(pose))

    def _untilted(self, pose: FloatArray) -> FloatArray:
        return disturbances.camera_pose(pose, CAMERA_HEIGHT_M, np.zeros(2))

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, 100 + stream])

    def _people_routes(self) -> list[FloatArray]:
        """A walk for each person between places of the reference path, so that they are met."""
        if self.settings.people == 0:
            return []
        planner = PathPlanner(self.model.space, _PEOPLE_CLEARANCE_M)
        rng, places = self._rng(6), self.reference_poses[:, :2]
        routes = []
        for _ in range(self.settings.people):
            tour = [*rng.permutation(places), *rng.permutation(places)]
            route = planner.walk(tour, _PEOPLE_STEP_M, _PEOPLE_STEPS, rng)
            routes.append(places if route is None else route)
        return routes

    def _lets_people_stand(self, places: FloatArray) -> BoolArray:
        return self.clearance(places) > PERSON_RADIUS

    def _touches(self, place: FloatArray) -> bool:
        people = self._people.places()
        if len(people):
            away = np.linalg.norm(people - place, axis=1)
            before = np.linalg.norm(people - self.wheelchair.pose[:2], axis=1)
            # Whoever walks into the wheelchair does not glue it to the spot.
            if bool(np.any((away < RADIUS_M + PERSON_RADIUS) & (away < before))):
                return True
        return self.model.space.touches(place, RADIUS_M, _CONTACT_M)
