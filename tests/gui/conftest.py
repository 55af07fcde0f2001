"""Blender with a window: `make test-gui`, with the command that starts it in STGA_BLENDER."""

import os
import shlex

import bpy  # noqa: F401  which brings the module gpu
import pytest

BLENDER = shlex.split(os.environ.get("STGA_BLENDER", ""))


@pytest.fixture(scope="module", autouse=True)
def window(alone):
    """One window at a time: a second one takes the keyboard and the processor from the first."""
    if not BLENDER:
        pytest.skip("STGA_BLENDER does not say how to start a Blender with a window")
    with alone("window"):
        yield
