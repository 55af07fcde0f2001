"""Choice of the backend that trains on a device."""

from ...avatar.offsets import OFFSETS
from ...errors import StgaError
from ...raster.devices import adapter_name
from ..settings import TrainingSettings
from .backend import Backend
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .state import TrainState


def make_backend(
    device: str, settings: TrainingSettings, frames: FrameStore, state: TrainState
) -> Backend:
    """The backend of a device of `choose_device`. Raises StgaError where that does not support the
    settings."""
    if device == "cpu":
        return CpuBackend(settings, frames, state)
    if settings.tracking:
        text = f"FLAME parameters are refined on the CPU only, not on {device}"
        raise StgaError(f"--effect tracking=on: {text}")
    from ...raster.gpu.device import Device
    from ...raster.gpu.frames import SIGNALS
    from .gpu_backend import GpuBackend

    for name in state.driven_offsets:
        if OFFSETS[name].signal not in SIGNALS:
            raise StgaError(f"driven offset {name}: is trained on the CPU only, not on {device}")
    return GpuBackend(Device(adapter_name(device)), settings, frames, state)
