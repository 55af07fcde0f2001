"""Export an avatar as a GaussianAvatars pair, a world-space PLY or a sequence of them."""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator

import numpy as np

from ..avatar.export import FORMATS, export_avatar
from ..avatar.file import Avatar
from ..capture.model import Capture
from ..errors import StgaError
from ..jobs.delegate import OpenHead
from .arguments import add_avatar, usable_path, whole_number
from .inputs import open_avatar

NAME, HELP = "export", "write an avatar in another format"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "avatar", "RUN|AVATAR", head)
    parser.add_argument("--format", choices=FORMATS, required=True)
    parser.add_argument("--capture", type=usable_path, help="whose frames to bake (default: the run's)")
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of that capture")
    parser.add_argument("--timestep", type=whole_number(0), help="frame of a single PLY (default: the neutral mesh)")
    parser.add_argument("--out", type=usable_path, required=True)


def run(options: Namespace) -> None:
    avatar, capture = open_avatar(options.avatar, options)
    sequence = None if capture is None else capture.flame
    export_avatar(options.out, avatar, options.format, _posed_meshes(avatar, capture, options), sequence)


def _posed_meshes(avatar: Avatar, capture: Capture | None, options: Namespace) -> Iterator[tuple[int, np.ndarray]]:
    """(timestep, mesh) to export: all of a sequence, the one that was asked for, or the neutral mesh."""
    if options.format == "ply" and options.timestep is None:
        yield 0, avatar.neutral
        return
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    for timestep in capture.timesteps if options.format == "ply-sequence" else (options.timestep,):
        if timestep not in capture.timesteps:
            raise StgaError(f"{capture.root}: has no timestep {timestep}")
        yield timestep, capture.mesh(timestep)
