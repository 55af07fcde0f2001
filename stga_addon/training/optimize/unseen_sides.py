"""Colors of what no training view shows, sides of the head and the inside of a closed mouth."""

from dataclasses import dataclass

import numpy as np

from ...avatar.embedding import MIN_DIVISOR, face_areas
from ...avatar.splats import Splats, colored_off_axis
from ...capture.mesh_geometry import connected_parts
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from .initial_splats import mean_colors, mirror_images
from .semantic_regions import (
    BROWS_LEVEL,
    SMOOTHED,
    HeadCoordinates,
    face_of,
    hairy_triangles,
    inside_colors,
    lining_of,
    nearest_rows,
    skin_of,
    sources_around_head,
    teeth_of,
)
from .surface import FACING_TIMESTEPS, GRAZING_COSINE, UNSEEN_COSINE, Surface

SPREAD_VIEWS = 12
"""Training views, spread over all, whose colors are measured."""
OPEN_VIEWS = 6
"""Views whose colors are measured of the timesteps in which the mouth is highest."""
MIN_TEETH_SHARE = 0.04
"""Of the pixels that show the mouth, that teeth fill at least; a slit between lips is as well one
of the mesh alone."""
SOURCE_COSINE = 0.5
"""Cosine between a triangle and a camera below which others do not take its color, which may
contain a matte's edge."""
FRINGE_COSINE = 0.2
"""The same for the scalp, which takes the color of a fringe where it is not visible itself."""
FRINGE_SHARE = 0.2
"""Of what is shown above the brows, the highest, where hair is if there is any."""
MIN_SHOWN_SHARE = 0.1
"""Fraction of the median of the pixels that show as much of the surface, below which it is not
visible: a folded eyelid has less."""
SOURCE_TRIANGLES = 100
"""Of whose colors a hidden triangle has the median."""
MAX_LIGHT_RATIO = 2.0
"""Of the light on one side of a face to that on the other."""
SMOOTHING = {"scalp": (SMOOTHED, 1.0), "body": (2 * SMOOTHED, 3.0)}
"""Triangles over which copied colors are smoothed, and by how much those above and below count as
farther than those beside: collars are level, and shadows of a chin are on the neck's front only."""
SOFTENING_FACTOR = 4
"""Triangles over which colors are softened, in multiples of those they are smoothed over."""
SAME_COLOR_DEVIATION = 0.12
"""Largest difference in 0…1 of colors that differ by their shade alone: collars and hairlines stay
sharp."""
SHOWN_COSINE = 0.5
"""Cosine between a triangle and the camera that it faces most above which its color depends on no
view."""
OFF_AXIS_WEIGHT = 0.75
"""Fraction of the off-axis color at a right angle to the views."""


@dataclass(frozen=True)
class UnseenSides:
    """What is plausible where views tell little of a head.

    triangles   (F,) bool: no view shows them
    shown       (F,) bool: the views whose colors were looked at show them well; not those that
                look as their mirror images
    color       (F, 3) in 0…1 that a triangle plausibly has
    is_hair     (F,) bool: hair's triangles, where any is shown
    view_dependence  (F,) 0…1 of the color that views show: 1 in hair, for its sheen and strands,
                more than 0 where a triangle turns away from all views
    off_axis    (F, 3) in 0…1: the color from a right angle to the views
    """

    triangles: np.ndarray
    shown: np.ndarray
    color: np.ndarray
    is_hair: np.ndarray
    view_dependence: np.ndarray
    off_axis: np.ndarray


def unseen_sides(surface: Surface) -> UnseenSides:
    """Triangles that no camera looks at, and of few cameras those of the face that turn away, look
    as their mirror images that are shown well; of scalp, neck and shoulders else as shown ones of
    their height, back and forth around the head, smoothed over those around; any other as the
    nearest connected ones. What views show looks as there."""
    capture = surface.capture
    cosine = surface.facing
    is_outside = surface.outside
    color, pixels = mean_colors(capture, _color_views(capture))
    density = pixels / np.maximum(face_areas(capture.neutral, capture.faces), MIN_DIVISOR)
    facing = density[cosine > SOURCE_COSINE]
    median = np.median(facing[facing > 0]) if facing.any() else 0.0
    shown = density > MIN_SHOWN_SHARE * median
    is_source = (pixels > 0) & is_outside & (cosine > SOURCE_COSINE) & ~surface.lids
    sources = np.flatnonzero(is_source)
    if not len(sources):
        none = np.zeros_like(shown)
        return UnseenSides(none, shown, color, none, none.astype(float), color)
    unseen = is_outside & (cosine < GRAZING_COSINE)
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    found = _as_nearest(capture, color, sources, unseen | ~shown | surface.lids)
    turned = np.where(is_outside, surface.turned_from(SHOWN_COSINE), 0.0)
    off_axis = color.copy()
    turns_away = np.zeros_like(shown)
    hair = np.full(3, np.inf)
    is_hair = np.zeros_like(shown)
    at = surface.at
    if at is not None:
        kinds = surface.kinds
        of_face = is_outside & ~kinds["scalp"] & ~kinds["body"]
        turns_away = of_face & (cosine < SOURCE_COSINE) & surface.has_few_cameras
        is_skin = of_face & is_source & (at.level < BROWS_LEVEL)
        for kind, members in kinds.items():
            own = np.flatnonzero(members & is_source)
            if kind == "scalp":
                if not len(own):
                    own = _fringe(at, is_outside & (pixels > 0) & (cosine > FRINGE_COSINE))
                own = hairy_triangles(own, centers, color, color[is_skin])
            if kind == "scalp" and len(own):
                near = nearest_rows(centers[own], centers[members], SOURCE_TRIANGLES)
                off_axis[members] = np.median(color[own[near]], axis=1)
                is_hair |= members
                hair = np.median(color[own], axis=0)
            rows = np.flatnonzero(members & unseen)
            if len(own) and len(rows):
                copied = color[sources_around_head(at, own, rows)]
                found[rows] = _smoothed(copied, centers[rows] @ at.axes.T, SMOOTHING[kind])
    hidden, mirrored = _mirrored_colors(surface, color, unseen | turns_away, is_source, hair)
    found[hidden] = mirrored
    shown[hidden] = False
    inside = _unseen_inside(capture, pixels > 0, is_outside) | _unseen_teeth(capture, pixels, shown)
    within = inside | (~is_outside & ~shown)
    found[within] = inside_colors(capture, color, shown, within)
    lids, of_skin = _lid_colors(surface, is_source, color)
    found[lids] = of_skin
    shown[lids] = False
    triangles = (is_outside & (cosine < UNSEEN_COSINE)) | inside
    off_axis = np.where((unseen | ~(shown | is_hair))[:, None], found, off_axis)
    return UnseenSides(triangles, shown, found, is_hair, np.where(is_hair, 1.0, turned), off_axis)


def plausible_off_axis(splats: Splats, along: np.ndarray, sides: UnseenSides) -> Splats:
    """Splats that views show along one direction only, that of their triangle (F, 3), with what is
    plausible off-axis: hair, and of the rest what lies on it, not what hangs before it."""
    face = splats.face
    share = OFF_AXIS_WEIGHT * sides.view_dependence[face]
    share[splats.unbound & ~sides.is_hair[face]] = 0
    share[sides.triangles[face]] = 0  # they have one color from everywhere, and hair its locks
    return colored_off_axis(splats, along[face], share, sides.off_axis[face])


def _smoothed(color: np.ndarray, places: np.ndarray, smoothing: tuple[int, float]) -> np.ndarray:
    """Colors (N, 3), of each the median of those around it, as SMOOTHING has it, and of such
    medians the mean of similar ones: what is copied from a lit and a shaded side would have
    patches of both. places (N, 3) to the head's left, up and ahead."""
    count, level_weight = smoothing
    places = places * [1, level_weight, 1]
    median = np.median(color[nearest_rows(places, places, count)], axis=1)
    around = median[nearest_rows(places, places, SOFTENING_FACTOR * count)]
    difference = (around - median[:, None]) / SAME_COLOR_DEVIATION
    weight = np.exp(-(difference**2).sum(2, keepdims=True) / 2)
    return np.asarray((weight * around).sum(1) / weight.sum(1))


def _as_nearest(
    capture: Capture, color: np.ndarray, sources: np.ndarray, hidden: np.ndarray
) -> np.ndarray:
    """Colors (F, 3), those of `hidden` triangles (F,) bool as of the nearest sources (M,), of the
    same connected part where it has any."""
    found = color.copy()
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[hidden]):
        rows = np.flatnonzero(hidden & (part == number))
        own = sources[part[sources] == number] if (part[sources] == number).any() else sources
        near = nearest_rows(centers[own], centers[rows], SOURCE_TRIANGLES)
        found[rows] = np.median(color[own[near]], axis=1)
    return found


def _mirrored_colors(
    surface: Surface,
    color: np.ndarray,
    unseen: np.ndarray,
    is_source: np.ndarray,
    hair: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Unseen triangles whose mirror images are sources, and what they look like (N, 3): those of
    the face in the light of their own side, as the nearest that are shown on both sides tell it;
    what looks rather like hair (3,) stays as it is, as does the hair around."""
    capture = surface.capture
    hidden, partner = mirror_images(capture, unseen, is_source)
    found = color[partner]
    if surface.at is None:
        return hidden, found
    is_face = ~surface.kinds["scalp"] & ~surface.kinds["body"]
    both, opposite = mirror_images(capture, is_source & is_face, is_source & is_face)
    if not len(both):
        return hidden, found
    away_from_hair = np.linalg.norm(found - hair, axis=1)
    away_from_skin = np.linalg.norm(found - np.median(color[both], axis=0), axis=1)
    rows = np.flatnonzero(is_face[hidden] & (away_from_skin < away_from_hair))
    if len(rows):
        centers = np.asarray(capture.neutral)[capture.faces].mean(1)
        near = nearest_rows(centers[both], centers[hidden[rows]], SOURCE_TRIANGLES)
        here, there = (np.median(color[own[near]], axis=1) for own in (both, opposite))
        gain = here / np.maximum(there, MIN_DIVISOR)
        found[rows] *= np.clip(gain, 1 / MAX_LIGHT_RATIO, MAX_LIGHT_RATIO)
    return hidden, np.clip(found, 0, 1)


def _lid_colors(
    surface: Surface, is_source: np.ndarray, color: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lids (M,) that stay in their folds, which are in the shade, and the median color (M, 3) of
    skin in their half of the face; none where no skin is shown there."""
    found = np.full(color.shape, np.nan)
    at = surface.at
    if at is not None:
        skin = face_of(at) & is_source
        for half in (at.azimuth > 0, at.azimuth <= 0):
            if (skin & half).any():
                found[surface.folded_lids & half] = np.median(color[skin & half], axis=0)
    lids = np.flatnonzero(np.isfinite(found[:, 0]))
    return lids, found[lids]


def _fringe(at: HeadCoordinates, shown: np.ndarray) -> np.ndarray:
    """The highest of the triangles (F,) bool that are shown above the brows."""
    above = np.flatnonzero(shown & (at.level > BROWS_LEVEL))
    return above[np.argsort(at.level[above])][int(len(above) * (1 - FRINGE_SHARE)) :]


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
    return [*spread, *(own[len(own) // 2] for own in opened)]


def _unseen_inside(capture: Capture, shown: np.ndarray, is_outside: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles inside of mouth and eyes that no view shows, nor any neighbor of theirs.
    Not the folds of ears, which other views show. None in a long recording whose meshes are files:
    not all of its mouths were looked for."""
    if capture.flame is None and len(capture.timesteps) > SPREAD_VIEWS:
        return np.zeros(len(shown), bool)
    touched = np.zeros(len(capture.neutral), bool)
    touched[capture.faces[shown]] = True
    may_line = ~skin_of(capture) | lining_of(capture)
    return np.asarray(may_line & ~is_outside & ~touched[capture.faces].any(1))


def _unseen_teeth(capture: Capture, pixels: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """(F,) bool: teeth that the pixels (F,) do not show well, or all where lips hide them."""
    teeth = teeth_of(capture)
    in_mouth = pixels[capture.regions.get("mouth", teeth)].sum()
    if pixels[teeth].sum() < MIN_TEETH_SHARE * in_mouth:
        return teeth
    return np.asarray(teeth & ~shown)
