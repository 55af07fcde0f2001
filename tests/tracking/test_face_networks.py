"""The face networks without MediaPipe, against what MediaPipe finds in the same pictures."""

from pathlib import Path

import numpy as np
import pytest
from flame.small_head import small_head

from stga_addon.flame.model import EYEBALL_WEIGHT
from stga_addon.flame.teeth import flame_model
from stga_addon.tracking.correspondence import calibrate, picture_cameras, shaded_image
from stga_addon.tracking.face_networks import IRIS_CENTERS, SCORE_NAMES, FaceNetworks

cv2 = pytest.importorskip("cv2")

REFERENCE = Path(__file__).with_name("mediapipe.npz")
"""Of mediapipe 0.10.21's Tasks, image mode, on `pictures`: landmarks (3, 478, 2) and scores (3,
52)."""


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """From the front, from the side, and turned in the image's plane before a wide dark
    background."""
    model = small_head(0)
    mesh, faces = model.v_template, model.faces
    cameras = picture_cameras(mesh)
    front, side = (shaded_image(mesh, faces, cameras[number]) for number in (0, 3))
    wide = cv2.copyMakeBorder(front, 60, 20, 40, 400, cv2.BORDER_CONSTANT, value=(30, 40, 50))
    turn = cv2.getRotationMatrix2D((300, 300), 25, 1.0)
    return [front, side, cv2.warpAffine(wide, turn, wide.shape[1::-1])]


def test_landmarks_and_scores_are_mediapipes(pictures):
    """Catches other anchors, crops or inputs than networks had, faces found twice or on a wall."""
    reference = np.load(REFERENCE)
    for image, points, scores in zip(
        pictures, reference["points"], reference["scores"], strict=True
    ):
        (found,) = FaceNetworks().detect(image)
        assert np.median(np.linalg.norm(found - points, axis=1)) < 0.1  # of 512 pixels
        weights = FaceNetworks().score(image).weights
        np.testing.assert_allclose([weights[name] for name in SCORE_NAMES], scores, atol=0.02)
    front = pictures[0]
    assert len(FaceNetworks().detect(np.concatenate([front, front], axis=1))) == 2
    assert len(FaceNetworks().detect(front)) == 1
    assert FaceNetworks().detect(np.full_like(front, 128)) == []
    assert FaceNetworks().score(np.full_like(front, 128)) is None


def test_landmarks_of_lips_and_lids_lie_on_what_moves_them():
    """Catches the lower lip's landmarks on the upper lip, which they touch while the mouth is
    closed, and those of lids on the eyeballs: an open mouth would be tracked as closed, and a blink
    as half of one."""
    model = flame_model(None)
    places, _ = calibrate(model, FaceNetworks(), "head")

    def moved(name):
        shape = model.shapedirs[:, :, model.n_identity + model.expression_names.index(name)]
        return np.linalg.norm(places.on(shape, model.faces), axis=1)

    upper, lower = (
        moved("jawOpen")[[80, 82, 13, 312, 310]],
        moved("jawOpen")[[88, 87, 14, 317, 318]],
    )
    assert upper.max() < 0.01 < 0.025 < lower.min()
    on_eyeballs = (model.weights[model.faces, 3:] > EYEBALL_WEIGHT).any((1, 2))[places.face]
    assert np.flatnonzero(on_eyeballs).tolist() == sorted(IRIS_CENTERS)
    assert moved("eyeBlinkLeft")[[385, 386, 387]].min() > 0.003
