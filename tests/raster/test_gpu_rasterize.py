"""The GPU rasterizer: what it has beside the tests that both back ends share, which are those with
`back_end`."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from raster.gpu_autograd import render
from raster.test_kernels import NAMES, SCENES, random_cotangents
from stga_addon.avatar.embedding import WORLD
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.gpu import trial
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.rasterize import Rasterizer, ViewOptions

pytestmark = pytest.mark.needs("adapter")


def test_the_same_bits_twice_and_from_used_buffers():
    """Catches sums in the order of chance, and results that depend on what an earlier image left in
    the buffers."""
    used = Rasterizer(Device())
    for name in ("plain", "opaque layers", "one pixel", "exact tiles", "plain"):
        scene = SCENES[name]
        splats = Parameters(*(scene.splats[field] for field in NAMES))
        frames = frames_in_camera(WORLD, scene.camera)
        face = np.zeros(len(splats.xyz), int)
        v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
        cotangents = v_image.float().numpy(), -v_alpha.float().numpy()
        given = ViewOptions(scene.camera, scene.degree), frames, face, splats, cotangents
        (image, _, gradients), (same, _, others) = (
            render(*given, rasterizer) for rasterizer in (Rasterizer(Device()), used)
        )
        assert_array_equal(same, image, err_msg=name)
        for field in NAMES:
            want = getattr(gradients, field)
            got = getattr(others, field)
            assert_array_equal(got, want, err_msg=f"{name}: {field}")


def test_a_trial_finds_wrong_numbers(device, monkeypatch):
    """Catches a trial that passes whatever a device computes."""
    monkeypatch.setattr(trial, "SECONDS", 0.0)
    assert trial.try_device(device).is_right
    backward = Rasterizer.backward

    def loses_a_tile(self, work, rendering, *arguments):
        # which hold the right ones of the first trial
        work.clear(work.device.buffer("pair_gradients", 0))
        work.clear(rendering["touched"], 12)
        return backward(self, work, rendering, *arguments)

    monkeypatch.setattr(Rasterizer, "backward", loses_a_tile)
    assert not trial.try_device(device).is_right
