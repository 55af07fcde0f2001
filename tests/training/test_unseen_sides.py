"""Sides that no training view shows: which they are, and what color their splats keep."""

from dataclasses import replace

import numpy as np
import pytest
from capture import factory

from stga_addon.capture.images import read_image
from stga_addon.capture.model import Capture
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.optimize.unseen_sides import unseen_sides

from .heads import PLACES, write_head
from .toys import quick_settings

CAMERA = 3
"""Sees the ball's +x side and front, from 40° beside the middle."""


@pytest.fixture(scope="module")
def from_one_side(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    capture, _ = write_head(tmp_path_factory.mktemp("side"), error=0.0)
    views = [
        view
        for view in capture.views["train"]
        if view.camera_index == CAMERA and view.timestep == 0
    ]
    return replace(capture, views={"train": views})


def test_what_is_hidden_and_what_it_looks_like(from_one_side: Capture) -> None:
    """Catches a side taken for another, a normal turned inside, and a mirror at a wrong plane:
    against the ball."""
    capture, sides = from_one_side, unseen_sides(from_one_side)
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
    np.testing.assert_array_equal(sides.color[copied], sides.color[partner[copied]])


def test_training_leaves_them_their_color(from_one_side: Capture) -> None:
    """Catches splats of the far side that take any color, where they shine through the near side,
    and a near side that is reset."""
    capture = from_one_side
    trainer = Trainer(
        capture, quick_settings("global", iterations=200, lattice=1, sh_degree=1, sh_steps=()), {}
    )
    view = capture.views["train"][0]
    image = read_image(view)
    for n in range(200):
        trainer.step(view, image, n / 200)
    sides, splats = unseen_sides(capture), trainer.state.splats()
    far = sides.triangles[splats.face]
    expected = (sides.color[splats.face[far]] - 0.5) / 0.28209479177387814
    np.testing.assert_allclose(splats.sh[far, 0], expected, atol=1e-6)
    assert (splats.sh[far, 1:] == 0).all()
    near = splats.sh[~far, 0] - (sides.color[splats.face[~far]] - 0.5) / 0.28209479177387814
    assert np.abs(near).max() > 0.01
