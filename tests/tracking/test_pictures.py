"""The head drawn over the footage while it is tracked."""

import numpy as np
import pytest

from stga_addon.tracking import pictures
from stga_addon.tracking.correspondence import calibrate
from stga_addon.tracking.face_networks import FaceNetworks
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.head_model import read_head_model

from .head_video import write_head_video

pytest.importorskip("cv2")
pytest.importorskip("av")


def test_first_frame_shows_the_head_where_it_is(tmp_path, monkeypatch):
    """Catches a mesh drawn beside the head, of another frame, or in another part of the image than
    is shown."""
    write_head_video(tmp_path / "head.mp4", 2)
    head, networks = read_head_model(None), FaceNetworks()
    places, reliable = calibrate(head.model, networks, "head")
    shown = []
    draw = pictures.with_mesh
    for with_mesh in (draw, lambda picture, *_: picture):
        monkeypatch.setattr(pictures, "with_mesh", with_mesh)
        footage = open_footage(tmp_path / "head.mp4")
        shown.append(pictures.picture_of_first_frame(head, footage, networks, places, reliable))
    over, plain = (picture.astype(int) for picture in shown)
    assert over.shape == (pictures.SIZE, pictures.SIZE, 3)
    drawn, skin = np.abs(over - plain).max(2) > 8, plain[..., 0] - plain[..., 2] > 20
    rows = np.flatnonzero(skin.any(1))
    above_the_neck = slice(0, rows[0] + 6 * len(rows) // 10)
    drawn, skin = drawn[above_the_neck], skin[above_the_neck]
    assert (drawn & skin).sum() > 0.7 * (drawn | skin).sum() > 0
