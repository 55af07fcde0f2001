"""Render an avatar from the cameras of a file, one PNG per camera entry, named like its file_path."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..avatar.file import read_avatar
from ..avatar.ply import read_ply
from ..capture.model import Capture, View
from ..capture.open import open_capture
from ..capture.transforms import read_transforms
from ..errors import StgaError
from ..files import replacing
from ..flame.motion import transferred_motion
from ..flame.sequence import sequence_mesh
from ..jobs.delegate import OpenHead
from .arguments import add_avatar, add_principal_point, color, usable_path
from .inputs import avatar_path, check_topology, open_avatar

NAME, HELP = "render", "render an avatar, one PNG per camera entry"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "source", "RUN|AVATAR|PLY", head)
    parser.add_argument("--cameras", type=usable_path, required=True, metavar="TRANSFORMS.json")
    parser.add_argument("--capture", type=usable_path, help="whose meshes drive the avatar (default: the run's)")
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of that capture, or of the motion")
    parser.add_argument(
        "--motion",
        type=usable_path,
        metavar="FILE",
        help="another person's FLAME motion (.npz, or a capture), at every timestep of it from each camera",
    )
    parser.add_argument("--out", type=usable_path, required=True, metavar="DIR")
    parser.add_argument("--background", type=color, default="white", help="white, black or R,G,B in 0…1")
    add_principal_point(parser)


def run(options: Namespace) -> None:
    from PIL import Image
    from tqdm import tqdm

    from ..raster.render import to_uint8

    principal_point = options.principal_point or _principal_point(options.source)
    views = [frame.view for frame in read_transforms(options.cameras, principal_point)]
    if options.motion is None:
        render = _renderer(options)
    else:
        render, views = _reenactment(options, views)
    names = _unique_names([view.name for view in views])
    for view, name in zip(tqdm(views, desc="Rendering", unit="image"), names, strict=True):
        with replacing(options.out / name) as partial:
            Image.fromarray(to_uint8(render(view))).save(partial, format="PNG")


def _principal_point(source: Path) -> str:
    """The convention that the avatar was trained with; a PLY has none."""
    return "vhap" if source.suffix.lower() == ".ply" else read_avatar(avatar_path(source)).principal_point


def _renderer(options: Namespace) -> Callable[[View], np.ndarray]:
    """View -> image (3, H, W), for an avatar with its capture or a plain world-space PLY."""
    from ..raster.render import render, render_avatar

    if options.source.suffix.lower() == ".ply":
        splats = read_ply(options.source)
        return lambda view: render(splats, view.camera, options.background)
    avatar, capture = open_avatar(options.source, options)
    if capture is None:
        raise StgaError(f"{options.source}: an avatar needs the meshes of a capture to follow; give --capture")
    return lambda view: render_avatar(avatar, _mesh(capture, view), view.camera, options.background)


def _reenactment(options: Namespace, views: list[View]) -> tuple[Callable[[View], np.ndarray], list[View]]:
    """An avatar moved by another person's FLAME motion; each timestep is seen from the first pose of each camera."""
    from ..raster.render import render_avatar
    from ..training.run.folder import read_run

    if options.source.suffix.lower() == ".ply":
        raise StgaError(f"{options.source}: is a PLY, whose splats are bound to no mesh that a motion could move")
    flame = options.flame or (read_run(options.source).flame if options.source.is_dir() else None)
    avatar = read_avatar(avatar_path(options.source))
    motion = open_capture(options.motion, flame)
    if motion.flame is None:
        raise StgaError(f"{options.motion}: was not tracked with FLAME, so it has no parameters of expression and pose")
    check_topology(motion, avatar)
    sequence = transferred_motion(motion.flame, avatar.neutral)
    cameras = {view.camera_index: view for view in reversed(views)}
    placed = [
        replace(cameras[index], timestep=timestep, name=f"{timestep:05d}_{index:02d}")
        for timestep in sequence.timesteps
        for index in sorted(cameras)
    ]
    background = options.background
    return lambda view: render_avatar(avatar, sequence_mesh(sequence, view.timestep), view.camera, background), placed


def _mesh(capture: Capture, view: View) -> np.ndarray:
    if view.timestep not in capture.timesteps:
        raise StgaError(f"{capture.root}: has no mesh for timestep {view.timestep}, which {view.name} asks for")
    return np.asarray(capture.mesh(view.timestep))


def _unique_names(paths: list[str]) -> list[str]:
    """File names with the suffix .png; where entries share one, their folders become part of it, then a number."""
    pngs = [PurePosixPath(path).with_suffix(".png") for path in paths]
    names = [png.name for png in pngs]
    if len(set(names)) < len(names):
        names = ["_".join(part for part in png.parts if part not in ("..", "/")) for png in pngs]
    unique: list[str] = []
    for name in names:
        candidates = (name, *(f"{PurePosixPath(name).stem}_{n}.png" for n in range(2, len(names) + 2)))
        unique.append(next(c for c in candidates if c not in unique))
    return unique
