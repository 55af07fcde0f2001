"""Opening captures in the layout of the STGA authors' release: triangle soups and selected triangles."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import read_json, read_npy
from .mesh_capture import rigid_free
from .meshes import checked_mesh, tracked_meshes
from .model import Capture, View


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
