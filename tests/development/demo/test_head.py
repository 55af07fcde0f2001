"""The synthetic head: a sound mesh in FLAME's format whose parts do what they are named for."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from stga_addon.development.demo.blend_shapes import EXPRESSIONS, IDENTITY
from stga_addon.development.demo.head import JOINT_POSITIONS, Head, synthetic_flame, synthetic_head, write_flame
from stga_addon.development.demo.head_mesh import PARTS
from stga_addon.development.demo.paint import paint
from stga_addon.development.demo.skin import EYE, EYE_RADIUS, hair_offset
from stga_addon.flame.forward import FlameFrame, flame_forward, neutral_frame
from stga_addon.flame.model import FlameModel, key_regions, read_flame


@pytest.fixture(scope="module")
def head() -> Head:
    return synthetic_head(3, 1)


@pytest.fixture(scope="module")
def dense() -> Head:
    return synthetic_head(3, 3)


def _expression(model: FlameModel, **amounts: float) -> FlameFrame:
    neutral = neutral_frame(model)
    expr = np.array([amounts.get(name, 0.0) for name in EXPRESSIONS])
    return FlameFrame(
        expr, neutral.rotation, neutral.neck_pose, neutral.jaw_pose, neutral.translation, neutral.eyes_pose
    )


def test_survives_the_file(tmp_path: Path, head: Head) -> None:
    # Catches a model file that our own FLAME reader would reject or change.
    path = tmp_path / "flame_model.npz"
    write_flame(synthetic_flame(3), path)
    model = read_flame(path)
    for name in ("v_template", "shapedirs", "posedirs", "j_regressor", "weights", "faces", "parents"):
        np.testing.assert_array_equal(getattr(model, name), getattr(head.model, name))
    assert (model.n_identity, model.n_expression) == (len(IDENTITY), len(EXPRESSIONS))
    assert model.masks.keys() == head.model.masks.keys()
    for name, ids in model.masks.items():
        np.testing.assert_array_equal(ids, head.model.masks[name])


@pytest.mark.parametrize("level", [1, 3])
def test_a_sound_surface(level: int) -> None:
    # Catches flipped, doubled or collapsed triangles, holes between the grid, its slits and its pockets.
    head = synthetic_head(0, level)
    model = head.model
    mesh = trimesh.Trimesh(model.v_template, model.faces, process=False)
    assert mesh.is_winding_consistent
    assert mesh.area_faces.min() > 1e-9
    assert len(np.unique(model.faces)) == len(model.v_template)
    assert mesh.body_count == 5  # skin, two eyeballs, two rows of teeth
    edges, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    assert counts.max() == 2
    border = np.unique(edges[counts == 1])
    skin = border[head.part[border] == PARTS.index("skin")]
    np.testing.assert_array_equal(skin, model.masks["boundary"])  # the neck's base is open
    hidden = border[np.isin(head.part[border], [PARTS.index("mouth"), PARTS.index("eyeball")])]
    assert not len(hidden)  # as are the lids' ends on the eyeball and the teeth's rims, but nothing else


def test_faces_outwards(head: Head) -> None:
    # Catches a head turned inside out: the solid bodies must have a positive volume.
    model = head.model
    for name in ("left_eyeball", "right_eyeball"):
        ids = model.masks[name]
        eyeball = trimesh.Trimesh(model.v_template, model.faces[np.isin(model.faces, ids).all(1)], process=False)
        assert eyeball.is_watertight
        assert 0.9 < eyeball.volume / (4 / 3 * np.pi * EYE_RADIUS**3) < 1.0
    skin = trimesh.Trimesh(model.v_template, model.faces[(head.part[model.faces] == 0).all(1)], process=False)
    outward = np.einsum("fc,fc->f", skin.face_normals, skin.triangles_center - [0, skin.centroid[1], skin.centroid[2]])
    assert (outward > 0).mean() > 0.9


def test_size_of_a_human_head(head: Head) -> None:
    # Catches a wrong unit, and a face that does not look along +z with y up.
    model = head.model
    extent = np.ptp(model.v_template, axis=0)
    assert 0.14 < extent[0] < 0.22
    assert 0.27 < extent[1] < 0.34
    assert 0.19 < extent[2] < 0.26
    centre = {name: model.v_template[ids].mean(0) for name, ids in model.masks.items()}
    assert centre["nose"][2] > centre["left_ear"][2] + 0.08
    assert centre["scalp"][1] > centre["nose"][1] > centre["lips"][1] > centre["neck"][1]
    assert centre["left_eyeball"][0] > 0 > centre["right_eyeball"][0]
    assert centre["left_eye_region"][0] > 0 > centre["right_eye_region"][0]


def test_key_regions_do_not_overlap(head: Head) -> None:
    # Catches a triangle that two regions claim, or a region the selection could never find.
    regions = key_regions(head.model)
    assert set(regions) == {"left_eye", "right_eye", "mouth", "nose"}
    assert np.sum(list(regions.values()), axis=0).max() == 1
    assert all(members.sum() > 60 for members in regions.values())


def test_skinning_is_a_partition(head: Head) -> None:
    # Catches weights that would scale the head, joints off their place, and teeth or eyes on the wrong bone.
    model = head.model
    assert model.weights.min() >= 0
    np.testing.assert_allclose(model.weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(model.j_regressor.sum(1), 1, atol=1e-9)
    np.testing.assert_allclose(model.j_regressor @ head.rest, JOINT_POSITIONS, atol=1e-9)
    np.testing.assert_array_equal(model.weights[model.masks["left_eyeball"], 3], 1)
    np.testing.assert_array_equal(model.weights[model.masks["right_eyeball"], 4], 1)


def test_left_is_the_mirror_of_right() -> None:
    # Catches an asymmetric grid, and one-sided expressions other than the two blinks.
    model = synthetic_flame(5)
    for name in ("neutral", "smile", "pucker", "frown", "brows_up", "brows_down", "cheek_puff", "lips_open", "squint"):
        vertices = flame_forward(model, np.zeros(len(IDENTITY)), _expression(model, **{name: 1.0}))
        distance, _ = cKDTree(vertices).query(vertices * [-1, 1, 1])
        assert distance.max() < 1e-9


@pytest.mark.parametrize(
    ("action", "moves", "keeps"),
    [
        ("smile", "lips", "forehead"),
        ("pucker", "lips", "forehead"),
        ("frown", "lips", "forehead"),
        ("lips_open", "lips", "forehead"),
        ("brows_up", "forehead", "lips"),
        ("brows_down", "forehead", "lips"),
        ("cheek_puff", "face", "scalp"),
        ("blink_left", "left_eye_region", "right_eye_region"),
        ("blink_right", "right_eye_region", "left_eye_region"),
        ("squint", "face", "scalp"),
    ],
)
def test_expressions_stay_where_they_belong(head: Head, action: str, moves: str, keeps: str) -> None:
    # Catches an action that shifts the whole head (selection would take everything) or does next to nothing.
    model = head.model
    moved = np.linalg.norm(model.shapedirs[:, :, len(IDENTITY) + EXPRESSIONS.index(action)], axis=1)
    assert moved[model.masks[moves]].max() > 0.003
    assert moved[model.masks[keeps]].max() < 0.0015
    assert moved[model.masks["teeth"]].max() == 0


def _lid_gap(vertices: np.ndarray, head: Head) -> float:
    """Height of the left eye's opening in its middle: lid edges are where the lid's pocket starts."""
    faces = head.model.faces[(head.part[head.model.faces] == PARTS.index("lid")).any(1)]
    edge = np.unique(faces[head.part[faces] == PARTS.index("skin")])
    middle = edge[abs(head.rest[edge, 0] - EYE[0]) < 0.004]
    return float(np.ptp(vertices[middle, 1]))


def test_blink_closes_the_eye_and_lids_stay_on_the_eyeball(dense: Head) -> None:
    # Catches lids that stop half-way or cut through the eyeball anywhere on their way.
    model, shape = dense.model, np.zeros(len(IDENTITY))
    lids = np.flatnonzero((dense.part == 0) & (dense.rest[:, 0] > 0))
    eye = (model.j_regressor @ model.v_template)[3]
    gaps = []
    for amount in (0.0, 0.5, 1.0):
        vertices = flame_forward(model, shape, _expression(model, blink_left=amount))
        gaps.append(_lid_gap(vertices, dense))
        front = lids[vertices[lids, 2] > eye[2]]
        assert np.linalg.norm(vertices[front] - eye, axis=1).min() > EYE_RADIUS - 0.0002
    assert gaps[0] > 0.006
    assert gaps[2] < 0.0022


def test_the_jaw_opens_the_mouth(head: Head) -> None:
    # Catches lips that stick together, and an upper jaw that goes along.
    model = head.model
    neutral = neutral_frame(model)
    opened = FlameFrame(
        neutral.expr, neutral.rotation, neutral.neck_pose, np.array([0.3, 0, 0]), neutral.translation, neutral.eyes_pose
    )
    moved = flame_forward(model, np.zeros(10), opened) - flame_forward(model, np.zeros(10), neutral)
    lips = model.masks["lips"]
    assert moved[lips, 1].min() < -0.015
    teeth = model.masks["teeth"]
    assert abs(moved[teeth[: len(teeth) // 2]]).max() < 1e-12
    assert moved[teeth[len(teeth) // 2 :], 1].max() < -0.01
    assert abs(moved[model.masks["nose"]]).max() < 0.002


def test_density_changes_nothing_but_density(head: Head, dense: Head) -> None:
    # Catches a pictured head that drifts away from the tracked one: shared grid points, posed by the same parameters.
    assert len(dense.model.v_template) > 7 * len(head.model.v_template)
    rng = np.random.default_rng(1)
    frame = FlameFrame(
        expr=rng.random(len(EXPRESSIONS)),
        rotation=rng.normal(0, 0.3, 3),
        neck_pose=rng.normal(0, 0.2, 3),
        jaw_pose=np.array([0.2, 0.05, 0.0]),
        translation=rng.normal(0, 0.1, 3),
        eyes_pose=rng.normal(0, 0.2, 6),
    )
    shape = rng.normal(size=len(IDENTITY))
    coarse_mesh = flame_forward(head.model, shape, frame, hair_offset(head.rest))
    dense_mesh = flame_forward(dense.model, shape, frame, hair_offset(dense.rest))
    shared = head.part == PARTS.index("skin")
    distance, _ = cKDTree(dense_mesh).query(coarse_mesh[shared])
    # Hair moves joints by where its vertices lie, which differs a little between densities.
    assert distance.max() < 3e-4
    without = [flame_forward(h.model, shape, frame)[h.part == PARTS.index("skin")] for h in (head, dense)]
    distance, _ = cKDTree(without[1]).query(without[0])
    assert distance.max() < 1e-6


def test_seeds_are_people() -> None:
    # Catches a seed that is ignored, or one that changes with the run.
    first, second = synthetic_flame(1).v_template, synthetic_flame(2).v_template
    assert 0.001 < abs(first - second).max() < 0.02
    np.testing.assert_array_equal(first, synthetic_flame(1).v_template)


def test_paint(dense: Head) -> None:
    # Catches colors out of range, and features painted where they do not belong.
    tint, roughness, grain = paint(dense, 3)
    assert tint.shape == dense.rest.shape
    assert tint.min() >= 0
    assert tint.max() <= 1
    assert ((roughness > 0) & (roughness < 1)).all()
    assert set(np.unique(grain)) == {0.0, 1.0}
    light = tint.mean(1)
    masks = dense.model.masks
    assert light[masks["scalp"]].mean() < 0.3 * light[masks["neck"]].mean()
    eyeball = masks["left_eyeball"]
    ahead = np.linalg.norm(dense.rest[eyeball, :2] - EYE[:2], axis=1) < 0.001
    pupil = eyeball[ahead & (dense.rest[eyeball, 2] > EYE[2])]
    assert light[pupil].max() < 0.02
    assert light[eyeball].max() > 0.6
