"""Embedding, projection and color of the splats, and the gradient back to them."""

from typing import Any, NamedTuple

from ..cpu.layout import PROJECTED
from .device import Device, Recording

INCLUDE = ("numbers", "splat")


class ProjectedSplats(NamedTuple):
    """Tables of N splats on the screen, as in `layout.py`."""

    projected: Any
    depth_key: Any
    rect: Any


def mark_focus(work: Recording, count: int, *, view: Any, face: Any, selected: Any) -> Any:
    """Record which of `count` splats ride on a selected triangle: (N,) 0 or 1; selected (F,): uploaded as bytes."""
    focus = work.device.buffer("focus", count)
    groups = work.device.groups(count)
    work.dispatch(work.device.kernel("focus"), groups, view=view, face=face, selected=selected, focus=focus)
    return focus


def projected_tables(device: Device, count: int) -> ProjectedSplats:
    """Room for `count` projected splats."""
    return ProjectedSplats(
        device.buffer("projected", count * PROJECTED),
        device.buffer("depth_key", count),
        device.buffer("rect", 4 * count),
    )


def project(
    work: Recording, count: int, out: ProjectedSplats, *, view: Any, splats: Any, face: Any, frames: Any
) -> None:
    """Record the projection of `count` splats to the rows of `out` from the view's first on.

    face (N,): the triangle of each.
    """
    device, given = work.device, {"view": view, "splats": splats, "face": face, "frames": frames}
    work.dispatch(device.kernel("project", include=INCLUDE), device.groups(count), **given, **out._asdict())


def project_backward(work: Recording, count: int, **buffers: Any) -> Any:
    """Record the gradient of the wanted splats from that of their pairs; returns `screen` (N,).

    buffers: view, splats, face and frames as given to `project`; projected, wanted, slots, pair_gradients, and
    gradients, whose wanted rows are overwritten. screen: for those rows, the length of the gradient with respect to
    the projected center in units of half the image.
    """
    device = work.device
    screen = device.buffer("screen", count)
    kernel = device.kernel("project_backward", include=INCLUDE)
    work.dispatch(kernel, device.groups(count), screen=screen, **buffers)
    return screen


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    device.kernel("focus")
    for name in ("project", "project_backward"):
        device.kernel(name, include=INCLUDE)
