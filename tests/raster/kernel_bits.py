"""Hashes of a forward and a backward pass of the CPU's kernels; run by test_bundled.py in processes
of its own."""

import hashlib

import numpy as np

from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_backward, render_forward
from stga_addon.training.optimize.image_loss import image_gradient, whole_image

rng = np.random.default_rng(0)
n = 300
pose = np.eye(4)
pose[2, 3] = 4
splats = Parameters(
    rng.normal(0, 0.8, (n, 3)),
    rng.normal(size=(n, 4)),
    rng.normal(-2, 0.5, (n, 3)),
    rng.normal(size=n),
    rng.normal(0, 0.4, (n, 16, 3)),
)
splats = Parameters(*(a.astype(np.float32) for a in splats[:5]))
camera_frames = frames_in_camera(WORLD, Camera(70, 50, 90.0, 90.0, 35.0, 25.0, pose))
face = np.zeros(n, np.int32)
rendering = render_forward(splats, face, camera_frames, 3)
target = rng.integers(0, 256, (50, 70, 3)).astype(np.uint8)
v_image = np.empty_like(rendering.image)
losses = image_gradient(rendering.image, target, whole_image(50, 70), 0.2, v_image)
gradients = Parameters(*(np.zeros_like(a) for a in splats[:5]))
render_backward(rendering, splats, face, camera_frames, v_image, gradients)
parts = [rendering.image, v_image, np.array(losses), *gradients[:5]]
print(*(hashlib.sha256(a.tobytes()).hexdigest()[:16] for a in parts))
