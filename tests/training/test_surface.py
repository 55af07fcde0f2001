"""What outlines tell of a head's surface, and what splats are like that no view tells of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import cKDTree

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.file import UNSEEN_REGION, Avatar
from stga_addon.avatar.lattice import NORMAL_AXIS, lattice_splats
from stga_addon.avatar.observed import observed_sides
from stga_addon.avatar.splats import SH_C0, joined
from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import rasterize, silhouette
from stga_addon.capture.model import Capture, View
from stga_addon.capture.visual_hull import voxel_size
from stga_addon.flame.model import faces_within
from stga_addon.flame.parts import flame_model, key_regions
from stga_addon.flame.quaternions import to_matrices
from stga_addon.render.render import render
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.hidden_layers import (
    OCCLUSION_OPACITY,
    above_unseen_hair,
    hidden_splats,
    splats_behind,
)
from stga_addon.training.optimize.initial_splats import visual_hull_points
from stga_addon.training.optimize.state import new_state
from stga_addon.training.optimize.surface import GRAZING_COSINE, Surface
from stga_addon.training.optimize.surface_prior import (
    BEHIND_COSINE,
    WELL_OBSERVED_COSINE,
    flattened,
    thickness,
    width,
)
from stga_addon.training.optimize.unseen_sides import unseen_sides

from .toys import alpha_of, quick_settings, settle, state_in

HAIR_M = 0.012
COLLAR_M = 0.01
"""How far hair and a collar stand above the bundled head."""


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """The bundled head by one camera that goes 60° to either side, its masks as of a head whose
    scalp and shoulders stand out."""
    folder = tmp_path_factory.mktemp("filmed")
    model = flame_model(None)
    neutral = np.asarray(model.v_template, np.float64)
    out = normals(neutral, model.faces)
    hair = (neutral[:, 1] > 0.09) | ((neutral[:, 2] < 0.02) & (neutral[:, 1] > 0.02))
    collar = neutral[:, 1] < -0.14
    dressed = neutral + (HAIR_M * hair + COLLAR_M * collar)[:, None] * out
    views = []
    for number, angle in enumerate(np.radians(np.linspace(-60, 60, 9))):
        eye = [1.2 * np.sin(angle), 0, 1.2 * np.cos(angle)]
        camera = look_at(eye, [0, -0.02, 0], 320, 400, 1000)
        path = folder / f"{number}.png"
        mask = silhouette(dressed, model.faces, camera) | silhouette(neutral, model.faces, camera)
        Image.fromarray(np.uint8(255 * mask)).save(path)
        views.append(View(number, 0, camera, path.name, path, path))
    return capture_of(folder, neutral, tuple(views))


@pytest.fixture(scope="module", params=["stga", "gaussian_avatars"])
def of_convention(request, filmed):
    """Frames of the head by either convention, which tests only read."""
    return FrameStore(filmed, request.param)


@pytest.fixture(scope="module")
def frames(filmed):
    """Frames of the head, which tests only read."""
    return FrameStore(filmed, "stga")


@pytest.fixture(scope="module")
def frontal(filmed):
    """The head as its middle views alone show it."""
    return replace(filmed, views={"train": filmed.views["train"][3:6]})


def normals(vertices, faces):
    a, b, c = vertices[faces].swapaxes(0, 1)
    total = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(total, corner, np.cross(b - a, c - a))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def capture_of(root, neutral, views):
    model = flame_model(None)
    return Capture(
        root=root,
        layout="mesh",
        faces=model.faces,
        neutral=neutral,
        timesteps=tuple(sorted({view.timestep for view in views})),
        views={"train": views},
        regions=key_regions(model),
        mesh=lambda _: neutral,
        expression_mesh=lambda *_: neutral,
    )


def test_hair_is_as_high_as_its_outline(filmed, frames):
    """Catches hair that is cut to the skull where no camera looks, a neck with hair, and clothes
    that are thought to be thin skin."""
    surface = frames.surface
    center = filmed.neutral[filmed.faces].mean(1)
    crown = surface.outside & (center[:, 1] > 0.11)
    back = surface.outside & (center[:, 2] < -0.08) & (center[:, 1] > 0.04)
    assert surface.hidden[back].mean() > 0.9
    for rows in (crown, back):
        assert abs(np.median(surface.hair_height[rows]) - HAIR_M) < 0.003
    neck = surface.outside & (center[:, 1] < -0.1)
    assert not surface.hair_height[neck].any()
    face = surface.outside & (center[:, 2] > 0.09) & (np.abs(center[:, 1]) < 0.03)
    assert surface.is_flat[face].mean() > 0.9
    shoulder = surface.outside & (center[:, 1] < -0.17) & (np.abs(center[:, 0]) > 0.09)
    assert not surface.is_flat[shoulder & ~surface.hidden].any()


def in_motion(capture, model, closed=(0.0, 0.0)):
    """The capture with the head's motion, whose left and right eye are so far closed at some
    timestep."""
    weights = dict(zip(("eyeBlinkLeft", "eyeBlinkRight"), closed, strict=True))
    blink = np.array([weights.get(name, 0.0) for name in model.expression_names])
    frames = [SimpleNamespace(expr=blink * (timestep == 4)) for timestep in capture.timesteps]
    return replace(capture, flame=SimpleNamespace(model=model, frame=frames.__getitem__))


@pytest.fixture(scope="module")
def moving(filmed):
    """Frames of the head in motion, whose eyes stay open, which tests only read."""
    return FrameStore(in_motion(filmed, flame_model(None)), "stga")


def from_the_front(capture, folder, change):
    """Its middle views, with masks that `change(view, mask)` has changed."""
    views = []
    for view in capture.views["train"][3:6]:
        mask = np.array(Image.open(view.mask))
        change(view, mask)
        path = folder / f"{view.timestep}.png"
        Image.fromarray(mask).save(path)
        views.append(replace(view, mask=path))
    return replace(capture, views={"train": tuple(views)})


def test_hair_is_no_higher_than_masks(filmed, tmp_path):
    """Catches hair of the one side, mirrored to the other, that stands out of its outline there."""

    def bare_on_one_side(view, mask):
        bare = silhouette(filmed.neutral, filmed.faces, view.camera)
        middle = view.camera.width // 2
        mask[:, :middle] = 255 * bare[:, :middle]

    surface = Surface(from_the_front(filmed, tmp_path, bare_on_one_side))
    center = filmed.neutral[filmed.faces].mean(1)
    normal = normals(filmed.neutral, filmed.faces)[filmed.faces].mean(1)
    partner = cKDTree(center).query(center * [-1, 1, 1])[1]
    beside = surface.outside & (center[:, 0] < -0.03)
    beside &= surface.hair_height[partner] > 0.9 * HAIR_M
    assert beside.sum() > 20
    points = (center + surface.hair_height[:, None] * normal)[beside]
    for view in surface.capture.views["train"]:
        covered = binary_dilation(np.asarray(Image.open(view.mask)) > 0, iterations=6)
        column, row = np.floor(view.camera.project(points)[0]).astype(int).T
        assert covered[row, column].all()


@pytest.mark.parametrize(("sides", "hangs"), [((-1, 1), True), ((1,), False)])
def test_long_hair_hides_the_neck(sides, hangs, filmed, tmp_path):
    """Catches long hair that, from behind, ends at the ears like a cap; and a neck that is hidden
    although hair, as the image shows, hangs over one shoulder."""
    center = filmed.neutral[filmed.faces].mean(1)

    def with_hair_beside_the_neck(view, mask):
        for side in sides:
            ends = [[0.03 * side, 0.0, 0], [0.1 * side, -0.16, 0]]
            (left, right), (top, bottom) = np.sort(view.camera.project(np.array(ends))[0].T)
            mask[int(top) : int(bottom), int(left) : int(right)] = 255

    surface = Surface(from_the_front(filmed, tmp_path, with_hair_beside_the_neck))
    neck = surface.outside & (center[:, 2] < -0.05) & (abs(center[:, 1] + 0.09) < 0.02)
    assert neck.sum() > 20
    assert surface.kinds["scalp"][neck].mean() == hangs
    assert np.all((surface.hair_height[neck] > 0.015) == hangs)
    assert not surface.kinds["scalp"][center[:, 1] < -0.16].any()


def test_no_hair_is_long_beyond_an_image(filmed, tmp_path):
    """Catches a close-up whose image ends beside the head, and that is thought to be full of
    hair."""
    surface = Surface(from_the_front(filmed, tmp_path, lambda view, mask: mask.fill(255)))
    assert not surface.has_long_hair


def test_an_end_of_a_bust_is_no_eye(filmed, frames):
    """Catches eyelids and lips, whose edges are open too, that are taken for the mesh's end, large
    splats there and at the rim of a face alone, and a torso beside a mesh that ends at the neck, of
    small ones."""
    border = frames.surface.border
    bound, unbound = frames.scale_limits(quick_settings(scale_limit=3.0, unbound_scale_limit=2.0))
    is_seen = frames.surface.facing > GRAZING_COSINE
    assert_allclose(bound[border & is_seen], 0.6 * frames.units[border & is_seen], rtol=1e-6)
    assert_allclose(unbound[is_seen], 2 * voxel_size(filmed.neutral), rtol=1e-6)
    height = filmed.neutral[filmed.faces[border]][:, :, 1].min(1)
    assert border.sum() > 20
    assert height.max() < -0.1
    center = filmed.neutral[filmed.faces].mean(1)
    face = (center[:, 2] > 0.03) & (center[:, 1] > -0.09)
    regions = {name: region[face] for name, region in filmed.regions.items()}
    assert Surface(replace(filmed, faces=filmed.faces[face], regions=regions)).border.any()


def test_hidden_sides_are_closed(filmed, of_convention):
    """Catches a back of the head through which the inside of the face is seen, at the start or when
    limits have shrunk its hair, one in the air, and tatters where the mesh ends."""
    frames = of_convention
    settings = quick_settings(convention=frames.convention, scale_limit=0.6)
    splats = hidden_splats(frames, settings)
    hair = frames.surface.hair_height[splats.face] > 0
    largest = np.exp(splats.log_scale[hair].max(1))
    assert hair.sum() > 300
    assert np.all(largest < 1.001 * frames.scale_limits(settings)[0, splats.face[hair]])
    assert set(np.unique(splats.face)) == set(np.flatnonzero(frames.surface.hidden))
    camera = look_at([0, 0.02, -1.2], [0, 0, 0], 320, 400, 1000)
    image = render(splats, camera, frames=frames.of(0))
    alpha = 1 - image.mean(0) / render(splats.rows([]), camera, frames=frames.of(0)).mean(0)
    triangle, _ = rasterize(filmed.neutral, filmed.faces, camera)
    own = np.zeros(triangle.shape, bool)
    shown = triangle >= 0
    inner = frames.surface.hidden & ~frames.surface.border
    own[shown] = inner[triangle[shown]]
    assert own.sum() > 5000
    # splats are gray: a closed layer covers what is white by half
    assert np.quantile(alpha[own], 0.01) > 0.45
    air = ~binary_dilation(silhouette(filmed.neutral, filmed.faces, camera), iterations=18)
    assert alpha[air].max() < 0.02


def test_no_tuft_hangs_behind_the_head(filmed):
    """Catches visual-hull points behind a head, where masks from in front do not end the hull: in
    the air, for all cameras that nobody has put there. Those of hair that outlines show stay."""
    views = filmed.views["train"]
    views = tuple(replace(view, timestep=0, camera_index=view.timestep) for view in views)
    capture = replace(filmed, views={"train": views}, timesteps=(0,))
    frames = FrameStore(capture, "stga")
    splats = visual_hull_points(capture, views, "stga", 0)
    gone = above_unseen_hair(frames, splats)
    at = to_world(splats, frames.of(0)).xyz
    distance = cKDTree(filmed.neutral).query(at)[0]
    behind = (at[:, 2] < -0.06) & (at[:, 1] > 0.04)
    assert distance[behind].max() > HAIR_M + 0.012
    assert distance[behind & ~gone].max() < HAIR_M + 0.008
    assert not gone[at[:, 2] > 0].any()


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_what_is_behind_keeps_its_width(frontal, convention):
    """Catches a back of the head in whose hair, neck and hem training, which does not see it, makes
    tears."""
    frames = FrameStore(frontal, convention)
    settings = quick_settings(convention=convention)
    layer = hidden_splats(frames, settings)
    state = new_state(joined([layer, splats_behind(frames, settings.sh_degree)]))
    state.parameters.log_scale[: len(layer)] -= 0.7
    settle(frames, state)
    surface = frames.surface
    is_behind = (surface.facing < BEHIND_COSINE)[layer.face]
    hair = is_behind & (surface.hair_height > 0)[layer.face]
    hem = (surface.closed & surface.border)[layer.face]
    axis = NORMAL_AXIS[convention]
    wide = width(state.parameters.rotation, state.parameters.log_scale, axis)[: len(layer)]
    assert np.all(wide[hair] > 0.97 * frames.hair_layer_scale[layer.face[hair]])
    before = width(layer.rotation, layer.log_scale, axis)
    for part in (hair, is_behind & ~hair & ~hem, hem):
        assert part.sum() > 50
        assert np.all(wide[part] > 0.7 * before[part])


def test_what_hardly_shows_hardly_moves(frontal):
    """Catches a back that next to no gradients move by whole steps of Adam, until it has holes, and
    a front that no longer learns."""
    frames = FrameStore(frontal, "stga")
    state = new_state(lattice_splats(frontal.neutral, frontal.faces, 0, 0))
    facing = frames.surface.facing[state.face]
    gradient = np.where(facing < BEHIND_COSINE, 1e-4, 1.0).astype(np.float32)
    for moments in (state.second.xyz, state.second.rotation, state.second.log_scale):
        moments[:] = gradient[:, None] ** 2
    state.second.opacity[:] = gradient**2
    state.second.sh[:] = gradient[:, None, None] ** 2
    settle(frames, state)
    behind = facing < BEHIND_COSINE
    assert behind.sum() > 100
    for moments in (state.second.xyz, state.second.rotation, state.second.log_scale):
        step = gradient[:, None] / np.sqrt(moments)
        assert step[behind].max() < 1e-3
        assert_array_equal(step[facing > WELL_OBSERVED_COSINE], 1)


@pytest.mark.parametrize("axis", [1, 2])
def test_flat_splats_look_the_same_from_the_front(axis):
    """Catches splats that change in the image of the camera that trains them, a limit in another
    unit, and a layer whose splats stay too small: covariances in float64."""
    rng = np.random.default_rng(0)
    rotation = rng.normal(size=(500, 4)).astype(np.float32)
    log_scale = rng.uniform(-8, -3, (500, 3)).astype(np.float32)
    limit = rng.uniform(1e-4, 1e-3, 500)
    least = np.where(np.arange(500) < 250, 0, 0.02)
    before = covariances(rotation, log_scale)
    after = covariances(*flattened(rotation, log_scale, axis, limit, least))
    others = [n for n in range(3) if n != axis]
    before, after = (both[np.ix_(range(500), others, others)] for both in (before, after))
    wider = np.maximum(least**2 / np.sqrt(np.linalg.det(before)), 1)[:, None, None]
    assert (wider[250:] > 1).sum() > 100
    assert_allclose(after, wider * before, rtol=1e-4, atol=1e-9)
    thick = thickness(*flattened(rotation, log_scale, axis, limit, least), axis)
    was = thickness(rotation, log_scale, axis) * np.sqrt(wider[:, 0, 0])
    assert_allclose(thick, np.minimum(was, limit), rtol=1e-3, atol=1e-6)


def covariances(rotation, log_scale):
    sides = to_matrices(rotation.astype(np.float64)) * np.exp(log_scale.astype(np.float64))[:, None]
    return sides @ sides.swapaxes(1, 2)


def test_what_views_tell_is_kept(filmed, frames):
    """Catches splats of which views tell much that are pulled away, ones of which they tell nothing
    that take any color and place, and hair that falls onto the skull."""
    surface = frames.surface
    state = state_in(frames, quick_settings("global", sh_degree=0, sh_steps=()))
    outer = state.parameters.opacity != OCCLUSION_OPACITY
    rng = np.random.default_rng(0)
    told = rng.random(len(state)) < 0.8
    for part in (state.second.sh, state.second.opacity):
        part[:] = 1e-12
        part[told] = 1.0
    state.parameters.sh[:] = rng.normal(size=state.parameters.sh.shape)
    state.parameters.xyz[outer] += rng.normal(0, 0.002, (outer.sum(), 3))
    before = {name: value.copy() for name, value in state.parameters._asdict().items()}
    settle(frames, state)
    grazing = surface.outside & (surface.facing < GRAZING_COSINE) & (surface.facing > 0)
    of_grazing = grazing[state.face] & ~state.unbound & outer
    kept = of_grazing & told & ~frames.sides.triangles[state.face]
    shown = of_grazing & frames.sides.visible[state.face] & ~frames.sides.triangles[state.face]
    assert shown.sum() > 50
    assert_array_equal(state.parameters.sh[shown], before["sh"][shown])
    away = (GRAZING_COSINE - surface.facing[state.face]) / (GRAZING_COSINE + 0.1)
    opacity = (state.parameters.opacity - before["opacity"])[kept]
    assert_allclose(
        opacity, ((0.3 / 1.3 * away) ** 2)[kept] * (3 - before["opacity"][kept]), atol=0.06
    )
    rows = of_grazing & ~told & ~frames.sides.triangles[state.face]
    assert rows.sum() > 100
    share = ~frames.sides.visible[state.face[rows], None]
    plausible = (frames.sides.color[state.face[rows]] - 0.5) / SH_C0
    own = before["sh"][rows, 0]
    assert_allclose(state.parameters.sh[rows, 0], own + share * (plausible - own), atol=1e-3)
    height = state.parameters.xyz[rows, 2]
    hair = surface.hair_height[state.face[rows]]
    outer_m = 0.8 * hair - voxel_size(filmed.neutral) / 2
    edges = np.diff(filmed.neutral[filmed.faces[state.face[rows]]], axis=1).swapaxes(0, 1)
    skin = -0.1 * np.sqrt(np.linalg.norm(np.cross(*edges), axis=1))
    plausible = np.where(outer_m > 0, outer_m, skin)
    was = before["xyz"][rows, 2]
    assert_allclose(height, was + away[rows] ** 2 * (plausible - was), atol=3e-4)


def test_lids_close(moving):
    """Catches lids that were trained on open eyes and, closed, are shreds with the eye behind."""
    capture = moving.capture
    model = capture.flame.model
    names = [model.expression_names.index(f"eyeBlink{side}") for side in ("Left", "Right")]
    blink = capture.neutral + model.shapedirs[:, :, model.n_identity :][:, :, names].sum(2)
    state = state_in(moving, quick_settings(sh_degree=0, sh_steps=()))
    lids = moving.surface.lids
    assert 100 < lids.sum() < 1000
    rng = np.random.default_rng(0)
    state.parameters.opacity[:] = -4
    state.parameters.log_scale[:] -= rng.uniform(0, 2, state.parameters.log_scale.shape)
    settle(moving, state)
    splats = state.splats()
    splats = splats.rows(lids[splats.face] & ~splats.unbound)
    camera = look_at([0, 0.03, 0.6], [0, 0.03, 0], 320, 200, 900)
    triangle, _ = rasterize(blink, capture.faces, camera)
    closed = binary_erosion((triangle >= 0) & lids[triangle])
    assert closed.sum() > 500
    blinked = face_frames(blink, capture.faces, capture.neutral)
    assert np.quantile(alpha_of(splats, camera, blinked)[closed], 0.02) > 0.8


def test_lids_that_views_show_stay(filmed):
    """Catches lids' own splats that join the layer under them, color and all, as training moves
    them a little below the surface."""
    capture = in_motion(filmed, flame_model(None), closed=(1.0, 1.0))
    frames = FrameStore(capture, "stga")
    state = state_in(frames, quick_settings(sh_degree=0, sh_steps=(), lattice=1))
    rng = np.random.default_rng(0)
    lids = frames.surface.lids & ~frames.sides.triangles & ~frames.surface.hidden
    rows = np.flatnonzero(lids[state.face] & ~state.unbound)
    state.parameters.xyz[rows] += rng.normal(0, 3e-4, (len(rows), 3))
    state.parameters.rotation[rows] = rng.normal(size=(len(rows), 4))
    for part in (state.second.sh, state.second.opacity):
        part[:] = 1
    settle(frames, state)
    is_layer = (state.parameters.rotation[rows] == [1, 0, 0, 0]).all(1)
    face, count = np.unique(state.face[rows[is_layer]], return_counts=True)
    assert set(face) == set(state.face[rows])
    assert count.max() == 1
    assert is_layer.mean() < 0.4


def test_lids_that_stay_folded_are_skin(filmed, tmp_path):
    """Catches a lid in the shade of its fold, where no view shows the eye closed, light from the
    other side on it, and what views show of a closed lid painted over."""
    model = flame_model(None)
    center = filmed.neutral[filmed.faces].mean(1)
    is_left = center[:, 0] > 0
    capture = in_motion(filmed, model, closed=(1.0, 0.0))
    lids = Surface(capture).lids
    colors = np.where(is_left[:, None], [200, 150, 130], [150, 100, 80])
    colors[lids] = [70, 40, 30]
    views = []
    for view in filmed.views["train"]:
        triangle, _ = rasterize(filmed.neutral, filmed.faces, view.camera)
        path = tmp_path / f"{view.timestep}.png"
        image = np.where(triangle[..., None] >= 0, colors[triangle], 255)
        Image.fromarray(np.uint8(image)).save(path)
        views.append(replace(view, image=path))
    frames = FrameStore(replace(capture, views={"train": tuple(views)}), "stga")
    sides = frames.sides
    folded = lids & ~is_left
    assert_array_equal(frames.surface.folded_lids, folded)
    assert not sides.visible[folded].any()
    assert_allclose(sides.color[folded] * 255, np.tile([150, 100, 80], (folded.sum(), 1)), atol=4)
    state = state_in(frames, quick_settings(sh_degree=0, sh_steps=(), lattice=1))
    state.parameters.sh[:] = -1
    for part in (state.second.sh, state.second.opacity):
        part[:] = 1
    settle(frames, state)
    bound = ~state.unbound
    at = bound & folded[state.face]
    plausible = (sides.color[state.face[at]] - 0.5) / SH_C0
    assert_allclose(state.parameters.sh[at, 0], plausible, atol=1e-4)
    shown = bound & (lids & is_left & sides.visible & ~frames.surface.hidden)[state.face]
    assert (state.parameters.sh[shown, 0] == -1).all(1).mean() > 0.6


def test_lids_close_over_eyes(moving):
    """Catches splats of an iris that stand out so far that they show on closed lids."""
    capture = moving.capture
    model = capture.flame.model
    eyeballs = np.zeros(len(capture.faces), bool)
    for side in ("left", "right"):
        eyeballs |= faces_within(model.faces, model.masks[f"{side}_eyeball"])
    for frames in (moving, FrameStore(capture, "gaussian_avatars")):
        convention = frames.convention
        state = state_in(frames, quick_settings(convention=convention))
        axis = NORMAL_AXIS[convention]
        bound = np.flatnonzero(~state.unbound)
        rng = np.random.default_rng(0)
        meters = frames.unit_lengths[state.face[bound]]
        before = rng.normal(0, 1e-3, len(bound)) / meters
        state.parameters.xyz[bound, axis] = before
        state.second.opacity[:] = 1  # as views show them
        settle(frames, state)
        height = state.parameters.xyz[bound, axis] * meters
        of_eyes = eyeballs[state.face[bound]]
        facing = (frames.sides.visible & (frames.surface.facing > 0.9))[state.face[bound]]
        expected = np.minimum(before * meters, -5e-4)
        assert_allclose(height[of_eyes & facing], expected[of_eyes & facing], atol=1e-6)
        assert (height[facing & ~of_eyes] > 0).mean() > 0.3


def test_teeth_that_views_show_are_theirs(filmed):
    """Catches teeth that are painted over as not shown, where lips leave a few of them free, or
    where they are smaller than pixels."""
    model = flame_model(None)
    names = [f"mouth{way}{side}" for way in ("UpperUp", "LowerDown") for side in ("Left", "Right")]
    moves = [model.n_identity + model.expression_names.index(name) for name in names]
    smile = filmed.neutral + model.shapedirs[:, :, moves].sum(2)
    capture = replace(
        filmed,
        views={"train": filmed.views["train"][4:5]},
        mesh=lambda _: smile,
    )
    capture = in_motion(capture, model)
    teeth = faces_within(model.faces, model.masks["teeth"])
    triangle, _ = rasterize(smile, model.faces, capture.views["train"][0].camera)
    pixels = np.bincount(triangle[triangle >= 0], minlength=len(teeth))
    shown = teeth & (pixels >= 4)
    assert 5 < shown.sum() < 0.05 * teeth.sum()
    centers = filmed.neutral[model.faces].mean(1)
    beside, near = (
        teeth & (pixels == 0) & (cKDTree(centers[own]).query(centers)[0] < reach_m)
        for own, reach_m in ((shown, 2e-3), (teeth & (pixels > 0), 8e-3))
    )
    sides = unseen_sides(Surface(capture))
    assert beside.any()
    assert not sides.triangles[shown | beside].any()
    assert sides.color[beside].min() > 0.1
    assert sides.triangles[teeth & (pixels == 0) & ~near].all()


def test_the_sides_that_were_filmed(filmed, frames):
    """Catches left for right, the surface that is seen for where cameras were, and a turn of the
    mesh."""
    empty = hidden_splats(frames, quick_settings()).rows([])

    def sides_of(turn, angles):
        views = tuple(view for view in filmed.views["train"] if view.timestep in angles)
        hidden = Surface(replace(filmed, views={"train": views})).hidden
        regions = {**filmed.regions, UNSEEN_REGION: hidden}
        neutral = (filmed.neutral @ turn.T).astype(np.float32)
        return observed_sides(Avatar(empty, "stga", neutral, filmed.faces, regions=regions))

    def filmed_from(right, left):
        return (
            f"filmed from {right}° on its right to {left}° on its left; what is beyond is plausible"
        )

    turned = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for turn in (np.eye(3), turned):
        assert sides_of(turn, range(9)) == filmed_from(60, 60)
        assert sides_of(turn, range(4, 9)) == filmed_from(0, 60)
