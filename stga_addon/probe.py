"""Says as JSON what an interpreter can train with: `python -m stga_addon.probe`. Needs nothing but that interpreter."""

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
    device = f"CPU with {os.cpu_count()} threads"
    if "torch" in found:
        torch = importlib.import_module("torch")
        if torch.cuda.is_available():
            device = str(torch.cuda.get_device_name())
    print(json.dumps({"python": platform.python_version(), "found": found, "broken": broken, "device": device}))


if __name__ == "__main__":
    main()
