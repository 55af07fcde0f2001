"""Which triangles really moved, and so which splats a frame trains (STGA, selective training)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .capture.model import Capture

KEY_REGIONS = ("left_eye", "right_eye", "mouth", "nose")


@dataclass(frozen=True)
class SelectionOptions:
    """threshold in metres; zero_pose "head" (rotation, translation and neck; jaw and eyes are expression) or "all"."""

    threshold: float = 0.002
    zero_pose: str = "head"
    regions: tuple[str, ...] = KEY_REGIONS


def select_faces(
    mesh: np.ndarray,
    neutral: np.ndarray,
    faces: np.ndarray,
    regions: Mapping[str, np.ndarray],
    threshold: float,
) -> np.ndarray:
    """(F,) bool: the triangles whose splats this frame trains.

    mesh, neutral (V, 3) metres without rigid head motion; faces (F, 3); regions name -> (F,) bool.
    A region whose mean centre offset exceeds the threshold is selected whole; any other triangle is selected
    by its own offset (STGA, selective training).
    """
    offset = np.linalg.norm((mesh[faces] - neutral[faces]).mean(1), axis=-1)
    in_region = np.zeros(len(faces), bool)
    selected = np.zeros(len(faces), bool)
    for members in regions.values():
        in_region |= members
        if members.any() and offset[members].mean() > threshold:
            selected |= members
    return np.asarray(selected | (~in_region & (offset > threshold)))


def select_capture(capture: Capture, options: SelectionOptions) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool for every timestep; a selection that came with the capture wins over the rule."""
    regions = {name: capture.regions[name] for name in options.regions if name in capture.regions}
    chosen = {}
    for timestep in capture.timesteps:
        faces = capture.given_selection.get(timestep)
        if faces is None:
            mesh = capture.expression_mesh(timestep, options.zero_pose)
            faces = select_faces(mesh, capture.neutral, capture.faces, regions, options.threshold)
        chosen[timestep] = faces
    return chosen
