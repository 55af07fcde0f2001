"""Needles beside the outline."""

from dataclasses import replace

import numpy as np
import pytest
from capture import factory
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_frames
from stga_addon.capture.camera import look_at
from stga_addon.capture.images import read_image
from stga_addon.capture.open import open_capture
from stga_addon.training.optimize.outlines import Outline, OutlinePruning, read_outlines
from stga_addon.training.optimize.step_hook import Schedule
from stga_addon.training.optimize.trainer import Trainer

from .toys import Rows, bits, quick_settings, random_state


def splats_after_a_turn(capture, place, masks=True):
    """How many splats there are before and after iteration 200 of a training, one of them at a
    place in meters."""
    quiet = {"density_interval": 0, "stray_reset_interval": 0, "random_background": masks}
    trainer = Trainer(capture, quick_settings("global", **quiet), {})
    frames = face_frames(capture.neutral, capture.faces, capture.neutral)
    top = int(capture.neutral[capture.faces].mean(1)[:, 1].argmax())  # which never moves
    local = frames.rotation[top].T @ (place - frames.origin[top]) / frames.scale[top]
    trainer.state.parameters.xyz[trainer.state.face.searchsorted(top)] = local
    count = len(trainer)
    trainer.iteration = 199
    view = capture.views["train"][0]
    trainer.step(view, read_image(view), 0.5)
    return count, len(trainer)


def test_a_needle_beside_the_head_does_not_outlive_its_turn(toy):
    """Catches a spike over the hair, outside of all masks, that stays; white clothes or teeth taken
    for background, where no mask says what is; and a published method that prunes."""
    before, after = splats_after_a_turn(toy, [0.0, 0.15, 0.0])
    assert after == before - 1
    views = tuple(replace(view, mask=None) for view in toy.views["train"])
    bare = replace(toy, views={**toy.views, "train": views})
    assert read_outlines(bare, 0) == []
    for capture, masks in ((bare, True), (toy, False)):
        before, after = splats_after_a_turn(capture, [0.0, 0.15, 0.0], masks)
        assert after == before


def test_outlines_are_the_masks_of_some_training_views(tmp_path):
    """Catches masks of other views or size, too many of them, and a lost margin."""
    capture = open_capture(factory.write_mesh_capture(tmp_path / "many", range(11), range(3)))
    for path in (tmp_path / "many" / "fg_masks").iterdir():
        mask = Image.open(path).resize(
            (16 * factory.WIDTH, 16 * factory.HEIGHT), Image.Resampling.NEAREST
        )
        mask.save(path)
    large = tuple(replace(view, camera=view.camera.scaled(16)) for view in capture.views["train"])
    outlines = read_outlines(replace(capture, views={**capture.views, "train": large}), 3)
    assert len(outlines) == 16
    assert len({(each.timestep, each.camera.position.tobytes()) for each in outlines}) == 16
    for outline in outlines:
        assert outline.clear.shape == (outline.camera.height, outline.camera.width) == (400, 267)
        columns, rows = np.meshgrid(
            *((np.arange(n) + 0.5) / s for n, s in ((267, 267 / 40), (400, 400 / 60)))
        )
        covered = factory.silhouette()[rows.astype(int), columns.astype(int)]
        margin = binary_dilation(covered, iterations=4)
        assert (outline.clear != ~margin).mean() < 0.01


def pictures(rng):
    """Five cameras around posed triangles, each with half of its image clear."""
    neutral = rng.normal(0, 0.1, (12, 3))
    faces = rng.permutation(12).reshape(4, 3)
    frames = {}
    outlines = []
    for timestep in range(5):
        posed = 1.3 * neutral @ Rotation.random(random_state=timestep).as_matrix().T + rng.normal(
            0, 0.02, 3
        )
        frames[timestep] = face_frames(posed, faces, neutral)
        eye = Rotation.from_rotvec([0, 0.5 * timestep, 0]).apply([0.05, 0.1, 1.0])
        camera = look_at(eye, [0, 0, 0], 80, 60, 220.0)
        outlines.append(
            Outline(timestep, camera, np.tile(np.arange(80) >= 30 + 5 * timestep, (60, 1)))
        )
    return outlines, frames


def outside_of_most(points, outlines):
    """Whether a point, given for each outline, is clear in most images that show it."""
    clear = []
    for point, outline in zip(points, outlines, strict=True):
        camera = outline.camera
        x, y, z = camera.world_to_camera[:3] @ [*point, 1]
        column = camera.fl_x * x / z + camera.cx
        row = camera.fl_y * y / z + camera.cy
        if z > 0.01 and 0 <= column < camera.width and 0 <= row < camera.height:
            clear.append(bool(outline.clear[int(row), int(column)]))
    return sum(clear) > len(clear) / 2


@pytest.mark.parametrize("region", [None, np.array([True, False, True, True])])
def test_what_is_pruned(region):
    """Catches positions in another frame, images that do not show a point, and bald triangles."""
    rng = np.random.default_rng(2)
    outlines, frames = pictures(rng)
    state = random_state(300, 4)
    state.parameters.xyz[:] = rng.normal(0, 0.05, (300, 3))
    state.unbound[:] = (np.arange(300) % 3 == 0) & (state.face != 3)
    bald = np.flatnonzero((state.face == 3) & ~state.unbound)
    state.parameters.xyz[bald] = [0.05, 0, 0.1]
    splats = state.splats()
    pruned = np.zeros(300, bool)
    for n in range(300):
        if region is not None and not region[splats.face[n]]:
            continue
        points = []
        for timestep in range(5):
            frame = frames[timestep]
            face = splats.face[n]
            points.append(
                frame.origin[face] + frame.scale[face] * frame.rotation[face] @ splats.xyz[n]
            )
        pruned[n] = outside_of_most(points, outlines)
    for face in range(4):
        bound = np.flatnonzero((splats.face == face) & ~splats.unbound)
        if pruned[bound].all():
            pruned[bound[splats.opacity[bound].argmax()]] = False
    assert pruned[bald].sum() == len(bald) - 1
    assert 60 < pruned.sum() < 240
    before = bits(state)
    pruning = OutlinePruning(None, 0, lambda timestep, coefficients: frames[timestep])
    pruning.outlines = outlines
    rows = Rows(state)
    pruning.apply(rows, Schedule(0, 0.5, 300, region))
    after = bits(rows.state)
    for name, old in before.items():
        np.testing.assert_array_equal(after[name], old[~pruned], err_msg=name)
