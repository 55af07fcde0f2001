"""Runs with any bpy, started by test_native_splats.py: writes a .blend file of a shown avatar, or
reads one as the add-on does.

`python native_file_script.py write FILE AVATAR` shows native splats where this Blender has them,
else points. `python native_file_script.py read FILE` replaces native splats that it lacks, or
chooses them.
"""

import json
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parents[2]))

from stga_addon.avatar.file import read_avatar
from stga_addon.scene import compat
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import (
    choose_display,
    display_mode,
    get_input,
    replace_native_splats,
    set_input,
    show_avatar,
)

if sys.argv[1] == "write":
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    avatar = read_avatar(Path(sys.argv[3]))
    mesh = bpy.data.meshes.new("head")
    mesh.from_pydata(avatar.neutral.tolist(), [], avatar.faces.tolist())
    head = bpy.data.objects.new("head", mesh)
    bpy.context.scene.collection.objects.link(head)
    shown = show_avatar(avatar, head)
    mode = splat_nodes.NATIVE if compat.NATIVE_SPLATS else splat_nodes.POINTS
    set_input(shown, splat_nodes.DISPLAY, mode)
    set_input(shown, splat_nodes.SIZE, 1.5)
    bpy.ops.wm.save_as_mainfile(filepath=sys.argv[2])
else:
    bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
    shown = bpy.data.objects["head splats"]
    sentence = replace_native_splats(bpy.data.objects)
    if compat.NATIVE_SPLATS:
        choose_display(shown, splat_nodes.NATIVE)
    instances = bpy.context.evaluated_depsgraph_get().object_instances
    found = {
        "native": compat.NATIVE_SPLATS,
        "sentence": sentence,
        "mode": display_mode(shown),
        "size": get_input(shown, splat_nodes.SIZE),
        "head": get_input(shown, splat_nodes.HEAD).name,
        "drawn": sum(each.is_instance or each.object.type == "POINTCLOUD" for each in instances),
    }
    print(f"RESULT {json.dumps(found)}")
