"""The views that a run is judged by: their images, the pixels of the head, and the pixels of what moves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from PIL import Image, ImageDraw

from ...capture.images import read_image, read_mask
from ...capture.model import Capture, View
from ...selection import SelectionOptions, select_capture

MAX_EVALUATION_VIEWS = 16
"""Held-out views that an evaluation during training looks at, evenly spread: few enough to cost little."""
MIN_REGION_PIXELS = 50
"""A region with fewer pixels in a view says nothing there."""


@dataclass(frozen=True)
class EvaluationView:
    """A view and what its rendering is compared with.

    target   (H, W, 3) uint8, read-only
    regions  "mask": inside the head mask; "moving": pixels of the triangles that the default selection rule picks
             at that timestep. (H, W) bool; a view without masks, or in which nothing moves, lacks the one or the other
    """

    view: View
    target: np.ndarray
    regions: Mapping[str, np.ndarray] = field(default_factory=dict)


def choose_evaluation_views(capture: Capture) -> Sequence[View]:
    """The held-out views that are looked at while training: at most MAX_EVALUATION_VIEWS, evenly spread."""
    views = capture.views.get("val", ())
    if len(views) <= MAX_EVALUATION_VIEWS:
        return views
    return [views[n] for n in np.linspace(0, len(views) - 1, MAX_EVALUATION_VIEWS).round().astype(int)]


def read_evaluation_view(capture: Capture, view: View) -> EvaluationView:
    """Read a view's image and mask and find its regions.

    The rule for "moving" is the default one whatever a run trains by, so that runs compare.
    Raises StgaError where a file cannot be read.
    """
    target, mask = read_image(view), read_mask(view)
    target.setflags(write=False)  # as in training; Numba would compile anew for writable arrays
    selection = select_capture(replace(capture, timesteps=(view.timestep,)), SelectionOptions())
    regions = {"moving": visible_pixels(capture, view, selection[view.timestep])}
    if mask is not None:
        regions = {"mask": mask > 127, **regions}
    return EvaluationView(
        view, target, {name: where for name, where in regions.items() if where.sum() >= MIN_REGION_PIXELS}
    )


def visible_pixels(capture: Capture, view: View, faces: np.ndarray) -> np.ndarray:
    """(H, W) bool: where one of the triangles `faces` (F,) bool is the nearest one."""
    mesh = np.asarray(capture.mesh(view.timestep))
    corners, depth = view.camera.project(mesh)
    corners -= 0.5  # Pillow's pixel centers lie at whole numbers
    centres = depth[capture.faces].mean(1)
    picture = Image.new("1", (view.camera.width, view.camera.height))
    draw = ImageDraw.Draw(picture)
    drawn = np.flatnonzero((depth[capture.faces] > 0.01).all(1))
    drawn = drawn[np.argsort(-centres[drawn], kind="stable")]  # the painter's order, far to near
    polygons = corners[capture.faces[drawn]].reshape(-1, 6).tolist()
    for polygon, chosen in zip(polygons, faces[drawn].tolist(), strict=True):
        draw.polygon(polygon, fill=int(chosen))
    return np.asarray(picture)
