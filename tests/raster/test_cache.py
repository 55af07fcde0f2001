"""Kernels from the cache against kernels that were just compiled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

STEP = """
import hashlib
import numpy as np
from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_backward, render_forward
from stga_addon.training.optimize.losses import image_gradient, whole_image
rng = np.random.default_rng(0)
n, pose = 300, np.eye(4)
pose[2, 3] = 4
splats = Parameters(
    rng.normal(0, 0.8, (n, 3)), rng.normal(size=(n, 4)), rng.normal(-2, 0.5, (n, 3)), rng.normal(size=n),
    rng.normal(0, 0.4, (n, 16, 3)),
)
splats = Parameters(*(a.astype(np.float32) for a in splats[:5]))
camera_frames, face = frames_in_camera(WORLD, Camera(70, 50, 90.0, 90.0, 35.0, 25.0, pose)), np.zeros(n, np.int32)
rendering = render_forward(splats, face, camera_frames, 3)
target = rng.integers(0, 256, (50, 70, 3)).astype(np.uint8)
v_image = np.empty_like(rendering.image)
losses = image_gradient(rendering.image, target, whole_image(50, 70), 0.2, v_image)
gradients = Parameters(*(np.zeros_like(a) for a in splats[:5]))
render_backward(rendering, splats, face, camera_frames, v_image, gradients)
parts = [rendering.image, v_image, np.array(losses), *gradients[:5]]
print(*(hashlib.sha256(a.tobytes()).hexdigest()[:16] for a in parts))
"""


@pytest.mark.slow
def test_the_first_run_on_a_machine_has_the_bits_of_all_later_ones(tmp_path: Path) -> None:
    """Catches a helper that is called where it was compiled alone, in one process, and as a copy in the next."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).resolve().parents[2]

    def bits() -> str:
        command = [sys.executable, "-c", STEP]
        done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True)
        return done.stdout

    compiled = bits()
    assert len(compiled.split()) == 8
    assert bits() == compiled
