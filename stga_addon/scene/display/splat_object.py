"""Splat objects: the Blender objects that display avatars and world-space splats."""

import re
from collections.abc import Iterable
from typing import Any
from uuid import uuid4

import bpy
import numpy as np

from ...avatar.file import UNSEEN_REGION, Avatar, AvatarLight
from ...avatar.observed import FROM_ALL_SIDES, observed_sides
from ...avatar.offsets import OFFSETS
from ...avatar.splats import Splats
from ...errors import StgaError
from .. import compat, tags
from ..arrays import has_triangles, mesh_triangles, mesh_vertices, triangle_mesh
from ..compat import animation_curves, modifier_input, set_modifier_input
from ..layers import DisplaySettings
from ..objects import collections_of, lock, remove
from . import splat_attributes as stored
from . import splat_nodes
from .frame_nodes import SIGNALS
from .lit_nodes import SCENE_LIGHT
from .node_builder import VERSION, find_tree, is_current
from .splat_attributes import SplatAttributes, avatar_attributes
from .splat_nodes import NATIVE, QUADS


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where the view transform changes colors in EEVEE and Cycles, else None."""
    name = scene.view_settings.view_transform
    return None if name == "Standard" else f"View transform {name} changes colors; choose Standard"


def shows_nodes(scene: bpy.types.Scene) -> bool:
    """Whether EEVEE or Cycles renders, which show what geometry nodes make of splats."""
    return scene.render.engine == "CYCLES" or scene.render.engine.startswith("BLENDER_EEVEE")


def use_transparent_bounces(scene: bpy.types.Scene) -> None:
    """Let Cycles, where enabled, see through overlapping splats; higher limits stay."""
    cycles = getattr(scene, "cycles", None)
    for limit in ("transparent_max_bounces", "min_transparent_bounces") if cycles else ():
        # layers of splats; behind Cycles' default of 8 is black
        setattr(cycles, limit, max(getattr(cycles, limit), 64))


SETTINGS = {getattr(splat_nodes, name.upper()): name for name in DisplaySettings.__annotations__}
"""Inputs of the splat modifier -> fields of `DisplaySettings`."""


def show_avatar(
    avatar: Avatar,
    head: Any,
    name: str | None = None,
    prepared: SplatAttributes | None = None,
    replaced: Any = None,
    scene: Any = None,
) -> Any:
    """Show the avatar by a splat object that follows the evaluated mesh of the object `head`, which
    has the avatar's triangles, else StgaError. prepared: `avatar_attributes` of the avatar.
    replaced: the splat object to show it by, which keeps its name, place, visibility, display
    settings and keyframes; None: a new one. scene: where all collections of the head are linked."""
    check_head(avatar, head)
    prepared = prepared or avatar_attributes(avatar)
    title = name or f"{head.name} splats"
    splat_object = replaced
    if splat_object is None:
        scene = scene or bpy.context.scene
        local = [each for each in collections_of(head) if each.library is None]
        splat_object = _splat_object(title, [*local, scene.collection][0], _tree_options(avatar))
        # A sibling of the head: both have the same object space.
        splat_object.parent = head.parent
        splat_object.matrix_parent_inverse = head.matrix_parent_inverse
        splat_object.matrix_basis = head.matrix_basis
        lock(splat_object)
    else:
        _exchange_tree(splat_object, splat_nodes.splat_tree(_tree_options(avatar)))
    splat_object[tags.CONVENTION] = avatar.convention
    splat_object[tags.ANTIALIASED] = avatar.antialiased
    splat_object[tags.OBSERVED] = observed_sides(avatar)
    set_input(splat_object, splat_nodes.HEAD, head)
    before = get_input(splat_object, splat_nodes.NEUTRAL)
    # In no collection: it is never displayed, and exists as long as the splats that point to it.
    mesh = triangle_mesh(f"{splat_object.name} neutral", avatar.neutral, avatar.faces)
    neutral = bpy.data.objects.new(mesh.name, mesh)
    neutral.hide_render = neutral.hide_viewport = True  # appended, it comes into a collection
    set_input(splat_object, splat_nodes.NEUTRAL, neutral)
    if before is not None and before.users == 0:
        remove([before])
    for using_scene in splat_object.users_scene:
        use_transparent_bounces(using_scene)
    splat_object.data.clear_geometry()  # also of attributes that only the avatar before has
    update_splats(splat_object, prepared)
    return splat_object


def _exchange_tree(splat_object: Any, tree: Any) -> None:
    """Show the splats by another node tree; inputs keep their values and keyframes by name."""
    replace_native_splats([splat_object])  # a mode that the other tree lacks
    modifier = splat_modifier(splat_object)
    before = input_identifiers(modifier)
    values = {name: modifier_input(modifier, identifier) for name, identifier in before.items()}
    modifier.node_group = tree
    _set_menus(splat_object)
    after = input_identifiers(modifier)
    for name in values.keys() & after.keys():
        set_modifier_input(modifier, after[name], values[name])
    renamed = {old: after.get(name, name) for name, old in before.items()}
    place = f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"]'
    for curve in animation_curves(splat_object):
        if curve.data_path.startswith(place):
            inside = curve.data_path[len(place) :]
            moved = re.sub(r"Socket_\d+", lambda found: renamed.get(found[0], found[0]), inside)
            curve.data_path = place + moved


def splats_of(head: Any, scene: Any, linked: bool = False) -> list[Any]:
    """The splat objects of the scene that follow the head and can be changed, or are linked."""
    splats = [each for each in scene.objects if tags.CONVENTION in each]
    wanted = [each for each in splats if (each.library is not None) == linked]
    return [each for each in wanted if followed_head(each) == head]


def check_editable_data(splat_object: Any) -> None:
    """Raise StgaError where a splat object's splats are in another file: others would be gone after
    reopening."""
    data = splat_object.data
    if data.library is not None or data.override_library is not None:
        problem = "has its splats in another file, and Blender would not save others"
        raise StgaError(f"{splat_object.name}: {problem}; open that file, or make its mesh local")


def show_world_splats(splats: Splats, name: str, scene: Any = None) -> Any:
    """Make a splat object of a world-space set, for example a standard 3DGS PLY, in a scene (None:
    the context's); returns it."""
    options = splat_nodes.TreeOptions(None, splats.sh_degree)
    splat_object = _splat_object(name, (scene or bpy.context.scene).collection, options)
    stored.write_splats(splat_object.data, stored.splat_attributes(splats))
    return splat_object


def can_update(splat_object: Any, avatar: Avatar) -> bool:
    """Whether the avatar differs from this object's only in splats and how they follow the mesh."""
    neutral = _stored_neutral(splat_object)
    if neutral is None or not has_triangles(neutral, avatar.faces):
        return False
    kind = splat_object.get(tags.CONVENTION), splat_object.get(tags.ANTIALIASED)
    tree = find_tree(_tree_options(avatar).tree_name)
    is_same = kind == (avatar.convention, avatar.antialiased)
    is_same &= np.array_equal(mesh_vertices(neutral), avatar.neutral.astype(np.float32))
    return bool(is_same and splat_modifier(splat_object).node_group == tree)


def _stored_neutral(splat_object: Any) -> Any:
    """The neutral mesh; None for splats without one, or an object without a modifier."""
    neutral = get_input(splat_object, splat_nodes.NEUTRAL)
    return None if neutral is None else neutral.data


def _unshared_neutral(splat_object: Any) -> Any:
    """The neutral mesh to write into: a new one where other splats, as those of a duplicate that
    is kept, have the same."""
    neutral = get_input(splat_object, splat_nodes.NEUTRAL)
    others = [each for each in bpy.data.objects if tags.CONVENTION in each]
    sharing = [each for each in others if _stored_neutral(each) == neutral.data]
    local = [each for each in sharing if each.data == splat_object.data and each.library is None]
    if len(local) < len(sharing):
        neutral = neutral.copy()
        neutral.data = neutral.data.copy()
        for each in local:
            set_input(each, splat_nodes.NEUTRAL, neutral)
    return neutral.data


def update_splats(splat_object: Any, prepared: SplatAttributes) -> None:
    """Show other splats in the same object. prepared: `avatar_attributes` where `can_update` is
    true."""
    neutral = _unshared_neutral(splat_object)
    stored.write_attributes(neutral, prepared.neutral, "FACE")
    stored.write_light(neutral, prepared.light)
    neutral.update()
    stored.write_splats(splat_object.data, prepared.splats)


def store_light(splat_object: Any, avatar: Avatar) -> bool:
    """Give the object the light of the same avatar; False where it shows another one."""
    neutral = _stored_neutral(splat_object)
    count = len(splat_object.data.vertices)
    if neutral is None or not has_triangles(neutral, avatar.faces) or count != len(avatar.splats):
        return False
    stored.write_light(_unshared_neutral(splat_object), avatar.light)
    stored.write_attributes(splat_object.data, stored.albedo_attribute(avatar), "POINT")
    splat_object.data.update()
    splat_object.data[tags.REVISION] = uuid4().hex  # what was read of it before is out of date
    return True


def store_linear_base(splat_object: Any, avatar: Avatar) -> bool:
    """Give the object the colors for linear light of the same avatar; False where it shows
    another one."""
    splats = stored_avatar(splat_object).splats
    known = avatar.splats
    if len(splats) != len(known) or not np.array_equal(splats.sh[:, 0], known.sh[:, 0]):
        return False
    stored.write_attributes(splat_object.data, stored.linear_attributes(avatar), "POINT")
    splat_object.data.update()
    return True


def stored_light(splat_object: Any) -> AvatarLight | None:
    """The light of the object's avatar; None without one, or without a modifier."""
    neutral = _stored_neutral(splat_object)
    return None if neutral is None else stored.read_light(neutral)


def build_next_node_group(avatar: Avatar) -> bool:
    """Build one node group that `show_avatar` needs; False if all exist (see `splat_nodes`)."""
    return splat_nodes.build_next_node_group(_tree_options(avatar))


def check_head(avatar: Avatar, head: Any) -> None:
    """Raise StgaError unless `head` is a mesh object with just the avatar's triangles."""
    if head is None or head.type != "MESH":
        raise StgaError("head: expected a mesh object that the avatar's splats can follow")
    if not has_triangles(head.data, avatar.faces):
        raise StgaError(
            f"head {head.name}: the avatar was trained on {len(avatar.faces)} triangles of "
            f"another mesh, this one has {len(head.data.polygons)} faces, or another order"
        )


def hide_object(obj: Any, scene: Any) -> None:
    """Hide an object, such as a head that covers its splats, wherever it is appended, linked or
    instanced. Linked ones are hidden in the scene's viewports only: they still render."""
    if obj.library is None:
        obj.hide_render = obj.hide_viewport = True
    else:
        hide_in_layers(obj, scene)


def hide_covered(splat_object: Any, scene: Any) -> None:
    """Hide what covers splats that were appended or linked: their head, where its file hides it in
    images, and their neutral mesh."""
    neutral = get_input(splat_object, splat_nodes.NEUTRAL)
    for each in (followed_head(splat_object), neutral):
        if each is not None and (each.hide_render or each is neutral):
            hide_object(each, scene)


def hide_in_layers(obj: Any, scene: Any) -> None:
    """Hide an object in the scene's viewports."""
    for layer in scene.view_layers:
        if layer.objects.get(obj.name) is obj:
            obj.hide_set(True, view_layer=layer)


def splat_modifier(splat_object: Any) -> Any:
    """The geometry nodes modifier that shows the splats. Raises StgaError without one."""
    for modifier in splat_object.modifiers if splat_object is not None else ():
        tree = modifier.node_group if modifier.type == "NODES" else None
        if tree is not None and VERSION in tree and tree.is_modifier:  # of any version
            return modifier
    raise StgaError(f"{getattr(splat_object, 'name', None)}: is not an object that shows splats")


def later_modifiers(splat_object: Any) -> list[Any]:
    """The modifiers after ours that change what viewports show of the splats."""
    last = [*splat_object.modifiers].index(splat_modifier(splat_object))
    return [each for each in splat_object.modifiers[last + 1 :] if each.show_viewport]


def is_partly_observed(splat_object: Any) -> bool:
    """Whether some of its splats are on sides of the head that no camera saw."""
    return splat_object.get(tags.OBSERVED, "") not in ("", FROM_ALL_SIDES)


def triangles_hint(splat_object: Any, depsgraph: Any) -> str | None:
    """A sentence where a head has lost the vertices that the splats are bound to, or None."""
    head = followed_head(splat_object)
    neutral = get_input(splat_object, splat_nodes.NEUTRAL)
    if head is None or neutral is None:
        return None
    evaluated_head = head.evaluated_get(depsgraph)
    if evaluated_head.type == "MESH" and len(evaluated_head.data.vertices) >= len(
        neutral.data.vertices
    ):
        return None
    follower = splat_object.name
    return (
        f"{head.name}: has other triangles than {follower}, which follows it; check its modifiers"
    )


def set_input(splat_object: Any, name: str, value: Any) -> None:
    """Set an input of the splat modifier by its displayed name. Raises StgaError where it has
    none."""
    modifier = splat_modifier(splat_object)
    identifier = input_identifier(modifier, name)
    if identifier is None:
        raise StgaError(f"{splat_object.name}: has no display setting {name!r}")
    set_modifier_input(modifier, identifier, value)


def get_input(splat_object: Any, name: str) -> Any:
    """An input of the splat modifier by its displayed name; None where it has no such input, or the
    object, which may be None, has lost that modifier."""
    try:
        modifier = splat_modifier(splat_object)
    except StgaError:
        return None
    identifier = input_identifier(modifier, name)
    return None if identifier is None else modifier_input(modifier, identifier)


def followed_head(splat_object: Any) -> Any:
    """The head that the splats follow, or None."""
    return get_input(splat_object, splat_nodes.HEAD)


def input_identifier(modifier: Any, name: str) -> str | None:
    """Identifier ("Socket_2") of a modifier's input by its displayed name, or None."""
    return input_identifiers(modifier).get(name)


def input_identifiers(modifier: Any) -> dict[str, str]:
    """Displayed name -> identifier of a modifier's inputs, less the geometry."""
    items = [each for each in modifier.node_group.interface.items_tree if each.in_out == "INPUT"]
    plain = [each for each in items if each.socket_type != "NodeSocketGeometry"]
    return {str(each.name): str(each.identifier) for each in plain}


def display_mode(splat_object: Any) -> str:
    """The display mode that is chosen for a splat object, a name in `LIMITS`."""
    return get_input(splat_object, splat_nodes.DISPLAY) or ""


def is_lit(splat_object: Any) -> bool:
    """Whether the scene's light falls on it in EEVEE and Cycles."""
    light = get_input(splat_object, splat_nodes.NATIVE_LIGHT)
    return light == SCENE_LIGHT and display_mode(splat_object) == NATIVE


def choose_display(splat_object: Any, mode: str) -> None:
    """Show splats in a display mode, a name in `LIMITS`. A node tree that is not of this version,
    and may lack the mode, is built again. Raises StgaError where `stored_avatar` does."""
    if not is_current(splat_modifier(splat_object).node_group):
        if tags.CONVENTION in splat_object:
            options = _tree_options(stored_avatar(splat_object))
        else:
            degree = stored.read_splats(splat_object.data).sh_degree
            options = splat_nodes.TreeOptions(None, degree)
        _exchange_tree(splat_object, splat_nodes.splat_tree(options))
    set_input(splat_object, splat_nodes.DISPLAY, mode)


def replace_native_splats(objects: Iterable[Any]) -> str:
    """Show camera quads where a file from a newer Blender has native splats, which this Blender
    would show as nothing; a sentence that says so, "" where there are none."""
    if compat.NATIVE_SPLATS:
        return ""
    messages = []
    for each in objects:
        if not tags.is_splats(each) or display_mode(each) != NATIVE:
            continue
        if each.library is None:
            set_input(each, splat_nodes.DISPLAY, QUADS)
            messages.append(f"{each.name} is displayed as {QUADS}")
        else:
            messages.append(f"{each.name} is linked, and not displayed")
    return "; ".join([*messages, "native splats need Blender 5.3 or newer"]) if messages else ""


def _set_menus(splat_object: Any) -> None:
    """Their defaults reach a modifier in some versions only."""
    for name, value in splat_nodes.MENUS.items():
        if input_identifier(splat_modifier(splat_object), name) is not None:
            set_input(splat_object, name, value)


def display_settings(modifier: Any) -> DisplaySettings:
    """The settings by a `splat_modifier`; defaults for those that its splats lack."""
    items = [each for each in modifier.node_group.interface.items_tree if each.name in SETTINGS]
    values = {SETTINGS[item.name]: modifier_input(modifier, item.identifier) for item in items}
    return DisplaySettings(**values)


def stored_avatar(splat_object: Any) -> Avatar:
    """The avatar of `show_avatar`, with unit rotations; of regions, the unseen triangles that have
    splats."""
    splat_modifier(splat_object)
    neutral = _stored_neutral(splat_object)
    if neutral is None:
        raise StgaError(f"{splat_object.name}: its neutral mesh is missing; show the avatar again")
    splats = stored.read_splats(splat_object.data)
    faces = mesh_triangles(neutral)
    unseen = stored.read_unseen(splat_object.data)
    regions = {}
    if unseen is not None:
        regions[UNSEEN_REGION] = np.isin(np.arange(len(faces)), splats.face[unseen])
    return Avatar(
        splats=splats,
        convention=splat_object[tags.CONVENTION],
        neutral=mesh_vertices(neutral),
        faces=faces,
        regions=regions,
        antialiased=bool(splat_object[tags.ANTIALIASED]),
        strain_range=stored.read_strain_range(neutral),
        driven_offsets=stored.read_driven_offsets(neutral),
        light=stored.read_light(neutral),
        linear_base=stored.read_linear_base(splat_object.data),
    )


def _splat_object(name: str, collection: Any, options: splat_nodes.TreeOptions) -> Any:
    splat_object = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    splat_object[tags.KIND] = tags.SPLATS
    collection.objects.link(splat_object)
    splat_object.modifiers.new("STGA Splats", "NODES").node_group = splat_nodes.splat_tree(options)
    _set_menus(splat_object)
    for scene in splat_object.users_scene:
        use_transparent_bounces(scene)
    return splat_object


def _tree_options(avatar: Avatar) -> splat_nodes.TreeOptions:
    names = [name for name, offset in OFFSETS.items() if offset.signal in SIGNALS]
    offsets = tuple(name for name in names if name in avatar.driven_offsets)
    return splat_nodes.TreeOptions(avatar.convention, avatar.splats.sh_degree, offsets)
