"""What moves the head in a web page: one linear rig for FLAME sequences and for baked meshes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...capture.mesh_geometry import weighted_procrustes
from ...flame.forward import joint_positions
from ...flame.model import JOINTS
from ...flame.quaternions import from_matrices, to_axis_angle
from ...flame.sequence import FlameSequence, with_identity

BAKE_TOLERANCE_M = 5e-6
"""Largest distance of a vertex of a baked mesh from the mesh that was baked."""


@dataclass(frozen=True)
class WebRig:
    """Blend shapes, skeleton and motion: V vertices, R blend shapes, J joints, T frames; meters and radians.

    base         (V, 3) vertices before blend shapes
    basis        (R, V, 3); the first `expressions` are sliders, which have the
                 `expression_names` or, without any, numbers
    correctives  (9·(J − 1), V, 3), factors: the entries of the rotations of joints 1… minus identity
    joints       (J, 3); they move with the blend shapes by joint_basis (R, J, 3)
    parents      of the joints, -1 for the root
    weights      (V, J) of linear blend skinning
    coefficients (T, R); pose (T, J, 3) axis-angle; translation (T, 3), added last
    """

    base: np.ndarray
    basis: np.ndarray
    correctives: np.ndarray
    joints: np.ndarray
    joint_basis: np.ndarray
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    weights: np.ndarray
    coefficients: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    expressions: int
    expression_names: tuple[str, ...] = ()


def flame_rig(sequence: FlameSequence) -> WebRig:
    """The FLAME model of a sequence with the person's identity baked in; dynamic offsets become blend shapes."""
    person = with_identity(sequence)
    model = person.model
    frames = [person.frame(timestep) for timestep in person.timesteps]
    expressions = np.moveaxis(model.shapedirs, 2, 0)
    coefficients = np.stack([frame.expr for frame in frames])
    offsets = [frame.dynamic_offset for frame in frames]
    if any(offset is not None for offset in offsets):
        zero = np.zeros_like(model.v_template)
        shapes, factors = principal_shapes(np.stack([zero if offset is None else offset for offset in offsets]))
        expressions = np.concatenate([expressions, shapes])
        coefficients = np.concatenate([coefficients, factors], axis=1)
    return WebRig(
        base=model.v_template,
        basis=expressions,
        correctives=np.moveaxis(model.posedirs, 2, 0),
        joints=joint_positions(model, model.v_template),
        joint_basis=np.einsum("jv,rvc->rjc", model.j_regressor, expressions),
        joint_names=JOINTS,
        parents=tuple(model.parents.tolist()),
        weights=model.weights,
        coefficients=coefficients,
        pose=np.stack([frame.pose for frame in frames]),
        translation=np.stack([frame.translation for frame in frames]),
        expressions=model.n_expression,
        expression_names=model.expression_names,
    )


def baked_rig(meshes: Sequence[np.ndarray]) -> WebRig:
    """Posed meshes (V, 3) as one rigid motion and the principal components of what is left: a rig without sliders."""
    stack = np.asarray(meshes, np.float64)
    rotations, translations = _rigid_motion(stack)
    aligned = np.einsum("tba,tvb->tva", rotations, stack - translations[:, None])
    base = aligned.mean(0)
    basis, coefficients = principal_shapes(aligned - base)
    vertices = len(base)
    return WebRig(
        base=base,
        basis=basis,
        correctives=np.zeros((0, vertices, 3)),
        joints=np.zeros((1, 3)),
        joint_basis=np.zeros((len(basis), 1, 3)),
        joint_names=("root",),
        parents=(-1,),
        weights=np.ones((vertices, 1)),
        coefficients=coefficients,
        pose=to_axis_angle(from_matrices(rotations))[:, None],
        translation=translations,
        expressions=0,
    )


def principal_shapes(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (R, V, 3) and coefficients (T, R) in −1…1 whose products are offsets (T, V, 3) to BAKE_TOLERANCE_M."""
    frames, vertices = offsets.shape[:2]
    flat = offsets.reshape(frames, -1)
    _, directions = np.linalg.eigh(flat @ flat.T)
    directions = directions[:, ::-1]  # largest first
    shapes, rest = [], flat.copy()
    for column in directions.T:
        if not frames or np.linalg.norm(rest.reshape(frames, vertices, 3), axis=2).max() <= BAKE_TOLERANCE_M:
            break
        shapes.append(column @ flat)
        rest -= np.outer(column, shapes[-1])
    coefficients = directions[:, : len(shapes)]
    largest = np.abs(coefficients).max(0) if shapes else np.ones(0)
    basis = np.array(shapes).reshape(-1, vertices, 3) * largest[:, None, None]
    return basis, coefficients / largest


def _rigid_motion(meshes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3) that best take the first mesh to each of `meshes` (T, V, 3), and their centers (T, 3)."""
    weights = np.ones(meshes.shape[1])
    return np.stack([weighted_procrustes(meshes[0], mesh, weights)[0] for mesh in meshes]), meshes.mean(1)
