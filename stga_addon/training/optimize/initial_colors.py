"""Colors that the splats of a mesh start with: those of the first training timestep's images."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from ...capture.images import read_view
from ...capture.mesh_raster import rasterize
from ...capture.model import Capture, View

SAMPLED_HEIGHT_PIXELS = 400
"""Images higher than this are shrunk to it: triangles are then two or three pixels wide."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
MIDDLE_GRAY = 0.5


def triangle_colors(capture: Capture, views: Sequence[View]) -> np.ndarray:
    """Mean color (F, 3) from 0 to 1 of each triangle in views of one timestep.

    A triangle that no view shows has the color of the nearest one of the neutral mesh that is shown: the back of a head
    that is seen from the front has the color of its sides. Gray if no view shows any.
    """
    total, count = np.zeros((len(capture.faces), 3)), np.zeros(len(capture.faces))
    mesh = capture.mesh(views[0].timestep)
    for view in views:
        small, image, mask = read_view(view, min(1.0, SAMPLED_HEIGHT_PIXELS / view.camera.height))
        triangle, _ = rasterize(mesh, capture.faces, small.camera)
        shown = triangle >= 0
        if mask is not None:
            shown &= binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)
        pixels, found = image[shown], triangle[shown]
        count += np.bincount(found, minlength=len(count))
        for channel in range(3):
            total[:, channel] += np.bincount(found, pixels[:, channel], len(count))
    seen = count > 0
    if not seen.any():
        return np.full(total.shape, MIDDLE_GRAY)
    centers = capture.neutral[capture.faces].mean(1)
    nearest = np.flatnonzero(seen)[cKDTree(centers[seen]).query(centers)[1]]
    return np.asarray(total[nearest] / count[nearest, None] / 255)
