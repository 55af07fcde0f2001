"""Runs in any Blender, or with bpy, started by test_native_splats.py: writes what native splats are
drawn from.

`python native_script.py -- AVATAR HEAD OUT`: the avatar's file, the head's vertices (.npy) and the
.npz file of the attributes of each case. Before Blender 5.3 the points stay points.
"""

import sys
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from stga_addon.avatar.file import read_avatar
from stga_addon.scene import compat, tags

if not compat.NATIVE_SPLATS:
    compat.NATIVE_SPLATS = True
    compat.native_splats = lambda tree, points, left_out: points

from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_attributes import RELIT_COLOR, read_attribute
from stga_addon.scene.display.splat_nodes import NATIVE
from stga_addon.scene.display.splat_object import set_input, show_avatar, store_linear_base

AVATAR, HEAD, OUT = sys.argv[sys.argv.index("--") + 1 :]
found = {}


def read(case):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    (cloud,) = [
        each.object.data for each in depsgraph.object_instances if each.object.type == "POINTCLOUD"
    ]
    found[f"{case}/type"] = getattr(cloud, "type", "")
    for attribute in cloud.attributes:
        if attribute.data_type in ("FLOAT4", "FLOAT_COLOR", "FLOAT_VECTOR", "QUATERNION"):
            found[f"{case}/{attribute.name}"] = read_attribute(cloud, attribute.name)


avatar = read_avatar(Path(AVATAR))
mesh = bpy.data.meshes.new("head")
mesh.from_pydata(np.load(HEAD).tolist(), [], avatar.faces.tolist())
head = bpy.data.objects.new("head", mesh)
bpy.context.scene.collection.objects.link(head)
# selects no triangle
head.vertex_groups.new(name=f"{tags.GROUP_PREFIX}{bpy.context.scene.frame_current}")
shown = show_avatar(avatar, head)
set_input(shown, splat_nodes.DISPLAY, NATIVE)
set_input(shown, splat_nodes.SIZE, 1.5)
read("recorded")
set_input(shown, splat_nodes.VIEW_DEPENDENT, False)
read("constant")
set_input(shown, splat_nodes.VIEW_DEPENDENT, True)
set_input(shown, splat_nodes.SHOW_SELECTION, True)
read("gray")
set_input(shown, splat_nodes.SHOW_SELECTION, False)
base = np.random.default_rng(1).uniform(-1, 1, (len(avatar.splats), 4)).astype(np.float32)
store_linear_base(shown, replace(avatar, linear_base=base))
read("fitted")
relit = np.random.default_rng(0).uniform(0, 2, (len(avatar.splats), 4)).astype(np.float32)
shown.data.attributes.new(RELIT_COLOR, "FLOAT_COLOR", "POINT").data.foreach_set(
    "color", relit.ravel()
)
shown.data.update()
read("relit")
np.savez(OUT, **found)
