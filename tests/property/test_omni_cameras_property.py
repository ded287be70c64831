"""Laws of omnidirectional cameras for arbitrary mirrors, mountings and directions."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings, strategies as st

from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    MirrorFrame,
    OmniCamera,
    angles_of,
    measure,
)
from fgslam.core.geometry import wrap

frames = st.builds(
    MirrorFrame,
    width=st.just(640),
    height=st.just(480),
    centre=st.tuples(st.floats(250.0, 400.0), st.floats(200.0, 280.0)),
    ahead=st.floats(-6.0, 6.0),
    clockwise=st.booleans(),
)
mirrors = st.builds(
    HyperbolicMirror,
    frame=frames,
    inner_radius=st.floats(0.0, 30.0),
    outer_radius=st.floats(100.0, 300.0),
    xi=st.floats(0.3, 1.0),
    focal_px=st.floats(20.0, 400.0),
)
panoramas = st.builds(
    Equirectangular,
    width=st.integers(50, 3000),
    height=st.integers(50, 1500),
    top_elevation=st.floats(0.1, np.pi / 2),
    bottom_elevation=st.floats(-np.pi / 2, 0.0),
)
cylinders = st.builds(
    Cylinder,
    width=st.integers(50, 3000),
    height=st.integers(50, 1500),
    tan_bottom=st.floats(-5.0, 0.0),
    tan_top=st.floats(0.1, 5.0),
)
cameras = st.one_of(mirrors, panoramas, cylinders)


@settings(deadline=None)
@given(camera=cameras, seed=st.integers(0, 2**32))
def test_pixels_and_rays_are_inverse(camera: OmniCamera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(100, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = camera.pixels(rays)
    seen = np.isfinite(pixels).all(axis=1)
    np.testing.assert_allclose(camera.rays(pixels[seen]), rays[seen], atol=1e-9)
    assert np.isnan(camera.rays(pixels[~seen])).all()
    np.testing.assert_allclose(
        camera.pixels(rays[seen] * rng.uniform(0.01, 100.0, (seen.sum(), 1))),
        pixels[seen],
        rtol=1e-9,
        atol=1e-9,
    )


@settings(deadline=None)
@given(camera=mirrors, turn=st.floats(-3.0, 3.0), seed=st.integers(0, 2**32))
def test_turning_the_robot_turns_the_picture(
    camera: HyperbolicMirror, turn: float, seed: int
) -> None:
    """The same pixels, another heading in the picture: bearings differ by that angle alone."""
    frame = camera.frame
    turned_frame = MirrorFrame(
        frame.width, frame.height, frame.centre, frame.ahead + turn, frame.clockwise
    )
    turned = HyperbolicMirror(
        turned_frame,
        camera.inner_radius,
        camera.outer_radius,
        xi=camera.xi,
        focal_px=camera.focal_px,
    )
    pixels = np.random.default_rng(seed).uniform(0.0, 1.0, (50, 2)) * [639, 479]
    before, elevation = angles_of(camera.rays(pixels))
    after, same = angles_of(turned.rays(pixels))
    np.testing.assert_allclose(elevation, same, atol=1e-12)
    sign = 1.0 if frame.clockwise else -1.0
    seen = np.isfinite(before)
    np.testing.assert_allclose(wrap(after + sign * turn - before)[seen], 0.0, atol=1e-9)


@settings(deadline=None)
@given(camera=cameras, sigma=st.floats(0.05, 5.0), seed=st.integers(0, 2**32))
def test_covariances_are_symmetric_positive_and_scale_with_the_noise(
    camera: OmniCamera, sigma: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0.0, 1.0, (50, 2)) * [camera.width - 1, camera.height - 1]
    bearing, elevation, covariance = measure(camera, pixels, sigma)
    # Straight up and down a bearing means nothing.
    usable = np.isfinite(bearing) & (np.abs(elevation) < 1.5)
    assume(usable.any())
    assert (np.linalg.eigvalsh(covariance[usable]) > 0.0).all()
    _, _, single = measure(camera, pixels, 1.0)
    np.testing.assert_allclose(covariance[usable], sigma**2 * single[usable], rtol=1e-12)
