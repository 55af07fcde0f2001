"""An artist's way through the installed extension; run by `test_versions.py` in a Python of its own
with some bpy.

    python workflow.py ZIP FOLDER PYTHON

FOLDER holds capture/, model.npz, other.npz and a.npz, and receives what is exported. PYTHON is the
one that trains, with the kernels in the zip; "" if there is none. Prints RESULT and JSON.
"""

import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.stga"


def main(archive, folder, python):
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module=MODULE)
    ops = bpy.ops.stga
    heavy = {"torch", "numba", "trimesh", "tqdm"} & {name.split(".")[0] for name in sys.modules}
    tabs = [name for name in dir(bpy.types) if name.startswith("STGA_PT_")]

    ops.import_capture(directory=str(folder / "capture"), flame=str(folder / "model.npz"))
    ops.select(threshold=0.0005)
    counted = [row.triangles for row in bpy.context.scene.stga.selected_frames]
    ops.heat_map()
    ops.heat_map(show=False)
    if not can_train():
        bpy.context.preferences.addons[MODULE].preferences.training_python = python
    trained = 0
    if can_train() or python:
        # Without torch, whose bytecode a new extension would write first
        own = {"python": python if can_train() else ""}
        ops.train(directory=str(folder / "run"), iterations=3, effects="tracking=off", **own)
        ops.show_avatar(filepath=bpy.context.scene.stga.avatar)
        trained = len(positions()) // 3
        bpy.data.objects.remove(bpy.context.scene.stga.splats)
    ops.show_avatar(filepath=str(folder / "a.npz"))
    ops.apply_motion(filepath=str(folder / "other.npz"), start=1)
    bpy.context.scene.frame_start = 1
    bpy.context.scene.frame_end = 5
    ops.export_avatar(filepath=str(folder / "pair"), format="gaussian-avatars")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "head.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(folder / "head.blend"))
    ops.export_avatar(filepath=str(folder / "plys"), format="ply-sequence")
    shown = positions()
    frame = bpy.context.scene.frame_current
    command_line = importlib.import_module(MODULE + ".operators.command_line")
    assert command_line._run(["select", "--threshold", "0.0005"]) == 0

    bpy.ops.preferences.addon_disable(module=MODULE)
    repos = bpy.context.preferences.extensions.repos
    index = next(i for i, repo in enumerate(repos) if repo.module == "user_default")
    bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="stga")
    left = [name for name in dir(bpy.types) if name.startswith("STGA_")]
    left += [path.name for path in Path(repos[index].directory).glob("stga*")]
    return {
        "version": bpy.app.version_string,
        "heavy": sorted(heavy),
        "tabs": tabs,
        "counted": counted,
        "can train": can_train(),
        "trained": trained,
        "shown": shown,
        "frame": frame,
        "left": left,
    }


def can_train():
    return all(map(importlib.util.find_spec, ("torch", "numba", "scipy", "PIL", "platformdirs")))


def positions():
    """Of the splats that are displayed, in the capture's coordinates."""
    bpy.context.scene.frame_set(4)
    display = MODULE + ".stga_addon.scene.display"
    splat_object = importlib.import_module(display + ".splat_object")
    splat_object.set_input(bpy.context.scene.stga.splats, "Display", "Points")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    shown = (each.object for each in depsgraph.object_instances)
    cloud = next(each for each in shown if each.type == "POINTCLOUD")
    read_attribute = importlib.import_module(display + ".splat_attributes").read_attribute
    return list(read_attribute(cloud.data, "position").ravel().tolist())


if __name__ == "__main__":
    print("RESULT " + json.dumps(main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])), flush=True)
    # the module bpy 4.2 crashes when its Python ends where a property has an update function
    os._exit(0)
