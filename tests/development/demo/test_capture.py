"""The demo's capture: its size, and pictures against the heads and cameras in its files."""

import numpy as np
import pytest
from PIL import Image
from refusal import refusal
from scipy.spatial import cKDTree

from stga_addon.capture.images import read_mask
from stga_addon.capture.mesh_geometry import silhouette
from stga_addon.capture.open import open_capture
from stga_addon.development.demo.capture import CAPTURE, unpack_capture
from stga_addon.development.demo.person import whole_head
from stga_addon.files import read_npz
from stga_addon.flame.forward import flame_forward

MAX_BYTES = 4e6
MOUTH_INSIDE = 11248, 13294  # ICT-FaceKit's vertices


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    unpack_capture(folder)
    return open_capture(folder)


def test_files_of_the_capture(capture):
    """Catches what training has seen among what it is judged by, flattened transparency, and a
    capture that outgrows the checkout."""
    seen = {
        split: [(v.timestep, v.camera_index) for v in views]
        for split, views in capture.views.items()
    }
    timesteps = {split: {timestep for timestep, _ in of} for split, of in seen.items()}
    cameras = {split: {camera for _, camera in of} for split, of in seen.items()}
    assert not timesteps["train"] & timesteps["test"]
    assert timesteps["val"] == timesteps["train"]
    assert len(cameras["val"]) == 1
    assert not cameras["train"] & cameras["val"]
    assert len(timesteps["train"]) >= 6
    assert len(timesteps["test"]) >= 2
    assert len(cameras["train"]) >= 8
    assert CAPTURE.stat().st_size <= MAX_BYTES
    with Image.open(capture.views["val"][0].image) as image:
        assert image.mode == "RGBA"


def test_heads_are_where_the_pictures_show_them(capture):
    """Catches pictures of another pose, person or camera than the files say."""
    for view in [view for views in capture.views.values() for view in views][::7]:
        head = silhouette(capture.mesh(view.timestep), capture.faces, view.camera)
        mask = read_mask(view) > 127
        assert (head & ~mask).sum() < 0.006 * head.sum(), view.image
        assert 1.0 < mask.sum() / head.sum() < 1.35, view.image


def test_the_pictured_head_moves_as_the_bundled_one(capture, shared_data):
    """Catches skinning, shapes or joints in the pictures other than in the files; the mouth's
    lining, which the pictures do not show, moves in its own way."""
    whole = whole_head(read_npz(shared_data / "ict_facekit.npz"))
    of = cKDTree(whole.v_template).query(capture.flame.model.v_template)[1]
    shown = (of < MOUTH_INSIDE[0]) | (of >= MOUTH_INSIDE[1])
    for timestep in capture.timesteps:
        posed = flame_forward(whole, capture.flame.shape, capture.flame.frame(timestep))
        np.testing.assert_allclose(posed[of][shown], capture.mesh(timestep)[shown], atol=3e-4)


def test_a_folder_that_cannot_be_written(tmp_path):
    """Catches a traceback for a full disk or a file in the way."""
    (tmp_path / "capture").write_text("")
    with refusal("cannot be written"):
        unpack_capture(tmp_path / "capture")
