"""Asynchronous copies from host to device, while the device still computes with the previous arrays."""

from typing import Any

import numpy as np
import warp as wp

from .buffers import DeviceBufferPool


class Uploads:
    """Sends an iteration's inputs on a stream of its own, from pinned host memory.

    Inputs are double-buffered: an iteration's arrays are overwritten by the iteration after the next. Memory does not
    grow with the number of iterations.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._buffers = [DeviceBufferPool(device), DeviceBufferPool(device)]
        self._pinned = DeviceBufferPool(wp.get_device("cpu"), pinned=device.is_cuda)
        self._stream = wp.Stream(device) if device.is_cuda else None
        self._current = 0

    def begin(self) -> None:
        """Switch buffers; to be called before an iteration's first array, once the previous iteration is launched."""
        self._current = 1 - self._current

    def send(self, name: str, values: np.ndarray, dtype: Any) -> wp.array:
        """Start copying `values`, which may be changed as soon as this returns.

        dtype: a scalar, or a vector or matrix that holds the last axes.
        """
        rank = len(getattr(dtype, "_shape_", ()))
        shape = values.shape[: values.ndim - rank]
        target = self._buffers[self._current].get(name, shape, dtype)
        if not values.size:
            return target
        source = self._pinned.get(name, shape, dtype)
        np.copyto(source.numpy(), values, casting="unsafe")
        wp.copy(target, source, stream=self._stream)
        return target

    def finish(self) -> None:
        """Make everything that is launched from now on wait for the copies."""
        if self._stream is not None:
            wp.get_stream(self.device).wait_stream(self._stream)
