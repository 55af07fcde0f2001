"""What of the scene plays in an exported web page."""

from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.camera import Camera, camera_from_gl
from ..stga_addon.errors import StgaError
from ..stga_addon.export.playback import Playback
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.scene.cameras import scene_camera
from ..stga_addon.scene.objects import Warn, frames_per_second
from ..stga_addon.scene.rig.head import rig_of
from ..stga_addon.scene.rig.motion import sample_motion
from ..stga_addon.scene.vertex_groups import training_selection
from .common import capture_of, flame_of


def scene_playback(context: Any, head: Any, frames: range, motion_only: bool) -> Playback:
    """The scene's frame rate, camera, selection groups and upward direction, in the head's
    space."""
    to_head = np.linalg.inv(np.array(head.matrix_world, np.float64))
    up = to_head[:3, :3] @ [0.0, 0.0, 1.0]
    up /= np.linalg.norm(up)
    selection = training_selection(head)
    everything = np.ones(len(head.data.polygons), bool)
    return Playback(
        title=head.name,
        fps=frames_per_second(context.scene),
        views=_scene_camera(context, to_head),
        up=(float(up[0]), float(up[1]), float(up[2])),
        selection=[selection.get(frame, everything) for frame in frames] if selection else None,
        motion_only=motion_only,
    )


def exact_motion(head: Any, frames: range, warn: Warn) -> FlameSequence | None:
    """FLAME parameters of what the head plays; None without a rig, or, after saying why, where they
    would not give the scene's meshes."""
    reasons: list[str] = []
    try:
        rig_of(head)
    except StgaError:
        return None
    try:
        motion = sample_motion(head, flame_of(capture_of(head), head.name), frames, reasons.append)
    except StgaError as error:
        reasons.append(str(error))
    if reasons:
        warn(f"No sliders in the page: {reasons[0]}")
        return None
    return motion


def _scene_camera(context: Any, to_head: np.ndarray) -> dict[str, Camera]:
    """The scene's camera as the head sees it; none where the scene has no perspective camera."""
    try:
        found = scene_camera(context.evaluated_depsgraph_get())
    except StgaError:
        return {}
    pose = to_head @ found.camera_to_world_gl
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    seen = camera_from_gl(
        pose, found.width, found.height, found.fl_x, found.fl_y, found.cx, found.cy
    )
    return {bpy.path.display_name(context.scene.camera.name, has_ext=False): seen}
