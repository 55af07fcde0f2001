"""The device that trains or renders: the GPU where it is right and faster."""

from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ..errors import StgaError
from ..worker.machine import address_space_gb

if TYPE_CHECKING:  # without a GPU, choosing needs numpy only
    from .gpu.trial import Trial

GPU = "gpu:"
"""Prefix of the adapter's name in a device."""
DEVICES = ("auto", "cpu", "gpu")
"""Choices of `choose_device`, beside "gpu:NAME"."""
EXPECTED_DEVICE = "auto, cpu, gpu or gpu:NAME"
"""Devices, as messages about a wrong one list them."""
MAX_DEVICE_LENGTH = 255
"""Largest number of characters in the name of a device."""
MIN_ADDRESS_SPACE_GB = 4.0
"""Addresses below which WebGPU's library was seen to wait for ever, at 0.7, for a thread that could
not be started."""


def is_device(value: Any) -> bool:
    """Whether a value is one of DEVICES or "gpu:" and a name."""
    is_named = isinstance(value, str) and value.startswith(GPU)
    return value in DEVICES or (is_named and len(GPU) < len(value) <= MAX_DEVICE_LENGTH)


def choose_device(requested: str, task: str = "Training") -> tuple[str, str]:
    """The device, "cpu" or "gpu:" and an adapter's name, and a sentence that explains the choice.

    requested: "auto", "cpu", "gpu" (the first adapter) or "gpu:NAME" (the adapter of that name, or
    the only one with this part in its name). "auto" takes the first adapter that is not software,
    right and faster than the CPU.
    task: what is done there. Raises StgaError if a GPU is requested and none works.
    """
    if requested == "cpu":
        return "cpu", f"{task} on the CPU (--device cpu)"
    if requested == "auto":
        return _fastest(task)
    adapter = adapter_name(requested)
    trial = _trial(adapter)
    if not trial.is_right:
        raise StgaError(
            f"--device {requested}: {_wrong(adapter, trial)}; choose another adapter, "
            "or give --device cpu"
        )
    return GPU + adapter, f"{task} on {adapter}, {_comparison(trial)}"


def adapter_names(software: bool = True) -> list[str]:
    """The adapters of `choose_device`, real GPUs first. Raises StgaError if there is none."""
    if find_spec("wgpu") is None:
        raise StgaError("--device gpu: the package wgpu (WebGPU) is not installed")
    given = address_space_gb()
    if given < MIN_ADDRESS_SPACE_GB:
        limit = f"{given:.1f} GB of addresses (ulimit -v)"
        raise StgaError(
            f"--device gpu: expected {MIN_ADDRESS_SPACE_GB:g} GB or no limit, not {limit}"
        )
    from .gpu.adapters import adapters, is_software

    names = [name for name, adapter in adapters().items() if software or not is_software(adapter)]
    if not names:
        found = "no GPU" if adapters() else "no graphics driver with Vulkan, Metal or Direct3D 12"
        raise StgaError(f"--device gpu: {found} was found")
    return names


def adapter_name(device: str) -> str:
    """The adapter's name for "gpu" or "gpu:NAME". Raises StgaError unless there is just one."""
    names = adapter_names()
    part = device.removeprefix(GPU)
    if device == "gpu" or part in names:
        return names[0] if device == "gpu" else part
    found = [name for name in names if part.lower() in name.lower()]
    if len(found) == 1:
        return found[0]
    which = "several adapters" if found else "no adapter"
    raise StgaError(f"--device {device}: {which} of that name; there are: {', '.join(names)}")


def _fastest(task: str) -> tuple[str, str]:
    """The first real GPU that is right and faster than the CPU, or the CPU and why."""
    try:
        names = adapter_names(software=False)
    except Exception as error:  # whatever a driver raises, the CPU still works
        return "cpu", f"{task} on the CPU: {first_line(error)}"
    reasons = []
    for adapter in names:
        try:
            trial = _trial(adapter)
        except Exception as error:
            reasons.append(f"{adapter} fails ({first_line(error)})")
            continue
        if trial.is_right and trial.device_s < trial.cpu_s:
            return GPU + adapter, f"{task} on {adapter}, {_comparison(trial)}"
        is_slow = f"{adapter} is {_comparison(trial)}"
        reasons.append(is_slow if trial.is_right else _wrong(adapter, trial))
    return "cpu", f"{task} on the CPU: {'; '.join(reasons)}"


def first_line(error: Exception) -> str:
    """The text of a driver's error, without its details."""
    return (str(error).strip() or repr(error)).splitlines()[0].removeprefix("--device gpu: ")


@cache
def _trial(adapter: str) -> "Trial":
    from .gpu.device import Device
    from .gpu.trial import try_device

    return try_device(Device(adapter))


def _comparison(trial: "Trial") -> str:
    """How fast a device is compared with the CPU, and the time of an image on each."""
    times = f"{1e3 * trial.device_s:.1f} and {1e3 * trial.cpu_s:.1f} ms an image"
    faster = trial.cpu_s / trial.device_s
    slower = trial.device_s / trial.cpu_s
    fraction = f"{faster:.1f} times as fast as" if faster > 1 else f"{slower:.1f} times slower than"
    return f"{fraction} the CPU in a trial ({times})"


def _wrong(adapter: str, trial: "Trial") -> str:
    return f"{adapter} computes gradients that differ from the CPU's by {100 * trial.error:.2g} %"
