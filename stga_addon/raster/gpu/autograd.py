"""Differentiable rendering of torch tensors by the Warp kernels, which share the tensors' memory."""

from typing import Any

import numpy as np
import torch
import warp as wp

from ...avatar.embedding import WORLD, FaceFrames
from ...capture.camera import Camera
from ..cpu.layout import Parameters
from ..cpu.rasterize import frames_in_camera
from .rasterize import PARAMETER_TYPES, DeviceFrames, Rasterizer, device_camera


def render_differentiable(
    splats: Parameters,
    camera: Camera,
    frames: FaceFrames = WORLD,
    face: np.ndarray | None = None,
    degree: int = 3,
    antialiased: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Differentiable rendering of float32 torch tensors on a CUDA device, or on the CPU, whose memory is shared_arrays.

    Everything else as in `cpu.autograd.render_differentiable`.
    """
    device = str(splats.xyz.device)
    camera_frames, count = frames_in_camera(frames, camera), len(splats.xyz)
    if splats.strain_color is None:
        splats = splats._replace(strain_color=splats.xyz.new_zeros(count, 0, 3))
    strains = min(camera_frames.strain.shape[1], splats.strain_color.shape[1])
    origin, matrix, strain = (
        wp.array(value, dtype=dtype, device=device)
        for value, dtype in (
            (camera_frames.origin, wp.vec3),
            (camera_frames.matrix, wp.mat33),
            (camera_frames.strain, wp.float32),
        )
    )
    on_face = wp.array(np.zeros(count, np.int32) if face is None else face, dtype=wp.int32, device=device)
    images = []
    for depth_as_color in (False, True):
        lens = device_camera(camera, degree, strains, depth_as_color, antialiased)
        images.append(_Blend.apply(DeviceFrames(origin, matrix, strain, lens), on_face, *splats))
    (rgb, transmittance), (depth, _) = images
    return rgb, 1 - transmittance, depth[0]


def shared_arrays(tensors: Parameters) -> Parameters:
    """Contiguous torch tensors as Warp arrays of `PARAMETER_TYPES` that share their memory."""
    return Parameters(*(_share(tensor.detach(), kind) for tensor, kind in zip(tensors, PARAMETER_TYPES, strict=True)))


def _share(tensor: torch.Tensor, kind: Any) -> wp.array:
    if tensor.numel():
        return wp.from_torch(tensor, dtype=kind)
    # Nothing to share, and torch's strides of empty tensors are not what Warp expects.
    return wp.empty(tuple(tensor.shape[: tensor.ndim - (kind is not wp.float32)]), kind, device=str(tensor.device))


def _stream(device: torch.device) -> Any:
    """Launch on torch's stream, so that its work and ours follow each other without the host."""
    return wp.ScopedStream(wp.stream_from_torch(device) if device.type == "cuda" else None)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frames: DeviceFrames, face: wp.array, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        device = tensors[0].device
        kept = [tensor.detach().contiguous() for tensor in tensors]
        with _stream(device):
            rasterizer, splats = Rasterizer(str(device)), shared_arrays(Parameters(*kept))
            rendering = rasterizer.forward(splats, face, frames)
        ctx.saved = kept, splats, face, rasterizer, rendering
        return wp.to_torch(rendering.image), wp.to_torch(rendering.transmittance)

    @staticmethod
    def backward(ctx: Any, v_image: torch.Tensor, v_transmittance: torch.Tensor) -> Any:
        kept, splats, face, rasterizer, rendering = ctx.saved
        gradients = Parameters(*(torch.zeros_like(tensor) for tensor in kept))
        with _stream(kept[0].device):
            rasterizer.backward(
                rendering, splats, face, wp.from_torch(v_image.contiguous()), shared_arrays(gradients),
                wp.from_torch(v_transmittance.contiguous()),
            )  # fmt: skip
        return None, None, *gradients
