"""Opening a capture folder of any layout."""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError, listed, shorten
from ..files import (
    is_file,
    is_folder,
    matching,
    naming,
    open_npz,
    read_bytes,
    read_json,
    read_npy,
    read_npz,
)
from ..flame.forward import FlameFrame
from ..flame.model import BUNDLED_HEAD, EXPRESSION_NAMES
from ..flame.parts import flame_model, found_regions, key_regions
from ..flame.sequence import (
    FlameSequence,
    expression_mesh,
    neutral_mesh,
    read_frame,
    read_identity,
    read_motion,
    sequence_mesh,
    with_identity,
)
from ..schema import check_encodable
from . import meshes
from .distortion import distortion, undistorted
from .mesh_geometry import pixels_of, without_head_motion
from .model import Capture, Views, evenly_spread
from .other_input import is_gaussian_output, other_input
from .repairs import (
    REPAIRS,
    REPAIRS_FILE,
    find_repair,
    in_image_size,
    in_meters,
    read_repairs,
    repaired,
    write_repairs,
)
from .transforms import (
    DEFAULT_PRINCIPAL_POINT,
    IMAGE_SUFFIXES,
    PRINCIPAL_POINTS,
    SPLITS,
    Frame,
    Transforms,
    read_splits,
    tracked_files,
    transforms_files,
    transforms_warnings,
    with_principal_point,
)

MIN_HEAD_EXTENT_M = 0.05
"""Least extent of a neutral mesh along its longest axis: below, its unit is probably not the
meter."""
TYPICAL_HEAD_EXTENT_M = 0.3
"""Extent of an average head, which messages name."""
MAX_HEAD_EXTENT_M = 3.0
"""Largest extent of a neutral mesh in meters."""
NO_FOLDER = "is not a folder; expected that of a capture"
"""Message for a path that is neither a capture nor anything else."""
NEUTRAL = ("neutral", "canonical")
"""Names of a mesh without expression."""
MAX_COMPARED_VIEWS = 4
"""Views whose images or masks are read to check a capture."""
MIN_FRACTION_DIFFERENCE = 0.01
"""Fraction of the vertices by which a convention must be worse than another to be doubted."""
CANONICAL_NAME = "canonical_flame_param.npz"
"""File of the canonical head's FLAME parameters, by which VHAP's captures are recognized."""
PARAMETERS = "flame_param"
"""Folder of VHAP's FLAME parameters, one file for each timestep."""

CAPTURE_MODELS = ("flame_model.npz", "flame_model.pkl")
"""Names of a FLAME model file in the folder of a capture, which is used where none is given."""
BUNDLED_MODEL = "bundled_head.npz"
"""Copy of the head model of this package in the folder of a capture that was tracked with it."""


def open_capture(
    folder: Path, flame: Path | None = None, principal_point: str = DEFAULT_PRINCIPAL_POINT
) -> Capture:
    """Open a capture: cameras and file names now, images and tracked meshes when they are asked
    for.

    An .npz file in place of a folder is a FLAME motion: a capture without views.

    Layouts: "flame" (VHAP and GaussianAvatars; needs the model file `flame`), "mesh" (`mesh_path`
    per frame, or a bare folder of meshes, which has no views) and "release" (STGA's authors).
    `principal_point` as in `read_transforms`; `Capture.warnings` says where the masks fit another
    one better. Raises StgaError in one sentence naming file, field and what was expected, also for
    any image, mask or tracked file that is missing.
    """
    if principal_point not in PRINCIPAL_POINTS:
        raise StgaError(
            f"principal point convention {shorten(principal_point)} is not one of "
            f"{', '.join(PRINCIPAL_POINTS)}"
        )
    check_encodable(folder)
    if folder.suffix.lower() == ".npz" and is_file(folder):
        path = folder.resolve()
        # A file that names its expressions is of the bundled head, and needs no model file.
        with open_npz(path) as file:
            bundled = EXPRESSION_NAMES in file.entries
        model_file = BUNDLED_HEAD if bundled else _model_file(path, flame)
        return sequence_capture(path, read_motion(path, flame_model(model_file)), model_file, {})
    if not is_folder(folder):
        found = other_input(folder)
        problem = f"is no capture: it {found.advice}" if found else NO_FOLDER
        raise StgaError(f"{folder}: {problem}")
    root = folder.resolve()
    transforms = Transforms({}, None, None)
    if transforms_files(root):
        transforms = read_splits(root, principal_point)
    _require_files(transforms.frames)
    transforms, resized = in_image_size(transforms)
    distorted = distortion(transforms.frames)
    if distorted:
        splits = {name: undistorted(frames) for name, frames in transforms.splits.items()}
        transforms = replace(transforms, splits=splits)
    capture = _open_layout(root, transforms, flame)
    warnings = [*capture.warnings, *([resized] if resized else ())]
    if distorted:
        warnings.append(f"{distorted}; images are undistorted as they are read")
    warnings += transforms_warnings(transforms.frames, principal_point)
    warnings += _mask_warnings(transforms.frames)
    warnings += _unnamed_images(transforms.frames)
    point = _principal_point_warning(transforms.frames, capture.mesh, principal_point)
    warnings += [point] if point else []
    capture, messages = _as_meant(capture, check=point is None)
    warnings += messages
    size = float(np.ptp(capture.neutral, axis=0).max()) if len(capture.neutral) else 0.0
    if not MIN_HEAD_EXTENT_M <= size <= MAX_HEAD_EXTENT_M:
        warnings.append(
            f"{root}: the neutral mesh measures {size:.3g} m; expected a head of "
            f"{TYPICAL_HEAD_EXTENT_M} m"
        )
    return replace(capture, fps=transforms.fps, warnings=tuple(warnings))


def _as_meant(capture: Capture, check: bool) -> tuple[Capture, list[str]]:
    """The capture in meters and with the repairs of its folder, and a sentence for each of these,
    or (check) for a mesh that misses the images. Raises StgaError."""
    # Limits, thresholds and the near plane are in meters: a head in millimeters cannot be trained.
    capture, rescaled = in_meters(capture)
    sentences = [rescaled] if rescaled else []
    names = read_repairs(capture.root)
    if names:
        capture = repaired(capture, names)
        repairs = "; ".join(REPAIRS[name].about for name in names)
        about = f"{capture.root / REPAIRS_FILE}: the capture is read as repaired: {repairs}"
        sentences.append(about)
    elif names is None and check:
        name, misses = find_repair(capture)
        capture = replace(capture, repair=name)
        sentences += [misses] if misses else []
    return capture, sentences


def is_capture(path: Path) -> bool:
    """Whether a path looks like a capture, or a motion, that `open_capture` reads."""
    if not is_folder(path):
        return False
    files = transforms_files(path)
    tracked = _names(files, "mesh_path", "flame_param_path")
    is_listed = is_folder(path / PARAMETERS) or bool(matching(path / "meshes", "mesh_*.json"))
    if tracked or is_listed or is_file(path / CANONICAL_NAME):
        return True
    bare = any(file.suffix.lower() in meshes.MESH_SUFFIXES for file in matching(path, "[!.]*"))
    return bare and not files and not is_gaussian_output(path)


def needs_no_flame(path: Path) -> bool:
    """Whether a path looks like a capture that is read without a FLAME model file: its meshes are
    files, or of the bundled head, whose model is in the folder."""
    return is_capture(path) and (is_file(path / BUNDLED_MODEL) or has_mesh_files(path))


def has_mesh_files(path: Path) -> bool:
    """Whether a path looks like a capture whose meshes are files, without poses of a model."""
    if not is_capture(path) or is_file(path / BUNDLED_MODEL):
        return False
    is_flame = is_folder(path / PARAMETERS) or is_file(path / CANONICAL_NAME)
    return not is_flame and not _names(transforms_files(path), "flame_param_path")


def _names(files: Sequence[Path], *keys: str) -> bool:
    """Whether one of these transforms has one of the keys."""
    return any(f'"{key}"'.encode() in read_bytes(file) for file in files for key in keys)


def repair_capture(
    folder: Path, flame: Path | None = None, principal_point: str = DEFAULT_PRINCIPAL_POINT
) -> str | None:
    """Keep in the capture's folder how it is to be read, if its mesh misses its images but fits
    them in another way (`find_repair`); returns a sentence about that. Raises StgaError."""
    capture = open_capture(folder, flame, principal_point)
    if capture.repair is None:
        return None
    write_repairs(capture.root, [capture.repair])
    return f"{capture.root / REPAIRS_FILE}: written: {REPAIRS[capture.repair].about}"


def _require_files(frames: Sequence[Frame]) -> None:
    """A missing file is reported now rather than an hour into the training."""
    checked = set[Path | None]()
    for frame in frames:
        for key, file in (
            ("file_path", frame.view.image),
            ("fg_mask_path", frame.view.mask),
            ("mesh_path", frame.mesh),
            ("flame_param_path", frame.flame),
        ):
            if file is not None and file not in checked and not is_file(file):
                raise StgaError(f"{file}: does not exist, but {frame.where} names it as its {key}")
            checked.add(file)


def _open_layout(root: Path, transforms: Transforms, flame: Path | None) -> Capture:
    frames = transforms.frames
    given = transforms.splits
    paths = [] if given else sorted(root.iterdir())
    bare = [p for p in paths if p.suffix.lower() in meshes.MESH_SUFFIXES and p.is_file()]
    if (root / CANONICAL_NAME).is_file() or any(frame.flame for frame in frames):
        return _open_flame_capture(root, transforms, flame)
    if any(frame.mesh for frame in frames):
        return _mesh_capture(root, "mesh", tracked_files(frames, "mesh"), transforms)
    if matching(root / "meshes", "mesh_*.json"):
        return _open_release(root, transforms)
    if bare and not is_gaussian_output(root):
        return _open_mesh_folder(root, bare)
    if not given and (root / PARAMETERS).is_dir():
        return _open_flame_capture(root, transforms, flame)
    expected = f"transforms_{'|'.join(SPLITS)}.json, transforms.json or meshes"
    if given:
        expected = "a frame with flame_param_path or mesh_path in the transforms"
    found = other_input(root)
    advice = f"; it {found.advice}" if found else ""
    raise StgaError(f"{root}: is not a capture; expected {expected}{advice}")


def _principal_point_warning(
    frames: Sequence[Frame], mesh: Callable[[int], np.ndarray], chosen: str
) -> str | None:
    """A warning where another convention puts clearly more of the mesh inside the masks of a few
    views. Vertices outside count: hair lies inside the mask but beside the mesh. None without
    Pillow, which Blender lacks."""
    apart = []
    outside = []
    for frame in frames:
        given = frame.view.camera
        cameras = [with_principal_point(given, frame.principal, name) for name in PRINCIPAL_POINTS]
        if (np.ptp([(camera.cx, camera.cy) for camera in cameras], axis=0) > 0.5).any():
            apart.append((frame.view, cameras))
    if not apart or find_spec("PIL") is None:
        return None
    from .images import read_mask

    for view, cameras in evenly_spread(apart, MAX_COMPARED_VIEWS):
        if (mask := read_mask(view)) is not None:
            points = mesh(view.timestep)
            fractions = []
            for camera in cameras:
                column, row, inside = pixels_of(points, camera)
                fractions.append(1 - float((inside & (mask[row, column] > 127)).mean()))
            outside.append(fractions)
    if not outside:
        return None
    fraction = dict(zip(PRINCIPAL_POINTS, np.mean(outside, axis=0).tolist(), strict=True))
    best = min(fraction, key=lambda convention: fraction[convention])
    if fraction[chosen] < 2 * fraction[best] + MIN_FRACTION_DIFFERENCE:
        return None
    return (
        f"{fraction[chosen]:.1%} of the mesh falls outside the masks with the principal point "
        f"read as {chosen!r}, but {fraction[best]:.1%} with {best!r}: the capture was probably "
        "written that way"
    )


def _mask_warnings(frames: Sequence[Frame]) -> list[str]:
    """What the masks of a few views hold instead of 0 to 255; nothing without Pillow, which Blender
    lacks."""
    views = [frame.view for frame in frames if frame.view.mask is not None]
    if not views or find_spec("PIL") is None:
        return []
    from .images import is_labeled, stored_mask

    masks = [stored_mask(view) for view in evenly_spread(views, MAX_COMPARED_VIEWS)]
    level = max(int(mask.max(initial=0)) for mask in masks)
    if level == 255:
        return []
    where = views[0].mask
    outside = "expected 255 inside the head, 0 outside"
    if level == 0:
        return [f"{where}: the masks are empty; {outside}"]
    if all(is_labeled(mask) for mask in masks if mask.any()):
        return [f"{where}: the masks hold only 0 and {level}, which is read as 255"]
    return [f"{where}: the masks hold nothing above {level}; {outside}"]


def _unnamed_images(frames: Sequence[Frame]) -> list[str]:
    """What lies beside the images of the frames, and none of them names."""
    views = [frame.view for frame in frames]
    named = {path for view in views for path in (view.image, view.mask)}
    found = []
    for folder in dict.fromkeys(view.image.parent for view in views):
        with naming(folder, "read"):
            paths = [folder / name for name in sorted(os.listdir(folder))]
        images = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
        left_out = [path for path in images if path not in named]
        if left_out:
            names = listed([path.name for path in left_out])
            counted = f"{len(left_out)} of {len(images)} images are named by no frame"
            found.append(f"{folder}: {counted}: {names}")
    return found


def _open_mesh_folder(root: Path, listed: Sequence[Path]) -> Capture:
    """Capture of layout "mesh" without views: a folder of meshes, one a timestep. Timesteps are the
    numbers at the end of the names, or the alphabetical order where a name has none. A mesh called
    `neutral` or `canonical` is the canonical one, and `regions.json` the regions file."""
    regions = root / "regions.json"
    canonical = next((path for path in listed if path.stem.lower() in NEUTRAL), None)
    tracked = [path for path in listed if path != canonical]
    if not tracked:
        raise StgaError(
            f"{root}: holds no tracked mesh besides {canonical}; expected one file per timestep"
        )
    numbers = [re.search(r"(\d+)$", path.stem, re.ASCII) for path in tracked]
    numbered = {int(match[1]): path for match, path in zip(numbers, tracked, strict=True) if match}
    files = dict(sorted(numbered.items()))
    files = files if len(files) == len(tracked) else dict(enumerate(tracked))
    whole = Transforms({}, canonical, regions if regions.is_file() else None)
    return _mesh_capture(root, "mesh", files, whole)


def _mesh_capture(
    root: Path,
    layout: str,
    files: dict[int, Path],
    transforms: Transforms,
    read: Callable[[Path], meshes.Mesh] = meshes.read_mesh,
) -> Capture:
    warnings = []
    canonical = transforms.canonical_mesh
    regions_file = transforms.regions
    if canonical is None:
        canonical, used = _neutral_beside(root, files[min(files)], read)
        warnings.append(
            f"no canonical mesh is given: {canonical.name}, {used}, is the neutral mesh"
        )
    neutral, faces = read(canonical)
    if any(path.suffix.lower() == ".stl" for path in (canonical, *files.values())):
        warnings.append(
            "STL has no shared vertices: of the topology, only the number of triangles can be "
            "checked"
        )
    if regions_file is not None:
        regions = meshes.read_regions(regions_file, faces, len(neutral))
    elif regions := found_regions(neutral, faces):
        warnings.append("no regions are given: eyes, mouth and nose are found on FLAME's mesh")
    empty = [name for name, members in regions.items() if not members.any()]
    if empty:
        warnings.append(f"{regions_file}: no triangle lies in {', '.join(empty)}")
    mesh = meshes.tracked_meshes(files, len(neutral), faces, canonical, read)
    return Capture(
        root=root,
        layout=layout,
        faces=faces,
        neutral=neutral,
        views=transforms.views,
        timesteps=tuple(files),
        regions=regions,
        mesh=mesh,
        expression_mesh=lambda timestep, zero_pose: without_head_motion(mesh(timestep), neutral),
        warnings=tuple(warnings),
    )


def _neutral_beside(
    root: Path, first: Path, read: Callable[[Path], meshes.Mesh]
) -> tuple[Path, str]:
    """A mesh called as a canonical one, as INSTA leaves it in the capture's folder, with the
    triangles of the first timestep's; else that one. With a few words about where it is from."""
    named = [
        folder / f"{name}{first.suffix}" for folder in (root, first.parent) for name in NEUTRAL
    ]
    for path in named:
        if path != first and is_file(path) and np.array_equal(read(path)[1], read(first)[1]):
            return path, "which lies there"
    return first, "the first timestep"


def _open_release(root: Path, transforms: Transforms) -> Capture:
    """Capture of layout "release": `meshes/mesh_%04d.json` and `training_faces/%04d.npy` by
    `keyframe`; without a neutral mesh and regions."""
    timesteps = sorted({frame.view.timestep for frame in transforms.frames})
    files = {timestep: root / "meshes" / f"mesh_{timestep:04d}.json" for timestep in timesteps}
    if not files:
        raise StgaError(
            f"{root}: its transforms hold no frame; expected a keyframe for each mesh in "
            f"{root / 'meshes'}"
        )
    bare = replace(transforms, canonical_mesh=None, regions=None)
    capture = _mesh_capture(root, "release", files, bare, read_soup)
    chosen = {t: root / "training_faces" / f"{t:04d}.npy" for t in timesteps}
    listed = {t: path for t, path in chosen.items() if path.is_file()}
    selection = {t: read_face_ids(path, len(capture.faces)) for t, path in listed.items()}
    return replace(capture, given_selection=selection)


def read_soup(path: Path) -> meshes.Mesh:
    """Vertices (3F, 3) and triangles (F, 3) from {"triangles": [{"Vertices": [[x, y, z], …]}, …]},
    meters. The layout has no shared vertices. Raises StgaError naming the file and the field."""
    document = read_json(path)
    try:
        corners = np.array([triangle["Vertices"] for triangle in document["triangles"]], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        corners = np.zeros(0)
    if corners.ndim != 3 or corners.shape[1:] != (3, 3):
        raise StgaError(
            f"{path}: triangles: expected a list of objects with three Vertices with three "
            "coordinates each"
        )
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return meshes.checked_mesh(path, corners.reshape(-1, 3), faces)


def read_face_ids(path: Path, faces: int) -> np.ndarray:
    """(F,) bool from a npy file of triangle numbers. Raises StgaError where they are no whole
    numbers below `faces`."""
    ids = read_npy(path)
    if ids.dtype.kind not in "iu" or ids.ndim != 1:
        raise StgaError(f"{path}: expected a list of triangle numbers")
    if ids.size and not 0 <= int(ids.min()) <= int(ids.max()) < faces:
        raise StgaError(
            f"{path}: names triangles {ids.min()} to {ids.max()}, but the mesh has 0 to {faces - 1}"
        )
    selected = np.zeros(faces, bool)
    selected[ids] = True
    return selected


def _open_flame_capture(root: Path, transforms: Transforms, model_file: Path | None) -> Capture:
    """Capture of layout "flame": `flame_param_path` per frame, else `flame_param/%05d.npz` by
    timestep; shape and static offset come from the first. A model with FLAME's published 5023
    vertices gets all parts, teeth as VHAP and GaussianAvatars have them."""
    model_file = _model_file(root, model_file)
    model = flame_model(model_file)
    frames = transforms.frames
    folder = root / PARAMETERS
    if any(frame.flame for frame in frames):
        files = tracked_files(frames, "flame")
    elif frames:
        timesteps = sorted({frame.view.timestep for frame in frames})
        files = {t: folder / f"{t:05d}.npz" for t in timesteps}
    else:
        listed = [p for p in matching(folder, "*.npz") if re.fullmatch(r"\d+", p.stem, re.ASCII)]
        files = dict(sorted((int(path.stem), path) for path in listed))
    if not files:
        raise StgaError(
            f"{folder}: holds no parameters; expected one .npz per timestep, such as 00000.npz"
        )
    first = files[min(files)]
    person = read_npz(first)
    shape, static_offset = read_identity(first, model, person)

    @lru_cache(meshes.cached_timesteps(len(model.v_template)))
    def frame(timestep: int) -> FlameFrame:
        path = meshes.file_of(files, timestep)
        return read_frame(path, model, person if path == first else None)

    sequence = FlameSequence(model, shape, static_offset, tuple(files), frame)
    return sequence_capture(root, sequence, model_file, transforms.views)


def with_sequence(capture: Capture, sequence: FlameSequence) -> Capture:
    """The FLAME capture with another motion of the same person, and the meshes that it makes."""
    return replace(capture, **_posed(capture.root, sequence))


def sequence_capture(
    root: Path, sequence: FlameSequence, model_file: Path | None, views: Views
) -> Capture:
    """The capture of layout "flame" whose meshes a sequence makes; where both are from."""
    model = sequence.model
    regions = key_regions(model)
    unmasked = []
    if not regions or model.has_found_masks:
        found = "eyes, mouth and nose are found on its mesh"
        used = found if regions else "triangles are selected one by one"
        unmasked = [f"the FLAME model has no vertex masks (FLAME_masks.pkl beside it): {used}"]
    return Capture(
        root=root,
        layout="flame",
        faces=model.faces,
        neutral=meshes.check_extent(f"{root}: neutral mesh", neutral_mesh(sequence)),
        views=views,
        timesteps=sequence.timesteps,
        regions=regions,
        flame_file=model_file,
        warnings=(*sequence.warnings, *unmasked),
        **_posed(root, sequence),
    )


def _posed(root: Path, sequence: FlameSequence) -> dict[str, Any]:
    """The fields of a capture that depend on its motion."""
    person = with_identity(sequence)

    def mesh(timestep: int) -> np.ndarray:
        vertices = sequence_mesh(person, timestep)
        return meshes.check_extent(f"{root}: timestep {timestep}", vertices)

    return {
        "mesh": meshes.cached_meshes(mesh, len(sequence.model.v_template)),
        "expression_mesh": partial(expression_mesh, person),
        "flame": sequence,
    }


def _model_file(root: Path, given: Path | None) -> Path:
    """The capture's bundled head, else the given FLAME model file, else the one in its folder.
    Raises StgaError where there is none: FLAME's license forbids passing it on."""
    if (root / BUNDLED_MODEL).is_file():
        return root / BUNDLED_MODEL
    beside = (root / name for name in CAPTURE_MODELS)
    found = given or next((path for path in beside if path.is_file()), None)
    if found is None:
        raise StgaError(
            f"{root}: is tracked with FLAME; give the FLAME model file (.pkl or .npz) with "
            "--flame or in the preferences of the add-on, or put it into the folder as "
            f"{CAPTURE_MODELS[0]}"
        )
    return found
