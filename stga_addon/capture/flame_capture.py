"""Opening captures tracked with FLAME (the layout of VHAP and GaussianAvatars)."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..files import read_npz
from ..flame.model import BUNDLED_HEAD, EXPRESSION_NAMES, key_regions
from ..flame.sequence import (
    FlameSequence,
    expression_mesh,
    neutral_mesh,
    read_frame,
    read_identity,
    read_motion,
    sequence_mesh,
)
from ..flame.teeth import flame_model
from .meshes import cached_meshes, check_extent, file_of
from .model import Capture, View
from .transforms import Transforms, tracked_files

CANONICAL_NAME = "canonical_flame_param.npz"
PARAMETERS = "flame_param"
OWN_MODELS = ("flame_model.npz", "flame_model.pkl")
"""Names of a FLAME model file in the folder of a capture, which is used where none is given."""
BUNDLED_MODEL = "bundled_head.npz"
"""Copy of the head model of this package in the folder of a capture that was tracked with it."""


def open_flame_capture(
    root: Path, transforms: Transforms, views: Mapping[str, tuple[View, ...]], model_file: Path | None
) -> Capture:
    """Capture of layout "flame": `flame_param_path` per frame, else `flame_param/%05d.npz` by timestep.

    A model with FLAME's published 5023 vertices gets teeth, because VHAP and GaussianAvatars use them; a model of any
    other size is used as it is. Shape and static offset come from the first timestep.
    Raises StgaError, also where no model file is given, and none lies in the folder (OWN_MODELS): FLAME's license
    forbids passing it on.
    """
    model_file = _model_file(root, model_file)
    model = flame_model(model_file)
    files = parameter_files(root, transforms)
    first = files[min(files)]
    shape, static_offset = read_identity(first, model)
    sequence = FlameSequence(
        model, shape, static_offset, tuple(files), lambda timestep: read_frame(file_of(files, timestep), model)
    )
    return sequence_capture(root, sequence, model_file, views)


def open_flame_motion(path: Path, model_file: Path | None) -> Capture:
    """A motion file (`flame.sequence.read_motion`) as a capture of layout "flame" without views.

    A file that names its expressions is of the bundled head, and needs no model file. Raises StgaError.
    """
    model_file = BUNDLED_HEAD if EXPRESSION_NAMES in read_npz(path) else _model_file(path, model_file)
    return sequence_capture(path, read_motion(path, flame_model(model_file)), model_file, {})


def with_sequence(capture: Capture, sequence: FlameSequence) -> Capture:
    """The FLAME capture with another motion of the same person, and the meshes that it makes."""
    return replace(capture, **_posed(capture.root, sequence))


def sequence_capture(
    root: Path, sequence: FlameSequence, model_file: Path | None, views: Mapping[str, tuple[View, ...]]
) -> Capture:
    """The capture of layout "flame" whose meshes a sequence makes; `root` and `model_file` say where it is from."""
    model = sequence.model
    regions = key_regions(model)
    missing = "the FLAME model has no vertex masks (FLAME_masks.pkl beside it): triangles are selected one by one"
    return Capture(
        root=root,
        layout="flame",
        faces=model.faces,
        neutral=check_extent(f"{root}: neutral mesh", neutral_mesh(sequence)),
        views=views,
        timesteps=sequence.timesteps,
        regions=regions,
        flame_file=model_file,
        warnings=() if regions else (missing,),
        **_posed(root, sequence),
    )


def _posed(root: Path, sequence: FlameSequence) -> dict[str, Any]:
    """The fields of a capture that depend on its motion."""

    def mesh(timestep: int) -> np.ndarray:
        return check_extent(f"{root}: timestep {timestep}", sequence_mesh(sequence, timestep))

    return {
        "mesh": cached_meshes(mesh, len(sequence.model.v_template)),
        "expression_mesh": lambda timestep, zero_pose: expression_mesh(sequence, timestep, zero_pose),
        "flame": sequence,
    }


def _model_file(root: Path, given: Path | None) -> Path:
    """The capture's bundled head, else the FLAME model file that is given, else the one in the capture's folder."""
    if (root / BUNDLED_MODEL).is_file():
        return root / BUNDLED_MODEL
    beside = (root / name for name in OWN_MODELS)
    found = given or next((path for path in beside if path.is_file()), None)
    if found is None:
        raise StgaError(
            f"{root}: is tracked with FLAME; give the FLAME model file (.pkl or .npz) with --flame or in the"
            f" preferences of the add-on, or put it into the folder as {OWN_MODELS[0]}"
        )
    return found


def parameter_files(root: Path, transforms: Transforms) -> dict[int, Path]:
    """timestep -> parameter file, ascending; without any frames, those in `flame_param`. Raises StgaError."""
    frames = transforms.frames
    if any(frame.flame for frame in frames):
        return tracked_files(frames, "flame")
    if frames:
        return {t: root / PARAMETERS / f"{t:05d}.npz" for t in sorted({frame.view.timestep for frame in frames})}
    listed = (root / PARAMETERS).glob("*.npz")
    files = {int(path.stem): path for path in listed if re.fullmatch(r"\d+", path.stem, re.ASCII)}
    if not files:
        raise StgaError(f"{root / PARAMETERS}: holds no parameters; expected one .npz per timestep, such as 00000.npz")
    return dict(sorted(files.items()))
