"""Reading of meshes with morph targets from binary glTF."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.glb import (
    UNREADABLE,
    Json,
    accessor_values,
    allowed_numbers,
    count_of,
    glb_chunks,
)
from ..errors import StgaError
from ..files import read_bytes
from ..flame.quaternions import to_matrices

TRIANGLES = 4
"""Mode of a primitive in glTF."""
PRIMITIVE_NUMBERS = 100
"""Numbers that each primitive counts for besides its content: it takes time even where it is
small."""
Placed = tuple[Json, list[tuple[str, Json]], np.ndarray]
"""A primitive, its morph targets with their names, and the transform (4, 4) of its node."""
READABLE_EXTENSIONS = {"KHR_mesh_quantization", "KHR_materials_unlit", "KHR_texture_transform"}


@dataclass(frozen=True)
class MorphMesh:
    """positions (V, 3) meters, y up; faces (F, 3); names and displacements (V, 3, K) of targets."""

    positions: np.ndarray
    faces: np.ndarray
    names: tuple[str, ...]
    targets: np.ndarray


def read_glb(path: Path) -> MorphMesh:
    """All triangle meshes of the scene of a .glb file, as one; targets of the same name are one.

    Vertices that are split at seams of normals and texture coordinates are merged. Skins are left
    in their bind pose. Raises StgaError naming the file and what is missing or not supported.
    Source: Khronos, glTF 2.0.
    """
    content = read_bytes(path)
    try:
        with np.errstate(all="ignore"):  # a head's vertices are checked by `read_head_model`
            document, data = glb_chunks(content)
            unknown = set(document.get("extensionsRequired", ())) - READABLE_EXTENSIONS
            if unknown:
                names = ", ".join(sorted(map(str, unknown)))
                raise StgaError(f"{path}: needs {names}; export it without compression")
            if any("uri" in buffer for buffer in document.get("buffers", ())):
                raise StgaError(
                    f"{path}: refers to other files; export a GLB that holds its buffers"
                )
            placed = _placed_primitives(path, document, len(content))
            parts = [_part(document, data, *each) for each in placed]
    except UNREADABLE as error:
        raise StgaError(
            f"{path}: is not a readable GLB ({type(error).__name__}: {error!s:.100})"
        ) from error
    if not parts:
        raise StgaError(f"{path}: its scene has no triangle mesh")
    return _joined(parts)


def _placed_primitives(path: Path, document: Json, size: int) -> list[Placed]:
    """The triangle primitives of the scene's meshes. Raises StgaError where these hold more numbers
    than a file of this size may."""
    allowed = allowed_numbers(size)
    vertices = 0
    corners = 0
    accessors = document["accessors"]
    names = set[str]()
    placed: list[Placed] = []
    for node, matrix in _mesh_nodes(document):
        mesh = document["meshes"][node["mesh"]]
        extras = mesh.get("extras")
        target_names = extras.get("targetNames", ()) if isinstance(extras, dict) else ()
        for primitive in mesh["primitives"]:
            if primitive.get("mode", TRIANGLES) != TRIANGLES:
                continue
            targets = primitive.get("targets", ())
            if len(target_names) != len(targets):
                target_names = [f"target {number}" for number in range(len(targets))]
            named = [(str(target_names[k]), target) for k, target in enumerate(targets)]
            vertices += count_of(accessors[primitive["attributes"]["POSITION"]])
            corners += PRIMITIVE_NUMBERS
            corners += count_of(accessors[primitive["indices"]]) if "indices" in primitive else 0
            names.update(name for name, _ in named)
            numbers = 3 * vertices * (1 + len(names)) + corners
            if numbers > allowed:
                raise StgaError(
                    f"{path}: its meshes hold {numbers} numbers, more than the {allowed} "
                    "allowed to a file of this size"
                )
            placed.append((primitive, named, matrix))
    return placed


def _mesh_nodes(document: Json) -> Iterator[tuple[Json, np.ndarray]]:
    """Nodes of the scene that have a mesh, and their transforms (4, 4)."""
    nodes = document.get("nodes", [])
    scene = document["scenes"][document.get("scene", 0)]
    waiting = [(int(row), np.eye(4)) for row in scene.get("nodes", ())]
    for _ in range(len(nodes)):  # each node has one parent: more would be a loop
        if not waiting:
            return
        row, above = waiting.pop()
        node = nodes[row]
        local = np.eye(4)
        if "matrix" in node:
            local = np.array(node["matrix"], float).reshape(4, 4).T
        else:
            turn = np.roll(np.array(node.get("rotation", (0, 0, 0, 1)), float), 1)
            local[:3, :3] = to_matrices(turn) * np.array(node.get("scale", (1, 1, 1)), float)
            local[:3, 3] = node.get("translation", (0, 0, 0))
        matrix = above @ local
        waiting += [(int(child), matrix) for child in node.get("children", ())]
        if "mesh" in node:
            yield node, np.eye(4) if "skin" in node else matrix


def _part(
    document: Json, data: bytes, primitive: Json, morphs: list[tuple[str, Json]], matrix: np.ndarray
) -> MorphMesh:
    """The mesh of a primitive, in the scene's axes."""
    positions = accessor_values(document, data, primitive["attributes"]["POSITION"], width=3)
    count = len(positions)
    targets = np.zeros((count, 3, len(morphs)))
    for column, (_, morph) in enumerate(morphs):
        if "POSITION" in morph:
            targets[:, :, column] = accessor_values(document, data, morph["POSITION"], count, 3)
    corners = np.arange(count)
    if "indices" in primitive:
        values = accessor_values(document, data, primitive["indices"], width=1)[:, 0]
        corners = values.astype(np.int64)
    if corners.min(initial=0) < 0 or corners.max(initial=0) >= count:
        raise ValueError("a primitive's indices do not fit its vertices")
    turn = matrix[:3, :3]
    faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
    names = tuple(name for name, _ in morphs)
    moved = np.einsum("ab,vbk->vak", turn, targets)
    return MorphMesh(positions @ turn.T + matrix[:3, 3], faces, names, moved)


def _joined(parts: list[MorphMesh]) -> MorphMesh:
    """One mesh of all parts; a part without a target of some name is not moved by it. Vertices are
    merged that no target parts, and triangles that collapse are left out."""
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    starts = np.cumsum([0, *(len(part.positions) for part in parts)]).tolist()
    targets = np.zeros((starts[-1], 3, len(names)))
    for start, part in zip(starts, parts, strict=False):
        for column, name in enumerate(part.names):
            rows = slice(start, start + len(part.positions))
            targets[rows, :, names.index(name)] += part.targets[:, :, column]
    joined = [part.faces + start for start, part in zip(starts, parts, strict=False)]
    positions = np.concatenate([part.positions for part in parts])
    values = np.column_stack([positions, targets.reshape(len(positions), -1)])
    values = np.ascontiguousarray(values + 0.0)  # no -0
    keys = values.view(np.dtype((np.void, values.dtype.itemsize * values.shape[1])))[:, 0]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)  # vertices in the order of the file
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[inverse.ravel()][np.concatenate(joined)]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    kept = first[order]
    return MorphMesh(positions[kept], faces[~collapsed], names, targets[kept])
