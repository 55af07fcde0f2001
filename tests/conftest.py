"""Fixtures that several test folders share."""

import gc
import os
import shutil
import signal
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

# Before OpenMP is loaded: its threads wait in a loop, and in tests, which run one per core, they
# would take the time of another test. Kernels have threads of their own (`raster/cpu/threads.py`),
# which sleep.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import kernels
import pytest
from capture import factory
from export.web.browser import find_browser
from filelock import FileLock

import stga_addon.development.commands  # noqa: F401  adds its commands, as `__main__` does
from stga_addon.capture.open import open_capture

MAX_PROCESSES = 8
"""Of up to 2 GB each."""
MIN_MEMORY_BYTES = 8 << 30
"""Free space of a memory disk with which the tests' files are kept there."""


def memory_disk(folder="/dev/shm"):
    """The variable that has pytest keep its temporary folders in memory, where this machine has
    enough: what the tests write, most of it flushed file by file, is then no wait."""
    if not hasattr(os, "ST_NOEXEC") or not os.path.isdir(folder):
        return {}
    found = os.statvfs(folder)
    fits = found.f_bavail * found.f_frsize >= MIN_MEMORY_BYTES and not found.f_flag & os.ST_NOEXEC
    return {"PYTEST_DEBUG_TEMPROOT": folder} if fits else {}


if "PYTEST_XDIST_WORKER" not in os.environ:  # those inherit it
    os.environ.update(memory_disk() | dict(os.environ))
    os.environ.update(kernels.shared_kernels())


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Two processes more than cores, because some tests wait: for a cluster, a browser or another
    process."""
    return min((os.cpu_count() or 1) + 2, MAX_PROCESSES)


def pytest_collection_finish():
    """Objects of modules and tests, which stay to the end, are no longer looked through for
    garbage."""
    gc.freeze()


def has_adapter():
    if find_spec("wgpu") is None:
        return False
    from stga_addon.raster.gpu.adapters import adapters

    return bool(adapters())


VALIDATION_LAYER = "vulkan/explicit_layer.d/VkLayer_khronos_validation.json"
TOOLS = {
    "adapter": (has_adapter, "no WebGPU adapter (Debian's software Vulkan: mesa-vulkan-drivers)"),
    "vulkan-validation": (
        lambda: any(
            Path(root, VALIDATION_LAYER).exists()
            for root in ("/usr/share", "/usr/local/share", "/etc")
        ),
        "no Vulkan validation layers (Debian: vulkan-validationlayers)",
    ),
    "chromium": (find_browser, "no Chromium (Debian: chromium)"),
    "node": (lambda: shutil.which("node"), "no Node.js (Debian: nodejs)"),
}
"""What tests marked `needs` use beyond the README's requirements: whether it is there, and what is
said where not."""


@cache
def missing(tool):
    is_there, reason = TOOLS[tool]
    return None if is_there() else reason


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Before any fixture, which might begin the work that the tool is for."""
    for mark in item.iter_markers("needs"):
        for tool in mark.args:
            if reason := missing(tool):
                pytest.skip(reason)


# A shell starts its background jobs deaf to Ctrl-C, which several tests send; the tests may run in
# one.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def alone(tmp_path_factory):
    """Name -> a lock that one at a time of the processes which run the tests holds, for what they
    have in common."""
    folder = tmp_path_factory.getbasetemp()
    common = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    return lambda name: FileLock(common / f"{name}.lock")


@pytest.fixture(scope="session")
def kernel_bundle():
    """Folder of all kernels as the complete edition brings them, and what raster/kernel_bits.py
    printed where they were compiled, in one process, which takes most of a minute."""
    folder = kernels.bundle()
    if folder is None:
        pytest.skip("no edition brings kernels for this platform")
    return folder, (folder / "bits.txt").read_text()


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory):
    """A ball of 10 cm, of one color per view: timesteps 0, 1, 3, 4 (the last one `test`), cameras 0
    to 3 (the last one `val`)."""
    return factory.write_mesh_capture(tmp_path_factory.mktemp("toy"), (0, 1, 3, 4), range(4))


@pytest.fixture(scope="session")
def toy(toy_root):
    return open_capture(toy_root)


@pytest.fixture(autouse=True, scope="session")
def known_transfers():
    """The light that reaches a mesh is found once: most captures here show the same ball, and for
    it this takes as long as their training."""
    estimate = import_module("stga_addon.light.estimate")
    find = estimate.transfer_of
    found = {}

    def known(vertices, faces, *directions):
        key = vertices.tobytes(), faces.tobytes(), *directions
        if key not in found:
            found[key] = find(vertices, faces, *directions)
        return tuple(array.copy() for array in found[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimate, "transfer_of", known)
        yield


@pytest.fixture(scope="session")
def take(tmp_path_factory):
    """footage/ of the small head, head.npz and its exact landmarks points/, for tests that only
    read it; without detail, so that landmarks alone are tracked, in a third of the time."""
    from flame.small_head import small_head
    from tracking.recording import record

    from stga_addon.tracking.head_model import HeadModel

    folder = tmp_path_factory.mktemp("take")
    record(folder, HeadModel(small_head(0), "flame"))
    return folder


@pytest.fixture(scope="session")
def shared_data():
    """Folder of development data (studio_head, raster_reference, …), which is not part of the
    project."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("STGA_DATA", beside))
    if not folder.is_dir():
        pytest.skip("shared data (studio_head, raster_reference, …) not present")
    return folder


@pytest.fixture(params=["cpu", pytest.param("gpu", marks=pytest.mark.needs("adapter"))])
def back_end(request, monkeypatch):
    """The kernels that a test's `render_differentiable` runs: Numba's, and WebGPU's on the first
    adapter."""
    if request.param == "gpu":
        from raster.gpu_autograd import render_differentiable

        for module in (request.module, sys.modules["raster.test_kernels"]):
            if hasattr(module, "render_differentiable"):
                monkeypatch.setattr(module, "render_differentiable", render_differentiable)
    return str(request.param)
