"""Blender's lights and worlds as values, as they light each avatar, and heads' shadows."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from mathutils import Euler

from ...avatar.file import Avatar
from ...capture.color import srgb_to_linear
from ...light.environment import split_environment
from ...light.harmonics import rotated, uniform
from ...light.relight import Relighter
from ...light.values import Caster, Light, Lighting, no_world
from .. import tags
from ..arrays import mesh_vertices, read_values
from ..compat import is_normalized, light_nodes, light_strength, world_nodes
from ..display import splat_nodes
from ..display.splat_object import get_input
from ..layers import Relit
from .settings import current_settings, lighting_settings

KINDS = {"SUN": "sun", "POINT": "point", "SPOT": "spot", "AREA": "area"}
ELLIPSES = ("DISK", "ELLIPSE")


def light_of(light: Any, matrix: Any) -> Light | None:
    """A light (evaluated data of an object) at a world matrix; None for one without light.

    Its node tree counts as far as it is one Emission node of constant color and strength.
    """
    color, tree = light_strength(light), light_nodes(light)
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    if links and links[0].from_node.type == "EMISSION":
        emitted, strength = (links[0].from_node.inputs[name] for name in ("Color", "Strength"))
        color = color * np.array(emitted.default_value[:3]) * strength.default_value
    if not color.any() or not np.isfinite(color).all():
        return None
    to_world = np.array(matrix, np.float64)
    scale = np.linalg.norm(to_world[:3, :3], axis=0)
    axes = to_world[:3, :3] / np.maximum(scale, 1e-12)
    found = Light(
        KINDS[light.type],
        color,
        position=to_world[:3, 3],
        direction=-axes[:, 2],
        casts_shadow=bool(light.use_shadow),
        diffuse=light.diffuse_factor,
        specular=light.specular_factor,
    )
    if light.type == "SUN":
        found = replace(found, angle=light.angle)
    elif light.type == "AREA":
        height = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size
        shape = "ellipse" if light.shape in ELLIPSES else "rectangle"
        size = float(light.size * scale[0]), float(height * scale[1])
        found = replace(found, size=size, tangent=axes[:, 0], shape=shape)
    else:
        found = replace(found, radius=light.shadow_soft_size)
        if light.type == "SPOT":
            found = replace(found, cone=light.spot_size, blend=light.spot_blend)
    if is_normalized(light):
        return found
    # Energy is per square meter, as Cycles counts them.
    radius = float(np.tan(found.angle / 2)) if found.kind == "sun" else found.radius
    area = np.pi * radius**2
    if found.kind == "area":
        area = found.size[0] * found.size[1] * (np.pi / 4 if found.shape == "ellipse" else 1.0)
    return replace(found, color=color * area)


def in_avatar_space(light: Light, to_world: np.ndarray) -> Light:
    """The light in the space that `to_world` (4, 4) takes to the world, as bright as before."""
    to_avatar = np.linalg.inv(to_world)
    found = light.transformed(to_avatar)
    if light.kind == "sun":
        return found
    scale = float(np.cbrt(abs(np.linalg.det(to_avatar[:3, :3]))))
    return replace(found, color=found.color * scale**2)


def is_linked(light_object: Any, receivers: tuple[Any, ...]) -> bool:
    """Whether a light's light linking lets it shine on any of these objects (originals)."""
    linking = getattr(light_object, "light_linking", None)
    collection = linking.receiver_collection if linking else None
    if collection is None:
        return True
    # Link state, and the objects that it is for; of several for one object the first counts.
    members = [
        (entry.light_linking.link_state, {member})
        for entry, member in zip(collection.collection_objects, collection.objects, strict=False)
    ] + [
        (entry.light_linking.link_state, set(child.all_objects))
        for entry, child in zip(collection.collection_children, collection.children, strict=False)
    ]
    named = [
        next((state for state, objects in members if receiver in objects), "")
        for receiver in receivers
    ]
    if "EXCLUDE" in named:
        return False
    return "INCLUDE" in named or "INCLUDE" not in [state for state, _ in members]


class WorldLight(NamedTuple):
    """What a world's light depends on; equal where its light is.

    color: scene-linear, with strength; of a texture, what its pixels are multiplied with. image:
    the texture's image.
    rotation (9,): row by row, from directions of the world to those of the texture.
    """

    color: tuple[float, ...]
    image: Any = None
    rotation: tuple[float, ...] = ()


def world_light(world: Any) -> WorldLight | None:
    """The light of a world, one color or an environment texture; None for other nodes."""
    tree = world_nodes(world) if world is not None else None
    if world is not None and tree is None:
        return WorldLight(tuple(world.color))
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    if not links:
        return WorldLight((0.0, 0.0, 0.0))
    background = links[0].from_node
    if background.type != "BACKGROUND" or background.inputs["Strength"].is_linked:
        return None
    strength, color = background.inputs["Strength"].default_value, background.inputs["Color"]
    if not color.is_linked:
        return WorldLight(tuple(channel * strength for channel in color.default_value[:3]))
    texture = color.links[0].from_node
    if texture.type != "TEX_ENVIRONMENT" or texture.image is None:
        return None
    rotation = _rotation(texture.inputs["Vector"])
    if texture.projection != "EQUIRECTANGULAR" or rotation is None:
        return None
    return WorldLight((strength,) * 3, texture.image, tuple(rotation.ravel().tolist()))


def split_world(light: WorldLight) -> tuple[np.ndarray, tuple[Light, ...]]:
    """Harmonics (9, 3) and suns in the world's axes; reads the image's pixels."""
    if light.image is None:
        return uniform(light.color), ()
    image, pixels = light.image, np.zeros((2, 4, 3), np.float32)  # black where a file is missing
    width, height = image.size
    if width and height and image.channels >= 3:
        pixels = np.empty((height, width, image.channels), np.float32)
        image.pixels.foreach_get(pixels.ravel())
    linear = pixels[::-1, :, :3]
    if not image.is_float and image.colorspace_settings.name == "sRGB":
        linear = srgb_to_linear(linear)
    rotation = np.reshape(light.rotation, (3, 3)).T
    return split_environment(linear * np.array(light.color), rotation)


def _rotation(vector: Any) -> np.ndarray | None:
    """(3, 3) that a Mapping node turns the texture's directions by; None for nodes that do more."""
    if not vector.is_linked:
        return np.eye(3)
    node = vector.links[0].from_node
    if node.type == "TEX_COORD":
        return np.eye(3)
    source = node.inputs["Vector"].links if node.type == "MAPPING" else ()
    if not source or source[0].from_node.type != "TEX_COORD" or node.inputs["Rotation"].is_linked:
        return None
    turn = np.array(Euler(node.inputs["Rotation"].default_value).to_matrix())
    return turn.T if node.vector_type == "TEXTURE" else turn


MAX_KEPT = 64
COPIED_SETTINGS = ("mode", "mix", "exposure", "roughness", "specular", "shadows")


class SceneLight:
    """What is kept between redraws, so that nothing is computed while nothing moves."""

    def __init__(self) -> None:
        self.casters = Casters()
        self._relighters: dict[int, Relighter] = {}
        self._relit: dict[tuple[int, bytes], tuple[Any, Relit]] = {}
        self._worlds: dict[WorldLight, tuple[np.ndarray, tuple[Light, ...]]] = {}

    def relit(
        self, splat_object: Any, head: Any, avatar: Avatar, vertices: np.ndarray,
        to_world: np.ndarray, visible: Sequence[tuple[Any, Any]], depsgraph: Any,
    ) -> Relit | None:  # fmt: skip
        """How the scene lights an avatar whose head has vertices (V, 3); None where its colors are
        as recorded.

        The same object as long as all is the same, `vertices` by identity. to_world (4, 4): from
        the avatar's space.
        """
        settings = current_settings(depsgraph)
        if avatar.light is None or settings is None or settings.mode == "recorded":
            return None
        lighting = self.lighting(settings, (splat_object, head), to_world, visible, depsgraph)
        casters = self.casters.of(head, to_world, visible, depsgraph) if lighting.shadows else ()
        uid = splat_object.session_uid
        relighter = self._relighters.get(uid)
        if relighter is None or relighter.avatar is not avatar:
            relighter = self._relighters[uid] = Relighter(avatar)
        # Equal for lightings of the same values.
        values = [value for name, value in vars(lighting).items() if name != "lights"]
        values += [value for light in lighting.lights for value in vars(light).values()]
        same = [each.tobytes() if isinstance(each, np.ndarray) else each for each in values]
        key, place = (*same, id(relighter), id(vertices), id(casters)), (uid, to_world.tobytes())
        known = self._relit.get(place)
        if known is None or known[0] != key:
            if len(self._relit) > MAX_KEPT:  # objects that move leave an entry at each place
                self._relit.clear()
            known = self._relit[place] = key, Relit(relighter, vertices, lighting, casters)
        return known[1]

    def lighting(
        self, settings: Any, receivers: tuple[Any, ...], to_world: np.ndarray,
        visible: Sequence[tuple[Any, Any]], depsgraph: Any,
    ) -> Lighting:  # fmt: skip
        """The light for objects `receivers`, in the space that `to_world` takes to the world."""
        chosen = lighting_settings(depsgraph.scene).lights
        lights = []
        for each, matrix in visible:
            is_chosen = chosen is None or each.name in chosen.all_objects
            if each.type == "LIGHT" and is_chosen and is_linked(each, receivers):
                light = light_of(each.evaluated_get(depsgraph).data, matrix)
                lights += [] if light is None else [in_avatar_space(light, to_world)]
        white = np.maximum(np.array(settings.white, np.float64), 1e-3)
        red, green, blue = (white / white.mean()).tolist()
        world, suns = self._world(depsgraph, to_world) if settings.world else (no_world(), ())
        return Lighting(
            world=world,
            lights=(*lights, *suns),
            white=(red, green, blue),
            **{name: getattr(settings, name) for name in COPIED_SETTINGS},
        )

    def _world(self, depsgraph: Any, to_world: np.ndarray) -> tuple[np.ndarray, tuple[Light, ...]]:
        """Harmonics (9, 3) and suns in the space of `lighting`; black for nodes not understood."""
        light = world_light(depsgraph.scene_eval.world)
        if light is None:
            return no_world(), ()
        if light.image is not None:
            light = light._replace(image=light.image.original)
        if light not in self._worlds:
            self._worlds = {light: split_world(light)}
        world, suns = self._worlds[light]
        if light.image is None:
            return world, suns
        u, _, v = np.linalg.svd(to_world[:3, :3])
        return rotated(world, (u @ v).T), tuple(in_avatar_space(sun, to_world) for sun in suns)


class Casters:
    """Meshes of a scene in world space, read once until `forget` is called.

    A hidden head throws a shadow where its splats are visible.
    """

    def __init__(self) -> None:
        self._read: list[tuple[Any, Caster]] | None = None
        self._placed: dict[tuple[Any, bytes], tuple[Caster, ...]] = {}

    def forget(self) -> None:
        """The scene has changed."""
        self._read = None
        self._placed.clear()

    def of(
        self, head: Any, to_world: np.ndarray, visible: Iterable[tuple[Any, Any]], depsgraph: Any
    ) -> tuple[Caster, ...]:
        """Those that throw shadows onto `head`, in the space that `to_world` (4, 4) takes to the
        world; the same objects until the scene changes.

        visible: objects and their matrices, as of `visible_objects`.
        """
        if self._read is None:
            self._read = list(_casters(visible, depsgraph))
        key = head, to_world.tobytes()
        if key not in self._placed:
            others = [caster for owner, caster in self._read if owner != head]
            to_avatar = np.linalg.inv(to_world)
            self._placed[key] = tuple(_moved(caster, to_avatar) for caster in others)
        return self._placed[key]


def _casters(visible: Iterable[tuple[Any, Any]], depsgraph: Any) -> Iterable[tuple[Any, Caster]]:
    """Each object that throws shadows, and its mesh in world space."""
    heads = set()
    for each, matrix in visible:
        if each.get(tags.KIND) == tags.SPLATS:
            head = get_input(each, splat_nodes.HEAD) if tags.CONVENTION in each else None
            if head is not None and head not in heads:
                heads.add(head)
                local = head.evaluated_get(depsgraph).matrix_world
                # instances move splats and head together
                placed = each.evaluated_get(depsgraph).matrix_world
                yield head, _read(head, matrix @ placed.inverted_safe() @ local, depsgraph)
        elif each.type == "MESH" and each.visible_shadow and each.get(tags.KIND) != tags.HEAD:
            yield each, _read(each, matrix, depsgraph)


def _read(owner: Any, matrix: Any, depsgraph: Any) -> Caster:
    mesh = owner.evaluated_get(depsgraph).data
    mesh.calc_loop_triangles()
    faces = read_values(mesh.loop_triangles, "vertices", 3, np.int32)
    caster = Caster(mesh_vertices(mesh).astype(np.float64), faces)
    return _moved(caster, np.array(matrix, np.float64))


def _moved(caster: Caster, matrix: np.ndarray) -> Caster:
    return Caster(caster.vertices @ matrix[:3, :3].T + matrix[:3, 3], caster.faces)


HIDDEN_RAYS = ("camera", "diffuse", "glossy", "transmission", "volume_scatter")
"""Rays that do not see a head which only throws shadows."""


def throws_shadow(splat_object: Any) -> bool:
    """Whether a splat object's head throws its shadow in images, and is not seen."""
    head = get_input(splat_object, splat_nodes.HEAD)
    is_hidden = head is None or head.hide_render or head.visible_camera
    return not is_hidden and bool(head.visible_shadow)


def throw_shadow(splat_object: Any, is_on: bool) -> None:
    """Let the head throw its shadow onto the scene unseen, or hide it from images again."""
    head = get_input(splat_object, splat_nodes.HEAD)
    head.hide_render = not is_on
    head.visible_shadow = True
    for ray in HIDDEN_RAYS:
        setattr(head, f"visible_{ray}", not is_on)
