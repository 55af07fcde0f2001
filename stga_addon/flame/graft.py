"""Parts that are added to a head model's mesh, after its own vertices and triangles."""

from dataclasses import dataclass, replace

import numpy as np

from .model import FlameModel


@dataclass(frozen=True)
class Graft:
    """N vertices that follow joints and identity, neither expression nor pose correctives.

    mask       the region that they are
    vertices   (N, 3) meters
    faces      (F, 3) of them, from 0
    identity   (N, 3, I) their displacements by the identity's components
    weights    (N, 5) skinning weights
    """

    mask: str
    vertices: np.ndarray
    faces: np.ndarray
    identity: np.ndarray
    weights: np.ndarray


def grafted(model: FlameModel, graft: Graft) -> FlameModel:
    """The model with the graft, whose vertices are named by its mask."""
    before = len(model.v_template)
    count = len(graft.vertices)
    shapedirs = np.zeros((count, *model.shapedirs.shape[1:]))
    shapedirs[:, :, : model.n_identity] = graft.identity
    faces = (graft.faces + before).astype(np.int32)
    return replace(
        model,
        v_template=np.concatenate([model.v_template, graft.vertices]),
        shapedirs=np.concatenate([model.shapedirs, shapedirs]),
        posedirs=np.pad(model.posedirs, ((0, count), (0, 0), (0, 0))),
        j_regressor=np.pad(model.j_regressor, ((0, 0), (0, count))),
        weights=np.concatenate([model.weights, graft.weights]),
        faces=np.concatenate([model.faces, faces]),
        masks={**model.masks, graft.mask: np.arange(before, before + count)},
    )
