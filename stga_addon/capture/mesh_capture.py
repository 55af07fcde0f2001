"""Opening captures and bare sequences of tracked meshes of any topology."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..errors import StgaError
from .meshes import MESH_SUFFIXES, read_mesh, read_regions, tracked_meshes
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
