"""A person who is known from another take, and whose avatar there is."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..capture.camera import Camera
from ..capture.model import evenly_spread
from . import landmark_bias
from .face_networks import FaceNetworks
from .fit import ROUNDS, HeadFit, RecordedTake, fit_head, posed_mesh
from .posed_points import PosedPoints, face_size, split
from .stages import Crew, Stage

BIAS_ROUNDS = 3
"""Rounds in which the networks' bias is measured, each on heads fitted without that of the round
before."""
BIAS_TIMESTEPS = 12
"""Timesteps at which the avatar is drawn to measure it."""


@dataclass(frozen=True)
class KnownPerson:
    """Whom an avatar shows.

    fit     the head, without a take's parameters
    draw    the avatar on a mesh (V, 3), as a camera sees it: (H, W, 3) uint8
    camera  that recorded the person; None of several
    """

    fit: HeadFit
    draw: Callable[[np.ndarray, Camera], np.ndarray]
    camera: Camera | None


def without_own_bias(take: RecordedTake, person: KnownPerson, crew: Crew) -> RecordedTake:
    """The take, each camera's landmarks corrected by the networks' bias: how far, in the median,
    they are off in pictures of the avatar, drawn with fitted heads as the camera sees them.

    From an unusual direction they are off by the same in pictures of the person, whatever the
    light.
    """
    networks = FaceNetworks()
    model = person.fit.head.model
    neutral = take.places.on(model.v_template, model.faces)
    corrected = take
    some = evenly_spread(sorted(take.landmarks), BIAS_TIMESTEPS)
    for _ in range(BIAS_ROUNDS):
        part = replace(corrected, landmarks={t: corrected.landmarks[t] for t in some})
        work = fit_head, (person.fit.head, part)
        fit: HeadFit = crew.helpers.run(*work, lambda steps: crew.report(Stage.FIT, 0, ROUNDS))
        points = PosedPoints(fit.head.model, take.places)
        shares: dict[str, list[np.ndarray]] = {}
        for timestep, values in fit.parameters.items():
            own = take.landmarks[timestep]
            mesh = posed_mesh(fit, values)
            head = points.positions(*split(values))
            cameras = map(fit.to_capture.camera, own.cameras)
            for name, camera in zip(own.names, cameras, strict=True):
                faces = networks.detect(person.draw(mesh, camera))
                if len(faces) == 1:
                    found = landmark_bias.without_bias(faces[0], camera, neutral, take.reliable)
                    away = found - camera.project(head)[0]
                    shares.setdefault(name, []).append(away / face_size(faces[0]))
        bias = {name: np.median(found, axis=0) for name, found in shares.items()}
        moved = {}
        for timestep, own in take.landmarks.items():
            seen = zip(own.names, own.points, strict=True)
            at = [pixels - bias.get(name, 0.0) * face_size(pixels) for name, pixels in seen]
            moved[timestep] = replace(own, points=np.stack(at))
        corrected = replace(take, landmarks=moved)
    return corrected
