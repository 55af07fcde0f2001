"""Colors for parts that no training view shows: sides of the head, and the inside of a closed
mouth."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...avatar.embedding import MIN_DIVISOR, FaceFrames, points_to_world
from ...avatar.splats import Splats, colored_off_axis, sh_color
from ...capture.image_colors import mean_colors, mirror_images
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...flame.quaternions import unit
from .color_fill import filled_colors
from .semantic_regions import (
    BROWS_LEVEL,
    NEIGHBORS,
    HeadCoordinates,
    Region,
    hairy_triangles,
    inside_colors,
    lining_of,
    nearest_rows,
    skin_of,
    teeth_of,
)
from .surface import FACING_TIMESTEPS, GRAZING_COSINE, UNSEEN_COSINE, Surface

SPREAD_VIEWS = 12
"""Training views, spread over all, whose colors are measured."""
OPEN_VIEWS = 6
"""Views whose colors are measured of the timesteps in which the mouth is highest."""
MIN_TEETH_FRACTION = 0.04
"""Least fraction of the mouth's pixels that teeth fill; with fewer, in a slit between the lips, all
teeth count as hidden."""
SOURCE_COSINE = 0.25
"""Cosine between a triangle and the camera that it faces most above which others take its color:
hair at the temples and a beard beside the jaw are seen at 60 to 75° at least."""
WELL_VISIBLE_COSINE = 0.5
"""The same above which a view shows a face better than its mirror image does."""
FRINGE_FRACTION = 0.2
"""Highest fraction of the visible triangles above the brows; they show hair if there is any."""
MIN_VISIBLE_FRACTION = 0.1
"""Fraction of the median of the pixels that show as much of the surface, below which it is not
visible: a folded eyelid has less."""
SOURCE_TRIANGLES = 100
"""Triangles over which hair's color off axis, and that of the layer behind skin, are medians."""
COLLAR_SLOPE = 0.6
"""Rise of a collar from front to back, by its depth."""
SOURCE_WEIGHT = 5.0
"""Weight of a source's color, as `filled_colors` counts it, where a camera faces it well; it falls
to 0 at SOURCE_COSINE, where hair and the backdrop shine through."""
MIRROR_WEIGHT = 0.1
"""The same of a mirror image's color, and of hair's color on an unseen scalp: colors turn to these
within a few triangles from what is observed."""
MIRROR_GAIN = 0.1
"""Least difference of cosines by which a mirror image must face its camera better; with less,
noise decides between neighbors."""
LEVEL_WEIGHT = 8.0
"""Factor by which visible triangles of neck and shoulders count as farther where they are above or
below a hidden triangle, along the normal of the collar's plane, instead of beside it: only a neck's
front has a chin's shadow."""
VIEW_INDEPENDENT_COSINE = 0.6
"""Cosine between a triangle and the camera that it faces most above which its color depends on no
view; up to SOURCE_COSINE, it depends wholly on the view."""
OFF_AXIS_WEIGHT = 0.75
"""Fraction of the off-axis color at a right angle to the views."""
BEHIND_STEEPNESS = 1.73
"""`steepness` of the way to the off-axis color where hair behind a face looks as if it were on it:
two thirds at 45°."""
ALSO_BEHIND_STEEPNESS = 0.5
"""`steepness` of the way to a color that a splat also has from behind: 40 % at 45°."""


@dataclass(frozen=True)
class UnseenSides:
    """Prior of a head where views determine little.

    triangles   (F,) bool: no view shows them
    visible     (F,) bool: the views whose colors were looked at show them well; not those that
                look as their mirror images
    color       (F, 3) in 0…1 that a triangle plausibly has
    is_hair     (F,) bool: hair's triangles, where any is shown
    view_dependence  (F,) 0…1 of the color that views show: 1 in hair, for its sheen and strands,
                more than 0 where a triangle turns away from all views
    off_axis    (F, 3) in 0…1: the color from a right angle to the views
    """

    triangles: np.ndarray
    visible: np.ndarray
    color: np.ndarray
    is_hair: np.ndarray
    view_dependence: np.ndarray
    off_axis: np.ndarray


def unseen_sides(surface: Surface) -> UnseenSides:
    """Colors of triangles that no camera faces, which continue the observed ones. Unseen hair has
    one color. Visible triangles keep their color, except where a face turns away from few
    cameras."""
    capture = surface.capture
    cosine = surface.facing
    is_outside = surface.outside
    views = _color_views(capture)
    color, pixels = mean_colors(capture, views)
    density = pixels / np.maximum(surface.areas, MIN_DIVISOR)
    facing = density[cosine > WELL_VISIBLE_COSINE]
    median = np.median(facing[facing > 0]) if facing.any() else 0.0
    visible = density > MIN_VISIBLE_FRACTION * median
    visible |= _around_visible_teeth(surface, visible)
    is_source = (pixels > 0) & is_outside & (cosine > SOURCE_COSINE) & ~surface.lids
    if not is_source.any():
        none = np.zeros_like(visible)
        return UnseenSides(none, visible, color, none, none.astype(float), color)
    unseen = is_outside & (cosine < SOURCE_COSINE)
    well_visible = is_source & (cosine > WELL_VISIBLE_COSINE)
    hair = _hair(surface, color, pixels > 0, is_source)
    hidden = unseen | ~visible | surface.lids
    is_face = np.zeros_like(visible)
    if surface.at is not None:
        is_face = ~surface.kinds["scalp"] & ~surface.kinds["body"]
    turns_away = is_face & is_outside & (cosine < WELL_VISIBLE_COSINE)
    may_be_mirrored = unseen | turns_away if surface.has_few_cameras else unseen
    sources = is_source & ~_hanging_hair(surface, color, well_visible, hair)
    mirrored, images = mirror_images(capture, may_be_mirrored, sources)
    is_better = cosine[images] > cosine[mirrored] + MIRROR_GAIN
    pairs = _MirrorImages(mirrored[is_better], images[is_better])
    continued = _continued(surface, color, sources, pairs, hair)
    found = color.copy()
    found[hidden] = continued[hidden]
    visible[pairs.triangles[well_visible[pairs.images]]] = False
    turned = np.where(is_outside, surface.turned_from(VIEW_INDEPENDENT_COSINE, SOURCE_COSINE), 0.0)
    off_axis = color.copy()
    if surface.has_few_cameras:
        found[turns_away] = continued[turns_away]
        off_axis[turns_away] = continued[turns_away]
    is_hair = np.zeros_like(visible)
    if len(hair):
        scalp = surface.kinds["scalp"]
        near = nearest_rows(surface.centers[hair], surface.centers[scalp], SOURCE_TRIANGLES)
        off_axis[scalp] = np.median(color[hair[near]], axis=1)
        is_hair = scalp.copy()
        found[scalp & unseen] = np.median(color[hair], axis=0)
    inner = _unseen_inner(capture, pixels > 0, is_outside) | _unseen_teeth(capture, pixels, visible)
    within = inner | (~is_outside & (~visible | (pixels == 0)))
    found[within] = inside_colors(capture, color, visible, within)
    lids, of_skin = _lid_colors(surface, well_visible, color)
    found[lids] = of_skin
    visible[lids] = False
    triangles = (is_outside & (cosine < UNSEEN_COSINE)) | inner
    off_axis = np.where((unseen | ~(visible | is_hair))[:, None], found, off_axis)
    return UnseenSides(triangles, visible, found, is_hair, np.where(is_hair, 1.0, turned), off_axis)


def plausible_off_axis(
    splats: Splats, along: np.ndarray, sides: UnseenSides, neutral: FaceFrames
) -> Splats:
    """Splats that views show along one direction only, that of their triangle (F, 3), with their
    prior's color off-axis: hair, and elsewhere the splats that lie on the surface. Free splats of
    shoulders have the median color of those around: the front ones hide what colors others have. A
    hair-colored splat on skin that turns away belongs to hair behind it: off-axis it is skin."""
    face = splats.face
    fraction = OFF_AXIS_WEIGHT * sides.view_dependence[face]
    fraction[sides.triangles[face]] = 0  # they have one color from everywhere, and hair its locks
    plausible = sides.off_axis[face]
    steepness = np.ones(len(face))
    color = sh_color(splats.sh, along[face])
    beside = np.flatnonzero(splats.unbound & ~sides.is_hair[face])
    if len(beside):
        places = points_to_world(splats.xyz[beside], neutral, face[beside])
        around = beside[nearest_rows(places, places, NEIGHBORS)]
        plausible[beside] = np.median(color[around], axis=1)
        fraction[beside] = 1
        steepness[beside] = ALSO_BEHIND_STEEPNESS
    if sides.is_hair.any():
        hair = np.median(sides.off_axis[sides.is_hair], axis=0)
        from_hair, from_skin = (np.linalg.norm(color - each, axis=1) for each in (hair, plausible))
        is_behind = (fraction > 0) & ~sides.is_hair[face] & (from_hair < from_skin)
        is_behind[beside] = False
        fraction[is_behind] = 1
        steepness[is_behind] = BEHIND_STEEPNESS
    return colored_off_axis(splats, along[face], fraction, plausible, steepness)


def _hair(
    surface: Surface, color: np.ndarray, has_pixels: np.ndarray, is_source: np.ndarray
) -> np.ndarray:
    """Triangles (M,) that show hair; of a head of which only a fringe is shown, that one."""
    at = surface.at
    if at is None:
        return np.zeros(0, int)
    scalp = surface.outside & surface.regions.within(Region.SCALP)
    rows = np.flatnonzero(scalp & is_source)
    if not len(rows):
        rows = _fringe(at, surface.outside & has_pixels & (surface.facing > GRAZING_COSINE))
    is_skin = is_source & ~scalp & ~surface.kinds["body"] & (at.level < BROWS_LEVEL)
    return hairy_triangles(rows, surface.centers, color, color[is_skin])


def _hanging_hair(
    surface: Surface, color: np.ndarray, well_visible: np.ndarray, hair: np.ndarray
) -> np.ndarray:
    """(F,) bool: triangles of a face, below the brows, whose observed color is nearer to that of
    long hair, triangles (M,), than to that of skin: hair hangs in front of it. None where hair is
    short."""
    skin = well_visible & surface.regions.face
    if not surface.has_long_hair or not len(hair) or not skin.any():
        return np.zeros(len(color), bool)
    from_hair, from_skin = (
        np.linalg.norm(color - np.median(color[rows], axis=0), axis=1) for rows in (hair, skin)
    )
    return np.asarray(surface.regions.face & (from_hair < from_skin))


class _MirrorImages(NamedTuple):
    """Triangles (N,) whose mirror images (N,) face a camera better than they do."""

    triangles: np.ndarray
    images: np.ndarray


def _continued(
    surface: Surface,
    color: np.ndarray,
    is_source: np.ndarray,
    mirrored: _MirrorImages,
    hair: np.ndarray,
) -> np.ndarray:
    """Colors (F, 3) of all triangles, continued from those of the sources (F,) bool and, less, from
    mirror images and from an unseen scalp, which has the median color of the hair, triangles (M,).
    Ears continue ears, if any is well visible; colors of neck and shoulders are compared in even
    light."""
    scalp = surface.kinds["scalp"]
    body = surface.kinds["body"]
    ears = surface.regions.within(Region.EAR)
    turned_away = surface.facing < SOURCE_COSINE
    observed = color.copy()
    facing = (surface.facing - SOURCE_COSINE) / (WELL_VISIBLE_COSINE - SOURCE_COSINE)
    weight = np.where(is_source, SOURCE_WEIGHT * np.clip(facing, 0, 1) ** 2, 0.0)
    weight[ears & (surface.facing < WELL_VISIBLE_COSINE)] = 0
    light = _side_light(surface, color, is_source)
    for unseen, level_weight in ((body & turned_away, LEVEL_WEIGHT), (body & ~turned_away, 1.0)):
        rows = unseen & surface.outside & ~is_source
        if (body & is_source).any() and rows.any():
            even = color / np.sqrt(light)
            both_sides = _nearest_colors(surface, even, is_source, rows, level_weight)
            observed[rows] = both_sides * np.sqrt(light[rows])
            weight[rows] = SOURCE_WEIGHT
    if len(hair):
        rows = scalp & surface.outside & turned_away
        observed[rows] = np.median(color[hair], axis=0)
        weight[rows] = MIRROR_WEIGHT
    detail = np.full(color.shape, np.nan)
    detail[mirrored.triangles] = color[mirrored.images] * light[mirrored.triangles]
    rows = mirrored.triangles[weight[mirrored.triangles] < MIRROR_WEIGHT]
    observed[rows] = detail[rows]
    weight[rows] = MIRROR_WEIGHT
    ears_apart = ears & (ears & (weight > 0)).any()
    found = filled_colors(surface.capture.faces, observed, weight, ears_apart, detail)
    missing = np.isnan(found[:, 0])
    if missing.any():  # parts of the mesh that nothing shows, such as an eyeball
        near = nearest_rows(surface.centers[is_source], surface.centers[missing], NEIGHBORS)
        found[missing] = np.median(color[is_source][near], axis=1)
    return np.clip(found, 0, 1)


def _side_light(surface: Surface, color: np.ndarray, is_source: np.ndarray) -> np.ndarray:
    """(F, 3) how much brighter a triangle is than its mirror image, by the ratio of both sides of
    the face where both are sources (F,) bool; 1 in the middle, in front and behind."""
    at = surface.at
    if at is None:
        return np.ones_like(color)
    of_face = is_source & surface.regions.face
    left, right = mirror_images(surface.capture, of_face & (at.azimuth > 0), of_face)
    sums = (np.maximum(color[rows].sum(0), MIN_DIVISOR) for rows in (left, right))
    return np.asarray(np.divide(*sums) ** np.sin(at.azimuth)[:, None])


def _nearest_colors(
    surface: Surface,
    color: np.ndarray,
    is_source: np.ndarray,
    unseen: np.ndarray,
    level_weight: float,
) -> np.ndarray:
    """Colors (N, 3) of unseen triangles (F,) bool of neck and shoulders: medians of the NEIGHBORS
    nearest sources (F,) bool there, or mirror images of these; level_weight: see LEVEL_WEIGHT."""
    assert surface.at is not None
    _, up, ahead = surface.at.axes
    tilted = unit(up + COLLAR_SLOPE * ahead)
    farther = (level_weight - 1) * (surface.centers @ tilted)
    centers = surface.centers + np.outer(farther, tilted)
    sources = is_source & surface.kinds["body"]
    rows, images = mirror_images(surface.capture, ~sources, sources)
    direct = np.flatnonzero(sources)
    places = centers[np.concatenate([direct, rows])]
    colors = color[np.concatenate([direct, images])]
    near = nearest_rows(places, centers[unseen], NEIGHBORS)
    return np.asarray(np.median(colors[near], axis=1))


def _lid_colors(
    surface: Surface, is_source: np.ndarray, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (M,) of folded lids, of which views show only a shaded edge, and the colors (M, 3)
    that they get: the median of the observed skin in the same half of the face. Lids are left out
    where no skin is observed in their half."""
    skin_color = np.full(color.shape, np.nan)
    at = surface.at
    if at is not None:
        skin = surface.regions.face & is_source
        for half in (at.azimuth > 0, at.azimuth <= 0):
            if (skin & half).any():
                skin_color[surface.folded_lids & half] = np.median(color[skin & half], axis=0)
    lids = np.flatnonzero(np.isfinite(skin_color[:, 0]))
    return lids, skin_color[lids]


def _fringe(at: HeadCoordinates, visible: np.ndarray) -> np.ndarray:
    """The highest of the triangles (F,) bool that are shown above the brows."""
    above = np.flatnonzero(visible & (at.level > BROWS_LEVEL))
    return above[np.argsort(at.level[above])][int(len(above) * (1 - FRINGE_FRACTION)) :]


def _color_views(capture: Capture) -> list[View]:
    """Some views spread over all, and some of the timesteps in which the mouth is highest: a mouth
    that opens once is seen."""
    views = capture.views["train"]
    spread = evenly_spread(views, SPREAD_VIEWS)
    mouth = capture.regions.get("mouth")
    by_timestep = views_by_timestep(views)
    is_known = mouth is not None and mouth.any() and capture.flame is not None
    if not is_known or len(by_timestep) <= SPREAD_VIEWS:
        return spread
    lips = np.unique(capture.faces[mouth])
    height = {}
    for timestep in evenly_spread(list(by_timestep), FACING_TIMESTEPS):
        place = np.asarray(capture.mesh(timestep))[lips]
        height[timestep] = np.linalg.svd(place - place.mean(0), compute_uv=False)[1]
    highest = sorted(height, key=lambda timestep: -height[timestep])[:OPEN_VIEWS]
    opened = [by_timestep[timestep] for timestep in highest]
    return [*spread, *(part[len(part) // 2] for part in opened)]


def _unseen_inner(capture: Capture, visible: np.ndarray, is_outside: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles inside of mouth and eyes that neither a view nor a view of a neighbor
    shows. Folds of ears are left out, because other views show them. None in a long recording whose
    meshes are files, because not all open mouths were looked for."""
    if capture.flame is None and len(capture.timesteps) > SPREAD_VIEWS:
        return np.zeros(len(visible), bool)
    touched = np.zeros(len(capture.neutral), bool)
    touched[capture.faces[visible]] = True
    may_line = ~skin_of(capture) | lining_of(capture)
    return np.asarray(may_line & ~is_outside & ~touched[capture.faces].any(1))


def _around_visible_teeth(surface: Surface, visible: np.ndarray) -> np.ndarray:
    """(F,) bool: teeth near those that are shown: they may be smaller than the pixels, between
    whose centers they lie."""
    teeth = np.flatnonzero(teeth_of(surface.capture))
    found = np.zeros(len(visible), bool)
    if len(teeth):
        places = surface.centers[teeth]
        found[teeth] = visible[teeth][nearest_rows(places, places, NEIGHBORS)].any(1)
    return found


def _unseen_teeth(capture: Capture, pixels: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(F,) bool: teeth that the pixels (F,) do not show well, or all where lips hide them."""
    teeth = teeth_of(capture)
    in_mouth = pixels[capture.regions.get("mouth", teeth)].sum()
    if pixels[teeth].sum() < MIN_TEETH_FRACTION * in_mouth:
        return teeth
    return np.asarray(teeth & ~visible)
