"""Sets of shots: objects that EEVEE or Cycles renders in the press that renders splats."""

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.scene import compat, tags
from stga_addon.scene.compat import enable_nodes
from stga_addon.scene.display.splat_object import show_world_splats
from stga_addon.scene.objects import Identity
from stga_addon.scene.render import film_set

from .session import placed
from .test_engine import TOLERANCE, WIDTH, _engine, camera_at, render  # noqa: F401
from .test_splat_object import random_splats

BEHIND = (0.2, 0.3, 0.6)
BEFORE = (0.8, 0.1, 0.05)


def board(name, color, corners):
    """A flat mesh of its own light, so that a path tracer shows exactly its color."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [range(len(corners))])
    material = bpy.data.materials.new(name)
    tree = enable_nodes(material)
    tree.nodes.clear()
    emission = tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (*color, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    mesh.materials.append(material)
    return placed(name, mesh)


def wall(y, left, right):
    return [(left, y, -9.0), (right, y, -9.0), (right, y, 9.0), (left, y, 9.0)]


def links_of(tree):
    return {(link.from_socket.path_from_id(), link.to_socket.path_from_id()) for link in tree.links}


def image_nodes(scene):
    """Render Layers and the output, which the set's nodes come between, and what is between."""
    tree = compat.new_compositor_tree(scene)
    kinds = {node.bl_idname: node for node in tree.nodes}
    gamma = tree.nodes.new("CompositorNodeExposure")
    layers = kinds["CompositorNodeRLayers"]
    (link,) = layers.outputs["Image"].links
    tree.links.new(gamma.outputs[0], link.to_socket)
    tree.links.new(layers.outputs["Image"], gamma.inputs[0])
    return tree, gamma


@pytest.fixture
def shot():
    """Splats between a wall behind them and a board before their left half."""
    splats = random_splats(1, 40, extent=0.8)
    splats.log_scale[:] = -1.5
    show_world_splats(splats, "splats")
    camera = camera_at(lens=40.0)
    camera.location = 0.0, -8.0, 0.0
    camera.rotation_euler = np.pi / 2, 0.0, 0.0
    return bpy.context.scene


def show_set(scene):
    """Made by a path tracer, which needs no graphics card."""
    film_set.show_set(scene)
    other = scene[tags.SET]
    other.render.engine = "CYCLES"
    other.cycles.samples = 4
    other.cycles.use_denoising = False


def test_sets_are_combined_with_splats_by_depth(shot, tmp_path):
    """Catches F12 that leaves out the set, a wall over the head, a head over what stands before it,
    soft outlines cut off or darkened, edges more than a pixel wide, a film that is opaque where the
    scene's is not, and objects that are removed or hidden and rendered on."""
    alone = render(tmp_path)
    behind = board("wall", BEHIND, wall(6.0, -20.0, 20.0))
    before = board("board", BEFORE, wall(-6.0, -20.0, 0.0))
    show_set(shot)
    both = render(tmp_path)
    half = WIDTH // 2
    for channel, near, far in zip("RGB", BEFORE, BEHIND, strict=True):
        assert_allclose(both[channel][:, : half - 1], near, atol=1e-3)
        expected = alone[channel] + (1 - alone["A"]) * far
        assert_allclose(both[channel][:, half + 1 :], expected[:, half + 1 :], atol=TOLERANCE)
    combined = compat.compositor_tree(shot).nodes[film_set.NODE].outputs
    (shown,) = combined["Image"].links
    image = shown.to_socket
    for name, values, nearest in (("Depth", alone["Depth"], 2.0), ("Mask", alone["A"], 0.0)):
        image.id_data.links.new(combined[name], image)
        found = render(tmp_path)["R"]
        assert_allclose(found[:, : half - 1], nearest, atol=1e-4)
        covered = (alone["A"] > TOLERANCE) & (values < 1e9)  # half covered or more have a depth
        covered[:, : half + 1] = False
        assert_allclose(found[covered], values[covered], rtol=1e-5, atol=TOLERANCE)
    image.id_data.links.new(combined["Image"], image)
    shot[tags.SET].collection.objects.link(alone_in_set := placed("lamp", None))
    behind.hide_render = True
    found = Identity(before)
    shot.collection.objects.unlink(before)
    assert found.find() is None  # though the set has it until the next image
    without = render(tmp_path)
    for channel in "RGBA":
        assert_allclose(without[channel], alone[channel], atol=TOLERANCE)
    assert alone_in_set.name in shot[tags.SET].objects


def test_sets_keep_what_the_compositor_does(shot, tmp_path):
    """Catches nodes of the artist that are replaced or get the splats alone, a set that leaves
    nodes or scenes behind once it is left out, and one with other samples than were chosen."""
    board("wall", BEHIND, wall(6.0, -20.0, 20.0))
    tree, exposure = image_nodes(shot)
    before = links_of(tree)
    scenes = len(bpy.data.scenes)
    show_set(shot)
    assert film_set.shows_set(shot)
    (link,) = exposure.inputs[0].links
    assert link.from_node.name == film_set.NODE
    exposure.inputs["Exposure"].default_value = 1.0
    shot.eevee.taa_render_samples = 3
    corner = render(tmp_path)["R"][0, 0]
    assert_allclose(corner, 2 * BEHIND[0], atol=1e-3)
    assert shot[tags.SET].eevee.taa_render_samples == 3
    film_set.leave_out_set(shot)
    assert not film_set.shows_set(shot)
    assert len(bpy.data.scenes) == scenes
    assert links_of(tree) == before
    assert render(tmp_path)["A"][0, 0] == 0.0
