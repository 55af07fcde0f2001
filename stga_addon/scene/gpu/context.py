"""Whether Blender can be asked for a GPU context: where it cannot get one, it ends the process."""

import ctypes
import sys
from functools import cache

import bpy

EGL_PLATFORM_DEVICE = 0x313F


@cache
def has_gpu_context() -> bool:
    """True with a window; without one only where EGL, by which Blender then gets its context, has a
    driver (Linux).

    Blender aborts where it asks for a context in vain, so this asks EGL first. Other systems were
    not tried without a window, and are not relied upon.
    """
    return not bpy.app.background or (sys.platform == "linux" and _has_egl_driver())


def _has_egl_driver() -> bool:
    """Whether EGL initializes its default display or, as Blender tries next, its first device."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return False
    pointer, count = ctypes.c_void_p, ctypes.c_int()
    egl.eglGetDisplay.restype, egl.eglGetDisplay.argtypes = pointer, [pointer]
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = pointer, [ctypes.c_char_p]
    if egl.eglInitialize(egl.eglGetDisplay(None), None, None):
        return True
    query, open_device = (
        egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")
    )
    if not query or not open_device:
        return False
    device = pointer()
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)
    if not query_devices(1, ctypes.byref(device), ctypes.byref(count)) or not count.value:
        return False
    display = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(open_device)(
        EGL_PLATFORM_DEVICE, device, None
    )
    return bool(display and egl.eglInitialize(display, None, None))
