"""The Python program of this process: Blender's own, in which a worker finds what the add-on bundles."""

import os
import sys
from functools import cache
from pathlib import Path


@cache
def own_python() -> str:
    """Path of the interpreter whose library this process runs; workers of this Python are started with it.

    Embedded in Blender, `sys.executable` is what Python finds by its name: beside Blender's library in official builds,
    but a stranger's where Blender uses the system's library and another program of that name comes first on PATH.
    """
    prefix = Path(sys.prefix)
    if Path(sys.executable).is_relative_to(prefix):
        return sys.executable
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    names = ("bin/python.exe", "python.exe") if os.name == "nt" else (f"bin/python{version}", "bin/python3")
    return next((str(path) for path in (prefix / name for name in names) if path.is_file()), sys.executable)
