"""GPU time of each kernel, by timestamp queries."""

from collections import Counter
from typing import Any

import numpy as np
import wgpu
from wgpu.backends.wgpu_native import lib

MAX_DISPATCHES = 2048
"""Dispatches that are timed between two readings; later ones are not."""


class KernelTimes:
    """Times what is recorded for a device while this is its `kernel_times`, each dispatch in a pass of its own."""

    def __init__(self, gpu: Any) -> None:
        """gpu: `Device.gpu`. Raises ValueError where the adapter has no timestamps."""
        if "timestamp-query" not in gpu.features:
            raise ValueError(f"{gpu.adapter.info['device']} has no timestamp queries")
        self._gpu, self._names = gpu, list[str]()
        self._resolved = 0
        self._queries = gpu.create_query_set(type="timestamp", count=2 * MAX_DISPATCHES)
        usage = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
        self._stamps = gpu.create_buffer(size=16 * MAX_DISPATCHES, usage=usage)
        self._period_ns = float(lib.wgpuQueueGetTimestampPeriod(gpu.queue._internal))

    def writes(self, name: str) -> dict[str, Any] | None:
        """The `timestamp_writes` of the pass that the next dispatch is alone in."""
        first = 2 * len(self._names)
        if first == 2 * MAX_DISPATCHES:
            return None
        self._names.append(name)
        return {
            "query_set": self._queries,
            "beginning_of_pass_write_index": first,
            "end_of_pass_write_index": first + 1,
        }

    def resolve(self, encoder: Any) -> None:
        """Record that the stamps written since the last call are copied where `read` finds them."""
        first, count = 2 * self._resolved, 2 * (len(self._names) - self._resolved)
        for begin in range(first, first + count, _PER_RESOLVE):
            # Places in the buffer are multiples of 256 bytes: so are runs of 32 stamps from the beginning.
            some = min(_PER_RESOLVE, first + count - begin)
            start = begin // _PER_RESOLVE * _PER_RESOLVE
            encoder.resolve_query_set(self._queries, start, begin + some - start, self._stamps, 8 * start)
        self._resolved = len(self._names)

    def read(self) -> dict[str, float]:
        """kernel -> milliseconds since the last call, after all submitted work, longest first."""
        total: Counter[str] = Counter()
        if self._names:
            data = self._gpu.queue.read_buffer(self._stamps, 0, 16 * len(self._names))
            stamps = np.frombuffer(data, np.uint64).reshape(-1, 2)
            for name, (begin, end) in zip(self._names, stamps.tolist(), strict=True):
                total[name] += 1e-6 * self._period_ns * max(end - begin, 0)
        self._names.clear()
        self._resolved = 0
        return dict(total.most_common())


_PER_RESOLVE = 32
