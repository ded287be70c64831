"""Pinhole and omnidirectional images, exact truth, and the cache of frames."""

from pathlib import Path

import numpy as np
import pytest
from omni_house import PANORAMA, plain, room

from fgslam.cameras.omni import HyperbolicMirror, OmniCamera
from fgslam.core import geometry
from fgslam.core.errors import DatasetError
from fgslam.worlds.house import camera_pose
from fgslam.worlds.patches import (
    RayCaster,
    Surface,
    Thing,
    box,
    placed,
    prism,
    rectangle,
    stack,
)
from fgslam.worlds.renderer import (
    Body,
    Layer,
    RenderCache,
    Renderer,
    bake,
    content_hash,
    flat_light,
    omni_view,
    pinhole_view,
    surface_points,
    visible,
)
from fgslam.worlds.textures import ColourBank, GreyBank

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


def test_fine_texture_fades_to_its_mean_instead_of_aliasing() -> None:
    checks = np.indices((256, 256)).sum(axis=0) % 2 * 200.0 + 20.0
    bank = GreyBank({"checks": checks.astype(np.float32)})
    renderer = Renderer(CAMERA, bank)
    far = renderer.image(make_layer([wall("checks", 5.0, tile_m=1.0)], bank), np.eye(4))[..., 0]
    np.testing.assert_allclose(far, 120.0, atol=1.0)
    near = renderer.image(make_layer([wall("checks", 0.05, tile_m=1.0)], bank), np.eye(4))[..., 0]
    assert near.std() > 25.0


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


# --------------------------------------------------------------------------------------------
# Omnidirectional


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


def test_texture_sides_must_be_powers_of_two() -> None:
    with pytest.raises(ValueError, match="powers of two, got 12 x 8"):
        ColourBank({"odd": np.zeros((8, 12, 3), np.float32)})


def test_light_with_a_far_reach_is_light_without_one() -> None:
    grey = Surface("plain")
    patches = stack(
        [
            Thing("floor", (rectangle((-3, 3, 0), (6, 0, 0), (0, -6, 0), grey),)),
            Thing("box", tuple(box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8), grey))),
        ]
    )
    caster = RayCaster(patches)
    lamps = np.array([[[1.0, 0.0, 2.5], [0.5, 0, 0], [0, 0.5, 0]]])
    baked = {
        reach: bake(patches, caster, lamps, np.random.default_rng(1), 0.3, reach).values
        for reach in (None, 1e4, 3.0)
    }
    np.testing.assert_allclose(baked[1e4], baked[None], atol=1e-5)
    assert (baked[3.0] <= baked[None] + 1e-6).all()
    assert baked[3.0].mean() < 0.9 * baked[None].mean()


# --------------------------------------------------------------------------------------------
# The cache


SHAPE = (3, 12, 16)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RenderCache:
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    return RenderCache("ab" * 32, {"a": 1}, SHAPE)


def images(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


def test_cached_frame_is_read_as_it_was_written(cache: RenderCache) -> None:
    assert not cache.present(7)
    assert cache.read(7) is None
    cache.write(7, images(7))
    assert cache.present(7)
    np.testing.assert_array_equal(cache.read(7), images(7))
    assert [p.name for p in cache.folder.iterdir() if p.name.startswith(".")] == []


def test_every_kind_of_damage_is_seen(cache: RenderCache) -> None:
    cache.write(0, images(0))
    whole = cache.path(0).read_bytes()
    flipped = bytearray(whole)
    flipped[100] ^= 1
    for content in (b"", whole[:-1], whole + b"x", bytes(flipped), b"X" + whole[1:]):
        cache.path(0).write_bytes(content)
        assert cache.read(0) is None
    cache.path(0).write_bytes(whole)
    np.testing.assert_array_equal(cache.read(0), images(0))


def test_cache_folder_that_cannot_be_made_gives_a_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path / "file"))
    with pytest.raises(DatasetError, match="set FGSLAM_CACHE to a folder"):
        RenderCache("cd" * 32, {}, SHAPE)


def test_hash_depends_on_content_not_on_order() -> None:
    assert content_hash({"a": 1, "b": [1, 2]}) == content_hash({"b": [1, 2], "a": 1})
    assert content_hash({"a": 1}) != content_hash({"a": 2})
