"""Differences between Blender 4.2 and 5.3: every version switch of the add-on."""

from contextlib import suppress
from typing import Any

import bpy
import numpy as np

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


def slot_of(user: Any) -> str | None:
    """Identifier of the slot of a strip or of animation data; None without one."""
    slot = user.action_slot if SLOTTED_ACTIONS else None
    return None if slot is None else str(slot.identifier)


def curves_of_slot(action: Any, slot: str | None) -> Any:
    """The f-curves of the slot of an identifier; of None all, as actions without slots have."""
    return all_curves(action) if slot is None else _slot_curves(action, action.slots[slot])


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
    legacy = "CompositorNodeMath"
    kind = legacy if hasattr(bpy.types, legacy) else "ShaderNodeMath"
    return nodes.out(kind, {"Value": list(values)}, operation=operation)


def compositor_mix(nodes: Any, factor: Any, first: Any, second: Any) -> Any:
    """Output of a Mix node of the compositor: second where factor is 1."""
    legacy = "CompositorNodeMixRGB"
    if hasattr(bpy.types, legacy):
        return nodes.out(legacy, {"Fac": factor, "Image": [first, second]})
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
