"""(1 − w)·L1 + w·(1 − SSIM) of an image on the device, and its gradient."""

from typing import Any

import numpy as np

from ..cpu.rasterize import tile_grid
from .device import Device, Recording

LOSS = np.dtype(
    [("ssim_weight", np.float32), ("masked", np.uint32)]
    + [(f"change_{channel}", np.float32) for channel in "rgb"]
)
"""The uniform `loss` of image_loss.wgsl."""


def upload_target(
    device: Device,
    target: np.ndarray,
    ssim_weight: float,
    mask: np.ndarray | None = None,
    change: Any = (0, 0, 0),
) -> None:
    """Send the target (H, W, 3) uint8 of the next image, and how it is compared.

    mask (H, W) uint8: the foreground's coverage; where it leaves the background free, the target's
    color is changed by `change` (3,) in 0…255.
    """
    loss = np.zeros(1, LOSS)
    loss["ssim_weight"], loss["masked"] = ssim_weight, mask is not None
    loss["change_r"], loss["change_g"], loss["change_b"] = change
    device.upload("loss", loss, "uniform")
    device.upload("image_target", target)
    if mask is not None:
        device.upload("mask", mask)


def image_loss(
    work: Recording, width: int, height: int, *, view: Any, image: Any, touched: Any, whole: bool
) -> tuple[Any, Any]:
    """Record the gradient of the loss of an image (3, H, W) against the uploaded target.

    touched (tiles,): in which tiles the gradient is wanted; the image must be rendered
    LOSS_REACH_PX around them. Returns the gradient (3, H, W), undefined in other tiles, and the
    loss (1,), which is computed if `whole`: every tile is touched.
    """
    buffer, (columns, rows) = work.device.buffer, tile_grid(width, height)
    tables = {
        "view": view,
        "loss": buffer("loss", LOSS.itemsize // 4, "uniform"),
        "image": image,
        "image_target": buffer("image_target", 0),
        "mask": buffer("mask", 0),
        "touched": touched,
        "v_image": buffer("v_image", 3 * width * height),
        "sums": buffer("loss sums", 6 * columns * rows),
        "result": buffer("loss result", 1),
    }
    work.dispatch("image_loss.gradient", (columns, rows, 3), tables)
    if whole:
        work.dispatch("image_loss.total", (1, 1, 1), tables)
    return tables["v_image"], tables["result"]
