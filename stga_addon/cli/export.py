"""Export an avatar as a GaussianAvatars pair, a world-space PLY or a sequence of them."""

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.embedding import to_world
from ..avatar.file import Avatar
from ..avatar.ply import write_ply
from ..capture.model import Capture
from ..errors import StgaError
from ..jobs.delegate import OpenHead
from .arguments import add_avatar
from .inputs import check_topology, open_avatar

NAME, HELP = "export", "write an avatar in another format"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "avatar", "RUN|AVATAR", head)
    parser.add_argument("--format", choices=("gaussian-avatars", "ply", "ply-sequence"), required=True)
    parser.add_argument("--capture", type=Path, help="whose frames to bake (default: the run's)")
    parser.add_argument("--flame", type=Path, help="FLAME model file of that capture")
    parser.add_argument("--timestep", type=int, help="frame of a single PLY (default: the neutral mesh)")
    parser.add_argument("--out", type=Path, required=True)


def run(options: Namespace) -> None:
    avatar, capture = open_avatar(options.avatar, options)
    if capture is not None:
        check_topology(capture, avatar)
    export_avatar(avatar, capture, options.format, options.out, options.timestep)


def export_avatar(
    avatar: Avatar, capture: Capture | None, kind: str, out: Path, timestep: int | None = None
) -> list[Path]:
    """Write `avatar` as "ply" (one frame, or the neutral mesh), "ply-sequence" or "gaussian-avatars".

    Returns the files written.
    Raises StgaError where the capture that holds the frames is missing or has not what the format needs.
    """
    if kind == "gaussian-avatars":
        from ..avatar.gaussian_avatars import write_gaussian_avatars

        if capture is None or capture.flame is None:
            raise StgaError("the GaussianAvatars format needs the FLAME parameters of a FLAME capture; give --capture")
        write_gaussian_avatars(out, avatar, capture.flame)
        return [out / "point_cloud.ply", out / "flame_param.npz"]
    if kind == "ply" and timestep is None:
        write_ply(out, _baked(avatar, avatar.neutral))
        return [out]
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    wanted = capture.timesteps if kind == "ply-sequence" else (timestep,)
    files = []
    for number in wanted:
        if number not in capture.timesteps:
            raise StgaError(f"{capture.root}: has no timestep {number}")
        path = out / f"{number:05d}.ply" if kind == "ply-sequence" else out
        write_ply(path, _baked(avatar, capture.mesh(number)))
        files.append(path)
    return files


def _baked(avatar: Avatar, mesh: np.ndarray) -> Any:
    return to_world(avatar.splats, avatar.frames(mesh))
