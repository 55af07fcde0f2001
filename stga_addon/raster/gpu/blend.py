"""Alpha blending of the splats of each tile, forward and backward."""

from typing import Any

from ..cpu.layout import PROJECTED
from .device import Device, Recording

INCLUDE = ("blend",)


def blend_forward(work: Recording, area: int, tiles: int, **buffers: Any) -> tuple[Any, Any]:
    """Record the blending of the rendered tiles; area: the image's pixels.

    buffers: view, rendered, tile_range, pair_slot, slot_splat, projected.
    Returns image (3, H, W) f32 over the background, and `pixels` (see `layout.py`), both undefined in other tiles.
    """
    device = work.device
    image, pixels = device.buffer("image", 3 * area), device.buffer("pixels", 2 * area)
    work.dispatch(
        device.kernel("blend_forward", include=INCLUDE), device.groups_of(tiles), image=image, pixels=pixels,
        **buffers,
    )  # fmt: skip
    return image, pixels


def blend_backward(
    work: Recording, capacity: int, tiles: int, *, v_image: Any, v_transmittance: Any | None, **buffers: Any
) -> Any:
    """Record the gradient of every wanted pair of the touched tiles; returns `pair_gradients`.

    v_image (3, H, W), v_transmittance (H, W) or None: gradients of the image and of the transmittance.
    buffers: view, touched, tile_range, pair_slot, slot_splat, projected, pixels.
    """
    device, has_v_transmittance = work.device, v_transmittance is not None
    kernel = device.kernel("blend_backward", include=INCLUDE, HAS_V_TRANSMITTANCE=has_v_transmittance)
    pair_gradients = device.buffer("pair_gradients", PROJECTED * capacity)
    work.dispatch(
        kernel, device.groups_of(tiles), v_image=v_image, pair_gradients=pair_gradients,
        v_transmittance=v_transmittance if has_v_transmittance else v_image, **buffers,
    )  # fmt: skip
    return pair_gradients


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches in training."""
    device.kernel("blend_forward", include=INCLUDE)
    device.kernel("blend_backward", include=INCLUDE, HAS_V_TRANSMITTANCE=False)
