"""Face landmark detectors: MediaPipe's face mesh with its own network or with a .task file."""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import StgaError

MIN_DETECTION_CONFIDENCE = 0.3
"""MediaPipe's default, 0.5, misses near-profile views."""
MAX_FACES = 2
"""Faces that are looked for: a second one in a frame is reported."""
IRIS_CENTERS = (468, 473)
FIRST_IRIS_POINT, MESH_POINTS = 468, 478
"""MediaPipe's landmarks: 468 of the skin, and five an iris of which the first is its center."""


class Detector(Protocol):
    """Finds faces in an image; every face has the same N landmarks."""

    def detect(self, image: np.ndarray) -> list[np.ndarray]:
        """Landmarks (N, 2) in pixels of each face in an image (H, W, 3) uint8; pixel centers lie at .5."""


class FaceMesh:
    """MediaPipe's face mesh with the network in its wheel (versions before 0.10.30): 478 landmarks, no download."""

    def __init__(self, solutions: Any) -> None:
        self._mesh = solutions.face_mesh.FaceMesh(
            static_image_mode=True,
            max_num_faces=MAX_FACES,
            refine_landmarks=True,
            min_detection_confidence=MIN_DETECTION_CONFIDENCE,
        )

    def detect(self, image: np.ndarray) -> list[np.ndarray]:
        found = self._mesh.process(np.ascontiguousarray(image)).multi_face_landmarks or []
        return [_pixels(face.landmark, image) for face in found]


@dataclass(frozen=True)
class FaceScores:
    """What the network says of a face: its blend shapes by name, 0 to 1, and its rotation (3, 3).

    The rotation takes a face that looks along +z, with y up and its own left at +x, to the camera's x right, y up and z
    towards the face.
    """

    weights: Mapping[str, float]
    rotation: np.ndarray


class FaceLandmarker:
    """MediaPipe's Tasks API with the user's `face_landmarker.task`: the same 478 landmarks, and with `scores` the 52
    blend shapes."""

    def __init__(self, mediapipe: Any, task: Path, scores: bool = False) -> None:
        vision = mediapipe.tasks.vision
        options = vision.FaceLandmarkerOptions(
            base_options=mediapipe.tasks.BaseOptions(model_asset_buffer=task.read_bytes()),
            num_faces=1 if scores else MAX_FACES,
            min_face_detection_confidence=MIN_DETECTION_CONFIDENCE,
            output_face_blendshapes=scores,
            output_facial_transformation_matrixes=scores,
        )
        self._image, self._format = mediapipe.Image, mediapipe.ImageFormat.SRGB
        self._landmarker = vision.FaceLandmarker.create_from_options(options)

    def detect(self, image: np.ndarray) -> list[np.ndarray]:
        return [_pixels(face, image) for face in self._found(image).face_landmarks]

    def score(self, image: np.ndarray) -> FaceScores | None:
        """The scores of the face in an image (H, W, 3) uint8; None where none is found. Only with `scores`."""
        found = self._found(image)
        if not found.face_blendshapes or not found.facial_transformation_matrixes:
            return None
        weights = {category.category_name: float(category.score) for category in found.face_blendshapes[0]}
        left, _, right = np.linalg.svd(np.asarray(found.facial_transformation_matrixes[0], np.float64)[:3, :3])
        return FaceScores(weights, left @ right)

    def _found(self, image: np.ndarray) -> Any:
        return self._landmarker.detect(self._image(image_format=self._format, data=np.ascontiguousarray(image)))


def make_detector(task: Path | None = None) -> Detector:
    """MediaPipe's detector; with `task`, the Tasks API with that file. Raises StgaError where it is not available."""
    mediapipe = _mediapipe()
    if task is not None:
        return _landmarker(mediapipe, task)
    if not hasattr(mediapipe, "solutions"):
        raise StgaError(
            f"mediapipe {mediapipe.__version__} has no network in its wheel; "
            "give Google's face_landmarker.task with --detector, which --download-detector downloads, or install "
            "mediapipe==0.10.21 (Python 3.11 or 3.12)"
        )
    return FaceMesh(mediapipe.solutions)


def make_face_scorer(task: Path) -> FaceLandmarker:
    """The detector with blend shapes. Raises StgaError where it is not available."""
    return _landmarker(_mediapipe(), task, scores=True)


def _landmarker(mediapipe: Any, task: Path, scores: bool = False) -> FaceLandmarker:
    try:
        return FaceLandmarker(mediapipe, task, scores)
    except (OSError, RuntimeError, ValueError) as error:
        raise StgaError(f"{task}: is not a face landmarker of MediaPipe ({error})") from error


def _mediapipe() -> Any:
    os.environ.setdefault("GLOG_minloglevel", "2")  # its C++ part reports its own progress on stderr
    try:
        import mediapipe
    except ImportError as error:
        raise StgaError(
            f"landmarks need the Python package mediapipe, which {sys.executable} (Python "
            f"{sys.version_info[0]}.{sys.version_info[1]}) lacks: install mediapipe 0.10.21 there (Python 3.11 or "
            "3.12; newer ones need a newer mediapipe and Google's face_landmarker.task), or give files with --landmarks"
        ) from error
    return mediapipe


def _pixels(landmarks: Any, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.array([(point.x, point.y) for point in landmarks]) * [width, height]
