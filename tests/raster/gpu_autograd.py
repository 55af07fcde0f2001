"""Differentiable rendering of torch tensors by the WebGPU kernels: copied to the device and
back."""

from functools import cache

import numpy as np
import torch

from stga_addon.avatar.embedding import WORLD
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import LOG_SCALE, OPACITY_LOGIT, ROTATION, SH, XYZ
from stga_addon.raster.gpu.rasterize import Rasterizer, ViewOptions, upload_frames, upload_splats


def render_differentiable(splats, camera, frames=WORLD, face=None, degree=3, antialiased=False):
    """Differentiable rendering on the first adapter; everything as in
    `cpu.autograd.render_differentiable`."""
    face = np.zeros(len(splats.xyz), np.int32) if face is None else face
    camera_frames = frames_in_camera(frames, camera)
    images = []
    for depth_as_color in (False, True):
        options = ViewOptions(
            camera, degree, depth_as_color=depth_as_color, antialiased=antialiased
        )
        images.append(_Blend.apply(options, camera_frames, face, *splats))
    (rgb, transmittance), (depth, _) = images
    return rgb, 1 - transmittance, depth[0]


@cache
def shared_rasterizer():
    """One for all tests, whose kernels stay compiled."""
    return Rasterizer(Device())


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, options, camera_frames, face, *tensors):
        splats = Parameters(*(t.detach().contiguous().numpy() for t in tensors))
        ctx.saved = options, camera_frames, face, splats
        image, transmittance, _ = render(options, camera_frames, face, splats)
        return torch.from_numpy(image), torch.from_numpy(transmittance)

    @staticmethod
    def backward(ctx, v_image, v_transmittance):
        cotangents = v_image.contiguous().numpy(), v_transmittance.contiguous().numpy()
        options, camera_frames, face, splats = ctx.saved
        _, _, gradients = render(options, camera_frames, face, splats, cotangents)
        given = [torch.from_numpy(gradient) for gradient in gradients]
        return None, None, None, *given[: len(ctx.needs_input_grad) - 3]


def split_rows(rows, coefficients):
    """The opposite of `layout.splat_rows`: copies of its columns; coefficients: K."""
    return Parameters(
        xyz=rows[:, XYZ:ROTATION].copy(),
        rotation=rows[:, ROTATION:LOG_SCALE].copy(),
        log_scale=rows[:, LOG_SCALE:OPACITY_LOGIT].copy(),
        opacity=rows[:, OPACITY_LOGIT].copy(),
        sh=rows[:, SH:].reshape(len(rows), coefficients, 3).copy(),
    )


def render(options, camera_frames, face, splats, cotangents=None, rasterizer=None):
    """Image and transmittance, and the gradients where there are cotangents of these two."""
    rasterizer = rasterizer or shared_rasterizer()
    device = rasterizer.device
    height = options.camera.height
    width = options.camera.width
    while True:
        table = upload_splats(device, splats, face)
        frames = upload_frames(device, camera_frames)
        gradients = device.upload("gradients", np.zeros((table.count, table.stride), np.float32))
        v_images = [device.upload(f"v {n}", v) for n, v in enumerate(cotangents or ())]
        with device.record() as work:
            rendering = rasterizer.forward(
                work, table, frames, options, rasterizer.upload_view(table, options)
            )
            if cotangents is not None:
                rasterizer.backward(
                    work, rendering, table, options.camera, v_images[0], gradients, v_images[1]
                )
        if rasterizer.pairs_fit():
            break
    pixels = device.read(rendering["pixels"], (height, width, 2))
    rows = device.read(gradients, (table.count, table.stride))
    image = device.read(rendering["image"], (3, height, width))
    return image, pixels[..., 0].copy(), split_rows(rows, table.coefficients)
