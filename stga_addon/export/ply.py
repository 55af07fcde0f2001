"""3D Gaussians as PLY files, and GaussianAvatars' pair of bound splats and FLAME motion."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.embedding import FaceFrames, face_frames, to_local, to_world
from ..avatar.file import Avatar
from ..avatar.splats import MAX_SH_DEGREE, SH_C0, Splats, in_world
from ..capture.ply import ply_rows
from ..errors import StgaError
from ..files import (
    NumberedFiles,
    converted,
    read_bytes,
    replacing,
    replacing_together,
    save_npz,
)
from ..flame.sequence import FlameSequence, motion_arrays
from ..progress import Log, warn

MAX_SPLAT_BYTES = 16 << 30
"""Largest file of splats that is read."""
READ_FILES = "the folder of a run, an avatar (.npz), or splats (.ply, .spz, .splat)"
"""What messages expect where splats are read."""

CLOUDCOMPARE_PREFIX = "scalar_"
"""Prefix that CloudCompare writes before the names of other properties."""
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"))
"""Names of red, green and blue in point clouds, which stand in for missing f_dc_0 to f_dc_2."""

FRAME_NAME = re.compile(r"(\d{5,}|-\d{4,})\.ply")
"""Name of a frame of a sequence: 00012.ply."""
REST_COEFFICIENTS = 3 * ((MAX_SH_DEGREE + 1) ** 2 - 1)
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(REST_COEFFICIENTS)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(path: Path, world: Splats) -> None:
    """Write world-space splats in 3D Gaussian Splatting's PLY layout, binary, atomically.

    All float32 and before activation; normals zero; f_rest channel by channel, zero-padded to
    degree 3.
    """
    with replacing(path) as partial:
        save_columns(partial, PROPERTIES, splat_columns(world))


SplatFrames = Iterable[tuple[int, Splats]]
"""Splats in world space with the numbers of their frames."""


def write_ply_sequence(folder: Path, frames: SplatFrames) -> list[Path]:
    """Write numbered world-space splats as 00012.ply, … into `folder`, all or none; returns the
    files.

    They replace an earlier sequence, whose other files are removed once they are written; all else
    in the folder stays. Raises StgaError where a file cannot be written or removed, and, before,
    where the folder holds files with such names that this function did not write.
    """
    files = NumberedFiles(folder, FRAME_NAME)
    written = []
    with files.added_together() as new_file:
        for number, world in frames:
            written.append(folder / f"{number:05d}.ply")
            with new_file(written[-1]) as partial:
                save_columns(partial, PROPERTIES, splat_columns(world))
    return written


def ply_bytes(splats: Splats) -> int:
    """Size of a PLY file."""
    return 4 * len(PROPERTIES) * len(splats)


def read_ply(path: Path, log: Log = warn) -> Splats:
    """World-space splats of a 3D Gaussian Splatting PLY.

    Properties may stand in any order, beside others; red, green and blue may stand for f_dc_0…2;
    of harmonics above degree 3, and of flat splats' missing third scale, `log` gets a sentence.
    Values may be not finite. Raises StgaError naming the file and the property that is missing, and
    for splats that are packed, or bound to triangles.
    """
    vertices = _without_prefix(read_vertices(path))
    names = vertices.dtype.names or ()
    binding = next((name for name in names if name.startswith("binding")), None)
    if binding is not None:
        raise StgaError(
            f"{path}: has the property {binding}: these splats lie in the frames of a head's "
            "triangles, not in the world; render the run, or export it as --format ply"
        )
    return splats_of(path, vertices, log)


def _without_prefix(vertices: np.ndarray) -> np.ndarray:
    """The vertices without CloudCompare's prefix of all properties but positions and colors."""
    names = vertices.dtype.names or ()
    plain = [name.removeprefix(CLOUDCOMPARE_PREFIX) for name in names]
    if len(set(plain)) == len(plain):
        vertices = vertices.view()
        vertices.dtype.names = tuple(plain)
    return vertices


def splats_of(path: Path, vertices: np.ndarray, log: Log) -> Splats:
    """The splats of a PLY's vertices, as `read_ply` reads them, in the axes of the file."""
    names = set(vertices.dtype.names or ())
    rest = sum(1 for name in names if name.startswith("f_rest_"))
    size = math.isqrt(rest // 3 + 1)
    if rest != 3 * (size**2 - 1):
        raise StgaError(f"{path}: has {rest} f_rest properties, expected 0, 9, 24 or 45")
    channels = _columns(path, vertices, [f"f_rest_{i}" for i in range(rest)])
    channels = channels.reshape(len(vertices), 3, rest // 3).transpose(0, 2, 1)
    if size > MAX_SH_DEGREE + 1:
        log(f"{path}: harmonics of degree {size - 1} are cut at {MAX_SH_DEGREE}")
        channels = channels[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
    scales = [f"scale_{i}" for i in range(3)]
    flat = {"scale_0", "scale_1"} <= names and "scale_2" not in names
    log_scale = _columns(path, vertices, scales[:2] if flat else scales)
    if flat:
        log(f"{path}: has no scale_2: its splats are flat (2D Gaussian Splatting)")
        log_scale = np.pad(log_scale, ((0, 0), (0, 1)), constant_values=-np.inf)
    return in_world(
        _columns(path, vertices, ["x", "y", "z"]),
        _columns(path, vertices, [f"rot_{i}" for i in range(4)]),
        log_scale,
        _columns(path, vertices, ["opacity"])[:, 0],
        np.concatenate([_base_color(path, vertices)[:, None], channels], axis=1),
    )


def _base_color(path: Path, vertices: np.ndarray) -> np.ndarray:
    """(N, 3) coefficients of degree 0: f_dc_0…2, or those of red, green and blue."""
    names = vertices.dtype.names or ()
    colors = next((triple for triple in COLOR_NAMES if set(triple) <= set(names)), None)
    if "f_dc_0" in names or colors is None:
        return _columns(path, vertices, [f"f_dc_{i}" for i in range(3)])
    dtype = vertices.dtype[colors[0]]
    values = _columns(path, vertices, colors)
    if dtype.kind in "iu":
        values = values / np.iinfo(dtype).max
    elif values.max(initial=0) > 1:  # a color of a byte, written as a number
        values = values / 255
    return (values - 0.5) / SH_C0


def splat_columns(splats: Splats) -> np.ndarray:
    """(N, 62) float32 in the order of PROPERTIES."""
    count = len(splats)
    normals = np.zeros_like(splats.xyz)
    rest = np.zeros((count, 3, REST_COEFFICIENTS // 3), np.float32)
    rest[..., : splats.sh.shape[1] - 1] = splats.sh[:, 1:].transpose(0, 2, 1)
    parts = splats.xyz, normals, splats.sh[:, 0], rest.reshape(count, REST_COEFFICIENTS)
    return np.column_stack([*parts, splats.opacity, splats.log_scale, splats.rotation])


def _columns(path: Path, vertices: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(N, len(names)) float32. Raises StgaError where one is missing, naming what is there."""
    columns = np.empty((len(vertices), len(names)), np.float32)
    for i, name in enumerate(names):
        given = vertices.dtype.names or ()
        if name not in given:
            raise StgaError(
                f"{path}: has no property {name!r}, as a PLY of 3D Gaussians must; it has "
                f"{', '.join(given):.200}"
            )
        columns[:, i] = converted(vertices[name], np.float32)
    return columns


def save_columns(path: Path, names: Sequence[str], columns: np.ndarray) -> None:
    """Write (N, len(names)) float32 as a binary PLY, not atomically. Raises OSError."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(columns)}"]
    lines += [f"property float {name}" for name in names]
    with path.open("wb") as out:
        out.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        out.write(np.ascontiguousarray(columns, "<f4").data)  # tofile would not say why it failed


def read_vertices(path: Path) -> np.ndarray:
    """Structured array (N,) of a PLY file's vertices, binary or ASCII, one field a property.

    Raises StgaError where the file is missing, malformed, packed or shorter than its header states.
    """
    rows = ply_rows(path, read_bytes(path, MAX_SPLAT_BYTES), ["vertex"]).get("vertex")
    names = () if rows is None else rows.scalars.dtype.names
    if rows is None or not names:
        raise StgaError(f"{path}: PLY header describes no vertices")
    if any(name.startswith("packed_") for name in names):
        raise StgaError(
            f"{path}: is a compressed PLY (packed_position, …), as SuperSplat writes them; "
            "save it there as a plain PLY"
        )
    return rows.scalars


def write_gaussian_avatars(
    folder: Path, avatar: Avatar, sequence: FlameSequence | None
) -> list[Path]:
    """Write point_cloud.ply and flame_param.npz of GaussianAvatars' layout into `folder`, both or
    neither; returns them.

    Splats go out in the "gaussian_avatars" convention, all float32 and before activation, with the
    triangle as the float property binding_0. The motion holds every timestep of `sequence`, its
    static offset, and the dynamic offset that the viewer requires. Raises StgaError without a
    sequence, or where its mesh is not the avatar's.
    """
    if sequence is None:
        raise StgaError(f"{folder}: GaussianAvatars needs the FLAME parameters of a FLAME capture")
    if not np.array_equal(sequence.model.faces, avatar.faces):
        raise StgaError(
            f"{folder}: the avatar's mesh is not the FLAME model's ({len(avatar.faces)} and "
            f"{len(sequence.model.faces)} triangles), expected an avatar trained on this "
            "model's meshes"
        )
    splats = in_convention(avatar, "gaussian_avatars")
    columns = np.column_stack([splat_columns(splats), splats.face.astype(np.float32)])
    files = [folder / "point_cloud.ply", folder / "flame_param.npz"]
    with replacing_together() as new_file:
        with new_file(files[0]) as partial:
            save_columns(partial, [*PROPERTIES, "binding_0"], columns)
        with new_file(files[1]) as partial:
            save_npz(partial, motion_arrays(sequence, np.float32), compressed=True)
    return files


def in_convention(avatar: Avatar, convention: str) -> Splats:
    """The avatar's splats in the frames of another convention, at the same places on the neutral
    mesh.

    Both conventions have their origin at the centroid, which is left out for precision. On deformed
    triangles the conventions scale differently, and so do the splats. Driven offsets are left out:
    they are 0 on the neutral mesh.
    """
    splats = avatar.splats
    if convention == avatar.convention:
        return splats

    def frames(name: str) -> FaceFrames:
        found = face_frames(avatar.neutral, avatar.faces, avatar.neutral, name)
        return replace(found, origin=np.zeros_like(found.origin))

    return to_local(to_world(splats, frames(avatar.convention)), frames(convention), splats.face)
