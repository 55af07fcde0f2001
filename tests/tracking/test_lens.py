"""Undistortion, and where OpenCV is missing; `test_colmap.py` has each lens."""

import sys

import numpy as np
import pytest
from refusal import refusal

from stga_addon.capture.camera import look_at
from stga_addon.capture.lens import Lens, undistortion

POINTS = np.dstack(np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.5, 0.5, 7))).reshape(-1, 2)
BROWN = Lens(radial=(-0.2, 0.07, 0.01), tangential=(0.003, -0.002))
CAMERA = look_at((0, 0, 1), (0, 0, 0), 320, 240, 300.0)


LENSES = [BROWN, Lens(radial=(0.15,)), Lens("fisheye", radial=(0.05, -0.02)), Lens("fisheye")]


@pytest.mark.parametrize("lens", LENSES)
def test_undistorted_pixels_are_where_the_pinhole_sees_them(lens):
    """Catches maps that are off by half a pixel, or for another focal length than the camera that
    is returned, borders that are made up, and a pinhole that throws away more than it has to."""
    pytest.importorskip("cv2")
    found = undistortion(CAMERA, lens, "camera")

    def recorded(y, x):
        rays = (np.stack([x, y], axis=-1) - [160, 120]) / found.camera.fl_x
        return lens.distort(rays) * 300 + [160, 120]

    y, x = np.mgrid[:240, :320] + 0.5
    # the color says where a pixel was recorded
    ramp = np.stack([x * 0.75, y, 0 * x], axis=-1).astype(np.uint8)
    error = found(ramp).astype(float)[..., :2] - (recorded(y, x) * [0.75, 1] - [0.375, 0.5])
    inside = np.s_[4:-4, 4:-4]
    assert np.abs(error[inside]).max() < 1.6  # whole-number colors, rounded twice
    assert np.abs(error[inside].mean(axis=(0, 1))).max() < 0.25
    whole = recorded(*np.mgrid[:241, :321])
    margin = np.min([whole, [320, 240] - whole])
    assert -0.01 < margin < 0.05  # the border is checked at 33 points a side


def test_without_opencv_the_message_names_it(monkeypatch):
    """Catches a traceback where the optional package is missing."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    with refusal(r"^cam 3: its lens is distorted; undistorting needs opencv-python-headless"):
        undistortion(CAMERA, BROWN, "cam 3")
    assert undistortion(CAMERA, Lens(), "cam 3") is None
