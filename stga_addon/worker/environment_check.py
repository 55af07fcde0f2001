"""Reports as JSON which packages and device an interpreter has: `python -m stga_addon.worker.environment_check`."""

import importlib
import json
import os
import platform
from importlib.util import find_spec

from .requirements import REQUIREMENTS


def main() -> None:
    versions, failures = {}, {}
    for name in (*REQUIREMENTS, *(["mediapipe"] if find_spec("mediapipe") else [])):
        try:
            versions[name] = str(getattr(importlib.import_module(name), "__version__", "?"))
        except Exception as error:  # a library that fails to load raises what it likes
            failures[name] = f"{type(error).__name__}: {error}".splitlines()[0]
    report = {
        "python": platform.python_version(),
        "versions": versions,
        "failures": failures,
        "device": _device(),
    }
    print(json.dumps(report))


def _device() -> str:
    """The GPU that warp-lang finds, or the CPU."""
    try:
        warp = importlib.import_module("warp")
        warp.config.quiet = True
        if warp.is_cuda_available():
            return str(warp.get_cuda_device().name)
    except Exception:  # the package is missing, or its driver fails: the CPU trains
        pass
    return f"CPU with {os.cpu_count()} threads"


if __name__ == "__main__":
    main()
