"""Frames of a video for structure from motion: the sharpest in each stretch of motion."""

from collections.abc import Sequence

import numpy as np

from ..worker.helpers import Step
from .footage.model import FootageCamera

FLOW_SIDE_PX = 480
"""Longer side of the images in which motion is measured."""
SHARPNESS_SIDE_PX = 960
"""Longer side of the images in which sharpness is measured."""
CORNERS = 200
"""Points that are followed from frame to frame."""
MIN_CORNERS = 8
"""Points below which a frame's motion is taken for that of the frame before."""
CORNER_QUALITY = 0.01
"""Least strength of a corner, relative to the strongest."""
CORNER_DISTANCE_PX = 8
"""Least distance between corners."""
SHAKE_FRAMES = 9
"""Frames over which motion is averaged, so that a hand's shaking is none."""


def choose_frames(
    camera: FootageCamera, timesteps: Sequence[int], count: int, step: Step
) -> dict[str, np.ndarray]:
    """`timesteps` (M,), ascending: of `count` stretches in which the image moves equally far, the
    sharpest frame of each. step: is called once a frame."""
    flows = []
    sharpness = []
    before = None
    flow = np.zeros(2)
    for timestep in timesteps:
        gray, sharp = _measured(camera.image(timestep))
        if before is not None:
            flow = _flow(before, gray, flow)
        flows.append(flow)
        sharpness.append(sharp)
        before = gray
        step()
    chosen = sharpest(np.array(flows), np.array(sharpness), count)
    return {"timesteps": np.array(timesteps)[chosen]}


def sharpest(flows: np.ndarray, sharpness: np.ndarray, count: int) -> np.ndarray:
    """(M,) numbers of frames, ascending, M ≤ count: the sharpest of each of `count` stretches of
    equal motion. flows (N, 2): how far the image has moved since the frame before."""
    width = min(SHAKE_FRAMES, len(flows))
    window = np.ones(width) / width
    padded = np.pad(flows, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(row, window, "valid") for row in padded.T], axis=1)
    path = np.cumsum(np.linalg.norm(smooth, axis=1))
    if path[-1] <= 0:
        path = np.arange(len(flows)) + 1.0
    stretch = np.minimum((count * path / path[-1]).astype(int), count - 1)
    stretches = (np.flatnonzero(stretch == number) for number in np.unique(stretch))
    return np.array([rows[sharpness[rows].argmax()] for rows in stretches])


def _measured(image: np.ndarray) -> tuple[np.ndarray, float]:
    """A small gray image, and how sharp the image is: the variance of its Laplacian in the middle,
    where the head is."""
    import cv2

    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    middle = reduced_to(gray, SHARPNESS_SIDE_PX)
    height, width = middle.shape
    middle = middle[height // 6 : height - height // 6, width // 4 : width - width // 4]
    return reduced_to(gray, FLOW_SIDE_PX), float(cv2.Laplacian(middle, cv2.CV_64F).var())


def reduced_to(image: np.ndarray, side: int) -> np.ndarray:
    """The image with a longer side of at most so many pixels."""
    import cv2

    scale = side / max(image.shape[:2])
    if scale >= 1:
        return image
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _flow(before: np.ndarray, now: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(2,) median motion of corners, as a fraction of the image's longer side; `last` without
    any."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
    if corners is None or len(corners) < MIN_CORNERS:
        return last
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, np.empty_like(corners))
    tracked = found.ravel() > 0
    if tracked.sum() < MIN_CORNERS:
        return last
    return np.median((moved - corners)[tracked].reshape(-1, 2), axis=0) / max(now.shape)
