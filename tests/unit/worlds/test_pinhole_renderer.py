import numpy as np
import pytest
from scipy import ndimage

from fgslam.core import geometry
from fgslam.worlds.rendering.patches import (
    RayCaster,
    Surface,
    Thing,
    box,
    placed,
    prism,
    rectangle,
    stack,
)
from fgslam.worlds.rendering.renderer import Renderer
from fgslam.worlds.rendering.scene import Body, Layer, flat_light
from fgslam.worlds.rendering.texture_bank import GreyBank
from fgslam.worlds.rendering.views import pinhole_view

HEIGHT, WIDTH = 48, 64
FOCAL, CX, CY = 60.0, 31.5, 23.5
CAMERA = pinhole_view((HEIGHT, WIDTH), FOCAL, CX, CY)


def make_layer(things: list[Thing], bank: GreyBank) -> Layer:
    patches = stack(things)
    # Lit from the camera's side, straight on: an albedo is seen as it is.
    light = flat_light(patches, np.array([0.0, 0.0, -1.0]))
    return Layer(patches, RayCaster(patches), light, bank)


def wall(texture: str, depth: float, tile_m: float | None = None) -> Thing:
    """8 m x 8 m before a camera at the origin, whose axes are the scene's."""
    patch = rectangle((-4, -4, depth), (8, 0, 0), (0, 8, 0), Surface(texture, tile_m))
    return Thing("wall", (patch,))


def ramps(side: int) -> GreyBank:
    across = np.tile(np.linspace(10, 240, side, dtype=np.float32), (side, 1))
    return GreyBank({"across": across, "down": across.T.copy()})


@pytest.mark.parametrize("texture", ["across", "down"])
def test_patch_is_seen_upright_and_in_place(texture: str) -> None:
    """Left is left, top is top, and every pixel shows the point that its centre's ray hits."""
    side = 256
    bank = ramps(side)
    image = Renderer(CAMERA, bank).image(make_layer([wall(texture, 5.0)], bank), np.eye(4))[..., 0]
    centre, size = (CX, WIDTH) if texture == "across" else (CY, HEIGHT)
    metres = (np.arange(size) - centre) / FOCAL * 5.0
    texels = (metres + 4.0) / 8.0 * side - 0.5
    expected = 10 + 230 * texels / (side - 1)
    seen = image[HEIGHT // 2] if texture == "across" else image[:, WIDTH // 2]
    np.testing.assert_allclose(seen, expected, atol=0.02)


def test_depth_is_exact_on_a_slanted_wall() -> None:
    bank = ramps(16)
    layer = make_layer([wall("across", 5.0)], bank)
    pose = geometry.pose(geometry.so3_exp(np.array([0.2, -0.5, 0.1])), np.array([0.3, 0.1, 1.0]))
    depth = Renderer(CAMERA, bank).distances(layer, pose)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = np.stack(
        [
            (columns - CX) / FOCAL,
            (rows - CY) / FOCAL,
            np.ones(rows.shape),
        ],
        axis=-1,
    )
    hit = np.isfinite(depth)
    assert hit.mean() > 0.5
    points = geometry.transform_to_world(pose, rays[hit] * depth[hit][:, None])
    np.testing.assert_allclose(points[:, 2], 5.0, atol=1e-12)


def test_where_nothing_is_seen_levels_are_0_depth_infinite_and_object_minus_1() -> None:
    bank = ramps(16)
    layer = make_layer([wall("across", 5.0)], bank)
    away = geometry.pose(geometry.so3_exp(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    renderer = Renderer(CAMERA, bank)
    assert renderer.image(layer, away)[..., 0].max() == 0.0
    assert np.isinf(renderer.distances(layer, away)).all()
    assert (renderer.things(layer, away) == -1).all()


def test_fine_texture_fades_to_its_mean_instead_of_aliasing() -> None:
    checks = np.indices((256, 256)).sum(axis=0) % 2 * 200.0 + 20.0
    bank = GreyBank({"checks": checks.astype(np.float32)})
    renderer = Renderer(CAMERA, bank)
    far = renderer.image(make_layer([wall("checks", 5.0, tile_m=1.0)], bank), np.eye(4))[..., 0]
    np.testing.assert_allclose(far, 120.0, atol=1.0)
    near = renderer.image(make_layer([wall("checks", 0.05, tile_m=1.0)], bank), np.eye(4))[..., 0]
    assert near.std() > 25.0


def test_shift_of_a_tenth_of_a_pixel_shows_as_such() -> None:
    """Sub-pixel truth: moving the camera moves the picture by what projection says."""
    rng = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(rng.standard_normal((256, 256)), 8.0)
    smooth = 128 + 40 * (smooth - smooth.mean()) / smooth.std()
    bank = GreyBank({"smooth": smooth.astype(np.float32)})
    renderer, layer = Renderer(CAMERA, bank), make_layer([wall("smooth", 4.0)], bank)
    here = renderer.image(layer, np.eye(4)).astype(float)[..., 0]
    moved = geometry.pose(np.eye(3), np.array([0.1 * 4.0 / FOCAL, 0.0, 0.0]))
    there = renderer.image(layer, moved).astype(float)[..., 0]
    gradient = np.gradient(here, axis=1)
    shift = np.sum((there - here) * gradient) / np.sum(gradient**2)
    assert shift == pytest.approx(0.1, abs=0.005)


def test_nearer_layer_hides_the_farther_one_and_edges_are_mixed() -> None:
    flat = {n: np.full((4, 4), v, dtype=np.float32) for n, v in (("dark", 20.0), ("light", 220.0))}
    bank = GreyBank(flat)
    behind = make_layer([wall("light", 5.0)], bank)
    half = rectangle((-4, -4, 3.0), (4.01, 0, 0), (0, 8, 0), Surface("dark"))
    patches = stack([Thing("half", (half,))], first_thing=5)
    light = flat_light(patches, np.array([0.0, 0.0, -1.0]))
    before = Layer(patches, RayCaster(patches), light, bank)
    renderer = Renderer(CAMERA, bank)
    things = renderer.things(behind, np.eye(4), [Body(before, np.eye(4), np.inf)])
    assert set(np.unique(things)) == {0, 5}
    assert (things[:, :31] == 5).all()
    assert (things[:, 33:] == 0).all()
    row = renderer.image(behind, np.eye(4), [Body(before, np.eye(4), np.inf)])[24, :, 0]
    np.testing.assert_allclose(row[:30], 20.0, atol=0.1)
    np.testing.assert_allclose(row[34:], 220.0, atol=0.1)
    # The border lies at column 31.7: that pixel, and it alone, is part dark and part light.
    mixed = np.flatnonzero((row > 25.0) & (row < 215.0))
    assert mixed.tolist() == [32]


@pytest.mark.parametrize("yaw", [0.0, 37.0])
def test_solids_face_outwards(yaw: float) -> None:
    surface = Surface("x")
    for solid in (
        box((-1, -2, 0), (1, 2, 3), surface),
        prism((0, 0, 0), (0.3, 0, 2), 0.4, surface),
    ):
        arrays = stack([Thing("solid", tuple(placed(solid, 5.0, -3.0, 1.0, yaw)))])
        middle = arrays.corner + 0.5 * (arrays.edge_u + arrays.edge_v)
        inside = middle.mean(axis=0)
        assert (np.sum((middle - inside) * arrays.normal, axis=1) > 0.0).all()


def test_textures_are_not_mirrored_on_any_side_of_a_box() -> None:
    """On every upright face of a box a texture runs from left to right as one looks at it."""
    bank = ramps(64)
    solid = box((-1, -1, -1), (1, 1, 1), Surface("across"))
    renderer = Renderer(CAMERA, bank)
    for yaw in (0.0, 90.0, 180.0, 270.0):
        layer = make_layer([Thing("box", tuple(placed(solid, 0, 0, 0, yaw)))], bank)
        # Camera 4 m to the south of the box, level, looking north.
        level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
        row = renderer.image(layer, geometry.pose(level, np.array([0, -4.0, 0])))[24, :, 0]
        face = row[row > 0.0]
        assert len(face) > 20
        assert (np.diff(face[1:-1]) > 0).all()
        assert face[-2] - face[1] > 100.0


def test_textures_must_have_sides_that_are_powers_of_two() -> None:
    with pytest.raises(ValueError, match="powers of two"):
        GreyBank({"odd": np.zeros((48, 64), dtype=np.float32)})
