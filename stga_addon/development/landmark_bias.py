"""Makes `tracking/networks/landmark_bias.npz`: how far the networks' landmarks lie from those of
the bundled head, in pictures of it from many directions and a few distances.

python -m stga_addon.development.landmark_bias
"""

import math
from dataclasses import replace

import numpy as np

from ..capture.camera import Camera, look_at
from ..files import write_npz
from ..flame.forward import flame_forward, neutral_frame
from ..flame.model import FlameModel
from ..flame.parts import flame_model
from ..tracking.correspondence import head_colors, shaded_image
from ..tracking.face_networks import FIRST_IRIS_POINT, FaceNetworks
from ..tracking.landmark_bias import BIAS_FILE, TABLE_DISTANCE_M
from ..tracking.landmarks import read_places
from ..tracking.recorded import BUNDLED_PLACES

AZIMUTHS_DEG = tuple(range(-60, 61, 15))
"""Azimuths of the cameras; 0 is straight ahead."""
ELEVATIONS_DEG = tuple(range(-45, 46, 15))
"""Elevations of the cameras; 0 is at the face's height."""
PICTURE_SIZE_PX = 512
"""Edge of the square pictures."""
NEAR_DISTANCES_M = (0.35, 0.6)
"""Distances of the cameras from the face's center besides TABLE_DISTANCE_M."""
FACE_HEIGHT_M = 0.2
"""Height of a typical face, from which the focal length follows."""
FACE_RATIO = 0.42
"""Height of the face as a fraction of the picture's."""

PEOPLE = 5
"""Heads that are rendered: the neutral one, the others of random identities and expressions."""
IDENTITY_COMPONENTS = 30
IDENTITY_SIGMA = 0.8
EXPRESSION_SHAPES = 4
EXPRESSION_WEIGHT = 0.4
SEED = 0


def main() -> None:
    """Write the file."""
    offset = _offsets(TABLE_DISTANCE_M)
    nearness = np.array([1 / distance - 1 / TABLE_DISTANCE_M for distance in NEAR_DISTANCES_M])
    grown = np.stack([_offsets(distance) for distance in NEAR_DISTANCES_M]) - offset
    write_npz(
        BIAS_FILE,
        {
            "azimuth_deg": np.array(AZIMUTHS_DEG, np.float32),
            "elevation_deg": np.array(ELEVATIONS_DEG, np.float32),
            "offset_m": offset.astype(np.float16),
            # by least squares
            "nearness_m2": (np.tensordot(nearness, grown, 1) / (nearness @ nearness)).astype(
                np.float16
            ),
        },
        compressed=True,
    )


def _offsets(distance: float) -> np.ndarray:
    """Offsets (A, E, N, 2) of landmarks in meters, from cameras at this distance in meters."""
    model = flame_model(None)
    places, reliable = read_places(BUNDLED_PLACES, len(model.faces))
    detector = FaceNetworks()
    colors = head_colors(model)
    generator = np.random.default_rng(SEED)
    shape = len(AZIMUTHS_DEG), len(ELEVATIONS_DEG), len(places), 2
    found = np.full((PEOPLE, *shape), np.nan)
    for person in range(PEOPLE):
        mesh = _person(model, generator, is_neutral=person == 0)
        at = places.on(mesh, model.faces)
        center = at[reliable].mean(0)
        for row, azimuth in enumerate(AZIMUTHS_DEG):
            for column, elevation in enumerate(ELEVATIONS_DEG):
                camera = _camera(center, azimuth, elevation, distance)
                faces = detector.detect(shaded_image(mesh, model.faces, camera, colors))
                if faces:
                    missed = faces[0] - camera.project(at)[0]
                    found[person, row, column] = missed * distance / camera.fl_x
    offset = _filled(found)
    offset[:, :, FIRST_IRIS_POINT:] = 0  # gaze is found from them, and lids hide their eyeballs
    return offset


def _person(model: FlameModel, generator: np.random.Generator, is_neutral: bool) -> np.ndarray:
    """Vertices (V, 3) of the neutral head, or of a random identity and expression."""
    identity = np.zeros(model.n_identity)
    weights = np.zeros(model.n_expression)
    if not is_neutral:
        identity[:IDENTITY_COMPONENTS] = generator.normal(0, IDENTITY_SIGMA, IDENTITY_COMPONENTS)
        chosen = generator.choice(len(model.expression_names), EXPRESSION_SHAPES, replace=False)
        moves = [not model.expression_names[number].startswith("eyeLook") for number in chosen]
        weights[chosen[moves]] = EXPRESSION_WEIGHT
    return flame_forward(model, identity, replace(neutral_frame(model), expr=weights))


def _camera(
    center: np.ndarray, azimuth_deg: float, elevation_deg: float, distance: float
) -> Camera:
    turn = math.radians(azimuth_deg)
    rise = math.radians(elevation_deg)
    across = math.cos(rise)
    direction = np.array([math.sin(turn) * across, math.sin(rise), math.cos(turn) * across])
    focal = distance * FACE_RATIO * PICTURE_SIZE_PX / FACE_HEIGHT_M
    eye = center + distance * direction
    return look_at(eye.tolist(), center.tolist(), PICTURE_SIZE_PX, PICTURE_SIZE_PX, focal)


def _filled(found: np.ndarray) -> np.ndarray:
    """Means (A, E, N, 2) over the people; a direction without a face in anyone's pictures has that
    of the next ones towards the front."""
    measured = ~np.isnan(found)
    mean = np.where(measured, found, 0).sum(0) / np.maximum(measured.sum(0), 1)
    known = measured.any(axis=(0, 3, 4))
    middle = len(AZIMUTHS_DEG) // 2, len(ELEVATIONS_DEG) // 2
    cells = [(row, column) for row in range(known.shape[0]) for column in range(known.shape[1])]
    for row, column in sorted(
        cells, key=lambda cell: abs(cell[0] - middle[0]) + abs(cell[1] - middle[1])
    ):
        if not known[row, column]:
            inner_row = row - int(np.sign(row - middle[0]))
            inner_column = column - int(np.sign(column - middle[1]))
            mean[row, column] = (mean[inner_row, column] + mean[row, inner_column]) / 2
    return mean


if __name__ == "__main__":
    main()
