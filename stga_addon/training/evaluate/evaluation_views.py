"""Evaluation views: held-out images, with the pixels of the head mask and of the moving region."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from ...capture.images import read_image, read_mask
from ...capture.model import Capture, View, evenly_spread
from ...selection import SelectionOptions, select_capture
from ..backdrop import without_backdrop

MAX_EVALUATION_VIEWS = 16
"""Held-out views that an evaluation during training renders."""
MIN_REGION_PIXELS = 50
"""A smaller region of a view is left out."""
MATTE_BORDER_SHARE = 0.0075
"""Width of the border of a head mask in which the matte is uncertain, as a share of the image's
height."""
MIN_DEPTH_M = 0.01
"""Triangles nearer to the camera's plane, or behind it, are not drawn."""


@dataclass(frozen=True)
class EvaluationView:
    """A view and the image that its rendering is compared with.

    target   (H, W, 3) uint8, read-only
    regions  name -> (H, W) bool. "mask": the head mask, if the view has one; "moving": visible
             pixels of the triangles that the default selection picks at the timestep, if there are
             any
    interior (H, W) bool: the head mask without the matte's border; None without a mask
    group    of views whose quality is reported apart as well, as those of one take; empty: none
    """

    view: View
    target: np.ndarray
    regions: Mapping[str, np.ndarray] = field(default_factory=dict)
    interior: np.ndarray | None = None
    group: str = ""


def choose_evaluation_views(capture: Capture) -> Sequence[View]:
    """At most MAX_EVALUATION_VIEWS of the held-out views, evenly spread: those of a training."""
    return evenly_spread(capture.views.get("val", ()), MAX_EVALUATION_VIEWS)


def read_evaluation_view(
    capture: Capture,
    view: View,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    backdrop: str = "plain",
) -> EvaluationView:
    """Read a view's image and mask and find its regions.

    background (0…1): behind transparent pixels; backdrop: see `TrainingSettings`, both as in
    training.

    "moving" is by the default selection whatever a run's settings are, so that runs are comparable.
    Raises StgaError if a file cannot be read.
    """
    red, green, blue = (round(255 * level) for level in background)
    target, mask = read_image(view, (red, green, blue)), read_mask(view)
    target, mask = without_backdrop(capture, view, target, mask, backdrop, background)
    target.setflags(write=False)  # as in training: Numba would compile again for writable arrays
    selection = select_capture(replace(capture, timesteps=(view.timestep,)), SelectionOptions())
    regions = {"moving": visible_pixels(capture, view, selection[view.timestep])}
    interior = None
    if mask is not None:
        regions = {"mask": mask > 127, **regions}
        border = max(1, round(MATTE_BORDER_SHARE * len(mask)))
        inside = binary_erosion(mask > 127, iterations=border)
        interior = inside if inside.sum() >= MIN_REGION_PIXELS else None
    regions = {name: where for name, where in regions.items() if where.sum() >= MIN_REGION_PIXELS}
    return EvaluationView(view, target, regions, interior)


def visible_pixels(capture: Capture, view: View, faces: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at which the nearest triangle is one of `faces` (F,) bool."""
    mesh = np.asarray(capture.mesh(view.timestep))
    corners, depth = view.camera.project(mesh)
    corners -= 0.5  # Pillow's pixel centers lie at whole numbers
    center_depth = depth[capture.faces].mean(1)
    picture = Image.new("1", (view.camera.width, view.camera.height))
    draw = ImageDraw.Draw(picture)
    drawn = np.flatnonzero((depth[capture.faces] > MIN_DEPTH_M).all(1))
    # painter's algorithm: far to near
    drawn = drawn[np.argsort(-center_depth[drawn], kind="stable")]
    polygons = corners[capture.faces[drawn]].reshape(-1, 6).tolist()
    for polygon, is_chosen in zip(polygons, faces[drawn].tolist(), strict=True):
        draw.polygon(polygon, fill=int(is_chosen))
    return np.asarray(picture)
