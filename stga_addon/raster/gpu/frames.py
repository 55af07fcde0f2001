"""Camera-space frames and deformation of a posed mesh's triangles, computed on the device, moved by
driven offsets."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...avatar.embedding import CONVENTIONS
from ...avatar.offsets import OFFSETS
from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, StrainBasis
from ...capture.camera import Camera
from .device import Device, Recording
from .layout import FRAME_STRIDE, list_words

SIGNALS = "smoothed_strain", "normal"
"""Those of `avatar.offsets.SIGNALS` that are computed on the device."""


class Embedding:
    """A mesh's topology and neutral form on the device, uploaded once.

    signals  by name of `avatar.offsets.SIGNALS`: (F, 3) of the mesh whose frames were composed last
    """

    def __init__(
        self,
        device: Device,
        areas: np.ndarray,
        faces: np.ndarray,
        convention: str,
        basis: StrainBasis | None = None,
    ) -> None:
        """areas (F,) of the neutral mesh; faces (F, 3); convention as in `face_frames`; basis:
        where splats follow the deformation."""
        if convention not in CONVENTIONS:
            raise ValueError(f"embedding convention {convention!r} is not one of {CONVENTIONS}")
        self._follows = basis is not None
        self._device = device
        self._count = len(faces)
        self._area_scales = convention == "stga"
        # zero only where the float64 is
        areas = np.where(areas > 0, np.maximum(areas, np.finfo(np.float32).tiny), areas)
        rows = np.zeros(0, np.float32)
        touching = np.zeros(0, np.uint32)
        if basis is not None:
            parts = basis.gram, basis.to_tensor, basis.to_plane, basis.normal.T, basis.range
            flat = [part.reshape(len(faces), -1) for part in parts]
            rows = np.concatenate(flat, axis=1, dtype=np.float32)
            touching = list_words(basis.vertex_faces)
            device.upload("neighbors", list_words(basis.neighbors))
        self._tables = {
            "faces": device.upload("faces", faces.astype(np.uint32)),
            "neutral_area": device.upload("neutral_area", areas.astype(np.float32)),
            "basis": device.upload("basis", rows),
            "vertex_faces": device.upload("vertex_faces", touching),
            "tensors": device.buffer("tensors", len(rows) and 6 * len(faces)),
            "strain_from_rest": device.buffer("strain_from_rest", len(rows) and 3 * len(faces)),
            "normal_change": device.buffer("normal_change", len(rows) and 3 * len(faces)),
        }
        self.signals: dict[str, Any] = {}
        self._uploaded: np.ndarray | None = None

    def upload(self, vertices: np.ndarray, camera: Camera) -> None:
        """Send a posed mesh (V, 3), world meters, and its camera before the recording is submitted.
        An array that is there from before is not sent again.

        Shaders have no float64: a position becomes the float32 of its distance to the first vertex
        and the rest.
        """
        center = vertices[0] if len(vertices) else np.zeros(3)
        if vertices is not self._uploaded:
            local = vertices - center
            parts = np.empty((len(vertices), 6), np.float32)
            parts[:, :3] = local
            parts[:, 3:] = local - parts[:, :3]
            self._device.upload("vertices", parts)
            self._uploaded = vertices
        self._device.uniform(
            "Pose",
            rows=np.c_[camera.rotation, camera.rotation @ center + camera.translation],
            triangles=self._count,
            follows=self._follows,
            area_scales=self._area_scales,
        )

    def compose(self, work: Recording, coefficients: Mapping[str, Any]) -> Any:
        """Record the frames of the mesh that was uploaded last; returns their table.

        coefficients: driven offset -> table (F, 3, 3): the frames are changed by them as in
        `Avatar.frames`.
        """
        tables = self._tables
        frames = tables["frames"] = self._device.buffer("frames", self._count * FRAME_STRIDE)
        work.dispatch("frames.compose", self._count, tables)
        if self._follows:
            work.dispatch("frames.average_strain", self._count, tables)
            strain = tables["strain_from_rest"]
            for n in range(AVERAGING_ROUNDS):
                words = self._count * STRAIN_COMPONENTS
                averaged = self._device.buffer(f"smoothed strain {n % 2}", words)
                given = {"smoothed": strain, "averaged": averaged}
                work.dispatch("frames.smooth_strain", self._count, given)
                strain = averaged
            found = strain, tables["normal_change"]
            self.signals = dict(zip(SIGNALS, found, strict=True))
        for name in sorted(coefficients, key=list(OFFSETS).index):  # scale after position
            driving = self.signals[OFFSETS[name].signal]
            given = {**tables, "coefficients": coefficients[name], "driving": driving}
            work.dispatch(f"frames.move_{OFFSETS[name].target}", self._count, given)
        return frames
