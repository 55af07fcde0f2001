"""Choice of the backend that trains on a device."""

import numpy as np

from ...errors import StgaError
from ...render.device import adapter_name
from ..settings import TrainingSettings
from .backend import Backend
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .state import TrainState


def make_backend(
    device: str, settings: TrainingSettings, units: np.ndarray, frames: FrameStore, state: TrainState
) -> Backend:
    """The backend of a device of `choose_device`.

    units (F,): see `losses.limit_units`. Raises StgaError if the device does not support the settings.
    """
    if device == "cpu":
        return CpuBackend(settings, units, frames, state)
    if settings.tracking:
        raise StgaError(f"--effect tracking=on: FLAME parameters are refined on the CPU only, not on {device}")
    from ...raster.gpu.device import Device  # needs wgpu, which training on the CPU does without
    from ...raster.gpu.driven_offsets import SIGNALS
    from .gpu_backend import GpuBackend

    for name in state.driven_offsets:
        if name not in SIGNALS:
            raise StgaError(f"driven offset {name}: is trained on the CPU only, not on {device}")
    return GpuBackend(Device(adapter_name(device)), settings, units, frames, state)
