"""The strain around each triangle (`avatar.strain.smoothed_strain`), computed on the device."""

from typing import Any

from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, StrainBasis
from .device import Device, Recording
from .layout import list_words

INCLUDE = ("pose",)


class SmoothedStrain:
    """The signal of one mesh, whose neighborhood is uploaded once."""

    def __init__(self, device: Device, basis: StrainBasis) -> None:
        self._count = len(basis.faces)
        self._neighbors = device.upload("neighbors", list_words(basis.neighbors))
        self._rounds = [device.buffer(f"smoothed strain {n}", self._count * STRAIN_COMPONENTS) for n in range(2)]

    def record(self, work: Recording, pose: Any, strain_from_rest: Any) -> Any:
        """Record the signal of the pose whose strain (F, 3), less that at rest, is given; returns its table (F, 3)."""
        device, averaged = work.device, strain_from_rest
        for n in range(AVERAGING_ROUNDS):
            smoothed, averaged = averaged, self._rounds[n % 2]
            work.dispatch(
                device.kernel("smoothed_strain", include=INCLUDE), device.groups(self._count), pose=pose,
                neighbors=self._neighbors, smoothed=smoothed, averaged=averaged,
            )  # fmt: skip
        return averaged

    @staticmethod
    def compile_kernels(device: Device) -> None:
        """Compile what `record` dispatches."""
        device.kernel("smoothed_strain", include=INCLUDE)
