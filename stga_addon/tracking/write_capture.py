"""Writing of a tracked take: VHAP's layout for FLAME, the mesh layout for other models."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..capture.camera import Camera
from ..capture.open import CANONICAL_NAME, PARAMETERS
from ..capture.transforms import camera_entry
from ..files import read_npz, replacing, write_json, write_npz
from ..flame.forward import frame_of
from ..flame.sequence import FRAME_FIELDS
from .fit import posed_mesh
from .folder import SPLIT_FILES, image_name, mask_name
from .footage.model import Footage, FootageCamera
from .stages import ReportStage, Stage
from .torso import FollowedTorso

MIN_CAMERAS_TO_HOLD_OUT = 4


def write_capture(
    out: Path, footage: Footage, torso: FollowedTorso, meshes: bool, report: ReportStage
) -> None:
    """Write images, masks, the tracked head of each timestep, and at last the transforms that make
    it a capture.

    torso: of all timesteps, interpolated ones included. With four cameras or more, the one nearest
    to the middle is held out as `val`; timesteps at which no camera saw a face, as behind a hand,
    are `test`. Raises StgaError where `out` cannot be written.
    """
    fit = torso.fit
    parameters = torso.parameters
    views = list(footage.views())
    index = {camera.name: number for number, camera in enumerate(footage.cameras)}
    splits: dict[str, list[dict[str, Any]]] = {"train": [], "val": [], "test": []}
    centers = np.array([each.camera.position for each in footage.cameras])
    held_out = None
    if len(centers) >= MIN_CAMERAS_TO_HOLD_OUT:
        nearest = np.linalg.norm(centers - centers.mean(0), axis=1).argmin()
        held_out = footage.cameras[int(nearest)].name
    flame = fit.head.layout == "flame"
    model = fit.head.model
    for number, (timestep, source) in enumerate(views):
        camera = fit.to_capture.camera(source.camera)
        entry = _entry(out, timestep, source, index[source.name], camera)
        if flame:
            entry["flame_param_path"] = f"{PARAMETERS}/{timestep:05d}.npz"
        else:
            entry["mesh_path"] = f"meshes/{timestep:05d}.obj"
        split = "val" if source.name == held_out else "train"
        splits[split if timestep in fit.parameters else "test"].append(entry)
        report(Stage.IMAGES, number + 1, len(views))
    top: dict[str, Any] = {} if flame else {"canonical_mesh_path": "meshes/neutral.obj"}
    if footage.fps is not None:
        top["fps"] = footage.fps
    neutral = np.zeros_like(next(iter(parameters.values())))
    offset = fit.static_offset
    person = {} if offset is None else {"static_offset": offset.astype(np.float32)}
    person["shape"] = fit.shape.astype(np.float32)
    for number, (timestep, values) in enumerate(parameters.items()):
        if flame:
            moving = {**moving_arrays(values), **person, **_offset(torso.offsets.get(timestep))}
            write_npz(_head_file(out, timestep), moving)
        if meshes or not flame:
            path = out / "meshes" / f"{timestep:05d}.obj"
            write_obj(path, torso.mesh(timestep), model.faces)
        report(Stage.HEADS, number + 1, len(parameters))
    if meshes or not flame:
        write_obj(out / "meshes" / "neutral.obj", posed_mesh(fit, neutral), model.faces)
    if flame:
        write_npz(out / CANONICAL_NAME, {**moving_arrays(neutral), **person})
    # train last: see is_written
    for name, entries in reversed(list(zip(SPLIT_FILES, splits.values(), strict=True))):
        write_json(out / name, {**top, "frames": entries})


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A Wavefront OBJ of triangles; vertices in micrometer precision."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="ascii")


def _entry(
    out: Path, timestep: int, source: FootageCamera, number: int, camera: Camera
) -> dict[str, Any]:
    """Copy image and mask; the entry of the transforms."""
    file = source.file(timestep)
    name = image_name(timestep, number, ".png" if file is None else file.suffix.lower())
    if file != out / name:  # which a frame of a video is already
        with replacing(out / name) as partial:
            if file is None:
                Image.fromarray(source.image(timestep)).save(partial, format="PNG")
            else:
                shutil.copyfile(file, partial)
    entry: dict[str, Any] = {
        "timestep_index": timestep,
        "camera_index": number,
        "camera_id": source.name,
        "file_path": name,
        **camera_entry(camera),
    }
    path = mask_name(timestep, number)
    mask = None if source.mattes.get(timestep) == out / path else source.mask(timestep)
    if mask is not None:
        with replacing(out / path) as partial:
            Image.fromarray(mask).save(partial, format="PNG")
    if mask is not None or timestep in source.mattes:
        entry["fg_mask_path"] = path
    return entry


def moving_arrays(parameters: np.ndarray) -> dict[str, np.ndarray]:
    """What changes from timestep to timestep of (E + 18,), as in VHAP's files: (1, …) float32."""
    frame = frame_of(parameters)
    return {name: getattr(frame, name)[None].astype(np.float32) for name in FRAME_FIELDS}


def replace_head(
    out: Path, timestep: int, parameters: np.ndarray, offset: np.ndarray | None = None
) -> None:
    """Write other parameters (E + 18,) of a timestep, and vertex offsets (V, 3) if given; the
    identity stays, and else the offsets."""
    path = _head_file(out, timestep)
    write_npz(path, {**read_npz(path), **moving_arrays(parameters), **_offset(offset)})


def _head_file(out: Path, timestep: int) -> Path:
    return out / PARAMETERS / f"{timestep:05d}.npz"


def _offset(offset: np.ndarray | None) -> dict[str, np.ndarray]:
    return {} if offset is None else {"dynamic_offset": offset[None].astype(np.float32)}
