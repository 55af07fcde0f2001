"""An empty Blender file for every test, and the checkout as an extension."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def empty_scene():
    bpy = pytest.importorskip("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="session")
def extension():
    """The checkout as a package of its own, as Blender imports an extension: only relative imports find their way."""
    spec = importlib.util.spec_from_file_location(
        "stga_checkout", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
    )
    module = sys.modules["stga_checkout"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.register()
    yield module
    module.unregister()
