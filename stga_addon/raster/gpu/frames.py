"""Camera-space frames and strain of a posed mesh's triangles, computed on the device, moved by
driven offsets."""

from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import numpy as np

from ...avatar import embedding
from ...avatar.offsets import OFFSETS
from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, StrainBasis
from ...capture.camera import Camera
from .device import Device, Recording
from .layout import FRAME_STRAIN, list_words


class SmoothedStrain:
    """Computes the signal of a driven offset of one mesh, whose neighborhood is uploaded once;
    kernels: what it dispatches."""

    kernels: ClassVar[tuple[str, ...]] = ("frames.smooth_strain",)

    def __init__(self, device: Device, basis: StrainBasis) -> None:
        self._count = len(basis.faces)
        self._neighbors = device.upload("neighbors", list_words(basis.neighbors))
        self._rounds = [
            device.buffer(f"smoothed strain {n}", self._count * STRAIN_COMPONENTS) for n in range(2)
        ]

    def record(self, work: Recording, strain_from_rest: Any) -> Any:
        """Record the signal of the uploaded pose, whose strain (F, 3), less that at rest, is given;
        returns its table (F, 3)."""
        averaged = strain_from_rest
        for n in range(AVERAGING_ROUNDS):
            smoothed, averaged = averaged, self._rounds[n % 2]
            tables = {"neighbors": self._neighbors, "smoothed": smoothed, "averaged": averaged}
            work.dispatch(self.kernels[0], self._count, tables)
        return averaged


SIGNALS = {"strain_position": SmoothedStrain}
"""Driven offset -> what computes its signal; those without are trained on the CPU only."""


class Embedding:
    """A mesh's topology and neutral form on the device, uploaded once.

    strains  columns of strain in its frames
    signals  name of a driven offset -> its signal (F, S) of the mesh whose frames were composed
             last
    """

    def __init__(
        self, device: Device, neutral: np.ndarray, faces: np.ndarray, convention: str,
        basis: StrainBasis | None = None, offsets: Collection[str] = (),
    ) -> None:  # fmt: skip
        """neutral (V, 3), faces (F, 3); convention as in `face_frames`; basis: where splats follow
        strain; offsets: the driven offsets that they follow, which need the basis."""
        if convention not in embedding.CONVENTIONS:
            known = embedding.CONVENTIONS
            raise ValueError(f"embedding convention {convention!r} is not one of {known}")
        self.strains = 0 if basis is None else STRAIN_COMPONENTS
        self._device, self._count, self._area_scales = device, len(faces), convention == "stga"
        area = embedding.face_areas(neutral, faces)
        # zero only where the float64 is
        area[area > 0] = np.maximum(area[area > 0], np.finfo(np.float32).tiny)
        rows, touching = np.zeros(0, np.float32), np.zeros(0, np.uint32)
        if basis is not None:
            parts = basis.gram, basis.to_tensor, basis.to_plane, basis.range
            flat = [part.reshape(len(faces), -1) for part in parts]
            rows = np.concatenate(flat, axis=1, dtype=np.float32)
            touching = list_words(basis.vertex_faces)
        self._tables = {
            "faces": device.upload("faces", faces.astype(np.uint32)),
            "neutral_area": device.upload("neutral_area", area.astype(np.float32)),
            "basis": device.upload("basis", rows),
            "vertex_faces": device.upload("vertex_faces", touching),
            "tensors": device.buffer("tensors", 6 * len(faces) if self.strains else 0),
            "strain_from_rest": device.buffer("strain_from_rest", len(faces) * self.strains),
        }
        assert basis is not None or not offsets
        self._signals = {
            name: SIGNALS[name](device, basis) for name in offsets if basis is not None
        }
        self.signals: dict[str, Any] = {}

    def upload(self, vertices: np.ndarray, camera: Camera) -> None:
        """Send a posed mesh (V, 3), world meters, and its camera before the recording is submitted.

        Shaders have no float64: a position becomes the float32 of its distance to the first vertex
        and the rest.
        """
        center = vertices[0] if len(vertices) else np.zeros(3)
        local = vertices - center
        parts = np.empty((len(vertices), 6), np.float32)
        parts[:, :3] = local
        parts[:, 3:] = local - parts[:, :3]
        self._device.upload("vertices", parts)
        turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        self._device.uniform(
            "Pose", rows=np.c_[turn, turn @ center + shift], triangles=self._count,
            strains=self.strains, area_scales=self._area_scales,
        )  # fmt: skip

    def compose(self, work: Recording, coefficients: Mapping[str, Any]) -> Any:
        """Record the frames of the mesh that was uploaded last; returns their table.

        coefficients: driven offset -> table (F, S, 3): the frames are moved by them as in
        `Avatar.frames`.
        """
        tables, words = self._tables, self._count * (FRAME_STRAIN + self.strains)
        frames = tables["frames"] = self._device.buffer("frames", words)
        work.dispatch("frames.compose", self._count, tables)
        if self.strains:
            work.dispatch("frames.average_strain", self._count, tables)
        strain = tables["strain_from_rest"]
        self.signals = {name: signal.record(work, strain) for name, signal in self._signals.items()}
        for name, table in coefficients.items():
            moving = {**tables, "coefficients": table, "driving": self.signals[name]}
            work.dispatch("frames.shift", self._count, moving, SIGNALS=OFFSETS[name].signals)
        return frames
