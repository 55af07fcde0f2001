"""Makes the demo's capture, `head_capture.zip`: a person of the bundled head model, path-traced by
Cycles.

python -m stga_addon.development.demo.make_capture ict_facekit.npz [FOLDER], the file as
`bundled_head.py` describes it; with FOLDER, instead a capture there by one camera, before which the
head turns. Needs Blender's bpy. The pictures show more than the bundled head has: twice as many
vertices, hair, lashes, pores.
"""

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from tqdm import tqdm

from ...capture.camera import Camera, look_at
from ...capture.open import BUNDLED_MODEL, CANONICAL_NAME, PARAMETERS
from ...capture.transforms import camera_entry
from ...files import read_npz, replacing, write_json, write_npz
from ...flame.forward import FlameFrame, flame_forward, neutral_frame
from ...flame.model import BUNDLED_HEAD
from ...tracking.folder import SPLIT_FILES, image_name
from ...tracking.write_capture import moving_arrays
from .capture import CAPTURE
from .person import Person, make_person
from .studio import Studio

CAMERAS = 9
"""Cameras on an arc in front of the head."""
HELD_OUT = 4
"""Index of the camera of `val`: the middle one."""
TURNING_ACTS = 40
"""Timesteps of the capture of one camera, before which the head turns."""
TURN_DEG = 50.0
"""Largest turn of the head before one camera, to both sides."""
NOD_DEG = 12.0
"""Largest nod of the head before one camera, up and down."""
WIDTH = 320
"""Width of the pictures in pixels."""
HEIGHT = 400
"""Height of the pictures in pixels."""

FOCAL = 3.7
"""Focal length in image widths."""
ARC_DEG = 70.0
ELEVATIONS_DEG = (8.0, -9.0)
DISTANCE_M = 1.1
AIM_M = (0.0, -0.002, 0.0)
SAMPLES = 10
WEBP_QUALITY = 93
WEBP_ALPHA_QUALITY = 90


@dataclass(frozen=True)
class Act:
    """An expression by ARKit's names without sides, and turns of head, neck and eyes in degrees.

    turn: to the person's left and down; gaze: of both eyes, likewise.
    """

    weights: dict[str, float]
    turn: tuple[float, float] = (0.0, 0.0)
    neck: tuple[float, float] = (0.0, 0.0)
    gaze: tuple[float, float] = (0.0, 0.0)

    def weight(self, name: str) -> float:
        """The weight of an expression, also of one that the act does not name."""
        return self.weights.get(name, RELAXED.get(name, 0.0))


RELAXED = {"eyeBlink": 0.13, "eyeSquint": 0.08, "mouthSmile": 0.18}
"""Weights of an act that does not set them otherwise."""
DIVERGENCE_DEG = 2.5
"""Angle by which each eyeball turns to the temple: a person looks some 5° to the nose of the
eyeball's axis, so the axes of eyes that look at a near camera do not meet there."""
TRAIN_ACTS = (
    Act({}),
    Act(
        {"mouthSmile": 0.85, "cheekSquint": 0.6, "eyeSquint": 0.3, "mouthDimple": 0.3},
        turn=(4, 0),
    ),
    Act(
        {
            "browInnerUp": 0.9,
            "browOuterUp": 0.8,
            "eyeWide": 0.6,
            "jawOpen": 0.5,
            "eyeBlink": 0,
            "mouthSmile": 0,
        },
        neck=(0, -4),
    ),
    Act({"eyeBlink": 1.0, "mouthPucker": 0.8, "mouthSmile": 0}, turn=(-3, 2)),
    Act(
        {"browDown": 0.8, "noseSneer": 0.5, "mouthFrown": 0.5, "mouthSmile": 0},
        neck=(-6, 0),
        gaze=(13, 0),
    ),
    Act(
        {
            "mouthSmile": 0.7,
            "mouthUpperUp": 0.5,
            "mouthLowerDown": 0.45,
            "jawOpen": 0.12,
            "cheekSquint": 0.5,
        },
        neck=(4, 2),
        gaze=(-12, 3),
    ),
)
"""Poses that are trained: an expression, a turn of head and neck, a gaze."""
TEST_ACTS = (
    Act(
        {"mouthSmile": 0.8, "jawOpen": 0.3, "browOuterUp": 0.5, "cheekSquint": 0.4},
        turn=(-4, -1),
        gaze=(6, 0),
    ),
    Act({"mouthFunnel": 0.6, "jawOpen": 0.15, "browInnerUp": 0.6, "mouthSmile": 0}, neck=(5, 0)),
)
"""Held-out poses."""
SMALL_WEIGHTS: tuple[dict[str, float], ...] = (
    {},
    {"mouthSmile": 0.5},
    {"browInnerUp": 0.7},
    {"mouthPucker": 0.3},
    {"eyeSquint": 0.4},
)
"""Expressions while the head turns: the mouth never opens, the lids never close."""


def main(source: Path, turning: Path | None = None) -> None:
    """Make the capture of the ICT-FaceKit arrays in `source`, without its head model; or one of a
    turning head in the folder `turning`."""
    if turning is not None:
        write_capture(turning, source, [camera_at(0, 0)], turning_acts())
        shutil.copyfile(BUNDLED_HEAD, turning / BUNDLED_MODEL)
        return
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_capture(folder, source, rig())
        with replacing(CAPTURE) as partial, ZipFile(partial, "w", ZIP_DEFLATED) as archive:
            for file in sorted(path for path in folder.rglob("*") if path.is_file()):
                # Of no date: equal files give an equal zip.
                archive.writestr(
                    ZipInfo(file.relative_to(folder).as_posix()), file.read_bytes(), ZIP_DEFLATED
                )


def turning_acts() -> tuple[Act, ...]:
    """A head that turns to both sides and nods."""
    acts = []
    for number, phase in enumerate(np.linspace(0, 2 * np.pi, TURNING_ACTS)):
        turned = 0.5 * TURN_DEG * np.sin(phase), 0.5 * NOD_DEG * np.sin(3 * phase)
        acts.append(Act(SMALL_WEIGHTS[number % len(SMALL_WEIGHTS)], turn=turned, neck=turned))
    return tuple(acts)


def write_capture(
    out: Path, source: Path, cameras: Sequence[Camera], acts: Sequence[Act] = TRAIN_ACTS
) -> None:
    """Write the capture into the folder `out`: acts that are trained, then TEST_ACTS."""
    person = make_person(read_npz(source))
    frames = [frame_of_act(act, person.model.expression_names) for act in (*acts, *TEST_ACTS)]
    _write_parameters(out, person, frames)
    studio = Studio(person, SAMPLES)
    with tqdm(total=len(frames) * len(cameras), unit="image") as bar:
        for timestep, frame in enumerate(frames):
            studio.pose(flame_forward(person.model, person.shape, frame))
            for number, image in enumerate(studio.pictures(cameras)):
                with replacing(out / _name(timestep, number)) as partial:
                    options = {
                        "quality": WEBP_QUALITY,
                        "alpha_quality": WEBP_ALPHA_QUALITY,
                        "method": 6,
                    }
                    image.save(partial, format="WEBP", **options)
                bar.update()
    _write_transforms(out, cameras, len(acts))


def frame_of_act(act: Act, names: tuple[str, ...]) -> FlameFrame:
    """The bundled head's parameters of an act; a weight without side is of both."""
    weights = RELAXED | act.weights
    sided = {
        f"{name}{side}": weight
        for name, weight in weights.items()
        for side in ("", "Left", "Right")
    }
    expr = np.array([sided.get(name, 0.0) for name in names])
    yaw, pitch, outwards = np.radians([*act.gaze, DIVERGENCE_DEG])

    def turned(angles: tuple[float, float]) -> np.ndarray:
        return np.radians([angles[1], angles[0], 0.0])

    zero = np.zeros(3)
    return FlameFrame(
        expr=expr,
        rotation=turned(act.turn),
        neck_pose=turned(act.neck),
        jaw_pose=zero,
        translation=zero,
        eyes_pose=np.array([pitch, yaw + outwards, 0.0, pitch, yaw - outwards, 0.0]),
    )


def rig() -> list[Camera]:
    """Cameras on an arc around the head, alternately from below and above."""
    elevations = [ELEVATIONS_DEG[number % len(ELEVATIONS_DEG)] for number in range(CAMERAS)]
    around = np.linspace(-ARC_DEG, ARC_DEG, CAMERAS)
    return [camera_at(*angles) for angles in zip(around, elevations, strict=True)]


def camera_at(
    azimuth_deg: float,
    elevation_deg: float,
    distance_m: float = DISTANCE_M,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    focal: float = FOCAL,
) -> Camera:
    """A camera that looks at the head, from so far to the person's left and up. size: width and
    height in pixels; focal: in image widths."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.cos(elevation)
    ahead = np.array([np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level])
    eye = (AIM_M + distance_m * ahead).tolist()
    return look_at(eye, AIM_M, *size, focal * size[0])


def _name(timestep: int, camera: int) -> str:
    return image_name(timestep, camera, ".webp")


def _write_parameters(out: Path, person: Person, frames: list[FlameFrame]) -> None:
    shape = {"shape": person.shape.astype(np.float32)}
    named = {f"{PARAMETERS}/{timestep:05d}.npz": frame for timestep, frame in enumerate(frames)}
    for name, frame in {**named, CANONICAL_NAME: neutral_frame(person.model)}.items():
        write_npz(out / name, moving_arrays(frame.parameters) | shape, compressed=True)


def _write_transforms(out: Path, cameras: Sequence[Camera], trained: int) -> None:
    splits: dict[str, list[dict[str, object]]] = {name: [] for name in SPLIT_FILES}
    train, val, test = splits.values()
    for timestep in range(trained + len(TEST_ACTS)):
        for number, camera in enumerate(cameras):
            split = val if number == HELD_OUT else train
            (split if timestep < trained else test).append(
                {
                    "timestep_index": timestep,
                    "camera_index": number,
                    "camera_id": f"{number:02d}",
                    "file_path": _name(timestep, number),
                    "flame_param_path": f"{PARAMETERS}/{timestep:05d}.npz",
                    **camera_entry(camera),
                }
            )
    for name, frames in [*splits.items(), ("transforms.json", [*train, *val, *test])]:
        write_json(out / name, {"frames": frames})


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
