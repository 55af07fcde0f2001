"""GaussianAvatars' pair of files: splats bound to triangles, and the FLAME motion that drives them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.embedding import face_frames, strained_sh, to_local, to_world
from ..avatar.file import Avatar
from ..avatar.splats import Splats, no_strain_color
from ..errors import StgaError
from ..files import replacing_together, save_npz
from ..flame.sequence import FlameSequence, motion_arrays
from .ply import PROPERTIES, save_columns, splat_columns

PLY_NAME = "point_cloud.ply"
MOTION_NAME = "flame_param.npz"
BINDING = "binding_0"


def write_gaussian_avatars(folder: Path, avatar: Avatar, sequence: FlameSequence | None) -> list[Path]:
    """Write point_cloud.ply and flame_param.npz of GaussianAvatars' layout into `folder`, both or neither.

    Splats go out in the "gaussian_avatars" convention, all float32 and before activation, with the triangle as the
    float property binding_0. The motion holds every timestep of `sequence`, its static offset, and the dynamic
    offset that the viewer requires. Returns the two files. Raises StgaError without a sequence, or where its mesh is
    not the avatar's.
    """
    if sequence is None:
        raise StgaError(f"{folder}: the GaussianAvatars format needs the FLAME parameters of a FLAME capture")
    if not np.array_equal(sequence.model.faces, avatar.faces):
        raise StgaError(
            f"{folder}: the avatar's mesh ({len(avatar.faces)} triangles) is not the FLAME model's "
            f"({len(sequence.model.faces)}), expected an avatar trained on this model's meshes"
        )
    splats = in_convention(avatar, "gaussian_avatars")
    columns = np.column_stack([splat_columns(splats), splats.face.astype(np.float32)])
    with replacing_together() as new_file:
        with new_file(folder / PLY_NAME) as partial:
            save_columns(partial, [*PROPERTIES, BINDING], columns)
        with new_file(folder / MOTION_NAME) as partial:
            save_npz(partial, motion_arrays(sequence, np.float32), compressed=True)
    return [folder / PLY_NAME, folder / MOTION_NAME]


def in_convention(avatar: Avatar, convention: str) -> Splats:
    """The avatar's splats in the frames of another convention, at the same places on the neutral mesh.

    Both conventions have their origin at the centroid, which is left out for precision. On deformed triangles the
    conventions scale differently, and so do the splats. What follows strain is that of the neutral mesh.
    """
    splats = avatar.splats
    if splats.strain_color.shape[1]:
        sh = strained_sh(splats, avatar.frames(avatar.neutral))
        splats = replace(splats, sh=sh, strain_color=no_strain_color(len(sh)))
    if convention == avatar.convention:
        return splats
    here, there = (
        replace(frames, origin=np.zeros_like(frames.origin))
        for frames in (
            face_frames(avatar.neutral, avatar.faces, avatar.neutral, name) for name in (avatar.convention, convention)
        )
    )
    return to_local(to_world(splats, here), there, splats.face)
