"""Tracked meshes on disk: OBJ, PLY, GLB and STL with the file's own order of vertices and triangles."""

import io
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..files import read_json
from ..flame.masks import faces_within

MESH_SUFFIXES = (".obj", ".ply", ".glb", ".stl")
CACHE_BYTES = 64 << 20


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 metres and triangles (F, 3) int32, in the file's order; polygons become fans.

    STL stores no shared vertices, so V is 3F there. A GLB's nodes are placed and joined.
    Raises StgaError naming the file where it is missing, malformed, not finite or without triangles.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise StgaError(f"{path}: is not a mesh; expected one of {', '.join(MESH_SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    vertices, faces = _parse_obj(path, data) if suffix == ".obj" else _parse_with_trimesh(path, data, suffix[1:])
    return checked_mesh(path, vertices, faces)


def checked_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same arrays as float64 and int32. Raises StgaError where they are no mesh (`read_mesh`)."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise StgaError(f"{path}: holds no triangles; expected vertices with three coordinates, and triangles")
    if not np.isfinite(vertices).all():
        raise StgaError(f"{path}: vertex {np.argwhere(~np.isfinite(vertices))[0, 0]} is not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise StgaError(f"{path}: a triangle names a vertex outside the {len(vertices)} that the file has")
    return np.array(vertices, np.float64), np.array(faces, np.int32)


def tracked_meshes(
    files: Mapping[int, Path], faces: np.ndarray, canonical: Path, read: Callable[[Path], tuple[np.ndarray, np.ndarray]]
) -> Callable[[int], np.ndarray]:
    """timestep -> its vertices (V, 3), parsed when called and kept while they fit the cache.

    Raises StgaError where a file's triangles are not exactly `faces`, those of the file `canonical`.
    """

    def mesh(timestep: int) -> np.ndarray:
        path = file_of(files, timestep)
        vertices, own = read(path)
        if own.shape != faces.shape:
            raise StgaError(
                f"{path}: has {len(own)} triangles, but {canonical} has {len(faces)}; the topology must not change"
            )
        if not np.array_equal(own, faces):
            different = int(np.argmax((own != faces).any(axis=1)))
            raise StgaError(
                f"{path}: triangle {different} joins vertices {own[different].tolist()}, "
                f"but {faces[different].tolist()} in {canonical}; the topology must not change"
            )
        return vertices

    return remembered(mesh, len(faces))


def remembered(mesh: Callable[[int], np.ndarray], vertices: int) -> Callable[[int], np.ndarray]:
    """The same function with its latest results kept, read-only, within 64 MiB; `vertices` says how large one is."""

    @lru_cache(maxsize=max(2, CACHE_BYTES // (24 * max(1, vertices))))
    def kept(timestep: int) -> np.ndarray:
        result = mesh(timestep)
        result.setflags(write=False)
        return result

    return kept


def file_of(files: Mapping[int, Path], timestep: int) -> Path:
    """The timestep's file. Raises StgaError where there is none, naming the range there is."""
    if timestep not in files:
        raise StgaError(f"timestep {timestep} has no tracked mesh; the capture has {min(files)} to {max(files)}")
    return files[timestep]


def read_regions(path: Path, faces: np.ndarray, vertices: int) -> dict[str, np.ndarray]:
    """Region name -> (F,) bool from a JSON file of vertex indices: a triangle belongs when its three corners do.

    Raises StgaError naming the file and the region.
    """
    values = read_json(path)
    if not isinstance(values, dict):
        raise StgaError(f"{path}: expected an object: region name -> list of vertex indices")
    return {name: faces_within(faces, _indices(path, name, value, vertices)) for name, value in values.items()}


def _indices(path: Path, name: str, value: Any, vertices: int) -> np.ndarray:
    if not isinstance(value, list) or not all(type(index) is int and 0 <= index < vertices for index in value):
        raise StgaError(f"{path}: {name}: expected a list of vertex indices from 0 to {vertices - 1}")
    return np.array(value, np.int64)


def _parse_with_trimesh(path: Path, data: bytes, file_type: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        import trimesh
    except ImportError as error:
        raise StgaError(f"{path}: reading {file_type.upper()} needs the Python package trimesh") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            # From memory, so that a mesh cannot name further files (textures, buffers) to be read.
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type=file_type, process=False)
            return np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:  # trimesh's parsers fail with whatever they stumble on; all of it means a bad file.
        raise StgaError(f"{path}: is not a readable {file_type.upper()} mesh ({error})") from error


def _parse_obj(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """trimesh cannot keep an OBJ's order once it has several materials or objects: it regroups and splits vertices."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    try:
        vertices = np.array([line.split()[1:4] for line in lines if line[:2] in (b"v ", b"v\t")], dtype=np.float64)
    except ValueError as error:
        raise StgaError(f"{path}: a vertex line does not hold three numbers") from error
    triangles: list[list[int]] = []
    count = 0
    try:
        for line in lines:
            kind = line[:2]
            if kind in (b"v ", b"v\t"):
                count += 1
            elif kind in (b"f ", b"f\t"):
                corners = [_corner(word, count) for word in line.split()[1:]]
                if len(corners) < 3:
                    raise ValueError("fewer than three corners")
                triangles += ([corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1))
        return vertices.reshape(-1, vertices.shape[-1]), np.array(triangles, np.int64).reshape(-1, 3)
    except (ValueError, OverflowError) as error:
        raise StgaError(f"{path}: a face line is malformed ({error})") from error


def _corner(word: bytes, count: int) -> int:
    """Vertex index from 0 up: OBJ counts from 1, and backwards from the latest vertex where negative."""
    index = int(word.partition(b"/")[0])
    if index == 0:
        raise ValueError("vertex 0, but OBJ counts from 1")
    return index - 1 if index > 0 else count + index
