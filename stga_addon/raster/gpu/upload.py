"""Asynchronous copies from host to device, while the device still computes with the previous arrays."""

from typing import Any

import numpy as np
import warp as wp

from .buffers import DeviceBufferPool


class Uploads:
    """Sends an iteration's inputs on a stream of its own, from memory that the device may read without the host.

    Each input has two places on the device, taken in turn: what one iteration reads stays until the one after the next
    begins. Memory does not depend on how many arrays are sent.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._there = [DeviceBufferPool(device), DeviceBufferPool(device)]
        self._pinned = DeviceBufferPool(wp.get_device("cpu"), pinned=device.is_cuda)
        self._stream = wp.Stream(device) if device.is_cuda else None
        self._turn = 0

    def begin(self) -> None:
        """Before an iteration's first array; the one before must have begun on the device, so that it read its own."""
        self._turn = 1 - self._turn

    def send(self, name: str, values: np.ndarray, dtype: Any) -> wp.array:
        """Start to copy an array; `values` may change at once. dtype may be a vector, then it is the last axes."""
        rank = len(getattr(dtype, "_shape_", ()))
        shape = values.shape[: values.ndim - rank]
        there = self._there[self._turn].get(name, shape, dtype)
        if not values.size:
            return there
        here = self._pinned.get(name, shape, dtype)
        np.copyto(here.numpy(), values, casting="unsafe")
        wp.copy(there, here, stream=self._stream)
        return there

    def finish(self) -> None:
        """Whatever is launched from here on sees what was sent."""
        if self._stream is not None:
            wp.get_stream(self.device).wait_stream(self._stream)
