"""An empty Blender file for every test."""

import pytest


@pytest.fixture(autouse=True)
def empty_scene():
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
