"""Fixtures that several test folders share."""

import os
import signal
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from zlib import crc32

# Before OpenMP is loaded: its threads wait in a loop, and in tests, which run one per core, they would take the time of
# another test. Kernels have threads of their own (`raster/cpu/threads.py`), which sleep.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from capture import factory
from filelock import FileLock

from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture

# A shell starts its background jobs deaf to Ctrl-C, which several tests send; the tests may run in one.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], FileLock]:
    """Name -> a lock that one at a time of the processes which run the tests holds, for what they have in common."""
    folder = tmp_path_factory.getbasetemp()
    common = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    return lambda name: FileLock(common / f"{name}.lock")


BITS = """
import contextlib, runpy
with open(os.environ["NUMBA_CACHE_DIR"] + "/bits.txt", "w") as file, contextlib.redirect_stdout(file):
    runpy.run_path({!r})
"""


@pytest.fixture(scope="session")
def kernel_bundle(alone: Callable[[str], FileLock], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of all kernels as the complete edition brings them, and what raster/kernel_bits.py printed where they were
    compiled, in one process, which takes half a minute. build/kernels keeps both until a kernel changes."""
    from stga_addon.development import compiled_kernels
    from stga_addon.development.wheels import Target, this_platform

    script = Path(__file__).with_name("raster") / "kernel_bits.py"
    target = Target(this_platform(), "{}.{}".format(*sys.version_info[:2]), ("4.2.0", ""))
    wheels = tmp_path_factory.mktemp("wheels")
    (wheels / f"numba-{version('numba')}-tests{crc32(script.read_bytes())}").touch()
    changed = compiled_kernels.SCRIPT.replace("from", "os.cpu_count = lambda: 1\nfrom", 1)
    changed = changed.replace("print(", BITS.format(str(script)) + "print(")
    with alone("kernels"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_kernels, "SCRIPT", changed)
        kernels = compiled_kernels.compile_kernels(target, wheels)
    if not kernels:
        pytest.skip("no edition brings kernels for this platform")
    folder = kernels[0].parents[1]
    return folder, (folder / "bits.txt").read_text()


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of 10 cm, of one color per view: timesteps 0, 1, 3, 4 (the last one `test`), cameras 0 to 3 (the last one
    `val`)."""
    return factory.write_mesh_capture(tmp_path_factory.mktemp("toy"), (0, 1, 3, 4), range(4))


@pytest.fixture(scope="session")
def toy(toy_root: Path) -> Capture:
    return open_capture(toy_root)


@pytest.fixture(scope="session")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """footage/ of the demo's head, head.npz and its exact landmarks points/, for tests that only read it; in black, so
    that landmarks alone are tracked, in a third of the time."""
    from tracking.test_track import record

    from stga_addon.development.demo.head import synthetic_flame
    from stga_addon.tracking.head_model import HeadModel

    folder = tmp_path_factory.mktemp("take")
    record(folder, HeadModel(synthetic_flame(0), "flame"))
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of development data (studio_head, raster_reference, …), which is not part of the project."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("STGA_DATA", beside))
    if not folder.is_dir():
        pytest.skip("shared data (studio_head, raster_reference, …) not present")
    return folder


@pytest.fixture(params=["cpu", "gpu"])
def back_end(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The kernels that a test's `render_differentiable` runs: Numba's, and WebGPU's on the first adapter."""
    if request.param == "gpu":
        from raster import gpu_device

        gpu_device.device()  # or skip
        from raster.gpu_autograd import render_differentiable

        for module in (request.module, sys.modules["raster.test_kernels"]):
            if hasattr(module, "render_differentiable"):
                monkeypatch.setattr(module, "render_differentiable", render_differentiable)
    return str(request.param)
