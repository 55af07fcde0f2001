"""Priors for splats that training views show little of. Without them, light through the front, or a
pixel of an outline, would give such splats any color, size and place."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from ...avatar.lattice import NORMAL_AXIS, SCALE, lattice_splats
from ...avatar.splats import SH_C0, Splats
from ...flame.quaternions import from_matrices, to_matrices
from .backend import Backend
from .frames import FrameStore
from .hidden_layers import HIDDEN_OPACITY, hidden_order, layer_on, occluding_splats
from .semantic_regions import eyeballs_of, lining_of
from .state import parameters_and_average
from .step_hook import Schedule
from .unseen_hair import UnseenHair

WELL_OBSERVED_COSINE = 0.8
"""Cosine between a triangle and the camera that it faces most above which its splats are well
observed: others' gradients are compared with theirs."""
BEHIND_COSINE = -0.5
"""Cosine below which nothing stands in an outline."""
DOUBT = 0.3
"""Gradient, as a fraction of the median of well observed splats, at which a step pulls a splat
halfway to what is plausible."""
MIN_PULL = 0.02
"""Least fraction of that way that is worth a change."""
LEAST_WIDTH_FRACTION = 0.9
"""Width below which splats of the hidden layer may not shrink, as a fraction of what the lattice
begins with."""
LINING_FRACTION = 0.5
"""Largest scale behind closed lips, as a fraction of that of a triangle's only splat."""
EYE_DEPTH_M = 0.0005
"""Least depth of splats below the eyeballs that they are on."""
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
"""Columns that are read of the splats that may be pulled."""
PINNED_KINDS = ("parameters", "average", "first", "second")
"""Arrays of the splats whose color is pinned."""
INNER_PARAMETERS = ("xyz", "rotation", "log_scale", "opacity")
"""Parameters of occluding splats, and of the layer where the mesh ends, that do not change."""


@dataclass(frozen=True)
class BoundSplats:
    """The bound splats that priors may change, as they were before the first prior.

    rows          (N,) their rows in the backend
    columns       PULLED_COLUMNS, (N, …) each
    reference     MOMENTS of well observed splats, (M, …) each
    is_occluding  (N,) bool: those of `occluding_splats`
    """

    backend: Backend
    rows: np.ndarray
    columns: Mapping[str, np.ndarray]
    reference: Mapping[str, np.ndarray]
    is_occluding: np.ndarray

    @property
    def face(self) -> np.ndarray:
        return self.columns["face"]

    def assign(self, which: np.ndarray, values: Mapping[str, np.ndarray | float]) -> None:
        """Give the splats `which` (K,), numbers among these, new columns (K, …)."""
        self.backend.assign(self.rows[which], values)


class Prior(Protocol):
    """What is plausible of some splats; made once for the frames of a training."""

    def apply(self, splats: BoundSplats) -> None:
        """Pull or keep what the views do not determine."""
        ...


class SurfacePrior:
    """Pulls bound splats toward a prior; the pull is stronger where views determine less.

    How much views determine is read from Adam's second moments, root mean squares of gradients.
    Without this, its steps, which are of one length for strong and weak gradients, would let splats
    that fill a pixel of an outline take any color and size for the cameras that see them from
    behind.
    """

    interval = 20

    def __init__(self, frames: FrameStore) -> None:
        self._frames = frames
        self._surface = frames.surface

    @cached_property
    def may_be_pulled(self) -> np.ndarray:
        """(F,) bool: triangles with splats that priors may pull; few with many cameras."""
        surface = self._surface
        sides = self._frames.sides
        may_be = sides.triangles | ~sides.visible | surface.lids | surface.is_flat
        may_be |= self._frames.occlusion_layer.triangles | eyeballs_of(self._frames.capture)
        return np.asarray(may_be | (surface.turned_away > 0))

    def prepare(self) -> None:
        self.may_be_pulled  # noqa: B018

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        where = backend.columns(("face", "unbound"))
        is_bound = ~where["unbound"]
        rows = np.flatnonzero(is_bound & self.may_be_pulled[where["face"]])
        if not len(rows):
            return
        well_observed = is_bound & (self._surface.facing > WELL_OBSERVED_COSINE)[where["face"]]
        reference = np.flatnonzero(well_observed if well_observed.any() else is_bound)
        moments = backend.columns(MOMENTS, reference)
        columns = backend.columns(PULLED_COLUMNS, rows)
        splats = BoundSplats(backend, rows, columns, moments, self._is_occluding(columns))
        for prior in self._priors:
            prior.apply(splats)

    @cached_property
    def _known(self) -> "_Known":
        return _Known(self._frames)

    @cached_property
    def _priors(self) -> list[Prior]:
        return [prior(self._known) for prior in PRIORS]

    def _is_occluding(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) bool: the splats of the layer behind lids and sides, each the nearest to its place.
        By depth, lids' own splats would join it, as training moves them by more than the tenth of a
        millimeter that it is deep, and never leave it."""
        has_inner = self._surface.lids | self._frames.occlusion_layer.triangles
        rows = np.flatnonzero(has_inner[columns["face"]])
        face = columns["face"][rows]
        inner = self._known.inner
        place = inner.xyz[np.searchsorted(inner.face, face)]
        distance = np.linalg.norm(columns["parameters/xyz"][rows] - place, axis=1)
        order = np.lexsort((distance, face))
        _, first = np.unique(face[order], return_index=True)
        is_occluding = np.zeros(len(columns["face"]), bool)
        is_occluding[rows[order[first]]] = True
        return is_occluding


class _Known:
    """What the priors of a training share."""

    def __init__(self, frames: FrameStore) -> None:
        self.frames = frames
        self.surface = frames.surface
        self.sides = frames.sides
        self.normal_axis = NORMAL_AXIS[frames.convention]

    @cached_property
    def hair(self) -> UnseenHair:
        return UnseenHair(self.frames)

    @cached_property
    def inner(self) -> Splats:
        return occluding_splats(self.frames)


class PlausibleColor:
    """Splats that views do not show take the color of `UnseenSides`, and keep it where no view
    determines it: training views see only the shaded edge of a folded lid."""

    def __init__(self, known: _Known) -> None:
        self._known = known

    def apply(self, splats: BoundSplats) -> None:
        known = self._known
        sides = known.sides
        face = splats.face
        moments = splats.columns["second/color"]
        is_occluding = splats.is_occluding
        fraction = doubt(moments, splats.reference["second/color"]) * ~sides.visible[face]
        # the avatar is made of averages, which only steps move
        is_untouched = ~sides.visible[face] & ~moments.any(1)
        is_folded = known.surface.folded_lids[face] & ~sides.visible[face]
        is_pinned = sides.triangles[face] | is_occluding | is_untouched | is_folded
        colors = sides.color[face]
        hair = np.flatnonzero(sides.is_hair[face])
        if len(hair):
            shades = known.hair.shades(face[hair], splats.columns["parameters/xyz"][hair])
            colors[hair] *= shades[:, None]
        plausible = ((colors - 0.5) / SH_C0).astype(np.float32)
        inner = np.searchsorted(known.inner.face, face[is_occluding])
        plausible[is_occluding] = known.inner.sh[inner, 0]
        rows = np.flatnonzero((fraction > MIN_PULL) & ~is_pinned)
        color = splats.columns["parameters/color"][rows]
        color += fraction[rows, None] * (plausible[rows] - color)
        splats.assign(rows, {"parameters/color": color})
        rows = np.flatnonzero(is_pinned)
        zeros = dict.fromkeys((f"{kind}/sh" for kind in PINNED_KINDS), 0.0)
        values = parameters_and_average({"color": plausible[rows]})
        splats.assign(rows, {**zeros, **values})


class OpaqueSurface:
    """Splats that face away from the views are opaque and lie on the surface, or in the outer layer
    of hair."""

    def __init__(self, known: _Known) -> None:
        self._known = known

    def apply(self, splats: BoundSplats) -> None:
        known = self._known
        surface = known.surface
        face = splats.face
        moments = splats.columns["second/opacity"]
        fraction = doubt(moments[:, None], splats.reference["second/opacity"][:, None])
        turned_away = np.where(surface.sticks_out, 0, surface.turned_away)
        fraction = (fraction * turned_away[face]) ** 2  # little of what outlines show
        # no view has stepped these: beyond images' edges also lies what faces cameras
        beyond = surface.outside & ~surface.sticks_out & ~known.sides.visible
        fraction[beyond[face] & ~moments.astype(bool)] = 1
        rows = np.flatnonzero(fraction > MIN_PULL)
        fraction = fraction[rows]
        opacity = splats.columns["parameters/opacity"][rows]
        opacity += fraction * (HIDDEN_OPACITY - opacity)
        xyz = splats.columns["parameters/xyz"][rows]
        axis = known.normal_axis
        height = known.hair.height(face[rows], xyz)
        xyz[:, axis] += fraction * (height - xyz[:, axis])
        splats.assign(rows, parameters_and_average({"opacity": opacity, "xyz": xyz}))


class ShortSteps:
    """Where gradients are below DOUBT times those of well observed splats, Adam's steps in position
    and shape are shortened by that ratio. Otherwise a layer that is hardly visible would get
    holes."""

    def __init__(self, known: _Known) -> None:
        pass

    def apply(self, splats: BoundSplats) -> None:
        reference = splats.reference
        least = {name: DOUBT**2 * np.median(reference[name].mean(1)) for name in GEOMETRY_MOMENTS}
        moments = {name: np.maximum(splats.columns[name], least[name]) for name in GEOMETRY_MOMENTS}
        splats.assign(np.arange(len(splats.rows)), moments)


class FlatSkin:
    """Splats on skin and clothes stay thin, and those of the hidden layer stay wide enough to close
    it."""

    def __init__(self, known: _Known) -> None:
        self._known = known

    def apply(self, splats: BoundSplats) -> None:
        frames = self._known.frames
        axis = self._known.normal_axis
        rows = np.flatnonzero(self._known.surface.is_flat[splats.face])
        face = splats.face[rows]
        rotation = splats.columns["parameters/rotation"][rows]
        log_scale = splats.columns["parameters/log_scale"][rows]
        limits = FLAT_VOXELS * frames.voxel / frames.unit_lengths[face]
        least = self._least_width[face]
        is_off = thickness(rotation, log_scale, axis) > FLAT_TOLERANCE * limits
        layer = np.flatnonzero(least > 0)
        widths = width(rotation[layer], log_scale[layer], axis)
        is_off[layer] |= widths * FLAT_TOLERANCE < least[layer]
        off = np.flatnonzero(is_off)
        flat = flattened(rotation[off], log_scale[off], axis, limits[off], least[off])
        values = parameters_and_average(dict(zip(("rotation", "log_scale"), flat, strict=True)))
        moments = dict.fromkeys(("first/rotation", "first/log_scale"), 0.0)
        splats.assign(rows[off], {**values, **moments})

    @cached_property
    def _least_width(self) -> np.ndarray:
        """(F,) of the `width` of the layer on triangles that face away from all cameras, in local
        units; smaller, it has gaps. 0 elsewhere."""
        surface = self._known.surface
        frames = self._known.frames
        is_layer = surface.closed & (surface.facing < BEHIND_COSINE)
        hair = self._known.hair.least_width
        skin = LEAST_WIDTH_FRACTION * SCALE * frames.units / hidden_order(frames)
        return np.where(is_layer, np.where(hair > 0, hair, skin), 0.0)


class FixedOcclusion:
    """Splats of the mouth's unseen inside, and behind lids and sides, stay as `occluding_splats`
    placed them: views would make them any size."""

    def __init__(self, known: _Known) -> None:
        self._inner = known.inner
        self._is_inside = known.sides.triangles & ~known.surface.outside

    def apply(self, splats: BoundSplats) -> None:
        rows = np.flatnonzero(self._is_inside[splats.face] | splats.is_occluding)
        inner = self._inner.rows(np.searchsorted(self._inner.face, splats.face[rows]))
        kept = {name: getattr(inner, name) for name in INNER_PARAMETERS}
        splats.assign(rows, parameters_and_average(kept))


class FixedEnd:
    """Splats of the layer where the mesh ends, the first ones of their triangles, stay as its
    lattice has them: masks would fray the end."""

    def __init__(self, known: _Known) -> None:
        surface = known.surface
        is_end = surface.closed & surface.border & ~known.hair.has_strands
        layer = layer_on(known.frames, is_end, hidden_order(known.frames), 0)
        self._lattice = layer.rows(np.argsort(layer.face, kind="stable"))
        self._size = np.bincount(layer.face, minlength=len(surface.border))

    def apply(self, splats: BoundSplats) -> None:
        size = self._size
        is_occluding = splats.is_occluding
        count = np.bincount(splats.face[~is_occluding], minlength=len(size))
        is_whole = (size > 0) & (count >= size)  # not where another lattice was chosen
        rows = np.flatnonzero(is_whole[splats.face] & ~is_occluding)
        rows = rows[np.argsort(splats.face[rows], kind="stable")]
        face = splats.face[rows]
        number = np.arange(len(rows)) - np.searchsorted(face, face)
        is_first = number < size[face]
        place = (np.searchsorted(self._lattice.face, face) + number)[is_first]
        kept = {name: getattr(self._lattice, name)[place] for name in INNER_PARAMETERS}
        splats.assign(rows[is_first], parameters_and_average(kept))


class SmallLining:
    """Splats on the lips' inner side that few cameras show well stay small: large ones would hang
    in front of the teeth when the lips part."""

    def __init__(self, known: _Known) -> None:
        capture = known.frames.capture
        sides = known.sides
        lining = lining_of(capture) & ~known.surface.outside & ~sides.visible & ~sides.triangles
        lining &= known.surface.has_few_cameras
        single = lattice_splats(
            capture.neutral, capture.faces, 0, 0, convention=known.frames.convention
        )
        largest = single.log_scale.max(1) + np.log(LINING_FRACTION)
        self._limits = np.where(lining, largest, np.inf).astype(np.float32)

    def apply(self, splats: BoundSplats) -> None:
        limits = self._limits[splats.face, None]
        rows = np.flatnonzero((splats.columns["parameters/log_scale"] > limits).any(1))
        log_scale = np.minimum(splats.columns["parameters/log_scale"][rows], limits[rows])
        values = parameters_and_average({"log_scale": log_scale})
        splats.assign(rows, {**values, "first/log_scale": 0.0})


class SunkenEyes:
    """Splats on eyeballs lie below them: lids, whose splats are as deep, close over them."""

    def __init__(self, known: _Known) -> None:
        self._axis = known.normal_axis
        self._eyeballs = eyeballs_of(known.frames.capture)
        self._highest = -EYE_DEPTH_M / known.frames.unit_lengths

    def apply(self, splats: BoundSplats) -> None:
        highest = self._highest[splats.face]
        rises = splats.columns["parameters/xyz"][:, self._axis] > highest
        rows = np.flatnonzero(rises & self._eyeballs[splats.face])
        xyz = splats.columns["parameters/xyz"][rows]
        xyz[:, self._axis] = highest[rows]
        splats.assign(rows, parameters_and_average({"xyz": xyz}))


PRIORS = (
    PlausibleColor,
    OpaqueSurface,
    ShortSteps,
    FlatSkin,
    FixedOcclusion,
    FixedEnd,
    SmallLining,
    SunkenEyes,
)
"""Priors in the order in which they apply: a later one may change the result of an earlier one."""


def doubt(second: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Weight (N,) of the prior in 0…1: 1 where views determine nothing, 0.5 where gradients are
    DOUBT times those of well observed splats. second (N, C): Adam's moments; reference (M, C):
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
    """Splats compressed along a local axis to a standard deviation of at most `limit` (N,), and
    widened across it to a `width` of at least `least` (N,): rotation (N, 4) wxyz and log_scale (N,
    3), float32. Splats that are wide enough look the same along that axis as before."""
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
