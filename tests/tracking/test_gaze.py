"""Eyes against those of a posed head whose gaze is known."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.flame.forward import POSE_SIZE, RIGID_SIZE
from stga_addon.flame.model import EYEBALL_WEIGHT
from stga_addon.flame.parts import flame_model
from stga_addon.tracking.correspondence import EYE_JOINTS
from stga_addon.tracking.fit import HeadFit, RecordedTake, posed_mesh
from stga_addon.tracking.gaze import with_gaze
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.posed_points import SurfacePoints
from stga_addon.tracking.solve import person

from .test_fit import HERE, cameras, seen

TIMESTEPS = 60
ON_EYEBALLS_RAD = np.array([[0.05, -0.15], [-0.02, 0.12]])
"""How far from the foremost point a stranger's irises lie on the eyeballs: up, and to the nose."""


def pupils_of(model):
    """The foremost corner of each eyeball."""
    places = []
    for joint in EYE_JOINTS:
        eyeball = np.flatnonzero((model.weights[model.faces, joint] > EYEBALL_WEIGHT).all(1))
        corners = model.v_template[model.faces[eyeball]][..., 2]
        face, corner = np.unravel_index(corners.argmax(), corners.shape)
        places.append((eyeball[face], np.eye(3)[corner]))
    return SurfacePoints(*map(np.array, zip(*places, strict=True)))


def gazes():
    """(T, 2, 2) of both eyes, up and aside: they follow something, jump elsewhere at once, and see
    what is near half of the time."""
    time = np.arange(TIMESTEPS)
    aside = np.where(time % 30 < 20, 0.2 * np.sin(time / 8), -0.25)
    up = np.where(time % 24 < 12, 0.1, -0.08)
    near = 0.06 * (time % 40 < 20)
    return np.stack([np.stack([up, turn], axis=1) for turn in (aside - near, aside + near)], axis=1)


@pytest.fixture(scope="module")
def bundled():
    head = HeadModel(flame_model(None), "flame")
    return person(head, np.zeros(head.model.n_identity))


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    ("is_stranger", "constant", "timesteps"),
    [
        (True, (0, 0), TIMESTEPS),
        (False, (0, 0), TIMESTEPS),
        (True, (0.0, 0.35), TIMESTEPS),
        (True, (0.15, -0.35), 1),
    ],
    ids=["stranger", "known", "looks aside", "one picture"],
)
def test_eyes_turn_as_irises_are_seen_to(bundled, count, is_stranger, constant, timesteps):
    """Catches gaze that landmarks of skin or smoothing hold back, eyes of a stranger that squint
    because the model's eyeballs lie elsewhere, and a look aside that lasts, which is dropped."""
    true = gazes()[:timesteps] * (timesteps > 1) + constant
    on_eyeballs = ON_EYEBALLS_RAD if is_stranger else 0.0
    model = bundled.model
    parameters = np.zeros((timesteps, model.n_expression + RIGID_SIZE))
    pose = parameters[:, -RIGID_SIZE:]
    pose[:, 1] = 0.3 * np.sin(np.arange(timesteps) / 10)
    eyes = pose[:, POSE_SIZE - 6 : POSE_SIZE].reshape(timesteps, 2, 3)
    eyes[..., :2] = true + on_eyeballs
    fit = HeadFit(bundled, np.zeros(0), dict(enumerate(parameters)), HERE)
    places = pupils_of(model)
    rig = cameras(count)
    points = [places.on(posed_mesh(fit, own), model.faces) for own in parameters]
    found = {t: seen(rig, own, noise=0.3, seed=t) for t, own in enumerate(points)}
    take = RecordedTake(places, np.ones(2, bool), found)
    eyes[..., :2] = 0.4 * true  # what is left of it beside landmarks of skin
    gazing, warnings = with_gaze(fit, take, is_stranger)
    turned = np.stack(list(gazing.parameters.values()))
    got = turned[:, -RIGID_SIZE:][:, POSE_SIZE - 6 : POSE_SIZE].reshape(timesteps, 2, 3)[..., :2]
    assert_allclose(got, true, atol=0.045)
    others = np.s_[:, : -RIGID_SIZE + POSE_SIZE - 6]
    assert_allclose(turned[others], parameters[others])
    # the irises' places by which the model differs from the stranger
    assert len(warnings) == is_stranger
    named = re.findall(r"([+-]\d+)° to its left", "".join(warnings))
    off = np.degrees(ON_EYEBALLS_RAD[:, 1]) * is_stranger
    assert_allclose(np.array(named, int), off[: len(named)], atol=3)
