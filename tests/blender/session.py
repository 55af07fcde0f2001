"""A session in Blender as tests carry it out: operators, panel, files, objects, pictures."""

import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from capture.factory import write_flame_capture
from PIL import Image

from stga_addon.scene.render.scene_splats import SplatCache, visible_layers

CHECKOUT = "stga_checkout"
"""The package that the checkout is as an extension."""


class Operator:
    """An operator of Blender that takes paths as well."""

    def __init__(self, operator):
        self.operator = operator

    def __call__(self, *how, **options):
        paths = {name: str(value) for name, value in options.items() if isinstance(value, Path)}
        return self.operator(*how, **options | paths)

    def __getattr__(self, name):
        return getattr(self.operator, name)


class Operators:
    """`bpy.ops.stga`, of such operators."""

    def __getattr__(self, name):
        return Operator(getattr(bpy.ops.stga, name))


ops = Operators()


def failure(sentence):
    """A block that ends with an operator's error, in whose message the sentence is found."""
    return pytest.raises(RuntimeError, match=sentence)


def panel():
    """The settings of the scene, which the panel shows."""
    return bpy.context.scene.stga


def import_flame(folder):
    """A FLAME capture written into a folder and imported: capture and model."""
    capture, model = write_flame_capture(folder)
    ops.import_capture(directory=capture, flame=model)
    return capture, model


def bring(file, how, name):
    """Append, link or, as one instance, link a collection of a file into the open one."""
    within = f"{file}/Collection/"
    operator = bpy.ops.wm.append if how in ("append", "paste") else bpy.ops.wm.link
    more = {"instance_collections": how == "instance"}
    operator(filepath=within + name, directory=within, filename=name, **more)


def state_of(kind):
    """How a request of the scene stands."""
    monitor = sys.modules[f"{CHECKOUT}.operators.monitor"]
    return monitor.state_of(bpy.context.scene, kind)


def save(path, **options):
    bpy.ops.wm.save_as_mainfile(filepath=str(path), **options)


def open_file(path):
    bpy.ops.wm.open_mainfile(filepath=str(path))


def reopen(path):
    save(path)
    open_file(path)


def placed(name, data=None):
    """A new object in the scene."""
    made = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(made)
    return made


def viewport():
    """The first window, and its 3D viewport."""
    window = bpy.context.window_manager.windows[0]
    return window, next(area for area in window.screen.areas if area.type == "VIEW_3D")


def shown_layers(cache=None):
    """What a render engine draws."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return visible_layers(depsgraph, SplatCache() if cache is None else cache)


def point_clouds():
    """Splats as points, or as native ones, as they are evaluated."""
    instances = bpy.context.evaluated_depsgraph_get().object_instances
    return [each.object.data for each in instances if each.object.type == "POINTCLOUD"]


def picture(path, engine, size_px=None, samples=1):
    """(H, W, 4) 0 to 255 of the scene by an engine, square where a size is given; not denoised,
    which not every build of Blender can."""
    scene = bpy.context.scene
    scene.render.engine = engine
    if size_px is not None:
        scene.render.resolution_x = scene.render.resolution_y = size_px
    scene.cycles.samples = scene.eevee.taa_render_samples = samples
    scene.cycles.use_denoising = False
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return np.asarray(Image.open(path)).astype(int)


WORKER = """
import json, pathlib, shutil, sys, time
FOLDER = pathlib.Path(sys.argv[-1])
def end(state, error=""):
    (FOLDER / "status.json").write_text(json.dumps({"state": state, "error": error}))
def answer(**values):
    header = {"format": "stga-request", "version": 1}
    (FOLDER / "result.json").write_text(json.dumps({**header, **values}))
    end("finished")
"""


def write_interpreter(path, body):
    """A program that stands in for the training Python, given the folder of a request."""
    path.write_text(f"#!{sys.executable}\n{WORKER}{body}\n")
    path.chmod(0o755)
    return str(path)
