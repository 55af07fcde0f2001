"""FLAME's forward pass in NumPy: parameters to vertices."""

from dataclasses import dataclass

import numpy as np

from .model import FlameModel

POSE_SIZE, TRANSLATION_SIZE = 15, 3
"""The last numbers of a frame's parameters: axis-angles of five joints, and the translation. Expression comes first."""
RIGID_SIZE = POSE_SIZE + TRANSLATION_SIZE


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
        return np.asarray(np.concatenate(joints).reshape(5, 3))

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
    """Rotation matrices (J, 3, 3) of axis-angle vectors (J, 3) in radians (Rodrigues' formula)."""
    angle = np.linalg.norm(axis_angle, axis=1)
    cross = np.zeros((len(axis_angle), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis_angle
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis_angle
    first = np.sinc(angle / np.pi)[:, None, None]  # sin(x) / x
    second = (np.sinc(angle / (2 * np.pi)) ** 2 / 2)[:, None, None]  # (1 - cos(x)) / x²
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def shaped_vertices(
    model: FlameModel, shape: np.ndarray, expr: np.ndarray, offset: np.ndarray | None = None
) -> np.ndarray:
    """Template with identity (I,), expression (E,) and vertex offset (V, 3) added, before posing: (V, 3) meters."""
    shaped = model.v_template + model.shapedirs @ np.concatenate([shape, expr])
    return np.asarray(shaped if offset is None else shaped + offset)


def joint_positions(model: FlameModel, shaped: np.ndarray) -> np.ndarray:
    """Joints (5, 3) of shaped, unposed vertices (V, 3)."""
    return np.asarray(model.j_regressor @ shaped)


def flame_forward(
    model: FlameModel, shape: np.ndarray, frame: FlameFrame, static_offset: np.ndarray | None = None
) -> np.ndarray:
    """Vertices (V, 3) in meters of one frame: blend shapes, pose correctives, linear blend skinning, translation.

    shape (I,); static_offset (V, 3) or None. FLAME (Li et al. 2017) with the vertex offsets of VHAP.
    """
    offsets = [offset for offset in (static_offset, frame.dynamic_offset) if offset is not None]
    shaped = shaped_vertices(model, shape, frame.expr, np.sum(offsets, axis=0) if offsets else None)
    joints = joint_positions(model, shaped)
    rotations = axis_angle_matrices(frame.pose)
    corrected = shaped + model.posedirs @ (rotations[1:] - np.eye(3)).ravel()
    world_rotation, world_joint = rotations.copy(), joints.copy()
    for joint, parent in enumerate(model.parents.tolist()):
        if parent >= 0:
            world_rotation[joint] = world_rotation[parent] @ rotations[joint]
            world_joint[joint] = world_joint[parent] + world_rotation[parent] @ (joints[joint] - joints[parent])
    moved = world_joint - np.einsum("jab,jb->ja", world_rotation, joints)  # each joint's x -> R x + moved
    skin = np.einsum("vj,jab->vab", model.weights, world_rotation)
    return np.asarray(np.einsum("vab,vb->va", skin, corrected) + model.weights @ moved + frame.translation)
