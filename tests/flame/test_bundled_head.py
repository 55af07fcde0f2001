"""The head model that comes with the package, against ICT-FaceKit's own arrays and rigid motion."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import rasterize
from stga_addon.development.arkit_shapes import ict_names
from stga_addon.driving.performance import ARKIT_SHAPES
from stga_addon.flame.forward import flame_forward, joint_positions, neutral_frame
from stga_addon.flame.model import BUNDLED_HEAD, JOINTS, SHAPE_STEP_M, torso_faces
from stga_addon.flame.parts import flame_model, key_regions
from stga_addon.flame.teeth import lip_pairs
from stga_addon.tracking.solve import LID_SHAPES

from .small_head import small_head, write_flame

MAX_BYTES = 6e6
MIN_TRIANGLES = 20_000
MAX_TRIANGLES = 26_000
METERS_PER_UNIT = 0.01
SETBACK_M = 0.0007
MOUTH_INSIDE = 11248, 13294  # ICT-FaceKit's vertices


@pytest.fixture(scope="module")
def head():
    return flame_model(None)


def posed(head, shape=None, **changed):
    frame = replace(neutral_frame(head), **changed)
    return flame_forward(head, np.zeros(head.n_identity) if shape is None else shape, frame)


def expression(head, **weights):
    values = np.zeros(head.n_expression)
    for name, weight in weights.items():
        values[head.expression_names.index(name)] = weight
    return values


def test_size_and_names(head):
    """Catches a file that outgrows the extension, and shapes that are missing or not in ARKit's
    words."""
    assert BUNDLED_HEAD.stat().st_size <= MAX_BYTES
    assert MIN_TRIANGLES <= len(head.faces) <= MAX_TRIANGLES
    assert set(head.expression_names) == set(ARKIT_SHAPES) - {"tongueOut"}
    assert set(key_regions(head)) == {"left_eye", "right_eye", "mouth", "nose"}
    assert (np.bincount(head.faces.ravel(), minlength=len(head.v_template)) > 0).all()
    assert torso_faces(head).any()


def test_vertices_and_shapes_are_ict_facekits(head, shared_data):
    """Catches thinning that moves vertices, and shapes of other vertices, another scale, order or
    side."""
    with np.load(shared_data / "ict_facekit.npz") as source:
        neutral = cKDTree(METERS_PER_UNIT * source["neutral"].astype(np.float64))
        is_ball = head.weights[:, 3:].max(1) == 1
        distance, of = neutral.query(head.v_template + [0, 0, SETBACK_M] * is_ball[:, None])
        assert distance.max() < 1e-7
        row = {str(name): number for number, name in enumerate(source["expression_names"])}
        parts = (ict_names(name) for name in head.expression_names)
        expressions = [sum(source["expression"][row[part]] for part in own) for own in parts]
        wanted = np.concatenate([source["identity"], expressions])[:, of].astype(np.float64)
    missed = np.abs(np.moveaxis(head.shapedirs, 2, 0) - METERS_PER_UNIT * wanted)
    # pushed back by lids; drawn along by the skin before them
    missed[:, is_ball | ((of >= MOUTH_INSIDE[0]) & (of < MOUTH_INSIDE[1]))] = 0
    assert np.quantile(missed, 0.999) <= SHAPE_STEP_M / 2 + 1e-9  # some vertices coincide


def test_eyeballs_turn_in_their_lids(head):
    """Catches an eyeball that wobbles about another center, turns the other way, or pulls skin
    along."""
    straight = posed(head)
    looking = posed(head, eyes_pose=np.array([0, 0.4, 0, 0, 0.4, 0]))
    joints = joint_positions(head, head.v_template)
    for side, joint in (("left", "left_eye"), ("right", "right_eye")):
        eyeball = head.masks[f"{side}_eyeball"]
        center = joints[JOINTS.index(joint)]
        radius = [norm(mesh[eyeball] - center, axis=1) for mesh in (straight, looking)]
        assert_allclose(*radius, atol=1e-9)
        assert np.ptp(radius[0]) < 0.0025  # a ball with a cornea
        front = eyeball[straight[eyeball, 2].argmax()]
        assert looking[front, 0] > straight[front, 0] + 0.003  # about +y, towards the person's left
    eyeballs = np.concatenate([head.masks[f"{side}_eyeball"] for side in ("left", "right")])
    skin = np.setdiff1d(np.arange(len(straight)), eyeballs)
    assert_array_equal(looking[skin], straight[skin])


def seen_eyeball(model, shape, **weights):
    """Square millimeters of the left eyeball that are seen from the front between the lids, and
    through their skin."""
    mesh = posed(model, shape, expr=expression(model, **weights))
    joint = JOINTS.index("left_eye")
    at = mesh[model.masks["left_eyeball"]].mean(0)
    eye = at + np.array([0, 0, 0.5])
    pixel_mm = 0.5
    camera = look_at(eye, at, 80, 80, 80 / 0.08)
    is_ball = (model.weights[model.faces, joint] == 1).all(1)
    lids = np.isin(model.faces, model.masks["left_eye_region"]).all(1)
    a, b, c = np.moveaxis(mesh[model.faces], 1, 0)
    lids &= (np.cross(b - a, c - a) * (eye - a)).sum(1) > 0
    first, _ = rasterize(mesh, model.faces, camera)
    skin = np.flatnonzero(~is_ball)
    behind, _ = rasterize(mesh, model.faces[skin], camera)
    ball = (first >= 0) & is_ball[first]
    skin_behind = (behind >= 0) & lids[skin[behind]]
    return pixel_mm**2 * np.array([(ball & ~skin_behind).sum(), (ball & skin_behind).sum()])


def test_lids_close_before_the_eyeballs(head):
    """Catches eyeballs that poke through lids on their way, of people other than the average, and
    lids that do not close where tracking takes them to be closed."""
    average = np.zeros(head.n_identity)
    rng = np.random.default_rng(0)
    people = [average, *rng.normal(size=(4, head.n_identity))]
    looking_down = {"eyeLookDownLeft": 1.0, "eyeBlinkLeft": 1 - LID_SHAPES["eyeLookDown"]}
    ways = [{name: w} for name in ("eyeBlinkLeft", "eyeLookDownLeft") for w in (0.5, 1.0)]
    for weights in (*ways, looking_down):
        assert max(seen_eyeball(head, person, **weights)[1] for person in people) < 5
    opening = seen_eyeball(head, average)[0]
    assert opening > 150
    for weights in ({"eyeBlinkLeft": 1.0}, looking_down):
        assert seen_eyeball(head, average, **weights)[0] < 0.1 * opening
    looking_down["eyeBlinkLeft"] -= 0.2
    assert seen_eyeball(head, average, **looking_down)[0] > 0.1 * opening


def back_sides(model, shape, weights):
    """Pixels below the lips that show the back of a triangle, from the front."""
    mesh = posed(model, shape, expr=expression(model, **weights))
    lips = mesh[model.masks["lips"]]
    at = np.array([lips[:, 0].mean(), lips[:, 1].min() - 0.004, lips[:, 2].max()])
    eye = at + np.array([0, 0, 0.5])
    first, _ = rasterize(mesh, model.faces, look_at(eye, at, 48, 48, 600))
    seen = np.unique(first[first >= 0])
    a, b, c = np.moveaxis(mesh[model.faces[seen]], 1, 0)
    away = seen[(np.cross(b - a, c - a) * (eye - a)).sum(1) < 0]
    return int(np.isin(first, away).sum())


def test_the_mouths_lining_stays_behind_the_chin(head):
    """Catches a lining that pursed lips push out through the chin, of some people: it is seen as a
    hole there, and trained on."""
    ways = [
        {"mouthPucker": 1.0},
        {"mouthPucker": 0.8, "mouthPressLeft": 0.6, "mouthPressRight": 0.6},
        {"mouthPucker": 0.5, "mouthLeft": 0.8, "jawOpen": 0.3},
    ]
    people = np.random.default_rng(0).normal(size=(24, head.n_identity))
    people[12:] *= 1.2
    for person in (people[3], people[12], people[16]):
        assert [back_sides(head, person, weights) for weights in ways] == [0, 0, 0]
        assert back_sides(head, 1.3 * person, ways[2]) == 0


def test_neck_turns_the_skull_alone(head):
    """Catches shoulders that turn along, a skull that bends, and teeth left behind."""
    turned = posed(head, neck_pose=np.array([0, 0.5, 0]))
    straight = posed(head)
    skull = np.flatnonzero(head.weights[:, JOINTS.index("neck")] == 1)
    assert np.isin(head.masks["teeth"], skull).all()
    assert np.isin(head.masks["nose"], skull).all()
    both = (mesh[skull] - mesh[skull].mean(0) for mesh in (straight, turned))
    assert_allclose(*(norm(mesh, axis=1) for mesh in both), atol=1e-9)
    torso = np.unique(head.faces[torso_faces(head)])
    assert norm(turned[torso] - straight[torso], axis=1).max() < 0.012
    bottom = torso[straight[torso, 1] < -0.15]
    assert_allclose(turned[bottom], straight[bottom], atol=1e-9)


def test_lips_part_when_the_jaw_opens(head):
    """Catches pairs on one lip, or of lips that are apart already."""
    upper, lower = lip_pairs(head)
    assert len(upper) > 10
    meshes = posed(head), posed(head, expr=expression(head, jawOpen=1.0))
    gaps = [norm(mesh[upper] - mesh[lower], axis=1) for mesh in meshes]
    assert gaps[0].max() < 0.002
    assert gaps[1].max() > 0.02


def test_a_changed_model_file_is_read_again(tmp_path):
    """Catches a model that is remembered although its file has changed, or masks were laid beside
    it, and one that every button reads again."""
    path = tmp_path / "model.npz"
    write_flame(replace(small_head(0), masks={}), path)
    first = flame_model(path)
    assert flame_model(path) is first
    (tmp_path / "FLAME_masks.pkl").write_bytes(pickle.dumps({"nose": np.arange(5)}, 2))
    assert "nose" in flame_model(path).masks
    write_flame(small_head(1), path)
    assert not np.array_equal(flame_model(path).v_template, first.v_template)
