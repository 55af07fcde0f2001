"""Cache of meshes and face frames by timestep; limits in their units (STGA, training)."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...avatar.embedding import MIN_DIVISOR, FaceFrames, face_frames
from ...avatar.lattice import SCALE
from ...avatar.offsets import COLOR, SIGNALS, DrivenOffset
from ...avatar.strain import strain_basis, trained_range
from ...capture.model import Capture
from ...capture.visual_hull import voxel_size
from ...raster.cpu.rasterize import moved_frames
from ..settings import TrainingSettings
from .occlusion_layer import OcclusionLayer, occlusion_layer
from .surface import Surface
from .unseen_sides import UnseenSides, unseen_sides

CACHE_BYTES = 256e6
"""Memory for the frames of timesteps: posing a mesh anew takes a seventh of an iteration."""
BYTES_PER_TRIANGLE = 170
"""Memory of a triangle's frame, deformation, signals and corners in a timestep."""

UNSEEN_LIMIT_FRACTION = 0.35
"""Fraction of the scale limit that remains on triangles that face away from all cameras: a large
splat that serves an outline floats in the air for other cameras."""
BORDER_LIMIT_FRACTION = 0.2
"""Fraction of the scale limit that remains where the mesh ends."""
BORDER_DISTANCE_FRACTION = 0.6
"""Fraction of the distance limit that remains where the mesh ends."""
LAYER_HEIGHT_FRACTION = 0.8
"""Height of the middle of hair's outer layer as a fraction of the height of hair, before half of
its thickness is taken off."""
LAYER_VOXELS = 0.5
"""Subtracted from that height: half of the layer's thickness."""
SKIN_DEPTH = 0.1
"""Depth of the layer on skin, in the triangles' units, so that it does not stand out."""
HEAD_RADIUS_VOXELS = 22.5
"""Radius of the head, by which hair's height is divided: hair's outer layer is wider than the scalp
by that ratio."""


@dataclass
class _Timestep:
    mesh: np.ndarray
    frames: FaceFrames | None = None
    signals: dict[str, np.ndarray] = field(default_factory=dict)


class FrameStore:
    """Meshes (V, 3) and face frames by timestep, float64; those of the latest CACHE_BYTES are kept.

    strain    `strain_basis` of the neutral mesh, None if nothing depends on strain
    neutral   face frames of the neutral mesh
    units     (F,) float32: the length that a triangle's limits are multiples of, in local units
    unit_lengths  (F,) meters of the neutral mesh that are a triangle's local unit
    voxel     meters between visual-hull points
    surface   what training views show of the triangles
    """

    def __init__(
        self,
        capture: Capture,
        convention: str,
        strain: bool = False,
        moved_mesh: Callable[[int], np.ndarray | None] = lambda timestep: None,
        limits: np.ndarray | None = None,
    ) -> None:
        """moved_mesh: (V, 3) of a timestep in place of the capture's, which may change, None where
        it is the capture's; limits (F, 2, 6): lowest and highest deformation that is followed;
        None: TRAINED_RANGE."""
        self.capture = capture
        self.convention = convention
        self._moved_mesh = moved_mesh
        self.surface = Surface(capture)
        limits = trained_range(len(capture.faces)) if limits is None else limits
        self.strain = strain_basis(capture.neutral, capture.faces, limits) if strain else None
        areas = self.surface.areas
        self.units = np.ones(len(capture.faces), np.float32)
        if convention != "gaussian_avatars":
            self.units = np.asarray(np.sqrt(2 * areas), np.float32)
        neutral = capture.neutral
        self.neutral = face_frames(neutral, capture.faces, neutral, convention, neutral_areas=areas)
        self.unit_lengths = np.maximum(self.neutral.scale, MIN_DIVISOR)
        self.voxel = voxel_size(neutral)
        self._most = int(CACHE_BYTES / BYTES_PER_TRIANGLE / len(capture.faces))
        self._cached: dict[int, _Timestep] = {}

    def scale_limits(self, settings: TrainingSettings) -> np.ndarray:
        """Largest scale (2, F) float32 of bound and of unbound splats, in local units."""
        unbound = settings.unbound_scale_limit * self.voxel / self.unit_lengths
        limits = np.stack([settings.scale_limit * self.units, unbound])
        limits *= 1 - (1 - UNSEEN_LIMIT_FRACTION) * self.surface.turned_away
        limits[0, self.surface.border] *= (
            BORDER_LIMIT_FRACTION  # a torso's unbound splats follow it
        )
        limits[0] = np.maximum(limits[0], self.hair_layer_scale)
        return np.asarray(limits, np.float32)

    def outlier_limits(self, settings: TrainingSettings) -> np.ndarray:
        """How far (F,) float32 bound splats may lie from the middle of their triangle, in local
        units: on the scalp as far as hair reaches."""
        fraction = np.where(self.surface.border, BORDER_DISTANCE_FRACTION, 1.0)
        hair = self.surface.hair_height / self.unit_lengths
        return np.asarray(settings.stray_limit * self.units * fraction + hair, np.float32)

    @cached_property
    def sides(self) -> UnseenSides:
        return unseen_sides(self.surface)

    @cached_property
    def occlusion_layer(self) -> OcclusionLayer:
        return occlusion_layer(self.surface, self.sides)

    @cached_property
    def layer_height(self) -> np.ndarray:
        """(F,) of the middle of hair's outer layer over each triangle, just below the surface on
        skin, in local units."""
        inner = LAYER_HEIGHT_FRACTION * self.surface.hair_height - LAYER_VOXELS * self.voxel
        skin = -SKIN_DEPTH * self.units
        return np.asarray(np.where(inner > 0, inner / self.unit_lengths, skin), np.float32)

    @cached_property
    def hair_layer_scale(self) -> np.ndarray:
        """(F,) scale of hair's outer layer on hidden triangles, in local units; 0 elsewhere. A
        smaller one would leave gaps that show the head's inside."""
        is_hair = self.surface.hidden & (self.surface.hair_height > 0)
        return np.asarray(np.where(is_hair, SCALE * self.units * self.hair_widening, 0))

    @cached_property
    def hair_widening(self) -> np.ndarray:
        """(F,) ratio of the width of hair's outer layer to the scalp's; 1 elsewhere."""
        return np.asarray(1 + self.surface.hair_height / (HEAD_RADIUS_VOXELS * self.voxel))

    def of(self, timestep: int) -> FaceFrames:
        entry = self._latest(timestep)
        capture = self.capture
        if entry.frames is None:
            entry.frames = face_frames(
                entry.mesh,
                capture.faces,
                capture.neutral,
                self.convention,
                self.strain,
                self.surface.areas,
            )
        return entry.frames

    def signals(self, timestep: int) -> Callable[[str], np.ndarray]:
        """Name of SIGNALS -> the signal (F, 3); only where there is a `strain` basis."""

        def signal(name: str) -> np.ndarray:
            assert self.strain is not None
            frames = self.of(timestep)
            entry = self._latest(timestep)
            if name not in entry.signals:
                # Numba compiles for arrays without gaps.
                entry.signals[name] = np.ascontiguousarray(SIGNALS[name](self.strain, frames))
            return entry.signals[name]

        return signal

    def driving(self, timestep: int) -> Callable[[DrivenOffset], np.ndarray]:
        """Driven offset -> the signal (F, 3) that trains it: `signals`, and zero where `is_trained`
        leaves a triangle out."""
        signals = self.signals(timestep)

        def signal(offset: DrivenOffset) -> np.ndarray:
            left_out = ~self.is_trained(offset)
            found = signals(offset.signal)
            return np.where(left_out[:, None], np.float32(0), found) if left_out.any() else found

        return signal

    def is_trained(self, offset: DrivenOffset) -> np.ndarray:
        """(F,) bool: triangles of which a driven offset is trained. Those of a `shut_mouth` keep
        their splats' places and sizes: its few movements would be continued to open lips, and draw
        splats across teeth."""
        if offset.target == COLOR:
            return np.ones(len(self.units), bool)
        return ~self.surface.shut_mouth

    def moved(self, timestep: int, coefficients: Mapping[str, np.ndarray]) -> FaceFrames:
        """The timestep's frames, moved and colored by the driven offsets of these coefficients."""
        return moved_frames(self.of(timestep), coefficients, self.signals(timestep))

    def mesh(self, timestep: int, read: np.ndarray | None = None) -> np.ndarray:
        """(V, 3) of the timestep's frames; read: the capture's, if it has been read already."""
        return self._latest(timestep, read).mesh

    def mesh_unless_kept(self, timestep: int) -> np.ndarray | None:
        """(V, 3) of the capture; None where the timestep's frames are kept: for another thread, so
        that none is read again."""
        return None if timestep in self._cached else np.asarray(self.capture.mesh(timestep))

    def clear(self) -> None:
        """Forget all meshes and frames, because what they are computed from has changed."""
        self._cached.clear()

    @contextmanager
    def strain_within(self, limits: np.ndarray | None) -> Iterator[None]:
        """Follow strain within other limits (F, 2, 6) for a while; None: within the same."""
        before = self.strain
        if limits is None or before is None:
            yield
            return
        self.strain = replace(before, range=limits)
        self.clear()
        try:
            yield
        finally:
            self.strain = before
            self.clear()

    def _latest(self, timestep: int, read: np.ndarray | None = None) -> _Timestep:
        entry = self._cached.pop(timestep, None)
        if entry is None:
            moved = self._moved_mesh(timestep)
            mesh = read if moved is None else moved
            entry = _Timestep(np.asarray(self.capture.mesh(timestep)) if mesh is None else mesh)
        self._cached[timestep] = entry  # dictionaries keep insertion order, so the oldest is first
        if len(self._cached) > max(1, self._most):
            del self._cached[next(iter(self._cached))]
        return entry
