"""Compiles what a training runs before the first one is asked for, in a folder that uninstalling
removes."""

import os
import subprocess
from contextlib import suppress
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.raster.kernel_cache import has_kernels
from ..stga_addon.worker.launch import CACHE_VARIABLE, KERNELS, cache_folder, start_in_background
from .common import package
from .training_python import training_python

PREPARATION = "stga_addon.jobs.perform"
START_DELAY_S = 1.0
"""After the extension was enabled: neither enabling nor Blender's start waits for a process."""

_processes: list["subprocess.Popen[bytes]"] = []


def begin_preparing(context: Any) -> None:
    """Compile in the background what the first training would wait for; nothing without a window,
    without a Python that trains, or where it is compiled or is being compiled."""
    if (
        bpy.app.background
        or CACHE_VARIABLE not in os.environ
        or has_kernels(cache_folder() / KERNELS)
    ):
        return
    if any(process.poll() is None for process in _processes):
        return
    with suppress(StgaError):  # training says what is missing
        _processes.append(start_in_background(training_python(context), [PREPARATION]))


def register() -> None:
    with suppress(ValueError):  # a checkout, which is no extension
        os.environ.setdefault(
            CACHE_VARIABLE, bpy.utils.extension_path_user(package(), path="cache")
        )
    if not bpy.app.background:
        bpy.app.timers.register(_begin, first_interval=START_DELAY_S)


def _begin() -> None:
    begin_preparing(bpy.context)


def unregister() -> None:
    """End what is compiling, which would write into a folder that is being removed."""
    if bpy.app.timers.is_registered(_begin):
        bpy.app.timers.unregister(_begin)
    for process in _processes:
        process.kill()
        process.wait()
    _processes.clear()
    with suppress(ValueError):
        if os.environ.get(CACHE_VARIABLE) == bpy.utils.extension_path_user(package(), path="cache"):
            del os.environ[CACHE_VARIABLE]
