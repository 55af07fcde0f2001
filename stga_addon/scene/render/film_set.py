"""The set of a shot: objects that the engine STGA Splats leaves out. EEVEE renders them as a second
scene in the same press, and nodes of the compositor combine both images by depth."""

from typing import Any

import bpy

from .. import compat, tags
from ..display.node_builder import Nodes, new_socket
from ..display.splat_object import followed_head
from ..light import throw_shadow, throws_shadow
from ..objects import objects_of_images

NODE = "STGA Set"
"""Name of the node that combines both images, and of its group."""
LAYERS = "STGA Set Layers"
"""Name of the node that renders the second scene."""
PASSES = "Image", "Depth"
"""Outputs of the splats' Render Layers node that the combined ones replace."""
FILM = "film_transparent", *compat.MOTION_BLUR
"""Settings of images that both scenes have in common."""


def shows_set(scene: Any) -> bool:
    """Whether images of the scene are combined with its set."""
    tree = compat.compositor_tree(scene)
    return tree is not None and scene.render.use_compositing and NODE in tree.nodes


def show_set(scene: Any) -> None:
    """Add the second scene, and the nodes that combine it with the splats' images; heads throw
    their shadows. Nodes that follow the splats' Render Layers follow the combination."""
    if shows_set(scene):
        return
    leave_out_set(scene)  # what is left of one
    scene.render.use_compositing = True
    tree = compat.compositor_tree(scene) or compat.new_compositor_tree(scene)
    splat_layers = next((node for node in tree.nodes if _renders(node, scene)), None)
    if splat_layers is None:
        splat_layers = tree.nodes.new("CompositorNodeRLayers")
        splat_layers.scene = scene
    title = f"{scene.name} Set"
    scene[tags.SET] = bpy.data.scenes.new(title)
    if not scene.view_layers[0].use_pass_z:
        scene[tags.ON_FOR_SET] = True
    followers = bpy.data.collections.new(title)
    followers[tags.KIND] = tags.SET
    scene[tags.SET].collection.children.link(followers)
    update_set(scene)
    layers = tree.nodes.new("CompositorNodeRLayers")
    layers.name = layers.label = LAYERS
    layers.scene = scene[tags.SET]
    layers.location = splat_layers.location.x, splat_layers.location.y - 400.0
    both = tree.nodes.new("CompositorNodeGroup")
    both.name = both.label = NODE
    both.node_tree = _depth_combine()
    both.location = splat_layers.location.x + 350.0, splat_layers.location.y
    for name in PASSES:
        for link in list(splat_layers.outputs[name].links):
            tree.links.new(both.outputs[name], link.to_socket)
        tree.links.new(splat_layers.outputs[name], both.inputs[f"Splats {name}"])
        tree.links.new(layers.outputs[name], both.inputs[f"Set {name}"])
    for splats in filter(tags.is_splats, scene.objects):
        head = followed_head(splats)
        if head is not None and head.library is None and not throws_shadow(splats):
            throw_shadow(splats, True)
            splats[tags.ON_FOR_SET] = True


def leave_out_set(scene: Any) -> None:
    """Remove the second scene and its nodes; what followed the combination follows the splats'
    images again. The depth pass and heads' shadows that it needed are off again."""
    tree = compat.compositor_tree(scene)
    both = None if tree is None else tree.nodes.get(NODE)
    if both is not None:
        for name in PASSES:
            source = both.inputs[f"Splats {name}"].links
            for link in list(both.outputs[name].links) if source else ():
                tree.links.new(source[0].from_socket, link.to_socket)
        for node in (both, tree.nodes.get(LAYERS)):
            if node is not None:
                tree.nodes.remove(node)
    if scene.pop(tags.ON_FOR_SET, False):
        scene.view_layers[0].use_pass_z = False
    for splats in filter(tags.is_splats, scene.objects):
        if splats.library is None and splats.pop(tags.ON_FOR_SET, False):
            throw_shadow(splats, False)
    other = scene.pop(tags.SET, None)
    if other is not None:
        followers = other.collection.children[:1]
        bpy.data.scenes.remove(other)
        bpy.data.batch_remove(followers)


def update_set(scene: Any) -> None:
    """Let the second scene show what the scene shows now: its objects without splats, camera, world
    and film; what an artist has put into the second scene alone stays."""
    other = scene.get(tags.SET)
    if other is None or not other.collection.children:
        return
    objects = objects_of_images(scene.view_layers[0].layer_collection)
    wanted = {each for each in objects if not tags.is_splats(each)}
    followers = other.collection.children[0].objects
    present = set(followers)
    for each in present - wanted:
        followers.unlink(each)
    for each in wanted - present:
        followers.link(each)
    if wanted != present:
        other.view_layers[0].update()  # else Blender 5.3 crashes as it renders the scene
    if other.render.engine not in (compat.EEVEE, "CYCLES"):
        other.render.engine = compat.EEVEE
    if other.eevee.taa_render_samples != scene.eevee.taa_render_samples:
        other.eevee.taa_render_samples = scene.eevee.taa_render_samples
    values = {"camera": _camera(scene), "world": scene.world}
    for name, value in values.items():
        if getattr(other, name) != value:
            setattr(other, name, value)
    for name in FILM:
        setattr(other.render, name, getattr(scene.render, name))
    for layer in (scene.view_layers[0], other.view_layers[0]):
        layer.use_pass_z = True


def _camera(scene: Any) -> Any:
    """The camera of the current frame, which markers may choose."""
    bound = [each for each in scene.timeline_markers if each.camera is not None]
    past = [each for each in bound if each.frame <= scene.frame_current]
    return max(past, key=lambda each: each.frame).camera if past else scene.camera


def _renders(node: Any, scene: Any) -> bool:
    return node.bl_idname == "CompositorNodeRLayers" and node.scene == scene


def _depth_combine() -> Any:
    """A group that lays the nearer image over the other at each pixel. Where the set's edges cross
    the splats, the choice is antialiased; splats' own edges blend by their alpha."""
    tree = bpy.data.node_groups.new(NODE, "CompositorNodeTree")
    for side in ("Splats", "Set"):
        new_socket(tree, f"{side} Image", "INPUT", "Color")
        new_socket(tree, f"{side} Depth", "INPUT", "Float")
    new_socket(tree, "Image", "OUTPUT", "Color")
    new_socket(tree, "Depth", "OUTPUT", "Float")
    new_socket(tree, "Mask", "OUTPUT", "Float").description = "Fraction of splats in each pixel"
    nodes = Nodes(tree)
    splats, splat_depth, others, other_depth, *_ = nodes.add("NodeGroupInput").outputs
    is_behind = compat.compositor_math(nodes, "GREATER_THAN", splat_depth, other_depth)
    hidden = nodes.out("CompositorNodeAntiAliasing", {"Image": is_behind})
    before = compat.alpha_over(nodes, others, splats)
    behind = compat.alpha_over(nodes, splats, others)
    nearest = compat.compositor_math(nodes, "MINIMUM", splat_depth, other_depth)
    alpha = nodes.add("CompositorNodeSeparateColor", {"Image": splats}).outputs["Alpha"]
    visible = compat.compositor_math(nodes, "SUBTRACT", 1.0, hidden)
    mask = compat.compositor_math(nodes, "MULTIPLY", alpha, visible)
    image = compat.compositor_mix(nodes, hidden, before, behind)
    nodes.finish("NodeGroupOutput", {"Image": image, "Depth": nearest, "Mask": mask})
    return tree
