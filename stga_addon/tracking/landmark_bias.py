"""Bias of the networks' landmarks on a head, by the direction and distance of the camera."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import similarity
from ..files import read_npz
from ..flame.quaternions import unit
from .fit import pose_from_one_camera

BIAS_FILE = Path(__file__).parent / "networks/landmark_bias.npz"
"""Azimuths (A,) and elevations (E,) in degrees; `offset_m`, the networks' offsets (A, E, N, 2) in
meters at the head's distance, to the right and down in an image whose camera is upright at
TABLE_DISTANCE_M in front of the head; `nearness_m2`, by how much they grow for each 1/m by which
the camera is nearer. Made by `development/landmark_bias.py`."""
TABLE_DISTANCE_M = 1.2
"""Distance of the cameras of `offset_m`. From farther away, offsets are the same."""
MIN_DISTANCE_M = 0.3
"""Smallest distance for which offsets are known."""
UP = np.array([0.0, 1.0, 0.0])  # In the head's axes; its face looks along +z


@dataclass(frozen=True)
class LandmarkBias:
    """Bias of the landmarks of one image, in pixels.

    offset      (N, 2) from a camera at TABLE_DISTANCE_M
    nearness    (N, 2) by how much it grows for each 1/m by which the camera is nearer
    distance_m  of the camera, as its focal length says
    """

    offset: np.ndarray
    nearness: np.ndarray
    distance_m: float

    def beyond_offset(self, distance_m: float) -> np.ndarray:
        """(N, 2): the bias from a camera at this distance, less `offset`."""
        near = min(max(distance_m, MIN_DISTANCE_M), TABLE_DISTANCE_M)
        return np.asarray(self.nearness * (1 / near - 1 / TABLE_DISTANCE_M))

    def of_rows(self, rows: np.ndarray) -> "LandmarkBias":
        """Bias of these landmarks alone."""
        return replace(self, offset=self.offset[rows], nearness=self.nearness[rows])


def without_bias(
    points: np.ndarray, camera: Camera, neutral: np.ndarray, reliable: np.ndarray
) -> np.ndarray:
    """Landmarks (N, 2) of the networks, in pixels of `camera`, moved to where they belong if it is
    at TABLE_DISTANCE_M. neutral, reliable: as of `bias_in`. Landmarks of another detector stay."""
    bias = bias_in(points, camera, neutral, reliable)
    return points if bias is None else points - bias.offset


def bias_in(
    points: np.ndarray, camera: Camera, neutral: np.ndarray, reliable: np.ndarray
) -> LandmarkBias | None:
    """Bias of landmarks (N, 2) of the networks, in pixels of `camera`; None for landmarks of
    another number, which are another detector's.

    neutral (N, 3) meters: their places on the neutral head; reliable (N,) bool: by which the
    direction is found that the camera sees the head from. Beyond the file's directions the nearest
    one counts.
    """
    table = _table()
    if table.values.shape[2] != len(points):
        return None
    turn, center = _pose(points, camera, neutral, reliable)
    away = camera.position - center
    distance = float(np.linalg.norm(away))
    direction = turn.T @ away / distance
    azimuth = np.degrees(np.arctan2(direction[0], direction[2]))
    elevation = np.degrees(np.arcsin(np.clip(direction[1], -1, 1)))
    right = unit(np.cross(UP, direction))
    down = np.cross(right, direction)
    # the roll between the upright camera's image and this one: the nearest rotation
    in_image = (camera.rotation @ turn @ np.stack([right, down], axis=1))[:2]
    left, _, other = np.linalg.svd(in_image)
    limits = [(axis[0], axis[-1]) for axis in table.grid]
    at = [np.clip(value, *limit) for value, limit in zip((azimuth, elevation), limits, strict=True)]
    px_per_m = np.array([camera.fl_x, camera.fl_y]) / distance
    in_pixels = table(at)[0].reshape(-1, 2, 2) @ (left @ other).T * px_per_m  # (N, 2, 2)
    return LandmarkBias(in_pixels[:, 0], in_pixels[:, 1], distance)


@cache
def _table() -> Any:
    """The file's arrays, to be interpolated: (azimuth, elevation) -> (1, N, 4)."""
    from scipy.interpolate import RegularGridInterpolator

    arrays = read_npz(BIAS_FILE)
    grid = arrays["azimuth_deg"].astype(np.float64), arrays["elevation_deg"].astype(np.float64)
    values = np.concatenate([arrays["offset_m"], arrays["nearness_m2"]], axis=-1)
    return RegularGridInterpolator(grid, values.astype(np.float64))


def _pose(
    points: np.ndarray, camera: Camera, neutral: np.ndarray, reliable: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) of the head, and the center (3,) of its landmarks, in the camera's world."""
    at = pose_from_one_camera(camera, points[reliable], neutral[reliable])
    return similarity(neutral[reliable], at, metric=True).rotation, at.mean(0)
