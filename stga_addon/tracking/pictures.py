"""Pictures of the head over the footage, for whoever watches the tracking."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
from PIL import Image

from ..capture.camera import Camera
from ..capture.model import evenly_spread
from ..errors import StgaError
from .contact_sheet import head_box, with_mesh
from .face_networks import FaceNetworks
from .fit import HeadFit, TimestepLandmarks, determines_pose, fit_head
from .footage.model import Footage
from .head_model import HeadModel
from .posed_points import SurfacePoints
from .write_capture import posed_mesh

SIZE = 256
"""Width and height of a picture in pixels: Blender's icons are square."""
FIRST_CAMERAS = 3
"""Most cameras of the first frame's fit."""
COLUMNS = 2
"""Most frames of a picture, in each direction."""

Show = Callable[[Callable[[], np.ndarray | None], Mapping[str, float]], None]
"""Called with what draws a picture (SIZE, SIZE, 3) uint8 for those who watch, None: there is
nothing to see; and with figures of how well the head fits (`format.describe_figures`)."""


def picture_of_first_frame(
    head: HeadModel,
    footage: Footage,
    detector: FaceNetworks,
    places: SurfacePoints,
    reliable: np.ndarray,
) -> np.ndarray | None:
    """The head on the first frame, found within seconds; None where no face, or several, are seen
    there."""
    timestep = footage.timesteps[0]
    seeing = evenly_spread(
        [camera for camera in footage.cameras if timestep in camera.timesteps], FIRST_CAMERAS
    )
    found = [(camera, detector.detect(camera.image(timestep))) for camera in seeing]
    alone = [(camera.camera, faces[0]) for camera, faces in found if len(faces) == 1]
    points = np.array([face for _, face in alone]).reshape(-1, len(places), 2)
    seen = TimestepLandmarks(
        tuple(camera for camera, _ in alone), points, np.ones(points.shape[:2])
    )
    if not determines_pose(seen, reliable, places.on(head.model.v_template, head.model.faces)):
        return None
    with suppress(StgaError):  # the whole take may still be tracked, and says what is wrong
        return picture_of_fit(fit_head(head, places, reliable, {timestep: seen}), footage)
    return None


def picture_of_fit(fit: HeadFit, footage: Footage) -> np.ndarray:
    """The head on a few of the frames that it was fitted to."""
    timesteps = evenly_spread(sorted(fit.parameters), COLUMNS**2)
    columns = COLUMNS if len(timesteps) == COLUMNS**2 else 1
    side = SIZE // columns
    picture = np.zeros((SIZE, SIZE, 3), np.uint8)
    for number, timestep in enumerate(timesteps[: columns**2]):
        camera = next(camera for camera in footage.cameras if timestep in camera.timesteps)
        row, column = side * (number // columns), side * (number % columns)
        picture[row : row + side, column : column + side] = _square(
            camera.image(timestep),
            fit.to_capture.camera(camera.camera),
            posed_mesh(fit, fit.parameters[timestep]),
            fit.head.model.faces,
            side,
        )
    return picture


def _square(
    image: np.ndarray, camera: Camera, vertices: np.ndarray, faces: np.ndarray, side: int
) -> np.ndarray:
    """The head in the image with the mesh over it, (side, side, 3); black beyond the image."""
    left, top, right, bottom = head_box(camera, vertices)
    size = max(right - left, bottom - top)
    left, top = (left + right - size) // 2, (top + bottom - size) // 2
    cut = replace(camera, width=size, height=size, cx=camera.cx - left, cy=camera.cy - top).scaled(
        side / size
    )
    cropped = Image.fromarray(image).crop((left, top, left + size, top + size))
    small = cropped.resize((cut.width, cut.height), Image.Resampling.BILINEAR)
    drawn = with_mesh(np.asarray(small), vertices, faces, cut)
    return np.asarray(Image.fromarray(drawn).resize((side, side)))
