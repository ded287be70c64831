"""How large a field of displacements the images of a rig show against each other.

What a point's images contradict each other by (a pair: its rows) is seen in every frame, without
motion or truth. What of it depends on the place in the image, and is none of the terms of a rig's
correction, is the field; its columns are taken to be as large. Landmarks are put into groups, and
only what different groups agree on counts, so that noise does not, were it a landmark's own for
good. docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from fgslam.backend.filters.online_doubt import pixels_of
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.measurements import Observations
from fgslam.core.rig_correction import displacements, prior_information
from fgslam.core.rig_field import field_displacements, field_modes
from fgslam.core.sensors import CameraRig, pixel_model, vertical_to_horizontal
from fgslam.core.store import Kept

_GROUPS = 8  # of landmarks; a deviation from them is known to a quarter
_LEAST_GROUPS = 4
_TOGETHER = 64  # identities, given one after the other: neighbours share the noise of their texture
_EVERY = 6  # frames between two estimates
_FREE_PX = 100.0  # prior of the terms, so wide that none of them is left to the modes
_SURE = 2.0  # standard errors above zero from which a field is one


class FieldSize:
    """Normal equations of rig terms and field, by group of landmarks; and the field's size."""

    _normal: Kept[FloatArray]
    _rows: Kept[IntArray]
    _frames: Kept[int]
    px: Kept[float]

    def __init__(self, rig: CameraRig, pixel_sigma: float) -> None:
        """Nothing seen yet; ``pixel_sigma`` of one coordinate, pixels."""
        self._rig = rig
        self._contradicting = null_space(
            pixel_model(rig.cameras, vertical_to_horizontal(rig)).T
        )  # (2 * cameras, 2 * cameras - 3) pixels that no point has
        self._prior = pixel_sigma**2 * prior_information(rig, _FREE_PX)
        size = len(self._prior) + field_modes(rig) + 1
        self._normal = np.zeros((_GROUPS, size, size))
        self._rows = np.zeros(_GROUPS, np.int64)
        self._frames = 0
        self.px = 0.0
        """Standard deviation of one coordinate in each image, pixels; 0: none is seen."""

    def observe(self, seen: Observations) -> None:
        """Takes in what a frame's pose accepted."""
        pixels = seen.pixels[:, : self._rig.cameras]
        whole = np.asarray(np.isfinite(pixels).all(axis=(1, 2)), np.bool_)
        if whole.any():
            self._add(seen.select(whole))
        self._frames += 1
        if self._frames % _EVERY == 0:
            variance, error = self._variance()
            self.px = float(np.sqrt(variance)) if variance > _SURE * error else 0.0

    # ----------------------------------------------------------------------------------------

    def _add(self, seen: Observations) -> None:
        """At the predicted pixels, whose noise is not that of the contradiction.

        The contradictions are raw. Less what was applied, which changes on the way, no one value
        of the terms would follow them, and the rest would be taken for a field.
        """
        rig, exact = self._rig, pixels_of(self._rig, seen.measurement)
        terms = displacements(rig, exact)
        off = seen.pixels[:, : rig.cameras].reshape(len(seen), -1)
        columns = np.concatenate([terms, field_displacements(rig, exact), off[..., None]], axis=2)
        columns = self._contradicting.T @ columns
        group = seen.ids // _TOGETHER % _GROUPS
        for k in range(_GROUPS):
            own = columns[group == k].reshape(-1, columns.shape[2])
            self._normal[k] += own.T @ own
            self._rows[k] += len(own)

    def _variance(self) -> tuple[float, float]:
        """The field's variance without bias, pixels^2, and its standard error.

        Products of what different groups show of the modes, over what a field of variance one
        would make of them; the error by leaving out group by group (jackknife).
        """
        normal = self._normal[self._rows > self._normal.shape[1]]
        if len(normal) < _LEAST_GROUPS:
            return 0.0, np.inf
        information, pull = self._of_field(normal)
        whole = information.sum(axis=0)
        # Modes count by how they show, each as far as it stands out of the noise.
        shrunk = np.linalg.inv(whole + np.eye(len(whole)))
        weighed = shrunk @ whole @ shrunk
        found = _Pairs(pull @ weighed @ pull.T)
        by_group = weighed @ information
        unit = _Pairs(np.einsum("gij,hji->gh", by_group, information))
        without = found.without() / unit.without()
        spread = ((without - without.mean()) ** 2).sum() * (len(normal) - 1) / len(normal)
        return found.all() / unit.all(), float(np.sqrt(spread))

    def _of_field(self, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """By group, information (g, m, m) and gradient (g, m) of the modes, terms eliminated."""
        p = len(self._prior)
        gain = np.linalg.solve(normal[:, :p, :p] + self._prior, normal[:, :p, p:])
        left = normal[:, p:, p:] - normal[:, p:, :p] @ gain
        return left[:, :-1, :-1], left[:, :-1, -1]


class _Pairs:
    """Products (g, g) of groups, added up over different ones."""

    def __init__(self, products: FloatArray) -> None:
        self._off = products - np.diag(np.diagonal(products))

    def all(self) -> float:
        return float(self._off.sum())

    def without(self) -> FloatArray:
        """(g,) without each group in turn."""
        return np.asarray(self._off.sum() - self._off.sum(axis=0) - self._off.sum(axis=1))
