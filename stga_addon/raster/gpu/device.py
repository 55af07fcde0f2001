"""WebGPU device: buffers that grow, kernels from WGSL files, recorded work, late readback.

Work is recorded as commands, which are submitted at once; nothing waits for the device except
`read` and `Readback.result`. A failure of driver or memory becomes a DeviceError.
"""

import logging
import re
import weakref
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from time import sleep
from typing import Any, NamedTuple

import numpy as np
import wgpu
from wgpu.backends.wgpu_native import ffi, lib

from ...errors import DeviceError, StgaError
from .adapters import adapters, is_software
from .layout import MAX_GROUPS, UNIFORMS, WORKGROUP, prelude_wgsl

POLL_INTERVAL_S = 2e-4
"""Interval at which wgpu's thread looks for results that are waited for."""
LOST_CHECK_S = 0.5
"""Interval at which a thread that waits for a result looks whether the device failed."""
_TABLE = re.compile(r"^var<(uniform|storage)> (\w+)(.*)$", re.M)
"""Declaration of a table in WGSL: its kind, its name, and the rest of the line."""
_FUNCTION = re.compile(r"(?:^@compute[^\n]*\n)?^fn (\w+)(.*?)^\}", re.M | re.S)
"""Function in WGSL: its name, and its text from the parameters on."""
_WRITTEN = re.compile(r"^\s*(\w+)\[[^=;\n]*\][.\w]* [-+*|]?=\s|&(\w+)", re.M)
"""Table in WGSL that is assigned to, or whose address is taken."""
NONE: Mapping[str, Any] = {}
"""Tables of `Recording.dispatch` where all are the device's buffers of the same names."""
Groups = tuple[int, int, int] | tuple[Any, int]
"""Workgroups of a dispatch; or the buffer that holds them as three u32, and the offset in bytes."""


@dataclass(frozen=True)
class Kernel:
    """An entry point of a WGSL file, ready to be dispatched; tables: those that it uses, in the
    order of their bindings."""

    pipeline: Any
    layout: Any
    tables: tuple[str, ...]


class Device:
    """Buffers by name on one adapter; devices of the same adapter share its connection and compiled
    kernels.

    dispatches, submits, waits  how often work was dispatched, submitted and waited for by `read`
    failures                    what the driver raised while results were awaited
    """

    def __init__(self, name: str | None = None) -> None:
        """Open the adapter called `name` in `adapters()`, the first one by default."""
        known = adapters()
        if not known:
            text = "no graphics driver with Vulkan, Metal or Direct3D 12 was found"
            raise StgaError(f"--device gpu: {text}")
        self.name = name or next(iter(known))
        if self.name not in known:
            text = f"no such adapter; there are: {', '.join(known)}"
            raise StgaError(f"--device gpu:{self.name}: {text}")
        self.is_software = is_software(known[self.name])
        with self.errors():
            self.gpu, self._kernels, self.failures = _open(self.name)
        names = ("max-storage-buffer-binding-size", "max-buffer-size")
        self.max_bytes = min(self.gpu.limits[name] for name in names)
        self.dispatches = self.submits = self.waits = 0
        self._buffers: dict[str, Any] = {}
        self._groups: dict[tuple[int, ...], tuple[Any, list[Any]]] = {}
        self._recorded: dict[Hashable, list[_Command]] = {}

    @property
    def bytes(self) -> int:
        """Size of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def buffer(self, name: str, words: int, usage: str = "storage") -> Any:
        """A buffer of at least so many 32-bit words; the same memory until more is asked for, then
        fresh zeros.

        usage: "storage", "uniform", or "indirect" (storage that also holds the workgroups of a
        dispatch).
        """
        buffer = self._buffers.get(name)
        needed = 4 * max(words, 4)
        if buffer is None or buffer.size < needed:
            # An eighth to spare, so that a slowly growing count does not allocate every time.
            most = max(needed, self.max_bytes // 4 * 4)
            size = needed if buffer is None else min(needed + needed // 32 * 4, most)
            # which would keep the old buffer's memory
            self._groups.clear()
            self._recorded.clear()
            buffer = self._buffers[name] = self.new_buffer(name, size, _USAGE[usage])
        return buffer

    def new_buffer(self, name: str, size: int, usage: int) -> Any:
        """A buffer of so many bytes; usage: flags of WebGPU."""
        if size > self.max_bytes:
            allowed = f"{self.name} allows buffers of {self.max_bytes >> 20} MiB"
            raise DeviceError(
                f"{allowed} and one of {size >> 20} MiB is needed for {name}",
                "use smaller images or fewer splats, or continue on the CPU (--device cpu)",
            )
        with self.errors():
            return self.gpu.create_buffer(label=name, size=size, usage=usage)

    def upload(self, name: str, values: np.ndarray, usage: str = "storage") -> Any:
        """Copy an array, which may be changed as soon as this returns, to a buffer before the next
        submit.

        The driver keeps the copy until earlier work is done. Bytes are padded with zeros to whole
        words.
        """
        data = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        buffer = self.buffer(name, -(-data.size // 4), usage)
        whole = data.size // 4 * 4
        with self.errors():
            if whole:
                self.gpu.queue.write_buffer(buffer, 0, data, 0, whole)
            if whole < data.size:
                rest = np.pad(data[whole:], (0, 4 - data.size % 4))
                self.gpu.queue.write_buffer(buffer, whole, rest)
        return buffer

    def uniform(self, struct: str, name: str = "", **fields: Any) -> Any:
        """Send a struct of `UNIFORMS`, whose other fields are zero, before the next submit; name:
        of the buffer, where it is not the struct's in lower case."""
        record = np.zeros((), UNIFORMS[struct])
        for field, value in fields.items():
            record[field] = value
        return self.upload(name or struct.lower(), record, "uniform")

    def read(self, buffer: Any, shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """Wait for all submitted work and copy the beginning of a buffer to host memory."""
        count = int(np.prod(shape))
        if not count:
            return np.empty(shape, dtype)
        self.waits += 1
        words = -(-count * np.dtype(dtype).itemsize // 4)
        readback = Readback(self, words)
        with self.record() as work:
            readback.copy_from(work, (buffer, words))
        readback.start()
        return np.array(readback.result().view(dtype)[:count].reshape(shape))

    def kernel(self, name: str, **constants: float) -> Kernel:
        """The entry point "file.function", compiled once; constants: values of the file's
        `override` declarations."""
        key = name, *sorted(constants.items())
        if key not in self._kernels:
            file, entry = name.split(".")
            code, tables = _linked(file, entry)
            entries = [
                {"binding": n, "visibility": wgpu.ShaderStage.COMPUTE, "buffer": {"type": kind}}
                for n, kind in enumerate(tables.values())
            ]
            with self.errors():
                layout = self.gpu.create_bind_group_layout(entries=entries)
                module = self.gpu.create_shader_module(label=file, code=code)
                pipeline = self.gpu.create_compute_pipeline(
                    label=name,
                    layout=self.gpu.create_pipeline_layout(bind_group_layouts=[layout]),
                    compute={"module": module, "entry_point": entry, "constants": constants},
                )
            self._kernels[key] = Kernel(pipeline, layout, tuple(tables))
        return self._kernels[key]

    def bind(self, kernel: Kernel, tables: Mapping[str, Any]) -> Any:
        """The bind group of a kernel with the tables that it uses, which are the buffers of these
        names where they are not given; made once for the same buffers."""
        buffers = [
            tables[name] if name in tables else self._buffers[name] for name in kernel.tables
        ]
        key = id(kernel), *map(id, buffers)
        found = self._groups.get(key)
        if found is None:
            entries = [
                {"binding": n, "resource": {"buffer": buffer}} for n, buffer in enumerate(buffers)
            ]
            group = self.gpu.create_bind_group(layout=kernel.layout, entries=entries)
            # Kept with its buffers, so that no identity in the key is given to another one.
            found = self._groups[key] = group, buffers
        return found[0]

    def record(self, key: Hashable = None) -> "Recording":
        """Begin to record work; used as a context manager it is submitted at the end, and kept for
        `repeat` if it has a key."""
        return Recording(self, key)

    def repeat(self, key: Hashable) -> bool:
        """Submit what was recorded with that key again, to the same buffers; False where none is
        kept, or buffers have changed since."""
        commands = self._recorded.get(key)
        if commands is not None:
            self._submit(commands)
        return commands is not None

    def _submit(self, commands: "Sequence[_Command]") -> None:
        with self.errors():
            encoder = self.gpu.create_command_encoder()
            compute: Any = None
            for command in commands:
                if isinstance(command, _Dispatch):
                    if compute is None:
                        compute = encoder.begin_compute_pass()
                    command.encode(compute._internal)
                    continue
                if compute is not None:
                    compute.end()
                    compute = None
                command(encoder)
            if compute is not None:
                compute.end()
            self.gpu.queue.submit([encoder.finish()])
        self.submits += 1
        self.dispatches += sum(isinstance(command, _Dispatch) for command in commands)

    @staticmethod
    def groups_of(workgroups: int) -> tuple[int, int, int]:
        """At least so many workgroups, in rows of a length that every adapter allows."""
        rows = max(1, -(-workgroups // MAX_GROUPS))
        return -(-workgroups // rows), rows, 1

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn what driver and library raise into a DeviceError; mistakes in kernels pass."""
        try:
            yield
        except (wgpu.GPUError, RuntimeError) as error:
            text = str(error).lower()
            is_full = "memory" in text and "out of" in text
            if is_full or isinstance(error, wgpu.GPUOutOfMemoryError):
                raise DeviceError(
                    f"the memory of {self.name} is full",
                    "close other programs that use it, use smaller images or fewer splats, or "
                    "continue on the CPU (--device cpu)",
                ) from error
            if "lost" in text or "could not map" in text:
                _open.cache_clear()
                raise DeviceError(
                    f"{self.name} was lost (the driver was reset, or took too long)",
                    "try again, on the CPU (--device cpu) if it happens again; a run's checkpoint "
                    "is kept for --resume",
                ) from error
            raise


class _Dispatch(NamedTuple):
    """A kernel's pipeline, bind group and workgroups."""

    pipeline: Any
    group: Any
    groups: Groups

    def encode(self, compute: Any) -> None:
        """Encode by the library's functions: its methods look for an error after each call, which
        takes longer than the call. Errors are reported when the commands are finished."""
        lib.wgpuComputePassEncoderSetPipeline(compute, self.pipeline._internal)
        lib.wgpuComputePassEncoderSetBindGroup(compute, 0, self.group._internal, 0, ffi.NULL)
        if len(self.groups) == 2:
            buffer, offset = self.groups
            lib.wgpuComputePassEncoderDispatchWorkgroupsIndirect(compute, buffer._internal, offset)
        else:
            lib.wgpuComputePassEncoderDispatchWorkgroups(compute, *self.groups)


_Command = _Dispatch | Callable[[Any], None]
"""Or what an encoder gets between dispatches."""


class Recording:
    """Work for the device in the order in which it is recorded; each dispatch sees what those
    before it wrote.

    commands  recorded so far
    """

    def __init__(self, device: Device, key: Hashable = None) -> None:
        self.device = device
        self.commands: list[_Command] = []
        self._key = key

    def dispatch(
        self, name: str, threads: int | Groups, tables: Mapping[str, Any] = NONE, **constants: float
    ) -> None:
        """Run `Device.kernel` by at least so many threads or workgroups; tables: as in
        `Device.bind`."""
        kernel = self.device.kernel(name, **constants)
        groups = threads
        if isinstance(groups, int):
            # `thread_number` in WGSL numbers the threads
            groups = self.device.groups_of(-(-groups // WORKGROUP))
        if isinstance(groups[0], int) and 0 in groups:
            return
        bound = self.device.bind(kernel, tables)
        self.commands.append(_Dispatch(kernel.pipeline, bound, groups))

    def copy(self, source: Any, target: Any, words: int, to: int = 0) -> None:
        """Copy the first words of a buffer to another, from its word `to` on."""
        part = 0, target, 4 * to, 4 * words
        self.commands.append(lambda encoder: encoder.copy_buffer_to_buffer(source, *part))

    def clear(self, buffer: Any, words: int | None = None) -> None:
        """Fill the beginning of a buffer, or all of it, with zeros."""
        size = None if words is None else 4 * words
        self.commands.append(lambda encoder: encoder.clear_buffer(buffer, 0, size))

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Hand the work to the device, without waiting for it, unless there was an error."""
        if error is None:
            self.device._submit(self.commands)
            if self._key is not None:
                self.device._recorded[self._key] = self.commands


class Readback:
    """Results of one recording, a few words, that arrive in host memory while the host goes on."""

    def __init__(self, device: Device, words: int) -> None:
        self._device = device
        usage = wgpu.BufferUsage.COPY_DST | wgpu.BufferUsage.MAP_READ
        self._buffer = device.new_buffer("readback", -(-words // 2) * 8, usage)
        self._promise: Any = None

    def copy_from(self, recording: Recording, *parts: tuple[Any, int]) -> None:
        """Record the copy of the first words of some buffers; `start` is to follow the submit."""
        at = 0
        for buffer, words in parts:
            recording.copy(buffer, self._buffer, words, to=at)
            at += words

    def start(self) -> None:
        """Ask for the words as soon as the submitted work is done."""
        with self._device.errors():
            # Without the empty submit that wgpu makes for READ; its own `read_buffer` does the
            # same.
            self._promise = self._buffer.map_async("READ_NOSYNC")

    def result(self) -> np.ndarray:
        """The words, uint32; waits if the work is not done yet."""
        with self._device.errors():
            while not self._promise._thread_event.wait(LOST_CHECK_S):  # a lost device never answers
                if self._device.failures:
                    raise self._device.failures[0]
            self._promise.sync_wait()
            words = np.frombuffer(self._buffer.read_mapped(), np.uint32).copy()
            self._buffer.unmap()
        return words


_RAISED_LIMITS = (
    "max-storage-buffer-binding-size",
    "max-buffer-size",
    "max-storage-buffers-per-shader-stage",
    "max-compute-workgroup-storage-size",
)
_STORAGE = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
_USAGE = {
    "storage": _STORAGE,
    "indirect": _STORAGE | wgpu.BufferUsage.INDIRECT,
    "uniform": wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST | wgpu.BufferUsage.COPY_SRC,
}
# what it logs it also raises, and that is reported
logging.getLogger("wgpu").setLevel(logging.CRITICAL)


@cache
def _open(name: str) -> tuple[Any, dict[tuple, Kernel], list[Exception]]:
    """An adapter's device, with its limits raised, and room for compiled kernels and for
    failures."""
    adapter = adapters()[name]
    device = adapter.request_device_sync(
        required_limits={limit: adapter.limits[limit] for limit in _RAISED_LIMITS}
    )
    failures: list[Exception] = []
    reference = weakref.ref(device)

    def poll(_: bool) -> None:
        alive = reference()
        try:
            if alive is not None:
                alive._poll(False)
        except Exception as error:  # for the thread that waits
            failures.append(error)
            sleep(LOST_CHECK_S)
        sleep(POLL_INTERVAL_S)

    # wgpu's thread, which runs while a result is awaited, looks now and then whether it is there.
    # By itself it waits inside the driver for all submitted work, and holds a lock that the next
    # submit waits for. Private: a version without it is slower, not wrong.
    if hasattr(getattr(device, "_poller", None), "_poll_func"):
        device._poller._poll_func = poll
    return device, {}, failures


def _source(name: str) -> str:
    return files(__package__).joinpath(f"{name}.wgsl").read_text(encoding="utf-8")


def entry_points(file: str) -> list[str]:
    """The kernels of a WGSL file."""
    return re.findall(r"^@compute[^\n]*\nfn (\w+)", _source(file), re.M)


@cache
def _linked(file: str, entry: str) -> tuple[str, dict[str, str]]:
    """The text of an entry point with the functions that it calls, and the kind of each table that
    they use, in the order of their bindings.

    A table is bound for reading where none of them assigns to it: what only reads needs no barrier
    between dispatches.
    """
    code = re.sub("//.*", "", "\n".join([prelude_wgsl(), _source("common"), _source(file)]))
    bodies = dict(_FUNCTION.findall(code))
    reached = set[str]()
    left = {entry}
    while left:
        reached |= left
        called = {name for each in left for name in re.findall(r"\w+(?=\()", bodies[each])}
        left = called & bodies.keys() - reached
    body = "".join(bodies[name] for name in sorted(reached))
    used = set(re.findall(r"(?<![.\w])\w+", body))
    assigned = {name for pair in _WRITTEN.findall(body) for name in pair}
    tables: dict[str, str] = {}

    def declare(found: re.Match[str]) -> str:
        kind, name, rest = found.groups()
        if name not in used:
            return ""
        binding = f"@group(0) @binding({len(tables)})"
        if kind == "uniform":
            access = "uniform"
            tables[name] = "uniform"
        elif name in assigned:
            access = "storage, read_write"
            tables[name] = "storage"
        else:
            access = "storage, read"
            tables[name] = "read-only-storage"
        return f"{binding} var<{access}> {name}{rest}"

    code = _TABLE.sub(declare, code)
    return _FUNCTION.sub(lambda found: found[0] if found[1] in reached else "", code), tables
