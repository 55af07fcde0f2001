"""Makes the demo's takes of a phone, `phone_takes.zip`: around.mp4, filmed around the person, who
keeps still, and talk.mp4, in which the person turns and speaks before a camera that stands still.

python -m stga_addon.development.demo.make_takes ict_facekit.npz, the file as `bundled_head.py`
describes it. Needs Blender's bpy. Cycles renders the person in a room, by whose detail structure
from motion finds the cameras.
"""

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_STORED, ZipFile, ZipInfo

import numpy as np
from numpy.random import Generator, default_rng
from tqdm import tqdm

from ...capture.camera import Camera
from ...files import read_npz, replacing
from ...flame.forward import flame_forward
from ...render.video import video_writer
from .capture import TAKES
from .make_capture import TRAIN_ACTS, Act, camera_at, frame_of_act
from .person import make_person
from .studio import Studio

WIDTH = 360
"""Width of a frame in pixels; it is upright, as a phone is held."""
HEIGHT = 480
"""Height of a frame in pixels."""
FOCAL = 1.4
"""Focal length in image widths, about that of a phone's main lens."""
SAMPLES = 8
"""Paths a pixel, before noise is removed."""
SEED = 5
"""Seed of the room, the walk and the turns of the head."""
WALK_FRAMES = 40
"""Frames of the walk around the head."""
WALK_DEG = 330.0
"""Angle that the camera goes around the head, from behind one ear over the face to the other."""
DISTANCE_M = 0.55
"""Distance of the camera from the head."""
BREATHING_M = 0.0008
"""Amplitude by which the head rises and falls during the walk."""
FRAMES_PER_SECOND = 5.0
"""Frame rate of both takes."""
STEPS = 3
"""Frames from one expression of the talk to the next."""
TURN_DEG = 22.0
"""Largest turn of the head between expressions."""
NOD_DEG = 6.0
"""Largest nod of the head between expressions."""
ROOM_M = 2.4
"""Half the length of the room's walls."""
BOXES = 70
"""Boxes at the walls, in place of furniture and pictures."""
GLOW = 0.5
"""Strength of the light that walls and boxes emit, in place of lamps."""


def main(source: Path) -> None:
    """Make both takes of the person of the ICT-FaceKit arrays in `source`."""
    person = make_person(read_npz(source))
    studio = Studio(person, SAMPLES)
    _add_room(studio, default_rng(SEED))
    names = person.model.expression_names
    with TemporaryDirectory() as name:
        folder = Path(name)
        for take, shots in (("around.mp4", list(walk())), ("talk.mp4", list(talk()))):
            with video_writer(folder / take, FRAMES_PER_SECOND) as append:
                for act, lift, camera in tqdm(shots, unit="image", desc=take):
                    mesh = flame_forward(person.model, person.shape, frame_of_act(act, names))
                    studio.pose(mesh + np.array([0, lift, 0]))
                    for image in studio.pictures([camera]):
                        append(np.asarray(image.convert("RGB")))
        with replacing(TAKES) as partial, ZipFile(partial, "w", ZIP_STORED) as archive:
            for file in sorted(folder.iterdir()):
                # Without a date, equal files give an equal zip.
                archive.writestr(ZipInfo(file.name), file.read_bytes())


def walk() -> Iterator[tuple[Act, float, Camera]]:
    """Expression, rise of the head in meters and camera of each frame around a still head."""
    rng = default_rng(SEED + 1)
    for number, azimuth in enumerate(np.linspace(-WALK_DEG / 2, WALK_DEG / 2, WALK_FRAMES)):
        elevation = 6 + 9 * np.sin(number / 6)
        shaken = rng.normal(0, 0.6, 2)
        distance = DISTANCE_M + 0.02 * np.sin(number / 5)
        camera = phone_at(azimuth + shaken[0], elevation + shaken[1], distance)
        yield Act({}), BREATHING_M * np.sin(1.3 * number), camera


def talk() -> Iterator[tuple[Act, float, Camera]]:
    """The same of a talk: expressions, and turns of the head between them."""
    rng = default_rng(SEED + 2)
    keys = [Act({})]
    for act in TRAIN_ACTS[1:]:
        turn = float(rng.uniform(-TURN_DEG, TURN_DEG)), float(rng.uniform(-NOD_DEG, NOD_DEG))
        keys += [act, Act({}, turn=turn)]
    camera = phone_at(4, 2)
    for one, other in pairwise(keys):
        for step in range(STEPS):
            yield _between(one, other, step / STEPS), 0.0, camera


def phone_at(azimuth_deg: float, elevation_deg: float, distance_m: float = DISTANCE_M) -> Camera:
    """The phone as `camera_at` places a camera."""
    return camera_at(azimuth_deg, elevation_deg, distance_m, (WIDTH, HEIGHT), FOCAL)


def _between(one: Act, other: Act, fraction: float) -> Act:
    def mixed(a: Any, b: Any) -> Any:
        return tuple(np.add(np.multiply(a, 1 - fraction), np.multiply(b, fraction)))

    names = {*one.weights, *other.weights}
    weights = {
        name: float((1 - fraction) * one.weight(name) + fraction * other.weight(name))
        for name in names
    }
    return Act(
        weights,
        mixed(one.turn, other.turn),
        mixed(one.neck, other.neck),
        mixed(one.gaze, other.gaze),
    )


def _add_room(studio: Studio, rng: Generator) -> None:
    """Add a room of papered walls with boxes of many colors at them."""
    studio.add_box(np.zeros(3), np.full(3, ROOM_M), (0.55, 0.52, 0.47))
    for _ in range(BOXES):
        place = rng.uniform(-ROOM_M, ROOM_M, 3)
        axis = rng.integers(3)
        place[axis] = ROOM_M * rng.choice([-1, 1])
        size = rng.uniform(0.08, 0.45, 3)
        size[axis] = rng.uniform(0.01, 0.3)
        studio.add_box(place, size, tuple(rng.uniform(0.05, 0.8, 3)))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
