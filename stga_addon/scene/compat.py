"""Differences between Blender 4.2 and 5.3: every version switch of the add-on."""

import hashlib
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import bpy
import numpy as np

from ..driving.performance import ARKIT_SHAPES
from ..flame.model import JOINTS
from . import tags

SLOTTED_ACTIONS = bpy.app.version >= (4, 4, 0)
"""Whether actions have slots, layers and strips: from 4.4 on."""
MODIFIER_INPUT_PROPERTIES = bpy.app.version >= (5, 2, 0)
"""Whether the inputs of a geometry nodes modifier are in `modifier.properties.inputs`: from 5.2
on."""
EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
"""Identifier of EEVEE among render engines, which 4.2 to 4.5 call EEVEE Next."""
NATIVE_SPLATS = hasattr(bpy.types, "GeometryNodePointsSetType")
"""Whether Blender draws Gaussian splats itself: from 5.3 on."""
WARNING_NODE = hasattr(bpy.types, "GeometryNodeWarning")
"""Whether geometry nodes can show a warning on their modifier: from 4.3 on."""
APPENDED: list[Any] = getattr(bpy.app.handlers, "blend_import_post", [])
"""Handlers after an append or link: from 4.3 on, else a list that nobody calls."""
SAVE_FAILED: list[Any] = getattr(bpy.app.handlers, "save_post_fail", [])
"""Handlers after a file could not be saved: from 4.0 on."""
MOTION_BLUR = tuple(
    name
    for name in ("use_motion_blur", "motion_blur_shutter", "motion_blur_position")
    if name in bpy.types.RenderSettings.bl_rna.properties
)
"""Settings of motion blur; the position of the shutter was of Cycles alone in older versions."""
REC709 = "Linear Rec.709"
"""The scene-linear color space of new files, and of all before Blender 5.0."""
# Options of a path property whose value may start with "//"; versions before 4.5 refuse this one.
PATH_OPTIONS = (
    {"PATH_SUPPORTS_BLEND_RELATIVE"}
    if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
    else set()
)


def stored_value(settings: Any, name: str) -> str:
    """What a file stores of a text property that has become one with functions; "" for nothing."""
    if hasattr(settings, "bl_system_properties_get"):  # from 5.0 on
        settings = settings.bl_system_properties_get()
    return "" if settings is None else str(settings.get(name, ""))


def action_curves(owner: Any) -> Any:
    """The f-curves that animate the data-block `owner`, whose action (and slot) is made where
    missing."""
    animation = owner.animation_data_create()
    if animation.action is None:
        animation.action = bpy.data.actions.new(f"{owner.name} action")
    action = animation.action
    if not SLOTTED_ACTIONS:
        return action.fcurves
    if animation.action_slot is None:
        animation.action_slot = action.slots.new(id_type=owner.id_type, name=owner.name)
    return _slot_curves(action, animation.action_slot)


def new_action_curves(action: Any, id_type: str, name: str) -> Any:
    """The f-curves of a new slot of an action for a kind of data-block ("OBJECT", "KEY"); of
    all kinds where actions have no slots."""
    if not SLOTTED_ACTIONS:
        return action.fcurves
    return _slot_curves(action, action.slots.new(id_type=id_type, name=name))


def _slot_curves(action: Any, slot: Any) -> Any:
    layer = action.layers[0] if action.layers else action.layers.new("Layer")
    strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
    return strip.channelbag(slot, ensure=True).fcurves


def strip_curves(strip: Any) -> Any:
    """The f-curves of an NLA strip that was an action of `action_curves`."""
    if not SLOTTED_ACTIONS:
        return strip.action.fcurves
    return strip.action.layers[0].strips[0].channelbag(strip.action_slot, ensure=True).fcurves


def all_curves(action: Any) -> list[Any]:
    """The f-curves of an action, of all slots."""
    if not SLOTTED_ACTIONS:
        return list(action.fcurves)
    bags = (bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags)
    return [curve for bag in bags for curve in bag.fcurves]


IMPORTED_CURVE = re.compile(
    rf'pose\.bones\["({"|".join(JOINTS)})"\]\.(rotation_quaternion|location)'
    rf'|key_blocks\["(t\d+|(expr_|identity_|offset_t)\d+|{"|".join(ARKIT_SHAPES)})"\]\.value'
    r'|\["stga_\w+"\]'
)
"""Data path of what an import, or a performance, keyframes; others are an artist's."""


def _is_added(curve: Any) -> bool:
    """Whether an f-curve of a rig or of shape keys moves what an artist added to them."""
    return IMPORTED_CURVE.fullmatch(curve.data_path) is None


def mark_imported(owner: Any) -> None:
    """Mark the action of `owner` as what an import has made."""
    animation = owner.animation_data
    if animation is not None and animation.action is not None:
        animation.action[tags.IMPORTED] = _digest(animation.action)


def is_made_by_hand(action: Any) -> bool:
    """Whether an action has other keyframes than an import gave it of what that moves, and other
    work is in them."""
    is_ours = tags.HELD in action or tags.PERFORMANCE in action
    return not is_ours and action.get(tags.IMPORTED) != _digest(action)


def _digest(action: Any) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for curve in all_curves(action):
        if _is_added(curve):
            continue
        places = np.empty(2 * len(curve.keyframe_points), np.float32)
        curve.keyframe_points.foreach_get("co", places)
        digest.update(f"{curve.data_path} {curve.array_index}".encode() + places.tobytes())
    return digest.hexdigest()


def animation_curves(owner: Any) -> list[Any]:
    """The f-curves and drivers that animate the data-block `owner`; nothing is made."""
    animation = owner.animation_data
    if animation is None:
        return []
    has_action = animation.action is not None
    has_action &= not SLOTTED_ACTIONS or animation.action_slot is not None
    return [*animation.drivers, *(action_curves(owner) if has_action else ())]


def copy_action(owner: Any, name: str) -> Any:
    """Give `owner` a copy of its action, or an empty one; the old one stays in the file. Returns
    the new action's f-curves."""
    animation = owner.animation_data_create()
    old = animation.action
    if old is None:
        animation.action = bpy.data.actions.new(name)
        return action_curves(owner)
    old.use_fake_user = True
    copy = old.copy()
    copy.name = name
    assign_action(animation, copy, slot_of(animation))
    return action_curves(owner)


def push_down_action(owner: Any, extrapolation: str = "HOLD") -> None:
    """Turn the action that animates `owner`, if any, into a strip on top of the NLA tracks."""
    animation = owner.animation_data
    if animation is None or animation.action is None:
        return
    action = animation.action
    slot = animation.action_slot if SLOTTED_ACTIONS else None
    animation.action = None
    track = animation.nla_tracks.new()
    track.name = action.name
    has_manual_range = action.use_frame_range
    action.use_frame_range = False  # a strip of that range leaves out the other keyframes
    strip = track.strips.new(action.name, int(np.floor(action.frame_range[0])), action)
    action.use_frame_range = has_manual_range
    # That start is a whole frame; the keyframes stay where they are.
    strip.frame_start_raw = strip.action_frame_start
    strip.frame_end_raw = strip.action_frame_end
    strip.extrapolation = extrapolation
    if slot is not None:
        strip.action_slot = slot


STRIP_FIELDS = (
    "action_frame_start",
    "action_frame_end",
    "scale",
    "repeat",
    "frame_start_raw",
    "frame_end_raw",
    "blend_type",
    "extrapolation",
    "use_auto_blend",
    "blend_in",
    "blend_out",
    "use_reverse",
    "use_animated_influence",
    "influence",
    "mute",
)
"""Fields of an NLA strip that `keep_animation` keeps, in an order in which they can be set."""


TRACK_FIELDS = ("name", "mute", "is_solo", "lock")
"""Fields of an NLA track that are kept."""
ACTION_FIELDS = ("action_blend_type", "action_extrapolation", "action_influence")
"""Kept fields that say how an owner's action acts on the strips below."""
STRIP_CURVES = ("influence", "strip_time")
"""Values of a strip that may have keyframes of their own."""
POINT_FIELDS = (
    "interpolation",
    "easing",
    "amplitude",
    "period",
    "back",
    "handle_left_type",
    "handle_right_type",
    "handle_left",
    "handle_right",
)
"""Fields of a keyframe beside its place, in an order in which they can be set."""
KeptPoint = tuple[tuple[float, float], dict[str, Any]]
"""A keyframe of a strip: place and fields."""


class KeptAnimation(NamedTuple):
    """What performances, and keyframes made by hand, gave an owner: NLA tracks, as fields and
    strips; values that shape keys have beside them, by data path; how its action acts; names of
    strips that scripts cannot make; the action in place of its own, with the slot's identifier,
    None for its own; the blend of the import's own strip; and a copy of its own action, with the
    slot's identifier, where that moves what an artist added."""

    tracks: list[tuple[dict[str, Any], list[tuple[Any, ...]]]]
    held: Mapping[str, float]
    fields: Mapping[str, Any]
    lost: list[str]
    action: Any = None
    slot: str | None = None
    blend: float = 0.0
    added: tuple[Any, str | None] | None = None


def slot_of(user: Any) -> str | None:
    """Identifier of the slot of a strip or of animation data; None without one."""
    slot = user.action_slot if SLOTTED_ACTIONS else None
    return None if slot is None else str(slot.identifier)


def keep_animation(owner: Any) -> KeptAnimation:
    """The animation of performances and made by hand, not the strips at the bottom, which that of
    the last import was pushed down to; nothing of None. An action of that import that was changed
    by hand stays in the file."""
    animation = owner.animation_data if owner is not None else None
    if animation is not None:
        animation.use_tweak_mode = False  # in which a strip's action is the owner's
    tracks = animation.nla_tracks if animation else ()
    lowest = [strip for strip in tracks[0].strips if strip.action] if tracks else []
    holding = [strip for strip in lowest if tags.HELD in strip.action]
    held = dict[str, float]()
    for strip in holding if holding and owner.id_type == "KEY" else ():
        held |= {each.data_path: each.evaluate(0) for each in strip_curves(strip)}
    own_rows = 1 + bool(holding)
    kept = []
    lost = list[str]()
    blend = 0.0
    added = None
    for row, track in enumerate(tracks):
        strips = []
        for strip in _clips(track.strips, lost):
            is_own = row < own_rows and _is_of_import(strip.action, owner)
            if not is_own or is_made_by_hand(strip.action):
                strip.action.use_fake_user = True
            if is_own:
                blend = max(blend, strip.blend_out)
                added = added or _copy_if_added(strip.action, slot_of(strip))
                continue
            fields = {name: getattr(strip, name) for name in STRIP_FIELDS}
            found = ((path, strip.fcurves.find(path)) for path in STRIP_CURVES)
            points = {
                path: [_kept_point(each) for each in curve.keyframe_points]
                for path, curve in found
                if curve is not None
            }
            strips.append((strip.name, strip.action, slot_of(strip), fields, points))
        if strips:
            kept.append(({name: getattr(track, name) for name in TRACK_FIELDS}, strips))
    how = {name: getattr(animation, name) for name in ACTION_FIELDS if animation}
    action = animation.action if animation else None
    if action is None or (tags.PERFORMANCE not in action and _is_of_import(action, owner)):
        if action is not None:
            added = _copy_if_added(action, slot_of(animation))
        return KeptAnimation(kept, held, how, lost, blend=blend, added=added)
    action.use_fake_user = True
    return KeptAnimation(kept, held, how, lost, action, slot_of(animation), blend, added)


def _copy_if_added(action: Any, slot: str | None) -> tuple[Any, str | None] | None:
    """A copy of an action of an import, with the identifier of its slot, if that moves what an
    artist added."""
    if tags.HELD in action or not any(map(_is_added, _curves_of_slot(action, slot))):
        return None
    return action.copy(), slot


def _curves_of_slot(action: Any, slot: str | None) -> Any:
    """The f-curves of the slot of an identifier; of None all, as actions without slots have."""
    return all_curves(action) if slot is None else _slot_curves(action, action.slots[slot])


def give_added_curves(owner: Any, kept: KeptAnimation) -> None:
    """Let the new action of an owner also move what an artist added, as the one before did."""
    if kept.added is None:
        return
    before, slot = kept.added
    curves = action_curves(owner)
    for curve in filter(_is_added, _curves_of_slot(before, slot)):
        try:
            owner.path_resolve(curve.data_path)
        except ValueError:  # what it moved is gone
            continue
        _copy_curve(curve, curves.new(curve.data_path, index=curve.array_index))
    bpy.data.actions.remove(before)


def _copy_curve(curve: Any, copy: Any) -> None:
    """Give an empty f-curve keyframes, modifiers and fields of another one."""
    kept = [_kept_point(each) for each in curve.keyframe_points]
    for place, _ in kept:
        copy.keyframe_points.insert(*place)
    for point, (_, fields) in zip(copy.keyframe_points, kept, strict=True):
        for field, value in fields.items():
            setattr(point, field, value)
    for field in ("extrapolation", "mute"):
        setattr(copy, field, getattr(curve, field))
    for each in curve.modifiers:
        made = copy.modifiers.new(each.type)
        for field in each.bl_rna.properties:
            if not field.is_readonly:
                setattr(made, field.identifier, getattr(each, field.identifier))
    copy.update()


def _is_of_import(action: Any, owner: Any) -> bool:
    """Whether an import made the action for its owner: for shape keys and rigs. An object that is
    keyframed by hand shares the action of its shape keys from Blender 4.4 on."""
    is_made = tags.IMPORTED in action or tags.HELD in action
    is_made |= action.name.startswith((f"{owner.name} action", f"{owner.name} place"))
    return is_made and (owner.id_type == "KEY" or owner.type == "ARMATURE")


def _clips(strips: Any, lost: list[str]) -> Iterator[Any]:
    """Strips with actions, also those within meta strips; the names of others are added to
    `lost`."""
    for strip in strips:
        if strip.type == "META":
            yield from _clips(strip.strips, lost)
        elif strip.type == "CLIP" and strip.action is not None:
            yield strip
        if strip.type != "CLIP":
            lost.append(strip.name)


def _kept_point(point: Any) -> KeptPoint:
    fields = {name: getattr(point, name) for name in POINT_FIELDS}
    for side in ("handle_left", "handle_right"):
        fields[side] = tuple(fields[side])
    return tuple(point.co), fields


def give_animation(owner: Any, kept: KeptAnimation) -> None:
    """Give an owner kept tracks above those that it has, and the kept action in place of its
    own, which stays in the file, once."""
    if not kept.fields:
        return
    animation = owner.animation_data_create()
    for name, value in kept.fields.items():
        setattr(animation, name, value)
    for track_fields, strips in kept.tracks:
        track = animation.nla_tracks.new()
        for title, action, slot, fields, points in strips:
            strip = track.strips.new(title, int(fields["frame_start_raw"]), action)
            if slot is not None:
                strip.action_slot = action.slots[slot]
            for field, value in fields.items():
                setattr(strip, field, value)
            for path, places in points.items():
                curve = strip.fcurves.find(path)
                for place, fields in places if curve is not None else ():
                    point = curve.keyframe_points.insert(*place)
                    for field, value in fields.items():
                        setattr(point, field, value)
        for field, value in track_fields.items():
            setattr(track, field, value)
    if kept.action is not None:
        own = animation.action
        assign_action(animation, kept.action, kept.slot)
        if own is not None:
            _keep_once(own)


def _keep_once(action: Any) -> None:
    """Keep an import's action that nothing plays in the file, unless an earlier one is equal."""
    digest = action.get(tags.IMPORTED)
    others = [each for each in bpy.data.actions if each != action and is_unused_import(each)]
    if digest is not None and any(each.get(tags.IMPORTED) == digest for each in others):
        bpy.data.actions.remove(action)
    else:
        action.use_fake_user = True


def is_unused_import(action: Any) -> bool:
    """Whether an import made the action, as it is, and nothing plays it."""
    is_ours = tags.IMPORTED in action or tags.HELD in action
    return is_ours and action.users == action.use_fake_user and not is_made_by_hand(action)


def assign_action(animation: Any, action: Any, slot: str | None) -> None:
    """Let an action animate the owner of `animation`, by the slot of an identifier."""
    animation.action = action
    if slot is not None:
        animation.action_slot = action.slots[slot]


def select_bones(rig: Any, names: set[str]) -> None:
    """Select these bones of an armature object only; from 5.0 on the pose has the selection."""
    owners = rig.pose.bones if bpy.app.version >= (5, 0, 0) else rig.data.bones
    for bone in owners:
        bone.select = bone.name in names


def set_modifier_input(modifier: Any, identifier: str, value: Any) -> None:
    """Set a geometry nodes modifier's input by identifier ("Socket_2"), a menu's by its item."""
    if MODIFIER_INPUT_PROPERTIES:
        getattr(modifier.properties.inputs, identifier).value = value
    elif isinstance(value, str) and isinstance(modifier[identifier], int):
        items = modifier.id_properties_ui(identifier).as_dict()["items"]
        modifier[identifier] = next(item[4] for item in items if item[0] == value)
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def modifier_input(modifier: Any, identifier: str) -> Any:
    """A geometry nodes modifier's input by identifier; of a menu, the chosen item's name."""
    if MODIFIER_INPUT_PROPERTIES:
        return getattr(modifier.properties.inputs, identifier).value
    value = modifier[identifier]
    if type(value) is not int:  # a menu's, whose item it is by number
        return value
    items = modifier.id_properties_ui(identifier).as_dict()["items"]
    return next((str(item[0]) for item in items if item[4] == value), "")


def modifier_input_owner(modifier: Any, identifier: str) -> tuple[Any, str]:
    """What `UILayout.prop` draws a geometry nodes modifier's input with: owner and property."""
    if MODIFIER_INPUT_PROPERTIES:
        return getattr(modifier.properties.inputs, identifier), "value"
    return modifier, f'["{identifier}"]'


def enable_nodes(owner: Any) -> Any:
    """The node tree of a new material or world, which comes without one before Blender 5."""
    if owner.node_tree is None:
        owner.use_nodes = True
    return owner.node_tree


def shader_nodes(owner: Any) -> Any:
    """The node tree of a world or a light; None where it is a plain color, possible for worlds
    before Blender 5.0, for lights before 5.3."""
    always_since = (5, 0, 0) if owner.id_type == "WORLD" else (5, 3, 0)
    return owner.node_tree if bpy.app.version >= always_since or owner.use_nodes else None


def native_splats(tree: Any, points: Any, left_out: str) -> Any:
    """Add nodes that make points native splats, without attributes of these names; their output,
    still points in a version that names them in another way."""
    node = tree.nodes.new("GeometryNodePointsSetType")
    with suppress(TypeError):  # there is no such item
        node.inputs["Type"].default_value = "3D Gaussian Splat"
    tree.links.new(points, node.inputs["Points"])
    removal = tree.nodes.new("GeometryNodeRemoveAttribute")
    removal.inputs["Pattern Mode"].default_value = "Wildcard"
    removal.inputs["Name"].default_value = left_out
    tree.links.new(node.outputs["Points"], removal.inputs["Geometry"])
    return removal.outputs["Geometry"]


def allow_depth_write(shader: Any) -> None:
    """Let a shader's fragments set their depth; versions before 5.0 need no declaration."""
    if hasattr(shader, "depth_write"):
        shader.depth_write("ANY")


def compositor_tree(scene: Any) -> Any:
    """The scene's tree of compositor nodes; None without one, or where it is not used."""
    if hasattr(scene, "compositing_node_group"):  # from 5.0 on
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def new_compositor_tree(scene: Any) -> Any:
    """Give the scene a tree of compositor nodes that passes its image on."""
    if not hasattr(scene, "compositing_node_group"):
        scene.use_nodes = True
        return scene.node_tree
    tree = bpy.data.node_groups.new(f"{scene.name} Compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    layers = tree.nodes.new("CompositorNodeRLayers")
    layers.scene = scene
    output = tree.nodes.new("NodeGroupOutput")
    output.location.x = 700.0
    tree.links.new(layers.outputs["Image"], output.inputs["Image"])
    scene.compositing_node_group = tree
    return tree


def compositor_math(nodes: Any, operation: str, *values: Any) -> Any:
    """Output of a Math node of the compositor, whose own kind went with 5.0."""
    own = "CompositorNodeMath"
    kind = own if hasattr(bpy.types, own) else "ShaderNodeMath"
    return nodes.out(kind, {"Value": list(values)}, operation=operation)


def compositor_mix(nodes: Any, factor: Any, first: Any, second: Any) -> Any:
    """Output of a Mix node of the compositor: second where factor is 1."""
    own = "CompositorNodeMixRGB"
    if hasattr(bpy.types, own):
        return nodes.out(own, {"Fac": factor, "Image": [first, second]})
    inputs = {"Factor": factor, "A": first, "B": second}
    return nodes.out("ShaderNodeMix", inputs, data_type="RGBA")


def alpha_over(nodes: Any, background: Any, foreground: Any) -> Any:
    """Output of an Alpha Over node, whose inputs have names of their own from 5.0 on."""
    node = nodes.add("CompositorNodeAlphaOver")
    images = [each for each in node.inputs if each.type == "RGBA"]
    for socket, image in zip(images, (background, foreground), strict=True):
        nodes.tree.links.new(image, socket)
    return node.outputs[0]


def shutter_position(scene: Any) -> str:
    """Where the shutter opens about the frame: "START", "CENTER" or "END"."""
    return str(getattr(scene.render, "motion_blur_position", "CENTER"))


def working_space() -> str:
    """The color space that is scene-linear in the open file; `REC709` before Blender 5.0."""
    spaces = getattr(bpy.data, "colorspace", None)
    return str(spaces.working_space) if spaces else REC709


def choose_format(settings: Any, media_type: str, file_format: str) -> None:
    """Choose images or videos ("IMAGE", "VIDEO") of a format in a scene's settings of images."""
    if hasattr(settings, "media_type"):  # from Blender 5.0 on
        settings.media_type = media_type
    settings.file_format = file_format


def sequencer_strips(scene: Any) -> Any:
    """The strips of a scene's video sequencer, which is made; `sequences` before Blender 4.4."""
    editor = scene.sequence_editor_create()
    return editor.strips if hasattr(editor, "strips") else editor.sequences


def light_strength(light: Any, area: float) -> np.ndarray:
    """(3,) linear: a light's color times energy, from 4.5 on also exposure, temperature, and area
    in square meters where the energy is per square meter."""
    color = np.array(light.color, np.float64) * light.energy * 2.0 ** getattr(light, "exposure", 0)
    if getattr(light, "use_temperature", False):
        color = color * np.array(light.temperature_color)
    return color if getattr(light, "normalize", True) else color * area
