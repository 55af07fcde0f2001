"""Rigged avatars: splats bound to the triangles of a mesh, and the shapes, skeleton and motion that
move it, for any format."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..avatar.file import Avatar
from ..capture.mesh_geometry import weighted_procrustes
from ..flame.forward import joint_positions
from ..flame.model import JOINTS
from ..flame.parts import FLAME_SIZES
from ..flame.quaternions import from_matrices, to_axis_angle
from ..flame.sequence import FlameSequence, motion_arrays, with_identity

Meshes = Iterable[tuple[int, np.ndarray]]
"""Pairs of a number and a posed mesh (V, 3) meters."""
BUNDLED_NOTICE = (
    "Contains a head derived from ICT-FaceKit. MIT License, Copyright (c) 2020 USC Institute for "
    "Creative Technologies."
)
"""Notice in files with the bundled head, as its MIT License requires."""
FLAME_LICENCE = ": FLAME's licence (flame.is.tue.mpg.de) decides who may receive them."
"""End of the notices in files with parts of FLAME."""
RIG_NOTICE = f"Contains blend shapes and a skeleton derived from a FLAME model{FLAME_LICENCE}"
"""Notice in files with a rig that was made from a FLAME model."""
MESH_NOTICE = f"Contains the triangles and the posed meshes of a FLAME head{FLAME_LICENCE}"
"""Notice in files with the mesh of a FLAME head, without its shapes."""

BAKE_TOLERANCE_M = 5e-6
"""Largest distance of a vertex of a baked mesh from the mesh that was baked."""


@dataclass(frozen=True)
class ShapeControls:
    """Named shapes of a face, such as ARKit's, which move expressions, jaw and eyes of a FLAME rig
    together, each by a weight from 0 to 1.

    linear    (C, E + 9): expression coefficients, then axis-angles of jaw, left and right eye, per
              weight of a control
    products  (C, E): expression coefficients per product of a weight and that of the control
              `opens`
    limited   the control whose weight counts up to that of `opens` only
    """

    names: tuple[str, ...]
    linear: np.ndarray
    products: np.ndarray
    opens: str
    limited: str


@dataclass(frozen=True)
class Rig:
    """Shapes, skin and motion of a mesh: V vertices, R shapes, J joints, T frames; meters and
    radians.

    A vertex of a frame is `base`, plus the sum of `coefficients` times `basis`, plus that of the
    entries of the rotations of joints 1… minus identity times `correctives`; skinned by `weights`;
    plus `translation`.

    base         (V, 3), at rest
    basis        (R, V, 3); the first E = `expressions` are named, the others only play the motion
    correctives  (9·(J − 1), V, 3); none: (0, V, 3)
    weights      (V, J) of linear blend skinning
    joint_rest   (J, 3), at which joints turn; they move with the shapes by joint_basis (R, J, 3)
    parents      of the joints, -1 for the root; they come before their children
    coefficients (T, R)
    pose         (T, J, 3), axis-angle
    translation  (T, 3)
    expression_names  of the model; (): it has numbers only
    """

    base: np.ndarray
    basis: np.ndarray
    correctives: np.ndarray
    joint_rest: np.ndarray
    joint_basis: np.ndarray
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    weights: np.ndarray
    coefficients: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    expressions: int
    expression_names: tuple[str, ...] = ()

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Names of the first E shapes."""
        numbers = tuple(f"expr_{k:03d}" for k in range(self.expressions))
        return self.expression_names or numbers


@dataclass(frozen=True)
class RiggedAvatar:
    """An avatar with what moves it.

    avatar    the mesh's triangles `faces` (F, 3), and splats bound to them: in the local frames of
              the triangles `splats.face` (`Avatar.frames` of the mesh that `rig` gives)
    rig       of its mesh
    controls  ARKit's shapes for the rig; None where they do not fit it
    notice    what of a head model is in it, and whose licence that has; "": nothing
    """

    avatar: Avatar
    rig: Rig
    controls: ShapeControls | None = None
    notice: str = ""


def rigged_avatar(
    avatar: Avatar,
    meshes: Meshes,
    sequence: FlameSequence | None,
    motion_only: bool,
    controls: ShapeControls | None,
) -> RiggedAvatar:
    """An avatar with the rig of its FLAME motion, unless `motion_only`; else with a rig without
    shapes that plays the numbered posed meshes (V, 3), which are only then taken.

    Raises ValueError where there is no pose.
    """
    notice = flame_notice(avatar, sequence, motion_only)
    if sequence is None or motion_only:
        return RiggedAvatar(avatar, baked_rig([mesh for _, mesh in meshes]), notice=notice)
    return RiggedAvatar(avatar, flame_rig(sequence), controls, notice)


def flame_rig(sequence: FlameSequence) -> Rig:
    """The FLAME model with the person's identity baked in; dynamic offsets become blend shapes."""
    person = with_identity(sequence)
    model = person.model
    motion = motion_arrays(person)
    expressions = np.moveaxis(model.shapedirs, 2, 0)
    coefficients = motion["expr"]
    if motion["dynamic_offset"].any():
        shapes, factors = principal_shapes(motion["dynamic_offset"])
        expressions = np.concatenate([expressions, shapes])
        coefficients = np.concatenate([coefficients, factors], axis=1)
    turns = [motion[name] for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")]
    return Rig(
        base=model.v_template,
        basis=expressions,
        correctives=np.moveaxis(model.posedirs, 2, 0),
        joint_rest=joint_positions(model, model.v_template),
        joint_basis=np.einsum("jv,rvc->rjc", model.j_regressor, expressions),
        joint_names=JOINTS,
        parents=tuple(model.parents.tolist()),
        weights=model.weights,
        coefficients=coefficients,
        pose=np.concatenate(turns, axis=1).reshape(len(coefficients), -1, 3),
        translation=motion["translation"],
        expressions=model.n_expression,
        expression_names=model.expression_names,
    )


def baked_rig(meshes: Sequence[np.ndarray]) -> Rig:
    """Posed meshes (V, 3) as one rigid motion and the principal components of what is left: a rig
    without sliders.

    Raises ValueError where there is none.
    """
    if not len(meshes):
        raise ValueError("there is no posed mesh")
    stack = np.asarray(meshes, np.float64)
    weights = np.ones(stack.shape[1])
    translations = stack.mean(1)
    rotations = np.stack([weighted_procrustes(stack[0], mesh, weights)[0] for mesh in stack])
    aligned = np.einsum("tba,tvb->tva", rotations, stack - translations[:, None])
    base = aligned.mean(0)
    basis, coefficients = principal_shapes(aligned - base)
    vertices = len(base)
    return Rig(
        base=base,
        basis=basis,
        correctives=np.zeros((0, vertices, 3)),
        joint_rest=np.zeros((1, 3)),
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
    """Shapes (R, V, 3) and coefficients (T, R) in −1…1 with products near offsets (T, V, 3)."""
    flat = offsets.reshape(len(offsets), -1)
    _, directions = np.linalg.eigh(flat @ flat.T)
    directions = directions[:, ::-1]  # largest first
    shapes = []
    rest = flat.copy()
    for column in directions.T:
        if np.linalg.norm(rest.reshape(-1, 3), axis=1).max() <= BAKE_TOLERANCE_M:
            break
        shapes.append(column @ flat)
        rest -= np.outer(column, shapes[-1])
    coefficients = directions[:, : len(shapes)]
    largest = np.abs(coefficients).max(0) if shapes else np.ones(0)
    basis = np.array(shapes).reshape(-1, *offsets.shape[1:]) * largest[:, None, None]
    return basis, coefficients / largest


def flame_notice(avatar: Avatar, sequence: FlameSequence | None, motion_only: bool) -> str:
    """What a page of the avatar holds of a head model, and whose licence that has; "" for a head of
    the user's own.

    Without a sequence, FLAME's mesh is known by its number of vertices.
    """
    if sequence is not None and sequence.model.expression_names:
        return BUNDLED_NOTICE
    if sequence is not None and not motion_only:
        return RIG_NOTICE
    is_flame = len(avatar.neutral) in FLAME_SIZES
    return MESH_NOTICE if is_flame or sequence is not None else ""
