"""ARKit's shapes on a head of any mesh, against masks, face networks, and a solver."""

from dataclasses import replace

import numpy as np
import pytest
from flame.small_head import small_head
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal
from scipy.optimize import least_squares

from stga_addon.driving.head_map import head_map, head_turns
from stga_addon.driving.inverse import (
    arkit_weights,
    captured_performance,
    head_angles,
    write_performance,
)
from stga_addon.driving.open_motion import MotionOptions, performed
from stga_addon.driving.performance import ARKIT_SHAPES, COLUMN, Performance
from stga_addon.driving.performers import read_performance
from stga_addon.driving.shapes import EYE_JOINTS, _Surface, effective_weights, face_points
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.flame.model import JOINTS
from stga_addon.flame.parts import flame_model
from stga_addon.flame.sequence import FlameSequence

from .heads import generated_flame, random_poses, with_expressions

NOSE_TIP = 4
UPPER_LIP = 13
LOWER_LIP = 14
CHIN = 152
RIGHT_EYE = 33
LEFT_EYE = 263
MOUTH_LEFT = 291
MOUTH_RIGHT = 61
NECK = JOINTS.index("neck")


def sequence_of(model, shape=None):
    shape = np.zeros(model.n_identity) if shape is None else shape
    return FlameSequence(model, shape, None, (), {}.__getitem__)


@pytest.fixture(scope="module")
def demo():
    """The small head, whose 10 expressions are not ICT-FaceKit's, and its map."""
    sequence = sequence_of(small_head(1))
    return sequence, head_map(sequence, "demo")


@pytest.fixture(scope="module")
def rich():
    """The small head with 48 expressions that reach most shapes, and its map."""
    model = with_expressions(small_head(0), 48)
    sequence = sequence_of(model, default_rng(0).normal(0, 0.5, model.n_identity))
    return sequence, head_map(sequence, "rich")


def frame_of(found, weights):
    (frame,) = found.frames(Performance(np.zeros(1), weights[None], None, 1.0))
    return frame


def posed(sequence, found, weights):
    """(N, 3) face points of one row of weights."""
    mesh = flame_forward(sequence.model, sequence.shape, frame_of(found, weights))
    return found.points.on(mesh, sequence.model.faces)


def weights_of(**values):
    weights = np.zeros(len(ARKIT_SHAPES))
    for name, value in values.items():
        weights[COLUMN[name]] = value
    return weights


def test_points_lie_where_the_masks_are(demo):
    """Catches points on another feature, mirrored, or on the back of the head."""
    model = demo[0].model
    places, used = face_points(model, "demo")
    at = places.on(model.v_template, model.faces)
    corners = model.faces[places.face]
    assert used.sum() > 440
    for point, mask in ((NOSE_TIP, "nose"), (UPPER_LIP, "lips"), (LOWER_LIP, "lips")):
        assert np.isin(corners[point], model.masks[mask]).any(), mask
    for point, mask in ((LEFT_EYE, "left_eye_region"), (RIGHT_EYE, "right_eye_region")):
        away = norm(at[point] - model.v_template[model.masks[mask]], axis=1)
        assert away.min() < 0.006, mask
    assert at[LEFT_EYE, 0] > 0.02 and at[RIGHT_EYE, 0] < -0.02  # noqa: PT018
    assert at[CHIN, 1] < at[LOWER_LIP, 1] < at[NOSE_TIP, 1]


def test_a_head_without_eyeballs_has_its_pupils_before_the_eyes_joints(demo):
    """Catches eyes that are taken to lie in or behind their joints: the face is drawn in there."""
    model = demo[0].model
    weights = model.weights.copy()
    weights[:, NECK] += weights[:, EYE_JOINTS].sum(1)
    weights[:, EYE_JOINTS] = 0
    both = [face_points(own, "demo") for own in (model, replace(model, weights=weights))]
    points = [places.on(model.v_template, model.faces) for places, _ in both]
    used = both[0][1] & both[1][1]
    assert used.sum() > 440
    assert np.median(norm(points[0] - points[1], axis=1)[used]) < 0.0005


@pytest.mark.nightly
def test_points_agree_with_the_detector(shared_data):
    """Catches a registration that slides along the face: the networks' landmarks on pictures."""
    pytest.importorskip("cv2")
    from stga_addon.tracking.correspondence import calibrate
    from stga_addon.tracking.face_networks import FaceNetworks

    model = generated_flame(shared_data, 1)
    places, used = face_points(model, "open FLAME")
    detected, reliable = calibrate(model, FaceNetworks(), "open FLAME")
    apart = places.on(model.v_template, model.faces) - detected.on(model.v_template, model.faces)
    distance = norm(apart, axis=1)[used & reliable]
    assert np.median(distance) < 0.002
    assert np.quantile(distance, 0.9) < 0.004


def test_directions(demo):
    """Catches a jaw, lips, eyes or tongue that move the other way, or at all."""
    sequence, found = demo
    model = sequence.model
    rest = posed(*demo, weights_of())
    row = {number: index for index, number in enumerate(np.flatnonzero(found.used))}
    opened = posed(*demo, weights_of(jawOpen=1.0)) - rest
    assert opened[row[CHIN], 1] < -0.008
    assert abs(opened[row[NOSE_TIP]]).max() < 0.003
    smile = norm(posed(*demo, weights_of(mouthSmileLeft=1.0)) - rest, axis=1)
    assert smile[row[MOUTH_LEFT]] > smile[row[MOUTH_RIGHT]]
    assert posed(*demo, weights_of(jawLeft=1.0))[row[CHIN], 0] > rest[row[CHIN], 0] + 0.002
    assert_allclose(posed(*demo, weights_of(tongueOut=1.0)), rest, atol=1e-12)
    ball = model.weights[:, 3] > 0.9
    before = model.v_template[ball]
    pupil = before[:, 2].argmax()
    for name, axis, sign in (("Up", 1, 1), ("Out", 0, 1), ("In", 0, -1)):
        frame = frame_of(found, weights_of(**{f"eyeLook{name}Left": 1.0}))
        frame = replace(frame, expr=0 * frame.expr)
        moved = flame_forward(model, sequence.shape, frame)[ball][pupil] - before[pupil]
        assert sign * moved[axis] > 0.003, name


@pytest.mark.nightly
def test_combinations_against_a_free_fit(rich):
    """Catches a map that adds up shapes wrongly: closed lips on an open jaw are among the poses."""
    sequence, found = rich
    count = sequence.model.n_expression
    zero = np.zeros(3)
    faces = sequence.model.faces
    weights = random_poses(12, default_rng(3))
    rest = posed(*rich, weights_of())
    missed = []
    best = []
    for row in weights:
        wanted = rest + np.tensordot(effective_weights(row), found.targets, 1)

        def points(values):
            frame = FlameFrame(values[:count], zero, zero, values[count:], zero, np.zeros(6))
            return found.points.on(flame_forward(sequence.model, sequence.shape, frame), faces)

        def error(values):
            return (points(values) - wanted).ravel() * 1000  # noqa: B023

        free = least_squares(error, found.parameters(row[None])[0, : count + 3], max_nfev=6)
        missed.append(norm(posed(sequence, found, row) - wanted, axis=1).mean())
        best.append(norm(points(free.x) - wanted, axis=1).mean())
    assert np.mean(missed) < 1.2 * np.mean(best)  # 1.16; of FLAME 1.06


def test_there_and_back(rich, tmp_path):
    """Catches weights lost on the way to a FLAME motion and back, beyond 0.01."""
    sequence, found = rich
    weights = random_poses(40, default_rng(5)) * 0.8
    head = default_rng(6).normal(0, 0.2, (40, 3))
    take = Performance(np.arange(40) / 30, weights, head, 30.0)
    write_performance(tmp_path / "a.csv", take)
    read = read_performance(tmp_path / "a.csv")
    assert_allclose(read.weights, weights, atol=1e-6)
    motion = performed(read, sequence, "rich", MotionOptions())
    back = captured_performance(motion.sequence, "rich", motion.fps)
    write_performance(tmp_path / "b.csv", back)
    again = read_performance(tmp_path / "b.csv")
    assert_allclose(again.times, take.times, atol=1e-4)
    assert_allclose(again.head, head, atol=1e-5)
    error = np.abs(again.weights - effective_weights(weights)).max(axis=0)
    sure = [name.startswith(("eyeLook", "jawO", "jawL", "jawR")) for name in ARKIT_SHAPES]
    assert error[sure].max() < 0.01
    assert (error < 0.01).sum() >= 30, dict(zip(ARKIT_SHAPES, error.round(3), strict=True))
    # What cannot be told apart still looks the same.
    frames = [motion.sequence.frame(timestep) for timestep in motion.sequence.timesteps]
    for number, row in enumerate(arkit_weights(frames, found, sequence)[:5]):
        apart = posed(sequence, found, row) - posed(sequence, found, weights[number])
        assert norm(apart, axis=1).max() < 5e-4


def test_head_turns_are_their_angles():
    """Catches an order of yaw, pitch and roll that differs between the two ways."""
    angles = default_rng(0).uniform(-0.7, 0.7, (20, 3))
    assert_allclose(head_angles(head_turns(angles)), angles, atol=1e-9)
    assert_allclose(head_turns([[0.3, 0, 0]]), [[0, 0.3, 0]], atol=1e-12)


def test_a_head_without_a_face():
    """Catches a map of nonsense for a model in other units or axes."""
    model = small_head(0)
    small = replace(model, v_template=model.v_template * 0.001)
    with refusal("tiny: its eyes lie 0 mm apart"):
        head_map(sequence_of(small), "tiny")


def test_points_that_move_far_find_other_triangles():
    """Catches neighbors of a search before that are kept where points have left them."""
    model = flame_model(None)
    rng = default_rng(0)
    surface = _Surface(model.v_template, model.faces)
    chosen = rng.choice(len(model.faces), 50)
    points = surface.centers[chosen] + 1e-4 * surface.normals[chosen]
    normals = surface.normals
    surface.nearest(points[::-1], normals[chosen[::-1]])
    found, fresh = (
        each.nearest(points, normals[chosen])
        for each in (surface, _Surface(model.v_template, model.faces))
    )
    assert_array_equal(found[0], fresh[0])
    assert np.median(found[3]) == pytest.approx(1e-4, rel=0.1)
