"""Differentiable rendering of torch tensors by the CPU kernels."""

from typing import Any

import numpy as np
import torch

from ...avatar.embedding import WORLD, FaceFrames
from ...capture.camera import Camera
from .layout import CameraFrames, Parameters
from .rasterize import frames_in_camera, render_backward, render_forward


def render_differentiable(
    splats: Parameters,
    camera: Camera,
    frames: FaceFrames = WORLD,
    face: np.ndarray | None = None,
    degree: int = 3,
    antialiased: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Differentiable rendering of float32 torch tensors.

    Without frames and face the splats are world-space ones. Returns rgb (3, H, W) premultiplied on
    black, alpha (H, W), and depth (H, W) = Σ weight · camera z.
    """
    face = np.zeros(len(splats.xyz), np.int32) if face is None else face
    camera_frames = frames_in_camera(frames, camera)
    given = [tensor for tensor in splats if tensor is not None]
    rgb, transmittance = _Blend.apply(camera_frames, face, degree, False, antialiased, *given)
    depth, _ = _Blend.apply(camera_frames, face, degree, True, antialiased, *given)
    return rgb, 1 - transmittance, depth[0]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        camera_frames: CameraFrames,
        face: np.ndarray,
        degree: int,
        depth_as_color: bool,
        antialiased: bool,
        *tensors: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        splats = Parameters(*(t.detach().contiguous().numpy() for t in tensors))
        rendering = render_forward(
            splats,
            face,
            camera_frames,
            degree,
            depth_as_color=depth_as_color,
            antialiased=antialiased,
        )
        ctx.saved = camera_frames, face, splats, rendering
        return torch.from_numpy(rendering.image), torch.from_numpy(rendering.transmittance)

    @staticmethod
    def backward(ctx: Any, v_image: torch.Tensor, v_transmittance: torch.Tensor) -> Any:
        camera_frames, face, splats, rendering = ctx.saved
        gradients = Parameters(*(np.zeros_like(a) for a in splats if a is not None))
        v_rgb = v_image.contiguous().numpy()
        v_t = v_transmittance.contiguous().numpy()
        render_backward(rendering, splats, face, camera_frames, v_rgb, gradients, v_t)
        return *[None] * 5, *(torch.from_numpy(g) for g in gradients if g is not None)
