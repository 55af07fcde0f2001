"""Identity of a training run: digests of its capture, FLAME model and settings."""

import hashlib
import json
from dataclasses import asdict, dataclass

import numpy as np

from ...capture.model import Capture
from ...schema import to_json
from ..settings import TrainingSettings

QUANTUM = 1e-6 * 0.5**0.5
"""Cameras (meters, pixels) and meshes (meters) are compared in multiples of this: other machines
compute other last bits. It is irrational, so that neither decimals nor binary fractions lie at the
edge between two multiples."""


@dataclass(frozen=True)
class RunIdentity:
    """What a run was trained with. Digests are SHA-256.

    principal_point  convention of the capture
    summary   counts of cameras and timesteps, for messages
    images    names, sizes, splits and timesteps of the views
    cameras   their poses and intrinsics
    faces, neutral   of the mesh
    flame     content of the FLAME model file; empty without one
    settings  of training
    """

    principal_point: str
    summary: str
    images: str
    cameras: str
    faces: str
    neutral: str
    flame: str
    settings: str

    @property
    def digest(self) -> str:
        """One digest of the whole identity, which a run's other files carry."""
        return _digest(json.dumps(asdict(self)).encode())


def identity_of(capture: Capture, principal_point: str, settings: TrainingSettings) -> RunIdentity:
    """Reads neither images nor tracked meshes."""
    flame = capture.flame
    views = [(split, view) for split, members in sorted(capture.views.items()) for view in members]
    cameras = {view.camera_index for _, view in views}
    timesteps = {view.timestep for _, view in views}
    images = [
        (
            split,
            view.timestep,
            view.camera_index,
            view.name,
            view.camera.width,
            view.camera.height,
            view.mask is not None,
        )
        for split, view in views
    ]
    lenses = [view.camera for _, view in views]
    poses = np.array([lens.world_to_camera for lens in lenses], np.float64).reshape(-1, 16)
    intrinsics = [lens.intrinsics[2:] for lens in lenses]
    return RunIdentity(
        principal_point,
        f"{len(cameras)} cameras, {len(timesteps)} timesteps",
        _digest(json.dumps(images).encode()),
        _digest(_quantized(np.hstack([poses, np.reshape(intrinsics, (-1, 4))]))),
        _digest(np.ascontiguousarray(capture.faces, np.int32).tobytes()),
        _digest(_quantized(capture.neutral)),
        "" if capture.flame_file is None or flame is None else flame.model.file_digest,
        _settings_digest(settings),
    )


def difference(trained: RunIdentity, given: RunIdentity) -> str | None:
    """The first part of `given` that differs, as in "has other images"; None where none does."""
    phrases = {
        "faces": "has a mesh with other triangles",
        "images": "has other images or image sizes",
        "cameras": "has other camera poses or intrinsics",
        "neutral": "has another neutral mesh",
    }
    other = [name for name in phrases if getattr(trained, name) != getattr(given, name)]
    return phrases[other[0]] if other else None


def _settings_digest(settings: TrainingSettings) -> str:
    """A later field counts only where it is set, so that runs from before it can be resumed."""
    values = to_json(settings)
    kept = {n: v for n, v in values.items() if v or n not in TrainingSettings.LATER_FIELDS}
    return _digest(json.dumps(kept, sort_keys=True).encode())


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _quantized(values: np.ndarray) -> bytes:
    # adding zero turns −0 into 0
    return np.asarray(np.round(np.asarray(values, np.float64) / QUANTUM) + 0.0).tobytes()
