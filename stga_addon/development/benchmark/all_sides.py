"""Pictures of avatars from all sides and in poses that their captures may not show.

    python -m stga_addon.development.benchmark.all_sides RUN... --sides FILE --poses FILE

Writes a sheet of eight directions around the head and one of six poses, of each run a row. The runs
are of one capture, tracked with the bundled head or another whose expressions have ARKit's names.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ...avatar.file import Avatar, read_avatar
from ...capture.camera import Camera
from ...errors import StgaError
from ...files import replacing
from ...render.render import render_avatar, to_uint8
from ...training.run.folder import AVATAR, open_refined
from ..demo.make_capture import ELEVATIONS_DEG, Act, camera_at, frame_of_act
from ..demo.run import side_by_side

DIRECTIONS = 8
"""Directions around the head in which it is compared."""
JPEG_QUALITY = 88
"""Pillow's quality of the written JPEG pictures, 0 to 100."""
PICTURE_FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}
"""Suffix of a picture -> Pillow's name of its format."""
NEUTRAL = Act({})
"""Act without any expression."""
POSES = (
    Act({"jawOpen": 1.0}),
    Act({"eyeBlink": 1.0}),
    Act({"mouthSmile": 1.0, "jawOpen": 0.6}),
    Act({"browDown": 1.0, "eyeBlink": 1.0, "mouthSmile": 0.0}),
    Act({"mouthPucker": 1.0, "mouthSmile": 0.0}),
    Act({"eyeBlink": 0.0}, gaze=(28.0, 0.0)),
)
"""Expressions in which the head is compared from the front; `gaze` in degrees."""

Shot = tuple[Camera, np.ndarray]
"""A camera, and the head's posed mesh (V, 3) that it sees."""


def shots_of(run: Path) -> tuple[list[Shot], list[Shot]]:
    """The directions and the poses, of the head of a run's capture. Raises StgaError where it is
    not tracked with such a head."""
    sequence = open_refined(run).flame
    names = () if sequence is None else sequence.model.expression_names
    if sequence is None or "jawOpen" not in names:
        raise StgaError(f"{run}: its head has no expressions by ARKit's names")

    def mesh(act: Act) -> np.ndarray:
        return sequence.mesh(frame_of_act(act, names))

    neutral = mesh(NEUTRAL)
    around = np.arange(DIRECTIONS) * 360 / DIRECTIONS
    sides = [(camera_at(angle, ELEVATIONS_DEG[0]), neutral) for angle in around]
    return sides, [(camera_at(0, 0), mesh(act)) for act in POSES]


def write_sheet(path: Path, avatars: Sequence[Avatar], shots: Sequence[Shot]) -> None:
    """A picture with a row of each avatar and a column of each shot."""
    rows = []
    for avatar in avatars:
        images = [render_avatar(avatar, mesh, camera, (1, 1, 1)) for camera, mesh in shots]
        rows.append(side_by_side([to_uint8(image) for image in images]))
    with replacing(path) as partial:
        Image.fromarray(np.concatenate(rows)).save(
            partial, format=PICTURE_FORMATS[path.suffix.lower()], quality=JPEG_QUALITY
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--sides", type=Path, required=True, metavar="FILE")
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE")
    options = parser.parse_args()
    for path in (options.sides, options.poses):
        if path.suffix.lower() not in PICTURE_FORMATS:
            parser.error(f"{path}: expected a name that ends in {', '.join(PICTURE_FORMATS)}")
    avatars = [read_avatar(run / AVATAR) for run in options.runs]
    for path, shots in zip((options.sides, options.poses), shots_of(options.runs[-1]), strict=True):
        write_sheet(path, avatars, shots)


if __name__ == "__main__":
    main()
