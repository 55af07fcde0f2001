"""Path-traced pictures of an animated person from calibrated cameras, rendered by Cycles."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from PIL import Image

from ...capture.camera import Camera
from ...scene.arrays import flat_floats, triangle_mesh
from ...scene.cameras import set_intrinsics
from ...scene.compat import enable_nodes
from ...scene.display.node_builder import Nodes, new_material
from ...scene.display.splat_attributes import write_attributes
from ..bundled_head import HEAD
from .person import SURFACES, Person, Strands

SOFT_BOXES = (
    (-38, 34, 14.0, 0.7),
    (58, 18, 5.0, 0.9),
    (0, -35, 1.5, 0.8),
    (150, 40, 4.0, 0.5),
    (-140, 30, 3.0, 0.5),
)
"""Lamps around the head: azimuth and elevation in degrees (0, 0 is straight ahead), watts, and edge
in meters."""
BOX_DISTANCE_M = 1.3
"""Distance of each lamp from the origin."""
AMBIENT = 0.30
"""Strength of the world's white background, Blender's unit."""
MAX_BOUNCES = 4
"""Bounces after which Cycles ends a light path."""
NOISE_THRESHOLD = 0.03
"""Noise level at which Cycles takes no more samples of a pixel."""
CLOTH_M = 0.0035
"""Distance of the cloth from the skin."""
COLLAR_CM = 1.5
"""Height of the ribbed collar, below the neckline."""
CLOTH_COLOR = (0.045, 0.12, 0.13)
"""Color of the cloth, linear RGB, which its knit makes darker and brighter."""

STRAND_TIP = 0.35
"""Radius of a hair's tip, relative to that of its root."""
BOX_GLOW = 0.5
"""Strength at which a room's boxes shine, instead of lamps of its own."""
BOX_SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corners of each side of a box; bits of a corner's number: at which end of x, y, z it is."""
BOX_FACES = np.array([[a, b, c, a, c, d] for a, b, c, d in BOX_SIDES]).reshape(-1, 3)
"""Triangles of a box."""


class Studio:
    """A Blender scene with the person, lights and a camera."""

    def __init__(self, person: Person, samples: int) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = _scene(samples)
        for box in SOFT_BOXES:
            _soft_box(self.scene, *box)
        self.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self.person = person
        self.body = bpy.data.objects.new("body", _body(person))
        subdivision = self.body.modifiers.new("smooth", "SUBSURF")
        subdivision.levels = subdivision.render_levels = 1
        self.cloth = bpy.data.objects.new("cloth", _cloth(person))
        self.cloth.modifiers.new("smooth", "SUBSURF").render_levels = 1
        thickness = self.cloth.modifiers.new("thickness", "DISPLACE")
        thickness.strength = CLOTH_M
        thickness.mid_level = 0.0
        self.hair = [
            bpy.data.objects.new(strands.name, _curves(strands)) for strands in person.strands
        ]
        for thing in (self.camera, self.body, self.cloth, *self.hair):
            self.scene.collection.objects.link(thing)
        self.scene.camera = self.camera

    def pose(self, vertices: np.ndarray) -> None:
        """Move the person's vertices to (V, 3), and the hair with them."""
        for thing in (self.body, self.cloth):
            thing.data.vertices.foreach_set("co", flat_floats(vertices))
            thing.data.update()
        for thing, strands in zip(self.hair, self.person.strands, strict=True):
            points = self.person.carried(strands, vertices)
            thing.data.attributes["position"].data.foreach_set("vector", flat_floats(points))
            thing.data.update_tag()

    def add_box(self, center: np.ndarray, half: np.ndarray, color: tuple[float, ...]) -> None:
        """Add a box of a papered room, which shines in one linear color with stains. center (3,)
        and half (3,) its size: meters. From then on, pictures show what is behind the person."""
        self.scene.render.film_transparent = False
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3, indexing="ij")).reshape(3, 8).T
        mesh = triangle_mesh("box", center + corners * half, BOX_FACES)
        mesh.polygons.foreach_set("use_smooth", [False] * len(BOX_FACES))
        mesh.materials.append(new_material("box", lambda nodes: _paper(nodes, color)))
        self.scene.collection.objects.link(bpy.data.objects.new("box", mesh))

    def pictures(self, cameras: Sequence[Camera]) -> Iterator[Image.Image]:
        """RGBA pictures of the pose, sRGB with straight alpha."""
        with TemporaryDirectory() as folder:
            self.scene.render.filepath = path = str(Path(folder) / "view.png")
            for view in cameras:
                self.scene.render.resolution_x = view.width
                self.scene.render.resolution_y = view.height
                set_intrinsics(self.camera.data, view)
                self.camera.matrix_world = Matrix(view.camera_to_world_gl.tolist())
                with _silent():
                    bpy.ops.render.render(write_still=True)
                with Image.open(path) as image:
                    yield image.convert("RGBA")


def _paper(nodes: Nodes, color: tuple[float, ...]) -> Any:
    """A surface that shines in one color, with stains that images can be matched by."""
    place = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    stains = _range(nodes, _noise(nodes, place, 9.0, 8.0), (0.3, 0.7), (0.5, 1.3))
    inputs = {"Color": nodes.scale(color, stains), "Strength": BOX_GLOW}
    return nodes.out("ShaderNodeEmission", inputs)


@contextmanager
def _silent() -> Iterator[None]:
    """Hide what Blender prints on standard output for every picture, which breaks a progress
    bar."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _scene(samples: int) -> Any:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.max_bounces = MAX_BOUNCES
    scene.cycles.use_denoising = True
    scene.cycles.adaptive_threshold = NOISE_THRESHOLD
    scene.cycles_curves.shape = "RIBBONS"
    scene.render.use_persistent_data = True
    scene.render.film_transparent = True
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("studio")
    background = enable_nodes(scene.world).nodes["Background"]
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = AMBIENT
    return scene


def _soft_box(scene: Any, azimuth: float, elevation: float, watts: float, size: float) -> None:
    light = bpy.data.lights.new("soft box", "AREA")
    light.energy = watts
    light.size = size
    box = bpy.data.objects.new("soft box", light)
    scene.collection.objects.link(box)
    # A light shines along its own -z: turn +z to look from the subject at the box, and step back.
    turn = Matrix.Rotation(np.radians(azimuth), 4, "Y") @ Matrix.Rotation(
        np.radians(-elevation), 4, "X"
    )
    box.matrix_world = turn @ Matrix.Translation((0, 0, BOX_DISTANCE_M))


def _body(person: Person) -> Any:
    visible = person.surface >= 0
    mesh = triangle_mesh("body", person.neutral, person.model.faces[visible])
    attributes = {
        "rest": ("FLOAT_VECTOR", "vector", flat_floats(person.rest)),
        "tint": ("FLOAT_VECTOR", "vector", flat_floats(person.tint)),
        "eye": ("FLOAT_VECTOR", "vector", flat_floats(person.eye)),
        "roughness": ("FLOAT", "value", flat_floats(person.roughness)),
        "freckles": ("FLOAT", "value", flat_floats(person.freckles)),
    }
    write_attributes(mesh, attributes, "POINT")
    shaders = {"skin": _skin, "mouth": _wet, "gums": _wet, "teeth": _wet, "eyes": _eye}
    for name in SURFACES:
        mesh.materials.append(new_material(name, shaders[name]))
    mesh.polygons.foreach_set("material_index", person.surface[visible].astype(np.int32))
    return mesh


def _curves(strands: Strands) -> Any:
    curves = bpy.data.hair_curves.new(strands.name)
    count, points = strands.points.shape[:2]
    curves.add_curves([points] * count)
    curves.attributes["position"].data.foreach_set("vector", flat_floats(strands.points))
    radius = curves.attributes.get("radius") or curves.attributes.new("radius", "FLOAT", "POINT")
    taper = strands.radius_m * np.linspace(1, STRAND_TIP, points)
    radius.data.foreach_set("value", flat_floats(np.tile(taper, count)))
    melanin = strands.melanin
    redness = strands.redness

    def shader(nodes: Nodes) -> Any:
        inputs = {
            "Melanin": melanin,
            "Melanin Redness": redness,
            "Roughness": 0.32,
            "Random Color": 0.4,
        }
        return nodes.out(
            "ShaderNodeBsdfHairPrincipled", inputs, model="CHIANG", parametrization="MELANIN"
        )

    curves.materials.append(new_material(strands.name, shader))
    return curves


def _skin(nodes: Nodes) -> Any:
    """Tint, mottled and freckled, with pores as bumps, all fixed to the rest position."""
    rest, tint = (_attribute(nodes, name)["Vector"] for name in ("rest", "tint"))
    roughness, freckles = (_attribute(nodes, name)["Fac"] for name in ("roughness", "freckles"))
    mottle = _range(nodes, _noise(nodes, rest, 260.0, 4.0), (0.3, 0.7), (0.94, 1.06))
    cells = nodes.add("ShaderNodeTexVoronoi", {"Vector": rest, "Scale": 430.0}).outputs
    spot = _range(nodes, cells["Distance"], (0.12, 0.34), (1.0, 0.0))
    chosen = _range(nodes, nodes.components(cells["Color"])[0], (0.45, 0.75), (0.0, 1.0))
    freckle = nodes.math("MULTIPLY", nodes.math("MULTIPLY", spot, chosen), freckles)
    paler = nodes.combine(
        *(nodes.math("SUBTRACT", 1.0, nodes.math("MULTIPLY", freckle, d)) for d in (0.3, 0.5, 0.6))
    )
    pores = _noise(nodes, rest, 700.0, 3.0)
    inputs = {
        "Base Color": nodes.vector("MULTIPLY", nodes.scale(tint, mottle), paler),
        "Roughness": roughness,
        "Subsurface Weight": 0.22,
        "Subsurface Radius": (1.0, 0.35, 0.2),
        "Subsurface Scale": 0.006,
        "Specular IOR Level": 0.45,
        "Normal": nodes.out(
            "ShaderNodeBump", {"Strength": 0.35, "Distance": 0.0005, "Height": pores}
        ),
    }
    return nodes.out("ShaderNodeBsdfPrincipled", inputs)


def _wet(nodes: Nodes) -> Any:
    """Teeth, gums, tongue and the mouth's inside."""
    inputs = {
        "Base Color": _attribute(nodes, "tint")["Vector"],
        "Roughness": _attribute(nodes, "roughness")["Fac"],
        "Coat Weight": 0.5,
    }
    return nodes.out("ShaderNodeBsdfPrincipled", inputs)


def _eye(nodes: Nodes) -> Any:
    """Pupil, iris with fibers, limbus and sclera by the angle from the eye's axis."""
    x, y, z = nodes.components(_attribute(nodes, "eye")["Vector"])
    radius = nodes.math(
        "SQRT", nodes.math("ADD", nodes.math("MULTIPLY", x, x), nodes.math("MULTIPLY", y, y))
    )
    away = nodes.math("ADD", radius, nodes.math("MULTIPLY", nodes.math("LESS_THAN", z, 0.0), 2.0))
    ramp = nodes.add("ShaderNodeValToRGB", {"Fac": away})
    elements = ramp.color_ramp.elements
    for place, color in EYE_COLORS[:-2]:
        elements.new(place).color = (*color, 1)
    for element, (place, color) in zip((elements[0], elements[-1]), EYE_COLORS[-2:], strict=True):
        element.position = place
        element.color = (*color, 1)
    around = nodes.math("ARCTAN2", y, x)
    fibers = nodes.combine(
        nodes.math("COSINE", around),
        nodes.math("SINE", around),
        nodes.math("MULTIPLY", radius, 0.3),
    )
    noise = _range(nodes, _noise(nodes, fibers, 14.0, 4.0), (0.3, 0.7), (0.55, 1.5))
    inside = nodes.math("LESS_THAN", away, IRIS)
    shade = nodes.math(
        "ADD", 1.0, nodes.math("MULTIPLY", inside, nodes.math("SUBTRACT", noise, 1.0))
    )
    inputs = {
        "Base Color": nodes.scale(ramp.outputs["Color"], shade),
        "Roughness": 0.25,
        "Coat Weight": 1.0,
        "Coat Roughness": 0.02,
        "Subsurface Weight": 0.1,
        "Subsurface Radius": (1.0, 0.5, 0.4),
        "Subsurface Scale": 0.002,
    }
    return nodes.out("ShaderNodeBsdfPrincipled", inputs)


IRIS = 0.37
"""Radius of the iris, in those of the eyeball."""
EYE_COLORS = (
    (0.13, (0.004, 0.004, 0.004)),
    (0.145, (0.16, 0.11, 0.035)),
    (0.21, (0.10, 0.16, 0.11)),
    (0.32, (0.055, 0.13, 0.13)),
    (0.36, (0.02, 0.04, 0.05)),
    (0.40, (0.70, 0.66, 0.62)),
    (0.0, (0.004, 0.004, 0.004)),
    (0.95, (0.66, 0.52, 0.47)),
)
"""(radius in those of the eyeball, linear RGB); the first and last color come at the end."""


def _cloth(person: Person) -> Any:
    faces = person.model.faces
    near = (faces < HEAD[1]).all(1) & (person.neckline[faces].min(1) < 0.5)
    mesh = triangle_mesh("cloth", person.neutral, faces[near])
    attributes = {
        "rest": ("FLOAT_VECTOR", "vector", flat_floats(person.rest)),
        "neckline": ("FLOAT", "value", flat_floats(person.neckline)),
    }
    write_attributes(mesh, attributes, "POINT")
    mesh.materials.append(new_material("cloth", _knitwear))
    return mesh


def _knitwear(nodes: Nodes) -> Any:
    """A ribbed collar and stitches below it; nothing above the neckline."""
    x, _, z = nodes.components(_attribute(nodes, "rest")["Vector"])
    neckline = _attribute(nodes, "neckline")["Fac"]
    around = nodes.math("ARCTAN2", x, nodes.math("ADD", z, 0.01))
    collar = nodes.math("GREATER_THAN", neckline, -COLLAR_CM)
    ribs = nodes.math("SINE", nodes.math("MULTIPLY", around, 110.0))
    rows = nodes.math("SINE", nodes.math("MULTIPLY", neckline, 26.0))
    height = nodes.out(
        "ShaderNodeMix", {"Factor": collar, "A": nodes.math("MULTIPLY", ribs, rows), "B": ribs}
    )
    inputs = {
        "Base Color": nodes.scale(CLOTH_COLOR, _range(nodes, height, (-1.0, 1.0), (0.75, 1.15))),
        "Roughness": 0.9,
        "Sheen Weight": 0.3,
        "Alpha": nodes.math("LESS_THAN", neckline, 0.0),
        "Normal": nodes.out(
            "ShaderNodeBump", {"Strength": 0.5, "Distance": 0.001, "Height": height}
        ),
    }
    return nodes.out("ShaderNodeBsdfPrincipled", inputs)


def _range(
    nodes: Nodes, value: Any, source: tuple[float, float], target: tuple[float, float]
) -> Any:
    limits = {
        "From Min": source[0],
        "From Max": source[1],
        "To Min": target[0],
        "To Max": target[1],
    }
    return nodes.out("ShaderNodeMapRange", {"Value": value, **limits})


def _noise(nodes: Nodes, position: Any, scale: float, detail: float) -> Any:
    return nodes.add(
        "ShaderNodeTexNoise", {"Vector": position, "Scale": scale, "Detail": detail}
    ).outputs[0]


def _attribute(nodes: Nodes, name: str) -> Any:
    return nodes.add("ShaderNodeAttribute", attribute_name=name).outputs
