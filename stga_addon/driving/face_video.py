"""A performance from a video of a face: the blend shapes of MediaPipe's face landmarker, frame by frame."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..flame.quaternions import from_matrices, to_axis_angle
from ..progress import Cancelled, Progress, Report
from ..tracking.detectors import FaceLandmarker
from ..tracking.footage.video import VideoFrames, read_video
from .inverse import head_angles
from .names import COLUMN, COUNT, arkit_name
from .performance import Performance


def watched_performance(path: Path, scorer: FaceLandmarker, report: Report) -> Performance:
    """The performance of the face in a video; frames without a face leave gaps.

    The head's rotation is relative to that of the first frame with a face, since the camera may look from anywhere.
    Raises StgaError where the video cannot be read, states no frame rate, or shows no face; Cancelled where the report
    asks to stop.
    """
    video = read_video(path)
    if not video.fps > 0:
        raise StgaError(f"{path}: states no frame rate")
    frames = VideoFrames(video, dict(zip(video.timesteps, range(len(video.timesteps)), strict=True)))
    times, rows, rotations = [], [], []
    for number, timestep in enumerate(frames.timesteps):
        if report(Progress(number / len(frames.timesteps), "Detecting the face")):
            frames.close()
            raise Cancelled(f"{path}: cancelled")
        found = scorer.score(frames.image(timestep))
        if found is not None:
            times.append(timestep / video.fps)
            rows.append(_weights(found.weights))
            rotations.append(found.rotation)
    if not rows:
        raise StgaError(f"{path}: no face was found in any of its {len(frames.timesteps)} frames")
    turned = np.stack(rotations) @ rotations[0].T
    head = head_angles(to_axis_angle(from_matrices(turned)))
    return Performance(np.array(times) - times[0], np.stack(rows), head, video.fps)


def _weights(scores: Mapping[str, float]) -> np.ndarray:
    """(52,) of the network's names, which has `_neutral` and lacks tongueOut."""
    weights = np.zeros(COUNT)
    for name, score in scores.items():
        known = arkit_name(name)
        if known is not None:
            weights[COLUMN[known]] = score
    return weights
