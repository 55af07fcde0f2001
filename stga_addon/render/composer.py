"""Pictures of splats, made on the chosen device."""

import logging
from collections.abc import Sequence

from ..capture.camera import Camera
from ..errors import DeviceError, one_line
from ..raster.devices import GPU, choose_device, first_line
from ..raster.posed_splats import ComposedImage, PosedSplats


class Composer:
    """Renders layers on a device, which is chosen with the first image.

    requested   see `choose_device`; with "auto", the CPU renders from a GPU's first failure on
    device   the one that was chosen; "" before
    failure  why the CPU took over; "" where it did not
    """

    def __init__(self, requested: str = "auto") -> None:
        self.requested = requested
        self.device = ""
        self.failure = ""

    def choose(self) -> str:
        """The device of the next image. Raises StgaError where one asked for by name fails."""
        if not self.device:
            self.device, _ = choose_device(self.requested, "Rendering")
        return self.device

    def compose(
        self, layers: Sequence[PosedSplats], camera: Camera, with_depth: bool = False
    ) -> ComposedImage:
        """See `cpu.compose.compose`. Raises StgaError where a device asked for by name fails."""
        if self.choose() != "cpu":
            from ..raster.gpu import compose as gpu

            try:
                return gpu.compose(self.device.removeprefix(GPU), layers, camera, with_depth)
            except Exception as error:  # a driver raises what it likes
                if self.requested != "auto":
                    raise
                cause = f"{self.device}: {first_line(error)}"
                cause = error.cause if isinstance(error, DeviceError) else cause
                self.device = "cpu"
                self.failure = one_line(f"{cause}; the CPU renders instead")
                logging.getLogger(__name__).warning(self.failure)
        from ..raster.cpu import compose as cpu

        return cpu.compose(layers, camera, with_depth)
