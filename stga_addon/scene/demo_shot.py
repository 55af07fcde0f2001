"""The demo's shot: its avatar on a body, among objects, lit, in motion, seen through a lens."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..driving.open_motion import MotionOptions, performed
from ..driving.performers import read_performance
from ..flame.quaternions import from_axis_angle
from ..flame.sequence import FlameSequence
from .arrays import evaluated_vertices
from .avatar_scene import viewports
from .compat import action_curves, enable_nodes
from .duplicate import attach_to_bone
from .light import lighting_settings
from .objects import set_frames_per_second
from .render.film_set import show_set
from .render.scene_splats import SplatCache, level_exposure
from .render.viewport_display import ENGINE
from .rig.head import usable_rig
from .rig.keyframes import EYES, Placement, key_value_path, rotation_path
from .rig.motion import apply_motion

FRAMES = 96
"""Length of the shot, and its last frame: 4 s."""
FRAMES_PER_SECOND = 24
"""Frame rate of the shot, that of cinema films."""
SIZE_PX = 960, 540
"""Width and height of an image of the shot."""
SAMPLES = 16
"""Samples of the lens for each image."""
RINGS = (
    (-0.45, 0.150, 0.100),
    (-0.25, 0.165, 0.105),
    (-0.08, 0.190, 0.110),
    (-0.03, 0.192, 0.102),
    (0.005, 0.182, 0.092),
    (0.030, 0.165, 0.088),
    (0.052, 0.138, 0.082),
    (0.068, 0.105, 0.074),
    (0.080, 0.074, 0.063),
    (0.090, 0.064, 0.058),
)
"""The body from the waist to the collar: height from the head's lower end, half a width and half a
depth, in meters."""
NECK_BEHIND_M = 0.03
"""Distance from the middle of the head's box back to the neck."""
FACE_M = 0.0, -0.07, 0.04
"""Offset from the neck to the face, at which the camera looks."""
CORNERS = 32
"""Corners of a ring."""
BLINK = {44: 0.0, 46: 0.9, 48: 0.9, 51: 0.0}
"""Frame -> how much more both lids close than in the performance."""
LOOK_DEG = {62: 0.0, 65: 16.0, 82: 16.0, 86: 0.0}
"""Frame -> turn of both eyes to the person's left."""
TURN_DEG = {1: -14.0, 40: 6.0, 96: 16.0}
"""Frame -> turn of the body about its spine."""


def build_shot(head: Any, person: FlameSequence, speech: Path) -> None:
    """Build the shot around a head with splats in the open scene. person: of the head; speech: the
    performance that it speaks from. Raises StgaError."""
    scene = bpy.context.scene
    set_frames_per_second(scene, FRAMES_PER_SECOND)
    _key_performance(head, person, speech)
    scene.frame_start = 1
    scene.frame_end = FRAMES
    vertices = evaluated_vertices(head) @ np.array(head.matrix_world)[:3, :3].T
    vertices += np.array(head.matrix_world)[:3, 3]
    middle = Vector((vertices.min(0) + vertices.max(0)) / 2)
    neck = Vector((middle.x, middle.y + NECK_BEHIND_M, vertices[:, 2].min()))
    armature = _body(neck)
    attach_to_bone(head, armature, "chest")
    _key_body(armature)
    _room(middle)
    _lamps(scene, middle)
    _camera(scene, middle)
    render = scene.render
    render.engine = ENGINE
    render.resolution_x, render.resolution_y = SIZE_PX
    render.resolution_percentage = 100
    scene.eevee.taa_render_samples = SAMPLES
    lighting_settings(scene).mode = "scene"
    scene.frame_set(1)
    for area in viewports(bpy.data.screens):
        area.spaces.active.region_3d.view_perspective = "CAMERA"
    show_set(scene)
    exposure = level_exposure(SplatCache())
    if exposure is not None:
        lighting_settings(scene).exposure = exposure


def _placed(name: str, data: Any, location: Sequence[float] = (0, 0, 0)) -> Any:
    made = bpy.data.objects.new(name, data)
    made.location = location
    bpy.context.scene.collection.objects.link(made)
    return made


def _painted(thing: Any, color: Sequence[float], roughness: float) -> Any:
    material = bpy.data.materials.new(thing.name)
    shader = enable_nodes(material).nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    thing.data.materials.append(material)
    return thing


def _lathe(name: str, rings: Sequence[tuple[float, float, float]]) -> Any:
    """A closed mesh through ellipses of (height, half a width, half a depth)."""
    angle = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    points = [
        (width * np.cos(a), depth * np.sin(a), height)
        for height, width, depth in rings
        for a in angle
    ]
    faces = [tuple(range(CORNERS))[::-1]]
    for ring in range(len(rings) - 1):
        for corner in range(CORNERS):
            after = (corner + 1) % CORNERS
            low = ring * CORNERS
            high = low + CORNERS
            faces.append((low + corner, low + after, high + after, high + corner))
    faces.append(tuple(range(len(points) - CORNERS, len(points))))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [], faces)
    mesh.shade_smooth()
    return mesh


def _body(neck: Vector) -> Any:
    """A torso below the neck, on an armature of two bones; the armature."""
    armature = _placed("Body", bpy.data.armatures.new("Body"), neck)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature.data.edit_bones
    spine = bones.new("spine")
    spine.head = 0, 0, RINGS[0][0]
    spine.tail = 0, 0, -0.2
    chest = bones.new("chest")
    chest.head = spine.tail
    chest.tail = 0, 0, 0
    chest.parent = spine
    bpy.ops.object.mode_set(mode="OBJECT")
    torso = _painted(_placed("Torso", _lathe("Torso", RINGS)), (0.02, 0.07, 0.075), 0.9)
    torso.parent = armature
    heights = np.repeat([ring[0] for ring in RINGS], CORNERS)
    fraction = np.clip((heights - RINGS[0][0]) / (-0.1 - RINGS[0][0]), 0, 1)
    for name, weights in (("spine", 1 - fraction), ("chest", fraction)):
        group = torso.vertex_groups.new(name=name)
        for index, weight in enumerate(weights.tolist()):
            group.add([index], weight, "REPLACE")
    torso.modifiers.new("Armature", "ARMATURE").object = armature
    armature.hide_viewport = True
    return armature


def _key_performance(head: Any, person: FlameSequence, speech: Path) -> None:
    """Apply the performance as a strip, and keyframe lids and eyes in actions above it."""
    performance = read_performance(speech)
    rate = float(FRAMES_PER_SECOND)
    motion = performed(performance, person, head.name, MotionOptions(), fps=rate)
    frames = motion.sequence.frames()
    apply_motion(head, frames, Placement(1, speech.stem, as_strip=True))
    keys = head.data.shape_keys
    rig = usable_rig(head)
    keys.animation_data.action_blend_type = "ADD"
    rig.animation_data.action_blend_type = "COMBINE"
    for side in ("Left", "Right"):
        _key(keys, key_value_path(f"eyeBlink{side}"), {f: [v] for f, v in BLINK.items()})
    turns = from_axis_angle(np.radians([[0, angle, 0] for angle in LOOK_DEG.values()]))
    for eye in EYES:
        _key(rig, rotation_path(eye), dict(zip(LOOK_DEG, turns.tolist(), strict=True)))
    bpy.context.scene.frame_set(1)


def _key_body(armature: Any) -> None:
    """Keyframes that turn the body's chest."""
    armature.pose.bones["chest"].rotation_mode = "XYZ"
    turns = {frame: [0.0, np.radians(angle), 0.0] for frame, angle in TURN_DEG.items()}
    _key(armature, 'pose.bones["chest"].rotation_euler', turns)


def _key(owner: Any, path: str, values: Mapping[int, Sequence[float]]) -> None:
    """Keyframe a property of `owner`, frame -> its elements."""
    curves = action_curves(owner)
    for index in range(len(next(iter(values.values())))):
        curve = curves.new(path, index=index)
        for frame, elements in values.items():
            curve.keyframe_points.insert(frame, elements[index])


def _room(middle: Vector) -> None:
    """A floor, a wall, things behind the head and one in front."""
    floor = [(-3, -3, -0.75), (3, -3, -0.75), (3, 1.6, -0.75), (-3, 1.6, -0.75)]
    wall = [(-3, 1.6, -0.75), (3, 1.6, -0.75), (3, 1.6, 3), (-3, 1.6, 3)]
    for name, corners, color in (
        ("Floor", floor, (0.25, 0.2, 0.16)),
        ("Wall", wall, (0.16, 0.24, 0.26)),
    ):
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(corners, [], [range(4)])
        _painted(_placed(name, mesh, (middle.x, middle.y, middle.z)), color, 0.9)
    column = [(-0.75, 0.09, 0.09), (-0.7, 0.07, 0.07), (0.9, 0.06, 0.06)]
    shelf = [(-0.02, 0.5, 0.16), (0.0, 0.5, 0.16)]
    vase = [(0.0, 0.03, 0.03), (0.05, 0.06, 0.06), (0.12, 0.05, 0.05), (0.17, 0.025, 0.025)]
    for name, rings, at, color in (
        ("Column", column, (-0.55, 0.9, 0.0), (0.6, 0.55, 0.5)),
        ("Shelf", shelf, (0.55, 0.75, -0.12), (0.3, 0.18, 0.1)),
        ("Vase", vase, (0.36, 0.7, -0.12), (0.7, 0.25, 0.1)),
        ("Bottle", vase, (0.26, -0.3, -0.28), (0.1, 0.35, 0.3)),
    ):
        _painted(_placed(name, _lathe(name, rings), middle + Vector(at)), color, 0.3)


def _lamps(scene: Any, middle: Vector) -> None:
    """A warm lamp from the left and above, a cool one from behind, and a dim world, in place of the
    scene's light."""
    for lamp in [each for each in scene.objects if each.type == "LIGHT"]:
        lamp.hide_render = True
    for name, at, watts, size, color in (
        ("Key", (-0.8, -0.9, 0.6), 22.0, 0.5, (1.0, 0.86, 0.7)),
        ("Rim", (0.7, 0.8, 0.5), 18.0, 0.4, (0.65, 0.8, 1.0)),
    ):
        data = bpy.data.lights.new(name, "AREA")
        data.energy = watts
        data.size = size
        data.color = color
        lamp = _placed(name, data, middle + Vector(at))
        lamp.rotation_euler = Vector(at).to_track_quat("Z", "Y").to_euler()
    scene.world = bpy.data.worlds.new("Shot")
    background = enable_nodes(scene.world).nodes["Background"]
    background.inputs["Color"].default_value = (0.05, 0.06, 0.08, 1.0)


def _camera(scene: Any, middle: Vector) -> None:
    """A camera that walks around the head and keeps it in focus."""
    target = _placed("Focus", None, middle + Vector(FACE_M))
    data = bpy.data.cameras.new("Shot")
    data.lens = 50.0
    data.dof.use_dof = True
    data.dof.focus_object = target
    data.dof.aperture_fstop = 1.4
    camera = _placed("Shot", data)
    look = camera.constraints.new("TRACK_TO")
    look.target = target
    for frame, at in ((1, (-0.5, -1.0, 0.06)), (FRAMES, (0.25, -0.85, 0.02))):
        camera.location = middle + Vector(at)
        camera.keyframe_insert("location", frame=frame)
    scene.camera = camera
