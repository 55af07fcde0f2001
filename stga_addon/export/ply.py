"""3D Gaussians as PLY files, and GaussianAvatars' pair of bound splats and FLAME motion."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.embedding import FaceFrames, face_frames, to_local, to_world
from ..avatar.file import Avatar
from ..avatar.splats import MAX_SH_DEGREE, Splats
from ..capture.ply import ply_rows
from ..errors import StgaError
from ..files import NumberedFiles, read_bytes, replacing, replacing_together, save_npz
from ..flame.sequence import FlameSequence, motion_arrays

MAX_PLY_BYTES = 16 << 30
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


def write_ply_sequence(folder: Path, frames: Iterable[tuple[int, Splats]]) -> list[Path]:
    """Write numbered world-space splats as 00012.ply, … into `folder`, all or none; returns the
    files.

    They replace an earlier sequence, whose other files are removed once they are written; all else
    in the folder stays. Raises StgaError where a file cannot be written or removed, and, before,
    where the folder holds files with such names that this function did not write.
    """
    files = NumberedFiles(folder, FRAME_NAME)
    written = []
    with replacing_together() as new_file:
        for number, world in frames:
            written.append(folder / f"{number:05d}.ply")
            with new_file(written[-1]) as partial:
                save_columns(partial, PROPERTIES, splat_columns(world))
    for path in written:
        files.add(path.name, path)
    files.finish()
    return written


def ply_bytes(splats: Splats) -> int:
    """Size of a PLY file."""
    return 4 * len(PROPERTIES) * len(splats)


def is_ply(path: Path) -> bool:
    """Whether a path is named as a PLY file."""
    return path.suffix.lower() == ".ply"


def read_ply(path: Path) -> Splats:
    """Read world-space splats from a 3D Gaussian Splatting PLY of SH degree 0 to 3.

    Properties may stand in any order, beside others. Raises StgaError naming the file and the
    property that is missing, not finite or truncated.
    """
    vertices = read_vertices(path)
    rest = sum(1 for name in vertices.dtype.names or () if name.startswith("f_rest_"))
    if rest not in [3 * (size**2 - 1) for size in range(1, MAX_SH_DEGREE + 2)]:
        raise StgaError(f"{path}: has {rest} f_rest properties, expected 0, 9, 24 or 45")
    count = len(vertices)
    sh = np.empty((count, 1 + rest // 3, 3), np.float32)
    sh[:, 0] = stack_columns(path, vertices, [f"f_dc_{i}" for i in range(3)])
    channels = stack_columns(path, vertices, [f"f_rest_{i}" for i in range(rest)])
    sh[:, 1:] = channels.reshape(count, 3, rest // 3).transpose(0, 2, 1)
    return Splats(
        xyz=stack_columns(path, vertices, ["x", "y", "z"]),
        rotation=stack_columns(path, vertices, [f"rot_{i}" for i in range(4)]),
        log_scale=stack_columns(path, vertices, [f"scale_{i}" for i in range(3)]),
        opacity=stack_columns(path, vertices, ["opacity"])[:, 0],
        sh=sh,
        face=np.zeros(count, np.int32),
        unbound=np.zeros(count, bool),
    )


def splat_columns(splats: Splats) -> np.ndarray:
    """(N, 62) float32 in the order of PROPERTIES."""
    count = len(splats)
    normals = np.zeros_like(splats.xyz)
    rest = np.zeros((count, 3, REST_COEFFICIENTS // 3), np.float32)
    rest[..., : splats.sh.shape[1] - 1] = splats.sh[:, 1:].transpose(0, 2, 1)
    parts = splats.xyz, normals, splats.sh[:, 0], rest.reshape(count, REST_COEFFICIENTS)
    return np.column_stack([*parts, splats.opacity, splats.log_scale, splats.rotation])


def stack_columns(path: Path, vertices: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(N, len(names)) float32. Raises StgaError where one is missing or not finite."""
    columns = np.empty((len(vertices), len(names)), np.float32)
    for i, name in enumerate(names):
        if name not in (vertices.dtype.names or ()):
            raise StgaError(f"{path}: has no property {name!r}, as a PLY of 3D Gaussians must")
        columns[:, i] = vertices[name]
    if not np.isfinite(columns).all():
        bad = names[int(np.argmin(np.isfinite(columns).all(axis=0)))]
        raise StgaError(f"{path}: property {bad!r} holds a value that is not finite")
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

    Raises StgaError where the file is missing, malformed, packed or shorter than its header says.
    """
    rows = ply_rows(path, read_bytes(path, MAX_PLY_BYTES), ["vertex"]).get("vertex")
    if rows is None or not rows.scalars.dtype.names:
        raise StgaError(f"{path}: PLY header describes no vertices")
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
        counts = f"{len(avatar.faces)} and {len(sequence.model.faces)} triangles"
        problem = f"the avatar's mesh is not the FLAME model's ({counts})"
        raise StgaError(f"{folder}: {problem}, expected an avatar trained on this model's meshes")
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
