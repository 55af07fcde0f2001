"""Reports as JSON which packages and device an interpreter has: `python -m stga_addon.worker.environment_check`."""

import importlib
import json
import os
import platform

NEEDED = {
    "torch": "torch",
    "numba": "numba",
    "scipy": "scipy",
    "PIL": "pillow",
    "platformdirs": "platformdirs",
    "trimesh": "trimesh",
    "tqdm": "tqdm",
}
"""Module -> what pip calls it."""


def main() -> None:
    found, broken = {}, {}
    for name in NEEDED:
        try:
            found[name] = str(getattr(importlib.import_module(name), "__version__", "?"))
        except Exception as error:  # a library that does not load raises what it likes
            broken[name] = f"{type(error).__name__}: {error}".splitlines()[0]
    report = {"python": platform.python_version(), "found": found, "broken": broken, "device": _device()}
    print(json.dumps(report))


def _device() -> str:
    """The GPU that warp-lang finds, or the CPU."""
    try:
        warp = importlib.import_module("warp")
        warp.config.quiet = True
        if warp.is_cuda_available():
            return str(warp.get_cuda_device().name)
    except Exception:  # without the package or a driver that works, there is the CPU
        pass
    return f"CPU with {os.cpu_count()} threads"


if __name__ == "__main__":
    main()
