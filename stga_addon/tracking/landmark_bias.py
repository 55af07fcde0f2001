"""Bias of the networks' landmarks on a head, by the direction from which a camera sees it."""

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
"""Azimuths (A,) and elevations (E,) in degrees, and the networks' offsets (A, E, N, 2) in meters at
the head's distance, to the right and down in an image whose camera is upright before the head; made
by `development/landmark_bias.py`."""
UP = np.array([0.0, 1.0, 0.0])  # In the head's axes; its face looks along +z


def without_bias(
    points: np.ndarray, camera: Camera, neutral: np.ndarray, reliable: np.ndarray
) -> np.ndarray:
    """Landmarks (N, 2) of the networks, in pixels of `camera`, moved to where they belong.

    neutral (N, 3) meters: their places on the neutral head; reliable (N,) bool: by which the
    direction is found that the camera sees the head from. Beyond the file's directions the nearest
    one counts. Landmarks of another number are another detector's, and stay.
    """
    table = _table()
    if table.values.shape[2] != len(points):  # of another detector
        return points
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
    offset = table(at)[0] @ (left @ other).T
    return points - offset * [camera.fl_x, camera.fl_y] / distance


@cache
def _table() -> Any:
    """The file's offsets, to be interpolated: (azimuth, elevation) -> (1, N, 2)."""
    from scipy.interpolate import RegularGridInterpolator

    arrays = read_npz(BIAS_FILE)
    grid = arrays["azimuth_deg"].astype(np.float64), arrays["elevation_deg"].astype(np.float64)
    return RegularGridInterpolator(grid, arrays["offset_m"].astype(np.float64))


def _pose(
    points: np.ndarray, camera: Camera, neutral: np.ndarray, reliable: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) of the head, and the center (3,) of its landmarks, in the camera's world."""
    at = pose_from_one_camera(camera, points[reliable], neutral[reliable])
    return similarity(neutral[reliable], at, metric=True).rotation, at.mean(0)
