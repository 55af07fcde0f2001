"""Cameras of the open scene as a calibration file for tracking."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError
from ..files import write_json
from . import tags
from .arrays import Z_UP_TO_Y_UP
from .render.camera import image_size, render_camera


def export_cameras(path: Path, cameras: Iterable[Any], depsgraph: Any) -> int:
    """Write the cameras at the current frame as transforms.json with pinholes; how many.

    cameras: camera objects. Each is named after its object: footage has a folder, a video or an image of that name.
    Axes are those of captures, y up, and the file says that a capture keeps this world: imported, it lies among the
    cameras. Image size: the scene's resolution, or that of the capture that the camera was imported from.
    Raises StgaError for a camera that is not perspective, is mirrored, or where there are none.
    """
    entries = [_entry(camera.name, _camera(camera.evaluated_get(depsgraph), depsgraph)) for camera in cameras]
    if not entries:
        raise StgaError("No cameras to export; add them, or select some")
    write_json(path, {"camera_model": "PINHOLE", "world": "keep", "frames": entries})
    return len(entries)


def _camera(camera: Any, depsgraph: Any) -> Camera:
    if np.linalg.det(np.array(camera.matrix_world.to_3x3())) < 0:
        raise StgaError(f"{camera.name}: is mirrored by a negative scale; apply the scale")
    size = camera.get(tags.IMAGE_SIZE) or image_size(depsgraph.scene.render)
    width, height = (int(pixels) for pixels in size)
    return render_camera(camera, depsgraph, width, height, (0, 0, width, height))


def _entry(name: str, camera: Camera) -> dict[str, Any]:
    intrinsics = {"fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": camera.cx, "cy": camera.cy}
    return {
        "file_path": f"{name}.png",
        "camera_id": name,
        "w": camera.width,
        "h": camera.height,
        **{key: float(value) for key, value in intrinsics.items()},
        "transform_matrix": (Z_UP_TO_Y_UP @ camera.camera_to_world_gl).tolist(),
    }
