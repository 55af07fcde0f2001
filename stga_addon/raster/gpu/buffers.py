"""Device memory that is reused between iterations."""

from typing import Any

import numpy as np
import warp as wp


class DeviceBufferPool:
    """Buffers by name; on the CPU, `pinned` ones may be copied from while the host goes on."""

    def __init__(self, device: wp.Device, pinned: bool = False) -> None:
        self.device, self._pinned = device, pinned
        self._views: dict[str, wp.array] = {}
        self._buffers: dict[str, wp.array] = {}

    def get(self, name: str, shape: int | tuple[int, ...], dtype: Any = wp.float32) -> wp.array:
        """An uninitialized array; the same memory whenever the same name, of one dtype, is taken again."""
        shape = (shape,) if isinstance(shape, int) else shape
        view = self._views.get(name)
        if view is not None and view.shape == shape:
            return view
        size = int(np.prod(shape))
        if not size:
            return wp.empty(shape, dtype, device=self.device)
        buffer = self._buffers.get(name)
        if buffer is None or buffer.size < size:
            wp.synchronize()  # running kernels may still use the memory that is freed
            self._views.pop(name, None)
            # An eighth to spare, so that a slowly growing count does not allocate every time.
            buffer = self._buffers[name] = wp.empty(size + size // 8, dtype, device=self.device, pinned=self._pinned)
        view = self._views[name] = buffer[:size].reshape(shape)
        return view
