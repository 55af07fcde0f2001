"""Selection of the triangles that move in a timestep, whose splats it trains; their pixels."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..flame.sequence import ZERO_POSES
from ..options import option
from .mesh_geometry import rasterize
from .model import Capture, View

KEY_REGIONS = ("left_eye", "right_eye", "mouth", "nose")


@dataclass(frozen=True)
class SelectionOptions:
    """How triangles are selected.

    threshold  meters that a triangle must move; finite, at least 0
    zero_pose  "head": rotation, translation and neck do not count as motion; "all": nor do jaw and
               eyes
    regions    names of key regions, each selected as a whole
    """

    threshold: float = option(
        "movement from the neutral face from which a triangle is selected",
        0.002,
        0,
        metavar="METERS",
    )
    zero_pose: str = option("motion that does not count as expression", "head", choices=ZERO_POSES)
    regions: tuple[str, ...] = KEY_REGIONS


def select_faces(
    mesh: np.ndarray,
    neutral: np.ndarray,
    faces: np.ndarray,
    regions: Mapping[str, np.ndarray],
    threshold: float,
) -> np.ndarray:
    """(F,) bool: the triangles whose splats this frame trains. mesh, neutral (V, 3) meters without
    rigid head motion; faces (F, 3); regions name -> (F,) bool. A region whose mean offset of
    triangle centers exceeds the threshold is selected as a whole; a triangle outside of the regions
    is selected by its own offset (STGA, selective training)."""
    offset = np.linalg.norm((mesh[faces] - neutral[faces]).mean(1), axis=-1)
    in_region = np.zeros(len(faces), bool)
    selected = np.zeros(len(faces), bool)
    for members in regions.values():
        in_region |= members
        if members.any() and offset[members].mean() > threshold:
            selected |= members
    return selected | (~in_region & (offset > threshold))


def select_capture(capture: Capture, options: SelectionOptions) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool of every timestep; a capture's own selection takes precedence."""
    regions = {name: capture.regions[name] for name in options.regions if name in capture.regions}
    chosen = {}
    for timestep in capture.timesteps:
        faces = capture.given_selection.get(timestep)
        if faces is None:
            mesh = capture.expression_mesh(timestep, options.zero_pose)
            faces = select_faces(mesh, capture.neutral, capture.faces, regions, options.threshold)
        chosen[timestep] = faces
    return chosen


def visible_pixels(capture: Capture, view: View, faces: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at which the nearest triangle is one of `faces` (F,) bool."""
    triangle, _ = rasterize(np.asarray(capture.mesh(view.timestep)), capture.faces, view.camera)
    return (triangle >= 0) & faces[triangle]
