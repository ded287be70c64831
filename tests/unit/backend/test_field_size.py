"""How large a field the images of a rig show against each other: fields drawn, and none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import assert_same_bits

from fgslam.backend.self_calibration import FieldSize
from fgslam.core.correction import (
    displacements,
    field_displacements,
    field_modes,
    prior_information,
)
from fgslam.core.sensors import (
    CameraRig,
    Observations,
    measurement_map,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.store import restore, state_of

PAIR = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
THREE = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, np.eye(4))
SIGMA_PX = 0.3
FRAMES, LANDMARKS, SIGHTINGS = 30, 60, 5


def frames(
    rig: CameraRig, field_px: float, seed: int, terms: float = 0.0, lasting: float = 0.0
) -> list[Observations]:
    """Landmarks that cross the image in some frames, as a rig with a field sees them.

    Args:
        rig: the cameras.
        field_px: deviation of the modes.
        seed: of everything.
        terms: what its correction is off by, over the prior's deviation.
        lasting: share of the noise's variance that a landmark keeps.
    """
    rng = np.random.default_rng(seed)
    ratio, cameras = vertical_to_horizontal(rig), rig.cameras
    model, fuse = pixel_model(cameras, ratio), measurement_map("fused", cameras, ratio)
    modes = field_px * rng.standard_normal(field_modes(rig))
    root = np.linalg.cholesky(np.linalg.inv(prior_information(rig)))
    wrong = terms * root @ rng.standard_normal(len(root))
    count, size = FRAMES * LANDMARKS, np.array([rig.width, rig.height])
    starts, moves = rng.uniform(0.0, size, (count, 2)), rng.normal(0.0, 0.03, (count, 2)) * size
    disparity, born = rng.uniform(2.0, 30.0, count), np.arange(count) // LANDMARKS
    own = np.sqrt(lasting) * rng.standard_normal((count, 2 * cameras))
    out = []
    for frame in range(FRAMES):
        ids = np.flatnonzero((born <= frame) & (born > frame - SIGHTINGS))
        places = starts[ids] + (frame - born[ids])[:, None] * moves[ids]
        exact = np.column_stack([places, disparity[ids]]) @ model.T
        at = exact.reshape(len(ids), cameras, 2)
        new = np.sqrt(1.0 - lasting) * rng.standard_normal(exact.shape)
        moved = exact + field_displacements(rig, at) @ modes + displacements(rig, at) @ wrong
        moved += SIGMA_PX * (own[ids] + new)
        pixels = np.full((len(ids), 3, 2), np.nan)
        pixels[:, :cameras] = moved.reshape(at.shape)
        noise = np.tile(np.eye(3), (len(ids), 1, 1))
        out.append(Observations(ids, moved @ fuse.T, noise, pixels, born[ids] == frame))
    return out


def after(rig: CameraRig, seen: list[Observations]) -> FieldSize:
    size = FieldSize(rig, SIGMA_PX)
    for each in seen:
        size.observe(each)
    return size


@pytest.mark.parametrize("rig", [PAIR, THREE], ids=["pair", "three"])
def test_a_field_is_found_as_large_as_it_is(rig: CameraRig) -> None:
    found = [after(rig, frames(rig, 0.4, seed)).px for seed in range(3)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.4, rel=0.3), found


@pytest.mark.parametrize(
    ("terms", "lasting"), [(0.0, 0.0), (1.0, 0.0), (0.0, 0.9)], ids=["exact", "turned", "lasting"]
)
def test_neither_noise_nor_what_terms_follow_is_a_field(terms: float, lasting: float) -> None:
    """Noise is one landmark's, even if it lasts; two standard errors are passed by 1 in 20."""
    found = [after(PAIR, frames(PAIR, 0.0, seed, terms, lasting)).px for seed in range(5)]
    assert np.sort(found)[-2] == 0.0, found
    assert np.max(found) < 0.1


def test_little_is_no_evidence_and_a_state_continues_to_the_same_bits() -> None:
    seen = frames(PAIR, 0.4, 1)
    assert after(PAIR, seen[:5]).px == 0.0
    whole, first, second = after(PAIR, seen), after(PAIR, seen[:20]), FieldSize(PAIR, SIGMA_PX)
    restore(second, state_of(first))
    for each in seen[20:]:
        second.observe(each)
    assert whole.px > 0.0
    assert second.px == whole.px
    assert_same_bits(state_of(second), state_of(whole))


def test_what_not_all_images_show_says_nothing() -> None:
    seen = frames(THREE, 0.4, 1)
    blocked = [each.pixels.copy() for each in seen]
    for pixels in blocked:
        pixels[:, 2] = np.nan
    partly = [dataclasses.replace(s, pixels=p) for s, p in zip(seen, blocked, strict=True)]
    assert after(THREE, partly).px == 0.0
