"""Blender's GPU context: whether there is one, and what computes it."""

import ctypes
import sys
from functools import cache

import bpy
import gpu

SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "basic render")
"""Parts of the names, in lower case, of OpenGL and Vulkan drivers that compute on the CPU."""


def is_software() -> bool:
    """Whether the driver computes on the CPU; needs a GPU context."""
    name = gpu.platform.renderer_get().lower()
    return any(software in name for software in SOFTWARE_RENDERERS)


@cache
def has_gpu_context() -> bool:
    """Whether Blender can be asked for a GPU context, in vain of which it aborts: with a window, or
    on Linux where EGL initializes its default display or, as Blender tries next, its first
    device."""
    if not bpy.app.background or sys.platform != "linux":
        return not bpy.app.background
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return False
    pointer = ctypes.c_void_p
    count = ctypes.c_int()
    device = ctypes.c_void_p()
    egl.eglGetDisplay.restype = pointer
    egl.eglGetDisplay.argtypes = [pointer]
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    egl.eglGetProcAddress.restype = pointer
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    if egl.eglInitialize(egl.eglGetDisplay(None), None, None):
        return True
    names = b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"
    query, open_device = map(egl.eglGetProcAddress, names)
    if not query or not open_device:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)
    if not query(1, ctypes.byref(device), ctypes.byref(count)) or not count.value:
        return False
    open_device = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(open_device)
    display = open_device(0x313F, device, None)  # EGL_PLATFORM_DEVICE_EXT
    return bool(display and egl.eglInitialize(display, None, None))
