"""A person who walks through the view: a moving, articulated, textured body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import CameraRig
from fgslam.worlds.driving.paths import PosesInTime
from fgslam.worlds.lab.settings import LabPersonSettings, LabSettings
from fgslam.worlds.rendering.patches import Patch, Surface, Thing, box, placed, prism

_STRIDE_M = 1.3
_THIGH, _SHIN, _UPPER_ARM, _FOREARM = 0.43, 0.42, 0.29, 0.27
_HIP, _SHOULDER = 0.90, 1.42
# Beyond the edge of the view at which the walk begins and ends, metres.
_MARGIN_M = 0.45


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


def make_walk(settings: LabSettings, drive: PosesInTime, rig: CameraRig) -> Walk | None:
    """The walk across the view that the settings ask for, or None.

    Raises:
        ConfigError: the drive is over before the person comes.
    """
    person_settings = settings.effects.person
    if person_settings is None:
        return None
    stamps = drive.timestamps
    if person_settings.first_frame >= len(stamps):
        raise ConfigError(
            f"effects.person.first_frame is {person_settings.first_frame}, but the drive has only "
            f"{len(stamps)} frames; lower it"
        )
    return across_view(person_settings, drive, rig, settings.drive.frame_rate_hz)


def across_view(
    settings: LabPersonSettings, drive: PosesInTime, rig: CameraRig, frame_rate: float
) -> Walk:
    """From the right of the view at the middle of the walk to its left, square to its axis."""
    begins = settings.first_frame / frame_rate
    ends = (settings.first_frame + settings.frames - 1) / frame_rate
    camera = (drive.body_poses(np.array([0.5 * (begins + ends)]))[0] @ rig.bTc)[:3]
    right, ahead = camera[:2, 0], camera[:2, 2] / np.linalg.norm(camera[:2, 2])
    middle = camera[:2, 3] + settings.distance_m * ahead
    half = settings.distance_m * rig.width / 2.0 / rig.fx + _MARGIN_M
    return Walk(middle + half * right, middle - half * right, begins, ends)


def person(stance: Stance) -> Thing:
    """The body at a stance; the gait follows from the way walked."""
    phase = 2.0 * np.pi * stance.way / _STRIDE_M
    parts = _trunk()
    for side in (-1.0, 1.0):
        swing = float(np.sin(phase)) * side
        lift = max(0.0, float(np.cos(phase)) * side)
        parts += _limb(
            (0.0, 0.09 * side, _HIP), (0.45 * swing, -0.7 * lift), (_THIGH, _SHIN),
            (0.075, 0.055), ("trousers", "trousers"),
        )  # fmt: skip
        parts += _limb(
            (0.0, 0.21 * side, _SHOULDER), (-0.4 * swing, 0.5), (_UPPER_ARM, _FOREARM),
            (0.05, 0.042), ("shirt", "skin"),
        )  # fmt: skip
    turned = placed(parts, stance.x, stance.y, 0.0, float(np.rad2deg(stance.heading)))
    return Thing("person", tuple(turned))


def _trunk() -> list[Patch]:
    """Torso, neck, head and hair; the body walks towards +x."""
    shirt, skin, hair = Surface("shirt", 0.5), Surface("skin", 0.3), Surface("plain_dark", 0.3)
    out = _flattened(prism((0, 0, _HIP - 0.05), (0, 0, _SHOULDER + 0.04), 0.19, shirt, 12), 0.62)
    out += box((-0.06, -0.21, _SHOULDER - 0.03), (0.06, 0.21, _SHOULDER + 0.05), shirt)
    out += prism((0, 0, _SHOULDER), (0, 0, 1.55), 0.055, skin)
    out += prism((0, 0, 1.52), (0, 0, 1.74), 0.088, skin, 12)
    out += prism((0, 0, 1.66), (0, 0, 1.78), 0.097, hair, 12)
    return out


def _flattened(patches: list[Patch], factor: float) -> list[Patch]:
    """Narrower along x: a torso is wider than deep."""
    scale = np.array([factor, 1.0, 1.0])
    return [Patch(p.corner * scale, p.edge_u * scale, p.edge_v * scale, p.surface) for p in patches]


def _limb(
    root: tuple[float, float, float],
    angles: tuple[float, float],
    lengths: tuple[float, float],
    radii: tuple[float, float],
    textures: tuple[str, str],
) -> list[Patch]:
    """Two bars hanging from ``root``: swung forward by the first angle, bent by the second."""
    out: list[Patch] = []
    x, y, z = root
    angle = 0.0
    for turn, length, radius, texture in zip(angles, lengths, radii, textures, strict=True):
        angle += turn
        end = (x + length * float(np.sin(angle)), y, z - length * float(np.cos(angle)))
        out += prism(end, (x, y, z), radius, Surface(texture, 0.4))
        x, y, z = end
    return out
