"""The field of displacements that no term of a rig's correction follows."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.correction import IMAGE_TERMS, displacements, field_displacements, field_modes
from fgslam.core.sensors import CameraRig

PAIR = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
THREE = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, np.eye(4))


def spread(rig: CameraRig, across: int = 25, down: int = 19) -> FloatArray:
    """(k, cameras, 2) the same pixels in all images."""
    axes = np.linspace(0, rig.width - 1, across), np.linspace(0, rig.height - 1, down)
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
    return np.repeat(grid[:, None], rig.cameras, axis=1)


@pytest.mark.parametrize("rig", [PAIR, THREE], ids=["pair", "three"])
def test_a_field_holds_nothing_that_terms_follow(rig: CameraRig) -> None:
    pixels = spread(rig)
    fields = field_displacements(rig, pixels)[:, 2:4]
    own = slice(field_modes(rig) // rig.cameras, 2 * field_modes(rig) // rig.cameras)
    fields = fields[..., own].reshape(2 * len(pixels), -1)
    terms = displacements(rig, pixels)[:, 2:4, : len(IMAGE_TERMS)].reshape(len(fields), -1)
    left = fields - terms @ np.linalg.lstsq(terms, fields, rcond=None)[0]
    size = np.sqrt((fields**2).sum(axis=1).mean())
    assert 0.1 < size < 1.0
    assert np.sqrt((left**2).sum(axis=1).mean()) > 0.98 * size


def test_images_have_fields_of_their_own_that_change_within_a_quarter_of_the_width() -> None:
    unit = field_displacements(THREE, spread(THREE))
    count = field_modes(THREE) // 3
    for camera in range(3):
        others = np.delete(unit, slice(camera * count, (camera + 1) * count), axis=2)
        assert not others[:, 2 * camera : 2 * camera + 2].any()
    row = unit[:, 1].reshape(19, 25, -1)[9]
    alike = (row[:-6] * row[6:]).sum(axis=1) / (row**2).sum(axis=1).mean()
    near = (row[:-1] * row[1:]).sum(axis=1) / (row**2).sum(axis=1).mean()
    assert near.mean() > 0.8
    assert alike.mean() < 0.4


def test_a_field_goes_on_beyond_the_image_as_at_its_border() -> None:
    at_border, beyond = (np.full((1, 2, 2), [x, 40.0]) for x in (619.0, 700.0))
    np.testing.assert_array_equal(
        field_displacements(PAIR, beyond), field_displacements(PAIR, at_border)
    )
    assert field_displacements(PAIR, np.empty((0, 2, 2))).shape == (0, 4, field_modes(PAIR))
