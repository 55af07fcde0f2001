"""Blender's cameras: imported from captures, exported, and as calibrated cameras."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Matrix

from ..capture.camera import Camera, camera_from_gl, covered_angles, most_central, turntable
from ..capture.model import Capture, View
from ..errors import StgaError
from ..files import write_json
from ..flame.quaternions import continuous, from_matrices
from . import arrays, tags
from .kept_animation import is_made_by_hand, mark_imported
from .objects import Warn, log_warning, place, remove, set_frames_per_second

UP = (0.0, 0.0, 1.0)
"""Direction against gravity: Blender's scenes are z-up."""
ORTHOGRAPHIC_DISTANCE = 1000.0
"""An orthographic view is rendered in perspective from this many times its width away."""


def image_size(render: Any) -> tuple[int, int]:
    """Width and height in pixels of final images by a scene's render settings."""
    fraction = render.resolution_percentage / 100
    return max(1, int(render.resolution_x * fraction)), max(1, int(render.resolution_y * fraction))


class Eye(NamedTuple):
    """What one view of a stereo image has in place of the camera's own: camera to world (4, 4), and
    shift."""

    pose: np.ndarray
    shift_x: float


def render_camera(
    camera: Any,
    depsgraph: Any,
    width: int,
    height: int,
    border: tuple[int, int, int, int] | None = None,
    eye: Eye | None = None,
) -> Camera:
    """The evaluated camera object for an image of width × height pixels. border: x, y, width,
    height in pixels of the render region, from the bottom left. eye: of a stereo image. Raises
    StgaError unless it is perspective."""
    if camera is None or camera.type != "CAMERA":
        raise StgaError("The scene has no camera to render through")
    if camera.data.type != "PERSP":
        raise StgaError(
            f"{camera.name}: is not a perspective camera; STGA Splats renders through no other type"
        )
    render = depsgraph.scene.render
    aspect = {"scale_x": render.pixel_aspect_x, "scale_y": render.pixel_aspect_y}
    projection = np.array(camera.calc_matrix_camera(depsgraph, x=width, y=height, **aspect))
    pose = np.array(camera.matrix_world.normalized(), np.float64)
    if eye is not None:
        data = camera.data
        pose = eye.pose
        sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
        projection[0, 2] += (eye.shift_x - data.shift_x) * projection[0, 0] * sensor / data.lens
    whole = camera_of(pose, projection, width, height)
    x, y, columns, rows = border or (0, 0, width, height)
    cx = whole.cx - x
    cy = whole.cy - (height - y - rows)
    return replace(whole, width=columns, height=rows, cx=cx, cy=cy)


def viewport_camera(region: Any, width: int, height: int) -> Camera:
    """The view of a 3D viewport (a RegionView3D) for an image of width × height pixels."""
    pose = np.array(region.view_matrix.inverted(), np.float64)
    projection = np.array(region.window_matrix, np.float64)
    if not region.is_perspective:  # nearly the same in perspective from far behind
        flat = projection
        distance = ORTHOGRAPHIC_DISTANCE * 2 / projection[0, 0]
        projection = np.zeros((4, 4))
        projection[0, 0] = flat[0, 0] * distance
        projection[1, 1] = flat[1, 1] * distance
        projection[:2, 2] = -flat[:2, 3]
        pose[:3, 3] += distance * pose[:3, 2]
    return camera_of(pose, projection, width, height)


def camera_of(pose: np.ndarray, projection: Any, width: int, height: int) -> Camera:
    """Camera from OpenGL's camera-to-world and perspective projection matrices, both (4, 4)."""
    p = np.array(projection, np.float64)
    focal = p[0, 0] * width / 2, p[1, 1] * height / 2
    center = (1 - p[0, 2]) * width / 2, (1 + p[1, 2]) * height / 2
    return camera_from_gl(pose, (width, height), focal, center)


SENSOR_WIDTH_MM = 36.0  # with the horizontal fit only its ratio to the focal length matters
CLIP_START = 0.01  # meters
DISPLAY_SIZE = 0.05  # meters; Blender's default of one meter would cover the head with cameras
POSE_TOLERANCE = 1e-9  # of matrix entries
INTRINSICS = ("width", "height", "fl_x", "fl_y", "cx", "cy")
INTRINSICS_TOLERANCE = 1e-6  # pixels


def _camera_data(title: str, before: Any) -> Any:
    """Data of a camera, with what an artist has set in that of an earlier import, such as depth of
    field; without its images and keyframes."""
    if before is None:
        data = bpy.data.cameras.new(title)
        data.clip_start = CLIP_START
        data.display_size = DISPLAY_SIZE
        return data
    data = before.data.copy()
    for background in data.background_images:
        background.image = None  # which clearing alone leaves with a user
    data.background_images.clear()
    data.animation_data_clear()
    return data


OPTICS = ("lens", "shift_x", "shift_y", "sensor_width")
"""Fields of a camera's data that an import sets."""
CAMERA_TAGS = (tags.KIND, tags.CAPTURE, tags.CAMERA_INDEX, tags.IMAGE_SIZE, tags.PIXEL_ASPECT)
"""Custom properties of a camera that stands for one of a capture."""


def _place_of(camera: Any) -> list[float]:
    """A camera's own matrix, row by row, and its OPTICS."""
    optics = [getattr(camera.data, name) for name in OPTICS]
    return [*np.array(camera.matrix_basis).ravel().tolist(), *optics]


def _is_changed(camera: Any, root: Any) -> bool:
    """Whether an artist has moved or keyframed a camera of an import, or given it another lens."""
    animated = [each.animation_data for each in (camera, camera.data) if each.animation_data]
    actions = [each.action for each in animated if each.action is not None]
    is_animated = any(each.nla_tracks or each.drivers for each in animated)
    if camera.parent != root or is_animated or any(map(is_made_by_hand, actions)):
        return True
    imported = camera.get(tags.IMPORTED)
    if imported is None:  # by an older version
        return False
    moves = camera.animation_data is not None and camera.animation_data.action is not None
    compared = slice(-len(OPTICS) if moves else 0, None)
    return not np.allclose(list(imported)[compared], _place_of(camera)[compared], atol=1e-6)


def _free(camera: Any) -> None:
    """Let a camera of an import be one of the scene's own."""
    for tag in (*CAMERA_TAGS, tags.IMPORTED):
        camera.pop(tag, None)


def _cameras_before(capture: Capture, root: Any, warn: Warn) -> dict[int, Any]:
    """Index -> camera of the last import; those that were changed since then, and copies, become
    the scene's own."""
    found = dict[int, Any]()
    changed = []
    for camera in tags.find(tags.CAMERA, capture.root):
        above = camera.parent
        if above is not None and above != root and above.get(tags.KIND) == tags.ROOT:
            continue  # of another head
        if _is_changed(camera, root):
            changed.append(camera.name)
            _free(camera)
        elif camera[tags.CAMERA_INDEX] in found:
            _free(camera)
        else:
            found[camera[tags.CAMERA_INDEX]] = camera
    if changed:
        stays = "changed since the import, and left as they are, beside the capture's"
        warn(f"{root.name}: cameras were {stays}: {', '.join(changed)}")
    return found


def _remove_unless_used(cameras: Iterable[Any]) -> None:
    """Delete cameras that the capture no longer has, but not those that a shot is seen through."""
    scenes = bpy.data.scenes
    used = {scene.camera for scene in scenes}
    used |= {marker.camera for scene in scenes for marker in scene.timeline_markers}
    for camera in cameras:
        if camera in used:
            _free(camera)
        else:
            remove([camera])


def import_cameras(capture: Capture, root: Any, warn: Warn = log_warning) -> list[Any]:
    """A camera object for each of the capture's cameras, ascending by index, under `root` (from
    `capture_root`); one that moves is keyframed. The images are background images, each visible on
    its frame (Blender's image sequences number frames by a file name's last number, which in
    captures is the camera). Importing again replaces the last import, but for cameras that were
    changed since. `warn` reports these, missing images and changing intrinsics."""
    cameras = []
    old = _cameras_before(capture, root, warn)
    by_index: dict[int, dict[int, View]] = {}
    for view in capture.all_views:
        by_index.setdefault(view.camera_index, {}).setdefault(view.timestep, view)
    for index, by_timestep in sorted(by_index.items()):
        views = [by_timestep[timestep] for timestep in sorted(by_timestep)]
        first = views[0].camera
        title = f"{root.name} camera {index:02d}"
        before = old.pop(index, None)
        data = _camera_data(title, before)
        set_intrinsics(data, first)
        camera = place(root, tags.CAMERA, title, data, before)
        camera[tags.CAMERA_INDEX] = index
        camera[tags.IMAGE_SIZE] = [first.width, first.height]
        camera[tags.PIXEL_ASPECT] = first.fl_x / first.fl_y
        intrinsics = np.array([[getattr(v.camera, name) for name in INTRINSICS] for v in views])
        if np.abs(intrinsics - intrinsics[0]).max() > INTRINSICS_TOLERANCE:
            used = views[0].timestep
            warn(f"{title}: its intrinsics change; those of timestep {used} are used for all")
        poses = np.stack([view.camera.camera_to_world_gl for view in views])
        camera.rotation_mode = "QUATERNION"
        camera.matrix_basis = Matrix(poses[0].tolist())
        if np.abs(poses - poses[0]).max() > POSE_TOLERANCE:
            frames = [view.timestep for view in views]
            turns = continuous(from_matrices(poses[:, :3, :3]))
            arrays.write_curves(camera, "location", frames, poses[:, :3, 3])
            arrays.write_curves(camera, "rotation_quaternion", frames, turns)
        found = [view for view in views if view.image.is_file()]
        missing = [view.image for view in views if not view.image.is_file()]
        if missing:
            warn(f"{missing[0]}: is missing, and {len(missing) - 1} other images of {data.name}")
        for row, view in enumerate(found):
            background = data.background_images.new()
            try:
                background.image = bpy.data.images.load(str(view.image))
            except RuntimeError as error:
                raise StgaError(f"{view.image}: cannot be read as an image") from error
            background.show_background_image = row == 0
        # Each is visible from its frame to the next one's; the first also before, the last after.
        paths = [f"background_images[{row}].show_background_image" for row in range(len(found))]
        if found:
            timesteps = [view.timestep for view in found]
            arrays.write_triangle_curves(data, paths, timesteps, "CONSTANT")
            data.show_background_images = True
        for owner in (camera, data):
            mark_imported(owner)
        camera[tags.IMPORTED] = _place_of(camera)
        cameras.append(camera)
    _remove_unless_used(old.values())
    return cameras


def configure_scene(scene: Any, capture: Capture, camera: Any, warn: Warn = log_warning) -> None:
    """Make `scene` render the images of `camera`, one of `import_cameras`': camera, resolution,
    pixel aspect, frames, rate, and the view transform Standard, as splats are trained in sRGB.
    `warn` reports cameras whose images have another size."""
    if camera.get(tags.KIND) != tags.CAMERA:
        raise StgaError(f"{camera.name}: is not a camera imported from a capture")
    width, height = camera[tags.IMAGE_SIZE]
    aspect = camera[tags.PIXEL_ASPECT]
    scene.camera = camera
    render = scene.render
    render.resolution_x = width
    render.resolution_y = height
    render.resolution_percentage = 100
    render.pixel_aspect_x = max(1.0, 1.0 / aspect)
    render.pixel_aspect_y = max(1.0, aspect)
    if capture.timesteps:
        scene.frame_start = capture.timesteps[0]
        scene.frame_end = capture.timesteps[-1]
    if capture.fps is not None:
        set_frames_per_second(scene, capture.fps)
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    for other in tags.find(tags.CAMERA, capture.root):
        same_size = tuple(other[tags.IMAGE_SIZE]) == (width, height)
        if not same_size or abs(other[tags.PIXEL_ASPECT] - aspect) > INTRINSICS_TOLERANCE:
            warn(
                f"{other.name}: its images have another size or pixel aspect than the scene, "
                f"set from {camera.name}"
            )


def look_through(scene: Any, camera: Any) -> None:
    """Give the scene a camera of `import_cameras`, and its image size; `look_away` takes the size
    back."""
    render = scene.render
    if tags.SCENE_RESOLUTION not in scene or not _has_camera_size(scene):
        scene[tags.SCENE_RESOLUTION] = [render.resolution_x, render.resolution_y]
    scene.camera = camera
    render.resolution_x, render.resolution_y = camera[tags.IMAGE_SIZE]


def look_away(scene: Any) -> None:
    """Give the scene its own resolution again, unless it has been changed meanwhile."""
    resolution = scene.get(tags.SCENE_RESOLUTION)
    if resolution is not None and _has_camera_size(scene):
        scene.render.resolution_x, scene.render.resolution_y = resolution
    scene.pop(tags.SCENE_RESOLUTION, None)


def _has_camera_size(scene: Any) -> bool:
    size = scene.camera.get(tags.IMAGE_SIZE) if scene.camera else None
    resolution = scene.render.resolution_x, scene.render.resolution_y
    return size is not None and tuple(size) == resolution


def central(cameras: list[Any]) -> Any:
    """The camera, of those of `import_cameras`, that sees the face; None without cameras."""
    if not cameras:
        return None
    bpy.context.view_layer.update()  # world matrices
    forward = np.array([-np.array(camera.matrix_world.col[2][:3]) for camera in cameras])
    return cameras[most_central(forward)]


def set_intrinsics(data: Any, camera: Camera) -> None:
    """Give a Blender camera's data the focal lengths and principal point of `camera`. Blender's
    shift is in image widths, right and up; a pixel's height is fl_x / fl_y times its width."""
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH_MM
    data.lens = camera.fl_x * SENSOR_WIDTH_MM / camera.width
    data.shift_x = (camera.width / 2 - camera.cx) / camera.width
    data.shift_y = (camera.cy - camera.height / 2) / camera.width * camera.fl_x / camera.fl_y


def export_cameras(path: Path, cameras: Iterable[Any], depsgraph: Any) -> int:
    """Write the cameras at the current frame as transforms.json with pinholes; how many. Each is
    named after its object, as are folders, videos or images of footage. Axes are captures', y up,
    and a capture keeps this world: imported, it lies among the cameras. Image size: that of the
    capture it was imported from, or the scene's. Raises StgaError for a camera that is not
    perspective, is mirrored, or where there are none."""
    entries = []
    for thing in cameras:
        evaluated = thing.evaluated_get(depsgraph)
        if evaluated.matrix_world.determinant() < 0:
            raise StgaError(f"{thing.name}: is mirrored by a negative scale; apply the scale")
        size = thing.get(tags.IMAGE_SIZE) or image_size(depsgraph.scene.render)
        camera = render_camera(evaluated, depsgraph, int(size[0]), int(size[1]))
        pose = arrays.Z_UP_TO_Y_UP @ camera.camera_to_world_gl
        entry = {"file_path": f"{thing.name}.png", "camera_id": thing.name}
        entry |= {"w": camera.width, "h": camera.height, "transform_matrix": pose.tolist()}
        entries.append(entry | {name: float(getattr(camera, name)) for name in INTRINSICS[2:]})
    if not entries:
        raise StgaError("No cameras to export; add them, or select some")
    write_json(path, {"camera_model": "PINHOLE", "world": "keep", "frames": entries})
    return len(entries)


def scene_camera(depsgraph: Any) -> Camera:
    """The scene's camera now, for a whole image. Raises StgaError unless it is perspective."""
    scene = depsgraph.scene
    camera = scene.camera.evaluated_get(depsgraph) if scene.camera else None
    return render_camera(camera, depsgraph, *image_size(scene.render))


def turntable_cameras(subject: Any, depsgraph: Any, count: int, angle: float) -> list[Camera]:
    """`count` cameras that start as the scene's and orbit a head or splats. angle: radians; 0: the
    sides that the cameras of the capture saw, a full turn where there are none."""
    start = scene_camera(depsgraph)
    matrix = np.array(subject.matrix_world, np.float64)
    if tags.is_splats(subject):  # in world space, some of them far away
        middle = np.median(arrays.mesh_vertices(subject.data), axis=0)
    else:
        vertices = arrays.evaluated_vertices(subject)
        middle = (vertices.min(0) + vertices.max(0)) / 2
    center = matrix[:3, :3] @ middle + matrix[:3, 3]
    angles = (-angle / 2, angle / 2) if angle else (-np.pi, np.pi)
    # The cameras of the capture that it belongs to, for their positions.
    children = () if angle or subject.parent is None else subject.parent.children_recursive
    sensors = [
        camera_from_gl(np.array(child.matrix_world, np.float64), (1, 1), (1, 1), (0, 0))
        for child in children
        if child.get(tags.KIND) == tags.CAMERA
    ]
    if sensors:
        angles = covered_angles(sensors, start, center, UP)
    return turntable(start, center, count, angles, UP)
