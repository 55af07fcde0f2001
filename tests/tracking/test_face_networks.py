"""The face networks without MediaPipe, against what MediaPipe finds in the same pictures."""

from pathlib import Path

import numpy as np
import pytest
from flame.small_head import small_head

from stga_addon.tracking.correspondence import picture_cameras
from stga_addon.tracking.face_networks import SCORE_NAMES, FaceNetworks
from stga_addon.tracking.mesh_image import shaded_image

cv2 = pytest.importorskip("cv2")

REFERENCE = Path(__file__).with_name("mediapipe.npz")
"""Of mediapipe 0.10.21's Tasks, image mode, on `pictures`: landmarks (3, 478, 2) and scores (3, 52)."""


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """From the front, from the side, and turned in the image's plane before a wide dark background."""
    model = small_head(0)
    mesh, faces = model.v_template, model.faces
    cameras = picture_cameras(mesh)
    front, side = (shaded_image(mesh, faces, cameras[number]) for number in (0, 3))
    wide = cv2.copyMakeBorder(front, 60, 20, 40, 400, cv2.BORDER_CONSTANT, value=(30, 40, 50))
    turn = cv2.getRotationMatrix2D((300, 300), 25, 1.0)
    return [front, side, cv2.warpAffine(wide, turn, wide.shape[1::-1])]


def test_landmarks_and_scores_are_mediapipes(pictures):
    """Catches anchors, crop, rotation, resampling or an order of inputs that are not those that the networks were
    trained with."""
    reference = np.load(REFERENCE)
    for image, points, scores in zip(pictures, reference["points"], reference["scores"], strict=True):
        (found,) = FaceNetworks().detect(image)
        assert np.median(np.linalg.norm(found - points, axis=1)) < 0.1  # of 512 pixels
        weights = FaceNetworks().score(image).weights
        np.testing.assert_allclose([weights[name] for name in SCORE_NAMES], scores, atol=0.02)


def test_two_faces_and_none(pictures):
    """Catches a second face that is not reported, one face that is found twice, and faces on a wall."""
    front = pictures[0]
    assert len(FaceNetworks().detect(np.concatenate([front, front], axis=1))) == 2
    assert len(FaceNetworks().detect(front)) == 1
    assert FaceNetworks().detect(np.full_like(front, 128)) == []
    assert FaceNetworks().score(np.full_like(front, 128)) is None
