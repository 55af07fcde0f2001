"""Distances of landmarks from those of the fitted head, and cameras that do not fit the others."""

import numpy as np

from ..errors import StgaError
from .fit import HeadFit, RecordedTake
from .footage.model import Footage
from .posed_points import PosedPoints, face_size, split

OUTLIER_FACTOR = 4.0
"""A camera is at fault whose landmarks miss the fitted head by this many times those of the
others."""
MIN_OUTLIER_FRACTION = 0.03
"""Least distance of an outlier, beside OUTLIER_FACTOR, as a fraction of the face's size."""
MAX_MEDIAN_ERROR = 0.04
"""Median over the cameras, beyond which they do not see one head: up to 0.016 on sound footage; the
demo's gives 0.06 where no camera is in step with another, and 0.2 mirrored."""

Errors = dict[str, dict[int, tuple[float, float]]]
"""Camera -> timestep -> landmarks' median distance from the head's: pixels, face sizes."""


def reprojection_errors(fit: HeadFit, take: RecordedTake, footage: Footage) -> Errors:
    """Distances of all cameras' landmarks from those of the fitted head."""
    points = PosedPoints(fit.head.model, take.places)
    errors: Errors = {camera.name: {} for camera in footage.cameras}
    for timestep, parameters in fit.parameters.items():
        head = points.positions(*split(parameters))
        landmarks = take.landmarks[timestep]
        detected = zip(
            landmarks.names, landmarks.cameras, landmarks.points, landmarks.confidence, strict=True
        )
        for name, camera, pixels, confidence in detected:
            use = take.reliable & (confidence > 0)
            away = fit.to_capture.camera(camera).project(head[use])[0] - pixels[use]
            distance = float(np.median(np.linalg.norm(away, axis=1)))
            errors[name][timestep] = distance, distance / max(face_size(pixels[use]), 1e-9)
    return errors


def median_px(errors: Errors) -> float:
    """Median in pixels over all cameras and timesteps."""
    return float(np.median([pixels for error in errors.values() for pixels, _ in error.values()]))


def misread_cameras(errors: Errors) -> list[str]:
    """Cameras whose landmarks miss the head by far more than those of the others, the worst
    first."""
    fraction = _fractions(errors)
    found = []
    for name, value in fraction.items():
        others = [fraction[other] for other in fraction if other != name] or [value]
        if value > max(MIN_OUTLIER_FRACTION, OUTLIER_FACTOR * float(np.median(others))):
            found.append(name)
    return sorted(found, key=lambda name: -fraction[name])


def check_cameras(errors: Errors) -> None:
    """Raise StgaError for a camera that does not fit what others see, or where none fits."""

    def at_worst(name: str) -> str:
        worst, (pixels, _) = max(errors[name].items(), key=lambda error: error[1][1])
        return f"camera {name}: its landmarks are off by {pixels:.0f} pixels at timestep {worst}"

    misread = misread_cameras(errors)
    if misread:
        raise StgaError(
            f"{at_worst(misread[0])}, far more than those of the other cameras; "
            "check its calibration, synchronization and mirroring"
        )
    fraction = _fractions(errors)
    if len(fraction) > 1 and float(np.median(list(fraction.values()))) > MAX_MEDIAN_ERROR:
        raise StgaError(
            f"{at_worst(max(fraction, key=fraction.__getitem__))}, and those of the other cameras "
            "are too; check the calibration, and whether all are synchronized and none mirrored"
        )


def _fractions(errors: Errors) -> dict[str, float]:
    """Camera -> median distance of its landmarks from the head's, in face sizes."""
    of_cameras = {
        name: [part for _, part in by_timestep.values()]
        for name, by_timestep in errors.items()
        if by_timestep
    }
    return {name: float(np.median(fractions)) for name, fractions in of_cameras.items()}
