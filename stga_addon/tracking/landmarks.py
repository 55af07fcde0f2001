"""Landmarks of every frame: detected, or read from a folder of files."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.camera import Camera
from ..capture.model import parts_of
from ..errors import StgaError
from ..files import read_npz, write_npz
from ..flame.model import floats
from ..worker.helpers import MAX_HELPERS, Step
from .face_networks import FaceNetworks
from .fit import MIN_LANDMARKS
from .folder import PLACES_FILE
from .footage.model import Footage, FootageCamera
from .posed_points import SurfacePoints
from .stages import Stage, Workers

MIN_BARYCENTRIC = -1e-3
"""Least barycentric coordinate of a landmark's place."""
MAX_SUM_ERROR = 1e-3
"""Largest difference of their sum from 1."""
MAX_PIXELS = 1e5
"""Largest coordinate of a landmark, three times as far as the largest image reaches."""
MAX_CONFIDENCE = 1e6
"""Largest confidence of a landmark: some detectors write scores instead of 0…1."""
MAX_TWO_FACES_FRACTION = 0.34
"""Fraction of a camera's frames, or of all where each camera has one, with a second face, beyond
which the footage is not of one person: a pattern on a wall may look like one."""
MIN_PART_TIMESTEPS = 50
"""Least number of timesteps in a part of a camera's take. There are as many parts as helpers at
most: each decodes a video from the key frame before it, or from the beginning."""
MIN_OVERLAP = 0.3  # Overlap of two faces' boxes above which they are one face, found twice


@dataclass(frozen=True)
class CameraLandmarks:
    """What one camera sees of N landmarks: timesteps (T,), points (T, N, 2) pixels, confidence (T,
    N); 0: not seen."""

    timesteps: np.ndarray
    points: np.ndarray
    confidence: np.ndarray


def landmark_file(folder: Path, camera: str) -> Path:
    """The file of a camera; characters that not all file systems allow are percent-encoded, as in
    `walk%2F1.npz`."""

    def encoded(found: re.Match[str]) -> str:
        return "".join(f"%{byte:02X}" for byte in found[0].encode())

    name = re.sub(r"[^\w.-]", encoded, camera) + ".npz"
    return folder / (name if name != PLACES_FILE else name.replace("h", "%68", 1))


def detect_landmarks(
    footage: Footage,
    detector: FaceNetworks,
    unbiased: Callable[[np.ndarray, Camera], np.ndarray],
    folder: Path,
    workers: Workers,
) -> dict[str, CameraLandmarks]:
    """Landmarks by camera; each camera's are written to `folder`, and read from there where they
    are already.

    detector: can be handed to helping processes; unbiased: what it finds (N, 2) in pixels of a
    camera, moved to where it belongs. A frame with several faces counts as one without a
    face. Raises StgaError where there are often several.
    """
    total = sum(len(camera.timesteps) for camera in footage.cameras)
    found: dict[str, CameraLandmarks] = {}
    # views with a second face, of cameras that see one moment
    crowded: list[tuple[FootageCamera, int]] = []
    done = 0
    for camera in footage.cameras:
        path = landmark_file(folder, camera.name)
        if not path.exists():
            limit = max(MIN_PART_TIMESTEPS, -(-len(camera.timesteps) // MAX_HELPERS))
            parts = [(camera, part, detector) for part in parts_of(camera.timesteps, limit)]
            detected = [
                faces
                for part in workers.map(_detect, parts, (Stage.LANDMARKS, done, total))
                for faces in part
            ]
            several = [
                t for t, each in zip(camera.timesteps, detected, strict=True) if len(each) > 1
            ]
            if len(camera.timesteps) == 1:
                crowded += [(camera, timestep) for timestep in several]
            elif len(several) > MAX_TWO_FACES_FRACTION * len(camera.timesteps):
                raise StgaError(
                    f"{camera.source(several[0])}: camera {camera.name} sees {len(several)} of "
                    f"{len(camera.timesteps)} frames with two faces, the first at timestep "
                    f"{several[0]}; expected one person"
                )
            faces = [each[0] if len(each) == 1 else None for each in detected]
            number = next((len(face) for face in faces if face is not None), 0)
            points = [
                np.zeros((number, 2)) if face is None else unbiased(face, camera.camera)
                for face in faces
            ]
            confidence = np.tile([[float(face is not None)] for face in faces], (1, number))
            timesteps = np.array(camera.timesteps)
            write_camera(path, CameraLandmarks(timesteps, np.stack(points), confidence))
        # in the file's precision, whether it was detected now or before
        found[camera.name] = read_camera(path, camera)
        done += len(camera.timesteps)
        workers.report(Stage.LANDMARKS, done, total)
    if len(crowded) > MAX_TWO_FACES_FRACTION * total:
        camera, timestep = crowded[0]
        raise StgaError(
            f"{camera.source(timestep)}: is one of {len(crowded)} of {total} images with two "
            "faces; expected one person"
        )
    return found


def read_landmarks(footage: Footage, folder: Path) -> dict[str, CameraLandmarks]:
    """Landmarks by camera from files of any detector; cameras without a file are not used. Raises
    StgaError."""
    files = {camera.name: landmark_file(folder, camera.name) for camera in footage.cameras}
    written = [camera for camera in footage.cameras if files[camera.name].exists()]
    found = {camera.name: read_camera(files[camera.name], camera) for camera in written}
    if not found:
        first = next(iter(files.values())).name
        raise StgaError(f"{folder}: has landmarks of no camera; expected files such as {first}")
    counts = {name: landmarks.points.shape[1] for name, landmarks in found.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{files[name].name} {count}" for name, count in counts.items())
        raise StgaError(f"{folder}: the files have different numbers of landmarks: {listed}")
    return found


def read_camera(path: Path, camera: FootageCamera) -> CameraLandmarks:
    """One camera's file. Raises StgaError naming the file and the field."""
    arrays = read_npz(path)
    if "timesteps" not in arrays:
        raise StgaError(f"{path}: has no timesteps")
    timesteps = arrays["timesteps"]
    listed = timesteps.tolist() if timesteps.ndim == 1 and timesteps.dtype.kind in "iu" else [None]
    if not set(listed) <= set(camera.timesteps) or len(set(listed)) < len(listed):
        raise StgaError(
            f"{path}: timesteps: expected timesteps of camera {camera.name}, each once, whole "
            "numbers (any,)"
        )
    shape = len(timesteps), None, 2
    points = floats(path, arrays, "points", shape, "f", "floating-point numbers")
    arrays = {"confidence": np.isfinite(points).all(2), **arrays}
    confidence = floats(path, arrays, "confidence", points.shape[:2], "biuf")
    # also where it is not a number
    if not ((confidence >= 0) & (confidence <= MAX_CONFIDENCE)).all():
        raise StgaError(f"{path}: confidence: expected numbers from 0 to {MAX_CONFIDENCE:g}")
    detected = points[confidence > 0]
    if not np.isfinite(detected).all():
        raise StgaError(f"{path}: points: expected finite pixels where confidence is not 0")
    if not (np.abs(detected) <= MAX_PIXELS).all():
        raise StgaError(
            f"{path}: points: expected pixels of at most {MAX_PIXELS:.0f}, as far as no image "
            "reaches"
        )
    known = np.where(confidence[..., None] > 0, points, 0.0)
    return CameraLandmarks(timesteps.astype(np.int64), known, confidence)


def write_camera(path: Path, landmarks: CameraLandmarks) -> None:
    arrays = {
        "timesteps": landmarks.timesteps,
        "points": landmarks.points.astype(np.float32),
        "confidence": landmarks.confidence.astype(np.float32),
    }
    write_npz(path, arrays)


def read_places(path: Path, triangles: int) -> tuple[SurfacePoints, np.ndarray]:
    """Where landmarks lie on the head model: `face` (N,), −1 for an unused one, and `barycentric`
    (N, 3).

    Returns the places and (N,) bool which are used. Raises StgaError naming the file and the field.
    """
    arrays = read_npz(path)
    if "face" not in arrays:
        raise StgaError(f"{path}: has no face")
    face = arrays["face"]
    expected = f"triangles from 0 to {triangles - 1}, or -1, of shape (any,)"
    is_row = face.ndim == 1 and face.dtype.kind in "iu"
    if not is_row or not ((face >= -1) & (face < triangles)).all():
        raise StgaError(f"{path}: face: expected {expected}")
    used = face >= 0
    if used.sum() < MIN_LANDMARKS:
        raise StgaError(
            f"{path}: face: uses {used.sum()} landmarks, expected at least {MIN_LANDMARKS}"
        )
    barycentric = floats(path, arrays, "barycentric", (len(face), 3), "biuf")
    if not np.isfinite(barycentric).all():
        raise StgaError(f"{path}: barycentric: expected finite numbers")
    fractions = np.where(used[:, None], barycentric, 1 / 3)
    if not (fractions >= MIN_BARYCENTRIC).all():
        raise StgaError(f"{path}: barycentric: expected numbers from 0 up")
    with np.errstate(over="ignore"):
        if not (np.abs(fractions.sum(1) - 1) <= MAX_SUM_ERROR).all():
            raise StgaError(f"{path}: barycentric: expected rows that add up to 1")
    return SurfacePoints(np.maximum(face, 0).astype(np.int64), fractions), used


def check_count(found: Mapping[str, CameraLandmarks], places: SurfacePoints) -> None:
    """Raise StgaError for a camera that sees a face and has another number of landmarks than the
    head model's file."""
    for name, camera in found.items():
        count = camera.points.shape[1]
        if camera.confidence.any() and count != len(places):
            raise StgaError(
                f"camera {name}: has {count} landmarks, but the head model's file has {len(places)}"
            )


def write_places(path: Path, places: SurfacePoints, used: np.ndarray) -> None:
    write_npz(path, {"face": np.where(used, places.face, -1), "barycentric": places.barycentric})


def _detect(
    camera: FootageCamera, timesteps: list[int], detector: FaceNetworks, step: Step
) -> list[list[np.ndarray]]:
    """The faces (N, 2) of each timestep; those whose bounding boxes overlap are one."""
    found = []
    near = None
    for timestep in timesteps:
        faces = detector.find(camera.image(timestep), near)
        others = []
        for face in faces[1:]:
            low = np.maximum(faces[0].min(0), face.min(0))
            high = np.minimum(faces[0].max(0), face.max(0))
            common = np.maximum(high - low, 0).prod()
            union = np.ptp(faces[0], axis=0).prod() + np.ptp(face, axis=0).prod() - common
            if union and common / union < MIN_OVERLAP:
                others.append(face)
        found.append(faces[:1] + others)
        near = faces[0] if len(found[-1]) == 1 else near
        step()
    return found
