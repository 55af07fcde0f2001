"""Render an avatar: one PNG per camera entry, a video of its motion, or a turntable."""

import itertools
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..avatar.file import read_avatar
from ..capture.camera import Camera, central_camera
from ..capture.camera_path import TURNTABLE_S, covered_angles, to_and_fro, turntable
from ..capture.model import View
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT, read_transforms
from ..errors import StgaError
from ..export.playback import DEFAULT_FPS, playback_fps
from ..export.ply import read_ply
from ..files import replacing
from ..flame.sequence import sequence_mesh
from ..requests.open_head import OpenHead
from .arguments import (
    add_avatar,
    add_device,
    add_principal_point,
    color,
    degrees,
    real_number,
    usable_path,
    whole_number,
)
from .inputs import avatar_path, open_avatar
from .motion import MOTION_HELP, add_motion_options, check_motion_options, open_avatar_motion

NAME, HELP = "render", "render an avatar as pictures, video or turntable"
AUTO = -1.0
"""Degrees of a turntable that covers what the cameras saw."""
MAX_TURNTABLE_IMAGES = 100_000


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "source", "RUN|AVATAR|PLY", head)
    output = parser.add_mutually_exclusive_group(required=True)
    output.add_argument("--out", type=usable_path, metavar="DIR", help="folder for PNGs")
    output.add_argument("--video", type=usable_path, metavar="FILE.mp4", help="every timestep from one camera, as MP4")
    parser.add_argument(
        "--cameras",
        type=usable_path,
        metavar="TRANSFORMS.json",
        help="one PNG per entry; for a video, where its camera is from (default: the capture)",
    )
    parser.add_argument(
        "--turntable", type=degrees, nargs="?", const=AUTO, metavar="DEGREES",
        help="move one camera around the head: 360 for a full turn, less to both sides (default: what cameras saw)",
    )  # fmt: skip
    parser.add_argument(
        "--camera", type=whole_number(0), metavar="INDEX", help="camera of the video (default: the central one)"
    )
    parser.add_argument(
        "--fps", type=real_number, help=f"frames per second of the video (default: the capture's, else {DEFAULT_FPS:g})"
    )
    parser.add_argument(
        "--seconds", type=real_number, metavar="S",
        help=f"least duration of a turntable (default {TURNTABLE_S:g}); shorter motion is repeated to and fro",
    )  # fmt: skip
    parser.add_argument("--capture", type=usable_path, help="whose meshes drive the avatar (default: the run's)")
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of that capture, or of the motion")
    parser.add_argument(
        "--motion",
        type=usable_path,
        metavar="FILE",
        help=f"{MOTION_HELP}; at every timestep of it from each camera",
    )
    add_motion_options(parser)
    add_device(parser)
    parser.add_argument("--background", type=color, default="white", help="white (default), black or R,G,B in 0…1")
    add_principal_point(parser, "what cy means in the file of --cameras (default: as in training; of a PLY vhap)")


def run(options: Namespace) -> None:
    from ..render.compose import Composer

    if options.video is not None and options.video.suffix.lower() != ".mp4":
        raise StgaError(f"{options.video}: a video's name ends in .mp4")
    _check_film_options(options)
    if options.motion is None:
        check_motion_options(options)
    if options.head is None:
        _check_mesh_options(options)
    if options.cameras is None and options.video is None and options.turntable is None:
        raise StgaError("--out needs --cameras, which says what to render, or --turntable")
    principal_point = options.principal_point or _principal_point(options.source)
    views = None
    if options.cameras is not None:
        views = [frame.view for frame in read_transforms(options.cameras, principal_point)]
    options.composer = Composer(options.device)
    options.composer.choose()
    subject = _subject(options) if options.motion is None else _reenacted(options)
    if options.video is not None or options.turntable is not None:
        _film(options, subject, subject.views if views is None else views)
    else:
        assert views is not None
        _write_pictures(options.out, subject, views if options.motion is None else _every_timestep(subject, views))


def _check_film_options(options: Namespace) -> None:
    """Fill in the defaults of a video and a turntable. Raises StgaError for an option that would have no effect,
    and for more images than a turntable may have."""
    turns = options.turntable is not None
    films = turns or options.video is not None
    for name, has_effect, needed, default in (
        ("camera", films, "--video or --turntable", None),
        ("fps", films, "--video or --turntable", None),
        ("seconds", turns, "--turntable", TURNTABLE_S),
    ):
        if getattr(options, name) is None:
            setattr(options, name, default)
        elif not has_effect:
            raise StgaError(f"--{name}: has no effect without {needed}")
    if turns:
        _turntable_images(options, options.fps or DEFAULT_FPS)  # before anything is read


def _check_mesh_options(options: Namespace) -> None:
    """Raise StgaError for an option on meshes or cameras that would have no effect."""
    if options.motion is not None and options.capture is not None:
        raise StgaError("--capture: cannot be combined with --motion, whose meshes drive the avatar")
    if options.principal_point is not None and options.cameras is None:
        raise StgaError("--principal-point: has no effect without --cameras")
    for name in ("capture", "flame"):
        if _is_ply(options.source) and options.motion is None and getattr(options, name) is not None:
            raise StgaError(f"--{name}: has no effect on {options.source}, whose splats follow no mesh")


def _is_ply(source: Path) -> bool:
    return source.suffix.lower() == ".ply"


@dataclass(frozen=True)
class _Subject:
    """What is rendered.

    image      view -> image (3, H, W)
    timesteps  of its motion, ascending; none where nothing moves
    center     of the head or splats at the first timestep, (3,) meters
    fps        at which it plays
    views      of its capture
    """

    image: Callable[[View], np.ndarray]
    timesteps: tuple[int, ...]
    center: Callable[[], np.ndarray]
    fps: float
    views: Sequence[View] = ()


def _write_pictures(folder: Path, subject: _Subject, views: list[View]) -> None:
    from PIL import Image
    from tqdm import tqdm

    from ..render.render import to_uint8

    names = unique_names([view.name for view in views])
    captured, target = {view.image for view in views}, folder.resolve()
    overwritten = next((name for name in names if target / name in captured), None)
    if overwritten is not None:
        raise StgaError(f"{folder / overwritten}: is an image of the capture; choose another --out")
    for view, name in zip(tqdm(views, desc="Rendering", unit="image"), names, strict=True):
        with replacing(folder / name) as partial:
            Image.fromarray(to_uint8(subject.image(view))).save(partial, format="PNG")


def _film(options: Namespace, subject: _Subject, views: Sequence[View]) -> None:
    """Write the subject's motion as one camera sees it, which stands still or orbits."""
    from tqdm import tqdm

    from ..render.render import to_uint8
    from ..render.video import sequence_writer, video_writer

    start = _chosen_camera(options, views)
    timesteps: Sequence[int] = subject.timesteps or (0,)
    path = [start] * len(timesteps)
    if options.turntable is not None:
        count = max(len(timesteps), _turntable_images(options, subject.fps), 1)
        timesteps = to_and_fro(timesteps, count)
        cameras = _turntable(options.turntable, start, views, subject.center(), count)
        path = [replace(start, camera=camera) for camera in cameras]
    path = [replace(view, timestep=timestep) for view, timestep in zip(path, timesteps, strict=True)]
    writer = sequence_writer(options.out) if options.video is None else video_writer(options.video, subject.fps)
    with writer as write:
        for view in tqdm(path, desc="Rendering", unit="image"):
            write(to_uint8(subject.image(view)))


def _turntable_images(options: Namespace, fps: float) -> int:
    """Images of --seconds. Raises StgaError for more than MAX_TURNTABLE_IMAGES."""
    images = float(options.seconds) * fps
    if images > MAX_TURNTABLE_IMAGES:
        asked = f"--seconds {options.seconds:g}: is {images:.0f} images at {fps:g} frames per second"
        raise StgaError(f"{asked}; expected up to {MAX_TURNTABLE_IMAGES}")
    return round(images)


def _turntable(turn: float, start: View, views: Sequence[View], center: np.ndarray, count: int) -> list[Camera]:
    """turn: degrees, or AUTO."""
    if turn == AUTO:
        angles = covered_angles([view.camera for view in views], start.camera, center)
    else:
        angles = -np.radians(turn) / 2, np.radians(turn) / 2
    return turntable(start.camera, center, count, angles)


def _chosen_camera(options: Namespace, views: Sequence[View]) -> View:
    """The first view of the camera to film with."""
    first = {view.camera_index: view for view in reversed(views)}
    if not first:
        raise StgaError(f"{options.source}: there is no camera to render from; give --cameras")
    if options.camera is None:
        indices = sorted(first)
        return first[indices[central_camera([first[index].camera for index in indices])]]
    if options.camera not in first:
        raise StgaError(f"--camera {options.camera}: there are only {', '.join(map(str, sorted(first)))}")
    return first[options.camera]


def _principal_point(source: Path) -> str:
    """The convention that the avatar was trained with; a PLY has none."""
    return DEFAULT_PRINCIPAL_POINT if _is_ply(source) else read_avatar(avatar_path(source)).principal_point


def _subject(options: Namespace) -> _Subject:
    """An avatar with its capture, or a plain world-space PLY."""
    from ..render.render import render, render_avatar

    if _is_ply(options.source):
        splats = read_ply(options.source)
        return _Subject(
            lambda view: render(splats, view.camera, options.background, composer=options.composer),
            (),
            lambda: np.median(splats.xyz, axis=0),
            playback_fps(None, options.fps),
        )
    avatar, capture = open_avatar(options.source, options)
    if capture is None:
        raise StgaError(f"{options.source}: an avatar needs the meshes of a capture to follow; give --capture")

    def mesh(view: View) -> np.ndarray:
        if view.timestep not in capture.timesteps:
            raise StgaError(f"{capture.root}: has no mesh for timestep {view.timestep}, which {view.name} asks for")
        return np.asarray(capture.mesh(view.timestep))

    return _Subject(
        lambda view: render_avatar(avatar, mesh(view), view.camera, options.background, options.composer),
        capture.timesteps,
        lambda: _middle(capture.mesh(capture.timesteps[0])),
        playback_fps(capture, options.fps),
        [view for views in capture.views.values() for view in views],
    )


def _reenacted(options: Namespace) -> _Subject:
    """An avatar moved by another person's motion."""
    from ..render.render import render_avatar

    if _is_ply(options.source):
        raise StgaError(f"{options.source}: is a PLY, whose splats are bound to no mesh that a motion could move")
    avatar = read_avatar(avatar_path(options.source))
    motion = open_avatar_motion(options, options.source, avatar)
    sequence = motion.sequence

    def mesh(timestep: int) -> np.ndarray:
        return sequence_mesh(sequence, timestep)

    return _Subject(
        lambda view: render_avatar(avatar, mesh(view.timestep), view.camera, options.background, options.composer),
        tuple(sequence.timesteps),
        lambda: _middle(mesh(sequence.timesteps[0])),
        options.fps or motion.fps or DEFAULT_FPS,
    )


def _middle(vertices: np.ndarray) -> np.ndarray:
    """(3,) center of the vertices' bounding box."""
    return np.asarray((vertices.min(0) + vertices.max(0)) / 2)


def _every_timestep(subject: _Subject, views: list[View]) -> list[View]:
    """Each timestep of the motion as the first pose of each camera sees it."""
    cameras = {view.camera_index: view for view in reversed(views)}
    return [
        replace(cameras[index], timestep=timestep, name=f"{timestep:05d}_{index:02d}")
        for timestep in subject.timesteps
        for index in sorted(cameras)
    ]


def unique_names(paths: list[str]) -> list[str]:
    """File names with the suffix .png; where entries share one, their folders become part of it, then a number."""
    pngs = [PurePosixPath(path).with_suffix(".png") for path in paths]
    names = [png.name for png in pngs]
    if len(set(names)) < len(names):
        names = ["_".join(part for part in png.parts if part not in ("..", "/")) for png in pngs]
    unique: dict[str, None] = {}
    for name in names:
        numbered = (f"{PurePosixPath(name).stem}_{n}.png" for n in itertools.count(2))
        unique[next(c for c in itertools.chain((name,), numbered) if c not in unique)] = None
    return list(unique)
