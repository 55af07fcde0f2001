"""A person who is known from another take."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import Similarity
from ..capture.model import Capture, cameras_at_once, evenly_spread
from ..errors import StgaError
from ..flame.sequence import with_identity
from . import landmark_bias
from .face_networks import FaceNetworks
from .fit import ROUNDS, HeadFit, RecordedTake, fit_head, posed_mesh
from .head_model import HeadModel
from .posed_points import PosedPoints, face_size, split
from .stages import Stage, Workers

BIAS_ROUNDS = 3
"""Rounds in which the networks' bias is measured, each on heads fitted without that of the round
before."""
BIAS_TIMESTEPS = 12
"""Timesteps at which the avatar is drawn to measure it."""


@dataclass(frozen=True)
class KnownPerson:
    """The person whom a tracked capture shows.

    fit     the head, without a take's parameters
    camera  that recorded the person; None of several
    draw    the person's avatar on a mesh (V, 3), as a camera sees it: (H, W, 3) uint8; None where
            there is none
    """

    fit: HeadFit
    camera: Camera | None
    draw: Callable[[np.ndarray, Camera], np.ndarray] | None = None


def captured_person(capture: Capture, name: str = "") -> KnownPerson:
    """The person whose head a capture was tracked with. Raises StgaError, beginning with `name` or
    the folder's, where it was tracked with neither FLAME nor the bundled head."""
    sequence = capture.flame
    if sequence is None:
        where = name or capture.root
        raise StgaError(f"{where}: its head is neither FLAME nor the bundled one; expected either")
    head = HeadModel(with_identity(sequence).model, "flame")
    fit = HeadFit(head, sequence.shape, {}, Similarity(), sequence.static_offset)
    cameras = list(cameras_of(capture).values())
    return KnownPerson(fit, cameras[0] if len(cameras) == 1 else None)


def cameras_of(capture: Capture) -> dict[int, Camera]:
    """Index -> camera. Where no two cameras show one timestep, as a phone's in several takes, the
    first take's camera stands for all."""
    views = sorted(capture.all_views, key=lambda view: view.timestep)
    found = {view.camera_index: view.camera for view in views}
    if cameras_at_once(views) > 1:
        return found
    return {view.camera_index: found[view.camera_index] for view in views[:1]}


def without_measured_bias(
    take: RecordedTake, person: KnownPerson, workers: Workers
) -> RecordedTake:
    """The take, each camera's landmarks corrected by the networks' bias: how far, in the median,
    they are off in pictures of the avatar, drawn with fitted heads as the camera sees them.

    From an unusual direction they are off by the same in pictures of the person, whatever the
    light.
    """
    assert person.draw is not None
    networks = FaceNetworks()
    model = person.fit.head.model
    neutral = take.places.on(model.v_template, model.faces)
    corrected = take
    some = evenly_spread(sorted(take.landmarks), BIAS_TIMESTEPS)
    for _ in range(BIAS_ROUNDS):
        part = replace(corrected, landmarks={t: corrected.landmarks[t] for t in some})
        work = fit_head, (person.fit.head, part)
        fit: HeadFit = workers.helpers.run(
            *work, lambda steps: workers.report(Stage.FIT, 0, ROUNDS)
        )
        points = PosedPoints(fit.head.model, take.places)
        fractions: dict[str, list[np.ndarray]] = {}
        for timestep, values in fit.parameters.items():
            landmarks = take.landmarks[timestep]
            mesh = posed_mesh(fit, values)
            head = points.positions(*split(values))
            cameras = map(fit.to_capture.camera, landmarks.cameras)
            for name, camera in zip(landmarks.names, cameras, strict=True):
                faces = networks.detect(person.draw(mesh, camera))
                if len(faces) == 1:
                    found = landmark_bias.without_bias(faces[0], camera, neutral, take.reliable)
                    away = found - camera.project(head)[0]
                    fractions.setdefault(name, []).append(away / face_size(faces[0]))
        bias = {name: np.median(found, axis=0) for name, found in fractions.items()}
        moved = {}
        for timestep, landmarks in take.landmarks.items():
            detected = zip(landmarks.names, landmarks.points, strict=True)
            at = [pixels - bias.get(name, 0.0) * face_size(pixels) for name, pixels in detected]
            moved[timestep] = replace(landmarks, points=np.stack(at))
        corrected = replace(take, landmarks=moved)
    return corrected
