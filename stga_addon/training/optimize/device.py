"""Choice of the training device: a working NVIDIA GPU, else the CPU."""

import ctypes
import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from ...errors import StgaError

if TYPE_CHECKING:  # choosing a device needs neither torch nor numba
    from ..settings import TrainingSettings
    from .backend import Backend
    from .frames import FrameStore
    from .state import TrainState

MIN_FREE_BYTES = 1 << 30
"""Free GPU memory that training needs at least."""


def choose_device(wanted: str) -> tuple[str, str]:
    """The device to train on, for `make_backend`, and a sentence that explains the choice.

    wanted: one of `settings.DEVICES`; "auto" takes a GPU if it has enough memory and passes the self-test; "warp-cpu"
    runs the GPU's code on the CPU, slowly, for tests. Raises StgaError if "cuda" is wanted and no GPU qualifies.
    """
    if wanted in ("cpu", "warp-cpu"):
        return wanted, f"Training on the CPU (--device {wanted})"
    found, reason = _find_gpu()
    if found is not None:
        return found, f"Training on {reason}"
    if wanted == "cuda":
        raise StgaError(f"--device cuda: {reason}")
    return "cpu", f"Training on the CPU: {reason}"


def make_backend(
    device: str, settings: "TrainingSettings", units: np.ndarray, frames: "FrameStore", state: "TrainState"
) -> "Backend":
    """The backend of a device of `choose_device`.

    units (F,): see `losses.limit_units`. Raises StgaError if the device does not support the settings.
    """
    if device == "cpu":
        from .cpu_backend import CpuBackend

        return CpuBackend(settings, units, frames, state)
    if settings.tracking:
        raise StgaError(f"--effect tracking=on: FLAME parameters are refined on the CPU only, not on {device}")
    from .gpu_backend import GpuBackend

    return GpuBackend("cpu" if device == "warp-cpu" else device, settings, units, frames, state)


def _find_gpu() -> tuple[str | None, str]:
    """The GPU to train on and its description, or None and the reason why there is none."""
    if find_spec("warp") is None:
        return None, "the package warp-lang (NVIDIA Warp) is not installed"
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return None, "there is no NVIDIA driver"
    try:
        import warp

        from ...raster.gpu.self_test import compile_kernels, passes

        if not warp.is_cuda_available():
            return None, "the NVIDIA driver finds no usable GPU"
        device = warp.get_cuda_device()
        if device.free_memory < MIN_FREE_BYTES:
            free, needed = device.free_memory >> 20, MIN_FREE_BYTES >> 20
            return None, f"{device.name} has {free} MiB of free memory; training needs at least {needed} MiB"
        compile_kernels(device.alias)
        if not passes(device.alias):
            return None, f"{device.name} fails the self-test: its results are wrong"
    except Exception as error:  # whatever a driver or compiler raises, the CPU can still train
        first_line = (str(error).strip() or repr(error)).splitlines()[0]
        return None, f"the GPU self-test failed ({first_line})"
    return device.alias, f"{device.name} ({device.free_memory >> 20} MiB of free memory)"
