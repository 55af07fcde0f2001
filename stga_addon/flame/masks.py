"""Regions of triangles from FLAME's vertex masks."""

import numpy as np

from .model import JOINTS, FlameModel

# Key region -> the vertex masks it is made of (STGA, selective training: eyes, mouth and nose).
KEY_MASKS = {
    "left_eye": ("left_eye_region", "left_eyeball"),
    "right_eye": ("right_eye_region", "right_eyeball"),
    "mouth": ("lips", "teeth"),
    "nose": ("nose",),
}
MIN_TORSO_WEIGHT = 0.7
"""Skinning weight of the root joint at the torso's vertices; the published FLAME's last ring has 0.9."""


def faces_within(faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) whose three corners are all among `vertices` (ids)."""
    return np.asarray(np.isin(faces, vertices).all(axis=1))


def torso_faces(model: FlameModel) -> np.ndarray:
    """(F,) bool: triangles at the end of the neck, which the root joint carries."""
    return np.asarray((model.weights[:, JOINTS.index("root")] > MIN_TORSO_WEIGHT)[model.faces].all(axis=1))


def key_regions(model: FlameModel) -> dict[str, np.ndarray]:
    """left_eye, right_eye, mouth and nose as (F,) bool; a region none of whose masks the model has is left out."""
    regions = {}
    for region, names in KEY_MASKS.items():
        present = [model.masks[name] for name in names if name in model.masks]
        if present:
            regions[region] = faces_within(model.faces, np.concatenate(present))
    return regions
