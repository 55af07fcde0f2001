"""Teeth for FLAME's mesh: two rows behind the lips, fitted to the mesh's own mouth.

The mesh with teeth has the index layout of the 5143-vertex meshes that VHAP and GaussianAvatars
exchange: number and order of the added vertices and triangles, and the corners of each triangle.
Offsets name vertices and bindings name triangles by index, and a triangle's local frame starts at
its first corner. Shape, size, place and rigging of the teeth are this project's own construction
from the mesh.
"""

import numpy as np

from ..errors import StgaError
from .graft import Graft, grafted
from .model import JOINTS, FlameModel
from .quaternions import unit

TEMPLATE_VERTICES = 5023
"""Vertices of the published FLAME mesh, which has no teeth."""
TEETH_VERTICES = 120
"""Vertices that the teeth add."""
TEETH_FACES = 168
"""Triangles that the teeth add."""
TEETH_PER_ROW = 15
"""Vertices of each of TEETH_ROWS."""
TEETH_ROWS = ("UR", "LR", "UE", "LE", "URB", "UEB", "LRB", "LEB")
"""Order of the rows among the added vertices, part of the index layout: upper, lower; root, edge; B
for back. Each row runs from the person's left to the right."""
TEETH_STRIPS = {
    "upper front": ("UR0 UE1 UE0 UR0 UR1 UE1", "UR0 UR1 UE0 UR1 UE1 UE0"),
    "upper back": ("URB0 UEB0 UEB1 URB0 UEB1 URB1", "URB0 UEB0 URB1 URB1 UEB0 UEB1"),
    "upper bottom": ("UEB0 UE0 UEB1 UEB1 UE0 UE1", "UEB0 UE0 UE1 UEB0 UE1 UEB1"),
    "lower front": ("LE0 LE1 LR0 LE1 LR1 LR0", "LE0 LR1 LR0 LE0 LE1 LR1"),
    "lower back": ("LRB0 LEB1 LEB0 LRB0 LRB1 LEB1", "LRB0 LRB1 LEB0 LRB1 LEB1 LEB0"),
    "lower top": ("LEB0 LEB1 LE0 LEB1 LE1 LE0", "LEB0 LE1 LE0 LEB0 LEB1 LE1"),
}
"""Strip between two rows -> two triangles a column, part of the index layout; a corner is (row, 0
or 1 for the column's near or far end). The diagonal flips in the middle of the mouth (the first and
the second text) so that left and right mirror each other."""
# Sizes as fractions of the width between the corners of the mouth, about 50 mm.
ARCH_WIDTH = 0.85
"""Width of the arch as a fraction of the mouth's."""
CLEARANCE = 0.03
"""Gap between the lips' inner surface and the teeth."""
OVERBITE = 0.06
"""Distance that the upper edge reaches below the lower one."""
OVERJET = 0.02
"""Distance that the upper edge stands in front of the lower one."""
EDGE_THICKNESS = 0.05
ROOT_THICKNESS = 0.1
MAX_MOUTH_RINGS = 12
MAX_LIP_DISTANCE_M = 0.002  # Largest distance between opposite vertices of closed lips


def with_teeth(model: FlameModel) -> FlameModel:
    """The model with upper and lower teeth: 5023 to 5143 vertices, 9976 to 10144 triangles. The
    upper row follows the neck joint, which turns the head, and the lower row the jaw; both follow
    identity as the inside of the mouth does, neither expression nor pose correctives. Adds the mask
    "teeth". Raises StgaError for a mesh without an open mouth."""
    rings, lips = mouth_rings(model.v_template, model.faces)
    inside = np.concatenate(rings)
    teeth = _positions(model.v_template, rings, lips)
    identity = model.shapedirs[inside, :, : model.n_identity]
    followed = _followed(model.v_template[inside], identity, teeth)
    weights = np.zeros((TEETH_VERTICES, len(JOINTS)))
    for row, name in enumerate(TEETH_ROWS):
        joint = JOINTS.index("neck" if name.startswith("U") else "jaw")
        weights[row * TEETH_PER_ROW : (row + 1) * TEETH_PER_ROW, joint] = 1
    return grafted(model, Graft("teeth", teeth, teeth_faces(0), followed, weights))


def lip_pairs(model: FlameModel) -> tuple[np.ndarray, np.ndarray]:
    """Vertex ids (n,) along the upper and the lower lip between the corners of the mouth, opposite
    each other. They are found on FLAME's mesh with or without teeth, and where expressions have
    ARKit's names. Raises StgaError for another mesh without an open mouth."""
    if "jawOpen" in model.expression_names:  # which moves one lip and leaves the other
        column = model.n_identity + model.expression_names.index("jawOpen")
        lips = model.masks["lips"]
        at = model.v_template
        opened = np.linalg.norm(model.shapedirs[lips, :, column], axis=1)
        upper = lips[opened < opened.max() / 4]
        lower = lips[opened > opened.max() / 2]
        distances = np.linalg.norm(at[upper, None] - at[lower], axis=2)
        near = np.flatnonzero(distances.min(axis=1) < MAX_LIP_DISTANCE_M)
        return upper[near], lower[distances[near].argmin(axis=1)]
    _, lips = mouth_rings(model.v_template, model.faces)
    half = len(lips) // 2
    sides = lips[1:half], lips[:half:-1]
    heights = [model.v_template[side, 1].mean() for side in sides]
    return sides if heights[0] > heights[1] else sides[::-1]


def lip_gap_m(lips: tuple[np.ndarray, np.ndarray], mesh: np.ndarray) -> float:
    """Largest distance between lips, the vertices of `lip_pairs`, in a mesh (V, 3) in meters."""
    upper, lower = lips
    return float(np.linalg.norm(mesh[upper] - mesh[lower], axis=1).max())


def teeth_faces(first: int) -> np.ndarray:
    """(168, 3) int32 triangles of the teeth, whose vertices start at id `first`."""
    start = {name: first + row * TEETH_PER_ROW for row, name in enumerate(TEETH_ROWS)}
    faces = []
    for halves in TEETH_STRIPS.values():
        for column in range(TEETH_PER_ROW - 1):
            corners = halves[column >= TEETH_PER_ROW // 2].split()
            faces += [start[corner[:-1]] + column + int(corner[-1]) for corner in corners]
    return np.array(faces, np.int32).reshape(-1, 3)


def mouth_rings(vertices: np.ndarray, faces: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Vertex ids of rings of neighbors from the open end of the throat, the foremost hole of
    FLAME's mesh, up to the one that lies foremost: the lips; and this one in order around the
    mouth. The head looks along z. Raises StgaError for a mesh without an open mouth."""
    faces = faces[(faces < TEMPLATE_VERTICES).all(axis=1)]
    depth = vertices[:, 2]
    edges = _edges(faces)
    # the neck's is farther back
    holes = [hole for hole in holes_of(faces) if depth[hole].mean() > depth[faces].mean()]
    if not holes:
        closed = "has a closed mouth, expected one that is open at the throat"
        raise StgaError(f"teeth: the FLAME model's mesh {closed}")
    rings = [max(holes, key=lambda hole: float(depth[hole].mean()))]
    reached = np.zeros(len(vertices), bool)
    for _ in range(MAX_MOUTH_RINGS):
        reached[rings[-1]] = True
        touched = edges[reached[edges].any(axis=1)]
        ring = np.unique(touched[~reached[touched]])
        if not len(ring) or depth[ring].mean() < depth[rings[-1]].mean():
            break
        rings.append(ring)
    lips = _ring_order(edges, rings[-1])
    x = vertices[lips, 0]  # from the left corner on; the right one is half a ring further
    lips = np.roll(lips, -int((x - np.roll(x, len(lips) // 2)).argmax()))
    return rings, lips


def _edges(faces: np.ndarray) -> np.ndarray:
    """(3F, 2) int64: directed edges of triangles."""
    return faces[:, [[0, 1], [1, 2], [2, 0]]].swapaxes(0, 1).reshape(-1, 2).astype(np.int64)


def holes_of(faces: np.ndarray) -> list[np.ndarray]:
    """Vertex ids of each hole of a mesh, in order around it."""
    edges = _edges(faces)
    key = edges.max() + 1
    forth = edges @ (key, 1)
    back = edges @ (1, key)
    following = dict(edges[~np.isin(forth, back)].tolist())
    holes = []
    while following:
        vertex, after = following.popitem()
        hole = [vertex]
        while after in following:
            hole.append(after)
            after = following.pop(after)
        holes.append(np.array(hole))
    return holes


def _ring_order(edges: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """A ring's vertices in order. Raises StgaError where the edges among them are no ring."""
    inside = edges[np.isin(edges, ring).all(axis=1)]
    beside: dict[int, set[int]] = {vertex: set() for vertex in ring.tolist()}
    for one, other in inside.tolist():
        beside[one].add(other)
        beside[other].add(one)
    ordered = [int(ring[0])]
    left = set(beside) - set(ordered)
    while following := beside[ordered[-1]] & left:
        ordered.append(min(following))
        left.discard(ordered[-1])
    if left or len(ring) % 2 or any(len(others) != 2 for others in beside.values()):
        none = "has no ring of vertices around its lips, expected FLAME's mesh"
        raise StgaError(f"teeth: the FLAME model's mesh {none}")
    return np.array(ordered)


def _positions(vertices: np.ndarray, rings: list[np.ndarray], lip_ids: np.ndarray) -> np.ndarray:
    """(120, 3) teeth: an upper arch curved like the lips, as far forward as their inner surface
    allows, and a lower one behind it."""
    lips = vertices[lip_ids]
    inside = vertices[np.concatenate(rings)]
    left = lips[0]
    right = lips[len(lips) // 2]
    width = left[0] - right[0]
    middle = (left[0] + right[0]) / 2
    curvature = max(0.0, -float(np.polyfit((lips[:, 0] - middle) ** 2, lips[:, 2], 1)[0]))
    arch, outward = _arch(ARCH_WIDTH * width / 2, curvature)
    bite = (lips[:, 1].max() + lips[:, 1].min()) / 2
    height = np.ptp(vertices[rings[0], 1]) / 2  # both rows together fill the open end
    edge = bite - OVERBITE * width
    # on the axis
    reach = inside[:, 2] + curvature * (inside[:, 0] - middle) ** 2 - CLEARANCE * width
    upper = reach[inside[:, 1] > edge].min()
    lower = reach[inside[:, 1] < bite].min()
    rows = {"UE": arch + np.array([middle, edge, upper])}
    rows["UR"] = rows["UE"] + [0, bite + height - edge, 0]
    rows["LE"] = rows["UE"] - (EDGE_THICKNESS + OVERJET) * width * outward + [0, bite - edge, 0]
    axis = rows["LE"][TEETH_PER_ROW // 2, 2]
    rows["LR"] = rows["LE"] - [0, height, max(0.0, axis - lower)]
    for front in ("UR", "UE", "LR", "LE"):
        thickness = EDGE_THICKNESS if front.endswith("E") else ROOT_THICKNESS
        rows[front + "B"] = rows[front] - thickness * width * outward
    return np.concatenate([rows[name] for name in TEETH_ROWS])


def _arch(half_width: float, curvature: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (15, 3), evenly spaced along z = −curvature · x² from left to right, and their outward
    normals (15, 3)."""
    x = np.linspace(half_width, -half_width, 257)
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(curvature * x**2)))])
    x = np.interp(np.linspace(0, length[-1], TEETH_PER_ROW), length, x)
    x = (x - x[::-1]) / 2
    zero = np.zeros_like(x)
    normals = unit(np.stack([2 * curvature * x, zero, zero + 1], axis=1))
    return np.stack([x, zero, -curvature * x**2], axis=1), normals


def _followed(points: np.ndarray, displacements: np.ndarray, teeth: np.ndarray) -> np.ndarray:
    """Displacements (T, 3, K) of the teeth (T, 3): those (M, 3, K) of the mouth's points (M, 3)
    fitted linearly in width and height and quadratically in width, so that the arch grows and bends
    as a whole."""
    center = points.mean(0)
    size = np.ptp(points[:, 0]) / 2

    def terms(at: np.ndarray) -> np.ndarray:
        x, y = ((at - center) / size)[:, :2].T
        return np.stack([np.ones_like(x), x, y, x**2], axis=1)

    known = terms(points)
    wanted = terms(teeth)
    weights = wanted @ np.linalg.pinv(known)
    return np.einsum("tm,mck->tck", weights, displacements)
