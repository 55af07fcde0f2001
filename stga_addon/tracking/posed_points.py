"""Points of a head model's surface, and their derivatives by its parameters."""

from dataclasses import dataclass

import numpy as np

from ..capture.mesh_geometry import triangle_normals
from ..flame.forward import (
    POSE_SIZE,
    RIGID_SIZE,
    TRANSLATION_SIZE,
    axis_angle_matrices,
    cross_matrices,
    joint_places,
    left_jacobians,
    world_turns,
)
from ..flame.model import FlameModel
from ..flame.quaternions import unit


@dataclass(frozen=True)
class SurfacePoints:
    """N places on a mesh: triangle (N,) and barycentric coordinates (N, 3)."""

    face: np.ndarray
    barycentric: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    def __getitem__(self, rows: np.ndarray) -> "SurfacePoints":
        return SurfacePoints(self.face[rows], self.barycentric[rows])

    def __add__(self, other: "SurfacePoints") -> "SurfacePoints":
        both = zip((self.face, self.barycentric), (other.face, other.barycentric), strict=True)
        return SurfacePoints(*map(np.concatenate, both))

    def on(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Their positions (N, 3), or other values (N, …) interpolated, from those of the vertices
        (V, …)."""
        return np.einsum("nk,nk...->n...", self.barycentric, vertices[faces[self.face]])


def head_rotation(parameters: np.ndarray) -> np.ndarray:
    """(3, 3) of the root joint in (E + 18,) parameters."""
    return axis_angle_matrices(parameters[None, -RIGID_SIZE : -RIGID_SIZE + 3])[0]


def split(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (K,), and pose with translation (18,), of parameters (K + 18,)."""
    return parameters[:-RIGID_SIZE], parameters[-RIGID_SIZE:]


def face_size(pixels: np.ndarray) -> float:
    """Diagonal of the box around landmarks (N, 2)."""
    return float(np.linalg.norm(np.ptp(pixels, axis=0)))


class PosedPoints:
    """The model's arrays at surface points; parameters are K coefficients and P = 18 numbers of
    pose and translation.

    Coefficients are those of `dirs`: identity and expression, or fewer. Pose is (5, 3) axis-angle,
    as in `FlameFrame`. Results have the precision of `dirs`.
    """

    def __init__(self, model: FlameModel, points: SurfacePoints) -> None:
        rows = model.faces[points.face].ravel()
        self._precision = model.shapedirs.dtype
        self.barycentric = points.barycentric.astype(self._precision)
        self.template = model.v_template[rows]
        self.dirs = model.shapedirs[rows]
        self.weights = model.weights[rows]
        self.parents = model.parents.tolist()
        self.posedirs = model.posedirs[rows] if model.posedirs.any() else None
        self.joints = model.j_regressor @ model.v_template
        self.joint_dirs = np.tensordot(model.j_regressor, model.shapedirs, 1)
        # (J, J): 1 where a joint (column) is one (row) or is carried by it
        self._below = np.eye(len(self.parents), dtype=self._precision)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                self._below[:, joint] += self._below[:, parent]
        self._used = np.flatnonzero(self.weights.any(0))  # joints that carry any of the points
        weights = self.weights[:, self._used] * self.barycentric.reshape(-1, 1)
        self._corner_weights = weights.T.reshape(len(self._used), -1, 3)
        self._last: tuple[bytes, _Posed] | None = None

    def positions(self, coefficients: np.ndarray, rigid: np.ndarray) -> np.ndarray:
        """(N, 3) meters; rigid (18,): pose, then translation."""
        return self._posed(coefficients, rigid).positions

    def triangle_normals(self, coefficients: np.ndarray, rigid: np.ndarray) -> np.ndarray:
        """(N, 3) unit normals of the posed triangles that the points lie on."""
        corners = self._posed(coefficients, rigid).corners.reshape(-1, 3, 3)
        return unit(triangle_normals(corners), 1e-20)

    def linearized(
        self, coefficients: np.ndarray, rigid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) and their derivatives (N, 3, K + 18)."""
        posed = self._posed(coefficients, rigid)
        count = len(self.barycentric)
        turns = left_jacobians(posed.angles).astype(self._precision)
        first = self.dirs.shape[2]
        used = self._used
        fraction = self._corner_weights.sum(2)
        found = np.empty((count, 3, first + RIGID_SIZE), self._precision)
        by_pose = found[..., first:-TRANSLATION_SIZE]
        # Blending and skinning are one product of (N, 3, 9) and (N, 9, K).
        skin = self._weighted(posed.skin).transpose(0, 2, 1, 3).reshape(count, 3, 9)
        places = joint_places(self.parents, posed.rotations, self.joint_dirs)
        moved: np.ndarray = places - posed.rotations @ self.joint_dirs
        found[..., :first] = skin @ self.dirs.reshape(count, 9, first)
        found[..., :first] += np.tensordot(fraction.T, moved[used], 1)
        # Turning a joint turns about it what it and the joints below it carry, each with its
        # fraction of the skin.
        turned = posed.corrected @ posed.rotations[used].swapaxes(1, 2) + posed.moved[used, None]
        corners = turned.reshape(*self._corner_weights.shape, 3)
        carried = np.einsum("jnc,jncx->jnx", self._corner_weights, corners)
        below = (self._below[:, used] @ fraction)[..., None] * posed.places[:, None]
        arms = np.tensordot(self._below[:, used], carried, 1) - below
        parents = [np.eye(3) if parent < 0 else posed.rotations[parent] for parent in self.parents]
        across = np.einsum("yxz,jyc->jzxc", cross_matrices(np.eye(3)), parents @ turns)
        across = across.astype(self._precision)
        by_joint = (arms @ across.reshape(-1, 3, 9)).reshape(*arms.shape, 3)
        by_pose[:] = by_joint.transpose(1, 2, 0, 3).reshape(count, 3, POSE_SIZE)
        if self.posedirs is not None:  # by all joints but the root
            bent = np.zeros((self.posedirs.shape[2], POSE_SIZE), self._precision)
            for joint in range(1, len(turns)):
                changes = (cross_matrices(turns[joint].T) @ posed.local[joint]).reshape(3, 9)
                bent[9 * (joint - 1) : 9 * joint, 3 * joint : 3 * joint + 3] = changes.T
            by_pose += skin @ (self.posedirs.reshape(-1, len(bent)) @ bent).reshape(count, 9, -1)
        found[..., -TRANSLATION_SIZE:] = np.eye(3)
        return posed.positions, found

    def _posed(self, coefficients: np.ndarray, rigid: np.ndarray) -> "_Posed":
        # positions, normals and derivatives are mostly asked for together
        key = np.concatenate([coefficients, rigid]).tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        angles = rigid[:POSE_SIZE].reshape(-1, 3)
        coefficients = coefficients.astype(self._precision)
        local = axis_angle_matrices(angles).astype(self._precision)
        rotations = world_turns(self.parents, local)
        joints = self.joints + self.joint_dirs @ coefficients
        places = joint_places(self.parents, rotations, joints)
        moved = places - (rotations @ joints[..., None])[..., 0]
        corrected = self.template + self.dirs @ coefficients
        if self.posedirs is not None:
            corrected += self.posedirs @ (local[1:] - np.eye(3, dtype=local.dtype)).ravel()
        skin = (self.weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        posed = np.einsum("nij,nj->ni", skin, corrected) + self.weights @ moved
        positions = self._weighted(posed).sum(1) + rigid[POSE_SIZE:].astype(self._precision)
        found = _Posed(positions, angles, local, rotations, places, moved, corrected, skin, posed)
        self._last = key, found
        return found

    def _weighted(self, values: np.ndarray) -> np.ndarray:
        """Values (3 N, …) at the triangles' corners as (N, 3 corners, …), times the barycentric
        coordinates."""
        shaped = values.reshape(len(self.barycentric), 3, *values.shape[1:])
        return shaped * self.barycentric.reshape(len(shaped), 3, *([1] * (values.ndim - 1)))


@dataclass(frozen=True)
class _Posed:
    """One evaluation: positions (N, 3); of J joints axis-angles (J, 3), local and world rotations
    (J, 3, 3), places in the world (J, 3), and shifts (J, 3) after rotating about the origin; of the
    3 N corners, corrected positions, blended rotations (3 N, 3, 3) and positions."""

    positions: np.ndarray
    angles: np.ndarray
    local: np.ndarray
    rotations: np.ndarray
    places: np.ndarray
    moved: np.ndarray
    corrected: np.ndarray
    skin: np.ndarray
    corners: np.ndarray
