"""Depth of field and motion blur: the rays of an image as samples over the camera's aperture and
shutter, as Blender's renderers understand them. Images are means of the samples."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..compat import shutter_position
from ..gpu.packing import View

SHUTTER_START = {"START": 0.0, "CENTER": -0.5, "END": -1.0}
"""When the shutter opens, in exposure times from the frame."""

TIME_STEP = 0.7548776662
"""Time from a sample to the next one, in exposure times: 1 over the plastic number."""
GOLDEN_STEP = 0.6180339887
"""Angle in the aperture from a sample to the next one, in turns."""


class Sample(NamedTuple):
    """A moment, in frames from the image's, and a point of the aperture, (2,) in radii, right and
    down."""

    offset: float
    point: np.ndarray


SHARP = Sample(0.0, np.zeros(2))


def has_depth_of_field(camera: Any) -> bool:
    """Whether a camera object focuses; of None, no."""
    dof = None if camera is None else getattr(camera.data, "dof", None)
    return dof is not None and bool(dof.use_dof)


def is_blurred(scene: Any) -> bool:
    """Whether images of the scene have depth of field or motion blur."""
    return has_depth_of_field(scene.camera) or bool(scene.render.use_motion_blur)


def samples(scene: Any, camera: Any) -> list[Sample]:
    """As many as EEVEE takes for an image of the scene by a camera object; `SHARP` alone where
    nothing is blurred."""
    focuses = has_depth_of_field(camera)
    moves = bool(scene.render.use_motion_blur)
    count = max(1, scene.eevee.taa_render_samples)
    if not (focuses or moves) or count == 1:
        return [SHARP]
    moment, turn, area = _even(count).T
    offsets = np.zeros(count)
    if moves:
        start = SHUTTER_START[shutter_position(scene)]
        offsets = (moment + start) * scene.render.motion_blur_shutter
    points = np.zeros((count, 2))
    if focuses:
        dof = camera.data.dof
        points = _aperture_points(turn, area, dof.aperture_blades, dof.aperture_rotation)
        points[:, 0] /= dof.aperture_ratio
    return [Sample(float(offset), point) for offset, point in zip(offsets, points, strict=True)]


def view_from(view: View, camera: Any, point: np.ndarray) -> View:
    """The view from a point (2,) of the aperture of an evaluated camera object, in radii: what is
    in focus stays where it is in the image."""
    if not point.any():
        return view
    data = camera.data
    radius = 1e-3 * data.lens / (2 * data.dof.aperture_fstop)
    right, down = radius * point
    pinhole = view.camera
    moved = pinhole.world_to_camera.copy()
    moved[:2, 3] -= right, down
    distance = max(_focus_distance(camera), 1e-6)
    cx = pinhole.cx + pinhole.fl_x * right / distance
    cy = pinhole.cy + pinhole.fl_y * down / distance
    return replace(view, camera=replace(pinhole, cx=cx, cy=cy, world_to_camera=moved))


def _focus_distance(camera: Any) -> float:
    """Meters along the axis of an evaluated camera object to its plane in focus."""
    dof = camera.data.dof
    target = dof.focus_object
    if target is None:
        return float(dof.focus_distance)
    place = target.matrix_world.translation
    bone = target.pose.bones.get(dof.focus_subtarget) if target.type == "ARMATURE" else None
    if bone is not None:
        place = target.matrix_world @ bone.matrix.translation
    return float(abs((camera.matrix_world.inverted_safe() @ place).z))


def _even(count: int) -> np.ndarray:
    """(count, 3) in 0…1, evenly spread: the last in order, the others by irrational steps, so that
    angle and radius make a sunflower's disk (Vogel 1979)."""
    order = np.arange(count)
    return np.stack(
        [
            (0.5 + order * TIME_STEP) % 1.0,
            (0.5 + order * GOLDEN_STEP) % 1.0,
            (0.5 + order) / count,
        ],
        axis=-1,
    )


def _aperture_points(turn: np.ndarray, area: np.ndarray, blades: int, rotation: float) -> Any:
    """(N, 2) points of a disk of radius 1, or of the regular polygon in it that three blades or
    more form, turned by radians. turn, area (N,): in 0…1, of a full turn and of the area."""
    fraction = np.sqrt(area)[:, None]
    if blades < 3:
        angle = 2 * np.pi * turn
        return fraction * np.stack([np.cos(angle), np.sin(angle)], -1)
    corner = np.floor(turn * blades)
    along = (turn * blades - corner)[:, None]
    # Blender's rotation is that of the first side's middle, counterclockwise as the camera sees it
    angles = rotation + 2 * np.pi * np.stack([corner - 0.5, corner + 0.5]) / blades
    first, second = np.stack([np.cos(angles), -np.sin(angles)], -1)
    return fraction * (first * (1 - along) + second * along)
