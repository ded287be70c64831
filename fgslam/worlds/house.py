"""The rendered house as a world to act in: images, ranges, driving, truth, and target images.

Everything random comes from the world's seed: the same seed and the same commands give the same
bytes. What is asked for does not change what comes later: an image's noise depends on the seed and
the time alone.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from fgslam.cameras.omni import Equirectangular, HyperbolicMirror, OmniCamera
from fgslam.core.arrays import BoolArray, Float32, FloatArray, Image
from fgslam.worlds.driving import RADIUS_M, RangeSensor, Wheelchair
from fgslam.worlds.floor import FloorSpace, PathPlanner
from fgslam.worlds.patches import RayCaster, stack
from fgslam.worlds.people import PERSON_RADIUS, People
from fgslam.worlds.places import build_house
from fgslam.worlds.renderer import Layer, Renderer, bake, noisy, omni_view, surface_points, visible
from fgslam.worlds.settings import (
    HouseCalibrationSettings,
    HouseCameraSettings,
    OmniHouseSettings,
)
from fgslam.worlds.textures import ColourBank, build_colour_library

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
# The mirror, Goedemé et al. 2005: eccentricity of the unified model; elevations at the inner edge,
# below which the camera sees itself, and at its rim, which touches the image's border.
MIRROR_XI = 0.92
MIRROR_ELEVATIONS_DEG = (-65.0, 15.0)
# Between the mirror's rim and the nearest border of the image.
_MARGIN_PX = 0.5
# The target images are taken at another time of day.
_TARGET_LEVEL = 0.9  # a little darker
_TARGET_BALANCE = np.array([[1.04], [1.0], [1.0 - 0.04]], dtype=np.float32)
"""(3, 1) of red, green, blue: warmer."""
_EVENING_PART = 0.3  # in the evening's light every other lamp is off, and shadows fall otherwise
_GAIN = 1.25  # of the camera: brings the house's baked light to mid-grey
_WAVE_PERIOD_S = 20.0  # of the camera's automatic exposure


_SEED = 0  # of textures, furniture and light


class HouseModel:
    """The house itself, the same for all worlds in it; safe to share, never changed.

    Attributes:
        space: where the wheelchair can stand.
        layer: the scene in full light, ready to be shaded; ``evening``: its other light.
        bank: all textures.
    """

    def __init__(self) -> None:
        """Builds everything, some seconds. Raises MissingDependencyError without Open3D."""
        house = build_house(np.random.default_rng([_SEED, 2]))
        patches = stack(house.things)
        caster = RayCaster(patches)
        self.bank = ColourBank(build_colour_library(np.random.default_rng([_SEED, 1])))
        day, evening = (
            bake(patches, caster, lamps, np.random.default_rng([_SEED, 3]), house.light_spacing_m)
            for lamps in (house.lamps, house.lamps[::2])
        )
        self.layer = Layer(patches, caster, day, self.bank)
        self.evening = evening.values
        self.space = FloorSpace(patches, house.low, house.high)


@lru_cache(maxsize=1)
def open_house() -> HouseModel:
    """The house, kept for the next world in it (some 100 MB)."""
    return HouseModel()


def make_house_camera(settings: HouseCameraSettings) -> OmniCamera:
    """The camera model that images of the house obey.

    Raises:
        CalibrationError: the mirror cannot show what is asked for.
    """
    if settings.model == "equirectangular":
        width = settings.width or 1024
        return Equirectangular(width, width // 2)
    bottom, top = np.deg2rad(MIRROR_ELEVATIONS_DEG)
    width = settings.width or 320
    size = (width, width * 3 // 4)
    return HyperbolicMirror.with_view(
        size, MIRROR_XI, (float(bottom), float(top)), margin_px=_MARGIN_PX
    )


def miscalibrated(
    camera: OmniCamera, errors: HouseCalibrationSettings, rng: np.random.Generator
) -> OmniCamera:
    """The camera as the robot knows it: itself where there are no errors.

    The ring that shows the surroundings keeps its radii: the wrong centre moves it.
    """
    if errors == HouseCalibrationSettings():
        return camera
    assert isinstance(camera, HyperbolicMirror)  # noqa: S101 - as the settings have checked
    signs, side = rng.choice([-1.0, 1.0], 2), rng.uniform(0.0, 2.0 * np.pi)
    xi, focal = (1.0 + errors.mirror * signs) * (camera.xi, camera.focal_px)
    centre = camera.frame.centre + errors.centre_px * np.array([np.cos(side), np.sin(side)])
    frame = replace(camera.frame, centre=(float(centre[0]), float(centre[1])))
    return replace(camera, frame=frame, xi=float(xi), focal_px=float(focal))


class OmniWorld:
    """A wheelchair with an omnidirectional camera in the house.

    Attributes:
        settings: as given.
        camera: the model that the images obey.
        calibration: the model that the robot has of it.
        reference_poses: (legs + 1, 3) planar poses of the path; the first is the start.
        wheelchair: the vehicle, with its truth.
    """

    def __init__(self, settings: OmniHouseSettings, seed: int) -> None:
        """Opens the house, lays the reference path and puts the wheelchair at its start.

        Raises:
            CalibrationError: the camera cannot have the calibration's errors.
            DatasetError: no reference path of that kind is found.
            MissingDependencyError: Open3D cannot be loaded.
        """
        self.settings, self._seed = settings, seed
        self.model = open_house()
        self.camera: OmniCamera = make_house_camera(settings.camera)
        self.calibration = miscalibrated(self.camera, settings.calibration, self._rng(8))
        self._renderer = Renderer(omni_view(self.camera), self.model.bank, _EDGE_CONTRAST)
        self._planner = PathPlanner(self.model.space, _PATH_CLEARANCE_M)
        self.reference_poses = self._planner.reference_path(
            settings.path.spacing_m, settings.path.legs, self._rng(0)
        )
        self._people = People(self._people_routes(), self._rng(1), self.model.bank)
        self._tilt = camera_tilt(settings.tilt_deg, self._rng(2))
        self._sensor = RangeSensor(self.model.layer.caster)
        self.put(self.reference_poses[0])

    # ---------------------------------------------------------------------------- acting

    def put(self, pose: FloatArray) -> None:
        """Puts the wheelchair elsewhere (3,), standing still, and time begins again at 0."""
        self.wheelchair = Wheelchair(pose, self._rng(3), self._touches)
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
            time: seconds, for exposure and noise.
        """
        pose = camera_pose(self.wheelchair.pose, CAMERA_HEIGHT_M, self._tilt)
        levels = self._renderer.levels(self.model.layer, pose, self._people.bodies())
        # Automatic exposure follows the scene slowly.
        wave = np.sin(2.0 * np.pi * time / _WAVE_PERIOD_S)
        gain = _GAIN * (1.0 + self.settings.exposure_wave * wave)
        return self._exposed(levels, gain, 1, round(abs(time) * 1e6))

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
        """The target images, taken at another time: other light and noise, no people."""
        tilt = camera_tilt(self.settings.tilt_deg, self._rng(5))
        return tuple(self.picture(pose, k, tilt) for k, pose in enumerate(self.target_poses))

    def crossing_routes(self) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 3) and (m, 3) of two routes through the house that meet in its corridor.

        Raises:
            DatasetError: there are none with such legs.
        """
        return self._planner.crossing_routes(self.settings.path.spacing_m, self._rng(7))

    def picture(self, pose: FloatArray, number: int, tilt: FloatArray | None = None) -> Image:
        """(h, w, 3) as target images are taken, from any planar pose (3,); ``number`` seeds it."""
        day = (1.0 - _EVENING_PART) * self.model.layer.light
        light = _TARGET_LEVEL * (day + _EVENING_PART * self.model.evening)
        upright = np.zeros(2) if tilt is None else tilt
        seen_from = camera_pose(pose, CAMERA_HEIGHT_M, upright)
        scene = self.model.layer.lit(np.asarray(light, dtype=np.float32))
        levels = self._renderer.levels(scene, seen_from) * _TARGET_BALANCE
        return self._exposed(levels, _GAIN, 2, number)

    def _exposed(self, levels: Float32, gain: float, stream: int, number: int) -> Image:
        """(h, w, 3) of levels (3, n), with noise that seed, stream and number determine."""
        seen = np.asarray(levels * np.float32(gain))
        name = (self._seed, stream, number)
        return self._renderer.assemble(noisy(seen, self.settings.noise_grey, name))

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

    def _untilted(self, pose: FloatArray) -> FloatArray:
        return camera_pose(pose, CAMERA_HEIGHT_M, np.zeros(2))

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

    def _touches(self, place: FloatArray) -> bool:
        people = self._people.places()
        if len(people):
            away = np.linalg.norm(people - place, axis=1)
            before = np.linalg.norm(people - self.wheelchair.pose[:2], axis=1)
            # Whoever walks into the wheelchair does not glue it to the spot.
            if bool(np.any((away < RADIUS_M + PERSON_RADIUS) & (away < before))):
                return True
        return self.model.space.touches(place, RADIUS_M, _CONTACT_M)


def camera_tilt(degrees: float, rng: np.random.Generator) -> FloatArray:
    """(2,) roll about the forward axis and pitch about the left one, radians; the side is drawn."""
    side = float(rng.uniform(0.0, 2.0 * np.pi))
    return np.asarray(np.deg2rad(degrees) * np.array([np.cos(side), np.sin(side)]))


def camera_pose(pose: FloatArray, height: float, tilt: FloatArray) -> FloatArray:
    """(4, 4) pose of a camera at ``height`` metres above a planar pose (3,), tilted.

    ``tilt`` (2,) is roll about the robot's forward axis and pitch about its left one, in radians.
    """
    (cy, sy), (cr, sr), (cp, sp) = (
        (np.cos(angle), np.sin(angle)) for angle in (pose[2], tilt[0], tilt[1])
    )
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    out = np.eye(4)
    out[:3, :3] = yaw @ pitch @ roll
    out[:3, 3] = pose[0], pose[1], height
    return out
