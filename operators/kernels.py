"""Kernels that the Python which trains compiles before they are asked for."""

import os
from contextlib import suppress
from subprocess import Popen

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.raster.kernel_cache import has_kernels
from ..stga_addon.worker import launch
from ..stga_addon.worker.launch import CACHE_VARIABLE
from .common import AtEnd, package
from .training_python import training_python

PREPARATION = "stga_addon.jobs.compile_ahead"
"""Module that a process runs to compile the kernels of training."""
START_DELAY_S = 1.0
"""Delay after the extension was enabled: neither enabling nor Blender's start waits for a
process."""

_preparations: list["Popen[bytes]"] = []


def begin_preparing() -> None:
    """Compile in the background what the first training would wait for; nothing without a window,
    without a Python that trains, or where it is compiled or is being compiled."""
    if bpy.app.background or CACHE_VARIABLE not in os.environ:
        return
    if has_kernels(launch.cache_folder() / launch.KERNELS):
        return
    if all(process.poll() is not None for process in _preparations):
        with suppress(StgaError):  # training says what is missing
            python = training_python(bpy.context)
            _preparations.append(launch.start_in_background(python, [PREPARATION]))


def register(at_end: AtEnd) -> None:
    with suppress(ValueError):  # a checkout, which is no extension
        cache = bpy.utils.extension_path_user(package(), path="cache")
        if os.environ.setdefault(CACHE_VARIABLE, cache) == cache:
            at_end(os.environ.pop, CACHE_VARIABLE, None)
    at_end(_end_preparing)
    if not bpy.app.background:
        bpy.app.timers.register(begin_preparing, first_interval=START_DELAY_S)


def _end_preparing() -> None:
    """End what is compiling, which would write into a folder that is being removed."""
    if bpy.app.timers.is_registered(begin_preparing):
        bpy.app.timers.unregister(begin_preparing)
    for process in _preparations:
        process.kill()
        process.wait()
    _preparations.clear()
