"""Google's face and person networks (Apache-2.0), run by OpenCV: landmarks, ARKit scores,
segmentation.

What stands around the networks follows the graphs that MediaPipe publishes: anchors and decoding of
the detector, the crop of the landmarks' network.
"""

import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..files import read_bytes

FOLDER = Path(__file__).with_name("networks")
"""Folder with MediaPipe's networks, part of the extension."""
FACE_FILE = FOLDER / "face_landmarker.task"
"""Archive of the networks that detect faces and find landmarks."""
PERSON_FILE = FOLDER / "selfie_segmentation.tflite"
"""Network that segments people."""
MIN_DETECTION_SCORE = 0.3
"""MediaPipe's default, 0.5, misses near-profile views."""
MIN_PRESENCE = 0.5
"""Least probability of a face in the crop, as the landmarks' network estimates it."""
MAX_FACES = 2
"""Faces that are looked for: a second one in a frame is reported."""
MAX_BOX_OVERLAP = 0.5
"""Intersection over union beyond which two detected boxes are of one face."""
CROP_SCALE = 1.5
"""Side of the landmarks' crop, in sides of the detected box."""
NEAR_SCALE = 4.0
"""Side of the part around another frame's face, in that of its landmarks."""
PART_FRACTIONS = (0.5, 0.25)
"""Sides of the parts of an image that are searched for small faces, as fractions of its longer
side: the detector finds faces from an eighth of its input on."""
MIN_PART_PX = 160
"""Side of a part below which landmarks would be guesses."""
DETECTOR_SIZE_PX = 128
"""Side of the face detector's input, as the network is defined."""
CROP_SIZE_PX = 256
"""Side of the landmark network's input, as the network is defined."""
PERSON_SIZE_PX = 256
"""Side of the segmentation's input and output, as the network is defined."""
ANCHOR_GRIDS = ((16, 2), (8, 6))
"""Cells along a side of the detector's grids, and anchors of each, which are its center."""
MAX_SMALL_FRACTION = 0.18
"""Size of a small face as a fraction of the image's longer side."""
SETTLING_STEPS = 2
"""Crops around a small face's landmarks: its box is a few of the detector's pixels wide, and eyes
were taken to be on the nose."""
OUTER_EYE_CORNERS = (33, 263)
"""Landmarks of right and left eye."""
IRIS_CENTERS = (468, 473)
"""Numbers of the landmarks in the middle of an iris, each before its other four."""
FIRST_IRIS_POINT = 468
"""Number of the first landmark of an iris; those before are the skin's."""
MESH_POINTS = 478
"""Landmarks of a face."""
SCORE_POINTS = np.array([
    0, 1, 4, 5, 6, 7, 8, 10, 13, 14, 17, 21, 33, 37, 39, 40, 46, 52, 53, 54, 55, 58, 61, 63, 65, 66,
    67, 70, 78, 80, 81, 82, 84, 87, 88, 91, 93, 95, 103, 105, 107, 109, 127, 132, 133, 136, 144,
    145, 146, 148, 149, 150, 152, 153, 154, 155, 157, 158, 159, 160, 161, 162, 163, 168, 172, 173,
    176, 178, 181, 185, 191, 195, 197, 234, 246, 249, 251, 263, 267, 269, 270, 276, 282, 283, 284,
    285, 288, 291, 293, 295, 296, 297, 300, 308, 310, 311, 312, 314, 317, 318, 321, 323, 324, 332,
    334, 336, 338, 356, 361, 362, 365, 373, 374, 375, 377, 378, 379, 380, 381, 382, 384, 385, 386,
    387, 388, 389, 390, 397, 398, 400, 402, 405, 409, 415, 454, 466, 468, 469, 470, 471, 472, 473,
    474, 475, 476, 477,
])  # fmt: skip
"""Landmarks that the scores' network takes."""
SCORE_NAMES = [
    "_neutral", "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft",
    "browOuterUpRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "eyeBlinkLeft",
    "eyeBlinkRight", "eyeLookDownLeft", "eyeLookDownRight", "eyeLookInLeft", "eyeLookInRight",
    "eyeLookOutLeft", "eyeLookOutRight", "eyeLookUpLeft", "eyeLookUpRight", "eyeSquintLeft",
    "eyeSquintRight", "eyeWideLeft", "eyeWideRight", "jawForward", "jawLeft", "jawOpen", "jawRight",
    "mouthClose", "mouthDimpleLeft", "mouthDimpleRight", "mouthFrownLeft", "mouthFrownRight",
    "mouthFunnel", "mouthLeft", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft",
    "mouthPressRight", "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper",
    "mouthShrugLower", "mouthShrugUpper", "mouthSmileLeft", "mouthSmileRight", "mouthStretchLeft",
    "mouthStretchRight", "mouthUpperUpLeft", "mouthUpperUpRight", "noseSneerLeft", "noseSneerRight",
]  # fmt: skip


@dataclass(frozen=True)
class FaceScores:
    """Result of the networks for a face: its blend shapes by name, 0 to 1, and its landmarks.

    points  (478, 3) pixels; depth, in pixels too, grows away from the camera
    """

    weights: Mapping[str, float]
    points: np.ndarray


@dataclass(frozen=True)
class _Crop:
    """A square of an image: center (2,) and side in pixels, turned clockwise by an angle."""

    center: np.ndarray
    side: float
    angle: float

    def matrix(self, size: int) -> np.ndarray:
        """(2, 3) from pixels of the crop, resampled to `size`, to the image's."""
        cos = np.cos(self.angle)
        sin = np.sin(self.angle)
        turn = self.side / size * np.array([[cos, -sin], [sin, cos]])
        return np.column_stack([turn, self.center - turn @ [size / 2, size / 2]])


class FaceNetworks:
    """Detector, landmarks and scores, each read when it is first needed."""

    def __getstate__(self) -> dict[str, Any]:
        """For helping processes, which read the networks themselves."""
        return {}

    def detect(self, image: np.ndarray) -> list[np.ndarray]:
        """Landmarks (478, 2) of at most two faces in an image (H, W, 3) uint8, in pixels, whose
        centers lie at .5. Only faces that are large enough in the whole image are found."""
        return [points[:, :2] for points in self._landmarks(image, [_whole(image)], MAX_FACES)]

    def find(self, image: np.ndarray, near: np.ndarray | None = None) -> list[np.ndarray]:
        """As `detect`. Where the whole image shows no face, small ones are looked for, as of a
        person two meters away: around the landmarks `near` (N, 2) of a frame before, else in parts
        of the image."""
        return [points[:, :2] for points in self._found(image, MAX_FACES, near)]

    def score(self, image: np.ndarray) -> FaceScores | None:
        """The scores of the clearest face in an image (H, W, 3) uint8; None where none is found."""
        found = self._found(image, 1)
        if not found:
            return None
        self._scores.setInput(found[0][SCORE_POINTS, :2].astype(np.float32)[None])
        scores = np.ravel(self._scores.forward())
        weights = dict(zip(SCORE_NAMES, map(float, scores), strict=True))
        return FaceScores(weights, found[0])

    def _found(
        self, image: np.ndarray, most: int, near: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """(478, 3) of each face in the first of these places that shows one: the whole image,
        around another's landmarks, parts of the image."""
        small = MAX_SMALL_FRACTION * max(image.shape[:2])
        for parts in _places(image, near):
            if found := self._landmarks(image, parts, most):
                sizes = [float(np.ptp(points[:, :2], axis=0).max()) for points in found]
                return [
                    self._settled(image, points) if size < small else points
                    for points, size in zip(found, sizes, strict=True)
                ]
        return []

    def _landmarks(self, image: np.ndarray, parts: Sequence[_Crop], most: int) -> list[np.ndarray]:
        """(478, 3) of each face in some parts of an image: pixels, and depth in pixels, which grows
        away from the camera."""
        found = [self._boxes(image, part) for part in parts]
        boxes, fractions = map(np.concatenate, zip(*found, strict=True))
        crops = [
            _Crop(box[:2], CROP_SCALE * box[2:4].max(), _tilt(box[4:6], box[6:8]))
            for box in _distinct(boxes, fractions)[:most]
        ]
        faces = (self._face(image, crop) for crop in crops)
        return [points for points in faces if points is not None]

    def _settled(self, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Landmarks (478, 3) of a small face, whose box is coarse, from crops around themselves."""
        for _ in range(SETTLING_STEPS):
            low = points[:, :2].min(0)
            high = points[:, :2].max(0)
            tilt = _tilt(*points[list(OUTER_EYE_CORNERS), :2])
            crop = _Crop((low + high) / 2, CROP_SCALE * (high - low).max(), tilt)
            found = self._face(image, crop)
            if found is None:
                break
            points = found
        return points

    def _face(self, image: np.ndarray, crop: _Crop) -> np.ndarray | None:
        """(478, 3) of the face in a crop; None where it shows none."""
        import cv2
        from scipy.special import expit

        to_image = crop.matrix(CROP_SIZE_PX)
        square = _resampled(image, to_image, CROP_SIZE_PX)
        self._mesh.setInput(cv2.dnn.blobFromImage(square, 1 / 255))
        points, presence = self._mesh.forward(["Identity", "Identity_1"])
        if expit(float(np.ravel(presence)[0])) < MIN_PRESENCE:
            return None
        points = np.reshape(points, (MESH_POINTS, 3)).astype(np.float64)
        flat = points[:, :2] @ to_image[:, :2].T + to_image[:, 2]
        return np.column_stack([flat, points[:, 2] * (crop.side / CROP_SIZE_PX)])

    def _boxes(self, image: np.ndarray, part: _Crop) -> tuple[np.ndarray, np.ndarray]:
        """(M, 16) center, size and six points of what may be faces in an upright part of an image,
        in its pixels; (M,) how likely, from MIN_DETECTION_SCORE on."""
        import cv2
        from scipy.special import expit

        matrix = part.matrix(DETECTOR_SIZE_PX)
        small = _resampled(image, matrix, DETECTOR_SIZE_PX, black_border=True)
        self._faces.setInput(cv2.dnn.blobFromImage(small, 2 / 255, mean=(127.5,) * 3))  # −1 to 1
        found, scores = self._faces.forward(["regressors", "classificators"])
        fractions = expit(np.ravel(scores).astype(np.float64))
        likely = fractions >= MIN_DETECTION_SCORE
        boxes = np.reshape(found, (-1, 16))[likely].astype(np.float64)
        boxes[:, :2] += _anchors()[likely]
        boxes[:, 4:] += np.tile(_anchors()[likely], 6)
        boxes *= part.side / DETECTOR_SIZE_PX
        boxes[:, :2] += matrix[:, 2]
        boxes[:, 4:] += np.tile(matrix[:, 2], 6)
        return boxes, fractions[likely]

    @cached_property
    def _faces(self) -> Any:
        return _face_network("face_detector.tflite")

    @cached_property
    def _mesh(self) -> Any:
        return _face_network("face_landmarks_detector.tflite")

    @cached_property
    def _scores(self) -> Any:
        return _face_network("face_blendshapes.tflite")


class PersonNetwork:
    """Segmentation of people, in 256×256 pixels of the whole image."""

    def probability(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32, 0…1, of an image (H, W, 3) uint8: how likely a pixel shows a person."""
        import cv2

        size = PERSON_SIZE_PX, PERSON_SIZE_PX
        reduced = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        self._network.setInput(cv2.dnn.blobFromImage(reduced, 1 / 255))
        small = np.reshape(self._network.forward(), size)
        return np.clip(cv2.resize(small, image.shape[1::-1], interpolation=cv2.INTER_LINEAR), 0, 1)

    @cached_property
    def _network(self) -> Any:
        return _network(read_bytes(PERSON_FILE))


def _network(data: bytes) -> Any:
    import cv2

    return cv2.dnn.readNetFromTFLite(np.frombuffer(data, np.uint8))


def _face_network(name: str) -> Any:
    """Raises StgaError where the file was damaged or removed."""
    try:
        with zipfile.ZipFile(FACE_FILE) as archive:
            return _network(archive.read(name))
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise StgaError(f"{FACE_FILE}: {name} cannot be read ({error}); install again") from error


def _resampled(
    image: np.ndarray, matrix: np.ndarray, size: int, black_border: bool = False
) -> np.ndarray:
    """(size, size, 3) of an image by the matrix (2, 3) from its pixels to the image's.

    Pixels are sampled at their upper left corners, as MediaPipe does: at their centers, landmarks
    lie 0.5 pixels away from MediaPipe's (median, images of 512²) instead of 0.01.
    """
    import cv2

    border = cv2.BORDER_CONSTANT if black_border else cv2.BORDER_REPLICATE
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (size, size), flags=flags, borderMode=border)


def _distinct(boxes: np.ndarray, fractions: np.ndarray) -> list[np.ndarray]:
    """Distinct faces (M,), the most probable first, among candidates (M, 16): center, size and six
    points.

    Boxes that overlap are one face, their mean weighted by how likely they are.
    """
    left = np.argsort(-fractions, kind="stable")
    faces = []
    while len(left):
        low = boxes[left, :2] - boxes[left, 2:4] / 2
        high = boxes[left, :2] + boxes[left, 2:4] / 2
        common = np.maximum(np.minimum(high, high[0]) - np.maximum(low, low[0]), 0).prod(axis=1)
        area = boxes[left, 2:4].prod(axis=1)
        same = common / np.maximum(area + area[0] - common, 1e-9) > MAX_BOX_OVERLAP
        same[0] = True
        weights = fractions[left[same]]
        faces.append(weights @ boxes[left[same]] / weights.sum())
        left = left[~same]
    return faces


def _whole(image: np.ndarray) -> _Crop:
    """The square around an image."""
    height, width = image.shape[:2]
    return _Crop(np.array([width, height]) / 2, max(width, height), 0.0)


def _tilt(right_eye: np.ndarray, left_eye: np.ndarray) -> float:
    """The angle, clockwise, of a face whose eyes are at these pixels (2,)."""
    return float(np.arctan2(*(left_eye - right_eye)[::-1]))


def _places(image: np.ndarray, near: np.ndarray | None) -> Iterator[list[_Crop]]:
    """Places where a face is looked for, in order: see `FaceNetworks.find`."""
    yield [_whole(image)]
    if near is not None:
        center = near.min(0) / 2 + near.max(0) / 2
        size = float(np.ptp(near, axis=0).max())
        yield [_Crop(center, NEAR_SCALE * size, 0.0)]
    for fraction in PART_FRACTIONS:
        side = fraction * max(image.shape[:2])
        if side >= MIN_PART_PX:
            rows, columns = (_centers(length, side) for length in image.shape[:2])
            yield [_Crop(np.array([x, y]), side, 0.0) for y in rows for x in columns]


def _centers(length: int, side: float) -> np.ndarray:
    """Centers of parts of that side along a length. They overlap by half, so that one of them shows
    a face whole."""
    if length <= side:
        return np.array([length / 2])
    count = 1 + math.ceil((length - side) / (side / 2))
    return np.linspace(side / 2, length - side / 2, count)


@cache
def _anchors() -> np.ndarray:
    """(896, 2) centers in the detector's pixels."""
    rows = []
    for cells, count in ANCHOR_GRIDS:
        centers = (np.arange(cells) + 0.5) * (DETECTOR_SIZE_PX / cells)
        y, x = np.meshgrid(centers, centers, indexing="ij")
        rows.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), count, axis=0))
    return np.concatenate(rows)
