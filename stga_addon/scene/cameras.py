"""The capture's cameras as Blender cameras, with its images as backgrounds."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..capture.camera import Camera, most_central
from ..capture.model import Capture, View
from ..errors import StgaError
from . import compat, tags
from .animation import write_curve
from .objects import Warn, log_warning, place, remove
from .timeline import set_frames_per_second

SENSOR_WIDTH_MM = 36.0  # with the horizontal fit only its ratio to the focal length matters
CLIP_START = 0.01  # meters
DISPLAY_SIZE = 0.05  # meters; Blender's default of one meter would cover the head with cameras
POSE_TOLERANCE = 1e-9  # of matrix entries
INTRINSICS_TOLERANCE = 1e-6  # pixels


def import_cameras(capture: Capture, root: Any, warn: Warn = log_warning) -> list[Any]:
    """One camera object for each of the capture's cameras, ascending by index, under `root` (from `capture_root`).

    Focal length, principal point and pose are the capture's; a pose that changes over time is keyframed. The images
    are background images, one per timestep and visible on its frame (Blender's image sequences number frames by a file
    name's last number, which in captures is the camera). Importing again replaces the last import. `warn` reports
    missing images and cameras whose intrinsics change.
    """
    cameras = []
    old = {camera[tags.CAMERA_INDEX]: camera for camera in tags.find(tags.CAMERA, capture.root)}
    for index, views in _views_by_camera(capture).items():
        cameras.append(_place_camera(root, index, views, old.pop(index, None), warn))
    remove(old.values())
    return cameras


def configure_scene(scene: Any, capture: Capture, camera: Any, warn: Warn = log_warning) -> None:
    """Make `scene` render the images of `camera`, one of `import_cameras`'.

    Sets the active camera, the resolution, the pixel aspect, the frame range (the capture's timesteps), the frame rate
    where the capture has one, and the view transform: splat colors are trained in sRGB, so it has to be Standard.
    `warn` reports cameras whose images have another size, since a Blender scene has only one.
    """
    if camera.get(tags.KIND) != tags.CAMERA:
        raise StgaError(f"{camera.name}: is not a camera imported from a capture")
    width, height = camera[tags.IMAGE_SIZE]
    aspect = camera[tags.PIXEL_ASPECT]
    scene.camera = camera
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1.0 / aspect), max(1.0, aspect)
    if capture.timesteps:
        scene.frame_start, scene.frame_end = capture.timesteps[0], capture.timesteps[-1]
    if capture.fps is not None:
        set_frames_per_second(scene, capture.fps)
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    for other in tags.find(tags.CAMERA, capture.root):
        same_size = tuple(other[tags.IMAGE_SIZE]) == (width, height)
        if not same_size or abs(other[tags.PIXEL_ASPECT] - aspect) > INTRINSICS_TOLERANCE:
            warn(f"{other.name}: its images have another size or pixel aspect than the scene, set from {camera.name}")


def central(cameras: list[Any]) -> Any:
    """The camera object, of `import_cameras`, that sees the face (`capture.camera.central_camera`); None of none."""
    if not cameras:
        return None
    bpy.context.view_layer.update()  # world matrices
    forward = np.array([-np.array(camera.matrix_world.col[2][:3]) for camera in cameras])
    return cameras[most_central(forward)]


def _views_by_camera(capture: Capture) -> dict[int, list[View]]:
    """camera index -> its views of all splits, one per timestep, ascending."""
    cameras: dict[int, dict[int, View]] = {}
    for views in capture.views.values():
        for view in views:
            cameras.setdefault(view.camera_index, {}).setdefault(view.timestep, view)
    return {index: [cameras[index][timestep] for timestep in sorted(cameras[index])] for index in sorted(cameras)}


def _place_camera(root: Any, index: int, views: list[View], old: Any, warn: Warn) -> Any:
    first = views[0].camera
    title = f"{root.name} camera {index:02d}"
    data = bpy.data.cameras.new(title)
    set_intrinsics(data, first)
    data.clip_start, data.display_size = CLIP_START, DISPLAY_SIZE
    camera = place(root, tags.CAMERA, title, data, old)
    camera[tags.CAMERA_INDEX] = index
    camera[tags.IMAGE_SIZE] = [first.width, first.height]
    camera[tags.PIXEL_ASPECT] = first.fl_x / first.fl_y
    if any(not _same_intrinsics(view.camera, first) for view in views):
        warn(f"{title}: its intrinsics change with the timestep; those of timestep {views[0].timestep} are used")
    _set_pose(camera, views)
    _set_backgrounds(data, views, warn)
    return camera


def set_intrinsics(data: Any, camera: Camera) -> None:
    """Give a Blender camera's data the focal lengths and principal point of `camera`.

    Blender's shift is in image widths, right and up; a pixel's height is fl_x / fl_y times its width.
    """
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH_MM
    data.lens = camera.fl_x * SENSOR_WIDTH_MM / camera.width
    data.shift_x = (camera.width / 2 - camera.cx) / camera.width
    data.shift_y = (camera.cy - camera.height / 2) / camera.width * camera.fl_x / camera.fl_y


def _same_intrinsics(one: Camera, other: Camera) -> bool:
    values = np.array([(c.width, c.height, c.fl_x, c.fl_y, c.cx, c.cy) for c in (one, other)])
    return bool(np.abs(values[0] - values[1]).max() <= INTRINSICS_TOLERANCE)


def _set_pose(camera: Any, views: list[View]) -> None:
    poses = np.stack([view.camera.camera_to_world_gl for view in views])
    camera.rotation_mode = "QUATERNION"
    camera.matrix_basis = Matrix(poses[0].tolist())
    if np.abs(poses - poses[0]).max() <= POSE_TOLERANCE:
        return
    curves = compat.action_curves(camera)
    frames = np.array([view.timestep for view in views])
    for axis in range(3):
        write_curve(curves, "location", axis, frames, poses[:, axis, 3])
    quaternions = [Matrix(pose[:3, :3].tolist()).to_quaternion() for pose in poses]
    for last, quaternion in pairwise(quaternions):
        quaternion.make_compatible(last)
    for element, values in enumerate(np.array(quaternions).T):
        write_curve(curves, "rotation_quaternion", element, frames, values)


def _set_backgrounds(data: Any, views: list[View], warn: Warn) -> None:
    found = [view for view in views if view.image.is_file()]
    if len(found) < len(views):
        missing = next(view.image for view in views if not view.image.is_file())
        warn(f"{missing}: is missing, and {len(views) - len(found) - 1} other images of {data.name}")
    if not found:
        return
    curves = compat.action_curves(data)
    frames = np.array([view.timestep for view in found])
    for row, view in enumerate(found):
        background = data.background_images.new()
        background.image = _load_image(view.image)
        background.show_background_image = row == 0
        # Visible from its own frame until the next image's; the first also before, the last also after.
        near = np.arange(max(row - 1, 0), min(row + 2, len(found)))
        path = f"background_images[{row}].show_background_image"
        write_curve(curves, path, 0, frames[near], (near == row).astype(float), "CONSTANT")
    data.show_background_images = True


def _load_image(path: Path) -> Any:
    try:
        return bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise StgaError(f"{path}: cannot be read as an image") from error
