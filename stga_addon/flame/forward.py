"""FLAME's forward pass in NumPy: parameters to vertices."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from .model import JOINTS, FlameModel
from .quaternions import from_axis_angle, from_matrices, multiply, to_axis_angle, to_matrices

POSE_SIZE = 3 * len(JOINTS)
"""Axis-angles of the joints at the end of a frame's parameters, after the expression."""
TRANSLATION_SIZE = 3
"""Coordinates of the shift that ends a frame's parameters."""
RIGID_SIZE = POSE_SIZE + TRANSLATION_SIZE
MAX_UNWOUND_RAD = 1.5 * np.pi  # At a whole turn, an axis-angle's change may turn nothing
SMALL_ANGLE = 1e-4  # Radians, below which a quotient by the squared angle is its limit


@dataclass(frozen=True)
class FlameFrame:
    """One timestep's parameters: axis-angle in radians, lengths in meters.

    expr            (E,) expression coefficients
    rotation, neck_pose, jaw_pose, translation  (3,)
    eyes_pose       (6,) left eye then right eye
    dynamic_offset  (V, 3) added to the shaped template like the static offset, or None
    """

    expr: np.ndarray
    rotation: np.ndarray
    neck_pose: np.ndarray
    jaw_pose: np.ndarray
    translation: np.ndarray
    eyes_pose: np.ndarray
    dynamic_offset: np.ndarray | None = None

    @property
    def pose(self) -> np.ndarray:
        """(5, 3) axis-angle of root, neck, jaw, left eye, right eye."""
        joints = [self.rotation, self.neck_pose, self.jaw_pose, self.eyes_pose]
        return np.concatenate(joints).reshape(len(JOINTS), 3)

    @property
    def parameters(self) -> np.ndarray:
        """(E + 18,) expression, pose and translation."""
        return np.concatenate([self.expr, self.pose.ravel(), self.translation])


def frame_of(parameters: np.ndarray, dynamic_offset: np.ndarray | None = None) -> FlameFrame:
    """The frame with these `FlameFrame.parameters`."""
    expr, pose, translation = np.split(parameters, [-RIGID_SIZE, -TRANSLATION_SIZE])
    rotation, neck, jaw, eyes = np.split(pose, [3, 6, 9])
    return FlameFrame(expr, rotation, neck, jaw, translation, eyes, dynamic_offset)


def neutral_frame(model: FlameModel) -> FlameFrame:
    """The frame with expression, pose and translation zero."""
    zero = np.zeros(3)
    return FlameFrame(np.zeros(model.n_expression), zero, zero, zero, zero, np.zeros(6))


def axis_angle_matrices(axis_angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (J, 3, 3) of axis-angle vectors (J, 3) in radians."""
    return to_matrices(from_axis_angle(axis_angle))


def world_turns(parents: Iterable[int], turns: np.ndarray) -> np.ndarray:
    """Rotations (5, 3, 3) of the joints in the world, from those in their parents."""
    world = turns.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[joint] = world[parent] @ turns[joint]
    return world


def joint_places(parents: Iterable[int], world: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Where joints (5, 3) or (5, 3, K) are in the world, whose rotations are world (5, 3, 3)."""
    places = joints.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            places[joint] = places[parent] + world[parent] @ (joints[joint] - joints[parent])
    return places


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """(N, 3, 3): the matrices of x ↦ vector × x, of vectors (N, 3)."""
    found = np.zeros((*vectors.shape, 3), vectors.dtype)
    for axis, component in enumerate(vectors.T):
        first = (axis + 1) % 3
        second = (axis + 2) % 3
        found[:, second, first] = component
        found[:, first, second] = -component
    return found


def moved_pose(
    rotation: np.ndarray,
    translation: np.ndarray,
    root: np.ndarray,
    turn: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A frame's rotation (3,) and translation (3,) after each vertex v has moved to turn v + shift.

    root (3,): its root joint, unposed, which depends on the expression; turn (3, 3), shift (3,)
    meters.
    """
    turned = from_matrices(turn @ axis_angle_matrices(rotation[None]))
    return to_axis_angle(turned)[0], turn @ (root + translation) + shift - root


def change_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(..., E + 18) from one frame's parameters to another's, of the same shape.

    Rotations are axis-angles of the turn that follows `start`'s, of up to 180°: differences of
    axis-angles are none, as the two vectors of half a turn are opposites. All others are
    subtracted.
    """
    change = np.subtract(end, start)
    turns = np.s_[..., -RIGID_SIZE:-TRANSLATION_SIZE]
    before, after = (from_axis_angle(_joints(parameters[turns])) for parameters in (start, end))
    turn = to_axis_angle(multiply(after, before * [1, -1, -1, -1]))
    turn = np.where((before == after).all(-1, keepdims=True), 0.0, turn)  # without rounding
    change[turns] = turn.reshape(change[turns].shape)
    return change


def changed_by(start: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Parameters (..., E + 18) after a change as of `change_between`, of the same shape; of the
    axis-angles of a rotation, that nearest to `start`'s. Nothing is rounded where nothing
    changes."""
    changed = np.add(start, change)
    turns = np.s_[..., -RIGID_SIZE:-TRANSLATION_SIZE]
    before, turn = (
        _joints(np.broadcast_to(each, changed.shape)[turns]) for each in (start, change)
    )
    found = to_axis_angle(multiply(from_axis_angle(turn), from_axis_angle(before)))
    found = np.where(turn.any(-1, keepdims=True), nearest_axis_angle(found, before), before)
    changed[turns] = found.reshape(changed[turns].shape)
    return changed


def parameters_at(times: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Parameters (T, E + 18) at times (T,), of (K, E + 18) at ascending times `known` (K,): linear
    between them, rotations on the shortest arc (spherical linear interpolation, Shoemake 1985);
    constant before and after."""
    row = np.clip(np.searchsorted(known, times, side="right") - 1, 0, max(len(known) - 2, 0))
    after = np.minimum(row + 1, len(known) - 1)
    fraction = (times - known[row]) / np.maximum(known[after] - known[row], 1e-9)
    change = np.clip(fraction, 0, 1)[:, None] * change_between(values[row], values[after])
    return changed_by(values[row], change)


def unwound(parameters: np.ndarray) -> np.ndarray:
    """Parameters (T, E + 18) of consecutive timesteps, each rotation as the axis-angle nearest to
    that of the timestep before, up to MAX_UNWOUND_RAD: a head that nods about half a turn does not
    change its sign."""
    found = parameters.copy()
    turns = _joints(found[:, -RIGID_SIZE:-TRANSLATION_SIZE])
    for row in range(1, len(found)):
        nearest = nearest_axis_angle(turns[row], turns[row - 1])
        is_far = np.linalg.norm(nearest, axis=1, keepdims=True) > MAX_UNWOUND_RAD
        turns[row] = np.where(is_far, turns[row], nearest)
    found[:, -RIGID_SIZE:-TRANSLATION_SIZE] = turns.reshape(len(found), POSE_SIZE)
    return found


def nearest_axis_angle(vectors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(..., 3) the same rotations as axis-angles (..., 3), with the whole turns that bring them
    nearest to others (..., 3)."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = vectors / np.maximum(angle, np.finfo(np.float64).tiny)
    along = (others * axis).sum(-1, keepdims=True)
    return vectors + 2 * np.pi * np.round((along - angle) / (2 * np.pi)) * axis


def _joints(vectors: np.ndarray) -> np.ndarray:
    """(..., J, 3) of axis-angles side by side (..., 3 J)."""
    return vectors.reshape(*vectors.shape[:-1], -1, 3)


def left_jacobians(angles: np.ndarray) -> np.ndarray:
    """(J, 3, 3): the small rotations, before those of axis-angles (J, 3), that their changes amount
    to."""
    angle = np.linalg.norm(angles, axis=1)[:, None, None]
    cross = cross_matrices(angles)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 − cos) / angle²
    third = (1 - np.sinc(angle / np.pi)) / np.maximum(angle, SMALL_ANGLE) ** 2
    third = np.where(angle > SMALL_ANGLE, third, 1 / 6)
    return np.eye(3) + second * cross + third * cross @ cross


def by_change(parameters: np.ndarray) -> np.ndarray:
    """(E + 18, E + 18) derivative of `changed_by` by the change, at none, of parameters (E + 18,)
    whose rotations are less than a whole turn."""
    derivative = np.eye(len(parameters))
    first = len(parameters) - RIGID_SIZE
    for joint, turn in enumerate(left_jacobians(frame_of(parameters).pose)):
        columns = slice(first + 3 * joint, first + 3 * joint + 3)
        derivative[columns, columns] = np.linalg.inv(turn)
    return derivative


def shaped_vertices(
    model: FlameModel, shape: np.ndarray, expr: np.ndarray, offset: np.ndarray | None = None
) -> np.ndarray:
    """Template (V, 3) in meters with identity (I,), expression (E,) and offset (V, 3), unposed."""
    shaped = model.v_template + model.shapedirs @ np.concatenate([shape, expr])
    return shaped if offset is None else shaped + offset


def joint_positions(model: FlameModel, shaped: np.ndarray) -> np.ndarray:
    """Joints (5, 3) of shaped, unposed vertices (V, 3)."""
    return model.j_regressor @ shaped


def flame_forward(
    model: FlameModel, shape: np.ndarray, frame: FlameFrame, static_offset: np.ndarray | None = None
) -> np.ndarray:
    """Vertices (V, 3) in meters of one frame: blend shapes, pose correctives, linear blend
    skinning, translation. shape (I,); static_offset (V, 3) or None. FLAME (Li et al. 2017) with the
    vertex offsets of VHAP."""
    offsets = [offset for offset in (static_offset, frame.dynamic_offset) if offset is not None]
    shaped = shaped_vertices(model, shape, frame.expr, np.sum(offsets, axis=0) if offsets else None)
    posed = _posed(model, shaped, frame)
    vertices = np.einsum("vab,vb->va", posed.skin, posed.corrected) + model.weights @ posed.moved
    return vertices + frame.translation


def parameters_gradient(
    model: FlameModel, frame: FlameFrame, vertex_gradient: np.ndarray
) -> np.ndarray:
    """(E + 18,) gradient of a scalar with respect to the frame's `parameters`, from that with
    respect to its vertices (V, 3): the reverse of `flame_forward`, of a model whose template has
    the identity and the static offset."""
    expressions = model.shapedirs[:, :, model.n_identity :]
    shaped = model.v_template + expressions @ frame.expr
    shaped = shaped if frame.dynamic_offset is None else shaped + frame.dynamic_offset
    posed = _posed(model, shaped, frame)
    force = model.weights.T @ vertex_gradient  # (5, 3), by where each joint moves what it carries
    by_corrected = np.einsum("vab,va->vb", posed.skin, vertex_gradient)
    outer = (vertex_gradient[:, :, None] * posed.corrected[:, None]).reshape(-1, 9)
    by_world = (model.weights.T @ outer).reshape(-1, 3, 3)
    by_world = by_world - force[:, :, None] * posed.joints[:, None]
    by_place = force.copy()
    by_joint = -np.einsum("jab,ja->jb", posed.world, force)
    by_local = np.zeros_like(by_world)
    for joint in reversed(range(len(model.parents))):
        parent = int(model.parents[joint])
        if parent < 0:
            by_local[joint] = by_world[joint]
            by_joint[joint] += by_place[joint]
            continue
        turn = posed.world[parent]
        bone = posed.joints[joint] - posed.joints[parent]
        by_local[joint] = turn.T @ by_world[joint]
        by_world[parent] += by_world[joint] @ posed.local[joint].T + np.outer(by_place[joint], bone)
        by_place[parent] += by_place[joint]
        by_joint[joint] += turn.T @ by_place[joint]
        by_joint[parent] -= turn.T @ by_place[joint]
    by_local[1:] += np.tensordot(by_corrected, model.posedirs, 2).reshape(-1, 3, 3)
    twist = by_local @ posed.local.swapaxes(1, 2)
    torque = np.stack([twist[:, k - 1, k - 2] - twist[:, k - 2, k - 1] for k in range(3)], 1)
    jacobians = left_jacobians(frame.pose)
    by_pose = [jacobian.T @ turn for jacobian, turn in zip(jacobians, torque, strict=True)]
    by_shaped = by_corrected + model.j_regressor.T @ by_joint
    by_expression = np.tensordot(by_shaped, expressions, 2)
    return np.concatenate([by_expression, *by_pose, vertex_gradient.sum(0)])


@dataclass(frozen=True)
class _Posed:
    """A posed frame: joints (5, 3) and vertices with pose correctives (V, 3), both unposed;
    rotations (5, 3, 3) of the joints in their parents and in the world; `moved` (5, 3): a joint
    takes x to R x + moved; R blended (V, 3, 3)."""

    joints: np.ndarray
    corrected: np.ndarray
    local: np.ndarray
    world: np.ndarray
    moved: np.ndarray
    skin: np.ndarray


def _posed(model: FlameModel, shaped: np.ndarray, frame: FlameFrame) -> _Posed:
    joints = joint_positions(model, shaped)
    local = axis_angle_matrices(frame.pose)
    corrected = shaped + model.posedirs @ (local[1:] - np.eye(3)).ravel()
    world = world_turns(model.parents, local)
    moved = joint_places(model.parents, world, joints) - np.einsum("jab,jb->ja", world, joints)
    skin = np.einsum("vj,jab->vab", model.weights, world)
    return _Posed(joints, corrected, local, world, moved, skin)
