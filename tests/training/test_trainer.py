"""One step of training: what a local iteration touches, and its whole gradient."""

from dataclasses import replace

import numpy as np
import pytest
from capture import factory
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.capture.images import read_image
from stga_addon.capture.open import open_capture
from stga_addon.training.optimize.backend import RenderOptions
from stga_addon.training.optimize.frames import (
    UNSEEN_LIMIT_FRACTION,
    FrameStore,
)
from stga_addon.training.optimize.initial_splats import initial_splats, unseen_fraction
from stga_addon.training.optimize.surface import GRAZING_COSINE, UNSEEN_COSINE
from stga_addon.training.optimize.trainer import Trainer

from .test_driven_offsets import squeezed
from .toys import assert_only_selected_changed, bits, hidden_layer_size, quick_settings

WHITE = np.ones(3, np.float32)


def lower_part(capture):
    """The capture's mouth selected in timesteps 1 and 3, nothing in 0, and 4 left out."""
    nothing = np.zeros(len(capture.faces), bool)
    return {0: nothing, 1: capture.regions["mouth"], 3: capture.regions["mouth"]}


def make_trainer(capture, strategy="selective", **changes):
    quiet = {"density_interval": 0, "stray_reset_interval": 0, "driven_offsets": tuple(OFFSETS)}
    quiet |= {"warm_up_share": 0.0, "global_interval": 2}
    return Trainer(capture, quick_settings(strategy, **{**quiet, **changes}), lower_part(capture))


def view_of(capture, timestep, camera=1):
    views = [v for split in capture.views.values() for v in split]
    return next(v for v in views if (v.timestep, v.camera_index) == (timestep, camera))


def large(view, factor=3.0):
    """In a larger image, and a noisy target: many tiles and a gradient everywhere."""
    view = replace(view, camera=view.camera.scaled(factor))
    size = view.camera.height, view.camera.width, 3
    return view, default_rng(0).integers(0, 256, size, np.uint8)


def disturb(trainer):
    """Rows unlike each other, and as many coefficients as there may be."""
    rng = default_rng(1)
    for value, average in zip(trainer.state.parameters, trainer.state.average, strict=True):
        value += rng.normal(0, 0.2 if value.ndim != 2 else 1e-3, value.shape).astype(np.float32)
        average[:] = value


def test_a_local_iteration_leaves_frozen_rows_bit_identical(toy):
    """Catches momentum, limits or statistics that reach rows which are not selected, and driven
    offsets of their triangles, which would change them in all frames."""
    trainer = make_trainer(squeezed(toy), distance_weight=0.1, distance_limit=0.01, scale_limit=0.1)
    view = view_of(toy, 1)
    target = read_image(view)
    for _ in range(3):  # the third is global, so that every visible row has moments
        trainer.step(view, target, 0.5)
    assert trainer.state.first.xyz[trainer.state.steps > 0].any()
    before = bits(trainer.state)
    offsets = trainer.state.driven_offsets
    values = {name: offset.value.copy() for name, offset in offsets.items()}
    for _ in range(2):
        assert trainer.step(view, target, 0.5) is None
    selected = toy.regions["mouth"][trainer.state.face]
    assert 0.05 < selected.mean() < 0.5
    assert_only_selected_changed(before, bits(trainer.state), selected)
    for name, offset in offsets.items():
        moved = (offset.value != values[name]).any((1, 2))
        assert moved.any()
        assert not moved[~toy.regions["mouth"]].any()


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("camera", [0, 2])
def test_local_gradient_is_the_whole_images(toy, degree, camera):
    """Catches tiles left out, and pixels that count though no tile rendered them."""
    trainer = make_trainer(toy)
    disturb(trainer)
    view, target = large(view_of(toy, 1, camera))
    focus = toy.regions["mouth"][trainer.state.face]
    step = trainer._backend
    frames = step._moved_frames(view.timestep)
    options = RenderOptions(WHITE, degree)
    rows, screen, loss = step._backward(frames, view, target, options, None)
    full = {name: array.copy() for name, array in trainer.state.gradients._asdict().items()}
    screen_gradient = screen.copy()
    wanted = rows[focus[rows]].copy()
    for buffer in step._buffers._buffers.values():
        buffer.fill(1e3 if buffer.dtype.kind == "f" else 0)
    for array in trainer.state.gradients:
        array.fill(7.0)
    rows, screen, loss = step._backward(frames, view, target, options, focus)
    assert loss is None
    assert_array_equal(np.sort(rows), np.sort(wanted))
    assert 20 < len(rows) < 0.5 * len(trainer.state)
    others = np.setdiff1d(np.arange(len(trainer.state)), rows)
    unused = trainer.state.gradients.sh[:, (degree + 1) ** 2 :]
    assert (unused == 7.0).all()
    unused[rows] = 0.0
    for name, array in trainer.state.gradients._asdict().items():
        difference = np.abs(array[rows] - full[name][rows]).max(initial=0)
        assert difference <= 1e-6 * np.abs(full[name][rows]).max(initial=0), name
        assert_array_equal(array[others], 7.0)
    assert_allclose(screen[rows], screen_gradient[rows], rtol=1e-5)


def test_kinds_of_iterations(toy):
    """Catches a schedule not followed, iterations that train nothing, without a selection or with
    an empty one, and regions split more because they are drawn more."""

    def kinds(trainer, share=0.5, timesteps=(1, 1, 3, 3, 1, 1, 3, 3)):
        views = [view_of(toy, timestep, n % 2) for n, timestep in enumerate(timesteps)]
        return [trainer.step(view, read_image(view), share) is not None for view in views]

    assert kinds(make_trainer(toy), timesteps=(0, 4)) == [True, True]
    assert kinds(make_trainer(toy)) == [False, False, True, False, False, True, False, False]
    # Two local visits of frames with two views each, then a global visit.
    by_frame = kinds(make_trainer(toy, global_unit="frame", global_interval=2))
    assert by_frame == [False] * 4 + [True] * 2 + [False] * 2
    assert all(kinds(make_trainer(toy, warm_up_share=0.6)))
    assert all(kinds(make_trainer(toy, "global")))
    counted = make_trainer(toy)
    view = view_of(toy, 1)
    for expected in (0, 0, 1, 1, 1, 2):
        counted.step(view, read_image(view), 0.5)
        assert counted.state.gradient_count.max() == expected


def test_outlier_resets_and_density_control_come_when_due(toy):
    """Catches maintenance that never runs, or outside its span, or grows too far."""
    options = {"density_interval": 2, "density_span": (0.2, 0.6), "growth": 0.05}
    options |= {"lattice": 2, "stray_reset_interval": 5}
    trainer = make_trainer(toy, "global", **options)
    view = view_of(toy, 1)
    image = read_image(view)
    counts = []
    face = trainer.state.face
    trainer.state.parameters.xyz[7] = 1.0
    assert not trainer.state.unbound[7]
    for n in range(10):
        if n == 4:
            own = trainer.state.parameters.xyz[trainer.state.face == int(face[7])]
            assert norm(own, axis=1).max() > 0.9
        trainer.step(view, image, n / 10)
        counts.append(len(trainer.state))
    first = trainer.initial_count
    assert counts[:2] == [first, first]
    assert first < counts[3] <= counts[5] <= round(first * 1.05)
    assert counts[5:] == [counts[5]] * 5
    assert norm(trainer.state.parameters.xyz, axis=1).max() < 0.5


def test_initial_splats_with_hull_points(tmp_path):
    """Catches visual-hull points mixed up with the lattice, which would escape its limits."""
    hairy = open_capture(factory.write_mesh_capture(tmp_path / "hairy"))
    rows, columns = np.mgrid[: factory.HEIGHT, : factory.WIDTH] + 0.5
    mask = np.hypot(columns - factory.CX, rows - factory.CY) < 29  # the ball itself: 20 pixels
    for path in (tmp_path / "hairy" / "fg_masks").iterdir():
        Image.fromarray(mask.astype(np.uint8) * 255).save(path)
    bare = initial_splats(hairy, quick_settings(lattice=2))
    full = initial_splats(hairy, quick_settings(lattice=2, hull_points=True))
    assert len(bare) == 6 * len(hairy.faces)
    assert not bare.unbound.any()
    assert len(full) > len(bare) + 100
    assert full.unbound[len(bare) :].all()
    for name, value in vars(bare).items():
        assert_array_equal(getattr(full, name)[: len(bare)], value)


@pytest.mark.parametrize(("most", "first", "whole"), [(320, 3, 6), (319, 1, 3)])
def test_splats_of_a_triangle_by_the_mesh(toy, monkeypatch, most, first, whole):
    """Catches a fine mesh that starts with twice the splats, a lattice that was chosen and is not
    used, and one that stays coarse because density control does not know or is off."""
    monkeypatch.setattr("stga_addon.training.settings.MAX_FINE_TRIANGLES", most)
    settings = quick_settings(lattice=None, density_interval=10)
    trainer = Trainer(toy, settings, {})
    triangles = len(toy.faces)
    layer = hidden_layer_size(trainer.frames)
    shown = triangles - int(trainer.frames.surface.hidden.sum())
    assert len(trainer) == first * shown + layer
    assert trainer.initial_count == whole * shown + layer
    even = replace(settings, density_interval=0)
    assert len(initial_splats(toy, even)) == whole * triangles
    assert len(initial_splats(toy, quick_settings(lattice=0))) == triangles


def test_unseen_fraction(toy):
    """Catches seen taken for unseen, another timestep, and fractions of bound splats."""
    splats = initial_splats(toy, quick_settings(lattice=0))
    splats.unbound[::2] = True
    splats.xyz[:] += default_rng(0).normal(0, 0.1, splats.xyz.shape).astype(np.float32)
    found = unseen_fraction(toy, "stga", splats)
    first = toy.views["train"][0].timestep
    frames = face_frames(toy.mesh(first), toy.faces, toy.neutral, "stga")
    world = to_world(splats, frames).xyz.astype(np.float64)
    unseen = []
    for view in (view for view in toy.views["train"] if view.timestep == first):
        camera = view.camera
        x, y, z = camera.world_to_camera[:3, :3] @ world.T + camera.world_to_camera[:3, 3:]
        column = camera.fl_x * x / z + camera.cx
        row = camera.fl_y * y / z + camera.cy
        beside = (column < 0) | (column >= camera.width) | (row < 0) | (row >= camera.height)
        unseen.append(beside | (z < 0.01))
    assert_allclose(found[::2], np.mean(unseen, axis=0)[::2], atol=1e-6)
    assert not found[1::2].any()
    assert 0.05 < found[::2].mean() < 0.95


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_scale_limits_in_meters(toy, convention):
    """Catches bound and unbound limits mixed up, triangles taken for meters, and large splats on
    triangles that no camera faces."""
    settings = quick_settings(convention=convention, scale_limit=3.0, unbound_scale_limit=2.0)
    store = FrameStore(toy, convention)
    bound, unbound = store.scale_limits(settings)
    facing = store.surface.facing
    share = np.interp(facing, (UNSEEN_COSINE, GRAZING_COSINE), (UNSEEN_LIMIT_FRACTION, 1))
    assert 0 < (share < 1).mean() < 0.8
    assert_allclose(bound, 3 * share * store.units, rtol=1e-6)
    diagonal = norm(toy.neutral.max(0) - toy.neutral.min(0))
    frames = face_frames(toy.neutral, toy.faces, toy.neutral, convention)
    expected = 2 * max(0.004, diagonal / 200) * share
    assert_allclose(unbound * frames.scale, expected, rtol=1e-5)
