"""Points of a head model's surface, and their derivatives by its parameters."""

from dataclasses import dataclass

import numpy as np

from ..flame.forward import FlameFrame, axis_angle_matrices
from ..flame.model import FlameModel

POSE_SIZE, TRANSLATION_SIZE = 15, 3
RIGID_SIZE = POSE_SIZE + TRANSLATION_SIZE
ANGLE_STEP = 1e-5
"""Radians, for derivatives by joint angles."""


@dataclass(frozen=True)
class SurfacePoints:
    """N places on a mesh: triangle (N,) and barycentric coordinates (N, 3)."""

    face: np.ndarray
    barycentric: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    def on(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Their positions (N, 3), or other values (N, …) interpolated, from those of the vertices (V, …)."""
        return np.asarray(np.einsum("nk,nk...->n...", self.barycentric, vertices[faces[self.face]]))


def parameters_of(frame: FlameFrame) -> np.ndarray:
    """(E + 18,) expression, pose and translation of a FLAME frame."""
    return np.concatenate([frame.expr, frame.pose.ravel(), frame.translation])


def head_rotation(parameters: np.ndarray) -> np.ndarray:
    """(3, 3) of the root joint in (E + 18,) parameters."""
    return np.asarray(axis_angle_matrices(parameters[None, -RIGID_SIZE : -RIGID_SIZE + 3])[0])


class PosedPoints:
    """The model's arrays at surface points; parameters are K coefficients and P = 18 numbers of pose and translation.

    Coefficients are those of `dirs`: identity and expression, or fewer. Pose is (5, 3) axis-angle, as in `FlameFrame`.
    """

    def __init__(self, model: FlameModel, points: SurfacePoints) -> None:
        rows = model.faces[points.face].ravel()
        self.barycentric = points.barycentric
        self.template, self.dirs = model.v_template[rows], model.shapedirs[rows]
        self.posedirs, self.weights, self.parents = model.posedirs[rows], model.weights[rows], model.parents.tolist()
        self.joints = model.j_regressor @ model.v_template
        self.joint_dirs = np.einsum("jv,vak->jak", model.j_regressor, model.shapedirs)

    def positions(self, coefficients: np.ndarray, rigid: np.ndarray) -> np.ndarray:
        """(N, 3) meters; rigid (18,): pose, then translation."""
        shaped = self.template + self.dirs @ coefficients
        return self._place(shaped, self.joints + self.joint_dirs @ coefficients, rigid)

    def linearized(self, coefficients: np.ndarray, rigid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) and their derivatives (N, 3, K + 18), exact but for the step of the joint angles."""
        shaped = self.template + self.dirs @ coefficients
        joints = self.joints + self.joint_dirs @ coefficients
        positions = self._place(shaped, joints, rigid)
        rotations, moved = self._transforms(rigid[:POSE_SIZE], self.joint_dirs)
        skin = np.einsum("vj,jab->vab", self.weights, rotations)
        by_coefficient = skin @ self.dirs + np.einsum("vj,jak->vak", self.weights, moved)
        columns = [self._blend(by_coefficient)]
        for number in range(POSE_SIZE):
            turned = rigid.copy()
            turned[number] += ANGLE_STEP
            columns.append((self._place(shaped, joints, turned) - positions)[..., None] / ANGLE_STEP)
        columns.append(np.broadcast_to(np.eye(3), (len(positions), 3, 3)))
        return positions, np.concatenate(columns, axis=2)

    def _place(self, shaped: np.ndarray, joints: np.ndarray, rigid: np.ndarray) -> np.ndarray:
        rotations, moved = self._transforms(rigid[:POSE_SIZE], joints[..., None])
        local = axis_angle_matrices(rigid[:POSE_SIZE].reshape(5, 3))
        corrected = shaped + self.posedirs @ (local[1:] - np.eye(3)).ravel()
        skin = np.einsum("vj,jab->vab", self.weights, rotations)
        posed = np.einsum("vab,vb->va", skin, corrected) + self.weights @ moved[..., 0]
        return np.asarray(self._blend(posed) + rigid[POSE_SIZE:])

    def _transforms(self, pose: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World rotations (5, 3, 3), and (5, 3, K) by which each joint moves what it carries after rotating it.

        joints (5, 3, K): joint positions, or their derivatives, in which the result is linear.
        """
        rotations = axis_angle_matrices(pose.reshape(5, 3))
        place = joints.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                place[joint] = place[parent] + rotations[parent] @ (joints[joint] - joints[parent])
                rotations[joint] = rotations[parent] @ rotations[joint]
        return rotations, place - rotations @ joints

    def _blend(self, values: np.ndarray) -> np.ndarray:
        """Values (N, …) at the points from those (3 N, …) at their triangles' corners."""
        return np.asarray(
            np.einsum("nk,nk...->n...", self.barycentric, values.reshape(len(self.barycentric), 3, *values.shape[1:]))
        )
