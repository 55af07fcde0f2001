"""Writing of a tracked take as a capture: VHAP's layout for FLAME, the mesh layout for other
models."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..capture.camera import Camera
from ..capture.open import CANONICAL_NAME, PARAMETERS
from ..capture.transforms import camera_entry
from ..files import replacing, write_json, write_npz
from ..flame.forward import flame_forward, frame_of
from ..flame.sequence import FRAME_FIELDS
from .fit import HeadFit
from .folder import SPLIT_FILES, image_name, mask_name
from .footage.model import Footage, FootageCamera
from .landmarks import Report

MIN_CAMERAS_TO_HOLD_OUT = 4


def write_capture(
    out: Path,
    footage: Footage,
    fit: HeadFit,
    parameters: Mapping[int, np.ndarray],
    offsets: Mapping[int, np.ndarray],
    meshes: bool,
    report: Report,
) -> None:
    """Write images, masks, the tracked head of each timestep, and at last the transforms that make
    it a capture.

    parameters: timestep -> (E + 18,), interpolated ones included; offsets: timestep -> (V, 3),
    where there are any. With four cameras or more, the one nearest to the middle is held out as
    `val`. Raises StgaError where `out` cannot be written.
    """
    views = [view for view in footage.views() if view[0] in parameters]
    index = {camera.name: number for number, camera in enumerate(footage.cameras)}
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "val": [], "test": []}
    held_out = _middle_camera(footage) if len(footage.cameras) >= MIN_CAMERAS_TO_HOLD_OUT else None
    for number, (timestep, camera) in enumerate(views):
        entry = _entry(
            out, timestep, camera, index[camera.name], fit.to_capture.camera(camera.camera)
        )
        folder = (f"{PARAMETERS}", "npz") if fit.head.layout == "flame" else ("meshes", "obj")
        entry["flame_param_path" if folder[1] == "npz" else "mesh_path"] = (
            f"{folder[0]}/{timestep:05d}.{folder[1]}"
        )
        frames["val" if camera.name == held_out else "train"].append(entry)
        report("Images", number + 1, len(views))
    top: dict[str, Any] = {
        **_write_heads(out, fit, parameters, offsets, meshes or fit.head.layout == "mesh", report)
    }
    if footage.fps is not None:
        top["fps"] = footage.fps
    # train last: see is_written
    for name, entries in reversed(list(zip(SPLIT_FILES, frames.values(), strict=True))):
        write_json(out / name, {**top, "frames": entries})


def posed_mesh(
    fit: HeadFit, parameters: np.ndarray, offset: np.ndarray | None = None
) -> np.ndarray:
    """The head's vertices (V, 3) in the capture's world, in meters; offset (V, 3): of this
    timestep."""
    return flame_forward(fit.head.model, np.zeros(0), frame_of(parameters, offset))


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A Wavefront OBJ of triangles; vertices in micrometer precision."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="ascii")


def _middle_camera(footage: Footage) -> str:
    centers = np.array([camera.camera.position for camera in footage.cameras])
    return footage.cameras[int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())].name


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


def _write_heads(
    out: Path,
    fit: HeadFit,
    parameters: Mapping[int, np.ndarray],
    offsets: Mapping[int, np.ndarray],
    meshes: bool,
    report: Report,
) -> dict[str, str]:
    """Write every timestep's head; returns the top level of the transforms."""
    faces, neutral = fit.head.model.faces, np.zeros_like(next(iter(parameters.values())))
    for number, (timestep, values) in enumerate(parameters.items()):
        if fit.head.layout == "flame":
            arrays = _flame_arrays(fit, values)
            if timestep in offsets:
                arrays["dynamic_offset"] = offsets[timestep][None].astype(np.float32)
            write_npz(out / PARAMETERS / f"{timestep:05d}.npz", arrays)
        if meshes:
            mesh = posed_mesh(fit, values, offsets.get(timestep))
            write_obj(out / "meshes" / f"{timestep:05d}.obj", mesh, faces)
        report("Heads", number + 1, len(parameters))
    if meshes:
        write_obj(out / "meshes" / "neutral.obj", posed_mesh(fit, neutral), faces)
    if fit.head.layout == "flame":
        write_npz(out / CANONICAL_NAME, _flame_arrays(fit, neutral))
        return {}
    return {"canonical_mesh_path": "meshes/neutral.obj"}


def moving_arrays(parameters: np.ndarray) -> dict[str, np.ndarray]:
    """What changes from timestep to timestep of (E + 18,) parameters, as in VHAP's files: (1, …)
    float32."""
    frame = frame_of(parameters)
    return {name: getattr(frame, name)[None].astype(np.float32) for name in FRAME_FIELDS}


def _flame_arrays(fit: HeadFit, parameters: np.ndarray) -> dict[str, np.ndarray]:
    arrays = moving_arrays(parameters)
    if fit.static_offset is not None:
        arrays["static_offset"] = fit.static_offset.astype(np.float32)
    return arrays | {"shape": fit.shape.astype(np.float32)}
