"""Lashes: dark splats around the eyes that stand off the mesh, and throw shadows that the mesh does not."""

from dataclasses import dataclass

import numpy as np

from ..avatar.embedding import face_frames, points_to_world
from ..avatar.file import Avatar
from ..capture.mesh_geometry import connected_parts, vertex_normals
from ..flame.quaternions import to_matrices
from .surface import at_splats
from .values import Caster

REACH_M = 0.025
"""From the middle of an eyeball."""
MIN_HEIGHT_M = 0.002
"""Above the mesh: shadow maps have a bias, and splats of skin lie within 1.5 mm."""
MIN_OPACITY, MAX_ALBEDO = 0.3, 0.15
EXTENT = 2.0
"""Distance of a lash's corners from its middle, in standard deviations of the splat: gaps between lashes close."""
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Lashes:
    """Four-cornered cards in the frames of triangles.

    face (M,) of the mesh. corners (M, 4, 3) float32 in the frame of that triangle (`avatar.embedding`).
    """

    avatar: Avatar
    face: np.ndarray
    corners: np.ndarray

    def caster(self, mesh: np.ndarray) -> Caster:
        """The cards of a head posed as mesh (V, 3), as what throws shadows."""
        avatar, used = self.avatar, self.avatar.faces[self.face]
        frames = face_frames(mesh, used, avatar.neutral, avatar.convention)
        corners = self.corners.reshape(-1, 3)
        vertices = points_to_world(corners, frames, np.repeat(np.arange(len(self.face)), 4))
        faces = 4 * np.arange(len(self.face))[:, None, None] + TRIANGLES
        return Caster(vertices, faces.reshape(-1, 3).astype(np.int32))


def find_lashes(
    avatar: Avatar, corners: np.ndarray, weights: np.ndarray, roughness: np.ndarray, albedo: np.ndarray
) -> Lashes:
    """The lashes of an avatar whose light is known.

    corners, weights (N, 3): `surface.surface_points`. roughness (N,) and albedo (N, 3) of the splats.
    """
    assert avatar.light is not None
    splats, neutral = avatar.splats, avatar.neutral.astype(np.float64)
    frames = face_frames(neutral, avatar.faces, neutral, avatar.convention)
    dark = (albedo.mean(1) < MAX_ALBEDO) & (roughness == 0) & (splats.opacities() > MIN_OPACITY)
    found = np.flatnonzero(dark)
    points = points_to_world(splats.xyz[found], frames, splats.face[found])
    found, points = (rows[_near_eyes(points, neutral, avatar)] for rows in (found, points))
    normal = at_splats(vertex_normals(neutral, avatar.faces), corners[found], weights[found])
    above = points - at_splats(neutral, corners[found], weights[found])
    height = (above * normal).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    found = found[height > MIN_HEIGHT_M]
    return Lashes(avatar, splats.face[found], _cards(avatar, found))


def _near_eyes(points: np.ndarray, neutral: np.ndarray, avatar: Avatar) -> np.ndarray:
    """(M,) bool: points (M, 3) of the neutral mesh within REACH_M of the middle of an eyeball."""
    assert avatar.light is not None
    wet = avatar.light.roughness > 0
    part = connected_parts(len(neutral), avatar.faces[wet[avatar.faces].all(1)])
    near = np.zeros(len(points), bool)
    for label in np.unique(part[wet]):
        middle = neutral[wet & (part == label)].mean(0)
        near |= np.linalg.norm(points - middle, axis=1) < REACH_M
    return near


def _cards(avatar: Avatar, splat: np.ndarray) -> np.ndarray:
    """(M, 4, 3) float32: ends of the two longest axes of splats (M,), in turn, in the frames of their triangles."""
    rows = avatar.splats.rows(splat)
    scale = np.exp(rows.log_scale.astype(np.float64))
    longest = np.argsort(-scale, axis=1, kind="stable")[:, :2]
    axes = np.swapaxes(to_matrices(rows.rotation), 1, 2)
    first, second = (
        EXTENT * np.take_along_axis(scale, longest[:, k, None], 1) * axes[np.arange(len(splat)), longest[:, k]]
        for k in range(2)
    )
    offsets = np.stack([first, second, -first, -second], axis=1)
    return np.asarray(rows.xyz[:, None] + offsets, np.float32)
