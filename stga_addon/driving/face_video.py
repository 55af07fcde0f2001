"""A performance from a video of a face: the scores of the face networks, frame by frame."""

from pathlib import Path

import numpy as np

from ..capture.mesh_geometry import similarity
from ..errors import StgaError
from ..flame.quaternions import from_matrices, to_axis_angle
from ..progress import Cancelled, Progress, Report
from ..tracking.face_networks import FaceNetworks
from ..tracking.footage.video import VideoFrames, read_video
from .inverse import head_angles
from .performance import ARKIT_SHAPES, Performance, arkit_name
from .shapes import face_shapes

CAMERA_FIELD_OF_VIEW_DEG = 63.0
"""Vertical, of a camera of which nothing is known, as MediaPipe supposes it."""


def watched_performance(path: Path, report: Report) -> Performance:
    """The performance of the face in a video; frames without a face leave gaps.

    The head's rotation is relative to that of the first frame with a face, since the camera may
    look from anywhere. Raises StgaError where the video cannot be read, states no frame rate, or
    shows no face; Cancelled where the report asks to stop.
    """
    video = read_video(path)
    if not video.fps > 0:
        raise StgaError(f"{path}: states no frame rate")
    numbers = {timestep: number for number, timestep in enumerate(video.timesteps)}
    frames = VideoFrames(video, numbers)
    networks = FaceNetworks()
    times = []
    rows = []
    rotations = []
    for number, timestep in enumerate(frames.timesteps):
        if report(Progress(number / len(frames.timesteps), "Detecting the face")):
            frames.close()
            raise Cancelled(f"{path}: cancelled")
        image = frames.image(timestep)
        found = networks.score(image)
        if found is not None:
            times.append(timestep / video.fps)
            # The network's names have `_neutral` and lack tongueOut.
            named = {arkit_name(name): score for name, score in found.weights.items()}
            rows.append([named.get(name, 0.0) for name in ARKIT_SHAPES])
            rotations.append(head_rotation(found.points, (image.shape[0], image.shape[1])))
    if not rows:
        raise StgaError(f"{path}: no face was found in any of its {len(frames.timesteps)} frames")
    turned = np.stack(rotations) @ rotations[0].T
    head = head_angles(to_axis_angle(from_matrices(turned)))
    seconds = np.array(times) - times[0]
    return Performance(seconds, np.array(rows, np.float64), head, video.fps, video.sentences)


def head_rotation(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The head's rotation (3, 3) from landmarks (478, 3) in pixels of an image of `size` (H, W).

    It takes a face that looks along +z, with y up and its own left at +x, to the camera's x right,
    y up and z towards the face: the least-squares rotation of the average face onto the landmarks,
    which a camera of CAMERA_FIELD_OF_VIEW_DEG spreads with their distance.
    """
    shapes = face_shapes()
    height, width = size
    focal = height / 2 / np.tan(np.radians(CAMERA_FIELD_OF_VIEW_DEG) / 2)
    distance = focal + points[:, 2] - points[:, 2].mean()
    offset = (points[:, :2] - [width / 2, height / 2]) * (distance / focal)[:, None]
    observed = np.column_stack([offset * [1, -1], -distance])[shapes.reliable]
    return similarity(shapes.points[shapes.reliable], observed).rotation
