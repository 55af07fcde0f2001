"""Cameras that see the head larger or smaller than the others do: the sign of a wrong focal
length."""

from collections.abc import Mapping

import numpy as np

from ..flame.forward import RIGID_SIZE
from .fit import HeadFit, LandmarkVisibility
from .footage.model import Footage
from .landmarks import CameraLandmarks
from .posed_points import SurfacePoints, head_rotation

MAX_SCALE_DIFFERENCE = 0.043
"""Of a camera from the median of all; 5 % of focal length show."""
MAX_SIDE_DEG = 60.0
"""Between the way the head faces and a camera, beyond which its landmarks are not compared: on the
path-traced head, scales of single views have a standard deviation of 0.01 up to here, and of 0.03
beyond, with a mean of −0.02."""
MIN_CAMERAS = 4
MIN_VISIBILITY = 0.1
"""Squared cosine of the angle at which a camera sees a landmark's surface, below which the landmark
is not used."""
MAX_TIMESTEPS = 40
ITERATIONS, OUTLIER_SCALE = 8, 1.5


def scale_warnings(
    fit: HeadFit,
    places: SurfacePoints,
    used: np.ndarray,
    footage: Footage,
    found: Mapping[str, CameraLandmarks],
) -> tuple[str, ...]:
    """One sentence for each camera whose landmarks are of another size than the fitted head is
    there."""
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
    fit: HeadFit,
    places: SurfacePoints,
    used: np.ndarray,
    footage: Footage,
    found: Mapping[str, CameraLandmarks],
) -> dict[str, dict[int, float]]:
    """Camera -> timestep -> size of its landmarks over that of the fitted head's in its image,
    where it sees the face not only from the side."""
    visibility = LandmarkVisibility(fit.head, places)
    cameras = {camera.name: fit.to_capture.camera(camera.camera) for camera in footage.cameras}
    timesteps = sorted(fit.parameters)[:: 1 + len(fit.parameters) // MAX_TIMESTEPS]
    scales: dict[str, dict[int, float]] = {}
    for timestep in timesteps:
        for name, own in found.items():
            rows = np.flatnonzero(own.timesteps == timestep)
            if not len(rows):
                continue
            at, (visible,) = visibility.seen(fit.parameters[timestep], cameras[name].position[None])
            away = (cameras[name].position - at[used].mean(0)) @ head_rotation(
                fit.parameters[timestep]
            )
            if away[2] < np.cos(np.radians(MAX_SIDE_DEG)) * np.linalg.norm(away):
                continue
            use = used & (own.confidence[rows[0]] > 0) & (visible > MIN_VISIBILITY)
            if use.sum() > RIGID_SIZE:
                projected, _ = cameras[name].project(at[use])
                scales.setdefault(name, {})[timestep] = _scale(
                    projected, own.points[rows[0]][use], visible[use]
                )
    return scales


def _scale(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> float:
    """The scale with which points (N, 2) fit others, after the mean shift; outliers count
    little."""
    scale, used = 1.0, weights
    for _ in range(ITERATIONS):
        a = source - (used[:, None] * source).sum(0) / used.sum()
        b = target - (used[:, None] * target).sum(0) / used.sum()
        scale = float((used * (a * b).sum(1)).sum() / (used * (a**2).sum(1)).sum())
        distance = np.linalg.norm(b - scale * a, axis=1)
        used = (
            weights
            / (1 + (distance / max(OUTLIER_SCALE * float(np.median(distance)), 1e-9)) ** 2) ** 2
        )
    return scale
