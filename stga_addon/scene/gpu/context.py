"""Whether Blender can be asked for a GPU context: where it cannot get one, it ends the process."""

import ctypes
import sys
from functools import cache

import bpy

EGL_OPENGL_API = 0x30A2


@cache
def has_gpu_context() -> bool:
    """True with a window; without one only where EGL, by which Blender then gets its context, has a driver (Linux).

    Blender aborts where it asks for a context in vain, so this asks EGL first. Other systems were not tried without a
    window, and are not relied upon.
    """
    return not bpy.app.background or (sys.platform == "linux" and _has_egl_driver())


def _has_egl_driver() -> bool:
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return False
    egl.eglGetDisplay.restype, egl.eglGetDisplay.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    display = egl.eglGetDisplay(None)
    return bool(display and egl.eglInitialize(display, None, None) and egl.eglBindAPI(EGL_OPENGL_API))
