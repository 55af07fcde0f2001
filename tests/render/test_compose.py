"""Layers rendered by the device that is there, and what happens where it fails."""

import logging
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raster import gpu_device
from refusal import refusal

from render.test_client import CAMERA, cloud, embedded, world
from stga_addon.errors import DeviceError
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.gpu import compose as gpu
from stga_addon.render import client as render_client
from stga_addon.render import composer as compose_module
from stga_addon.render.client import RenderClient
from stga_addon.render.composer import Composer

TOLERANCE = 2e-5


@pytest.fixture(scope="module")
def adapter():
    return gpu_device.device().name


def scene():
    """Layers of different degrees, places, colors and antialiasing."""
    place = np.diag([1.2, 1.2, 1.2, 1.0])
    place[:3, :3] = place[:3, :3] @ [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    gray = cloud(70, 4)
    return [embedded(), world(cloud()), world(replace(gray, sh=gray.sh[:, :1]), place)]


def assert_same_picture(got, want):
    assert_allclose(got.rgb, want.rgb, atol=TOLERANCE)
    assert_allclose(got.alpha, want.alpha, atol=TOLERANCE)
    assert (got.depth is None) == (want.depth is None)
    if want.depth is not None and got.depth is not None:
        seen = want.alpha > 0.05  # elsewhere a rounded depth is divided by next to nothing
        assert seen.any()
        assert_allclose(got.depth[seen], want.depth[seen], rtol=1e-3)


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize(
    "layers", [scene(), [], [world(cloud(1).rows(np.zeros(1, bool)))]], ids=["three", "no", "empty"]
)
@pytest.mark.needs("adapter")
def test_a_gpu_composes_the_same_picture(adapter, layers, with_depth):
    """Catches a layer with another's frames, camera, degree or rows, and a wrong depth."""
    want = compose(layers, CAMERA, with_depth)
    if want.alpha.max() > 0:
        assert_same_picture(gpu.compose(adapter, layers, CAMERA, with_depth), want)
    else:
        got = gpu.compose(adapter, layers, CAMERA, with_depth)
        assert got.alpha.max() == got.rgb.max() == 0


@pytest.mark.needs("adapter")
def test_more_pairs_than_there_is_room_for(adapter, monkeypatch):
    """Catches an empty picture where pairs did not fit, and a lost device that is kept."""
    monkeypatch.setattr("stga_addon.raster.gpu.rasterize.INITIAL_PAIR_CAPACITY", 10)
    gpu._rasterizer.cache_clear()
    assert_same_picture(gpu.compose(adapter, scene(), CAMERA, True), compose(scene(), CAMERA, True))
    monkeypatch.setattr("stga_addon.raster.gpu.rasterize.Rasterizer.draw", lost)
    with pytest.raises(DeviceError):
        gpu.compose(adapter, scene(), CAMERA)
    assert not gpu._rasterizer.cache_info().currsize, "the lost device is kept"


def lost(*_):
    raise DeviceError("Card 9000 was lost", "try again")


def test_the_cpu_takes_over_where_a_gpu_fails(monkeypatch, caplog):
    """Catches a failed driver that ends an animation, or a CPU in place of a GPU asked for."""
    chosen = "gpu:Card 9000", "why"
    monkeypatch.setattr(compose_module, "choose_device", lambda wanted, task: chosen)
    calls = []
    monkeypatch.setattr(gpu, "compose", lambda *given: calls.append(given) or lost())
    composer = Composer()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            found = composer.compose(scene(), CAMERA).rgb
            assert_array_equal(found, compose(scene(), CAMERA).rgb)
    assert len(calls) == 1
    assert composer.failure == "Card 9000 was lost; the CPU renders instead"
    assert caplog.messages == [composer.failure]
    monkeypatch.setattr(gpu, "compose", lambda *given: 1 / 0)
    other = Composer()
    other.compose(scene(), CAMERA)
    assert other.failure == "gpu:Card 9000: division by zero; the CPU renders instead"
    monkeypatch.setattr(gpu, "compose", lost)
    with refusal(r"^--device gpu: Card 9000 was lost; try again$"):
        Composer("gpu").compose(scene(), CAMERA)


@pytest.mark.needs("adapter")
def test_software_renders_by_name_only(adapter):
    """Catches pictures by software Vulkan instead of the CPU, bit for bit."""
    if not gpu_device.device().is_software:
        pytest.skip("the first adapter is a GPU")
    composer = Composer()
    found = composer.compose(scene(), CAMERA).rgb
    assert_array_equal(found, compose(scene(), CAMERA).rgb)
    assert composer.device == "cpu"
    assert Composer("gpu").choose() == f"gpu:{adapter}"


@pytest.mark.nightly
@pytest.mark.needs("adapter")
def test_the_server_renders_on_the_wanted_device(adapter, monkeypatch):
    """Catches a server that renders on something else, or goes on with the device of before."""
    monkeypatch.setattr(render_client, "missing_packages", lambda: ["numba"])
    device = [f"gpu:{adapter}"]
    remote = RenderClient(lambda: sys.executable, lambda: device[0])
    layers = scene()
    want = compose(scene(), CAMERA, True)
    on_gpu = remote.compose(layers, CAMERA, True)
    assert remote._server is not None
    _, first = remote._server
    assert_same_picture(on_gpu, want)
    assert not np.array_equal(on_gpu.rgb, want.rgb)  # rounding: it was not the CPU
    device[0] = "auto" if gpu_device.device().is_software else "cpu"
    assert_array_equal(remote.compose(layers, CAMERA, True).rgb, want.rgb)
    assert subprocess.Popen.poll(first) is not None
    device[0] = "gpu:Voodoo 2"
    with refusal(r"could not render the image \(--device gpu:Voodoo 2: no adapter"):
        remote.compose(layers, CAMERA)
    remote.close()
