"""Tracked meshes (OBJ, PLY, GLB, STL) in the file's order; regions of triangles."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..files import converted, read_bytes, read_json, read_npz
from ..flame.model import faces_within
from .camera import MAX_COORDINATE_M
from .glb import WIDTHS, allowed_numbers, glb_chunks
from .model import Capture
from .ply import ply_rows

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and triangles (F, 3)."""
MESH_SUFFIXES = (".obj", ".ply", ".glb", ".stl")
"""Suffixes of the mesh files that are read."""

PRIMITIVE_NUMBERS = 1000
"""Numbers that each primitive counts for: trimesh takes time even for a small one."""
CACHE_BYTES = 96 << 20
"""Memory for posed meshes: of a take of ten seconds, each is posed once."""
MAX_MESH_BYTES = 512 << 20
"""Largest mesh file that is read."""

MIN_EXTENT_M = 1e-9
"""A smaller mesh is a point: no shape to train on, and no scale to compare motion with."""
PLY_CORNERS = ("vertex_indices", "vertex_index")  # The names that writers give a face's list
SELECTED_WEIGHT = 0.5  # Least weight of a triangle that belongs to the region


def read_mesh(path: Path) -> Mesh:
    """Vertices (V, 3) float64 meters and triangles (F, 3) int32, in the file's order; polygons
    become fans. STL stores no shared vertices, so V is 3F there. A GLB's nodes are placed and
    joined. Raises StgaError naming the file where it is missing, malformed, not finite or without
    triangles, collapsed to a point or far outside of any scene."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise StgaError(f"{path}: is not a mesh; expected one of {', '.join(MESH_SUFFIXES)}")
    data = read_bytes(path, MAX_MESH_BYTES)
    if suffix == ".obj":
        return checked_mesh(path, *_parse_obj(path, data))
    if suffix == ".ply":
        return checked_mesh(path, *_parse_ply(path, data))
    return checked_mesh(path, *_parse_with_trimesh(path, data, suffix[1:]))


def checked_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh of the arrays, as float64 and int32. Raises StgaError as `read_mesh` does, if they are
    not a valid triangle mesh."""
    triples = all(array.ndim == 2 and array.shape[1] == 3 for array in (vertices, faces))
    if not triples or not len(faces):
        raise StgaError(
            f"{path}: holds no triangles; expected vertices with three coordinates, and triangles"
        )
    if not np.isfinite(vertices).all():
        raise StgaError(f"{path}: vertex {np.argwhere(~np.isfinite(vertices))[0, 0]} is not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise StgaError(
            f"{path}: a triangle names a vertex outside the {len(vertices)} that the file has"
        )
    vertices = np.array(vertices, np.float64)
    check_extent(str(path), vertices)
    return vertices, np.array(faces, np.int32)


def check_extent(source: str, vertices: np.ndarray) -> np.ndarray:
    """The same vertices (V, 3). Raises StgaError for a point, and for what lies far away."""
    if not np.abs(vertices).max() <= MAX_COORDINATE_M:  # also where it is not a number
        raise StgaError(
            f"{source}: the mesh reaches farther than {MAX_COORDINATE_M:g} m from the origin"
        )
    if np.ptp(vertices, axis=0).max() < MIN_EXTENT_M:
        raise StgaError(f"{source}: all vertices of the mesh lie in one point; expected a head")
    return vertices


def tracked_meshes(
    files: Mapping[int, Path],
    count: int,
    faces: np.ndarray,
    canonical: Path,
    read: Callable[[Path], Mesh],
) -> Callable[[int], np.ndarray]:
    """timestep -> its vertices (V, 3), parsed when called and cached. Raises StgaError where a file
    has not exactly the `count` vertices and the `faces` of the file `canonical`."""

    def mesh(timestep: int) -> np.ndarray:
        path = file_of(files, timestep)
        vertices, triangles = read(path)
        if triangles.shape != faces.shape:
            other = f"has {len(triangles)} triangles, but {canonical} has {len(faces)}"
        elif not np.array_equal(triangles, faces):
            row = int(np.argmax((triangles != faces).any(axis=1)))
            found = triangles[row].tolist()
            expected = faces[row].tolist()
            other = f"triangle {row} joins vertices {found}, but {expected} in {canonical}"
        elif len(vertices) != count:
            other = f"has {len(vertices)} vertices, but {canonical} has {count}"
        else:
            return vertices
        raise StgaError(f"{path}: {other}; the topology must not change")

    return cached_meshes(mesh, count)


def cached_meshes(mesh: Callable[[int], np.ndarray], vertices: int) -> Callable[[int], np.ndarray]:
    """The function with its latest results kept, read-only, within CACHE_BYTES."""

    @lru_cache(cached_timesteps(vertices))
    def kept(timestep: int) -> np.ndarray:
        result = mesh(timestep)
        result.setflags(write=False)
        return result

    return kept


def cached_timesteps(vertices: int) -> int:
    """How many timesteps with three float64 a vertex CACHE_BYTES hold."""
    return max(2, CACHE_BYTES // (24 * max(1, vertices)))


def file_of(files: Mapping[int, Path], timestep: int) -> Path:
    """The timestep's file. Raises StgaError where there is none, naming the range there is."""
    if timestep not in files:
        raise StgaError(
            f"timestep {timestep} has no tracked mesh; the capture has {min(files)} to {max(files)}"
        )
    return files[timestep]


def read_regions(path: Path, faces: np.ndarray, vertices: int) -> dict[str, np.ndarray]:
    """Region name -> (F,) bool from a JSON file of vertex indices: a triangle belongs when its
    three corners do. Raises StgaError naming the file and the region."""
    values = read_json(path)
    if not isinstance(values, dict):
        raise StgaError(f"{path}: expected an object: region name -> list of vertex indices")
    for name, value in values.items():
        ids = value if isinstance(value, list) else [None]
        if not all(type(index) is int and 0 <= index < vertices for index in ids):
            raise StgaError(
                f"{path}: {name}: expected a list of vertex indices from 0 to {vertices - 1}"
            )
    return {name: faces_within(faces, np.array(value, np.int64)) for name, value in values.items()}


def _parse_with_trimesh(path: Path, data: bytes, file_type: str) -> Mesh:
    try:
        import trimesh
    except ImportError as error:
        raise StgaError(
            f"{path}: reading {file_type.upper()} needs the Python package trimesh"
        ) from error
    try:
        if file_type == "glb":
            _check_glb(data)
        with np.errstate(all="ignore"):
            # From memory, so that a mesh cannot have other files (textures, buffers) read.
            options = {"skip_materials": True} if file_type == "glb" else {}
            stream = io.BytesIO(data)
            mesh = trimesh.load_mesh(stream, file_type=file_type, process=False, **options)
            return np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:  # trimesh's parsers raise any kind of error for a bad file
        raise StgaError(f"{path}: is not a readable {file_type.upper()} mesh ({error})") from error


def _check_glb(data: bytes) -> None:
    """Raises ValueError where accessors promise more than the file can hold, or nodes repeat more,
    which trimesh would allocate, and where nodes are no trees, which it would follow without end.
    """
    document, _ = glb_chunks(data)
    nodes = document.get("nodes", [])
    allowed = allowed_numbers(len(data))
    accessors = document.get("accessors", [])
    counts = [accessor["count"] for accessor in accessors]
    if any(type(count) is not int or not 0 <= count <= len(data) for count in counts):
        raise ValueError("an accessor counts more than the file can hold")
    widths = [WIDTHS[accessor["type"]] for accessor in accessors]
    numbers = sum(count * width for count, width in zip(counts, widths, strict=True))
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children):
        raise ValueError("its nodes are not trees")
    waiting = [root for scene in document.get("scenes", []) for root in scene.get("nodes", [])]
    for _ in range(len(nodes) + len(waiting)):
        if waiting:
            waiting += nodes[waiting.pop()].get("children", [])
    if waiting:
        raise ValueError("its nodes form a cycle")
    of_mesh = [_numbers(mesh, counts) for mesh in document.get("meshes", [])]
    numbers += sum(of_mesh) + sum(of_mesh[node["mesh"]] for node in nodes if "mesh" in node)
    if numbers > allowed:
        raise ValueError(
            f"its meshes hold {numbers} numbers, more than the {allowed} allowed to a file of "
            "this size"
        )


def _numbers(mesh: dict[str, Any], counts: Sequence[int]) -> int:
    """Numbers that a GLB's mesh holds, with what its primitives cost besides."""
    numbers = 0
    for primitive in mesh["primitives"]:
        numbers += PRIMITIVE_NUMBERS + 3 * counts[primitive["attributes"]["POSITION"]]
        numbers += counts[primitive["indices"]] if "indices" in primitive else 0
    return numbers


def _parse_ply(path: Path, data: bytes) -> Mesh:
    """With our own reader: trimesh splits the vertices where texture coordinates differ, and cannot
    read triangles mixed with other polygons, as Blender writes them."""
    rows = ply_rows(path, data, ["vertex", "face", "tristrips"])
    vertices = rows.get("vertex")
    faces = rows.get("face")
    names = () if vertices is None else vertices.scalars.dtype.names or ()
    if vertices is None or not {"x", "y", "z"} <= set(names):
        raise StgaError(f"{path}: has no vertices with x, y and z")
    lists = {} if faces is None else faces.lists
    corners = next((indices for name, indices in lists.items() if name in PLY_CORNERS), None)
    if corners is None:
        kind = "triangle strips" if "tristrips" in rows else "no polygons"
        raise StgaError(f"{path}: holds {kind}; expected faces with vertex_indices")
    points = np.stack([converted(vertices.scalars[axis], np.float64) for axis in "xyz"], axis=1)
    if (corners.lengths < 3).any():
        row = int((corners.lengths < 3).argmax())
        raise StgaError(f"{path}: face {row} has fewer than three corners")
    return points, converted(corners.values, np.int64)[_fans(corners.lengths)]


def _fans(counts: np.ndarray) -> np.ndarray:
    """(F, 3): which of the corners of polygons, one after another, are those of their triangles."""
    fan = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, fan)
    second = first + 1 + np.arange(fan.sum()) - np.repeat(np.cumsum(fan) - fan, fan)
    return np.stack([first, second, second + 1], axis=1)


def _parse_obj(path: Path, data: bytes) -> Mesh:
    """An own parser: trimesh regroups the vertices of an OBJ with several materials or objects."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    points = [n for n, line in enumerate(lines) if line.startswith((b"v ", b"v\t"))]
    polygons = [n for n, line in enumerate(lines) if line.startswith((b"f ", b"f\t"))]
    try:
        vertices = np.array([lines[n].split()[1:4] for n in points], np.float64)
    except ValueError as error:
        raise StgaError(f"{path}: a vertex line does not hold three numbers") from error
    text = b"\n".join([lines[n] for n in polygons])
    earlier = (0,) * len(polygons)
    if b"-" in text:
        earlier = tuple(np.searchsorted(points, polygons))
    try:
        faces = _triangles(text, earlier)
    except (ValueError, OverflowError) as error:
        raise StgaError(f"{path}: a face line is malformed ({error})") from error
    return vertices, faces


@lru_cache(maxsize=2)
def _triangles(text: bytes, earlier: tuple[int, ...]) -> np.ndarray:
    """(F, 3) of an OBJ's face lines, which all files of a sequence share; polygons as fans. OBJ
    counts vertices from 1 up, or backwards from the latest of each line's `earlier` ones."""
    corners = [line.split()[1:] for line in text.splitlines()]
    count = np.array([len(words) for words in corners], int)
    if (count < 3).any():
        raise ValueError("fewer than three corners")
    numbers = [int(word.partition(b"/")[0]) for words in corners for word in words]
    index = np.array(numbers, np.int64)
    if (index == 0).any():
        raise ValueError("vertex 0, but OBJ counts from 1")
    index = np.where(index > 0, index - 1, np.repeat(np.array(earlier, int), count) + index)
    return index[_fans(count)]


def is_region_file(name: str) -> bool:
    """Whether a region is named by its file."""
    return Path(name).suffix.lower() in (".npz", ".json")


def find_region(capture: Capture, name: str) -> np.ndarray:
    """(F,) bool: a region of the capture, a vertex mask of FLAME, or the triangles of a region
    file. Raises StgaError where there is none, or it holds no triangle."""
    masks = {} if capture.flame is None else capture.flame.model.masks
    path = Path(name)
    shape = (len(capture.faces),)
    if name in capture.regions:
        region = capture.regions[name]
    elif name in masks:
        region = faces_within(capture.faces, masks[name])
    elif path.suffix.lower() == ".npz":
        weights = read_npz(path, ("weights",)).get("weights", np.zeros(0, int))
        if weights.dtype not in (np.float32, np.float64, np.bool_) or weights.shape != shape:
            found = f"{weights.dtype} {weights.shape}" if weights.size else "no such array"
            raise StgaError(
                f"{path}: expected 'weights', one number from 0 to 1 per triangle {shape}, "
                f"found {found}"
            )
        region = weights >= SELECTED_WEIGHT
    elif path.suffix.lower() == ".json":
        regions = read_regions(path, capture.faces, len(capture.neutral))
        region = np.any([np.zeros(shape, bool), *regions.values()], axis=0)
    else:
        known = ", ".join(dict.fromkeys([*capture.regions, *masks])) or "none"
        raise StgaError(
            f"region '{name}': is neither a region of the capture ({known}) nor an .npz or "
            ".json file"
        )
    if not region.any():
        raise StgaError(f"region '{name}': holds no triangle")
    return region
