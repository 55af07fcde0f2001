"""Opaque layers that training adds where views show nothing: on hidden skin and hair, behind lids
and in the mouth, and the occlusion layer."""

from dataclasses import replace

import numpy as np

from ...avatar.embedding import face_frames, to_local, to_world
from ...avatar.lattice import NORMAL_AXIS, lattice_splats
from ...avatar.splats import SH_C0, Splats, joined
from ..settings import TrainingSettings
from .frames import FrameStore
from .occlusion_layer import CELL_VOXELS
from .surface import Surface
from .unseen_hair import UnseenHair

HIDDEN_SPACING_VOXELS = 1.0
"""Spacing of the lattice on hidden triangles where no order is chosen."""
MAX_HIDDEN_ORDER = 4
"""Largest order of that lattice."""
HIDDEN_OPACITY = 3.0
"""Logit of the opacity of splats on hidden triangles."""
HIDDEN_FLATNESS = 0.25
"""Their thickness as a fraction of that of the lattice's splats."""
OCCLUSION_OPACITY = 5.0
"""Logit of the opacity of the occlusion layer."""
CELL_WIDTH = 0.6
"""Least standard deviation of the occlusion layer's splats, in cells."""
BESIDE_LID_FRACTION = 0.6
"""Fraction of the scale of the layer under lids that it has at their edges and in the mouth, where
it would stand out beside the eye and the lips."""
BORDER_INSET = 0.6
"""Fraction of the distance from the middle of a triangle, and of the scale, at the mesh's edge, of
a lattice of order 1; a finer one reaches less beyond."""


def above_unseen_hair(frames: FrameStore, splats: Splats) -> np.ndarray:
    """(N,) bool: unbound splats above hidden hair. Masks from the front do not limit the hull
    behind a head, so these splats would hang in the air in off-axis views."""
    surface = frames.surface
    top = (surface.hair_height + frames.voxel) / frames.unit_lengths
    height = splats.xyz[:, NORMAL_AXIS[frames.convention]]
    is_hair = surface.hidden & (surface.hair_height > 0)
    return np.asarray(splats.unbound & is_hair[splats.face] & (height > top[splats.face]))


def hidden_splats(frames: FrameStore, settings: TrainingSettings) -> Splats:
    """A dense opaque layer on the `closed` triangles, where no view splits splats: on skin and
    clothes, or at the outer layer of hair, where it consists of strands unless an outline shows
    them."""
    surface = frames.surface
    hair = UnseenHair(frames)
    order = hidden_order(frames)
    if settings.lattice is not None:
        order[:] = settings.lattice
    layer = layer_on(frames, surface.closed & ~hair.has_strands, order, settings.sh_degree)
    return joined([layer, hair.splats(settings.sh_degree, HIDDEN_OPACITY)])


def layer_on(
    frames: FrameStore, triangles: np.ndarray, order: np.ndarray, sh_degree: int
) -> Splats:
    """The hidden layer on some triangles (F,) bool: lattices of these orders (F,)."""
    capture = frames.capture
    insets = border_inset(frames.surface, order)
    parts = []
    for number in np.unique(order):
        rows = np.flatnonzero(triangles & (order == number)).astype(np.int32)
        lattice = lattice_splats(
            capture.neutral,
            capture.faces[rows],
            int(number),
            sh_degree,
            HIDDEN_OPACITY,
            convention=frames.convention,
        )
        parts.append(replace(lattice, face=rows[lattice.face]))
    layer = joined(parts)
    face = layer.face
    axis = NORMAL_AXIS[frames.convention]
    inset = insets[face]
    xyz = layer.xyz * inset[:, None]
    xyz[:, axis] += frames.layer_height[face]
    log_scale = layer.log_scale + np.log(inset * frames.hair_widening[face])[:, None]
    log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    return replace(layer, xyz=xyz.astype(np.float32), log_scale=log_scale.astype(np.float32))


def hidden_order(frames: FrameStore) -> np.ndarray:
    """(F,) order of the hidden layer's lattice, which rises with the triangle's size: on large
    triangles, colors and the mesh's end would be coarse otherwise."""
    spacing = HIDDEN_SPACING_VOXELS * frames.voxel
    order = np.ceil(frames.units * frames.unit_lengths / spacing)
    return np.clip(order, 1, MAX_HIDDEN_ORDER).astype(int)


def border_inset(surface: Surface, order: np.ndarray) -> np.ndarray:
    """(F,) fraction of each triangle's size that the hidden layer, lattices of these orders (F,),
    covers."""
    inset = 1 - (1 - BORDER_INSET) / np.maximum(order, 1) ** 2
    return np.where(surface.border, inset, 1.0)


def splats_behind(frames: FrameStore, sh_degree: int) -> Splats:
    """The opaque layer under lids, and the `occlusion_layer`. The lids' splats are trained on open
    eyes and would leave gaps when the eyes close."""
    surface = frames.surface
    inner = occluding_splats(frames, sh_degree)
    has_inner = (surface.lids & ~surface.closed) | frames.occlusion_layer.triangles
    return inner.rows(has_inner[inner.face])


def occluding_splats(frames: FrameStore, sh_degree: int = 0) -> Splats:
    """One splat in its plausible color, sorted by triangle, for each triangle of lids, under its
    middle and so large that closed lids have no gaps, of the mouth's unseen inside, and of the
    `occlusion_layer`."""
    capture = frames.capture
    axis = NORMAL_AXIS[frames.convention]
    lids = frames.surface.lids
    occlusion = frames.occlusion_layer
    layer = lattice_splats(
        capture.neutral, capture.faces, 0, sh_degree, HIDDEN_OPACITY, frames.convention
    )
    around = np.ones(len(capture.neutral), bool)
    around[capture.faces[~lids]] = False
    fraction = np.where(around[capture.faces].all(1), 1.0, BESIDE_LID_FRACTION)
    layer.xyz[:, axis] = frames.layer_height
    layer.log_scale[:] += np.log(fraction)[:, None]
    layer.log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    behind = lattice_splats(
        occlusion.places, capture.faces, 0, sh_degree, OCCLUSION_OPACITY, frames.convention
    ).rows(occlusion.triangles)
    behind.log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    there = face_frames(occlusion.places, capture.faces, occlusion.places, frames.convention)
    world = to_world(behind, there)
    world.xyz[:] -= occlusion.depth[behind.face, None] * there.rotation[behind.face, :, axis]
    least = np.where(np.arange(3) == axis, 0, CELL_WIDTH * CELL_VOXELS * frames.voxel)
    world = replace(world, log_scale=np.log(np.maximum(np.exp(world.log_scale), least)))
    behind = to_local(world, frames.neutral, behind.face)
    within = lids | (frames.sides.triangles & ~frames.surface.outside)
    layer = joined([layer.rows((within & ~occlusion.triangles)[layer.face]), behind])
    layer = layer.rows(np.argsort(layer.face))
    color = np.where(occlusion.triangles[:, None], occlusion.color, frames.sides.color)
    layer.sh[:, 0] = (color[layer.face] - 0.5) / SH_C0
    return layer
