"""Camera-space frames and strain of a posed mesh's triangles, computed on the device."""

from typing import Any

import numpy as np

from ...avatar import embedding
from ...avatar.strain import AVERAGING_ROUNDS, STRAIN_COMPONENTS, IndexLists, StrainBasis
from ...capture.camera import Camera
from .device import Device, Recording
from .layout import FRAME_STRAIN

POSE = np.dtype(
    [("rows", np.float32, (3, 4))] + [(name, np.uint32) for name in ("triangles", "strains", "area_scales", "padding")]
)
"""The uniform of pose.wgsl."""
INCLUDE = ("pose",)


class Embedding:
    """A mesh's topology and neutral form on the device, uploaded once; strains: columns of strain in its frames."""

    def __init__(
        self, device: Device, neutral: np.ndarray, faces: np.ndarray, convention: str, basis: StrainBasis | None = None
    ) -> None:
        """neutral (V, 3), faces (F, 3); convention as in `face_frames`; basis: where splats follow strain."""
        if convention not in embedding.CONVENTIONS:
            raise ValueError(f"embedding convention {convention!r} is not one of {embedding.CONVENTIONS}")
        self.strains = 0 if basis is None else STRAIN_COMPONENTS
        self._device, self._count, self._area_scales = device, len(faces), convention == "stga"
        none = np.zeros(0, np.uint32)
        rows = none if basis is None else _basis_rows(basis)
        self._neighbors = device.upload("neighbors", none if basis is None else _words(basis.neighbors))
        self._buffers = {
            "faces": device.upload("faces", faces.astype(np.uint32)),
            "neutral_area": device.upload("neutral area", _area(neutral, faces)),
            "basis": device.upload("strain basis", rows.astype(np.float32)),
            "vertex_faces": device.upload("vertex faces", none if basis is None else _words(basis.vertex_faces)),
            "tensors": device.buffer("strain tensors", 6 * len(faces) if self.strains else 0),
        }
        self._rounds = [device.buffer(f"smoothed strain {n}", len(faces) * self.strains) for n in range(2)]

    @property
    def smoothed_strain(self) -> Any:
        """`smoothed_strain` (F, 3) of the mesh whose frames were moved by it last."""
        return self._rounds[AVERAGING_ROUNDS % 2]

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

    def compose(self, work: Recording, strain_position: Any | None = None) -> Any:
        """Record the frames of the mesh that was uploaded last; returns their table.

        strain_position (F, 3, 3): the frames are moved by it as in `Avatar.frames`; needs the basis of strain.
        """
        device, groups = self._device, self._device.groups(self._count)
        buffers = {
            **self._buffers,
            "pose": device.buffer("pose", POSE.itemsize // 4, "uniform"),
            "vertices": device.buffer("vertices", 0),
            "frames": device.buffer("frames", self._count * (FRAME_STRAIN + self.strains)),
            "strain_from_rest": self._rounds[0],
        }
        work.dispatch(device.kernel("frames", "compose", INCLUDE), groups, **buffers)
        if self.strains:
            work.dispatch(device.kernel("frames", "average_strain", INCLUDE), groups, **buffers)
        if strain_position is not None:
            self._shift(work, buffers["pose"], buffers["frames"], strain_position)
        return buffers["frames"]

    def _shift(self, work: Recording, pose: Any, frames: Any, strain_position: Any) -> None:
        """Record the frames' move by strain."""
        assert self.strains
        device, groups, rounds = self._device, self._device.groups(self._count), self._rounds
        shared = {"pose": pose, "neighbors": self._neighbors, "coefficients": strain_position, "frames": frames}
        average, shift = (device.kernel("smoothed_strain", entry, INCLUDE) for entry in ("average", "shift"))
        for n in range(AVERAGING_ROUNDS):
            work.dispatch(average, groups, **shared, smoothed=rounds[n % 2], averaged=rounds[(n + 1) % 2])
        work.dispatch(
            shift, groups, **shared, smoothed=self.smoothed_strain, averaged=rounds[(AVERAGING_ROUNDS + 1) % 2]
        )


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches."""
    for entry in ("compose", "average_strain"):
        device.kernel("frames", entry, INCLUDE)
    for entry in ("average", "shift"):
        device.kernel("smoothed_strain", entry, INCLUDE)


def _area(neutral: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float32, zero only where the float64 is."""
    area = embedding.face_areas(neutral, faces)
    area[area > 0] = np.maximum(area[area > 0], np.finfo(np.float32).tiny)
    return np.asarray(area, np.float32)


def _basis_rows(basis: StrainBasis) -> np.ndarray:
    """(F, 21 + 8·S): a triangle's numbers side by side."""
    parts = basis.gram, basis.to_tensor, basis.to_plane, basis.range
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _words(lists: IndexLists) -> np.ndarray:
    """Where each list begins in this same array, and the last one ends; then the lists."""
    return np.asarray(np.concatenate([lists.indptr + len(lists.indptr), lists.indices]), np.uint32)
