"""Opening captures of tracked meshes: with cameras, as a bare sequence, or in the layout of the authors' release."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import read_json, read_npy
from .meshes import MESH_SUFFIXES, checked_mesh, read_mesh, read_regions, tracked_meshes
from .model import Capture, View
from .rigid import without_head_motion
from .transforms import Transforms, tracked_files

NEUTRAL_NAMES = ("neutral", "canonical")
REGIONS_NAME = "regions.json"


def open_mesh_capture(root: Path, transforms: Transforms, views: Mapping[str, tuple[View, ...]]) -> Capture:
    """Capture of layout "mesh": `mesh_path` per frame, `canonical_mesh_path` and `regions_path` at the top level.

    Only the canonical mesh is read now, the others when they are needed. Raises StgaError.
    """
    files = tracked_files(transforms.frames, "mesh")
    return _mesh_capture(root, files, transforms.canonical_mesh, transforms.regions, views)


def open_mesh_folder(root: Path) -> Capture:
    """Capture of layout "mesh" without views: a folder of meshes, one a timestep.

    Timesteps are the numbers at the end of the names, or the alphabetical order where a name has none. A mesh called
    `neutral` or `canonical` is the canonical one, and `regions.json` the regions file. Raises StgaError.
    """
    meshes = mesh_files(root)
    canonical = next((path for path in meshes if path.stem.lower() in NEUTRAL_NAMES), None)
    tracked = [path for path in meshes if path != canonical]
    if not tracked:
        raise StgaError(f"{root}: holds no tracked mesh besides {canonical}; expected one file per timestep")
    regions = root / REGIONS_NAME
    return _mesh_capture(root, _by_number(tracked), canonical, regions if regions.is_file() else None, {})


def mesh_files(folder: Path) -> list[Path]:
    """The meshes directly in a folder, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES and path.is_file())


def rigid_free(mesh: Callable[[int], np.ndarray], neutral: np.ndarray) -> Callable[[int, str], np.ndarray]:
    """`Capture.expression_mesh` for meshes without parameters, which ignores the choice of zero pose."""
    return lambda timestep, zero_pose: without_head_motion(mesh(timestep), neutral)


def _mesh_capture(
    root: Path,
    files: dict[int, Path],
    canonical: Path | None,
    regions_file: Path | None,
    views: Mapping[str, tuple[View, ...]],
) -> Capture:
    warnings = []
    if canonical is None:
        canonical = files[min(files)]
        warnings.append(f"no canonical mesh is given: {canonical.name}, the first timestep, is the neutral mesh")
    neutral, faces = read_mesh(canonical)
    if any(path.suffix.lower() == ".stl" for path in (canonical, *files.values())):
        warnings.append("STL has no shared vertices: of the topology, only the number of triangles can be checked")
    regions = {} if regions_file is None else read_regions(regions_file, faces, len(neutral))
    empty = [name for name, members in regions.items() if not members.any()]
    if empty:
        warnings.append(f"{regions_file}: no triangle lies in {', '.join(empty)}")
    mesh = tracked_meshes(files, len(neutral), faces, canonical, read_mesh)
    return Capture(
        root=root,
        layout="mesh",
        faces=faces,
        neutral=neutral,
        views=views,
        timesteps=tuple(files),
        regions=regions,
        mesh=mesh,
        expression_mesh=rigid_free(mesh, neutral),
        warnings=tuple(warnings),
    )


def _by_number(paths: list[Path]) -> dict[int, Path]:
    numbers = [re.search(r"(\d+)$", path.stem, re.ASCII) for path in paths]
    numbered = {int(match[1]): path for match, path in zip(numbers, paths, strict=True) if match}
    return dict(sorted(numbered.items())) if len(numbered) == len(paths) else dict(enumerate(paths))


def is_release(root: Path) -> bool:
    """Whether the folder holds `meshes/mesh_*.json`."""
    return next((root / "meshes").glob("mesh_*.json"), None) is not None


def open_release(root: Path, views: Mapping[str, tuple[View, ...]]) -> Capture:
    """Capture of layout "release": `meshes/mesh_%04d.json` and `training_faces/%04d.npy` by `keyframe`.

    The layout names neither a neutral mesh nor regions. Raises StgaError naming the file and the field.
    """
    timesteps = sorted({view.timestep for split in views.values() for view in split})
    files = {timestep: root / "meshes" / f"mesh_{timestep:04d}.json" for timestep in timesteps}
    if not files:
        raise StgaError(f"{root}: its transforms hold no frame; expected a keyframe for each mesh in {root / 'meshes'}")
    canonical = files[timesteps[0]]
    neutral, faces = read_soup(canonical)
    mesh = tracked_meshes(files, len(neutral), faces, canonical, read_soup)
    chosen = {timestep: root / "training_faces" / f"{timestep:04d}.npy" for timestep in timesteps}
    return Capture(
        root=root,
        layout="release",
        faces=faces,
        neutral=neutral,
        views=views,
        timesteps=tuple(timesteps),
        regions={},
        mesh=mesh,
        expression_mesh=rigid_free(mesh, neutral),
        given_selection={t: read_face_ids(path, len(faces)) for t, path in chosen.items() if path.is_file()},
        warnings=(f"the layout has no canonical mesh: {canonical.name}, the first timestep, is the neutral mesh",),
    )


def read_soup(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (3F, 3) and triangles (F, 3) from {"triangles": [{"Vertices": [[x, y, z], …]}, …]}, meters.

    The layout has no shared vertices. Raises StgaError naming the file and the field.
    """
    document = read_json(path)
    try:
        corners = np.array([triangle["Vertices"] for triangle in document["triangles"]], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StgaError(f"{path}: triangles: expected a list of objects with Vertices, three points each") from error
    if corners.ndim != 3 or corners.shape[1:] != (3, 3):
        raise StgaError(f"{path}: triangles: expected three Vertices with three coordinates each in every triangle")
    return checked_mesh(path, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def read_face_ids(path: Path, faces: int) -> np.ndarray:
    """(F,) bool from a npy file of triangle numbers. Raises StgaError where they are no whole numbers below `faces`."""
    ids = read_npy(path)
    if ids.dtype.kind not in "iu" or ids.ndim != 1:
        raise StgaError(f"{path}: expected a list of triangle numbers")
    if ids.size and not 0 <= int(ids.min()) <= int(ids.max()) < faces:
        raise StgaError(f"{path}: names triangles {ids.min()} to {ids.max()}, but the mesh has 0 to {faces - 1}")
    selected = np.zeros(faces, bool)
    selected[ids] = True
    return selected
