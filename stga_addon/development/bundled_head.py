"""Makes `flame/head.npz`, the head model that comes with this package, from ICT-FaceKit, and
`tracking/networks/bundled_head_places.npz`, where landmarks lie on it.

python -m stga_addon.development.bundled_head ict_facekit.npz. The input holds the model's neutral
(V, 3) in centimeters, y up, looking along +z, tris (F, 3), identity (100, V, 3) in standard
deviations, and expression (57, V, 3) with expression_names. MIT License, Copyright (c) 2020 USC
Institute for Creative Technologies.
"""

import heapq
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..driving.performance import ARKIT_SHAPES, OPTIONAL
from ..files import read_npz, write_npz
from ..flame.model import BUNDLED_HEAD, JOINTS, SHAPE_STEP_M
from ..flame.parts import flame_model
from ..tracking.correspondence import calibrate
from ..tracking.face_networks import FaceNetworks
from ..tracking.landmarks import write_places
from ..tracking.recorded import BUNDLED_PLACES
from .arkit_shapes import METERS_PER_UNIT, ict_names

# Ranges of vertices: the first, and the one behind the last, of ICT-FaceKit's parts. Its second
# shells of the eyeballs, tear films and lashes are left out.
FACE = (0, 9409)
"""Vertices of the face, the front of the skin."""
HEAD = (9409, 11248)
"""Vertices of the skin of skull and neck."""
MOUTH_INSIDE = (11248, 13294)
"""Vertices of the mouth's lining."""
EYE_SOCKETS = (13294, 14062)
"""Vertices of both eye sockets."""
SKIN = (0, 14062)
"""Vertices of the whole skin: the four parts above."""
GUMS = (14062, 17039)
"""Vertices of gums and tongue."""
TEETH = (17039, 21451)
"""Vertices of all teeth."""
LEFT_EYEBALL = (21451, 22221)
"""Vertices of one shell of the left eyeball."""
RIGHT_EYEBALL = (23021, 23791)
"""Vertices of one shell of the right eyeball."""

KEPT_TRIANGLES = {SKIN: 19000, GUMS: 900, TEETH: 2500, LEFT_EYEBALL: 500, RIGHT_EYEBALL: 500}
"""Part -> how many of its triangles are kept."""
DETAIL = {FACE: 1.0, HEAD: 0.3, MOUTH_INSIDE: 0.03, EYE_SOCKETS: 0.03}
"""Part of the skin -> factor of its geometric error, by which triangles are distributed."""
FEATURE_DETAIL = 8.0
"""The same factor around eyes and mouth, which expressions fold."""
IDENTITIES = 100
"""Identity components of ICT-FaceKit that are kept."""
MIN_FLIP_COSINE = 0.3
"""Least cosine between a triangle's normals before and after a collapse; below it, the triangle
would fold over."""
EDGE_WEIGHT = 10.0
"""Weight of a mesh's open edges in the quadrics."""

NECK_JOINT_CM = (0.0, 0.4, 0.0)
"""Where the skull turns on the spine, between the ears' canals."""
ROOT_JOINT_CM = (0.0, -13.2, -2.7)
"""Where the neck leaves the torso."""
JOINT_BAND_CM = 1.5
"""Half height of the band of skin whose average is a joint."""
NECK_SLOPE = 0.35
"""Slope of the planes that divide the neck, which leans forward and whose nape ends higher than its
front."""
NECK_BOTTOM_CM = -13.7
"""Height on the axis below which skin follows the root joint alone."""
NECK_TOP_CM = -4.7
"""Height on the axis above which skin follows the neck joint alone."""
EYEBALL_SETBACK_CM = 0.07
"""How far eyeballs lie behind ICT-FaceKit's: other identities' eyeballs would otherwise poke
through their lids, which move along straight lines."""
EYEBALL_RETRACTION_CM = 0.1
"""How far closing lids push eyeballs back, as they do in life (Evinger et al. 1984)."""
LINING_NEIGHBORS = 12
"""Nearest vertices of the face that a vertex of the mouth's lining follows."""
LINING_FOLLOWS_CM = (0.25, 0.6)
"""Distances from the face between which the mouth's lining begins to move with it: ICT-FaceKit's,
which pursed lips push forward, comes out of the chin of small faces."""
LINING_STAYS_CM = (1.2, 1.8)
"""Distances from the face between which the mouth's lining ceases to move with it."""
MIN_EYE_MOTION = 0.15
"""Displacement at the edge of an eye's region, relative to the largest one of the shapes that move
it."""
MIN_LIPS_MOTION = 0.45
"""Displacement at the edge of the lips' region, relative to the largest one of the shapes that move
them."""


def main(source: Path) -> None:
    """Write the file for the ICT-FaceKit arrays in `source`."""
    arrays = read_npz(source)
    neutral = arrays["neutral"].astype(np.float64)
    triangles = arrays["tris"].astype(np.int64)
    names, shapes = arkit_displacements(arrays)
    moved = dict(zip(names, np.linalg.norm(shapes, axis=2), strict=True))
    kept, faces = _thinned(neutral, triangles, _detail(moved))
    identity = arrays["identity"][:IDENTITIES, kept].astype(np.float64)
    moved_skin = np.concatenate([identity, shapes[:, kept]])
    displacements = METERS_PER_UNIT * with_lining(moved_skin, neutral[kept], kept)
    template = neutral_head(arrays)[kept]
    write_npz(
        BUNDLED_HEAD,
        {
            "v_template": (METERS_PER_UNIT * template).astype(np.float32),
            "f": faces.astype(np.uint16),
            # One component after the other, which compresses best.
            "shape_steps": np.round(displacements / SHAPE_STEP_M).astype(np.int16),
            "n_identity": np.array(IDENTITIES),
            "expression_names": np.array(names),
            "J_regressor": _regressor(template, kept).astype(np.float32),
            "weights": skinning_weights(template, kept).astype(np.float32),
            "kintree_table": np.array([[-1, 0, 1, 1, 1], range(len(JOINTS))]),
            **{
                f"masks/{name}": np.flatnonzero(of[kept])
                for name, of in _masks(neutral, moved).items()
            },
        },
        compressed=True,
    )
    write_places(BUNDLED_PLACES, *calibrate(flame_model(None), FaceNetworks(), str(BUNDLED_HEAD)))


def neutral_head(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """ICT-FaceKit's neutral head (V, 3) in centimeters, with the eyeballs set back."""
    neutral = arrays["neutral"].astype(np.float64)
    for part in (LEFT_EYEBALL, RIGHT_EYEBALL):
        neutral[slice(*part), 2] -= EYEBALL_SETBACK_CM
    return neutral


def arkit_displacements(arrays: Mapping[str, np.ndarray]) -> tuple[tuple[str, ...], np.ndarray]:
    """ARKit's names of ICT-FaceKit's expressions, and their displacements (E, V, 3) in centimeters,
    with those of the eyeballs behind lids that close."""
    row = {str(name): number for number, name in enumerate(arrays["expression_names"])}
    names = tuple(name for name in ARKIT_SHAPES if name not in OPTIONAL)
    shapes = [
        sum(arrays["expression"][row[part]].astype(np.float64) for part in ict_names(name))
        for name in names
    ]
    displacements = np.stack(shapes)
    for side, part in (("Left", LEFT_EYEBALL), ("Right", RIGHT_EYEBALL)):
        lids = [names.index(shape + side) for shape in ("eyeBlink", "eyeLookDown")]
        displacements[lids, slice(*part), 2] -= EYEBALL_RETRACTION_CM
    return names, displacements


def with_lining(displacements: np.ndarray, neutral: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Displacements (K, N, 3) of vertices `kept` (N,), at `neutral` (N, 3) in centimeters, where
    the mouth's lining behind lips, chin and cheeks moves with the skin before it. Their distance
    is that of the neutral head then, whatever the coefficients; at the lips' edge, which it
    continues, and around the teeth it moves as it did."""
    from scipy.spatial import cKDTree

    face, lining = (np.flatnonzero(_within(part, kept)) for part in (FACE, MOUTH_INSIDE))
    distance, near = cKDTree(neutral[face]).query(neutral[lining], LINING_NEIGHBORS)
    weights = distance**-2.0
    weights = weights / weights.sum(axis=1, keepdims=True)
    followed = np.einsum("lk,clkx->clx", weights, displacements[:, face[near]])
    begins, ceases = (
        _smooth_step((distance[:, 0] - low) / (high - low))
        for low, high in (LINING_FOLLOWS_CM, LINING_STAYS_CM)
    )
    fraction = (begins * (1 - ceases))[:, None]
    found = displacements.copy()
    found[:, lining] = fraction * followed + (1 - fraction) * displacements[:, lining]
    return found


def _smooth_step(fraction: np.ndarray) -> np.ndarray:
    """From 0 to 1, without a slope at both ends."""
    fraction = np.clip(fraction, 0, 1)
    return np.asarray(fraction * fraction * (3 - 2 * fraction))


def _within(part: tuple[int, int], ids: np.ndarray) -> np.ndarray:
    return (ids >= part[0]) & (ids < part[1])


def _regions(moved: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Name -> the skin's vertices that shapes of the eyes and the lips move, as (V,) bool."""

    def moves(fraction: float, *names: str) -> np.ndarray:
        found = np.max([moved[name] / moved[name].max() for name in names], axis=0) > fraction
        return np.asarray(found & _within(FACE, np.arange(len(found))))

    return {
        "left_eye_region": moves(MIN_EYE_MOTION, "eyeBlinkLeft", "eyeWideLeft"),
        "right_eye_region": moves(MIN_EYE_MOTION, "eyeBlinkRight", "eyeWideRight"),
        "lips": moves(MIN_LIPS_MOTION, "mouthRollLower", "mouthRollUpper", "mouthFunnel"),
    }


def _masks(neutral: np.ndarray, moved: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    ids = np.arange(len(neutral))
    x, y, z = neutral.T
    nose = _within(FACE, ids) & (abs(x) < 2.1) & (y > -1.2) & (y < 3.2) & (z > 9.2 + abs(x) / 4)
    eyeballs = {
        "left_eyeball": _within(LEFT_EYEBALL, ids),
        "right_eyeball": _within(RIGHT_EYEBALL, ids),
    }
    return {**_regions(moved), **eyeballs, "nose": nose, "teeth": _within(TEETH, ids)}


def _detail(moved: dict[str, np.ndarray]) -> np.ndarray:
    """(V,) factor of the geometric error at a vertex."""
    count = len(next(iter(moved.values())))
    detail = np.ones(count)
    for part, factor in DETAIL.items():
        detail[slice(*part)] = factor
    return np.asarray(
        np.where(np.any(list(_regions(moved).values()), axis=0), FEATURE_DETAIL, detail)
    )


def _thinned(
    vertices: np.ndarray, triangles: np.ndarray, detail: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ids (N,) of the vertices that are kept, and the triangles (F, 3) between them."""
    kept = []
    faces = []
    count = 0
    for part, wanted in KEPT_TRIANGLES.items():
        part_triangles = triangles[_within(part, triangles).all(axis=1)]
        part_triangles = collapsed(vertices, part_triangles, detail, wanted)
        used, within = np.unique(part_triangles, return_inverse=True)
        kept.append(used)
        faces.append(within.reshape(-1, 3) + count)
        count += len(used)
    return np.concatenate(kept), np.concatenate(faces)


def collapsed(
    vertices: np.ndarray, triangles: np.ndarray, detail: np.ndarray, wanted: int
) -> np.ndarray:
    """About `wanted` of the triangles (F, 3), between some of their own vertices.

    Edges are collapsed into one of their ends by the smallest quadric error (Garland and Heckbert
    1997) times `detail` (V,). New places would need new shapes; an end has its own.
    """
    quadrics = _quadrics(vertices, triangles)
    faces = {number: tuple(corners) for number, corners in enumerate(triangles.tolist())}
    around: dict[int, set[int]] = {}
    for number, corners in faces.items():
        for corner in corners:
            around.setdefault(corner, set()).add(number)

    def neighbors(vertex: int) -> set[int]:
        return {corner for number in around[vertex] for corner in faces[number]} - {vertex}

    def cost(gone: int, end: int) -> float:
        at = np.append(vertices[end], 1.0)
        return float(at @ quadrics[gone] @ at * detail[gone])

    def folds(gone: int, end: int) -> bool:
        for number in around[gone] - around[end]:
            before = vertices[list(faces[number])]
            after = vertices[[end if corner == gone else corner for corner in faces[number]]]
            one, other = (np.cross(c[1] - c[0], c[2] - c[0]) for c in (before, after))
            if one @ other < MIN_FLIP_COSINE * np.linalg.norm(one) * np.linalg.norm(other) + 1e-12:
                return True
        return False

    queue = [(cost(gone, end), gone, end) for gone in around for end in neighbors(gone)]
    heapq.heapify(queue)
    while len(faces) > wanted and queue:
        priority, gone, end = heapq.heappop(queue)
        if gone not in around or end not in around or not around[gone] & around[end]:
            continue
        if priority < (now := cost(gone, end)):  # its quadric has grown meanwhile
            heapq.heappush(queue, (now * (1 + 1e-9), gone, end))
            continue
        shared = around[gone] & around[end]
        if len(neighbors(gone) & neighbors(end)) != len(shared) or folds(gone, end):
            continue  # the surface would touch itself, or fold
        for number in shared:
            for corner in faces.pop(number):
                around[corner].discard(number)
        for number in around.pop(gone):
            faces[number] = tuple(end if corner == gone else corner for corner in faces[number])
            around[end].add(number)
        quadrics[end] += quadrics[gone]
        for other in neighbors(end):
            heapq.heappush(queue, (cost(end, other), end, other))
            heapq.heappush(queue, (cost(other, end), other, end))
    return np.array(list(faces.values()))


def _quadrics(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(V, 4, 4) squared distances from the planes of a vertex' triangles, by their area, and from
    planes that stand on open edges."""
    quadrics = np.zeros((len(vertices), 4, 4))

    def add(corners: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> None:
        unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        plane = np.concatenate(
            [unit, -(unit * vertices[corners[:, 0]]).sum(1, keepdims=True)], axis=1
        )
        products = weights[:, None, None] * plane[:, :, None] * plane[:, None, :]
        for column in corners.T:
            np.add.at(quadrics, column, products)

    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    add(triangles, normals, np.linalg.norm(normals, axis=1) / 2)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    key = len(vertices)
    open_ = ~np.isin(edges @ (key, 1), edges @ (1, key))
    along = vertices[edges[open_, 1]] - vertices[edges[open_, 0]]
    standing = np.cross(along, np.tile(normals, (3, 1))[open_])
    add(edges[open_], standing, EDGE_WEIGHT * (along**2).sum(1))
    return quadrics


def _height(at: np.ndarray) -> np.ndarray:
    """Heights (...,) of points (..., 3) along the neck."""
    return np.asarray(at[..., 1] + NECK_SLOPE * at[..., 2])


def skinning_weights(template: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(N, 5) skinning weights of vertices `kept` (N,), at `template` (N, 3) in centimeters.

    Root, neck and eyeballs; the jaw is a shape.
    """
    fraction = (_height(template) - NECK_BOTTOM_CM) / (NECK_TOP_CM - NECK_BOTTOM_CM)
    fraction = np.where(_within(SKIN, kept), _smooth_step(fraction), 1.0)
    weights = np.zeros((len(kept), len(JOINTS)))
    weights[:, JOINTS.index("root")] = 1 - fraction
    weights[:, JOINTS.index("neck")] = fraction
    for joint, part in (("left_eye", LEFT_EYEBALL), ("right_eye", RIGHT_EYEBALL)):
        weights[_within(part, kept)] = np.eye(len(JOINTS))[JOINTS.index(joint)]
    return weights


def _regressor(template: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(5, N): eyes turn about the middle of their eyeballs, root and neck about averages of
    skin."""
    regressor = np.zeros((len(JOINTS), len(kept)))
    for joint, part in (("left_eye", LEFT_EYEBALL), ("right_eye", RIGHT_EYEBALL)):
        ids = np.flatnonzero(_within(part, kept))
        middle = template[ids].min(0) / 2 + template[ids].max(0) / 2
        regressor[JOINTS.index(joint), ids] = _average(template[ids], middle)
    for joint, at in (("root", ROOT_JOINT_CM), ("neck", NECK_JOINT_CM)):
        near = abs(_height(template) - _height(np.array(at))) < JOINT_BAND_CM
        ids = np.flatnonzero(_within((0, HEAD[1]), kept) & near)
        regressor[JOINTS.index(joint), ids] = _average(template[ids], np.array(at))
    regressor[JOINTS.index("jaw")] = regressor[JOINTS.index("neck")]
    return regressor


def _average(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The most even weights (N,) of the points whose average is `at`."""
    system = np.concatenate([points.T, np.ones((1, len(points)))])
    return np.asarray(np.linalg.lstsq(system, np.append(at, 1.0), rcond=None)[0])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
