"""The picture of the GPU renderer against that of the CPU rasterizer, in the module bpy."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from capture.factory import ball
from light.scenes import lit_avatar
from numpy.random import default_rng
from raster import reference

from stga_addon.avatar.embedding import WORLD, to_world
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.offsets import OFFSETS, POSITION
from stga_addon.capture.camera import look_at
from stga_addon.light.harmonics import uniform
from stga_addon.light.lamps import MAP_SIZE, ShadowMap
from stga_addon.light.relight import Relighter
from stga_addon.light.values import Caster, Light, Lighting
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import ComposedImage
from stga_addon.scene.gpu.buffers import read_pixels
from stga_addon.scene.gpu.context import has_gpu_context
from stga_addon.scene.gpu.packing import View
from stga_addon.scene.gpu.renderer import COMPACT, SplatRenderer
from stga_addon.scene.layers import DisplaySettings, Relit, SceneLayer

from .gpu_context import run_with_gpu

needs_gpu = pytest.mark.skipif(
    not has_gpu_context(), reason="Blender gets no GPU context here: EGL has no driver"
)
MIN_PSNR_DB = 60.0
MIN_COMPACT_PSNR_DB = 45.0
MIN_RELIT_PSNR_DB = 55.0
TURNED = np.array(
    [[0.6, -0.8, 0, 0.02], [0.8, 0.6, 0, -0.01], [0, 0, 1, 0.03], [0, 0, 0, 1]]
) @ np.diag([1.3, 0.8, 1, 1])


def avatar(degree, *driven):
    """Splats of every size, opacity and color on a ball, with driven offsets of these names."""
    vertices, faces = ball()
    rng = default_rng(degree)
    splats = lattice_splats(vertices, faces := faces.astype(np.int32), 3, sh_degree=degree)
    count = len(splats)
    splats = replace(
        splats,
        xyz=splats.xyz + rng.normal(0, 1e-3, (count, 3)).astype(np.float32),
        rotation=rng.normal(size=(count, 4)).astype(np.float32),
        log_scale=rng.normal(-6, 0.6, (count, 3)).astype(np.float32),
        opacity=rng.normal(0, 2, count).astype(np.float32),
        sh=rng.normal(0, 0.3, splats.sh.shape).astype(np.float32),
    )
    return with_driven(Avatar(splats, "stga", vertices.astype(np.float32), faces), *driven)


def with_driven(of, *names):
    """With these driven offsets, and ranges of normals that clip small turns."""
    rng = default_rng(9)
    count = len(of.faces)
    units = [5e-3 if OFFSETS[name].target == POSITION else 0.6 for name in names]
    values = [rng.normal(0, unit, (count, 3, 3)).astype(np.float32) for unit in units]
    ends = np.repeat([[-2.0, -0.06], [2.0, 0.03]], 3, axis=1).astype(np.float32)
    limits = np.tile(ends, (count, 1, 1))
    offsets = dict(zip(names, values, strict=True))
    return replace(of, strain_range=limits, driven_offsets=offsets)


def layer(of, pose=None, antialiased=False, **more):
    mesh = of.neutral * [1.1, 0.9, 1.05]
    return SceneLayer(
        of.splats, of.frames(mesh), np.eye(4) if pose is None else pose, antialiased, **more
    )


def unembedded(of):
    world = to_world(of.splats, of.frames(of.neutral))
    return SceneLayer(world, WORLD, TURNED)


@cache
def cases():
    size = float(np.ptp(avatar(0).neutral))
    near = look_at((0.3 * size, 0.2 * size, 1.5 * size), (0, 0, 0), 160, 200, 220)
    far = look_at((0, 100 * size, 1500 * size), (0, 0, 0), 60, 80, 90_000)
    inside = look_at((0, 0, 0.3 * size), (0, 0, 0), 160, 200, 120)
    display = DisplaySettings(0.7, 0.3, 60.0, False, True, False)
    frozen = np.arange(len(avatar(0).faces)) % 3 == 0
    only = DisplaySettings(selected_only=True)
    unseen = np.arange(len(avatar(0).faces)) % 2 == 0
    both = DisplaySettings(show_selection=True, show_unseen=True)
    filmed = DisplaySettings(show_selection=True, filmed_only=True)
    marked = {"frozen": frozen, "unseen": unseen}
    three = [layer(avatar(0)), layer(avatar(3, "strain_color"), TURNED), unembedded(avatar(2))]
    return {
        "sh 0": ([layer(avatar(0))], near),
        "sh 3": ([layer(avatar(3))], near),
        "driven": ([layer(avatar(1, *OFFSETS))], near),
        "strain position": ([layer(avatar(1, "strain_position"))], near),
        "antialiased": ([layer(avatar(0), antialiased=True)], near),
        "orthographic": ([layer(avatar(3))], far),
        "inside": ([layer(avatar(2))], inside),
        "two and world": (three, near),
        "display settings": ([layer(avatar(2, *OFFSETS), settings=display, frozen=frozen)], near),
        "selected only": ([layer(avatar(0), settings=only, frozen=frozen)], near),
        "unseen": ([layer(avatar(2, *OFFSETS), settings=both, **marked)], near),
        "filmed only": ([layer(avatar(0), settings=filmed, **marked)], near),
    }


def render(layers, camera, exact):
    """By the CPU rasterizer, or for one untransformed layer by the reference in float64.

    Far from the camera the former sorts by depths that float32 has rounded.
    """
    if not exact:
        return compose([one.posed() for one in layers], camera, with_depth=True)
    world = to_world(layers[0].splats, layers[0].frames)
    names = "xyz", "rotation", "log_scale", "opacity", "sh"
    values = (torch.as_tensor(getattr(world, name), dtype=torch.float64) for name in names)
    images = reference.render(*values, camera, world.sh_degree)
    rgb, alpha, depth = (image.numpy() for image in images)
    return ComposedImage(rgb, alpha, depth / np.maximum(alpha, 1e-12))


def psnr_db(found, expected):
    return float(-10 * np.log10(max(np.mean((found - expected) ** 2), 1e-12)))


def check(found, layers, camera, exact):
    expected = render(layers, camera, exact)
    print(f"{psnr_db(found.rgb, expected.rgb):.1f} dB")
    assert psnr_db(found.rgb, expected.rgb) >= MIN_PSNR_DB
    assert psnr_db(found.alpha, expected.alpha) >= MIN_PSNR_DB
    assert expected.alpha.mean() > 0.05, "nothing to compare"
    opaque = expected.alpha > 0.5
    error = np.abs(found.depth - expected.depth)[opaque]
    assert np.sqrt(np.mean(error**2)) < 1e-3 * np.ptp(expected.depth[opaque])


def drawn(pictures, *options):
    """Pictures of layers from views, drawn by one renderer."""
    found = []

    def draw():
        renderer = SplatRenderer(*options)
        for layers, view in pictures:
            renderer.draw(layers, view)
            found.append(renderer.read())

    run_with_gpu(draw)
    return found


@needs_gpu
@pytest.mark.parametrize("name", cases())
def test_picture_equals_the_rasterizers(name):
    """Catches another projection, order, color, filter, pose or setting than the CPU's."""
    layers, camera = cases()[name]
    check(drawn([(layers, View(camera))])[0], layers, camera, exact=name == "orthographic")


@needs_gpu
def test_clip_planes():
    """Catches splats outside a clipping region, and planes of another space."""
    camera = cases()["sh 0"][1]
    of = avatar(0)
    planes = np.array([[1.0, 0.2, 0.0, 0.0], [0.0, 1.0, 0.0, 0.02]])
    world = to_world(of.splats, of.frames(of.neutral))
    inside = (np.c_[world.xyz, np.ones(len(world))] @ planes.T >= 0).all(1)
    view = View(camera, clip_planes=planes)
    (image,) = drawn([([SceneLayer(world, WORLD, np.eye(4))], view)])
    expected = compose([SceneLayer(world.rows(inside), WORLD, np.eye(4)).posed()], camera)
    assert 0.2 < inside.mean() < 0.8
    assert psnr_db(image.rgb, expected.rgb) >= MIN_PSNR_DB


@needs_gpu
def test_other_splats_in_the_compact_format():
    """Catches splats of an earlier picture, and wrong targets of viewports on a card."""
    pictures = [cases()[name] for name in ("two and world", "sh 0", "two and world")]
    found = drawn([(layers, View(camera)) for layers, camera in pictures], COMPACT)
    for image, (layers, camera) in zip(found, pictures, strict=True):
        expected = compose([one.posed() for one in layers], camera)
        assert psnr_db(image.rgb, expected.rgb) >= MIN_COMPACT_PSNR_DB


def relit_layers(mode):
    """A ball and a plate under four lights, a world and a caster; beside it one as recorded."""
    avatar = with_driven(lit_avatar(degree=1), *OFFSETS)
    mesh = avatar.neutral.astype(np.float64) * [1.05, 0.97, 1.0]
    eye = np.ones(3)
    disk = Light("area", eye * 2, (-0.5, 0.3, 0.4), direction=(0.5, -0.3, -0.4))
    lights = (
        Light("sun", eye * [1.5, 1.0, 0.5], direction=(-0.3, -1, 0.1), angle=0.1),
        Light("point", eye * 3, (0.3, 0.4, 0.5), radius=0.02),
        Light("spot", eye * 9, (0.4, 0.1, 0.4), direction=(-0.4, -0.1, -0.4), cone=0.5, blend=0.5),
        replace(disk, size=(0.3, 0.4), shape="ellipse"),
    )
    corners = np.array([[0.1, 0.1, 0.2], [0.2, 0.1, 0.2], [0.15, 0.3, 0.2]])
    wall = Caster(corners, np.array([[0, 1, 2]]))
    world = default_rng(3).normal(0, 0.1, (9, 3)) + uniform(np.full(3, 0.4))
    light = Lighting(world, lights, exposure=0.3, white=(1.1, 1.0, 0.9))
    if mode == "mix":
        light = replace(light, mode=mode, mix=0.6)
    elif mode == "kept":  # nearly the light of the capture, some of whose colors are kept
        dim = tuple(replace(light, color=0.15 * light.color) for light in lights)
        light = Lighting(uniform((0.6, 0.5, 0.4)), dim, exposure=0.7)
    relit = Relit(Relighter(avatar), mesh, light, (wall,))
    assert (relit.relighter.distant_in_head(mesh, light)[1].fraction > 0.2) == (mode == "kept")
    shown = SceneLayer(avatar.splats, avatar.frames(mesh), TURNED, relit=relit)
    half = np.diag([0.5, 0.5, 0.5, 1]) + np.eye(4, k=3) * 0.2
    recorded = SceneLayer(avatar.splats, avatar.frames(mesh), half)
    return [recorded, shown]


@needs_gpu
@pytest.mark.parametrize("mode", ["scene", "mix", "kept"])
def test_light_of_the_scene(mode):
    """Catches light that the GPU computes otherwise than `Relighter`, and a lit recorded layer."""
    layers = relit_layers(mode)
    camera = look_at((0.3, 0.2, 0.7), (0, 0, 0), 160, 200, 300)
    (image,) = drawn([(layers, View(camera))])
    expected = compose([one.posed(camera.position) for one in layers], camera)
    print(f"{psnr_db(image.rgb, expected.rgb):.1f} dB")
    assert psnr_db(image.rgb, expected.rgb) >= MIN_RELIT_PSNR_DB
    plain = compose([replace(one, relit=None).posed() for one in layers], camera)
    assert psnr_db(image.rgb, plain.rgb) < 28, "nothing is lit"


def check_shadow_map(atlas, index, expected):
    """A map of the atlas against the depth map (MAP_SIZE, MAP_SIZE) of the CPU, texel by texel."""
    found = atlas[:, MAP_SIZE * index : MAP_SIZE * (index + 1)]
    hit = np.isfinite(expected)
    assert 0.1 < hit.mean() < 0.9, "nothing to compare"
    assert (hit != (found < 1e20)).mean() < 1e-4, "another outline"
    error = np.abs(found - expected)[hit & (found < 1e20)]
    print(f"map {index}: {1e3 * error.max():.2f} mm at most")
    assert (error > 1e-3).mean() < 1e-4  # edges of triangles at the middle of a texel


@needs_gpu
def test_shadow_maps():
    """Catches surfaces that hide what is nearer to a light, and depth bent over large triangles."""
    shown = relit_layers("scene")[1]
    relit = shown.relit
    far = Light("point", np.ones(3), (30, 50, 20))
    lighting = replace(relit.lighting, lights=(*relit.lighting.lights[:3], far))
    relit = replace(relit, lighting=lighting)
    atlas = []

    def draw():
        renderer = SplatRenderer()
        camera = look_at((0.3, 0.2, 0.7), (0, 0, 0), 16, 20, 30)
        renderer.draw([replace(shown, relit=relit)], View(camera))
        atlas.append(read_pixels(renderer._relit[0].textures["shadows"], 1)[..., 0])

    run_with_gpu(draw)
    for index, light in enumerate(lighting.lights):
        expected = ShadowMap(relit.mesh, relit.relighter.avatar.faces, light, relit.casters)
        check_shadow_map(atlas[0], index, expected.depth)
