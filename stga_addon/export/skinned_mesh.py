"""The mesh of a rig as glTF: skin, morph targets and motion."""

import itertools

import numpy as np

from ..flame.quaternions import continuous, from_axis_angle
from .gltf import COMPONENTS, VERTICES, Accessors, Json, accessor_of, little_endian, range_of
from .rig import Rig

QUANTIZATION = "KHR_mesh_quantization"
"""Extension of glTF that allows vertices and shapes in short integers."""

SHAPE_STEP_M = 4e-5
"""Step of what a shape moves a vertex by; larger where one moves farther than a short integer
holds."""
MIN_SHAPE_M = 8e-5
"""Least displacement by a shape that is kept."""
BASE_STEP_M = 2.0**-20
"""Quantization step of vertices at rest, so fine that no thin triangle becomes a line."""
MAX_SHORT = 32767
MAX_USHORT = 65535
_INDICES = 34963
_SKIN_COLOR = [0.6, 0.42, 0.33, 1.0]


def skinned_mesh(rig: Rig, faces: np.ndarray, fps: float, exact: bool) -> tuple[Json, Accessors]:
    """A document with the mesh, triangles `faces` (F, 3), and its accessors, to which more may be
    added; `exact`: displacements in float32, not in steps of SHAPE_STEP_M.

    Positions are in a unit in which displacements are normalized short integers. The skin's inverse
    bind matrices bring it to meters, so that any program poses the mesh in meters.
    """
    accessors = Accessors()
    largest = float(np.abs(rig.basis).max(initial=0.0))
    unit = 1.0 if exact else max(SHAPE_STEP_M * MAX_SHORT, largest)
    base = rig.base / unit
    fine = 2.0 ** np.ceil(np.log2(unit / BASE_STEP_M))
    position = np.asarray(base if exact else np.rint(base * fine) / fine, np.float32)
    attributes = {"POSITION": accessors.add(position, VERTICES, **range_of(position))}
    attributes |= _skin_attributes(rig.weights, accessors, exact)
    wide = len(rig.base) > MAX_USHORT
    indices = faces.ravel().astype(np.uint32 if wide else np.uint16)
    primitive = {
        "attributes": attributes,
        "indices": accessors.add(indices, _INDICES),
        "material": 0,
    }
    mesh: Json = {"name": "Head", "primitives": [primitive]}
    if len(rig.basis):
        primitive["targets"] = _targets(rig.basis / unit, unit, accessors, exact)
        others = (f"motion_{k:03d}" for k in range(len(rig.basis) - rig.expressions))
        mesh |= {
            "weights": [0.0] * len(rig.basis),
            "extras": {"targetNames": [*rig.shape_names, *others]},
        }
    count = len(rig.parents)
    roots = [joint for joint in range(count) if rig.parents[joint] < 0]
    bind = _bind(rig, unit, accessors)
    document: Json = {
        "scene": 0,
        "scenes": [{"nodes": [*roots, count]}],
        "nodes": [*_joints(rig), {"name": "Head", "mesh": 0, "skin": 0}],
        "meshes": [mesh],
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": bind}],
        "materials": [_material()],
        "animations": [_animation(rig, fps, accessors)],
    }
    if len(rig.basis) and not exact:
        document |= {"extensionsUsed": [QUANTIZATION], "extensionsRequired": [QUANTIZATION]}
    return document, accessors


def _material() -> Json:
    look = {"baseColorFactor": _SKIN_COLOR, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    return {"name": "Skin", "pbrMetallicRoughness": look, "doubleSided": True}


def _skin_attributes(weights: np.ndarray, accessors: Accessors, exact: bool) -> dict[str, int]:
    """JOINTS_n and WEIGHTS_n of weights (V, J): four joints each, those of most weight first."""
    sets = -(-max(1, int((weights > 0).sum(axis=1).max())) // 4)
    padded = np.pad(weights, ((0, 0), (0, max(0, 4 * sets - weights.shape[1]))))
    joints = np.argsort(-padded, axis=1, kind="stable")[:, : 4 * sets]
    fractions = np.take_along_axis(padded, joints, axis=1)
    if exact:
        fractions = np.asarray(fractions, np.float32)
    else:
        steps = np.rint(fractions * MAX_USHORT).astype(np.int64)
        steps[:, 0] += MAX_USHORT - steps.sum(axis=1)
        fractions = steps.astype(np.uint16)
    joints = np.where(fractions > 0, joints, 0)
    kind = np.uint8 if weights.shape[1] <= 256 else np.uint16
    attributes = {}
    for number in range(sets):
        four = np.s_[:, 4 * number : 4 * number + 4]
        values = np.ascontiguousarray(joints[four].astype(kind))
        attributes[f"JOINTS_{number}"] = accessors.add(values, VERTICES)
        normalized = {} if exact else {"normalized": True}
        values = np.ascontiguousarray(fractions[four])
        attributes[f"WEIGHTS_{number}"] = accessors.add(values, VERTICES, **normalized)
    return attributes


def _targets(
    shapes: np.ndarray, unit: float, accessors: Accessors, exact: bool
) -> list[dict[str, int]]:
    """Morph targets of displacements (R, V, 3) in units: only of vertices that move."""
    values = np.asarray(shapes, np.float32) if exact else np.rint(shapes * MAX_SHORT)
    values = values if exact else values.astype(np.int16)
    least = 0.0 if exact else MIN_SHAPE_M / unit
    moved = [np.flatnonzero((np.abs(shape) > least).any(axis=1)) for shape in shapes]
    wide = shapes.shape[1] > MAX_USHORT
    places = [each.astype(np.uint32 if wide else np.uint16) for each in moved]
    displacements = [shape[rows] for shape, rows in zip(values, moved, strict=True)]
    index_view = accessors.add_view(b"".join(map(little_endian, places)))
    value_view = accessors.add_view(b"".join(map(little_endian, displacements)))
    index_offsets = itertools.accumulate((each.nbytes for each in places), initial=0)
    value_offsets = itertools.accumulate((each.nbytes for each in displacements), initial=0)
    targets = []
    for shape, rows, index_at, value_at in zip(
        values, places, index_offsets, value_offsets, strict=False
    ):
        accessor = accessor_of(shape) | range_of(shape)
        accessor |= {} if exact else {"normalized": True}
        if len(rows):
            kind = COMPONENTS[rows.dtype.name]
            accessor["sparse"] = {
                "count": len(rows),
                "indices": {
                    "bufferView": index_view,
                    "byteOffset": index_at,
                    "componentType": kind,
                },
                "values": {"bufferView": value_view, "byteOffset": value_at},
            }
        targets.append({"POSITION": accessors.append(accessor)})
    return targets


def _joints(rig: Rig) -> list[Json]:
    """Nodes of the joints, at rest."""
    nodes = []
    for joint, parent in enumerate(rig.parents):
        place = rig.joint_rest[joint] - (rig.joint_rest[parent] if parent >= 0 else 0)
        node: Json = {"name": rig.joint_names[joint], "translation": place.tolist()}
        children = [child for child, other in enumerate(rig.parents) if other == joint]
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def _bind(rig: Rig, unit: float, accessors: Accessors) -> int:
    matrices = np.tile(np.diag([unit, unit, unit, 1.0]), (len(rig.parents), 1, 1))
    matrices[:, :3, 3] = -rig.joint_rest
    columns = matrices.transpose(0, 2, 1).reshape(-1, 16)
    return accessors.add(columns.astype(np.float32))


def _animation(rig: Rig, fps: float, accessors: Accessors) -> Json:
    """The motion: rotations of the joints, translation of the root, weights of the shapes."""
    frames = len(rig.pose)
    seconds = (np.arange(frames) / fps).astype(np.float32)
    times = accessors.add(seconds, **range_of(seconds))
    samplers = list[Json]()
    channels = list[Json]()

    def add(node: int, path: str, values: np.ndarray) -> None:
        output = accessors.add(np.ascontiguousarray(values, np.float32))
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})

    for joint, parent in enumerate(rig.parents):
        turns = continuous(from_axis_angle(rig.pose[:, joint]))
        add(joint, "rotation", turns[:, [1, 2, 3, 0]])
        if parent < 0:
            add(joint, "translation", rig.joint_rest[joint] + rig.translation)
    if len(rig.basis):
        add(len(rig.parents), "weights", np.asarray(rig.coefficients).ravel())
    return {"name": "Motion", "samplers": samplers, "channels": channels}
