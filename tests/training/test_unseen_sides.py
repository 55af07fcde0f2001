"""Colors of sides that no view shows."""

from dataclasses import replace

import numpy as np
import pytest
from capture import factory
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import cKDTree

from stga_addon.avatar.embedding import face_areas, face_frames, points_to_world, to_world
from stga_addon.avatar.file import UNSEEN_REGION
from stga_addon.avatar.lattice import NORMAL_AXIS, lattice_splats
from stga_addon.avatar.offsets import COLOR, OFFSETS
from stga_addon.avatar.splats import SH_C0, joined, sh_color
from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import connected_parts, rasterize, silhouette
from stga_addon.capture.model import View
from stga_addon.flame.forward import neutral_frame
from stga_addon.flame.model import faces_within, torso_faces
from stga_addon.flame.parts import flame_model, key_regions
from stga_addon.flame.quaternions import to_matrices
from stga_addon.render.render import render, render_avatar
from stga_addon.tracking.torso_cloth import draped, torso_sheet
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.hidden_layers import (
    OCCLUSION_OPACITY,
    hidden_splats,
    splats_behind,
)
from stga_addon.training.optimize.initial_splats import flat_points
from stga_addon.training.optimize.occlusion_layer import GRAZED_COSINE
from stga_addon.training.optimize.semantic_regions import Region, head_regions
from stga_addon.training.optimize.state import new_state, state_of_avatar
from stga_addon.training.optimize.step_hook import Schedule
from stga_addon.training.optimize.surface import GRAZING_COSINE, Surface
from stga_addon.training.optimize.surface_prior import SurfacePrior, width
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.optimize.unseen_sides import (
    SOURCE_COSINE,
    UnseenSides,
    plausible_off_axis,
    unseen_sides,
)

from .heads import PLACES, write_head
from .toys import Rows, alpha_of, quick_settings, settle, state_in

CAMERA = 3
"""Sees the ball's +x side and front, from 40° beside the middle."""


def sides_of(capture):
    return unseen_sides(Surface(capture))


@pytest.fixture(scope="module")
def from_one_side(tmp_path_factory):
    capture, _ = write_head(tmp_path_factory.mktemp("side"), error=0.0)
    own = [view for view in capture.views["train"] if view.camera_index == CAMERA]
    views = [view for view in own if view.timestep == 0]
    return replace(capture, views={"train": views})


def test_what_is_hidden_and_what_it_looks_like(from_one_side):
    """Catches another side, normal or mirror plane, and a mirrored side without its details."""
    capture = from_one_side
    sides = sides_of(from_one_side)
    neutral, posed = (
        mesh[capture.faces].mean(1) - mesh.mean(0) for mesh in (capture.neutral, capture.mesh(0))
    )
    direction, turned = (
        own / np.linalg.norm(own, axis=1, keepdims=True) for own in (neutral, posed)
    )
    cosine = turned @ factory.pose(PLACES[CAMERA])[:3, 2]
    assert sides.triangles[cosine < -0.3].mean() > 0.95
    assert sides.triangles[cosine > 0.1].mean() < 0.05  # the expression makes dents
    mirrored = direction * [-1, 1, 1]
    partner = (mirrored @ direction.T).argmax(1)
    copied = sides.triangles & (cosine[partner] > 0.7)
    assert copied.sum() > 20
    pairs = sides.color[copied].ravel(), sides.color[partner[copied]].ravel()
    assert np.corrcoef(*pairs)[0, 1] > 0.9


def test_restored_colors_are_those_of_the_avatar(from_one_side):
    """Catches a side whose color is given to the splats that train, but not to their moving
    average, which the avatar is made of, or that the optimizer's moments take away again."""
    capture = from_one_side
    trainer = Trainer(capture, quick_settings("global", lattice=1, sh_degree=1, sh_steps=()), {})
    state = trainer.state
    sides = sides_of(capture)
    rng = np.random.default_rng(0)
    for part in (state.parameters, state.average, state.first, state.second):
        part.sh[:] = rng.random(part.sh.shape)
    state.unbound[::7] = True
    before = {name: getattr(state, name).sh.copy() for name in ("average", "first", "second")}
    settle(FrameStore(capture, "stga"), state, 0)
    far = sides.triangles[state.face] & ~state.unbound
    assert 0 < far.sum() < len(far)
    expected = (sides.color[state.face[far]] - 0.5) / 0.28209479177387814
    for part in (state.parameters, state.average):
        assert_allclose(part.sh[far, 0], expected, atol=1e-6)
        assert (part.sh[far, 1:] == 0).all()
    for name, old in before.items():
        assert_array_equal(getattr(state, name).sh[~far], old[~far])
    assert (state.first.sh[far] == 0).all()
    assert (state.second.sh[far] == 0).all()


def test_a_glance_counts(from_one_side):
    """Catches sides that are judged by one view, where another shows them, and one that a few of
    many frames show, and that is painted over."""
    capture = from_one_side
    (view, *_) = capture.views["train"]
    half_turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    center = np.eye(4)
    center[:3, 3] = capture.mesh(view.timestep).mean(0)
    back = view.camera.world_to_camera @ center @ half_turn @ np.linalg.inv(center)
    glance = replace(view, camera=replace(view.camera, world_to_camera=back))
    views = [
        replace(glance if 900 <= number < 915 else view, timestep=number) for number in range(1800)
    ]
    posed = capture.mesh(view.timestep)
    video = replace(capture, views={"train": tuple(views)}, mesh=lambda _: posed)
    alone, beside, both = (
        sides_of(replace(capture, views={"train": own})).triangles
        for own in ((view,), (glance,), (view, glance))
    )
    assert (alone & ~beside).sum() > 20
    assert (beside & ~alone).sum() > 20
    assert_array_equal(both, alone & beside)
    assert_array_equal(sides_of(video).triangles, both)


HAIR = np.array([40, 25, 15], np.uint8)
GRAY = np.array([170, 160, 145], np.uint8)
SKIN = np.array([220, 170, 150], np.uint8)
CLOTH = np.array([30, 60, 160], np.uint8)
EYES = np.array([200, 180, 170], np.uint8)
TURNS_DEG = (-45, -20, 0, 20, 45)


@pytest.fixture(scope="module")
def bundled(from_one_side):
    """A capture of the bundled head at rest, without views."""
    model = flame_model(None)
    return replace(
        from_one_side,
        views={},
        faces=model.faces,
        neutral=model.v_template,
        mesh=lambda _: model.v_template,
        flame=replace(from_one_side.flame, model=model, frame=lambda _: neutral_frame(model)),
        regions=key_regions(model),
    )


def eyeballs_of(capture):
    masks = (capture.flame.model.masks[f"{side}_eyeball"] for side in ("left", "right"))
    return np.any([faces_within(capture.faces, mask) for mask in masks], axis=0)


def middles(capture):
    """Of the triangles, and their heights over the eyes, in their distance from the mouth."""
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    return centers, (centers[:, 1] - 0.04) / 0.07


def painted(capture, hair=HAIR, fringe=0.75):
    """(F, 3): hair, skin, eyes, and clothes, whose collar is higher behind than in front; behind
    the ears, skin beside gray hair is in shade."""
    centers, level = middles(capture)
    hairline = np.interp(centers[:, 2], (-0.06, 0.02), (-1.1, fringe))
    color = np.where(centers[:, 2:] < 0.02, shaded_skin(hair), SKIN)
    color[level > hairline] = hair
    color[level + 0.3 * centers[:, 2] / 0.07 < -2.4] = CLOTH
    color[eyeballs_of(capture)] = EYES
    return color


def shaded_skin(hair):
    return (0.6 if hair is GRAY else 1.0) * SKIN


def filmed(capture, color, angles, height, folder, away=1.0):
    """The capture with a view from each of these degrees around the head."""
    views = []
    for number, angle in enumerate(np.radians(angles)):
        eye = [away * np.sin(angle), height, away * np.cos(angle)]
        camera = look_at(eye, [0, -0.02, 0], 160, 200, 480)
        triangle, _ = rasterize(capture.neutral, capture.faces, camera)
        picture = np.full((200, 160, 3), 255, np.uint8)
        picture[triangle >= 0] = color[triangle[triangle >= 0]]
        path = folder / f"{number}.png"
        mask = folder / f"{number}_mask.png"
        Image.fromarray(picture).save(path)
        Image.fromarray(np.uint8(255 * (triangle >= 0))).save(mask)
        views.append(View(0, 0, camera, path.name, path, mask))
    return replace(capture, views={"train": tuple(views)})


@pytest.fixture(scope="module")
def turning(bundled, tmp_path_factory):
    """Frames of the head as it turns, which tests only read."""
    folder = tmp_path_factory.mktemp("turning")
    return FrameStore(filmed(bundled, painted(bundled), TURNS_DEG, 0.0, folder), "stga")


@pytest.fixture(scope="module")
def frontal(bundled, tmp_path_factory):
    """Frames of the head that one camera sees in front, which tests only read."""
    folder = tmp_path_factory.mktemp("frontal")
    return FrameStore(filmed(bundled, painted(bundled), (0,), 0.0, folder), "stga")


@pytest.fixture(scope="module")
def outside(bundled):
    """(F,) bool: triangles of the head that are seen from around it."""
    return Surface(bundled).outside


@pytest.mark.parametrize(
    ("angles", "height", "fringe", "hair"),
    [(TURNS_DEG, 0.0, 0.75, HAIR), (TURNS_DEG, 0.0, 0.75, GRAY), ((0,), -0.5, 0.5, HAIR)],
)
def test_hair_goes_round_the_head(angles, height, fringe, hair, bundled, tmp_path):
    """Also gray hair, hardly brighter than skin in the shade, and that of a head that does not
    turn, of which a fringe is shown, from below. Catches a back of the head in the color of skin, a
    neck with hair or in the color of clothes, and clothes that end where the camera does."""
    color = painted(bundled, hair, fringe)
    sides = sides_of(filmed(bundled, color, angles, height, tmp_path))
    centers, level = middles(bundled)
    back = sides.triangles & (centers[:, 2] < -0.03) & (np.abs(centers[:, 0]) < 0.05)
    skin = shaded_skin(hair)
    expected = {(0.2, 1.0): hair, (-0.9, -0.2): hair, (-1.8, -1.4): skin, (-3.0, -2.5): CLOTH}
    for part, own in expected.items():
        rows = back & (level > part[0]) & (level < part[1])
        assert rows.sum() > 8, part
        off = np.abs(255 * sides.color[rows] - own).max(1)
        assert (off < 25).mean() > 0.9, part


def test_a_chest_goes_on_below_the_image(bundled, tmp_path):
    """Catches a chest that has the color of the hair on the shoulders beside it."""
    color = painted(bundled)
    centers, level = middles(bundled)
    beside = np.abs(centers[:, 0])
    below = level < -1.8
    color[below] = np.where(beside[below, None] < 0.06, SKIN, HAIR)
    capture = filmed(bundled, color, (0,), 0.0, tmp_path)
    (view,) = capture.views["train"]
    rows = 165
    for file in (view.image, view.mask):
        Image.fromarray(np.asarray(Image.open(file))[:rows]).save(file)
    camera = replace(view.camera, height=rows)
    sides = sides_of(replace(capture, views={"train": (replace(view, camera=camera),)}))
    beyond = camera.project(centers)[0][:, 1] > rows
    chest = beyond & (beside < 0.04) & (centers[:, 2] > 0.02)
    assert chest.sum() > 20
    assert (np.abs(255 * sides.color[chest] - SKIN).max(1) < 25).mean() > 0.95


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_unseen_hair_grows_in_locks(convention, bundled, tmp_path):
    """Catches a helmet of one color, strands across the direction of growth or with gaps, locks
    that fade, change from turn to turn or reach skin, and light that takes them away off-axis."""
    capture = filmed(bundled, painted(bundled, GRAY), TURNS_DEG, 0.0, tmp_path)
    frames = FrameStore(capture, convention)
    surface = frames.surface
    surface.hair_height = np.where(surface.kinds["scalp"], 0.02, 0)  # as outlines would tell it
    layer = hidden_splats(frames, quick_settings(convention=convention, sh_degree=0))
    longest = np.argsort(layer.log_scale, axis=1)
    aspect = np.exp(np.diff(np.sort(layer.log_scale, axis=1), axis=1)[:, 1])
    strands = aspect > 3
    assert 2000 < strands.sum() < 4000
    centers, level = middles(bundled)
    hair = (level > -0.9) & (centers[:, 2] < -0.08)
    assert set(layer.face[strands]) >= set(np.flatnonzero(hair & surface.closed))
    assert not strands[(level < -1.5)[layer.face]].any()
    world = to_world(layer, frames.neutral)
    axes = to_matrices(world.rotation)
    along = np.take_along_axis(axes, longest[:, None, 2:], axis=2)[..., 0]
    behind = strands & (level < 0.2)[layer.face] & (abs(centers[:, 0]) < 0.04)[layer.face]
    assert np.median(abs(along[behind, 1])) > 0.85  # down, along the nape
    on_top = strands & (level > 1.2)[layer.face]
    from_above = np.array([0, -0.15, -1])  # to the crown, which lies behind the top
    assert np.median(abs(along[on_top] @ from_above)) > 0.8
    camera = look_at([0, 0.05, -1], [0, 0.05, 0], 320, 400, 960)
    triangle, _ = rasterize(bundled.neutral, bundled.faces, camera)
    shown = binary_erosion((triangle >= 0) & hair[triangle], iterations=6)
    assert shown.sum() > 2000
    assert alpha_of(layer, camera, frames.neutral)[shown].min() > 0.98
    state = new_state(joined([layer, splats_behind(frames, 0)]))
    prior = SurfacePrior(frames)
    prior.apply(Rows(state), Schedule(20, 0.5, len(state)))
    once = state.average.sh.copy()
    prior.apply(Rows(state), Schedule(40, 0.5, len(state)))
    assert_allclose(state.average.sh, once, atol=1e-3)
    kept = state.splats(averaged=True).rows(slice(len(layer)))
    assert_allclose(kept.xyz[strands], layer.xyz[strands], atol=1e-3)
    axis = NORMAL_AXIS[convention]
    wider = width(kept.rotation, kept.log_scale, axis) / width(
        layer.rotation, layer.log_scale, axis
    )
    assert np.median(wider[strands]) < 1.1
    colors = sh_color(state.average.sh, np.array([0.0, 0, 1]))[: len(layer)]
    shade = colors / frames.sides.color[layer.face]
    pinned = frames.sides.triangles[layer.face]
    assert np.ptp(shade[pinned & strands], axis=1).max() < 1e-3  # of one hue
    assert 0.08 < shade[pinned & strands].std() < 0.2
    assert abs(shade[pinned & strands].mean() - 1) < 0.02
    assert_allclose(shade[pinned & (level < -1.5)[layer.face]], 1, atol=1e-3)
    place = world.xyz[behind]
    near, apart = (
        np.corrcoef(shade[behind, 0], shade[behind, 0][nearest(place * weights)])[0, 1]
        for weights in ([50, 1, 50], [1, 50, 1])  # in the same lock, and at the same height
    )
    assert near > apart + 0.2
    splats = replace(layer, sh=once[: len(layer)])
    along = np.tile(np.float32([0, 0, 1]), (len(hair), 1))
    off_axis = plausible_off_axis(splats, along, frames.sides, frames.neutral)
    assert_array_equal(off_axis.sh[strands, 0], splats.sh[strands, 0])


LONG_HAIR_M = 0.11
"""Distance from the middle plane at which `with_long_hair` ends."""


def with_long_hair(capture, end=-0.15):
    """A capture of one view, in which hair hangs beside the neck down to a height in meters, which
    is that of the shoulders."""
    (view,) = capture.views["train"]
    ears = np.array([[-LONG_HAIR_M, 0.04, -0.01], [LONG_HAIR_M, end, -0.01]])
    (left, right), (top, bottom) = np.round(np.sort(view.camera.project(ears)[0].T)).astype(int)
    image, mask = (np.array(Image.open(file)) for file in (view.image, view.mask))
    beside = np.zeros(mask.shape, bool)
    beside[top:bottom, left:right] = mask[top:bottom, left:right] == 0
    image[beside] = HAIR
    mask[beside] = 255
    Image.fromarray(image).save(view.image)
    Image.fromarray(mask).save(view.mask)
    return capture


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_long_hair_hangs_straight_down(convention, bundled, tmp_path):
    """Catches long hair that follows the neck as a helmet's rim does, that ends inside of what the
    image shows or outside of it, and gaps in it."""
    capture = with_long_hair(filmed(bundled, painted(bundled), (0,), 0.0, tmp_path))
    frames = FrameStore(capture, convention)
    frames.surface.hair_height = np.where(frames.surface.kinds["scalp"], 0.02, 0)
    layer = hidden_splats(frames, quick_settings(convention=convention, sh_degree=0))
    hair = layer.rows(frames.sides.is_hair[layer.face])
    x, y, z = to_world(hair, frames.neutral).xyz.T
    occiput = z[(y > 0) & (y < 0.06)].min()
    for low in (-0.06, -0.05, -0.04, -0.03, -0.02):
        assert z[(y > low) & (y < low + 0.01)].min() == pytest.approx(occiput, abs=0.012)
    neck = (y > -0.06) & (y < -0.02)
    assert LONG_HAIR_M - 0.03 < np.quantile(abs(x[neck]), 0.98) < LONG_HAIR_M - 0.005
    camera = look_at([0, -0.02, -1], [0, -0.02, 0], 320, 400, 960)
    corners = np.array([[-0.075, -0.1, -0.1], [0.075, 0.0, -0.1]])
    (left, right), (top, bottom) = np.sort(camera.project(corners)[0].T).astype(int)
    alpha = alpha_of(layer, camera, frames.neutral)[top:bottom, left:right]
    assert alpha.min() > 0.98


def test_a_bob_ends_above_the_shoulders(bundled, tmp_path):
    """Catches hair that is longer than the image shows, and has the color of the neck under it."""
    color = painted(bundled)
    color[head_regions(bundled).within(Region.SIDE, Region.NAPE)] = 2.5 * HAIR
    filmed_hair = with_long_hair(filmed(bundled, color, (0,), -0.4, tmp_path), end=-0.085)
    frames = FrameStore(filmed_hair, "stga")
    layer = hidden_splats(frames, quick_settings(sh_degree=0))
    is_hair = frames.sides.is_hair[layer.face]
    height = to_world(layer, frames.neutral).xyz[:, 1]
    assert -0.115 < height[is_hair].min() < -0.08
    colors = 255 * frames.sides.color[layer.face[is_hair & (height < -0.05)]]
    assert np.abs(colors - HAIR).max() < 25


def test_long_hair_beside_the_neck_is_as_deep_as_the_ears(bundled, tmp_path):
    """Catches hair that is torn in off-axis views: as deep as the jaw above, and as the shoulders
    below."""
    capture = with_long_hair(filmed(bundled, painted(bundled), (0,), 0.0, tmp_path))
    (view,) = capture.views["train"]
    depth = []
    for has_long_hair in (False, True):
        splats = flat_points(capture, view, "stga", 0, has_long_hair=has_long_hair)
        points = points_to_world(splats.xyz, FrameStore(capture, "stga").of(0), splats.face)
        beside = (points[:, 1] < -0.04) & (abs(points[:, 0]) > 0.06)
        depth.append(points[beside, 2])
    assert min(len(each) for each in depth) > 100
    assert [np.ptp(each) > 0.07 for each in depth] == [True, False]
    assert depth[1].max() < 0.02


def test_the_less_hair_is_unseen_the_fewer_strands(bundled, turning, tmp_path):
    """Catches as many strands behind a head that cameras show nearly all around."""
    around = filmed(bundled, painted(bundled), (*TURNS_DEG, -100, 150), 0.0, tmp_path)
    count = []
    for frames in (turning, FrameStore(around, "stga")):
        layer = hidden_splats(frames, quick_settings())
        count.append(np.sum(np.exp(np.diff(np.sort(layer.log_scale, axis=1))[:, 1]) > 3))
    assert count[1] < 0.3 * count[0]


def nearest(places):
    """(N,) row of the place nearest to each of these (N, 3) but itself."""
    return cKDTree(places).query(places, 2)[1][:, 1]


def test_a_beard_goes_on_beside_the_jaw(bundled, tmp_path):
    """Catches a cheek that is bare of the beard that views from the front show at its edge alone,
    60 to 75° aside, where colors of a cheek were copied."""
    centers, level = middles(bundled)
    color = painted(bundled)
    surface = Surface(filmed(bundled, color, (0,), 0.0, tmp_path))
    of_cheek = surface.outside & (level < 0.1) & (level > -0.8) & (centers[:, 2] > 0.01)
    of_cheek &= ~surface.regions.within(Region.EAR) & ~surface.kinds["body"]
    beard = of_cheek & (surface.facing < 0.48)
    color[beard] = HAIR
    sides = sides_of(filmed(bundled, color, (0,), 0.0, tmp_path))
    unseen = beard & (surface.facing < 0.2) & (np.abs(centers[:, 0]) > 0.05)
    border, _ = cKDTree(centers[beard & (surface.facing > 0.3)]).query(centers)
    rows = unseen & (border < 0.006)
    assert rows.sum() > 20
    toward_beard, toward_skin = (
        np.linalg.norm(255 * sides.color[rows] - end, axis=1) for end in (HAIR, SKIN)
    )
    assert (toward_skin / (toward_skin + toward_beard)).mean() > 0.4  # a bare cheek: 0


def test_hair_ends_at_the_ears(bundled, frontal, outside):
    """Catches skin around ears where hair is, and hair on them: their shells stand out."""
    sides = frontal.sides
    centers, level = middles(bundled)
    beside = outside & (abs(centers[:, 0]) > 0.062) & (level > -1)
    shells = beside & (abs(centers[:, 0]) > 0.08)
    above = beside & (level > 0.35) & (centers[:, 2] < -0.01)
    behind = beside & (abs(level) < 0.3) & (centers[:, 2] < -0.03)
    for rows, color in ((shells, SKIN), (above, HAIR), (behind, HAIR)):
        rows = rows & sides.triangles
        assert rows.sum() > 20
        assert np.mean(np.abs(255 * sides.color[rows] - color).max(1) < 30) > 0.95


def test_shoulders_behind_a_shirt_are_clothed(bundled, tmp_path):
    """Catches shoulders in the color of the neck where a camera in front, lower than the face, does
    not see them: a shirt is open in front and reaches the nape."""
    color = painted(bundled)
    centers, level = middles(bundled)
    color[(color == CLOTH).all(1)] = SKIN
    color[level + 0.6 * centers[:, 2] / 0.07 < -2.2] = CLOTH
    surface = Surface(filmed(bundled, color, (0,), -0.3, tmp_path))
    sides = unseen_sides(surface)
    unseen = sides.triangles & surface.kinds["body"]
    for kind in (CLOTH, SKIN):
        rows = unseen & (color == kind).all(1)
        assert rows.sum() > 100
        away = np.abs(255 * sides.color[rows] - kind).max(1)
        assert (away < 30).mean() > 0.85


def test_what_lips_and_lids_hide(bundled, turning, outside):
    """Catches a closed mouth that is skin inside, or at the throat's end, teeth that are too white
    or train with a slit between lips, lips with a dark rim, an eye that is skin where it looks
    off-axis, and folds of ears, or eyes' sockets, that count as the mouth's inside."""
    sides = turning.sides
    hidden = sides.triangles & ~outside
    behind_lids = eyeballs_of(bundled) & hidden
    assert behind_lids.sum() > 20
    off = np.abs(255 * sides.color[behind_lids] - EYES)
    assert off.max() < 3
    centers, level = middles(bundled)
    model = bundled.flame.model
    teeth = faces_within(bundled.faces, model.masks["teeth"])
    folds = ~outside & (np.abs(centers[:, 0]) > 0.06)
    assert folds.sum() > 20
    assert not sides.triangles[folds].any()
    assert sides.triangles[teeth].all()
    assert hidden[teeth].all()
    part = connected_parts(len(bundled.neutral), bundled.faces)[bundled.faces[:, 0]]
    away = np.linalg.norm(centers - centers[bundled.regions["mouth"]].mean(0), axis=1)
    front = teeth & (away < 0.02) & (centers[:, 2] > np.quantile(centers[teeth, 2], 0.8))
    assert_allclose(np.median(sides.color[front], 0), 0.85 * EYES / 255, rtol=0.1)
    inside = hidden & ~teeth & (away < 0.06)
    throat = inside & (away > 0.04)
    end = (part == part[0]) & hidden & (level < -0.5) & (away > 0.075)
    for rows in (throat & (part == part[0]), throat & (part != part[0]), end):
        assert rows.sum() > 20
        assert sides.color[rows].max(1).mean() < 0.3
    sockets = (part == part[0]) & ~outside & (away < 0.09) & (level > -0.3)
    sockets &= ~sides.visible & (np.abs(centers[:, 0]) < 0.06)
    assert sockets.sum() > 20
    assert (sides.color[sockets].max(1) > 0.3).mean() > 0.95
    lips = np.argsort(np.where(inside & (part == part[0]), away, np.inf))[:10]
    assert (np.median(sides.color[lips], 0) > 0.4 * SKIN / 255).all()


def test_splats_behind_closed_lips_stay_small(frontal):
    """Catches splats of the lips' inner side that hang before teeth and tongue once they part."""
    capture = frontal.capture
    state = state_in(frontal, quick_settings(iterations=1))
    state.parameters.log_scale[:] += 1
    before = state.parameters.log_scale.copy()
    settle(frontal, state)
    sides = frontal.sides
    outside = frontal.surface.outside
    lips = capture.regions["mouth"] & (outside | ~sides.triangles)
    inner = lips & ~outside & ~sides.visible
    of_inner = inner[state.face] & ~state.unbound
    assert of_inner.sum() > 20
    side = np.sqrt(2 * face_areas(capture.neutral, capture.faces)) / frontal.unit_lengths
    width = np.exp(state.parameters.log_scale).max(1)
    assert (width[of_inner] < 0.4 * side[state.face[of_inner]]).all()
    of_outer = (lips & outside & sides.visible)[state.face] & ~state.unbound
    assert (state.parameters.log_scale[of_outer] == before[of_outer]).any(1).mean() > 0.9


def speaking(capture, weight, cameras):
    """The capture by so many cameras in one place, with a second timestep, in which the jaw opens
    by this weight and brows rise."""
    model = capture.flame.model
    names = model.expression_names
    changes = model.shapedirs[..., model.n_identity :]
    posed = model.v_template + changes[..., names.index("jawOpen")] * weight
    posed += changes[..., names.index("browInnerUp")]
    (view,) = capture.views["train"]
    views = tuple(
        replace(view, timestep=timestep, camera_index=camera)
        for timestep in (0, 1)
        for camera in range(cameras)
    )
    meshes = [model.v_template, posed]
    return replace(capture, views={"train": views}, timesteps=(0, 1), mesh=meshes.__getitem__)


@pytest.mark.parametrize(
    ("weight", "cameras", "stays"), [(0.1, 1, True), (0.8, 1, False), (0.1, 5, False)]
)
def test_a_mouth_that_was_never_open_stays_as_it_is(weight, cameras, stays, frontal):
    """Catches the few movements of shut lips that are continued to an open mouth, where they draw
    large splats across the teeth; and a mouth that was filmed open, or by many cameras, but does
    not follow it."""
    capture = speaking(frontal.capture, weight, cameras)
    settings = quick_settings("global", lattice=1, driven_offsets=tuple(OFFSETS))
    trainer = Trainer(capture, settings, {})
    view = capture.views["train"][-1]
    target = default_rng(0).integers(0, 255, (view.camera.height, view.camera.width, 3), np.uint8)
    trainer.step(view, target, 0.0)
    mouth = head_regions(capture).within(Region.MOUTH)
    for name, state in trainer.state.driven_offsets.items():
        changed = state.value.any((1, 2))
        assert changed[~mouth].sum() > 100
        assert changed[mouth].any() != (stays and OFFSETS[name].target != COLOR), name


def test_what_sticks_out_of_masks_is_not_closed(bundled, tmp_path):
    """Catches opaque crumbs beside the ear of a head whose turn is tracked too far in some frames,
    where the image shows what is behind the head."""
    capture = filmed(bundled, painted(bundled), TURNS_DEG, 0.0, tmp_path)
    centers, _ = middles(capture)
    cut = np.full(len(centers), np.inf)
    for view in capture.views["train"][:2]:
        mask = np.asarray(Image.open(view.mask)).copy()
        edge = int(np.flatnonzero(mask.any(0))[0]) + 25
        mask[:, :edge] = 0
        Image.fromarray(mask).save(view.mask)
        cut = np.minimum(cut, view.camera.project(centers)[0][:, 0] - edge)
    trainer = Trainer(capture, quick_settings(iterations=1), {})
    surface = trainer.frames.surface
    assert surface.sticks_out[cut < -4].all()
    assert not surface.sticks_out[cut > 12].any()
    beyond = surface.hidden & surface.sticks_out
    assert beyond.sum() > 20
    layer = hidden_splats(trainer.frames, trainer.settings)
    assert not beyond[layer.face].any()
    assert_array_equal(
        np.unique(layer.face[surface.hidden[layer.face]]), np.flatnonzero(surface.closed)
    )
    state = trainer.state
    bound = ~state.unbound & (state.parameters.opacity != OCCLUSION_OPACITY)
    state.parameters.opacity[:] = -5
    settle(trainer.frames, state)
    assert (state.parameters.opacity[bound & beyond[state.face]] == -5).all()
    assert (
        state.parameters.opacity[bound & (surface.closed & (surface.facing < -0.1))[state.face]] > 2
    ).all()


def test_a_chest_below_the_images(bundled, tmp_path):
    """Catches a chest that the background shines through where images end above it, though it
    faces the camera; one whose plausible color never reaches the average, which only steps move;
    and splats that images show, made opaque as well."""
    capture = filmed(bundled, painted(bundled), (0,), 0.0, tmp_path)
    (view,) = capture.views["train"]
    end = 120
    for path in (view.image, view.mask):
        Image.fromarray(np.asarray(Image.open(path))[:end]).save(path)
    view = replace(view, camera=replace(view.camera, height=end))
    capture = replace(capture, views={"train": (view,)})
    trainer = Trainer(capture, quick_settings(iterations=1), {})
    frames = trainer.frames
    row = view.camera.project(middles(capture)[0])[0][:, 1]
    seen, cosine = frames.surface.visible_from(np.array([0.0, 0.0, 1.0]))
    faces_camera = seen & (cosine > 0.5)
    below = faces_camera & (row > end + 5)
    assert below.sum() > 100
    state = trainer.state
    state.second.opacity[(row < end)[state.face]] = 1e-3
    before = state.parameters.opacity.copy()
    state.average.sh[:, 0] = 9
    settle(frames, state)
    of_chest = below[state.face]
    assert state.parameters.opacity[of_chest].min() > 2
    colors = 0.5 + SH_C0 * state.average.sh[of_chest, 0]
    is_plausible = np.abs(colors - frames.sides.color[state.face[of_chest]]).max(1) < 1e-4
    assert is_plausible.mean() > 0.99  # the others are of the layer behind
    shown = (faces_camera & (row < end - 5))[state.face] & ~state.unbound
    changed = state.parameters.opacity[shown] != before[shown]
    assert changed.mean() < 0.1


def test_a_mirrored_cheek(bundled, tmp_path):
    """Catches a cheek as gray as the wall that its outline is blurred with, though the other one
    is shown, and hair at the temple that turns to skin."""
    color = painted(bundled)
    centers, level = middles(bundled)
    temple = (level > 0.3) & (centers[:, 2] < 0.055)
    color[temple] = HAIR
    angles = (0, 30, 60)
    facing = Surface(filmed(bundled, color, angles, 0.0, tmp_path)).facing
    is_right = centers[:, 0] < 0
    blurred = np.where((is_right & (facing < SOURCE_COSINE))[:, None], GRAY, color)
    surface = Surface(filmed(bundled, blurred, angles, 0.0, tmp_path))
    sides = unseen_sides(surface)
    turned = surface.outside & is_right & (facing < SOURCE_COSINE - 0.02)
    cheek = turned & (centers[:, 2] > 0.03) & (abs(level + 0.4) < 0.4)
    hair = turned & temple & (centers[:, 2] > 0.03) & (level < 0.9)
    for rows in (cheek & (facing < GRAZING_COSINE), cheek, hair):
        assert rows.sum() > 20
        assert sides.visible[rows].mean() < 0.1
        away = abs(255 * sides.color[rows] - color[rows]).max(1)
        assert (away < 40).mean() > 0.9  # skin and hair are 180 levels apart


def test_a_mirrored_side_keeps_its_light(bundled, tmp_path):
    """Catches a cheek in shade that has its mirror image's light where no view shows it."""
    centers, level = middles(bundled)
    is_right = centers[:, 0] < 0
    color = np.where(is_right[:, None], 0.5, 1.0) * painted(bundled)
    surface = Surface(filmed(bundled, color, (0, 30, 60), 0.0, tmp_path))
    unseen = surface.outside & is_right & (surface.facing < GRAZING_COSINE)
    cheek = unseen & (centers[:, 2] > 0.02) & (abs(level + 0.4) < 0.4)
    assert cheek.sum() > 20
    found = 255 * unseen_sides(surface).color[cheek].mean(0)
    assert_allclose(found, 0.5 * SKIN, rtol=0.2)


def test_a_neck_lit_from_one_side(bundled, tmp_path):
    """Catches a neck whose shaded side is too bright, and whose lit side is too dark, where no view
    shows it."""
    at = Surface(filmed(bundled, painted(bundled), (0,), 0.0, tmp_path)).at
    light = 4.0 ** (0.5 * np.sin(at.azimuth) - 0.5)  # 1 on the left, 1/4 on the right
    color = light[:, None] * painted(bundled)
    surface = Surface(filmed(bundled, color, (0,), 0.0, tmp_path))
    neck = surface.outside & surface.kinds["body"] & (surface.facing < SOURCE_COSINE)
    neck &= (color == light[:, None] * SKIN).all(1)
    found = 255 * unseen_sides(surface).color
    for side in (neck & (at.azimuth > 0), neck & (at.azimuth < 0)):
        assert side.sum() > 20
        away = abs(found[side] / color[side] - 1).max(1)
        assert np.median(away) < 0.2  # 0.25 and 0.3 where only the result is relit


def test_hair_off_axis(bundled, tmp_path):
    """Catches an avatar of one camera that does not look from there as it was trained, streaks of
    hair that run around the head as they shine in front, a face that is smoothed with them, a
    training that goes on with what is plausible only, and views from several sides that are taken
    for one."""
    color = painted(bundled)
    streak = (np.arange(len(color)) % 4 == 0) & (color == HAIR).all(1)
    color[streak] = GRAY
    capture = filmed(bundled, color, (0,), 0.6, tmp_path)
    view = capture.views["train"][0]
    trainer = Trainer(capture, quick_settings(iterations=1, sh_degree=0, sh_steps=()), {})
    avatar = trainer.avatar("", None)
    splats = avatar.splats
    trained = trainer.state.splats(averaged=True)
    drawn = render_avatar(avatar, capture.neutral, view.camera)
    assert_allclose(drawn, np.clip(trainer.render(view), 0, 1), atol=0.03)
    seen = 0.5 + 0.28209479177387814 * trained.sh[:, 0]
    along = avatar.filmed_along
    centers, level = middles(capture)
    towards = centers - view.camera.position
    assert_allclose(along, towards / np.linalg.norm(towards, axis=1)[:, None], atol=1e-5)
    off_axis = sh_color(splats.sh, np.array([[1.0, 0, 0]]))
    facing = trainer.frames.surface.facing[splats.face]
    shown = ~splats.unbound & (facing > 0.6)
    hair = ~splats.unbound & (facing > 0.2) & (level[splats.face] > 1.2)
    assert hair.sum() > 20
    assert off_axis[hair].std(0).max() < 0.5 * seen[hair].std(0).max()
    cheeks = shown & (np.abs(level[splats.face]) < 0.5)
    assert_allclose(off_axis[cheeks], seen[cheeks], atol=1e-5)
    assert_allclose(state_of_avatar(avatar).parameters.sh, trained.sh, atol=1e-5)
    sides = trainer.frames.sides
    before_neck = (sides.view_dependence > 0.5)[splats.face] & ~sides.is_hair[splats.face]
    assert before_neck.sum() > 100
    assert splats.sh[before_neck, 1:].any()
    around = filmed(bundled, color, (-30, 30), 0.0, tmp_path)
    assert Trainer(around, trainer.settings, {}).avatar("", None).filmed_along is None


def test_hair_behind_a_cheek_is_no_streak_on_it():
    """Catches strands that one camera sees beside a face, on triangles of the mesh that turn away
    from it, as streaks on skin from aside; what is as dark as hair where views show it well, as
    brows, stays."""
    places = np.random.default_rng(0).normal(size=(12, 3))
    splats = lattice_splats(places, np.arange(12).reshape(4, 3), 0, 0)
    skin = np.array([0.8, 0.6, 0.5])
    hair = np.array([0.1, 0.1, 0.1])
    splats.sh[:, 0] = (np.array([skin, hair + 0.05, hair + 0.05, hair]) - 0.5) / SH_C0
    none = np.zeros(4, bool)
    sides = UnseenSides(
        triangles=none,
        visible=~none,
        color=np.tile(skin, (4, 1)),
        is_hair=np.array([False, False, False, True]),
        view_dependence=np.array([0.5, 0.2, 0.0, 1.0]),
        off_axis=np.array([skin, skin, hair + 0.05, hair]),
    )
    along = np.tile([0.0, 0, -1], (4, 1))
    neutral = face_frames(places, np.arange(12).reshape(4, 3), places, "stga")
    found = plausible_off_axis(splats, along, sides, neutral)
    seen, aside, half = (
        sh_color(found.sh, np.tile(way, (4, 1)))
        for way in ([0.0, 0, -1], [1.0, 0, 0], [np.sqrt(0.5), 0, -np.sqrt(0.5)])
    )
    assert_allclose(seen, 0.5 + SH_C0 * splats.sh[:, 0], atol=1e-5)
    assert_allclose(aside[1], skin, atol=1e-4)
    assert np.abs(half[1] - skin).max() < 0.4 * np.abs(seen[1] - skin).max()
    assert_allclose(aside[2], hair + 0.05, atol=1e-4)


def test_shoulders_have_no_stars_behind(frontal):
    """Catches free splats before shoulders and a neck, behind the front ones, that shine in any
    color where a camera sees them first, turn to skin, or change in front."""
    capture = frontal.capture
    sides = frontal.sides
    along = frontal.surface.filmed_along
    _, level = middles(capture)
    face = np.flatnonzero((level < -1.5) & ~sides.is_hair & (frontal.surface.facing > 0.3))
    splats = lattice_splats(capture.neutral, capture.faces, 0, 0).rows(face)
    splats.unbound[:] = True
    color = np.where(np.arange(len(face))[:, None] % 4 == 0, [0.9, 0.8, 0.1], 0.1)
    splats.sh[:, 0] = (color - 0.5) / SH_C0
    found = plausible_off_axis(splats, along, sides, frontal.neutral)
    front, behind = (sh_color(found.sh, sign * along[face]) for sign in (1, -1))
    assert_allclose(front, color, atol=1e-5)
    assert_allclose(behind, np.full(color.shape, 0.1), atol=0.02)


def test_a_torso_that_is_elsewhere_is_not_flat(bundled, tmp_path):
    """Catches splats of arms and hands before a chest that are pressed onto a mesh which is not
    where masks show a body."""
    capture = filmed(bundled, painted(bundled), (0,), 0.0, tmp_path)
    (view,) = capture.views["train"]
    torso = torso_faces(bundled.flame.model)
    surface = Surface(capture)
    shown = torso & ~surface.hidden
    assert surface.is_flat[shown].mean() > 0.5
    mask = np.asarray(Image.open(view.mask)).copy()
    mask[int(view.camera.project(middles(capture)[0][shown])[0][:, 1].min()) :] = 0
    Image.fromarray(mask).save(view.mask)
    assert not Surface(capture).is_flat[shown].any()


BASE = np.array([0, -0.11, 0.0])
"""The base of the neck."""
TIE = np.array([200, 20, 20], np.uint8)


def behind(frames):
    """The layer behind what views graze, and the frames that it is drawn in."""
    layer = splats_behind(frames, 0)
    return layer.rows(frames.occlusion_layer.triangles[layer.face]), frames.of(0)


def beside_masks(capture, layer, frames):
    """The highest alpha of splats where masks, with a margin, are clear."""
    found = 0.0
    for view in capture.views["train"]:
        mask = binary_dilation(np.asarray(Image.open(view.mask)) > 0, iterations=2)
        found = max(found, alpha_of(layer, view.camera, frames)[~mask].max())
    return found


@pytest.mark.parametrize(("narrower", "most_beside"), [(0.88, 0.1), (0.7, 0.15)])
def test_nobody_looks_through_a_side(bundled, tmp_path, narrower, most_beside):
    """Catches a head that is tracked wider than it is, by 10 or 25 mm at each side, through whose
    sides, transparent in all images, one sees its inside from there; and a layer that shows beside
    the masks."""
    capture = filmed(bundled, painted(bundled), TURNS_DEG, 0.0, tmp_path)
    for view in capture.views["train"]:
        narrow = silhouette(capture.neutral * [narrower, 1, 1], capture.faces, view.camera)
        Image.fromarray(np.uint8(255 * narrow)).save(view.mask)
    layer, frames = behind(FrameStore(capture, "stga"))
    assert beside_masks(capture, layer, frames) < most_beside
    centers, level = middles(capture)
    camera = look_at([1, 0, 0], [0, -0.02, 0], 160, 200, 480)
    triangle, _ = rasterize(capture.neutral, capture.faces, camera)
    for part in ((level > 0.2) & (centers[:, 2] < -0.02), (level < -1) & (centers[:, 2] < -0.01)):
        part &= level > -1.8
        own = binary_erosion((triangle >= 0) & part[triangle], iterations=7)
        assert own.sum() > 100
        assert alpha_of(layer, camera, frames)[own].min() > 0.9


def test_no_spike_behind_a_large_triangle(bundled, tmp_path):
    """Catches a splat behind a triangle much larger than others, such as a torso's corner, that is
    as large, and stands out beside it."""
    color = painted(bundled)
    of_bust = FrameStore(filmed(bundled, color, (-20, 0, 20), 0.0, tmp_path), "stga")
    _, level = middles(bundled)
    (lowest, *_) = np.argsort(np.where(of_bust.occlusion_layer.triangles, level, 0))
    neutral = np.array(bundled.neutral)
    neutral[bundled.faces[lowest, 0]] += [0, 0, -0.07]
    capture = replace(bundled, neutral=neutral, mesh=lambda _: neutral)
    capture = filmed(capture, color, (-20, 0, 20), 0.0, tmp_path)
    layer, frames = behind(FrameStore(capture, "stga"))
    width = np.exp(layer.log_scale).max(1) * frames.scale[layer.face]
    assert width.max() < 0.0105


def test_the_end_behind_a_bust_stays(turning):
    """Catches a hem behind a bust that training frays."""
    trainer = Trainer(turning.capture, quick_settings("global", lattice=None), {})
    surface = trainer.frames.surface
    state = trainer.state
    rows = (surface.border & surface.closed)[state.face] & ~state.unbound
    assert rows.sum() > 100
    before = [array[rows].copy() for array in state.parameters[:3]]
    for array in state.parameters[:3]:
        array[rows] += np.random.default_rng(0).normal(0, 0.01, array[rows].shape)
    for name in ("outliers", "unseen sides"):
        trainer.hooks[name].apply(trainer._backend, Schedule(20, 0.1, len(state)))
    for array, kept in zip(trainer.state.parameters[:3], before, strict=True):
        assert_allclose(array[rows], kept, atol=1e-6)


def test_nobody_looks_through_what_a_collar_hides(turning):
    """Catches a neck and clothes that are opaque for the cameras only, which see a collar before
    them, so that off-axis the background shows through; and a layer that reaches beyond the end
    of the mesh."""
    capture = turning.capture
    layer, frames = behind(turning)
    _, level = middles(capture)
    camera = look_at([0.85, -0.08, 0.5], [0, -0.08, 0], 160, 200, 480)
    triangle, _ = rasterize(capture.neutral, capture.faces, camera)
    dressed = (level < -1.6) & (level > -2.5) & (turning.surface.facing > GRAZED_COSINE)
    own = binary_erosion((triangle >= 0) & dressed[triangle], iterations=5)
    alpha = alpha_of(layer, camera, frames)
    assert own.sum() > 100
    assert np.mean(alpha[own] > 0.8) > 0.9
    assert alpha[~binary_dilation(triangle >= 0, iterations=2)].max() < 0.25


def test_nobody_looks_into_the_mouth_past_a_cheek(bundled, frontal, turning):
    """Catches cheeks of a head that never turned, whose splats lie along the views, without a layer
    behind them, and one where turns have shown that there are no gaps."""
    centers, level = middles(bundled)
    angle = np.degrees(np.arctan2(abs(centers[:, 0]), centers[:, 2] + 0.009))
    cheek = (abs(level + 0.5) < 0.5) & (abs(angle - 37) < 5)
    assert frontal.occlusion_layer.triangles[cheek].any()
    assert not turning.occlusion_layer.triangles[cheek].any()


def test_what_is_beside_the_jaw_lies_behind_the_face(bundled, tmp_path):
    """Catches a collar, or hair on shoulders, that stands before a cheek, as deep as the jaw that
    it is seen beside."""
    capture = filmed(bundled, painted(bundled), (0,), 0.0, tmp_path)
    (view,) = capture.views["train"]
    jaw = np.array([0.066, -0.03, 0.045])
    assert norm(middles(capture)[0] - jaw, axis=1).min() < 0.005
    (pixel,), _ = view.camera.project(jaw[None])
    mask = np.asarray(Image.open(view.mask)).copy()
    row = int(pixel[1])
    mask[row - 5 : row + 5, 30:130] = 255
    Image.fromarray(mask).save(view.mask)
    splats = flat_points(capture, view, "stga", 0)
    points = points_to_world(splats.xyz, FrameStore(capture, "stga").of(0), splats.face)
    assert len(points) > 20
    assert points[:, 2].max() < jaw[2] - 0.005


def test_a_mesh_of_a_face_alone_has_a_layer_beside_it(bundled, tmp_path):
    """Catches an error where no part of a mesh is behind the face."""
    face = head_regions(bundled).face
    regions = {name: own[face] for name, own in bundled.regions.items()}
    alone = replace(bundled, faces=bundled.faces[face], regions=regions, flame=None)
    capture = filmed(alone, painted(bundled)[face], (0,), 0.0, tmp_path)
    (view,) = capture.views["train"]
    mask = np.asarray(Image.open(view.mask)) > 0
    Image.fromarray(np.uint8(255 * binary_dilation(mask, iterations=8))).save(view.mask)
    assert len(flat_points(capture, view, "stga", 0)) > 20


def with_torso(capture, width=0.2, height=0.4):
    """The capture with the torso that tracking has drawn over a chest of this size in meters."""
    sheet = torso_sheet(capture.flame.model)
    neutral = np.array(capture.neutral, np.float64)
    x, y = np.meshgrid(np.linspace(-width, width, 41), np.linspace(-height, 0, 41))
    chest = np.stack([x, y, 0.06 - 0.5 * x**2], 2).reshape(-1, 3)
    neutral[sheet.vertices] = draped(sheet, neutral[sheet.vertices] - BASE, chest) + BASE
    return replace(capture, neutral=neutral, mesh=lambda _: neutral)


def test_a_torso_has_a_back(bundled, tmp_path):
    """Catches a torso through which, from behind, one sees its front from inside; a back that
    shows beside the masks, as large splats do; one below a bust; small splats at a torso's edge;
    and a back with the skin, or the tie, that an open collar shows in front."""
    capture = with_torso(bundled)
    assert not Surface(capture).border.any()
    centers, level = middles(capture)
    color = painted(capture)
    color[(np.abs(centers[:, 0]) < 0.145) & (level < -2.2)] = TIE
    capture = filmed(capture, color, (-20, 0, 20), 0.0, tmp_path, away=2.5)
    trainer = Trainer(capture, quick_settings(iterations=1), {})
    layer, frames = behind(trainer.frames)
    assert beside_masks(capture, layer, frames) < 0.05
    camera = look_at([0, -0.2, -2], [0, -0.2, 0], 160, 200, 480)
    triangle, _ = rasterize(capture.neutral, capture.faces, camera)
    inner = (level < -4) & (level > -6) & (np.abs(centers[:, 0]) < 0.08)
    own = (triangle >= 0) & inner[triangle]
    assert own.sum() > 300
    assert alpha_of(layer, camera, frames)[own].min() > 0.9
    shown = 255 * render(layer, camera, (1, 1, 1), frames=frames)[:, own]
    assert np.abs(shown - CLOTH[:, None]).max() < 30
    away = centers[layer.face] - points_to_world(layer.xyz, frames, layer.face)
    assert away[inner[layer.face], 2].max() > 0.05
    avatar = trainer.avatar("center", None)
    shown = render_avatar(avatar, capture.neutral, camera, (1, 1, 1))[:, own]
    assert_allclose(255 * shown, CLOTH[:, None].repeat(own.sum(), 1), atol=40)
    bust = filmed(bundled, painted(bundled), (-20, 0, 20), 0.0, tmp_path)
    of_bust = FrameStore(bust, "stga")
    assert of_bust.surface.border.any()
    layer, frames = behind(of_bust)
    away = middles(bust)[0][layer.face] - points_to_world(layer.xyz, frames, layer.face)
    assert norm(away, axis=1).max() < 0.025


def test_a_torso_is_whole_beyond_the_images(bundled, tmp_path):
    """Catches blurred, half transparent cloth where a torso leaves the images, as no view splits
    splats there; and what *Filmed Only* would show of it."""
    torso = with_torso(bundled)
    capture = filmed(torso, painted(torso), (-20, 0, 20), 0.0, tmp_path)
    trainer = Trainer(capture, quick_settings(iterations=1), {})
    surface = trainer.frames.surface
    centers, _ = middles(capture)
    within = np.zeros(len(centers), bool)
    for view in capture.views["train"]:
        pixels, _ = view.camera.project(centers)
        within |= ((pixels > 0) & (pixels < [160, 200])).all(1)
    in_front = surface.outside & (surface.facing > 0.3)
    beyond = in_front & ~within
    assert beyond.sum() > 100
    avatar = trainer.avatar("center", None)
    assert avatar.regions[UNSEEN_REGION][beyond].all()
    assert not avatar.regions[UNSEEN_REGION][in_front & within].any()
    own = avatar.splats
    face = own.face[~own.unbound]
    opacity = 1 / (1 + np.exp(-own.opacity[~own.unbound]))
    count = np.bincount(face, minlength=len(centers))
    assert np.median(count[beyond]) > 2 * np.median(count[in_front & within])
    assert np.median(opacity[beyond[face]]) > 0.9


def test_a_head_is_outside_with_any_torso(bundled, outside):
    """Catches triangles too small for the cameras that look for the outside, where a torso makes
    the mesh large: they would be taken for the mouth's inside and ears' folds."""
    beside = Surface(with_torso(bundled, 0.5, 0.8)).outside
    _, level = middles(bundled)
    head = outside & (level > -1.5)
    assert head.sum() > 5000
    assert beside[head].mean() > 0.9
