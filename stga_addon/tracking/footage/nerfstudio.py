"""Cameras of transforms files: nerfstudio, instant-ngp, VHAP, Blender's exports."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...capture.distortion import lens_of
from ...capture.model import FPS_LIMIT
from ...capture.transforms import Frame, read_transforms, repairs, with_principal_point
from .shots import Calibrated, Shot
from .sources import natural_order

FACE_KEYS = ("expression", "exp_path", "mesh_path", "flame_path")
"""Keys of each frame of NeRFace, IMavatar and INSTA: a head that moves in front of one camera."""
MARKS = b'"frames"', b'"transform_matrix"'
"""Keys that every transforms file has."""
HEAD_BYTES = 1 << 16
"""Bytes from the beginning of a file in which MARKS are looked for."""
HEAD_FIXED = (
    "its frames hold a face's expressions: they are moments of one camera, and its poses are "
    "relative to the head, which tracking finds itself"
)
"""Sentence about what NeRFace, INSTA and their like write."""


def is_transforms(path: Path) -> bool:
    """Whether a file of any name is a transforms file, by its beginning."""
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    return all(mark in head for mark in MARKS)


def read_nerfstudio(path: Path) -> Calibrated:
    """Entries of a transforms file; `file_path` is the label. Raises StgaError. Their `cy` means
    what VHAP's does where frames have `timestep_index` and nothing says which lens they have, as
    nerfstudio's and instant-ngp's do, else what OpenCV's does (`read_transforms`)."""
    frames = read_transforms(path, "opencv", moved=True)
    shots = []
    is_timed = any(
        frame.record.has(key) for frame in frames for key in ("timestep_index", "keyframe")
    )
    convention = written_convention(frames)
    for frame in frames:
        view = frame.view
        record = frame.record
        name = frame.camera_id
        camera = with_principal_point(view.camera, frame.principal, convention)
        if name is None and record.has("camera_index"):
            name = f"{view.camera_index:02d}"
        timestep = view.timestep if is_timed else None
        mask = view.mask
        mask = mask or record.path_of("mask_path")  # nerfstudio's
        fps = record.number("fps", 0, FPS_LIMIT) if record.has("fps") else None
        keeps_world = record.values.get("world") == "keep"
        shot = Shot(
            view.name, camera, lens_of(record), frame.where, view.image, timestep, mask, name
        )
        shots.append(replace(shot, fps=fps, keeps_world=keeps_world))
    if not is_timed and is_head_fixed(frames):
        return _of_one_camera(shots), (*repairs(frames), HEAD_FIXED)
    return shots, repairs(frames)


def written_convention(frames: Sequence[Frame]) -> str:
    """What `cy` means in a transforms file (`read_transforms`), by the program that wrote it."""
    has_lens = any(frame.record.has(key) for frame in frames for key in ("camera_model", "k1"))
    is_vhap = not has_lens and any(frame.record.has("timestep_index") for frame in frames)
    return "vhap" if is_vhap else "opencv"


def is_head_fixed(frames: Sequence[Frame]) -> bool:
    """Whether poses are relative to a moving head, as those of single-camera head trackers."""
    entries = [frame.record.values for frame in frames]
    return len(frames) > 1 and any(all(key in each for each in entries) for key in FACE_KEYS)


def _of_one_camera(shots: list[Shot]) -> list[Shot]:
    """Shots of one camera that stands in the origin, a moment each, in natural order of images."""
    order = sorted(range(len(shots)), key=lambda place: natural_order(shots[place].label))
    timed = []
    for timestep, place in enumerate(order):
        shot = shots[place]
        camera = replace(shot.camera, world_to_camera=np.eye(4))
        timed.append(replace(shot, camera=camera, camera_name="camera", timestep=timestep))
    return timed
