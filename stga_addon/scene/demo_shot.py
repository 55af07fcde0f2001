"""The demo's shot: its avatar on a body, among objects, lit, in motion, seen through a lens."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ...scene import light, tags
from ...scene.arrays import evaluated_vertices
from ...scene.compat import enable_nodes
from ...scene.duplicate import attach_to_bone
from ...scene.light import lighting_settings
from ...scene.objects import save_file, set_frames_per_second
from ...scene.render import engine
from ...scene.render.film_set import show_set
from ...scene.render.scene_splats import SplatCache, level_exposure
from ...scene.render.viewport_display import ENGINE

FRAMES = 96
FRAMES_PER_SECOND = 24
SIZE_PX = 960, 540
SAMPLES = 16
"""Of the lens, for each image."""

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
"""From the middle of the head's box to the neck."""
FACE_M = 0.0, -0.07, 0.04
"""From there to the face, which the camera looks at."""
CORNERS = 32
"""Of a ring."""
SPEECH = {
    1: {},
    8: {"jawOpen": 0.35},
    13: {"mouthFunnel": 0.5, "jawOpen": 0.15},
    18: {"mouthClose": 0.1},
    24: {"jawOpen": 0.45, "mouthSmileLeft": 0.2, "mouthSmileRight": 0.2},
    29: {"mouthPucker": 0.6},
    35: {"jawOpen": 0.25, "mouthStretchLeft": 0.3, "mouthStretchRight": 0.3},
    42: {},
    60: {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7, "cheekSquintLeft": 0.4},
    96: {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5},
}
"""Frame -> sliders of the mouth."""
BLINK = {44: 0.0, 46: 1.0, 48: 1.0, 51: 0.0}
"""Frame -> both lids."""
TURN_DEG = {1: -14.0, 40: 6.0, 96: 16.0}
"""Frame -> turn of the body about its spine."""


def make_shot(path: Path) -> None:
    """Build the shot around the head with splats in the open file, and save it. Raises
    StgaError."""
    heads = [each for each in bpy.context.scene.objects if each.get(tags.KIND) == tags.HEAD]
    with _registered():
        _build(heads[0])
        save_file(path)


@contextmanager
def _registered() -> Iterator[None]:
    """Register the engine and the settings of lighting for the block, where no extension has."""
    if lighting_settings(bpy.context.scene) is not None:
        yield
        return
    light.register()
    engine.register(lambda: "")
    try:
        yield
    finally:
        engine.unregister()
        light.unregister()


def _build(head: Any) -> None:
    scene = bpy.context.scene
    scene.frame_start = 1
    scene.frame_end = FRAMES
    set_frames_per_second(scene, FRAMES_PER_SECOND)
    vertices = evaluated_vertices(head) @ np.array(head.matrix_world)[:3, :3].T
    vertices += np.array(head.matrix_world)[:3, 3]
    middle = Vector((vertices.min(0) + vertices.max(0)) / 2)
    neck = Vector((middle.x, middle.y + NECK_BEHIND_M, vertices[:, 2].min()))
    armature = _body(neck)
    attach_to_bone(head, armature, "chest")
    _act(head, armature)
    _room(middle)
    _lamps(middle)
    _camera(scene, middle)
    render = scene.render
    render.engine = ENGINE
    render.resolution_x, render.resolution_y = SIZE_PX
    render.resolution_percentage = 100
    scene.eevee.taa_render_samples = SAMPLES
    lighting_settings(scene).mode = "scene"
    scene.frame_set(1)
    show_set(scene)
    exposure = level_exposure(SplatCache())
    if exposure is not None:
        lighting_settings(scene).exposure = exposure


def _placed(name: str, data: Any, location: Sequence[float] = (0, 0, 0)) -> Any:
    made = bpy.data.objects.new(name, data)
    made.location = location
    bpy.context.scene.collection.objects.link(made)
    return made


def _painted(thing: Any, color: Sequence[float], roughness: float = 0.6) -> Any:
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
    share = np.clip((heights - RINGS[0][0]) / (-0.1 - RINGS[0][0]), 0, 1)
    for name, weights in (("spine", 1 - share), ("chest", share)):
        group = torso.vertex_groups.new(name=name)
        for index, weight in enumerate(weights.tolist()):
            group.add([index], weight, "REPLACE")
    torso.modifiers.new("Armature", "ARMATURE").object = armature
    armature.hide_viewport = True
    return armature


def _act(head: Any, armature: Any) -> None:
    """Keyframes of the mouth, the lids, the eyes and the body."""
    keys = head.data.shape_keys
    rig = next((each for each in head.parent.children if each.get(tags.KIND) == tags.RIG), None)
    for owner in (keys, rig):  # the expressions of the capture
        if owner is not None and owner.animation_data is not None:
            owner.animation_data.action = None
    for block in keys.key_blocks[1:]:
        if not block.name.startswith("identity"):
            block.value = 0.0
    used = sorted({name for pose in SPEECH.values() for name in pose})
    for frame, pose in SPEECH.items():
        _key_sliders(keys, frame, {name: pose.get(name, 0.0) for name in used})
    for frame, value in BLINK.items():
        _key_sliders(keys, frame, {"eyeBlinkLeft": value, "eyeBlinkRight": value})
    chest = armature.pose.bones["chest"]
    chest.rotation_mode = "XYZ"
    for frame, angle in TURN_DEG.items():
        chest.rotation_euler.y = np.radians(angle)
        chest.keyframe_insert("rotation_euler", index=1, frame=frame)


def _key_sliders(keys: Any, frame: int, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        block = keys.key_blocks.get(name)
        if block is not None:
            block.value = value
            block.keyframe_insert("value", frame=frame)


def _room(middle: Vector) -> None:
    """A floor, a wall, things behind the head and one before it."""
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


def _lamps(middle: Vector) -> None:
    """A warm lamp from the left and above, a cool one from behind, and a dim world."""
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
    background = enable_nodes(bpy.context.scene.world).nodes["Background"]
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
