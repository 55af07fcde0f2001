"""A FLAME model whose jaw opens, and what meets what in its mouth."""

from dataclasses import replace

import numpy as np
from rays import distances
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from stga_addon.flame.forward import flame_forward, neutral_frame

from .conftest import model_of, random_arrays

JOINT_POSITIONS_M = np.array(
    [[0, -0.16, -0.03], [0, -0.12, -0.03], [0, -0.02, 0], [0.03, 0.03, 0.04], [-0.03, 0.03, 0.04]]
)


def open_flame(shared_data):
    """FLAME 2023 Open's template and identity, with a skeleton and a jaw made here. Expressions and
    correctives stay random: they are not published openly."""
    with np.load(shared_data / "flame_open" / "flame2023_open_basis.npz") as data:
        arrays = random_arrays(vertices=5023, components=80)
        arrays["shapedirs"][:, :, :60] = data["shapedirs"]
        arrays |= {"v_template": data["v_template"].astype(float), "f": data["faces"]}
    model = model_of(arrays, n_identity=60)
    jaw = jaw_weights(model.v_template, model.faces)
    weights = np.zeros_like(model.weights)
    weights[:, 1] = 1 - jaw
    weights[:, 2] = jaw
    homogeneous = np.vstack([model.v_template.T, np.ones(5023)])
    targets = np.vstack([JOINT_POSITIONS_M.T, np.ones(5)])
    regressor = np.linalg.lstsq(homogeneous, targets, rcond=None)[0].T
    return replace(model, weights=weights, j_regressor=regressor)


def jaw_weights(vertices, faces):
    """(V,) how much each vertex follows the jaw: 1 at chin and lower lip, 0 above the lips, as
    smooth as possible."""
    x, y, z = vertices.T
    inner = np.isin(np.arange(len(vertices)), np.unique(open_edges(faces)))
    fixed = (y > -0.036) | (z < 0) | (y < -0.11)
    moved = (y < -0.05) & (z > 0.045) & (np.abs(x) < 0.025) & (y > -0.09)
    moved |= inner & (z > 0.03) & (y < -0.053)
    edges = np.concatenate([edges_of(faces), edges_of(faces)[:, ::-1]])
    adjacency = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2).tocsr()
    laplacian = diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    free = ~(fixed | moved)
    weights = np.where(moved & ~fixed, 1.0, 0.0)
    from_fixed = laplacian[free][:, ~free] @ weights[~free]
    weights[free] = spsolve(laplacian[free][:, free].tocsc(), -from_fixed)
    return np.clip(weights, 0, 1)


def open_edges(faces):
    """The directed edges that one triangle has alone."""
    edges = set(map(tuple, edges_of(faces).tolist()))
    return [(a, b) for a, b in edges if (b, a) not in edges]


def edges_of(faces):
    """(3F, 2) the directed edges of triangles."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def jaw_opened(model, degrees, shape=None):
    """The mesh (V, 3) with the jaw opened, without expression or correctives."""
    model = replace(model, posedirs=np.zeros_like(model.posedirs))
    frame = replace(neutral_frame(model), jaw_pose=np.array([np.radians(degrees), 0, 0]))
    return flame_forward(model, np.zeros(model.n_identity) if shape is None else shape, frame, None)


def crossings(vertices, skin, teeth):
    """How many pairs of an edge of one and a triangle of the other, of two sets of triangles,
    meet."""
    return _pierced(vertices, teeth, skin) + _pierced(vertices, skin, teeth)


def _pierced(vertices, edged, pierced):
    edges = np.unique(np.sort(edges_of(edged), axis=1), axis=0)
    ends = vertices[edges]
    corners = vertices[pierced]
    ends, corners = _near(ends, corners), _near(corners, ends)
    along = distances(ends[:, None, 0], (ends[:, 1] - ends[:, 0])[:, None], corners)
    return int(((along >= 0) & (along <= 1)).sum())


def _near(some, others):
    """Those of some (n, k, 3) that touch the box around the others."""
    low = others.min((0, 1))
    high = others.max((0, 1))
    return np.asarray(some[((some.min(1) <= high) & (some.max(1) >= low)).all(1)])


def covered_from_front(vertices, skin, points):
    """(n,) bool: points (n, 3) with a triangle of the skin in front of them, along z."""
    return (distances(points[:, None], np.array([0.0, 0.0, 1.0]), vertices[skin]) > 0).any(1)
