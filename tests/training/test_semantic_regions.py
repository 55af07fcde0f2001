"""Regions of heads, by what else is known of the bundled head, and on meshes of other make."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_areas
from stga_addon.capture.model import Capture
from stga_addon.development.head_regions import bundled_head, flame_head, regions_of
from stga_addon.flame.model import JOINTS, faces_within, torso_faces
from stga_addon.flame.parts import flame_model
from stga_addon.training.optimize.semantic_regions import (
    Region,
    head_regions,
    lining_of,
    skin_of,
)

MIRROR = np.array([-1, 1, 1])


@pytest.fixture(scope="module")
def head():
    return bundled_head()


def other_identity(seed):
    model = flame_model(None)
    identity = np.random.default_rng(seed).normal(0, 0.7, model.n_identity)
    return model.v_template + model.shapedirs[:, :, : model.n_identity] @ identity


@pytest.fixture(scope="module")
def flame(shared_data):
    return flame_head(shared_data / "flame_open/flame2023_open_basis.npz")


def test_the_file_is_what_makes_it(head, flame):
    """Catches regions that were changed in the script and not in the file, and FLAME's that an
    edition without the bundled head does not know."""
    for own in (head, flame):
        assert_array_equal(head_regions(own).region, regions_of(own))


def test_parts_of_the_bundled_head(head):
    """Catches regions of other triangles, on one side alone, and ears that lack their shells."""
    model = flame_model(None)
    found = head_regions(head)
    centers = head.neutral[head.faces].mean(1)
    for name in ("left_eye_region", "right_eye_region", "nose"):
        assert found.face[faces_within(head.faces, model.masks[name])].all(), name
    teeth = faces_within(head.faces, model.masks["teeth"])
    turned_by_eyes = model.weights[:, JOINTS.index("left_eye") :].any(1)[head.faces].all(1)
    gums = ~skin_of(head) & ~teeth & ~turned_by_eyes
    assert np.count_nonzero(gums) > 500
    assert found.within(Region.MOUTH)[teeth | gums].mean() > 0.97
    top = skin_of(head) & (centers[:, 1] > np.quantile(centers[:, 1], 0.97))
    assert found.within(Region.SCALP)[top].all()
    assert found.within(Region.BODY, Region.NAPE)[torso_faces(model)].all()
    above_neck = centers[:, 1] > model.v_template[model.masks["lips"], 1].mean()
    for side in (-1, 1):
        widest = above_neck & (side * centers[:, 0] > np.abs(centers[above_neck, 0]).max() - 0.012)
        assert np.count_nonzero(widest) > 20
        assert found.within(Region.EAR)[widest].all()
    partner = cKDTree(centers).query(centers * MIRROR)[1]
    areas = face_areas(head.neutral, head.faces)
    assert areas[found.region != found.region[partner]].sum() < 0.01 * areas.sum()


def remeshed(head: Capture, neutral: np.ndarray) -> tuple[Capture, np.ndarray]:
    """A capture of other triangles, a quarter of each in another order, and whose triangle each of
    them is a part of."""
    count = len(neutral)
    edges = np.sort(head.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, of = np.unique(edges, axis=0, return_inverse=True)
    x, y, z = (count + of.reshape(-1, 3)).T
    a, b, c = head.faces.T
    corners = [(a, x, z), (b, y, x), (c, z, y), (x, y, z)]
    faces = np.concatenate([np.stack(own, 1) for own in corners])
    shuffled = np.random.default_rng(0).permutation(len(faces))
    parent = np.tile(np.arange(len(head.faces)), 4)[shuffled]
    regions = {name: own[parent] for name, own in head.regions.items()}
    places = np.concatenate([neutral, neutral[edges].mean(1)])
    capture = replace(head, faces=faces[shuffled], neutral=places, regions=regions)
    return capture, parent


def test_every_identity_has_the_bundled_heads_regions(head):
    """Catches regions of the bundled head that depend on where its vertices are."""
    known = head_regions(head)
    found = head_regions(replace(head, neutral=other_identity(1)))
    assert_array_equal(found.region, known.region)


@pytest.mark.parametrize(("seed", "differs"), [(None, 0.005), (1, 0.06), (2, 0.06)])
def test_other_meshes_have_the_nearest_regions(seed, differs, head):
    """Catches a mesh that is not laid on the bundled head: turned, in another size or place."""
    shape = head.neutral if seed is None else other_identity(seed)
    turn = Rotation.from_euler("xyz", [20, -70, 35], degrees=True).as_matrix()
    capture, parent = remeshed(head, 1.3 * shape @ turn.T + [0.4, -2, 1])
    found = head_regions(capture)
    known = head_regions(head)
    areas = face_areas(capture.neutral, capture.faces)
    assert areas[found.region != known.region[parent]].sum() < differs * areas.sum()


@pytest.mark.parametrize("is_known", [True, False])
def test_flames_mesh(is_known, flame):
    """Catches FLAME's mesh with regions of another, or laid on the bundled head another way: its
    face, skull, ears, lips' inner side and the end of its neck."""
    neutral = flame.neutral
    faces = flame.faces
    regions = flame.regions
    if not is_known:
        faces = faces[::-1].copy()
        regions = {name: own[::-1] for name, own in regions.items()}
    capture = replace(flame, faces=faces, regions=regions)
    found = head_regions(capture)
    for name in ("left_eye", "right_eye", "nose", "mouth"):
        assert found.face[regions[name]].mean() > 0.97, name
    x, y, z = neutral[faces].mean(1).T
    eyes, mouth = (y[regions[name]].mean() for name in ("left_eye", "mouth"))
    skull = (y > eyes) & (z < z[regions["left_eye"]].mean() - 0.1)
    beside = (y > mouth) & (np.abs(x) > np.abs(x[y > mouth]).max() - 0.01)
    end = y < y.min() + 0.02
    of_neck = Region.BODY, Region.NAPE
    for rows, kinds in ((skull, (Region.SCALP,)), (beside, (Region.EAR,)), (end, of_neck)):
        assert np.count_nonzero(rows) > 20
        assert found.within(*kinds)[rows].mean() > 0.97, kinds
    assert lining_of(capture)[regions["mouth"]].mean() > 0.8


def test_where_the_mouth_is_not_known(head):
    """Catches regions of a mesh that cannot be laid on the bundled head."""
    capture, _ = remeshed(head, head.neutral)
    mouthless = replace(capture, regions={**capture.regions, "mouth": np.zeros(4, bool)})
    assert_array_equal(head_regions(mouthless).region, np.full(len(capture.faces), Region.OTHER))


def test_teeth_on_flame_belong_to_the_mouth(flame):
    """Catches a head that is not known any more with what is grafted into its mouth."""
    faces = np.concatenate([flame.faces, flame.faces[:50]])
    found = head_regions(replace(flame, faces=faces))
    assert_array_equal(found.region[:-50], head_regions(flame).region)
    assert found.within(Region.MOUTH)[-50:].all()
