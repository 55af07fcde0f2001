"""Which device trains: an NVIDIA GPU where one works, else the CPU."""

import ctypes
import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from ...errors import StgaError

if TYPE_CHECKING:  # to ask for the device, `stga info` needs neither torch nor numba
    from ..settings import TrainingSettings
    from .backend import Backend
    from .frames import FrameStore
    from .state import TrainState

MIN_FREE_BYTES = 1 << 30
"""Bytes of GPU memory below which training does not begin there."""


def choose_device(wanted: str) -> tuple[str, str]:
    """The device to train on, for `make_backend`, and a sentence that says which it is and why.

    wanted: one of `settings.DEVICES`; "auto" takes a GPU only if it has memory and passes a trial; "warp-cpu" runs the
    GPU's code on the CPU, slowly, to test it. Raises StgaError where "cuda" is wanted and there is no GPU that does.
    """
    if wanted in ("cpu", "warp-cpu"):
        return wanted, "training on the CPU, as asked for"
    found, reason = _find_gpu()
    if found is not None:
        return found, f"training on {reason}"
    if wanted == "cuda":
        raise StgaError(f"--device cuda: {reason}")
    return "cpu", f"training on the CPU: {reason}"


def make_backend(
    device: str, settings: "TrainingSettings", lengths: np.ndarray, frames: "FrameStore", state: "TrainState"
) -> "Backend":
    """What computes iterations on a device of `choose_device`.

    lengths (F,): what a triangle's limits are multiples of. Raises StgaError where the settings need another device.
    """
    if device == "cpu":
        from .cpu_backend import CpuBackend

        return CpuBackend(settings, lengths, frames, state)
    if settings.tracking:
        raise StgaError(f"effect tracking: FLAME's parameters are refined on the CPU only, not on {device}")
    from .gpu_backend import GpuBackend

    return GpuBackend("cpu" if device == "warp-cpu" else device, settings, lengths, frames, state)


def _find_gpu() -> tuple[str | None, str]:
    """The GPU to train on and its name, or None and what is missing."""
    if find_spec("warp") is None:
        return None, "the package warp-lang, which drives NVIDIA GPUs, is not installed"
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return None, "there is no NVIDIA driver"
    try:
        import warp

        from ...raster.gpu.self_test import compile_kernels, passes

        if not warp.is_cuda_available():
            return None, "the NVIDIA driver finds no GPU that it can use"
        device = warp.get_cuda_device()
        if device.free_memory < MIN_FREE_BYTES:
            return (
                None,
                f"{device.name} has {device.free_memory >> 20} MiB of memory free, {MIN_FREE_BYTES >> 20} are needed",
            )
        compile_kernels(device.alias)
        if not passes(device.alias):
            return None, f"{device.name} computes wrong numbers in a trial"
    except Exception as error:  # a driver or compiler may fail in any way; none of them may end a run on the CPU
        first_line = (str(error).strip() or repr(error)).splitlines()[0]
        return None, f"a trial on the GPU failed ({first_line})"
    return device.alias, f"{device.name} ({device.free_memory >> 20} MiB of memory free)"
