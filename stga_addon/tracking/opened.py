"""Footage that is about to be tracked: which of its results are on disk already, and what is to be
done."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from os.path import realpath
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import read_json, write_json
from ..flame.model import BUNDLED_HEAD
from . import folder
from .footage.model import Footage
from .head_model import HeadModel, read_head_model
from .known_person import KnownPerson


@dataclass(frozen=True)
class TrackingOptions:
    """How footage is tracked.

    landmarks  folder of landmark files in place of the networks'
    meshes     whether an OBJ is written for each timestep of a FLAME capture as well
    world      "head": meters as the head's size says, y up, the head near the origin; "keep": that
               of the cameras, which is scaled about its origin where it is not in meters; "auto":
               as the calibration states, else "head"
    mattes     whether they are made for frames without a mask (`with_mattes`)
    person     known from another take, with the head file's shapes: then only scale, expressions
               and poses are sought; of an avatar without the networks' bias, and `end_tracking` is
               the caller's
    """

    landmarks: Path | None = None
    meshes: bool = False
    world: str = "auto"
    mattes: bool = True
    person: KnownPerson | None = None


DEFAULT_OPTIONS = TrackingOptions()


@dataclass(frozen=True)
class OpenedFootage:
    """Footage, its head model, and the folder of the capture.

    head_file  None: the bundled head
    source     what landmarks and mattes are of, as JSON
    """

    footage: Footage
    head: HeadModel
    head_file: Path | None
    out: Path
    options: TrackingOptions
    source: dict[str, Any]

    @property
    def keeps_world(self) -> bool:
        return self.footage.keeps(self.options.world)


def open_take(
    footage: Footage, head_file: Path | None, out: Path, options: TrackingOptions
) -> OpenedFootage:
    """Raises StgaError for a folder that is no place for a capture, and for a damaged head."""
    check_place(footage, out)
    person = options.person
    head = read_head_model(head_file) if person is None else person.fit.head
    stored = _stored(footage, out)
    template = hashlib.sha256(head.model.v_template.tobytes()).hexdigest()[:16]
    model = str(head_file.resolve()) if head_file else ""
    source = {
        **footage_state(stored),
        "head_model": [model, file_state([head_file or BUNDLED_HEAD]), template],
        "landmarks": None if options.landmarks is None else realpath(options.landmarks),
    }
    return OpenedFootage(stored, head, head_file, out, options, source)


def check_place(footage: Footage, out: Path) -> None:
    """Raise StgaError for a folder that is no place for a capture."""
    if folder.is_written(out):
        raise StgaError(f"{out}: already holds a capture; give another --out")
    if Path(realpath(out)) == footage.root:
        raise StgaError(f"{out}: is the folder of the footage; give another --out")


def begin_landmarks(opened: OpenedFootage) -> None:
    """Record what the landmarks in the folder are of. Raises StgaError for other footage's."""
    path = opened.out / folder.FOOTAGE_FILE
    if path.exists() and read_json(path) != opened.source:
        raise StgaError(
            f"{opened.out}: holds landmarks of other footage; give another --out, or delete it"
        )
    write_json(path, opened.source)


def is_of_footage(out: Path, footage: Footage) -> bool:
    """Whether the tracking in a folder, whole or interrupted, is of this footage."""
    path = out / folder.FOOTAGE_FILE
    stored = read_json(path) if path.exists() else None
    return isinstance(stored, dict) and stored.items() >= footage_state(footage).items()


def footage_state(footage: Footage) -> dict[str, Any]:
    """Each camera's first frame, the state of all files, and the undistortion; as JSON."""
    cameras = {}
    for camera in footage.cameras:
        state: list[Any] = [camera.source(camera.timesteps[0]), file_state(camera.frames.files)]
        if camera.undistortion is not None:
            state += [repr(camera.undistortion.lens), *camera.camera.intrinsics[2:]]
        cameras[camera.name] = state
    timesteps = list(footage.timesteps)
    return {"footage": str(footage.root), "cameras": cameras, "timesteps": timesteps}


def file_state(files: Iterable[Path]) -> str:
    """Changes with the size or the time of modification of one of the files."""
    states = [file.stat() for file in files]
    sizes = repr([(state.st_size, state.st_mtime_ns) for state in states])
    return hashlib.sha256(sizes.encode()).hexdigest()[:16]


def _stored(footage: Footage, out: Path) -> Footage:
    """The footage whose undistorted frames that are no files yet are decoded once: they are kept as
    the capture's images. A file that exists is that of the frame."""
    cameras = []
    for number, camera in enumerate(footage.cameras):
        if camera.file(camera.timesteps[0]) is None:
            kept = {t: out / folder.image_name(t, number) for t in camera.timesteps}
            camera = replace(camera, kept=kept)
        cameras.append(camera)
    return replace(footage, cameras=tuple(cameras))
