"""People who walk to and fro in the house; they wait for the robot, or turn back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgslam.simulation.lighting import flat_light
from fgslam.simulation.omni.colour_bank import ColourBank
from fgslam.simulation.omni.colour_textures import SHIRTS
from fgslam.simulation.omni.mirror_renderer import Body
from fgslam.simulation.patches import Patch, Surface, Thing, stack
from fgslam.simulation.person import Stance, person
from fgslam.simulation.raycaster import RayCaster
from fgslam.simulation.renderer import Layer
from fgslam.types import FloatArray

PERSON_RADIUS = 0.3
_BODY_RADIUS = 0.6
_SPEED = 0.8
_STRIDE_M = 1.3
_PHASES = 16
# Nearer to the robot a person stops, and after waiting that long turns back.
_POLITE_M, _PATIENCE_S = 1.1, 2.0


class Walker:
    """One person on a polyline, walking to its end and back for ever."""

    def __init__(self, route: FloatArray, start: float) -> None:
        """On ``route`` (n, 2), ``start`` metres from its beginning."""
        self._route = route
        self._length = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))]
        )
        self._at, self._sign = float(start % self._length[-1]), 1.0
        self._walked, self._waited = 0.0, 0.0

    def stance(self) -> Stance:
        """Where the person is now."""
        x, y = self._place(self._at)
        ahead = self._place(self._at + 0.05 * self._sign) - self._place(
            self._at - 0.05 * self._sign
        )
        return Stance(float(x), float(y), float(np.arctan2(ahead[1], ahead[0])), self._walked)

    def advance(self, seconds: float, robot: FloatArray) -> None:
        """Walks on unless the robot (2,) is in the way."""
        step = _SPEED * seconds
        ahead, here = self._place(self._at + 0.3 * self._sign), self._place(self._at)
        far, nearing = np.linalg.norm(ahead - robot), np.linalg.norm(here - robot)
        if far < _POLITE_M and far <= nearing:
            self._waited += seconds
            if self._waited > _PATIENCE_S:
                self._sign, self._waited = -self._sign, 0.0
            return
        self._waited = 0.0
        self._walked += step
        self._at += step * self._sign
        if not 0.0 <= self._at <= self._length[-1]:
            self._at = float(np.clip(self._at, 0.0, self._length[-1]))
            self._sign = -self._sign

    def _place(self, at: float) -> FloatArray:
        return np.array([np.interp(at, self._length, self._route[:, k]) for k in (0, 1)])


class People:
    """All who walk about; the renderer's bodies and the range sensor's discs."""

    def __init__(self, routes: Sequence[FloatArray], rng: np.random.Generator, bank: ColourBank):
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
            out.append(Body(self._layer(phase, shirt), _pose(stance), _BODY_RADIUS))
        return out

    def _layer(self, phase: int, shirt: int) -> Layer:
        """The body in its own frame at one of the gait's phases; kept, as building it is slow."""
        if (phase, shirt) not in self._layers:
            thing = person(Stance(0.0, 0.0, 0.0, phase * _STRIDE_M / _PHASES))
            dressed = tuple(_dressed(patch, shirt) for patch in thing.patches)
            patches = stack([Thing("person", dressed)])
            light = flat_light(patches, np.array([0.0, 0.0, 1.0]))
            layer = Layer(patches, RayCaster(patches), light, self._bank)
            self._layers[phase, shirt] = layer
        return self._layers[phase, shirt]


def _dressed(patch: Patch, shirt: int) -> Patch:
    if patch.surface.texture != "shirt":
        return patch
    surface = Surface(f"shirt_{shirt}", patch.surface.tile_m)
    return Patch(patch.corner, patch.edge_u, patch.edge_v, surface)


def _pose(stance: Stance) -> FloatArray:
    out = np.eye(4)
    c, s = np.cos(stance.heading), np.sin(stance.heading)
    out[:2, :2] = [[c, -s], [s, c]]
    out[:2, 3] = stance.x, stance.y
    return out
