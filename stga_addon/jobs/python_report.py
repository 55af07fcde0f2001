"""Packages and device of an interpreter as JSON: `python -m stga_addon.jobs.python_report`."""

import importlib
import json
import os
import platform

from ..worker.training_python import REQUIREMENTS


def main() -> None:
    versions, failures = {}, {}
    for name in REQUIREMENTS:
        try:
            versions[name] = str(getattr(importlib.import_module(name), "__version__", "?"))
        except Exception as error:  # a library that fails to load raises what it likes
            failures[name] = f"{type(error).__name__}: {error}".splitlines()[0]
    names, device = _adapters()
    report = {
        "python": platform.python_version(), "versions": versions, "failures": failures,
        "device": device, "adapters": names,
    }  # fmt: skip
    print(json.dumps(report))


def _adapters() -> tuple[list[str], str]:
    """GPUs for `--device gpu:NAME`, and the device to report; `choose_device` tries it later."""
    cpu = f"CPU with {os.cpu_count()} threads"
    try:
        from ..raster.gpu.adapters import adapters, is_software

        found = adapters()
    except Exception:  # a package is missing, or a driver fails: the CPU trains
        return [], cpu
    return list(found), next(
        (name for name, adapter in found.items() if not is_software(adapter)), cpu
    )


if __name__ == "__main__":
    main()
