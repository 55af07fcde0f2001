"""Adapters of WebGPU by name."""

import os
from contextlib import suppress
from functools import cache
from typing import Any

import wgpu
from wgpu.backends.wgpu_native.extras import set_instance_extras

NEEDED_LIMITS = {
    "max-storage-buffers-per-shader-stage": 10,
    "max-compute-workgroup-storage-size": 24 << 10,
}
"""Limits of an adapter that the kernels need; WebGPU promises 8 and 16 KiB, desktop adapters have
more."""
BACKENDS = ("Vulkan", "Metal", "DX12")
"""Without OpenGL, which lacks what the kernels need and complains where there is no display."""


@cache
def adapters() -> dict[str, Any]:
    """The adapters that can run the kernels, by a name that distinguishes equal ones: cards first,
    software last.

    A GPU that has Vulkan or Metal is named by that before Direct3D 12, whose compiler is the
    slowest.
    """
    # Mesa's layer for windows complains where there is no display
    os.environ.setdefault("NODEVICE_SELECT", "1")
    with suppress(RuntimeError):  # where this process has an instance already, it stays as it is
        set_instance_extras(backends=BACKENDS)
    found: dict[str, Any] = {}
    every = wgpu.gpu.enumerate_adapters_sync()
    for adapter in sorted(every, key=_preference):
        too_small = any(adapter.limits[limit] < least for limit, least in NEEDED_LIMITS.items())
        if too_small or adapter.info["backend_type"] == "OpenGL":
            continue
        name = f"{adapter.info['device']} ({adapter.info['backend_type']})"
        same = sum(known == name or known.startswith(f"{name} #") for known in found)
        found[f"{name} #{same + 1}" if same else name] = adapter
    return found


def _preference(adapter: Any) -> tuple[int, bool]:
    kinds = ("DiscreteGPU", "IntegratedGPU", "CPU")
    info = adapter.info
    rank = kinds.index(info["adapter_type"]) if info["adapter_type"] in kinds else 1
    return rank, info["backend_type"] == "D3D12"


def is_software(adapter: Any) -> bool:
    """Whether an adapter computes on the CPU."""
    return bool(adapter.info["adapter_type"] == "CPU")
