"""Parts that FLAME's mesh is given, in one table, and head models with them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from pathlib import Path

import numpy as np

from ..errors import StgaError
from .key_masks import found_masks
from .model import BUNDLED_HEAD, FlameModel, faces_within, read_flame
from .teeth import TEETH_FACES, TEETH_VERTICES, TEMPLATE_VERTICES, with_teeth


@dataclass(frozen=True)
class Part:
    """What a part is, beside its name: that of its vertex mask, and of the effect and the setting
    of a training by which splats are put on it.

    label     as people read it; kind: what a mesh without it lacks
    graft     adds `vertices` vertices, `faces` triangles and the mask to FLAME's mesh. Raises
              StgaError for a mesh that it does not fit
    region    of KEY_MASKS, which it belongs to
    """

    label: str
    kind: str
    graft: Callable[[FlameModel], FlameModel]
    vertices: int
    faces: int
    region: str


PARTS = {
    "teeth": Part("Teeth", "rows of teeth", with_teeth, TEETH_VERTICES, TEETH_FACES, "mouth"),
}
"""Name -> part, in the order in which parts are grafted."""
ADDED_VERTICES = tuple(accumulate((part.vertices for part in PARTS.values()), initial=0))
"""Number of added vertices of a mesh with none of the parts, with the first one, …: meshes of other
programs lack some."""
FLAME_SIZES = tuple(TEMPLATE_VERTICES + added for added in ADDED_VERTICES)
"""Numbers of vertices of FLAME's meshes."""
KEY_MASKS = {
    "left_eye": ("left_eye_region", "left_eyeball"),
    "right_eye": ("right_eye_region", "right_eyeball"),
    "mouth": ("lips",),
    "nose": ("nose",),
}
"""Key region -> the vertex masks of FLAME's mesh that it is made of (STGA, selective training:
eyes, mouth and nose); parts are added."""


def flame_model(path: Path | None) -> FlameModel:
    """The FLAME model file, with all parts where it has FLAME's 5023 vertices, and masks where it
    has none; None: the bundled head. Raises StgaError."""
    path = path or BUNDLED_HEAD
    try:
        # its masks may lie beside it
        state = path.stat()
        masks = path.parent.stat()
    except OSError:  # which reading it names
        return read_flame(path)
    return _remembered(path, state.st_mtime_ns, state.st_size, masks.st_mtime_ns)


@lru_cache(maxsize=2)
def _remembered(path: Path, *state: int) -> FlameModel:
    """The model of a file whose times and size are `state`: every button that needs the head reads
    it again, and some the bundled one besides."""
    model = read_flame(path)
    if len(model.v_template) == TEMPLATE_VERTICES:
        if not model.masks:
            masks = found_masks(model.v_template, model.faces)
            model = replace(model, masks=masks, has_found_masks=bool(masks))
        for part in PARTS.values():
            model = part.graft(model)
    return model


def key_regions(model: FlameModel) -> dict[str, np.ndarray]:
    """left_eye, right_eye, mouth, nose as (F,) bool; those without any mask are left out."""
    return _in_regions(model.masks, model.faces)


def found_regions(vertices: np.ndarray, faces: np.ndarray) -> dict[str, np.ndarray]:
    """`key_regions` that are found on a mesh (V, 3) of FLAME's size; none where it is of another
    make."""
    if len(vertices) not in FLAME_SIZES:
        return {}
    try:
        masks = found_masks(vertices, faces)
    except StgaError:  # of a mouth that is closed at the throat
        return {}
    ends = zip(PARTS, FLAME_SIZES, FLAME_SIZES[1:], strict=False)
    parts = {name: np.arange(first, past) for name, first, past in ends if past <= len(vertices)}
    return _in_regions({**masks, **parts} if masks else {}, faces)


def _in_regions(masks: Mapping[str, np.ndarray], faces: np.ndarray) -> dict[str, np.ndarray]:
    regions = {}
    for region, names in KEY_MASKS.items():
        parts = [name for name, part in PARTS.items() if part.region == region]
        present = [masks[name] for name in (*names, *parts) if name in masks]
        if present:
            regions[region] = faces_within(faces, np.concatenate(present))
    return regions
