"""Face landmark detectors: MediaPipe's face mesh with its own network or with a .task file."""

import os
import sys
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


class FaceLandmarker:
    """MediaPipe's Tasks API with the user's `face_landmarker.task`: the same 478 landmarks."""

    def __init__(self, mediapipe: Any, task: Path) -> None:
        vision = mediapipe.tasks.vision
        options = vision.FaceLandmarkerOptions(
            base_options=mediapipe.tasks.BaseOptions(model_asset_buffer=task.read_bytes()),
            num_faces=MAX_FACES,
            min_face_detection_confidence=MIN_DETECTION_CONFIDENCE,
        )
        self._image, self._format = mediapipe.Image, mediapipe.ImageFormat.SRGB
        self._landmarker = vision.FaceLandmarker.create_from_options(options)

    def detect(self, image: np.ndarray) -> list[np.ndarray]:
        found = self._landmarker.detect(self._image(image_format=self._format, data=np.ascontiguousarray(image)))
        return [_pixels(face, image) for face in found.face_landmarks]


def make_detector(task: Path | None = None) -> Detector:
    """MediaPipe's detector; with `task`, the Tasks API with that file. Raises StgaError where it is not available."""
    os.environ.setdefault("GLOG_minloglevel", "2")  # its C++ part reports its own progress on stderr
    try:
        import mediapipe
    except ImportError as error:
        raise StgaError(
            f"landmarks need the Python package mediapipe, which {sys.executable} (Python "
            f"{sys.version_info[0]}.{sys.version_info[1]}) lacks: install mediapipe 0.10.21 there (Python 3.11 or "
            "3.12; newer ones need a newer mediapipe and Google's face_landmarker.task), or give files with --landmarks"
        ) from error
    if task is not None:
        try:
            return FaceLandmarker(mediapipe, task)
        except (OSError, RuntimeError, ValueError) as error:
            raise StgaError(f"{task}: is not a face landmarker of MediaPipe ({error})") from error
    if not hasattr(mediapipe, "solutions"):
        raise StgaError(
            f"mediapipe {mediapipe.__version__} has no network in its wheel; "
            "give Google's face_landmarker.task with --detector, which --download-detector downloads, or install "
            "mediapipe==0.10.21 (Python 3.11 or 3.12)"
        )
    return FaceMesh(mediapipe.solutions)


def _pixels(landmarks: Any, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.array([(point.x, point.y) for point in landmarks]) * [width, height]
