"""Strands and locks of hair where no view shows the hair: without them, it looks like a helmet."""

from dataclasses import replace
from functools import cache, cached_property

import numpy as np

from ...avatar.embedding import face_areas, face_frames, points_to_world, to_local, to_world
from ...avatar.lattice import NORMAL_AXIS, lattice_splats
from ...avatar.splats import Splats, joined
from ...capture.mesh_geometry import vertex_normals
from ...flame.quaternions import from_matrices, unit
from .frames import SKIN_DEPTH, FrameStore
from .hanging_hair import hanging_hair
from .semantic_regions import HeadCoordinates

STRAND_COSINE = -0.3
"""Largest cosine of the angle between a triangle and the camera that it faces most for which
strands are added: longer than the layer's splats, they would stand out in outlines."""
STRANDS = 10000
"""Strands that a whole scalp would have."""
STRAND_FRACTION = 1.35
"""Product of a strand's standard deviations along and across its direction, as a fraction of its
part of the surface: strands hide what is below."""
STRAND_SHAPE = (2.6, 0.38, 0.13)
"""Standard deviations along, across and normal to a strand, as multiples of that product's root."""
SMOOTHING_STEPS = 10
"""Averages over neighbors of the height of hair, which changes from triangle to triangle."""
MIN_RISE = 0.3
"""Least cosine between hair's surface and a triangle in its slope."""
CROWN_ELEVATION_DEG = 55.0
"""Elevation of the point behind the middle of the head from which hair grows in all directions."""
LOCK_CONTRAST = 0.15
"""Standard deviation of the brightness of locks, as a fraction of it."""
LOCKS = 400
"""Locks around the head."""
LOCK_LENGTH = 0.7
"""Length over which a lock keeps its brightness, in distances of the eyes from the mouth."""


class UnseenHair:
    """Hair's outer layer where it faces away from all cameras. It is the same in every run."""

    def __init__(self, frames: FrameStore) -> None:
        self._frames = frames

    @cached_property
    def has_strands(self) -> np.ndarray:
        """(F,) bool: triangles whose layer of hair consists of strands."""
        surface = self._frames.surface
        is_hair = self._frames.sides.is_hair
        return np.asarray(surface.closed & is_hair & (surface.facing < STRAND_COSINE))

    def splats(self, sh_degree: int, opacity_logit: float) -> Splats:
        """Strands, which lie on the hair's surface in the direction of growth, and a splat under
        them on each triangle, and between them where hair hangs; without color."""
        frames = self._frames
        capture = frames.capture
        scalp = lattice_splats(
            capture.neutral, capture.faces, 0, sh_degree, opacity_logit, frames.convention
        ).rows(self.has_strands)
        if not len(scalp):
            return scalp
        scalp.xyz[:, NORMAL_AXIS[frames.convention]] = self._scalp_height[scalp.face]
        return joined([scalp, self._between_strands(scalp), self._strands(scalp)])

    def _between_strands(self, like: Splats) -> Splats:
        """A splat on each triangle whose strands hang too far from it for the scalp's to close gaps
        between them."""
        frames = self._frames
        faces = frames.capture.faces
        surface = self._surface
        moved = (surface != self._grown).any(1)
        hangs = self.has_strands & moved[faces].any(1)
        splats = lattice_splats(surface, faces, 0, like.sh_degree, 0.0, frames.convention)
        splats.opacity[:] = like.opacity[0]
        there = face_frames(surface, faces, surface, frames.convention)
        splats = splats.rows(hangs)
        return to_local(to_world(splats, there), frames.neutral, splats.face)

    def _strands(self, like: Splats) -> Splats:
        at = self._at
        faces = self._frames.capture.faces
        surface = self._surface
        rows = np.flatnonzero(self.has_strands)
        area = face_areas(surface, faces[rows])
        ends = np.round(self._count * np.cumsum(area) / area.sum()).astype(int)
        face = np.repeat(rows, np.maximum(np.diff(ends, prepend=0), 1))
        weights = np.random.default_rng(0).dirichlet(np.ones(3), len(face))[:, :, None]
        place = (surface[faces[face]] * weights).sum(1)
        normals = vertex_normals(surface, faces)
        normal = unit((normals[faces[face]] * weights).sum(1), 1e-20)
        along = growth(at, place, normal)
        axes = np.stack([along, np.cross(normal, along), normal], axis=2)
        world = replace(
            like.rows(np.zeros(len(face), int)),
            xyz=place.astype(np.float32),
            rotation=from_matrices(axes).astype(np.float32),
            log_scale=np.tile(np.log(self._strand_width * np.array(STRAND_SHAPE)), (len(face), 1)),
        )
        return to_local(world, self._frames.neutral, face)

    @cached_property
    def least_width(self) -> np.ndarray:
        """(F,) standard deviation of splats of the layer, geometric mean of both directions in it,
        in local units."""
        frames = self._frames
        if not self.has_strands.any():
            return frames.hair_layer_scale
        strand = self._strand_width / frames.unit_lengths
        return np.where(self.has_strands, strand, frames.hair_layer_scale)

    @cached_property
    def _strand_width(self) -> float:
        """Standard deviation in meters, geometric mean of along and across the growth."""
        area = face_areas(self._surface, self._frames.capture.faces[self.has_strands]).sum()
        return float(np.sqrt(STRAND_FRACTION * area / self._count))

    @property
    def _count(self) -> float:
        """How many strands there are."""
        area = self._frames.surface.areas
        scalp = self._frames.surface.kinds["scalp"]
        return float(STRANDS * area[self.has_strands].sum() / area[scalp].sum())

    def height(self, face: np.ndarray, xyz: np.ndarray) -> np.ndarray:
        """(N,) of the layer at places (N, 3) on triangles, in local units; where strands grow it is
        smooth, or the scalp's, whichever is nearer."""
        level, slope = self._planes
        height = level[face] + (slope[face] * xyz).sum(1)
        now = xyz[:, NORMAL_AXIS[self._frames.convention]]
        scalp = self._scalp_height[face]
        is_scalp = self.has_strands[face] & (abs(now - scalp) < abs(now - height))
        return np.where(is_scalp, scalp, height)

    @cached_property
    def _planes(self) -> tuple[np.ndarray, np.ndarray]:
        """The layer over each triangle, in its frame: height (F,) at the origin and its slope along
        the axes (F, 3), bounded where the surface is steep."""
        frames = self._frames
        axis = NORMAL_AXIS[frames.convention]
        rows = np.flatnonzero(self.has_strands)
        offsets = self._surface[frames.capture.faces[rows]] - frames.neutral.origin[rows][:, None]
        corners = np.einsum("nji,ncj->nci", frames.neutral.rotation[rows], offsets)
        corners /= frames.unit_lengths[rows, None, None]
        normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), 1e-20)
        level = frames.layer_height.copy()
        slope = np.zeros((len(level), 3), np.float32)
        slope[rows] = -normal / np.maximum(normal[:, axis], MIN_RISE)[:, None]
        slope[rows, axis] = 0
        level[rows] = corners[:, 0, axis] - (slope[rows] * corners[:, 0]).sum(1)
        return level, slope

    @property
    def _scalp_height(self) -> np.ndarray:
        return -SKIN_DEPTH * self._frames.units

    def shades(self, face: np.ndarray, xyz: np.ndarray) -> np.ndarray:
        """(N,) brightness of hair at places (N, 3) on triangles, relative to the typical one."""
        return lock_shades(self._at, points_to_world(xyz, self._frames.neutral, face))

    @property
    def _at(self) -> HeadCoordinates:
        at = self._frames.surface.at
        assert at is not None  # hair is known only where a head's parts are
        return at

    @cached_property
    def _surface(self) -> np.ndarray:
        """(V, 3) `_grown`, and long hair where it hangs."""
        surface = self._grown.copy()
        if self._frames.surface.has_long_hair:
            rows = np.unique(self._frames.capture.faces[self.has_strands])
            hanging = hanging_hair(self._frames.surface, self._at, surface[rows])
            surface[rows] = hanging.around(surface[rows])
        return surface

    @cached_property
    def _grown(self) -> np.ndarray:
        """(V, 3) the neutral mesh, where strands grow moved to the middle of the layer."""
        frames = self._frames
        neutral = frames.surface.neutral
        own = frames.capture.faces[self.has_strands]
        uses = np.maximum(np.bincount(own.ravel(), minlength=len(neutral)), 1)
        of_triangles = (frames.layer_height * frames.unit_lengths)[self.has_strands]
        for _ in range(SMOOTHING_STEPS):
            height = np.bincount(own.ravel(), np.repeat(of_triangles, 3), len(neutral)) / uses
            of_triangles = height[own].mean(1)
        return neutral + height[:, None] * vertex_normals(neutral, frames.capture.faces)


def growth(at: HeadCoordinates, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) in which hair grows at places (N, 3) of a surface with these normals
    (N, 3): away from the crown, which is down at the sides and behind."""
    outward = unit(places - at.middle, 1e-20)
    crown = _crown(at)
    away = (outward @ crown)[:, None] * outward - crown
    away -= (away * normals).sum(1, keepdims=True) * normals
    return unit(away, 1e-20)


def lock_shades(at: HeadCoordinates, places: np.ndarray) -> np.ndarray:
    """(N,) brightness of hair at places (N, 3), relative to the typical one. It differs from lock
    to lock and changes slowly along a lock, which reaches down from the crown."""
    crown = _crown(at)
    across = at.axes[0]
    away = places - at.middle
    turn = np.arctan2(away @ np.cross(crown, across), away @ across) / (2 * np.pi)
    distance = np.linalg.norm(away, axis=1)
    angle = np.arccos(np.clip(away @ crown / np.maximum(distance, 1e-20), -1, 1))
    place = np.stack([LOCKS * turn, distance * angle / (LOCK_LENGTH * at.unit)])
    cell = np.floor(place).astype(int)
    column, row = place - cell
    brightness = _brightness_of_locks()
    total = np.zeros(len(places))
    for right, lower in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = abs(1 - right - column) * abs(1 - lower - row)
        total += weight * brightness[(cell[0] + right) % LOCKS, (cell[1] + lower) % LOCKS]
    return np.asarray(1 + LOCK_CONTRAST * total)


@cache
def _brightness_of_locks() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((LOCKS, LOCKS))


def _crown(at: HeadCoordinates) -> np.ndarray:
    """Unit vector (3,) from the middle of the head."""
    elevation = np.radians(CROWN_ELEVATION_DEG)
    return np.asarray(np.sin(elevation) * at.axes[1] - np.cos(elevation) * at.axes[2])
