"""Choice of the device that trains or renders, and the message if the wanted one cannot be used."""

import subprocess
import sys
from types import SimpleNamespace

import pytest
from refusal import refusal

from stga_addon.raster import devices as device_module
from stga_addon.raster.devices import adapter_names, choose_device, is_device

pytest.importorskip("wgpu")

from stga_addon.raster.gpu import adapters as gpu
from stga_addon.raster.gpu import device as gpu_device
from stga_addon.raster.gpu import trial
from stga_addon.raster.gpu.trial import Trial

CARD = "Card 9000 (Vulkan)"
OTHER = "Card 9000 (DX12)"
SOFTWARE = "llvmpipe (Vulkan)"


@pytest.fixture
def trials(monkeypatch):
    """Two names of a card and a software adapter; what a trial of each finds."""
    kinds = {CARD: "DiscreteGPU", OTHER: "DiscreteGPU", SOFTWARE: "CPU"}
    adapters = {name: SimpleNamespace(info={"adapter_type": kind}) for name, kind in kinds.items()}
    found = {name: Trial(1e-6, 0.002, 0.02) for name in adapters}
    monkeypatch.setattr(gpu, "adapters", lambda: adapters)
    monkeypatch.setattr(gpu_device, "Device", lambda name: name)
    monkeypatch.setattr(trial, "try_device", lambda name: found[name])
    device_module._trial.cache_clear()
    yield found
    device_module._trial.cache_clear()


def test_a_right_and_faster_gpu_is_taken(trials):
    """Catches a device that was not meant, and a broken driver that hides another one."""
    assert choose_device("auto") == choose_device("gpu")
    chosen, why = choose_device("auto")
    assert chosen == f"gpu:{CARD}"
    trial = "10.0 times as fast as the CPU in a trial (2.0 and 20.0 ms an image)"
    assert why == f"Training on {CARD}, {trial}"
    assert choose_device("cpu")[0] == "cpu"
    assert choose_device("gpu:dx12")[0] == f"gpu:{OTHER}"
    trials[CARD] = Trial(0.5, 0.002, 0.02)
    device_module._trial.cache_clear()
    assert choose_device("auto")[0] == f"gpu:{OTHER}"


def test_software_is_only_taken_by_name(trials, monkeypatch):
    """Catches "auto" that trains on software Vulkan, and a test machine on which nobody can."""
    trials[CARD] = trials[OTHER] = Trial(1e-6, 0.04, 0.02)
    chosen, why = choose_device("auto")
    assert chosen == "cpu"
    assert why.startswith(
        f"Training on the CPU: {CARD} is 2.0 times slower than the CPU in a trial (40.0 and 20.0 ms"
    )
    assert choose_device("gpu:llvm")[0] == f"gpu:{SOFTWARE}"
    software = {SOFTWARE: SimpleNamespace(info={"adapter_type": "CPU"})}
    monkeypatch.setattr(gpu, "adapters", lambda: software)
    assert choose_device("auto") == ("cpu", "Training on the CPU: no GPU was found")
    assert adapter_names() == [SOFTWARE]


def test_no_gpu_within_few_addresses(trials, monkeypatch):
    """Catches WebGPU's library, which waits for ever there, loaded under a limit of addresses."""
    monkeypatch.setattr(device_module, "address_space_gb", lambda: 1.2)
    chosen, why = choose_device("auto")
    assert (chosen, "not 1.2 GB of addresses (ulimit -v)" in why) == ("cpu", True)
    with refusal("not 1.2 GB of addresses"):
        choose_device("gpu")


@pytest.mark.parametrize("error", [0.02, float("nan")])
def test_wrong_gradients_are_refused(trials, error):
    """Catches training on a driver that computes something else."""
    for name in trials:
        trials[name] = Trial(error, 0.002, 0.02)
    with refusal(r"^--device gpu: Card .* computes gradients that differ"):
        choose_device("gpu")
    assert choose_device("auto")[0] == "cpu"


def test_names_that_fit_none_or_several(trials):
    """Catches an adapter that nobody meant, and a file that names nonsense."""
    with refusal(r"^--device gpu:card: several adapters .*llvmpipe"):
        choose_device("gpu:card")
    with refusal("^--device gpu:Voodoo: no adapter of that name; there are: Card"):
        choose_device("gpu:Voodoo")
    assert all(map(is_device, ("auto", "cpu", "gpu", "gpu:any name")))
    wrong = "", "gpu:", "cuda", "gpux", None, 3, ["cpu"], "gpu:" + 999 * "x"
    assert not any(map(is_device, wrong))


def raises(name):
    raise RuntimeError("device lost\nand more lines")


@pytest.mark.parametrize(
    ("place", "name", "stand_in", "reason"),
    [
        (device_module, "find_spec", lambda name: None, "package wgpu .* is not installed"),
        (gpu, "adapters", dict, "no graphics driver with Vulkan"),
    ],
)
def test_what_is_wrong_is_said(trials, monkeypatch, place, name, stand_in, reason):
    """Catches a traceback, a silent fallback, and training on a GPU that cannot."""
    monkeypatch.setattr(place, name, stand_in)
    with refusal(f"^--device gpu: .*{reason}"):
        choose_device("gpu")
    chosen, why = choose_device("auto")
    assert chosen == "cpu"
    assert why.startswith("Training on the CPU: ")
    assert "--device" not in why


def test_a_driver_that_fails_leaves_the_cpu(trials, monkeypatch):
    """Catches "auto" that ends in a driver's traceback."""
    works = trial.try_device
    broken = {CARD}
    monkeypatch.setattr(trial, "try_device", lambda n: raises(n) if n in broken else works(n))
    assert choose_device("auto")[0] == f"gpu:{OTHER}"
    device_module._trial.cache_clear()
    broken.add(OTHER)
    reasons = f"{CARD} fails (device lost); {OTHER} fails (device lost)"
    assert choose_device("auto") == ("cpu", f"Training on the CPU: {reasons}")


def test_wgpu_is_imported_only_where_it_works():
    """Catches a run on the CPU that needs wgpu, or waits for a driver."""
    script = (
        "import sys; from stga_addon.raster import devices; "
        "from stga_addon.training.run import session; "
        "devices.choose_device('cpu'); sys.exit('wgpu' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], timeout=120).returncode == 0
