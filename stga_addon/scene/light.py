"""Blender's lights and worlds as values, how a scene lights its avatars, and heads' shadows."""
# mypy: disable-error-code="valid-type"

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Euler

from ..avatar.file import Avatar
from ..capture.color import srgb_to_linear
from ..light.environment import split_environment
from ..light.harmonics import rotated, uniform
from ..light.relight import Relighter
from ..light.values import SKIN_ROUGHNESS, Caster, Light, Lighting
from . import tags
from .arrays import mesh_vertices, read_values
from .compat import light_strength, shader_nodes
from .display.splat_object import followed_head
from .layers import Relit

PROPERTY = "stga_lighting"  # the scene's `LightingSettings`
MODE_CHANGED: list[Callable[[Any], None]] = []  # what is called with a scene whose mode was chosen


def _mode_changed(settings: Any, context: Any) -> None:
    for call in MODE_CHANGED:
        call(settings.id_data)


class LightingSettings(bpy.types.PropertyGroup):  # type: ignore[misc]
    """Settings of the panel *Lighting*, one group for each scene."""

    mode: bpy.props.EnumProperty(
        name="Lighting",
        description="Which light avatars show",
        items=(
            ("recorded", "As Recorded", "The light of the capture: colors as trained"),
            ("scene", "Scene", "The scene's lights and world"),
            ("mix", "Mix", "Between both"),
        ),
        update=_mode_changed,
    )
    mix: bpy.props.FloatProperty(
        name="Mix",
        description="Fraction of the scene's light",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    exposure: bpy.props.FloatProperty(
        name="Exposure",
        soft_min=-4.0,
        soft_max=4.0,
        description="Stops by which relit avatars are brighter: the absolute level of a capture's "
        "light is not known",
    )
    white: bpy.props.FloatVectorProperty(
        name="White",
        subtype="COLOR",
        size=3,
        default=(1.0, 1.0, 1.0),
        min=0.0,
        max=1.0,
        description="What should be white or gray on the avatar; its tint is taken away. Pick it "
        "with the eyedropper from the avatar as recorded",
    )
    roughness: bpy.props.FloatProperty(
        name="Roughness",
        description="Of highlights on skin",
        default=SKIN_ROUGHNESS,
        min=0.05,
        max=1.0,
    )
    specular: bpy.props.FloatProperty(
        name="Highlights",
        description="Factor of highlights; 0: none",
        default=1.0,
        min=0.0,
        soft_max=2.0,
    )
    shadows: bpy.props.BoolProperty(
        name="Shadows",
        description="Lights are blocked by the head and by other objects",
        default=True,
    )
    world: bpy.props.BoolProperty(
        name="World", description="The scene's world lights avatars, too", default=True
    )
    lights: bpy.props.PointerProperty(
        name="Lights",
        type=bpy.types.Collection,
        description="Only the lights of this collection light avatars; empty: all",
    )


def lighting_settings(scene: Any) -> Any:
    """The scene's `LightingSettings`; None where the add-on is not registered."""
    return getattr(scene, PROPERTY, None)


def settings_values(scene: Any) -> tuple[Any, ...]:
    """The values of the scene's `LightingSettings`, to compare."""
    settings = lighting_settings(scene)
    if settings is None:
        return ()
    others = [name for name in LightingSettings.__annotations__ if name != "white"]
    return tuple(settings.white), *(getattr(settings, name) for name in others)


def _surface_node(tree: Any) -> Any:
    """The shader that a light's or world's node tree ends in; None where nothing is linked."""
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    return links[0].from_node if links else None


def light_of(light: Any, matrix: Any) -> Light | None:
    """A light's evaluated data at a world matrix; None without light. Its node tree counts as far
    as it is one Emission node of constants."""
    to_world = np.array(matrix, np.float64)
    scale = np.linalg.norm(to_world[:3, :3], axis=0)
    axes = to_world[:3, :3] / np.maximum(scale, 1e-12)
    fields: dict[str, Any] = {}
    if light.type == "SUN":
        fields["angle"] = light.angle
        area = np.pi * np.tan(light.angle / 2) ** 2
    elif light.type == "AREA":
        height = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size
        is_round = light.shape in ("DISK", "ELLIPSE")
        fields["size"] = width, height = float(light.size * scale[0]), float(height * scale[1])
        fields |= {"tangent": axes[:, 0], "shape": "ellipse" if is_round else "rectangle"}
        area = width * height * (np.pi / 4 if is_round else 1.0)
    else:
        fields["radius"] = light.shadow_soft_size
        area = np.pi * light.shadow_soft_size**2
        if light.type == "SPOT":
            fields |= {"cone": light.spot_size, "blend": light.spot_blend}
    color = light_strength(light, area)
    shader = _surface_node(shader_nodes(light))
    if shader is not None and shader.type == "EMISSION":
        emitted, strength = (shader.inputs[name] for name in ("Color", "Strength"))
        color = color * np.array(emitted.default_value[:3]) * strength.default_value
    if not color.any() or not np.isfinite(color).all():
        return None
    return Light(
        light.type.lower(),
        color,
        position=to_world[:3, 3],
        direction=-axes[:, 2],
        casts_shadow=bool(light.use_shadow),
        diffuse=light.diffuse_factor,
        specular=light.specular_factor,
        **fields,
    )


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
    entries = zip(collection.collection_objects, collection.objects, strict=False)
    members = [(entry.light_linking.link_state, {member}) for entry, member in entries]
    entries = zip(collection.collection_children, collection.children, strict=False)
    members += [(e.light_linking.link_state, set(child.all_objects)) for e, child in entries]
    named = [next((state for state, those in members if each in those), "") for each in receivers]
    includes = any(state == "INCLUDE" for state, _ in members)
    return "EXCLUDE" not in named and ("INCLUDE" in named or not includes)


class WorldLight(NamedTuple):
    """What a world's light depends on. color: scene-linear, times strength; of a texture, a factor.
    rotation (9,): row by row, from directions of the world to the texture's."""

    color: tuple[float, ...]
    image: Any = None
    rotation: tuple[float, ...] = ()


def world_light(world: Any) -> WorldLight | None:
    """The light of a world, one color or an environment texture; None for other nodes."""
    tree = shader_nodes(world) if world is not None else None
    if world is not None and tree is None:
        return WorldLight(tuple(world.color))
    background = _surface_node(tree)
    if background is None:
        return WorldLight((0.0, 0.0, 0.0))
    if background.type != "BACKGROUND" or background.inputs["Strength"].is_linked:
        return None
    strength = background.inputs["Strength"].default_value
    color = background.inputs["Color"]
    if not color.is_linked:
        return WorldLight(tuple(channel * strength for channel in color.default_value[:3]))
    texture = color.links[0].from_node
    if texture.type != "TEX_ENVIRONMENT" or texture.image is None:
        return None
    links = texture.inputs["Vector"].links
    turn = np.eye(3)
    if links and (node := links[0].from_node).type != "TEX_COORD":
        source = node.inputs["Vector"].links if node.type == "MAPPING" else ()
        if not source or source[0].from_node.type != "TEX_COORD":
            return None
        if node.inputs["Rotation"].is_linked:
            return None
        turn = np.array(Euler(node.inputs["Rotation"].default_value).to_matrix())
        turn = turn.T if node.vector_type == "TEXTURE" else turn
    is_flat = texture.projection == "EQUIRECTANGULAR"
    rotation = tuple(turn.ravel().tolist())
    return WorldLight((strength,) * 3, texture.image, rotation) if is_flat else None


MAX_KEPT = 64


class PosedAvatar(NamedTuple):
    """An avatar on its head in a frame.

    splat_object, head  original objects
    vertices  (V, 3) of the head, in the avatar's space
    to_world  (4, 4) from that space
    """

    splat_object: Any
    head: Any
    avatar: Avatar
    vertices: np.ndarray
    to_world: np.ndarray


class SceneLight:
    """What is kept between redraws, so that nothing is computed while nothing moves."""

    def __init__(self) -> None:
        self._casters: list[tuple[Any, Caster]] | None = None
        self._placed: dict[tuple[Any, bytes], tuple[Caster, ...]] = {}
        self._relighters: dict[int, Relighter] = {}
        self._relit: dict[tuple[int, bytes], tuple[Any, Relit]] = {}
        self._worlds: dict[WorldLight, tuple[np.ndarray, tuple[Light, ...]]] = {}

    def forget_casters(self) -> None:
        """The scene has changed: read the meshes that throw shadows again."""
        self._casters = None
        self._placed.clear()

    def relit(
        self,
        posed: PosedAvatar,
        find_visible: Callable[[], Sequence[tuple[Any, Any]]],
        depsgraph: Any,
    ) -> Relit | None:
        """How the scene lights an avatar, None where colors are as recorded; the same object while
        all is the same, `posed.vertices` by identity. find_visible: objects and their matrices."""
        # A change of the settings of a viewport does not evaluate its scene anew.
        is_viewport = depsgraph.mode == "VIEWPORT"
        settings = lighting_settings(depsgraph.scene if is_viewport else depsgraph.scene_eval)
        if posed.avatar.light is None or settings is None or settings.mode == "recorded":
            return None
        visible = find_visible()
        to_world = posed.to_world
        receivers = posed.splat_object, posed.head
        lighting = self._lighting(settings, receivers, to_world, visible, depsgraph)
        casters: tuple[Caster, ...] = ()
        if lighting.shadows:
            if self._casters is None:
                self._casters = list(_casters(visible, depsgraph))
            place = posed.head, to_world.tobytes()
            if place not in self._placed:
                others = [caster for owner, caster in self._casters if owner != posed.head]
                to_avatar = np.linalg.inv(to_world)
                self._placed[place] = tuple(_moved(caster, to_avatar) for caster in others)
            casters = self._placed[place]
        uid = posed.splat_object.session_uid
        relighter = self._relighters.get(uid)
        if relighter is None or relighter.avatar is not posed.avatar:
            relighter = self._relighters[uid] = Relighter(posed.avatar)
        # Equal for lightings of the same values.
        values = [value for name, value in vars(lighting).items() if name != "lights"]
        values += [value for light in lighting.lights for value in vars(light).values()]
        same = [each.tobytes() if isinstance(each, np.ndarray) else each for each in values]
        key = (*same, id(relighter), id(posed.vertices), id(casters))
        place = (uid, to_world.tobytes())
        known = self._relit.get(place)
        if known is None or known[0] != key:
            if len(self._relit) > MAX_KEPT:  # objects that move leave an entry at each place
                self._relit.clear()
            known = self._relit[place] = key, Relit(relighter, posed.vertices, lighting, casters)
        return known[1]

    def _lighting(
        self,
        settings: Any,
        receivers: tuple[Any, ...],
        to_world: np.ndarray,
        visible: Sequence[tuple[Any, Any]],
        depsgraph: Any,
    ) -> Lighting:
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
        names = "mode", "mix", "exposure", "roughness", "specular", "shadows"
        chosen = {name: getattr(settings, name) for name in names}
        world = np.zeros((9, 3))  # also for nodes that are not understood
        outside = world_light(depsgraph.scene_eval.world) if settings.world else None
        if outside is not None and outside.image is None:
            world = uniform(outside.color)
        elif outside is not None:
            outside = outside._replace(image=outside.image.original)
            if outside not in self._worlds:
                image = outside.image
                pixels = np.zeros((2, 4, 3), np.float32)  # black where a file is missing
                width, height = image.size
                if width and height and image.channels >= 3:
                    pixels = np.empty((height, width, image.channels), np.float32)
                    image.pixels.foreach_get(pixels.ravel())
                linear = pixels[::-1, :, :3]
                if not image.is_float and image.colorspace_settings.name == "sRGB":
                    linear = srgb_to_linear(linear)
                turn = np.reshape(outside.rotation, (3, 3)).T
                self._worlds = {outside: split_environment(linear * outside.color, turn)}
            world, suns = self._worlds[outside]
            u, _, v = np.linalg.svd(to_world[:3, :3])
            world = rotated(world, (u @ v).T)
            lights += [in_avatar_space(sun, to_world) for sun in suns]
        return Lighting(world=world, lights=tuple(lights), white=(red, green, blue), **chosen)


def _casters(visible: Iterable[tuple[Any, Any]], depsgraph: Any) -> Iterable[tuple[Any, Caster]]:
    """Each object that throws shadows, with its mesh in world space; hidden heads of visible splats
    do."""
    heads = set()
    for each, matrix in visible:
        if tags.is_splats(each):
            head = followed_head(each)
            if head is not None and head not in heads:
                heads.add(head)
                local = head.evaluated_get(depsgraph).matrix_world
                # instances move splats and head together
                placed = each.evaluated_get(depsgraph).matrix_world
                yield head, _read(head, matrix @ placed.inverted_safe() @ local, depsgraph)
        elif each.type == "MESH" and each.visible_shadow and not tags.is_head(each):
            yield each, _read(each, matrix, depsgraph)


def _read(owner: Any, matrix: Any, depsgraph: Any) -> Caster:
    mesh = owner.evaluated_get(depsgraph).data
    mesh.calc_loop_triangles()
    faces = read_values(mesh.loop_triangles, "vertices", 3, np.int32)
    caster = Caster(mesh_vertices(mesh).astype(np.float64), faces)
    return _moved(caster, np.array(matrix, np.float64))


def _moved(caster: Caster, matrix: np.ndarray) -> Caster:
    return Caster(caster.vertices @ matrix[:3, :3].T + matrix[:3, 3], caster.faces)


def throws_shadow(splat_object: Any) -> bool:
    """Whether a splat object's head throws its shadow in images, and is not seen."""
    head = followed_head(splat_object)
    is_hidden = head is None or head.hide_render or head.visible_camera
    return not is_hidden and bool(head.visible_shadow)


def throw_shadow(splat_object: Any, is_on: bool) -> None:
    """Let the head throw its shadow onto the scene unseen, or hide it from images again."""
    head = followed_head(splat_object)
    head.hide_render = not is_on
    head.visible_shadow = True
    for ray in ("camera", "diffuse", "glossy", "transmission", "volume_scatter"):
        setattr(head, f"visible_{ray}", not is_on)


def register() -> None:
    bpy.utils.register_class(LightingSettings)
    setattr(bpy.types.Scene, PROPERTY, bpy.props.PointerProperty(type=LightingSettings))


def unregister() -> None:
    delattr(bpy.types.Scene, PROPERTY)
    bpy.utils.unregister_class(LightingSettings)
