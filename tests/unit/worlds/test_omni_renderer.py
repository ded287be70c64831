"""Colour images through omnidirectional cameras: truth, filtering, edges, movers."""

import numpy as np
import pytest

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.cameras.omni.mirrors import HyperbolicMirror
from fgslam.worlds.house import camera_pose
from fgslam.worlds.rendering.patches import RayCaster, Surface, Thing, box, stack
from fgslam.worlds.rendering.renderer import Renderer, surface_points, visible
from fgslam.worlds.rendering.scene import Body, Layer, flat_light
from fgslam.worlds.rendering.texture_bank import ColourBank, GreyBank
from fgslam.worlds.rendering.views import omni_view
from tests.omni_house import PANORAMA, plain, room

GREY, RED = (100, 100, 100), (250, 20, 30)
MIRROR = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))
MARKS = np.array([[-2.5, 3.0, 0.6], [-0.4, 3.0, 1.2], [1.1, 3.0, 1.9], [2.6, 3.0, 1.0]])
POSE = camera_pose(np.array([0.4, 0.5, 0.3]), 1.2, np.deg2rad([1.5, -1.0]))


@pytest.fixture(scope="module")
def bank() -> ColourBank:
    return plain(GREY, RED)


@pytest.fixture(scope="module")
def scene(bank: ColourBank) -> Layer:
    return room(bank, MARKS)


@pytest.mark.parametrize("camera", [PANORAMA, MIRROR], ids=["panorama", "mirror"])
def test_mark_is_drawn_where_truth_says(camera: OmniCamera, scene: Layer, bank: ColourBank) -> None:
    """Each mark's centre of redness lies on the pixel of its centre, to a fifth of a pixel."""
    view = omni_view(camera)
    levels = Renderer(view, bank, 24.0).levels(scene, POSE)
    red = np.zeros(view.shape)
    red.ravel()[view.valid] = (levels[0] - GREY[0]) / (RED[0] - GREY[0])
    pixels, shows = visible(scene, camera, POSE, MARKS - [0.0, 0.002, 0.0])
    assert shows.all()
    rows, columns = np.indices(red.shape)
    for column, row in pixels:
        near = red * (np.hypot(columns - column, rows - row) < 9.0)
        centre = np.array([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        # A square's centre of mass in the picture is not quite its centre's image.
        assert np.linalg.norm(centre - (column, row)) < 0.2
        assert near.sum() > 2.0


def test_pictures_have_red_first_and_are_black_outside_the_mirror(
    scene: Layer, bank: ColourBank
) -> None:
    view = omni_view(MIRROR)
    renderer = Renderer(view, bank, 24.0)
    image = renderer.assemble(renderer.levels(scene, POSE))
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    inside = np.isin(np.arange(240 * 320), view.valid).reshape(240, 320)
    assert image[~inside].max() == 0
    assert image[..., 0].max() == RED[0]
    # Nothing but mixtures of the two colours is seen within: a mark is never blue.
    seen = image[inside].astype(int)
    assert (seen[:, 2] <= GREY[2]).all()
    assert np.median(seen, axis=0).tolist() == list(GREY)


def test_points_and_ranges_are_exact(scene: Layer, bank: ColourBank) -> None:
    rng = np.random.default_rng(2)
    pixels = rng.uniform((90.0, 20.0), (230.0, 220.0), (400, 2))
    points = surface_points(scene, MIRROR, POSE, pixels)
    shown = np.isfinite(points).all(axis=1)
    assert shown.mean() > 0.9
    on_wall = np.min(
        np.abs(points[shown][:, [0, 0, 1, 1, 1, 2, 2]] - [-4, 4, -3, 3, 2.998, 0, 3]), axis=1
    )
    assert on_wall.max() < 1e-12
    again, seen = visible(scene, MIRROR, POSE, points[shown])
    assert seen.all()
    np.testing.assert_allclose(again, pixels[shown], atol=1e-9)
    ranges = Renderer(omni_view(MIRROR), bank, 24.0).distances(scene, POSE)
    assert np.isnan(ranges[0, 0])
    centres = np.array([[150.0, 60.0], [200.0, 130.0]])
    far = np.linalg.norm(surface_points(scene, MIRROR, POSE, centres) - POSE[:3, 3], axis=1)
    np.testing.assert_allclose(ranges[[60, 130], [150, 200]], far, atol=1e-12)


def test_hidden_point_does_not_show(scene: Layer) -> None:
    behind = MARKS + np.array([0.0, 0.4, 0.0])
    assert not visible(scene, PANORAMA, POSE, behind)[1].any()


def test_edge_pixels_are_mixed(bank: ColourBank) -> None:
    """Over a mark's border redness goes through intermediate levels in proportion to coverage."""
    layer = room(bank, np.array([[0.0, 3.0, 1.2]]), side=1.0)
    upright = camera_pose(np.array([0.0, 0.5, np.pi / 2]), 1.2, np.zeros(2))
    levels = Renderer(omni_view(PANORAMA), bank, 24.0).levels(layer, upright).reshape(3, 256, 512)
    share = (levels[0] - GREY[0]) / (RED[0] - GREY[0])
    # On the horizon's row the mark spans +-atan(0.5 / 2.498): its width in pixels is known.
    width = 2.0 * np.arctan(0.5 / 2.498) * 511 / (2 * np.pi)
    assert share[127].sum() == pytest.approx(width, abs=0.5)
    assert ((share > 0.1) & (share < 0.9)).sum() > 10


def test_body_hides_what_is_behind_it_and_nothing_before_it(bank: ColourBank) -> None:
    layer = room(bank, MARKS)
    things = stack([Thing("box", tuple(box((-0.2, -0.2, 0.0), (0.2, 0.2, 1.8), Surface("c1"))))])
    light = flat_light(things, np.array([0.0, 0.0, 1.0]))
    light.values[:] = 1.0
    mover = Layer(things, RayCaster(things), light, bank)
    renderer = Renderer(omni_view(PANORAMA), bank, 24.0)
    clean = renderer.levels(layer, POSE)
    for place, hidden in (([1.5, 1.5, 0.0], True), ([0.4, 9.0, 0.0], False)):
        wTo = np.eye(4)
        wTo[:3, 3] = place
        seen = renderer.levels(layer, POSE, [Body(mover, wTo, 0.3)])
        changed = np.abs(seen - clean).max(axis=0) > 50.0
        assert bool(changed.any()) == hidden
        if hidden:
            rays = PANORAMA.rays(np.argwhere(changed.reshape(256, 512))[:, ::-1].astype(float))
            bearing = np.arctan2(rays @ POSE[1, :3], rays @ POSE[0, :3])
            expected = np.arctan2(1.5 - 0.5, 1.5 - 0.4)
            assert np.abs(bearing.mean() - expected) < 0.02


def test_each_channel_is_filtered_as_a_grey_texture() -> None:
    """Against the trilinear filter for grey textures, at many places and footprints."""
    rng = np.random.default_rng(4)
    textures = [rng.uniform(0.0, 255.0, (64, 32, 3)).round().astype(np.float32) for _ in range(3)]
    colour = ColourBank({f"t{i}": t for i, t in enumerate(textures)})
    n = 5000
    texture = rng.integers(0, 3, n).astype(np.int32)
    u, v = rng.uniform(-2.0, 2.0, (2, n)).astype(np.float32)
    footprint = np.exp(rng.uniform(-3.0, 6.0, n)).astype(np.float32)
    seen = colour.sample(texture, u, v, footprint)
    for k in range(3):
        grey = GreyBank({f"t{i}": t[..., k] for i, t in enumerate(textures)})
        # Coarser levels are rounded to whole levels in colour, hence half a level.
        np.testing.assert_allclose(seen[k], grey.sample(texture, u, v, footprint)[0], atol=0.75)


def test_white_stays_white_and_black_black() -> None:
    """No lane of a packed texel runs over into the next one."""
    extremes = plain((255, 0, 255), (0, 255, 0))
    n = 2000
    rng = np.random.default_rng(5)
    u, v = rng.random((2, n)).astype(np.float32)
    footprint = np.exp(rng.uniform(-2.0, 3.0, n)).astype(np.float32)
    for texture, expected in ((0, (255, 0, 255)), (1, (0, 255, 0))):
        seen = extremes.sample(np.full(n, texture, np.int32), u, v, footprint)
        np.testing.assert_allclose(seen.T, np.broadcast_to(expected, (n, 3)), atol=0.13)


def test_texture_sides_must_be_powers_of_two() -> None:
    with pytest.raises(ValueError, match="powers of two, got 12 x 8"):
        ColourBank({"odd": np.zeros((8, 12, 3), np.float32)})
