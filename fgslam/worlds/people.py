"""People in the rendered places: their bodies, a walk across the view, walkers in the house.

Those of the house wait for the robot and turn back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import CameraRig
from fgslam.worlds.driving import FRAME_RATE_HZ, Drive, planar_poses
from fgslam.worlds.patches import (
    Patch,
    RayCaster,
    Surface,
    Thing,
    box,
    placed,
    prism,
    stack,
)
from fgslam.worlds.renderer import Body, Layer, flat_light
from fgslam.worlds.settings import LabSettings
from fgslam.worlds.textures import SHIRTS, ColourBank

_STRIDE_M = 1.3
_THIGH, _SHIN, _UPPER_ARM, _FOREARM = 0.43, 0.42, 0.29, 0.27
_HIP, _SHOULDER = 0.90, 1.42
# Beyond the edge of the view at which the walk begins and ends, metres.
_MARGIN_M = 0.45
ACROSS_M = 1.8  # before the camera, at the middle of the walk: nearer than most of the lab
WALK_FRAMES = 12  # of the walk, its first and last frame included


@dataclass(frozen=True, slots=True)
class Stance:
    """Where a person is: position and heading in the room (metres, radians), and the way walked."""

    x: float
    y: float
    heading: float
    way: float


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A straight walk: from ``start`` (2,) to ``end`` (2,) between two times in seconds."""

    start: FloatArray
    end: FloatArray
    begins: float
    ends: float

    def stance(self, seconds: float) -> Stance | None:
        """The person at a time, or None before and after the walk."""
        if not self.begins <= seconds <= self.ends:
            return None
        part = (seconds - self.begins) / (self.ends - self.begins)
        step = self.end - self.start
        x, y = self.start + part * step
        length = float(np.linalg.norm(step))
        return Stance(float(x), float(y), float(np.arctan2(step[1], step[0])), part * length)


def make_walk(settings: LabSettings, drive: Drive, rig: CameraRig) -> Walk | None:
    """The walk across the view that the settings ask for, or None.

    From the right of the view at the middle of the walk to its left, square to its axis.

    Raises:
        ConfigError: the drive is over before the person comes.
    """
    first, frames = settings.effects.person, len(drive.timestamps)
    if first is None:
        return None
    if first >= frames:
        raise ConfigError(
            f"effects.person is {first}, but the drive has only {frames} frames; lower it"
        )
    begins, ends = first / FRAME_RATE_HZ, (first + WALK_FRAMES - 1) / FRAME_RATE_HZ
    camera = (drive.body_poses(np.array([0.5 * (begins + ends)]))[0] @ rig.bTc)[:3]
    right, ahead = camera[:2, 0], camera[:2, 2] / np.linalg.norm(camera[:2, 2])
    middle = camera[:2, 3] + ACROSS_M * ahead
    half = ACROSS_M * rig.width / 2.0 / rig.fx + _MARGIN_M
    return Walk(middle + half * right, middle - half * right, begins, ends)


def person(stance: Stance, shirt: str = "shirt") -> Thing:
    """The body at a stance; the gait follows from the way walked."""
    phase = 2.0 * np.pi * stance.way / _STRIDE_M
    parts = _trunk(shirt)
    for side in (-1.0, 1.0):
        swing = float(np.sin(phase)) * side
        lift = max(0.0, float(np.cos(phase)) * side)
        for root, turns, lengths, radii, textures in (
            ((0.0, 0.09 * side, _HIP), (0.45 * swing, -0.7 * lift), (_THIGH, _SHIN),
             (0.075, 0.055), ("trousers", "trousers")),
            ((0.0, 0.21 * side, _SHOULDER), (-0.4 * swing, 0.5), (_UPPER_ARM, _FOREARM),
             (0.05, 0.042), (shirt, "skin")),
        ):  # fmt: skip
            (x, y, z), angle = root, 0.0  # two bars, swung by the first angle, bent by the second
            for turn, length, radius, texture in zip(turns, lengths, radii, textures, strict=True):
                angle += turn
                end = (x + length * float(np.sin(angle)), y, z - length * float(np.cos(angle)))
                parts += prism(end, (x, y, z), radius, Surface(texture, 0.4))
                x, y, z = end
    turned = placed(parts, stance.x, stance.y, 0.0, float(np.rad2deg(stance.heading)))
    return Thing("person", tuple(turned))


def _trunk(shirt_texture: str) -> list[Patch]:
    """Torso, neck, head and hair; the body walks towards +x."""
    shirt, skin, hair = (
        Surface(shirt_texture, 0.5),
        Surface("skin", 0.3),
        Surface("plain_dark", 0.3),
    )
    torso = prism((0, 0, _HIP - 0.05), (0, 0, _SHOULDER + 0.04), 0.19, shirt, 12)
    flat = np.array([0.62, 1.0, 1.0])  # a torso is wider than deep
    out = [Patch(p.corner * flat, p.edge_u * flat, p.edge_v * flat, shirt) for p in torso]
    out += box((-0.06, -0.21, _SHOULDER - 0.03), (0.06, 0.21, _SHOULDER + 0.05), shirt)
    out += prism((0, 0, _SHOULDER), (0, 0, 1.55), 0.055, skin)
    out += prism((0, 0, 1.52), (0, 0, 1.74), 0.088, skin, 12)
    out += prism((0, 0, 1.66), (0, 0, 1.78), 0.097, hair, 12)
    return out


# --------------------------------------------------------------------------------------------
# Walking about in the house


PERSON_RADIUS = 0.3
_BODY_RADIUS = 0.6
_SPEED = 0.8
_PHASES = 16
# Nearer to the robot a person stops, and after waiting that long turns back.
_POLITE_M, _PATIENCE_S = 1.1, 2.0
_AHEAD_M = 0.3


class Walker:
    """One person on a polyline, walking to its end and back; waits for the robot, then turns."""

    def __init__(self, route: FloatArray, start: float) -> None:
        """On ``route`` (n, 2), ``start`` metres from its beginning."""
        self._route = route
        self._length = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))]
        )
        self._at, self._sign = float(start % self._length[-1]), 1.0
        self._walked, self._waited, self._heading = 0.0, 0.0, 0.0
        self._face_ahead()

    def stance(self) -> Stance:
        """Where the person is now."""
        x, y = self._place(self._at)
        return Stance(float(x), float(y), self._heading, self._walked)

    def advance(self, seconds: float, robot: FloatArray) -> None:
        """Walks on unless the robot (2,) is in the way."""
        here, ahead = self._place(self._at), self._place(self._at + _AHEAD_M * self._sign)
        nearest = float(np.linalg.norm(ahead - robot))
        if nearest < _POLITE_M and nearest <= np.linalg.norm(here - robot):
            self._waited += seconds
            if self._waited > _PATIENCE_S:
                self._waited, self._sign = 0.0, -self._sign
        else:
            self._waited = 0.0
            self._walked += _SPEED * seconds
            self._at += _SPEED * seconds * self._sign
            if not 0.0 <= self._at <= self._length[-1]:
                self._at = float(np.clip(self._at, 0.0, self._length[-1]))
                self._sign = -self._sign
        self._face_ahead()

    def _face_ahead(self) -> None:
        ahead = self._place(self._at + _AHEAD_M * self._sign) - self._place(self._at)
        if np.any(ahead != 0.0):  # at the very end of the route the heading stays
            self._heading = float(np.arctan2(ahead[1], ahead[0]))

    def _place(self, at: float) -> FloatArray:
        return np.array([np.interp(at, self._length, self._route[:, k]) for k in (0, 1)])


class People:
    """All who walk about; the renderer's bodies and the range sensor's discs."""

    def __init__(
        self, routes: Sequence[FloatArray], rng: np.random.Generator, bank: ColourBank
    ) -> None:
        """One person on each route (n, 2), starting somewhere on it."""
        self._starts = [(route, float(rng.uniform(0.0, 100.0))) for route in routes]
        self._shirts = [int(k) for k in rng.integers(0, SHIRTS, len(routes))]
        self._bank = bank
        self._layers: dict[tuple[int, int], Layer] = {}
        self.restart()

    def restart(self) -> None:
        """Everybody is again where the first walk began."""
        self._walkers = [Walker(route, start) for route, start in self._starts]

    def advance(self, seconds: float, robot: FloatArray) -> None:
        """Everybody walks on."""
        for walker in self._walkers:
            walker.advance(seconds, robot)

    def places(self) -> FloatArray:
        """(n, 2) where they are."""
        stances = [walker.stance() for walker in self._walkers]
        return np.array([[s.x, s.y] for s in stances]).reshape(-1, 2)

    def bodies(self) -> list[Body]:
        """As the renderer takes them."""
        out = []
        for walker, shirt in zip(self._walkers, self._shirts, strict=True):
            stance = walker.stance()
            phase = int(stance.way / _STRIDE_M * _PHASES) % _PHASES
            pose = planar_poses(np.array([[stance.x, stance.y, stance.heading]]))[0]
            out.append(Body(self._layer(phase, shirt), pose, _BODY_RADIUS))
        return out

    def _layer(self, phase: int, shirt: int) -> Layer:
        """The body in its own frame at one of the gait's phases; kept, as building it is slow."""
        if (phase, shirt) not in self._layers:
            body = person(Stance(0.0, 0.0, 0.0, phase * _STRIDE_M / _PHASES), f"shirt_{shirt}")
            patches = stack([body])
            light = flat_light(patches, np.array([0.0, 0.0, 1.0]))
            self._layers[phase, shirt] = Layer(patches, RayCaster(patches), light, self._bank)
        return self._layers[phase, shirt]
