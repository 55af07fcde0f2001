"""ARKit's shapes as sliders of a web page."""

import numpy as np

from ..errors import StgaError
from ..export.playback import ShapeControls
from ..flame.sequence import FlameSequence
from .head_map import PRODUCTS, head_map
from .names import ARKIT_SHAPES, COUNT
from .shapes import JAW_OPEN, MOUTH_CLOSE


def page_controls(sequence: FlameSequence | None) -> ShapeControls | None:
    """The controls of a FLAME head; None for a head without FLAME, or whose face ARKit's shapes do not fit."""
    if sequence is None:
        return None
    try:
        found = head_map(sequence, "the avatar")
    except StgaError:  # eyes that are not where a head has them
        return None
    products = np.zeros((COUNT, found.expressions.shape[1]))
    products[PRODUCTS] = found.expressions[COUNT:]
    linear = np.concatenate([found.expressions[:COUNT], found.jaw, found.eyes], axis=1)
    return ShapeControls(ARKIT_SHAPES, linear, products, ARKIT_SHAPES[JAW_OPEN], ARKIT_SHAPES[MOUTH_CLOSE])
