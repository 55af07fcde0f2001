"""Choice of the training device, and the message if the wanted one cannot be used."""

import ctypes
import subprocess
import sys
from types import SimpleNamespace

import pytest

from stga_addon.errors import StgaError
from stga_addon.raster.gpu import self_test
from stga_addon.training.optimize import device as device_module
from stga_addon.training.optimize.device import MIN_FREE_BYTES, choose_device

warp = pytest.importorskip("warp")


class Gpu(SimpleNamespace):
    """A GPU as Warp describes it, with everything in order."""

    def __init__(self, **changes: object) -> None:
        super().__init__(**{"name": "Card", "alias": "cuda:0", "free_memory": 8 << 30, **changes})


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Gpu:
    """A machine with a GPU whose kernels do nothing."""
    card = Gpu()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    monkeypatch.setattr(warp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(warp, "get_cuda_device", lambda: card)
    monkeypatch.setattr(self_test, "compile_kernels", lambda name: None)
    monkeypatch.setattr(self_test, "passes", lambda name: True)
    return card


def test_a_working_gpu_is_taken(gpu: Gpu) -> None:
    """Catches "auto" that never takes the GPU, and "cpu" that does."""
    for wanted in ("auto", "cuda"):
        assert choose_device(wanted) == ("cuda:0", "Training on Card (8192 MiB of free memory)")
    assert choose_device("cpu")[0] == "cpu"
    assert choose_device("warp-cpu")[0] == "warp-cpu"


def broken(name: str) -> None:
    raise RuntimeError("nvrtc: too old\nand more lines")


def no_driver(name: str) -> None:
    raise OSError(name)


WRONG = {
    "no package": ((device_module, "find_spec", lambda name: None), "warp-lang .* is not installed"),
    "no driver": ((ctypes, "CDLL", no_driver), "no NVIDIA driver"),
    "no card": ((warp, "is_cuda_available", lambda: False), "finds no usable GPU"),
    "no memory": (
        (warp, "get_cuda_device", lambda: Gpu(free_memory=MIN_FREE_BYTES // 2)),
        "512 MiB .* at least 1024 MiB",
    ),
    "no compiler": ((self_test, "compile_kernels", broken), r"failed \(nvrtc: too old\)$"),
    "wrong numbers": ((self_test, "passes", lambda name: False), "fails the self-test: its results are wrong"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_said_and_only_auto_falls_back(gpu: Gpu, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """Catches a traceback, a silent fallback, and training on a GPU that cannot."""
    place, reason = WRONG[what]
    monkeypatch.setattr(*place)
    with pytest.raises(StgaError, match=f"^--device cuda: .*{reason}"):
        choose_device("cuda")
    chosen, why = choose_device("auto")
    assert chosen == "cpu"
    assert why.startswith("Training on the CPU: ")


def test_warp_is_imported_only_where_it_works() -> None:
    """Catches a run on the CPU that needs warp-lang, or waits for it to start."""
    script = (
        "import sys; from stga_addon.training.optimize import device; from stga_addon.training.run import loop; "
        "device.choose_device('cpu'); sys.exit('warp' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], timeout=120).returncode == 0
