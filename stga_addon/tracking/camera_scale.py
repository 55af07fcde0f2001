"""Cameras that see the head larger or smaller than the others do: the sign of a wrong focal length."""

from collections.abc import Mapping

import numpy as np

from ..capture.mesh_geometry import vertex_normals
from ..flame.forward import RIGID_SIZE
from .fit import HeadFit
from .footage.model import Footage
from .landmarks import CameraLandmarks
from .posed_points import PosedPoints, SurfacePoints, head_rotation

MAX_SCALE_DIFFERENCE = 0.043
"""Of a camera from the median of all. Landmarks alone differ by up to 0.041 from the side; 5 % of focal length show."""
MIN_CAMERAS = 4
MIN_VISIBILITY = 0.1
"""Squared cosine of the angle at which a camera sees a landmark's surface, below which the landmark is not used."""
MAX_TIMESTEPS = 40
ITERATIONS, OUTLIER_SCALE = 8, 1.5


def scale_warnings(
    fit: HeadFit, places: SurfacePoints, used: np.ndarray, footage: Footage, found: Mapping[str, CameraLandmarks]
) -> tuple[str, ...]:
    """One sentence for each camera whose landmarks are of another size than the fitted head is there."""
    scales = camera_scales(fit, places, used, footage, found)
    if len(scales) < MIN_CAMERAS:
        return ()
    medians = {name: float(np.median(list(own.values()))) for name, own in scales.items()}
    usual = float(np.median(list(medians.values())))
    warnings = []
    for name, value in medians.items():
        difference = value / usual - 1
        if abs(difference) > MAX_SCALE_DIFFERENCE:
            worst = max(scales[name], key=lambda t: abs(scales[name][t] / usual - 1))
            size = "larger" if difference > 0 else "smaller"
            warnings.append(
                f"camera {name}: shows the head {abs(difference):.1%} {size} than the other cameras do, most at "
                f"timestep {worst}; check its focal length and position"
            )
    return tuple(warnings)


def camera_scales(
    fit: HeadFit, places: SurfacePoints, used: np.ndarray, footage: Footage, found: Mapping[str, CameraLandmarks]
) -> dict[str, dict[int, float]]:
    """Camera -> timestep -> size of its landmarks over that of the fitted head's in its image."""
    model = fit.head.model
    points, normals = PosedPoints(model, places), places.on(vertex_normals(model.v_template, model.faces), model.faces)
    cameras = {camera.name: fit.to_capture.camera(camera.camera) for camera in footage.cameras}
    timesteps = sorted(fit.parameters)[:: 1 + len(fit.parameters) // MAX_TIMESTEPS]
    scales: dict[str, dict[int, float]] = {}
    for timestep in timesteps:
        values = fit.parameters[timestep]
        at = points.positions(values[:-RIGID_SIZE], values[-RIGID_SIZE:])
        facing = normals @ head_rotation(values).T
        for name, own in found.items():
            rows = np.flatnonzero(own.timesteps == timestep)
            if not len(rows):
                continue
            towards = cameras[name].position - at
            length = np.linalg.norm(towards, axis=1) * np.maximum(np.linalg.norm(facing, axis=1), 1e-9)
            visible = np.clip((facing * towards).sum(1) / length, 0, 1) ** 2
            use = used & (own.confidence[rows[0]] > 0) & (visible > MIN_VISIBILITY)
            if use.sum() > RIGID_SIZE:
                projected, _ = cameras[name].project(at[use])
                scales.setdefault(name, {})[timestep] = _scale(projected, own.points[rows[0]][use], visible[use])
    return scales


def _scale(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> float:
    """The scale with which points (N, 2) fit others, after the mean shift; outliers count little."""
    scale, used = 1.0, weights
    for _ in range(ITERATIONS):
        a = source - (used[:, None] * source).sum(0) / used.sum()
        b = target - (used[:, None] * target).sum(0) / used.sum()
        scale = float((used * (a * b).sum(1)).sum() / (used * (a**2).sum(1)).sum())
        distance = np.linalg.norm(b - scale * a, axis=1)
        used = weights / (1 + (distance / max(OUTLIER_SCALE * float(np.median(distance)), 1e-9)) ** 2) ** 2
    return scale
