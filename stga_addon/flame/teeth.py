"""Teeth: the two rows that GaussianAvatars adds to FLAME's mesh."""

from dataclasses import replace

import numpy as np

from ..errors import StgaError
from .model import JOINTS, FlameModel

TEMPLATE_VERTICES = 5023
TEETH_VERTICES, TEETH_FACES = 120, 168
TEETH_PER_ROW = 15
# Inner lip vertices of the 5023-vertex topology, from the person's left corner of the mouth to the right.
UPPER_LIP = (1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543, 2774, 2811, 2813, 2850, 2833, 2832, 2830)
LOWER_LIP = (1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503, 2948, 2905, 2898, 2881, 2880, 2713, 2712)
# Order of the eight rows among the added vertices: upper, lower; root, edge; B for back.
TEETH_ROWS = ("UR", "LR", "UE", "LE", "URB", "UEB", "LRB", "LEB")
# Two triangles a column; a corner is (row, 0 or 1 for the column's near or far end). The diagonal flips in the middle
# of the mouth (the first half and the second half below) so that left and right mirror each other. The first corner
# matters: a triangle's local frame starts there.
TEETH_STRIPS = {
    "upper front": ("UR0 UE1 UE0 UR0 UR1 UE1", "UR0 UR1 UE0 UR1 UE1 UE0"),
    "upper back": ("URB0 UEB0 UEB1 URB0 UEB1 URB1", "URB0 UEB0 URB1 URB1 UEB0 UEB1"),
    "upper bottom": ("UEB0 UE0 UEB1 UEB1 UE0 UE1", "UEB0 UE0 UE1 UEB0 UE1 UEB1"),
    "lower front": ("LE0 LE1 LR0 LE1 LR1 LR0", "LE0 LR1 LR0 LE0 LE1 LR1"),
    "lower back": ("LRB0 LEB1 LEB0 LRB0 LRB1 LEB1", "LRB0 LRB1 LEB0 LRB1 LEB1 LEB0"),
    "lower top": ("LEB0 LEB1 LE0 LEB1 LE1 LE0", "LEB0 LE1 LE0 LEB0 LEB1 LE1"),
}


def with_teeth(model: FlameModel) -> FlameModel:
    """The model with upper and lower teeth: 5023 to 5143 vertices, 9976 to 10144 triangles (GaussianAvatars).

    The upper row follows the neck and the lower row the jaw; both follow identity like the lips, neither expression
    nor pose correctives. Adds the mask "teeth". Raises StgaError for any other topology.
    """
    if len(model.v_template) != TEMPLATE_VERTICES:
        raise StgaError(
            f"teeth: the model has {len(model.v_template)} vertices, expected FLAME's topology of {TEMPLATE_VERTICES}"
        )
    upper, lower = list(UPPER_LIP), list(LOWER_LIP)
    teeth = _positions(model.v_template[upper], model.v_template[lower])
    shapedirs = np.tile((model.shapedirs[upper] + model.shapedirs[lower]) / 2, (len(TEETH_ROWS), 1, 1))
    shapedirs[:, :, model.n_identity :] = 0
    weights = np.zeros((TEETH_VERTICES, len(JOINTS)))
    for row, name in enumerate(TEETH_ROWS):
        joint = JOINTS.index("neck" if name.startswith("U") else "jaw")
        weights[row * TEETH_PER_ROW : (row + 1) * TEETH_PER_ROW, joint] = 1
    added = np.arange(TEMPLATE_VERTICES, TEMPLATE_VERTICES + TEETH_VERTICES)
    return replace(
        model,
        v_template=np.concatenate([model.v_template, teeth]),
        shapedirs=np.concatenate([model.shapedirs, shapedirs]),
        posedirs=np.concatenate([model.posedirs, np.zeros((TEETH_VERTICES, *model.posedirs.shape[1:]))]),
        j_regressor=np.concatenate([model.j_regressor, np.zeros((len(JOINTS), TEETH_VERTICES))], axis=1),
        weights=np.concatenate([model.weights, weights]),
        faces=np.concatenate([model.faces, teeth_faces(TEMPLATE_VERTICES)]),
        masks={**model.masks, "teeth": added},
    )


def _positions(upper_lip: np.ndarray, lower_lip: np.ndarray) -> np.ndarray:
    """(120, 3) teeth behind lips (15, 3) each, sized by the mean distance between the lips."""
    size = np.linalg.norm(upper_lip - lower_lip, axis=1).mean()
    up, forward = np.array([0, size, 0]), np.array([0, 0, size])
    middle = (upper_lip + lower_lip) / 2
    middle[:, 1] = middle[:, 1].mean()
    middle -= 1.5 * forward
    rows = {"UE": middle + 0.1 * up, "LE": middle - 0.1 * up - 0.4 * forward}
    rows["UR"], rows["LR"] = rows["UE"] + 2 * up, rows["LE"] - 2 * up
    for front in ("UR", "UE", "LR", "LE"):
        rows[front + "B"] = rows[front] - forward
    return np.concatenate([rows[name] for name in TEETH_ROWS])


def teeth_faces(first: int) -> np.ndarray:
    """(168, 3) int32 triangles of the teeth, whose vertices start at id `first`."""
    start = {name: first + row * TEETH_PER_ROW for row, name in enumerate(TEETH_ROWS)}
    faces = []
    for halves in TEETH_STRIPS.values():
        for column in range(TEETH_PER_ROW - 1):
            corners = halves[column >= TEETH_PER_ROW // 2].split()
            faces += [start[corner[:-1]] + column + int(corner[-1]) for corner in corners]
    return np.array(faces, np.int32).reshape(-1, 3)
