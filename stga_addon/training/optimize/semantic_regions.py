"""Which visible triangles of a head unseen ones look like: hair like hair, a neck like a neck."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from zlib import crc32

import numpy as np
from scipy.spatial import cKDTree

from ...capture.mesh_geometry import connected_parts, head_axes
from ...capture.model import Capture
from ...files import read_npz
from ...flame.model import BUNDLED_HEAD, faces_within
from ...flame.parts import flame_model, key_regions

REGIONS_FILE = BUNDLED_HEAD.with_name("head_regions.npz")
"""For each head of KNOWN_HEADS, made by `development/head_regions.py`: `NAME/region` (F,), the
`Region` of its triangles, and `NAME/checksum` of these."""
KNOWN_HEADS = ("bundled", "flame")
"""Heads whose triangles are known by their `checksum`."""
EYES_TO_MIDDLE = 1.35
"""Distance of the head's middle behind the eyes, in distances of the eyes from the mouth, the unit
of all lengths here."""
BROWS_OVER_EYES = 0.15
"""Height of the head's middle above the eyes: that of the brows."""
BROWS_LEVEL = 0.45
"""Height of the brows over the eyes."""
JAW_LEVEL = -0.5
"""Height of the jaw over the eyes."""
CHIN_LEVEL = -2.0
"""Height of the chin over the eyes."""
TORSO_HEIGHT = 2.0
"""Least extent of a torso; the end of a bust has less."""
MIN_HAIR_CONTRAST = 0.9
"""A triangle of the scalp has hair if its color is this far from the skin's, as a fraction of the
scalp's most different ones, in standard deviations of skin."""
LEAST_SHADE = 0.02
"""Least standard deviation of skin's shades, in colors of 0…1."""
NEIGHBORS = 24
"""Triangles around one over which a decision or color is smoothed, or has its median."""

DEPTHS = (0.0, 0.25, 0.45, 0.75)
"""Distances from the visible lips at which the colors of a mouth's inside are given: it gets darker
inward."""
LIP_FRACTION = 0.75
"""Brightness of the lining at the lips, as a fraction of theirs."""
GUM_FRACTIONS = np.array([[0.43, 0.24, 0.22], [0.22, 0.1, 0.09], [0.12, 0.04, 0.03]])
"""Color of gums and tongue at the later DEPTHS, as fractions of the eyes' white."""
TOOTH_DEPTHS = (0.05, 0.15, 0.5)
"""Distances from the visible lips at which the brightness of teeth is given."""
TOOTH_FRACTIONS = (0.92, 0.74, 0.23)
"""Brightness of teeth at TOOTH_DEPTHS, as fractions of the eyes' white."""
WHITE_QUANTILE = 0.8
"""Quantile of the eyeballs' brightness above which triangles are white."""
WHITE = np.array([0.75, 0.67, 0.63])
"""Color of the eyes' white in daylight, for heads without eyes."""


@dataclass(frozen=True)
class HeadCoordinates:
    """Triangles' places around the neutral head, seen from its middle at the height of the brows.

    azimuth  (F,) radians from straight ahead, positive on the left
    level    (F,) height over the eyes, in distances of the eyes from the mouth
    unit     meters from the eyes to the mouth
    eyes     (3,) their middle
    middle   (3,) of the head, at the height of the brows
    axes     (3, 3) unit vectors to the head's left, up and ahead
    """

    azimuth: np.ndarray
    level: np.ndarray
    unit: float
    eyes: np.ndarray
    middle: np.ndarray
    axes: np.ndarray

    @property
    def angle_deg(self) -> np.ndarray:
        """(F,) from straight ahead, to either side."""
        return np.asarray(np.degrees(np.abs(self.azimuth)))


def head_coordinates(capture: Capture) -> HeadCoordinates | None:
    """None for a mesh whose eyes and mouth are not known, or not apart."""
    centers = np.asarray(capture.neutral, np.float64)[capture.faces].mean(1)
    found = head_axes(centers, capture.regions)
    if found is None:
        return None
    eyes, axes, unit = found
    across, up, ahead = axes
    middle = eyes + unit * (BROWS_OVER_EYES * up - EYES_TO_MIDDLE * ahead)
    return HeadCoordinates(
        azimuth=np.arctan2((centers - middle) @ across, (centers - middle) @ ahead),
        level=(centers - eyes) @ up / unit,
        unit=unit,
        eyes=eyes,
        middle=middle,
        axes=axes,
    )


class Region(IntEnum):
    """Regions of a head's triangles, by their numbers in REGIONS_FILE."""

    OTHER = 0
    """Forehead, temples and the edge of the face; all triangles where regions are not known."""
    FACE = 1
    """What is between brows and neck, ahead of the ears, but for MOUTH."""
    MOUTH = 2
    """Lips, teeth, gums and lining; the face's inner side around them."""
    EAR = 3
    """Ears."""
    SCALP = 4
    """Where hair grows."""
    NAPE = 5
    """Back of the neck, which long hair hides; without it, part of the body."""
    BODY = 6
    """Neck and shoulders."""
    SIDE = 7
    """Cheeks in front of the ears, which long hair hides."""


@dataclass(frozen=True)
class HeadRegions:
    """Which part of a head each triangle belongs to.

    region  (F,) numbers of `Region`
    """

    region: np.ndarray

    def within(self, *regions: Region) -> np.ndarray:
        """(F,) bool: triangles of these regions."""
        return np.isin(self.region, regions)

    @property
    def face(self) -> np.ndarray:
        """(F,) bool: triangles between brows and neck, ahead of the ears."""
        return self.within(Region.FACE, Region.MOUTH)


def head_regions(capture: Capture) -> HeadRegions:
    """Regions of a capture's triangles.

    Heads of KNOWN_HEADS, of any identity, are recognized by their triangles; what is grafted onto
    them belongs to the mouth. On another mesh, each triangle has the region of the bundled head's
    nearest triangle, after both heads' eyes and mouths are laid upon each other. Where a mesh has
    no eyes or mouth, or the bundled head is missing, all regions are OTHER.
    """
    faces = capture.faces
    arrays = _arrays()
    for name in KNOWN_HEADS:
        known = arrays[f"{name}/region"]
        if checksum(faces[: len(known)]) == arrays[f"{name}/checksum"]:
            region = np.full(len(faces), Region.MOUTH, np.uint8)
            region[: len(known)] = known
            return HeadRegions(region)
    places = head_places(np.asarray(capture.neutral)[faces].mean(1), capture.regions)
    if places is None or not BUNDLED_HEAD.is_file():
        return HeadRegions(np.full(len(faces), Region.OTHER, np.uint8))
    rows = nearest_rows(_bundled_places(), places, 1)[:, 0]
    return HeadRegions(arrays["bundled/region"][rows])


def checksum(faces: np.ndarray) -> int:
    """CRC-32 of triangles (F, 3)."""
    return crc32(np.ascontiguousarray(faces, "<i4").tobytes())


def head_places(centers: np.ndarray, regions: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Triangles' centers (F, 3) from the eyes along the head's axes, in distances of the eyes from
    the mouth; None where these are not known."""
    found = head_axes(centers, regions)
    if found is None:
        return None
    eyes, axes, unit = found
    return np.asarray((centers - eyes) @ axes.T / unit)


@cache
def _arrays() -> dict[str, np.ndarray]:
    return read_npz(REGIONS_FILE)


@cache
def _bundled_places() -> np.ndarray:
    """`head_places` (F, 3) of the bundled head."""
    model = flame_model(None)
    places = head_places(model.v_template[model.faces].mean(1), key_regions(model))
    assert places is not None
    return places


def nearest_rows(known: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """Rows (N, count) of the known places (M, 3) that are nearest to each of these (N, 3), the
    nearest first; M where there are fewer."""
    _, rows = cKDTree(known).query(places, np.arange(min(count, len(known))) + 1)
    return np.asarray(rows)


def hairy_triangles(
    sources: np.ndarray, centers: np.ndarray, color: np.ndarray, skin: np.ndarray
) -> np.ndarray:
    """Triangles of a scalp whose color differs from skin by more than skin's shades (K, 3) do among
    each other; all of them where no skin is known."""
    if not len(sources) or not len(skin):
        return sources
    median = np.median(skin, axis=0)
    shades = (skin - median).T @ (skin - median) / len(skin) + LEAST_SHADE**2 * np.eye(3)
    away = color[sources] - median
    contrast = np.sqrt((away * np.linalg.solve(shades, away.T).T).sum(1))
    near = nearest_rows(centers[sources], centers[sources], NEIGHBORS)
    contrast = np.quantile(contrast[near], 0.1, axis=1)
    return np.asarray(sources[contrast > MIN_HAIR_CONTRAST * np.quantile(contrast, 0.9)])


def inside_colors(
    capture: Capture, color: np.ndarray, visible: np.ndarray, inside: np.ndarray
) -> np.ndarray:
    """Colors (M, 3) of triangles `inside` (F,) bool that no view shows and that motion of mouth or
    lids exposes: teeth, gums and lining near the mouth, in the light on the person's lips and eyes;
    the hidden part of eyeballs, as white as the visible part; elsewhere the color of the skin
    around. color, visible: of `mean_colors`."""
    faces = capture.faces
    centers = np.asarray(capture.neutral)[faces].mean(1)
    skin = skin_of(capture)
    known = np.flatnonzero(visible & skin)
    if not len(known) or not inside.any():
        return np.asarray(color[inside])
    near = nearest_rows(centers[known], centers[inside], NEIGHBORS)
    found = np.median(color[known[near]], axis=1)
    eyeballs = eyeballs_of(capture)
    white = _white_of_eyes(color[eyeballs & visible])
    found[eyeballs[inside]] = white
    at = head_coordinates(capture)
    if at is None:
        return np.asarray(found)
    mouth = capture.regions["mouth"]
    lips = mouth & skin & visible
    if not lips.any():
        return np.asarray(found)
    part = connected_parts(len(capture.neutral), faces)[faces[:, 0]]
    in_mouth = np.isin(part, part[~skin & head_regions(capture).within(Region.MOUTH)])
    within = inside & (in_mouth | lining_of(capture))
    depth = cKDTree(centers[lips]).query(centers[within])[0] / at.unit
    colors = np.vstack([LIP_FRACTION * np.median(color[lips], axis=0), GUM_FRACTIONS * white])
    inner = np.stack([np.interp(depth, DEPTHS, channel) for channel in colors.T], axis=1)
    teeth = teeth_of(capture)[within]
    inner[teeth] = np.interp(depth[teeth], TOOTH_DEPTHS, TOOTH_FRACTIONS)[:, None] * white
    found[within[inside]] = inner
    return np.asarray(found)


def _white_of_eyes(colors: np.ndarray) -> np.ndarray:
    """(3,) of the colors (M, 3) of those triangles of eyeballs that views show."""
    if not len(colors):
        return WHITE
    bright = colors[np.argsort(colors.sum(1))]
    return np.asarray(bright[int(WHITE_QUANTILE * len(bright)) :].mean(0))


def skin_of(capture: Capture) -> np.ndarray:
    """(F,) bool: the largest connected part of the mesh."""
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    return np.asarray(part == np.bincount(part).argmax())


def lining_of(capture: Capture) -> np.ndarray:
    """(F,) bool: skin that may line the mouth; none where the mouth is not known."""
    return np.asarray(skin_of(capture) & head_regions(capture).within(Region.MOUTH))


def teeth_of(capture: Capture) -> np.ndarray:
    """(F,) bool: teeth, where the head model marks them."""
    return _in_masks(capture, ("teeth",))


def eyeballs_of(capture: Capture) -> np.ndarray:
    """(F,) bool: eyeballs, where the head model marks them."""
    return _in_masks(capture, ("left_eyeball", "right_eyeball"))


def _in_masks(capture: Capture, names: Collection[str]) -> np.ndarray:
    masks = {} if capture.flame is None else capture.flame.model.masks
    found = np.zeros(len(capture.faces), bool)
    for name in masks.keys() & set(names):
        found |= faces_within(capture.faces, masks[name])
    return found
