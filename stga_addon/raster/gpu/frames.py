"""Camera-space frames and strain of a posed mesh's triangles, computed on the device."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ...avatar import embedding
from ...avatar.strain import STRAIN_COMPONENTS, StrainBasis
from ...capture.camera import Camera
from . import driven_offsets
from .device import Device, Recording
from .layout import FRAME_STRAIN, list_words

POSE = np.dtype(
    [("rows", np.float32, (3, 4))] + [(name, np.uint32) for name in ("triangles", "strains", "area_scales", "padding")]
)
"""The uniform of pose.wgsl."""
INCLUDE = ("pose",)


class Embedding:
    """A mesh's topology and neutral form on the device, uploaded once.

    strains  columns of strain in its frames
    signals  name of a driven offset -> its signal (F, S) of the mesh whose frames were composed last
    """

    def __init__(
        self, device: Device, neutral: np.ndarray, faces: np.ndarray, convention: str,
        basis: StrainBasis | None = None, offsets: Collection[str] = (),
    ) -> None:  # fmt: skip
        """neutral (V, 3), faces (F, 3); convention as in `face_frames`; basis: where splats follow strain; offsets: the
        driven offsets that they follow, which need the basis."""
        if convention not in embedding.CONVENTIONS:
            raise ValueError(f"embedding convention {convention!r} is not one of {embedding.CONVENTIONS}")
        self.strains = 0 if basis is None else STRAIN_COMPONENTS
        self._device, self._count, self._area_scales = device, len(faces), convention == "stga"
        none = np.zeros(0, np.uint32)
        rows = none if basis is None else _basis_rows(basis)
        self._buffers = {
            "faces": device.upload("faces", faces.astype(np.uint32)),
            "neutral_area": device.upload("neutral area", _area(neutral, faces)),
            "basis": device.upload("strain basis", rows.astype(np.float32)),
            "vertex_faces": device.upload("vertex faces", none if basis is None else list_words(basis.vertex_faces)),
            "tensors": device.buffer("strain tensors", 6 * len(faces) if self.strains else 0),
        }
        self._strain_from_rest = device.buffer("strain from rest", len(faces) * self.strains)
        assert basis is not None or not offsets
        self._signals = {name: driven_offsets.SIGNALS[name](device, basis) for name in offsets if basis is not None}
        self.signals: dict[str, Any] = {}

    def upload(self, vertices: np.ndarray, camera: Camera) -> None:
        """Send a posed mesh (V, 3), world meters, and its camera before the recording is submitted.

        Shaders have no float64: a position becomes the float32 of its distance to the first vertex and the rest.
        """
        center = vertices[0] if len(vertices) else np.zeros(3)
        local = vertices - center
        parts = np.empty((len(vertices), 6), np.float32)
        parts[:, :3] = local
        parts[:, 3:] = local - parts[:, :3]
        self._device.upload("vertices", parts)
        pose = np.zeros(1, POSE)
        turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        pose["rows"] = np.c_[turn, turn @ center + shift]
        pose["triangles"], pose["strains"], pose["area_scales"] = self._count, self.strains, self._area_scales
        self._device.upload("pose", pose, "uniform")

    def compose(self, work: Recording, coefficients: Mapping[str, Any]) -> Any:
        """Record the frames of the mesh that was uploaded last; returns their table.

        coefficients: driven offset -> table (F, S, 3): the frames are moved by them as in `Avatar.frames`.
        """
        device, groups = self._device, self._device.groups(self._count)
        buffers = {
            **self._buffers,
            "pose": device.buffer("pose", POSE.itemsize // 4, "uniform"),
            "vertices": device.buffer("vertices", 0),
            "frames": device.buffer("frames", self._count * (FRAME_STRAIN + self.strains)),
            "strain_from_rest": self._strain_from_rest,
        }
        work.dispatch(device.kernel("frames", "compose", INCLUDE), groups, **buffers)
        if self.strains:
            work.dispatch(device.kernel("frames", "average_strain", INCLUDE), groups, **buffers)
        pose, frames, strain = buffers["pose"], buffers["frames"], self._strain_from_rest
        self.signals = {name: signal.record(work, pose, strain) for name, signal in self._signals.items()}
        driven_offsets.shift(work, self._count, coefficients, self.signals, pose, frames)
        return frames


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    for entry in ("compose", "average_strain"):
        device.kernel("frames", entry, INCLUDE)


def _area(neutral: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float32, zero only where the float64 is."""
    area = embedding.face_areas(neutral, faces)
    area[area > 0] = np.maximum(area[area > 0], np.finfo(np.float32).tiny)
    return np.asarray(area, np.float32)


def _basis_rows(basis: StrainBasis) -> np.ndarray:
    """(F, 21 + 8·S): a triangle's numbers side by side."""
    parts = basis.gram, basis.to_tensor, basis.to_plane, basis.range
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
