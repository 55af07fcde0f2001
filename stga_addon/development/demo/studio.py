"""Path-traced pictures of an animated mesh from calibrated cameras, rendered by Cycles."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...capture.camera import Camera
from ...scene.arrays import flat_floats, triangle_mesh
from ...scene.cameras import set_intrinsics
from ...scene.compat import enable_nodes
from ...scene.display.node_builder import Nodes, new_material
from ...scene.display.splat_attributes import write_attributes

# Soft boxes around the head: azimuth and elevation in degrees (0, 0 is straight ahead), watts.
SOFT_BOXES = ((-50, 32, 8.0), (48, 36, 6.0), (0, -20, 2.0))
BOX_DISTANCE, BOX_SIZE = 1.2, 0.6  # meters
AMBIENT = 0.5


@dataclass(frozen=True)
class StudioHead:
    """The mesh to render.

    faces (F, 3); rest (V, 3) positions the skin's fine texture is attached to; tint (V, 3) linear RGB;
    roughness and grain (V,): grain is how much fine texture shows, 0 to 1.
    """

    faces: np.ndarray
    rest: np.ndarray
    tint: np.ndarray
    roughness: np.ndarray
    grain: np.ndarray


def render_poses(
    subject: StudioHead,
    poses: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    keep: Callable[[int, int, np.ndarray], None],
    samples: int,
    seed: int = 0,
) -> None:
    """Path-trace every pose (V, 3) from every camera, one after the other.

    `keep(pose, camera, rgba)` gets each picture: (H, W, 4) uint8, sRGB, straight alpha. Works in a scene of its own
    with Cycles on the CPU and leaves the open file as it was. All cameras share one size.
    """
    with _studio(subject, samples, seed) as (scene, head, camera), TemporaryDirectory() as folder:
        for index, vertices in enumerate(poses):
            head.data.vertices.foreach_set("co", flat_floats(vertices))
            head.data.update()
            for number, view in enumerate(cameras):
                place_camera(scene, camera, view)
                keep(index, number, _render(scene, Path(folder) / "view.png"))


def place_camera(scene: bpy.types.Scene, camera: bpy.types.Object, view: Camera) -> None:
    """Give a Blender camera and the scene's image the intrinsics and pose of `view` (pixels must be square)."""
    scene.render.resolution_x, scene.render.resolution_y = view.width, view.height
    set_intrinsics(camera.data, view)
    camera.matrix_world = Matrix(view.camera_to_world_gl.tolist())


def _render(scene: bpy.types.Scene, path: Path) -> np.ndarray:
    from PIL import Image

    scene.render.filepath = str(path)
    with _silent():
        bpy.ops.render.render(write_still=True, scene=scene.name)
    with Image.open(path) as image:
        return np.asarray(image.convert("RGBA")).copy()


@contextmanager
def _silent() -> Iterator[None]:
    """Hide what Blender prints on standard output for every saved picture, which would break the progress bar."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextmanager
def _studio(
    subject: StudioHead, samples: int, seed: int
) -> Iterator[tuple[bpy.types.Scene, bpy.types.Object, bpy.types.Object]]:
    """A scene with the head and a camera, removed with all its data when the block ends."""
    kinds = ("scenes", "worlds", "lights", "cameras", "meshes", "materials", "objects")
    before = {kind: set(getattr(bpy.data, kind)) for kind in kinds}
    try:
        scene = _scene(samples, seed)
        for azimuth, elevation, watts in SOFT_BOXES:
            _soft_box(scene, azimuth, elevation, watts)
        head = _head(scene, subject)
        camera = bpy.data.objects.new("studio camera", bpy.data.cameras.new("studio camera"))
        scene.collection.objects.link(camera)
        scene.camera = camera
        yield scene, head, camera
    finally:
        for kind in kinds:
            blocks = getattr(bpy.data, kind)
            for block in set(blocks) - before[kind]:
                blocks.remove(block)


def _scene(samples: int, seed: int) -> bpy.types.Scene:
    scene = bpy.data.scenes.new("studio")
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.cycles.use_denoising = True
    scene.cycles.max_bounces = 3
    scene.render.use_persistent_data = True
    scene.render.film_transparent = True
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"
    world = bpy.data.worlds.new("studio")
    background = enable_nodes(world).nodes["Background"]
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = AMBIENT
    scene.world = world
    return scene


def _soft_box(scene: bpy.types.Scene, azimuth: float, elevation: float, watts: float) -> None:
    light = bpy.data.lights.new("soft box", "AREA")
    light.energy, light.size = watts, BOX_SIZE
    box = bpy.data.objects.new("soft box", light)
    scene.collection.objects.link(box)
    # A light shines along its own -z: turn +z to look from the subject at the box, then step back along it.
    turn = Matrix.Rotation(np.radians(azimuth), 4, "Y") @ Matrix.Rotation(np.radians(-elevation), 4, "X")
    box.matrix_world = turn @ Matrix.Translation((0, 0, BOX_DISTANCE))


def _head(scene: bpy.types.Scene, subject: StudioHead) -> bpy.types.Object:
    mesh = triangle_mesh("subject", subject.rest, subject.faces)
    attributes = {
        "rest": ("FLOAT_VECTOR", "vector", flat_floats(subject.rest)),
        "tint": ("FLOAT_VECTOR", "vector", flat_floats(subject.tint)),
        "roughness": ("FLOAT", "value", flat_floats(subject.roughness)),
        "grain": ("FLOAT", "value", flat_floats(subject.grain)),
    }
    write_attributes(mesh, attributes, "POINT")
    mesh.materials.append(new_material("subject", _skin_shader))
    head = bpy.data.objects.new("subject", mesh)
    scene.collection.objects.link(head)
    return head


def _skin_shader(nodes: Nodes) -> bpy.types.NodeSocket:
    """Tint times fine noise, and pores as bumps, both fixed to the rest position and faded by `grain`."""
    rest, tint = (_attribute(nodes, name)["Vector"] for name in ("rest", "tint"))
    grain, roughness = (_attribute(nodes, name)["Fac"] for name in ("grain", "roughness"))
    inputs = {
        "Base Color": nodes.scale(tint, _mottle(nodes, rest, grain)),
        "Roughness": roughness,
        "Normal": _pores(nodes, rest, grain),
    }
    return nodes.out("ShaderNodeBsdfPrincipled", inputs)


def _mottle(nodes: Nodes, position: bpy.types.NodeSocket, grain: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Factor on the tint: 0.88 to 1.12 where grain is 1, 1 where it is 0."""
    noise = _noise(nodes, position, scale=260.0, detail=4.0)
    ranges = {"From Min": 0.3, "From Max": 0.7, "To Min": 0.88, "To Max": 1.12}
    shade = nodes.out("ShaderNodeMapRange", {"Value": noise, **ranges})
    return nodes.out("ShaderNodeMix", {"Factor": grain, "A": 1.0, "B": shade})


def _pores(nodes: Nodes, position: bpy.types.NodeSocket, grain: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Normals of bumps of up to 0.6 mm."""
    noise = _noise(nodes, position, scale=700.0, detail=3.0)
    return nodes.out("ShaderNodeBump", {"Strength": grain, "Distance": 0.0006, "Height": noise})


def _noise(nodes: Nodes, position: bpy.types.NodeSocket, scale: float, detail: float) -> bpy.types.NodeSocket:
    inputs = {"Vector": position, "Scale": scale, "Detail": detail}
    return nodes.add("ShaderNodeTexNoise", inputs).outputs[0]


def _attribute(nodes: Nodes, name: str) -> Any:
    return nodes.add("ShaderNodeAttribute", attribute_name=name).outputs
