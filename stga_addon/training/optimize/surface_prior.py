"""Pulls splats of which training views tell little to what is plausible: what shines through the
front, and a pixel of an outline, would give them any color, size and place."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...avatar.embedding import face_frames, to_local, to_world
from ...avatar.lattice import NORMAL_AXIS, SCALE, lattice_splats
from ...avatar.splats import SH_C0, Splats, joined
from ...flame.quaternions import from_matrices, to_matrices
from ..settings import TrainingSettings
from .backend import Backend
from .frames import FrameStore
from .occlusion_layer import CELL_VOXELS
from .semantic_regions import eyeballs_of, lining_of
from .state import parameters_and_average
from .step_hook import Schedule
from .surface import Surface
from .unseen_hair import UnseenHair

WELL_SEEN_COSINE = 0.8
"""Cosine between a triangle and the camera that it faces most above which its splats are well
observed: others' gradients are compared with theirs."""
BEHIND_COSINE = -0.5
"""Cosine below which nothing stands in an outline."""
DOUBT = 0.3
"""Gradient, as a fraction of the median of well observed splats, at which a step pulls a splat
halfway to what is plausible."""
MIN_PULL = 0.02
"""Least fraction of that way that is worth a change."""
HIDDEN_SPACING_VOXELS = 1.0
"""Spacing of the lattice on hidden triangles where no order is chosen."""
MAX_HIDDEN_ORDER = 4
"""Largest order of that lattice."""
HIDDEN_OPACITY = 3.0
"""Logit of the opacity of splats on hidden triangles."""
HIDDEN_FLATNESS = 0.25
"""Their thickness as a fraction of that of the lattice's splats."""
LEAST_WIDTH_SHARE = 0.9
"""Width below which they may not shrink, as a fraction of what the lattice begins with."""
OCCLUSION_OPACITY = 5.0
"""Logit of the opacity of the occlusion layer."""
CELL_WIDTH = 0.6
"""Least standard deviation of the occlusion layer's splats, in cells."""
BESIDE_LID_SHARE = 0.6
"""Of the scale of the layer under lids, at their edges and in the mouth, where it would stand out
beside the eye and the lips."""
LINING_SHARE = 0.5
"""Of the scale of a triangle's only splat: the largest behind closed lips."""
EYE_DEPTH_M = 0.0005
"""Least depth of splats below the eyeballs that they are on."""
BORDER_INSET = 0.6
"""Of the distance from the middle of a triangle, and of the scale, at the mesh's edge, of a lattice
of order 1; a finer one reaches less beyond."""
FLAT_VOXELS = 0.25
"""Largest standard deviation along the normal of splats on skin and clothes; views of a narrow cone
do not determine it."""
FLAT_TOLERANCE = 1.02
"""Factor by which a splat must be thicker for a change to be worth it."""
MIN_VARIANCE = 1e-14
"""Least variance of a splat along an axis, in m²."""
GEOMETRY_MOMENTS = ("second/xyz", "second/rotation", "second/log_scale")
"""Second moments of positions and shapes."""
MOMENTS = ("second/color", "second/opacity", *GEOMETRY_MOMENTS)
"""Second moments that are compared with those of well observed splats."""
PULLED_COLUMNS = (
    "face",
    "parameters/color",
    "parameters/opacity",
    "parameters/xyz",
    "parameters/rotation",
    "parameters/log_scale",
    *MOMENTS,
)
"""What is read of the splats that may be pulled."""
PINNED_KINDS = ("parameters", "average", "first", "second")
"""Arrays of the splats whose color is pinned."""
INNER_PARAMETERS = ("xyz", "rotation", "log_scale", "opacity")
"""Parameters of the inner layer, and of the occlusion layer's end, that do not change."""


class SurfacePrior:
    """Pulls bound splats towards what is plausible, the more the less the views tell of them: the
    color of what they lie on, opaque and flat on the surface, or in the outer layer of hair.

    How much views tell is read from Adam's second moments, root mean squares of gradients. Without
    this, its steps, which are of one length for strong and weak gradients, would let splats that
    fill a pixel of an outline take any color and size for the cameras that see them from behind.
    """

    interval = 20

    def __init__(self, frames: FrameStore) -> None:
        self._frames = frames
        self._surface = frames.surface

    @cached_property
    def may_be_pulled(self) -> np.ndarray:
        """(F,) bool: triangles some of whose splats may be; of many cameras, few."""
        surface = self._surface
        sides = self._frames.sides
        may_be = sides.triangles | ~sides.shown | surface.lids | surface.is_flat
        may_be |= self._frames.occlusion_layer.triangles | self._eyeballs
        return np.asarray(may_be | (surface.turned_away > 0))

    def prepare(self) -> None:
        self.may_be_pulled  # noqa: B018

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        where = backend.columns(("face", "unbound"))
        is_bound = ~where["unbound"]
        bound = np.flatnonzero(is_bound & self.may_be_pulled[where["face"]])
        if not len(bound):
            return
        well_seen = is_bound & (self._surface.facing > WELL_SEEN_COSINE)[where["face"]]
        reference = np.flatnonzero(well_seen if well_seen.any() else is_bound)
        moments = backend.columns(MOMENTS, reference)
        columns = backend.columns(PULLED_COLUMNS, bound)
        is_inner = self._is_inner(columns)
        self._pull_colors(backend, bound, columns, moments["second/color"], is_inner)
        self._pull_shapes(backend, bound, columns, moments["second/opacity"])
        self._shorten_steps(backend, bound, columns, moments)
        self._flatten(backend, bound, columns)
        self._keep_layer(backend, bound, columns, is_inner)
        self._keep_end(backend, bound, columns, is_inner)
        self._shrink_lining(backend, bound, columns)
        self._sink_eyes(backend, bound, columns)

    def _pull_colors(
        self,
        backend: Backend,
        bound: np.ndarray,
        columns: Mapping[str, np.ndarray],
        reference: np.ndarray,
        is_inner: np.ndarray,
    ) -> None:
        sides = self._frames.sides
        face = columns["face"]
        share = doubt(columns["second/color"], reference) * ~sides.shown[face]
        # the avatar is made of averages, which only steps move
        is_untouched = ~sides.shown[face] & ~columns["second/color"].any(1)
        # of a lid, the edge of a fold is seen, in the fold's shade
        is_folded = self._surface.folded_lids[face] & ~sides.shown[face]
        is_pinned = sides.triangles[face] | is_inner | is_untouched | is_folded
        rows = np.flatnonzero((share > MIN_PULL) & ~is_pinned)
        colors = sides.color[face]
        hair = np.flatnonzero(sides.is_hair[face])
        if len(hair):
            shades = self._hair.shades(face[hair], columns["parameters/xyz"][hair])
            colors[hair] *= shades[:, None]
        plausible = ((colors - 0.5) / SH_C0).astype(np.float32)
        inner = np.searchsorted(self._inner.face, face[is_inner])
        plausible[is_inner] = self._inner.sh[inner, 0]
        color = columns["parameters/color"][rows]
        color += share[rows, None] * (plausible[rows] - color)
        backend.assign(bound[rows], {"parameters/color": color})
        rows = np.flatnonzero(is_pinned)
        zeros = dict.fromkeys((f"{kind}/sh" for kind in PINNED_KINDS), 0.0)
        values = parameters_and_average({"color": plausible[rows]})
        backend.assign(bound[rows], {**zeros, **values})

    def _pull_shapes(
        self,
        backend: Backend,
        bound: np.ndarray,
        columns: Mapping[str, np.ndarray],
        reference: np.ndarray,
    ) -> None:
        face = columns["face"]
        share = doubt(columns["second/opacity"][:, None], reference[:, None])
        surface = self._surface
        turned_away = np.where(surface.sticks_out, 0, surface.turned_away)
        share = (share * turned_away[face]) ** 2  # little of what outlines show
        # no view has stepped these: beyond images' edges also lies what faces cameras
        beyond = surface.outside & ~surface.sticks_out & ~self._frames.sides.shown
        share[beyond[face] & ~columns["second/opacity"].astype(bool)] = 1
        rows = np.flatnonzero(share > MIN_PULL)
        share = share[rows]
        opacity = columns["parameters/opacity"][rows]
        opacity += share * (HIDDEN_OPACITY - opacity)
        xyz = columns["parameters/xyz"][rows]
        axis = NORMAL_AXIS[self._frames.convention]
        height = self._hair.height(face[rows], xyz)
        xyz[:, axis] += share * (height - xyz[:, axis])
        values = {"opacity": opacity, "xyz": xyz}
        backend.assign(bound[rows], parameters_and_average(values))

    def _shorten_steps(
        self,
        backend: Backend,
        bound: np.ndarray,
        columns: Mapping[str, np.ndarray],
        reference: Mapping[str, np.ndarray],
    ) -> None:
        """Where gradients are below DOUBT times those of well seen splats, Adam moves and shapes
        splats by steps that are as much shorter: a layer that hardly shows would get holes."""
        least = {name: DOUBT**2 * np.median(reference[name].mean(1)) for name in GEOMETRY_MOMENTS}
        moments = {name: np.maximum(columns[name], least[name]) for name in GEOMETRY_MOMENTS}
        backend.assign(bound, moments)

    def _flatten(
        self, backend: Backend, bound: np.ndarray, columns: Mapping[str, np.ndarray]
    ) -> None:
        """Splats on skin and clothes stay thin, those of the layer behind as wide as closes it."""
        face = columns["face"]
        limit = FLAT_VOXELS * self._frames.voxel
        axis = NORMAL_AXIS[self._frames.convention]
        rows = np.flatnonzero(self._surface.is_flat[face])
        rotation = columns["parameters/rotation"][rows]
        log_scale = columns["parameters/log_scale"][rows]
        limits = limit / self._frames.unit_lengths[face[rows]]
        least = self._least_width[face[rows]]
        is_off = thickness(rotation, log_scale, axis) > FLAT_TOLERANCE * limits
        layer = np.flatnonzero(least > 0)
        widths = width(rotation[layer], log_scale[layer], axis)
        is_off[layer] |= widths * FLAT_TOLERANCE < least[layer]
        off = np.flatnonzero(is_off)
        flat = flattened(rotation[off], log_scale[off], axis, limits[off], least[off])
        values = parameters_and_average(dict(zip(("rotation", "log_scale"), flat, strict=True)))
        moments = dict.fromkeys(("first/rotation", "first/log_scale"), 0.0)
        backend.assign(bound[rows[off]], {**values, **moments})

    @cached_property
    def _least_width(self) -> np.ndarray:
        """(F,) of the `width` of the layer on triangles that face away from all cameras, in local
        units; smaller, it has gaps. 0 elsewhere."""
        surface = self._surface
        is_layer = surface.closed & (surface.facing < BEHIND_COSINE)
        hair = self._hair.least_width
        skin = LEAST_WIDTH_SHARE * SCALE * self._frames.units / hidden_order(self._frames)
        return np.where(is_layer, np.where(hair > 0, hair, skin), 0.0)

    def _keep_layer(
        self,
        backend: Backend,
        bound: np.ndarray,
        columns: Mapping[str, np.ndarray],
        is_inner: np.ndarray,
    ) -> None:
        """Splats of the mouth's unseen inside, and those behind lids and sides, stay as
        `inner_layer` has them: views would make them any size."""
        face = columns["face"]
        is_inside = (self._frames.sides.triangles & ~self._surface.outside)[face]
        rows = np.flatnonzero(is_inside | is_inner)
        inner = self._inner.rows(np.searchsorted(self._inner.face, face[rows]))
        kept = {name: getattr(inner, name) for name in INNER_PARAMETERS}
        backend.assign(bound[rows], parameters_and_average(kept))

    def _keep_end(
        self,
        backend: Backend,
        bound: np.ndarray,
        columns: Mapping[str, np.ndarray],
        is_inner: np.ndarray,
    ) -> None:
        """Splats of the layer where the mesh ends, the first ones of their triangles, stay as its
        lattice has them: masks would fray the end."""
        lattice = self._end
        triangles = len(self._surface.border)
        size = np.bincount(lattice.face, minlength=triangles)
        count = np.bincount(columns["face"][~is_inner], minlength=triangles)
        is_whole = (size > 0) & (count >= size)  # not where another lattice was chosen
        rows = np.flatnonzero(is_whole[columns["face"]] & ~is_inner)
        rows = rows[np.argsort(columns["face"][rows], kind="stable")]
        face = columns["face"][rows]
        number = np.arange(len(rows)) - np.searchsorted(face, face)
        is_first = number < size[face]
        place = (np.searchsorted(lattice.face, face) + number)[is_first]
        kept = {name: getattr(lattice, name)[place] for name in INNER_PARAMETERS}
        backend.assign(bound[rows[is_first]], parameters_and_average(kept))

    @cached_property
    def _end(self) -> Splats:
        """The layer on triangles at the mesh's end, sorted by triangle."""
        surface = self._surface
        order = hidden_order(self._frames)
        is_end = surface.closed & surface.border & ~self._hair.has_strands
        layer = layer_on(self._frames, is_end, order, 0)
        return layer.rows(np.argsort(layer.face, kind="stable"))

    def _shrink_lining(
        self, backend: Backend, bound: np.ndarray, columns: Mapping[str, np.ndarray]
    ) -> None:
        """Splats on the lips' inner side, which few cameras do not show well, stay small: they
        would hang before the teeth when the lips part."""
        limits = self._lining_limits[columns["face"], None]
        rows = np.flatnonzero((columns["parameters/log_scale"] > limits).any(1))
        log_scale = np.minimum(columns["parameters/log_scale"][rows], limits[rows])
        values = parameters_and_average({"log_scale": log_scale})
        backend.assign(bound[rows], {**values, "first/log_scale": 0.0})

    @cached_property
    def _lining_limits(self) -> np.ndarray:
        """(F,) largest log scale, in local units; infinite elsewhere."""
        capture = self._frames.capture
        sides = self._frames.sides
        limits = np.full(len(capture.faces), np.inf, np.float32)
        lining = lining_of(capture) & ~self._surface.outside & ~sides.shown & ~sides.triangles
        single = lattice_splats(
            capture.neutral, capture.faces, 0, 0, convention=self._frames.convention
        )
        lining &= self._surface.has_few_cameras
        limits[lining] = single.log_scale.max(1)[lining] + np.log(LINING_SHARE)
        return limits

    def _sink_eyes(
        self, backend: Backend, bound: np.ndarray, columns: Mapping[str, np.ndarray]
    ) -> None:
        """Splats on eyeballs lie below them: lids, whose splats are as deep, close over them."""
        axis = NORMAL_AXIS[self._frames.convention]
        face = columns["face"]
        highest = (-EYE_DEPTH_M / self._frames.unit_lengths)[face]
        rises = columns["parameters/xyz"][:, axis] > highest
        rows = np.flatnonzero(rises & self._eyeballs[face])
        xyz = columns["parameters/xyz"][rows]
        xyz[:, axis] = highest[rows]
        backend.assign(bound[rows], parameters_and_average({"xyz": xyz}))

    @cached_property
    def _eyeballs(self) -> np.ndarray:
        return eyeballs_of(self._frames.capture)

    @cached_property
    def _hair(self) -> UnseenHair:
        return UnseenHair(self._frames)

    @cached_property
    def _inner(self) -> Splats:
        return inner_layer(self._frames)

    def _is_inner(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) bool: the splats of the layer behind lids and sides, each the nearest to its place.
        By depth, lids' own splats would join it, as training moves them by more than the tenth of a
        millimeter that it is deep, and never leave it."""
        has_inner = self._surface.lids | self._frames.occlusion_layer.triangles
        rows = np.flatnonzero(has_inner[columns["face"]])
        face = columns["face"][rows]
        place = self._inner.xyz[np.searchsorted(self._inner.face, face)]
        distance = np.linalg.norm(columns["parameters/xyz"][rows] - place, axis=1)
        order = np.lexsort((distance, face))
        _, first = np.unique(face[order], return_index=True)
        is_inner = np.zeros(len(columns["face"]), bool)
        is_inner[rows[order[first]]] = True
        return is_inner


def doubt(second: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Share (N,) in 0…1 of what is plausible: 1 where views tell nothing, a half where gradients
    are DOUBT times those of well observed splats. second (N, C): Adam's moments; reference (M, C):
    those of well observed splats."""
    little = DOUBT * np.median(np.sqrt(reference.mean(1))) + np.finfo(np.float32).tiny
    return np.asarray(little / (little + np.sqrt(second.mean(1))), np.float32)


def thickness(rotation: np.ndarray, log_scale: np.ndarray, axis: int) -> np.ndarray:
    """Standard deviation (N,) of splats along a local axis; rotation (N, 4) wxyz."""
    across = to_matrices(rotation)[:, axis]
    return np.asarray(np.sqrt(((across * np.exp(log_scale)) ** 2).sum(1)))


def width(rotation: np.ndarray, log_scale: np.ndarray, axis: int) -> np.ndarray:
    """Standard deviation (N,) of splats across a local axis, geometric mean of both directions."""
    across = np.delete(to_matrices(rotation) * np.exp(log_scale)[:, None], axis, axis=1)
    return np.asarray(np.linalg.det(across @ across.swapaxes(1, 2)) ** 0.25)


def flattened(
    rotation: np.ndarray, log_scale: np.ndarray, axis: int, limit: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Splats compressed along a local axis to the standard deviation `limit` (N,), at most, and
    widened across it to a `width` of `least` (N,): rotation (N, 4) wxyz and log_scale (N, 3),
    float32. What is seen along that axis of those wide enough stays as it is."""
    wide = np.maximum(width(rotation, log_scale, axis), np.sqrt(MIN_VARIANCE))
    wider = np.maximum(least / wide, 1)
    sides = to_matrices(rotation) * np.exp(log_scale)[:, None] * wider[:, None, None]
    thick = np.linalg.norm(sides[:, axis], axis=1)
    sides[:, axis] *= np.minimum(limit / thick, 1)[:, None]
    variance, axes = np.linalg.eigh(sides @ sides.swapaxes(1, 2))
    axes[np.linalg.det(axes) < 0] *= -1
    turned = from_matrices(axes)
    scale = 0.5 * np.log(np.maximum(variance, MIN_VARIANCE))
    return turned.astype(np.float32), scale.astype(np.float32)


def above_unseen_hair(frames: FrameStore, splats: Splats) -> np.ndarray:
    """(N,) bool: unbound splats that stand higher than hair which faces no camera. Masks from
    in front do not end the hull behind a head: what stands there hangs in the air off-axis."""
    surface = frames.surface
    top = (surface.hair_height + frames.voxel) / frames.unit_lengths
    height = splats.xyz[:, NORMAL_AXIS[frames.convention]]
    is_hair = surface.hidden & (surface.hair_height > 0)
    return np.asarray(splats.unbound & is_hair[splats.face] & (height > top[splats.face]))


def hidden_splats(frames: FrameStore, settings: TrainingSettings) -> Splats:
    """A dense opaque layer on the `closed` triangles, in which no view splits splats: on skin and
    clothes, or where the outer layer of hair is, of strands where no outline shows it."""
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
    inset = border_inset(frames.surface, order)[face]
    xyz = layer.xyz * inset[:, None]
    xyz[:, axis] += frames.layer_height[face]
    log_scale = layer.log_scale + np.log(inset * frames.hair_widening[face])[:, None]
    log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    return replace(layer, xyz=xyz.astype(np.float32), log_scale=log_scale.astype(np.float32))


def hidden_order(frames: FrameStore) -> np.ndarray:
    """(F,) order of the hidden layer's lattice, the higher the larger the triangles: colors and
    ends of the mesh would be as coarse as these."""
    spacing = HIDDEN_SPACING_VOXELS * frames.voxel
    order = np.ceil(frames.units * frames.unit_lengths / spacing)
    return np.clip(order, 1, MAX_HIDDEN_ORDER).astype(int)


def border_inset(surface: Surface, order: np.ndarray) -> np.ndarray:
    """(F,) share of the size that the hidden layer, lattices of these orders (F,), has on each
    triangle."""
    inset = 1 - (1 - BORDER_INSET) / np.maximum(order, 1) ** 2
    return np.where(surface.border, inset, 1.0)


def splats_behind(frames: FrameStore, sh_degree: int) -> Splats:
    """The opaque layer under lids, whose own splats, trained on open eyes, would leave gaps when
    they close, and the `occlusion_layer`."""
    surface = frames.surface
    inner = inner_layer(frames, sh_degree)
    has_inner = (surface.lids & ~surface.closed) | frames.occlusion_layer.triangles
    return inner.rows(has_inner[inner.face])


def inner_layer(frames: FrameStore, sh_degree: int = 0) -> Splats:
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
    share = np.where(around[capture.faces].all(1), 1.0, BESIDE_LID_SHARE)
    layer.xyz[:, axis] = frames.layer_height
    layer.log_scale[:] += np.log(share)[:, None]
    layer.log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    behind = lattice_splats(
        occlusion.places, capture.faces, 0, sh_degree, OCCLUSION_OPACITY, frames.convention
    ).rows(occlusion.triangles)
    behind.log_scale[:, axis] += np.log(HIDDEN_FLATNESS)
    there = face_frames(occlusion.places, capture.faces, occlusion.places, frames.convention)
    world = to_world(behind, there)
    least = np.where(np.arange(3) == axis, 0, CELL_WIDTH * CELL_VOXELS * frames.voxel)
    world = replace(world, log_scale=np.log(np.maximum(np.exp(world.log_scale), least)))
    behind = to_local(world, frames.neutral, behind.face)
    within = lids | (frames.sides.triangles & ~frames.surface.outside)
    layer = joined([layer.rows((within & ~occlusion.triangles)[layer.face]), behind])
    layer = layer.rows(np.argsort(layer.face))
    color = np.where(occlusion.triangles[:, None], occlusion.color, frames.sides.color)
    layer.sh[:, 0] = (color[layer.face] - 0.5) / SH_C0
    return layer
