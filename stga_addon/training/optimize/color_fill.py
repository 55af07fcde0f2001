"""Colors of unseen triangles as a smooth continuation of observed ones over the surface."""

from typing import Any

import numpy as np
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve


def filled_colors(
    faces: np.ndarray,
    color: np.ndarray,
    weight: np.ndarray,
    group: np.ndarray,
    detail: np.ndarray,
) -> np.ndarray:
    """Colors (F, 3) of triangles that change as little as possible between neighbors, and from the
    observed ones as far as these count (screened Poisson equation); NaN on parts of the surface
    without an observed triangle.

    faces   (F, 3); triangles with a common edge are neighbors
    color   (F, 3) observed
    weight  (F,) of the observed color, 0 where there is none; 1 counts as much as a neighbor
    group   (F,) triangles of different groups are no neighbors
    detail  (F, 3) a color whose differences between neighbors are kept, such as the mirror image's;
            NaN without
    """
    adjacency: Any = trimesh.graph.face_adjacency
    pairs = adjacency(faces)
    pairs = pairs[group[pairs[:, 0]] == group[pairs[:, 1]]]
    first = pairs[:, 0]
    second = pairs[:, 1]
    count = len(faces)
    rows = np.concatenate([first, second])
    columns = np.concatenate([second, first])
    neighbors = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (count, count))
    _, part = connected_components(neighbors, directed=False)
    reached = (np.bincount(part, weight) > 0)[part]
    change = np.nan_to_num(detail[first] - detail[second])
    right = weight[:, None] * np.where(weight[:, None] > 0, color, 0)
    np.add.at(right, first, change)
    np.add.at(right, second, -change)
    system = sparse.diags(weight + np.asarray(neighbors.sum(1)).ravel()) - neighbors
    found = np.full(color.shape, np.nan)
    found[reached] = spsolve(system.tocsr()[reached][:, reached].tocsc(), right[reached])
    return found
