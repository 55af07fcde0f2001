"""Colors for parts that no training view shows: sides of the head, and the inside of a closed
mouth."""

from dataclasses import dataclass

import numpy as np

from ...avatar.embedding import MIN_DIVISOR, FaceFrames, points_to_world
from ...avatar.splats import Splats, colored_off_axis, sh_color
from ...capture.image_colors import mean_colors, mirror_images
from ...capture.mesh_geometry import connected_parts
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...flame.quaternions import unit
from .semantic_regions import (
    BROWS_LEVEL,
    HeadCoordinates,
    Region,
    hairy_triangles,
    inside_colors,
    lining_of,
    nearest_rows,
    skin_of,
    teeth_of,
)
from .surface import FACING_TIMESTEPS, UNSEEN_COSINE, Surface

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
FRINGE_COSINE = 0.2
"""The same for the scalp, which takes the color of a fringe where it is not visible itself."""
FRINGE_FRACTION = 0.2
"""Highest fraction of the visible triangles above the brows; they show hair if there is any."""
MIN_VISIBLE_FRACTION = 0.1
"""Fraction of the median of the pixels that show as much of the surface, below which it is not
visible: a folded eyelid has less."""
NEAREST = 24
"""Neighbors whose colors' median hidden triangles and free splats have, and that show a tooth."""
SOURCE_TRIANGLES = 100
"""Triangles over which hair's color off axis, and that of the layer behind skin, are medians."""
COLLAR_SLOPE = 0.6
"""Rise of a collar from front to back, by its depth."""
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
    """Colors of triangles that no camera faces. They take the color of the nearest visible
    triangles on either side of the head; those on the other side are mirrored. Unseen hair has one
    color, and ears take the color of ears. Visible triangles keep their color, except on faces of
    few cameras, which take their mirror image's color where that is shown better."""
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
    sides = _Sides(surface, color)
    hidden = unseen | ~visible | surface.lids
    found = color.copy()
    ears = surface.regions.within(Region.EAR)
    found[hidden] = sides.nearest(is_source & ~ears, hidden)
    turned = np.where(is_outside, surface.turned_from(VIEW_INDEPENDENT_COSINE, SOURCE_COSINE), 0.0)
    off_axis = color.copy()
    is_hair = np.zeros_like(visible)
    may_be_mirrored = unseen.copy()
    if surface.at is not None:
        # what faces a camera beyond its image goes on as the image ends
        body = surface.kinds["body"]
        of_kind = (body, body & ~unseen, False), (body, body & unseen, True), (ears, ears, False)
        for like, kind, is_level in of_kind:
            if (like & is_source).any() and (kind & hidden).any():
                found[kind & hidden] = sides.nearest(like & is_source, kind & hidden, is_level)
        if surface.has_few_cameras:
            turns_away = sides.of_face & is_outside & (cosine < WELL_VISIBLE_COSINE)
            off_axis[turns_away] = sides.nearest(is_source & ~ears, turns_away)
            may_be_mirrored |= turns_away
        scalp = surface.kinds["scalp"]
        if len(hair):
            near = nearest_rows(sides.centers[hair], sides.centers[scalp], SOURCE_TRIANGLES)
            off_axis[scalp] = np.median(color[hair[near]], axis=1)
            is_hair = scalp.copy()
            found[scalp & unseen] = np.median(color[hair], axis=0)
    rows, mirrored = sides.mirrored(may_be_mirrored, well_visible)
    found[rows] = mirrored
    visible[rows] = False
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
        around = beside[nearest_rows(places, places, NEAREST)]
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
        rows = _fringe(at, surface.outside & has_pixels & (surface.facing > FRINGE_COSINE))
    is_skin = is_source & ~scalp & ~surface.kinds["body"] & (at.level < BROWS_LEVEL)
    return hairy_triangles(rows, surface.centers, color, color[is_skin])


class _Sides:
    """Colors of a surface's triangles by those that are shown on either side of the head."""

    def __init__(self, surface: Surface, color: np.ndarray) -> None:
        capture = surface.capture
        self._color = color
        self.centers = surface.centers
        self.of_face = np.zeros(len(color), bool)
        if surface.at is not None:
            self.of_face = ~surface.kinds["scalp"] & ~surface.kinds["body"]
            _, up, ahead = surface.at.axes
            tilted = unit(up + COLLAR_SLOPE * ahead)
            farther = (LEVEL_WEIGHT - 1) * (self.centers @ tilted)
            self._raised = self.centers + np.outer(farther, tilted)
        self._part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
        every = np.ones(len(color), bool)
        self._partner, self._image = mirror_images(capture, every, every)

    def nearest(
        self, sources: np.ndarray, hidden: np.ndarray, is_level: bool = False
    ) -> np.ndarray:
        """Colors (N, 3) of the triangles `hidden` (F,) bool: medians of those of the NEAREST
        sources (F,) bool or mirror images of these, of the same connected part where it has
        any. is_level: whether those above and below count as farther (LEVEL_WEIGHT)."""
        centers = self._raised if is_level else self.centers
        direct = np.flatnonzero(sources)
        of_source = sources[self._image]
        rows = np.concatenate([direct, self._partner[of_source]])
        places = centers[rows]
        colors = self._color[np.concatenate([direct, self._image[of_source]])]
        parts = self._part[rows]
        found = self._color.copy()
        for number in np.unique(self._part[hidden]):
            rows = np.flatnonzero(hidden & (self._part == number))
            known = parts == number
            if not known.any():
                known[:] = True
            near = nearest_rows(places[known], centers[rows], NEAREST)
            found[rows] = np.median(colors[known][near], axis=1)
        return np.asarray(found[hidden])

    def mirrored(self, hidden: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of the triangles `hidden` (F,) bool have mirror images that are `visible`, and
        their colors (N, 3)."""
        are_visible = hidden[self._partner] & visible[self._image]
        return self._partner[are_visible], self._color[self._image[are_visible]]


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
        found[teeth] = visible[teeth][nearest_rows(places, places, NEAREST)].any(1)
    return found


def _unseen_teeth(capture: Capture, pixels: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(F,) bool: teeth that the pixels (F,) do not show well, or all where lips hide them."""
    teeth = teeth_of(capture)
    in_mouth = pixels[capture.regions.get("mouth", teeth)].sum()
    if pixels[teeth].sum() < MIN_TEETH_FRACTION * in_mouth:
        return teeth
    return np.asarray(teeth & ~visible)
