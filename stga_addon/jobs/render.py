"""Rendering of an avatar or a PLY: a PNG per camera entry, a video of its motion, a turntable."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.camera import TURNTABLE_S, central_camera, covered_angles, to_and_fro, turntable
from ..capture.distortion import distortion
from ..capture.model import View
from ..capture.transforms import read_transforms
from ..driving.open_motion import MotionOptions
from ..driving.performers import is_performance
from ..errors import StgaError
from ..export.playback import DEFAULT_FPS, playback_fps
from ..export.splat_files import is_splats, read_splats
from ..files import is_file, replacing
from ..flame.sequence import sequence_mesh
from ..light.environment import read_lighting, turned
from ..light.relight import Relighter
from ..options import When, like, option
from ..progress import Log, Report, Written, counted
from ..raster.posed_splats import PosedSplats
from ..render.composer import Composer
from ..render.video import sequence_writer, video_writer
from ..schema import setting
from ..tracking.footage.json_cameras import is_gaussian_cameras, read_gaussian_cameras
from ..tracking.footage.nerfstudio import written_convention
from ..training.run.folder import WORLD_FILE
from . import avatar_source
from .train import Train

MAX_TURNTABLE_IMAGES = 100_000


def _is_head(value: Any) -> bool:
    return value.source is None or not is_splats(value.source)


HEAD = When(_is_head, "on {source}, which holds splats in the world, bound to no head")
PLAYED = When(
    lambda value: (
        value.video
        or value.turntable is not None
        or (value.motion and is_performance(value.motion))
    ),
    "without --video, --turntable or a face performance as --motion",
)
MESHES = When(
    lambda value: value.motion is None or value.cameras is None,
    "with --motion and --cameras, which say what is rendered",
)
TIMESTEPS = When(
    lambda value: value.turntable is None, "with --turntable, which plays all of the motion"
)


@dataclass(frozen=True)
class Render:
    """Render an avatar: one PNG per camera entry, a video of its motion, or a turntable.

    output    an .mp4 file where `video` is set, else a folder for PNGs
    others    as of `avatar_source.Posed`
    """

    source: Path = option("folder of a run, avatar file or PLY", flag="RUN|AVATAR|PLY")
    output: Path = setting()
    video: bool = False
    cameras: Path | None = option(
        "one PNG per entry; for a video, where its camera is from (default: the capture)",
        None,
        metavar="TRANSFORMS.json",
    )
    turntable: float | None = option(
        "move one camera around the head: 360 for a full turn, less to both sides (default: what "
        "cameras saw)",
        None,
        0,
        360,
        metavar="DEGREES",
        bare=0.0,
    )
    camera: int | None = option(
        "camera of the video (default: the central one)",
        None,
        0,
        metavar="INDEX",
        needs=(("video", "turntable"),),
    )
    fps: float | None = option(
        f"frames per second of the video (default: the capture's, else {DEFAULT_FPS:g})",
        None,
        0,
        needs=(PLAYED,),
    )
    seconds: float = option(
        f"least duration of a turntable (default {TURNTABLE_S:g}); shorter motion is repeated to "
        "and fro",
        TURNTABLE_S,
        0,
        metavar="S",
        needs=("turntable",),
    )
    frames: tuple[int, int] | None = option(
        "timesteps to render (default: all), not of a turntable",
        None,
        0,
        metavar="FIRST:LAST",
        needs=(TIMESTEPS,),
    )
    capture: Path | None = option(
        "whose meshes drive the avatar, or cameras see the motion (default: the run's)",
        None,
        needs=(HEAD, MESHES),
    )
    flame: Path | None = like(
        Train, "flame", help="FLAME model file of that capture, or of the motion", needs=(HEAD,)
    )
    motion: Path | None = avatar_source.motion_field(HEAD)
    played: avatar_source.Played | None = None
    background: tuple[float, float, float] = option(
        "white (default), black or R,G,B in 0…1", (1.0, 1.0, 1.0), 0, 1
    )
    principal_point: str | None = like(
        Train,
        "principal_point",
        default=None,
        needs=("cameras",),
        help="what cy means in the file of --cameras (default: as in training; with splats, as "
        "the program of the file writes it)",
    )
    device: str = like(Train, "device")
    motion_options: MotionOptions = avatar_source.motion_options_field("motion")
    light: Path | None = option(
        "environment (.hdr) or lights (.toml) that light the avatar",
        None,
        metavar="FILE",
        needs=(HEAD,),
    )
    light_turn: float = option(
        "turn that light around the head during the video",
        0.0,
        -36000,
        36000,
        metavar="DEGREES",
        needs=("light", ("video", "turntable")),
    )
    world: bool = option(
        "put the run's world behind the avatar (train with --effect world=on)",
        False,
        needs=(HEAD,),
    )

    @property
    def is_film(self) -> bool:
        """Whether one camera sees the motion, instead of a picture per camera."""
        return self.video or self.turntable is not None

    def check(self) -> None:
        """Raise StgaError for a video of another name, and where nothing says what to render."""
        if self.video and self.output.suffix.lower() != ".mp4":
            raise StgaError(f"{self.output}: a video's name ends in .mp4")
        if self.cameras is None and not self.is_film:
            raise StgaError("--out needs --cameras, which says what to render, or --turntable")


def render(request: Render, report: Report, log: Log) -> Written:
    """Render the pictures or the video; cancelled, no video is written, and pictures that are
    finished stay. Raises StgaError."""
    if request.turntable is not None:
        _turntable_images(request, request.fps or DEFAULT_FPS)  # before anything is read
    views: Sequence[View] = ()
    if request.cameras is not None:
        views = camera_views(request, request.cameras, log)
    composer = Composer(request.device)
    composer.choose()
    subject = _subject(request, composer, log)
    if request.is_film:
        _film(request, subject, subject.views if request.cameras is None else views, report)
        return Written(request.output)
    if request.motion is not None:  # each timestep as the first pose of each camera sees it
        cameras = sorted({view.camera_index: view for view in reversed(views)}.items())
        views = [
            replace(view, timestep=timestep, name=f"{timestep:05d}_{index:02d}")
            for timestep in subject.timesteps
            for index, view in cameras
        ]
    timesteps = set(_timesteps(request, tuple({view.timestep for view in views})))
    _pictures(request, subject, [view for view in views if view.timestep in timesteps], report)
    return Written(request.output)


def camera_views(request: Render, path: Path, log: Log) -> list[View]:
    """The views of a file of cameras: transforms, or 3D Gaussian Splatting's. Raises StgaError."""
    if is_file(path) and is_gaussian_cameras(path):
        shots = read_gaussian_cameras(path)
        return [
            View(0, n, shot.camera, shot.label, Path(shot.label)) for n, shot in enumerate(shots)
        ]
    principal_point = request.principal_point
    if principal_point is None:
        if is_splats(request.source):
            principal_point = written_convention(read_transforms(path))
        else:
            principal_point = read_avatar(avatar_source.avatar_path(request.source)).principal_point
    frames = read_transforms(path, principal_point)
    if distorted := distortion(frames):
        log(f"{distorted}; pictures are drawn as of a pinhole")
    return [frame.view for frame in frames]


@dataclass(frozen=True)
class _Subject:
    """What is rendered.

    image      view and fraction of the film, 0 to 1 -> image (3, H, W)
    timesteps  of its motion, ascending; none where nothing moves
    center     of the head or splats at the first timestep, (3,) meters
    fps        at which it plays
    views      of its capture
    """

    image: Callable[[View, float], np.ndarray]
    timesteps: tuple[int, ...]
    center: Callable[[], np.ndarray]
    fps: float
    views: Sequence[View] = ()


def _pictures(request: Render, subject: _Subject, views: Sequence[View], report: Report) -> None:
    """Write a PNG for each view."""
    from PIL import Image

    from ..render.render import to_uint8

    folder = request.output
    names = unique_names([view.name for view in views])
    captured = {view.image for view in views}
    target = folder.resolve()
    overwritten = next((name for name in names if target / name in captured), None)
    if overwritten is not None:
        raise StgaError(f"{folder / overwritten}: is an image of the capture; choose another --out")
    for view, name in counted(
        zip(views, names, strict=True), len(views), report, "Rendering", "Image"
    ):
        with replacing(folder / name) as partial:
            Image.fromarray(to_uint8(subject.image(view, 0.0))).save(partial, format="PNG")


def _film(request: Render, subject: _Subject, views: Sequence[View], report: Report) -> None:
    """Write the subject's motion as one camera sees it, which stands still or orbits."""
    from ..render.render import to_uint8

    first = {view.camera_index: view for view in reversed(views)}
    indices = sorted(first)
    index = request.camera
    if not first:
        raise StgaError(f"{request.source}: there is no camera to render from; give --cameras")
    if index is None:
        index = indices[central_camera([first[each].camera for each in indices])]
    if index not in first:
        raise StgaError(f"--camera {index}: there are only {', '.join(map(str, indices))}")
    start = first[index]
    timesteps: Sequence[int] = _timesteps(request, subject.timesteps) or (0,)
    cameras = [start.camera] * len(timesteps)
    if request.turntable is not None:
        count = max(len(timesteps), _turntable_images(request, subject.fps), 1)
        timesteps = to_and_fro(timesteps, count)
        center = subject.center()
        half = np.radians(request.turntable) / 2
        angles = (-half, half)
        if not half:
            angles = covered_angles([view.camera for view in views], start.camera, center)
        cameras = turntable(start.camera, center, count, angles)
    steps = zip(cameras, timesteps, strict=True)
    path = [replace(start, camera=camera, timestep=timestep) for camera, timestep in steps]
    out = request.output
    with video_writer(out, subject.fps) if request.video else sequence_writer(out) as write:
        for n, view in enumerate(counted(path, len(path), report, "Rendering", "Image")):
            write(to_uint8(subject.image(view, n / len(path))))


def _timesteps(request: Render, timesteps: tuple[int, ...]) -> tuple[int, ...]:
    """Those from the first to the last of `frames`. Raises StgaError where there is none."""
    if request.frames is None:
        return timesteps
    first, last = request.frames
    found = tuple(timestep for timestep in timesteps if first <= timestep <= last)
    if not found:
        raise StgaError(f"--frames {first}:{last}: there is no such timestep to render")
    return found


def _turntable_images(request: Render, fps: float) -> int:
    """Images of --seconds. Raises StgaError for more than MAX_TURNTABLE_IMAGES."""
    images = request.seconds * fps
    if images > MAX_TURNTABLE_IMAGES:
        raise StgaError(
            f"--seconds {request.seconds:g}: is {images:.0f} images at {fps:g} frames per "
            f"second; expected up to {MAX_TURNTABLE_IMAGES}"
        )
    return round(images)


def _subject(request: Render, composer: Composer, log: Log) -> _Subject:
    """An avatar with its capture or moved by another person's motion, or world-space splats."""
    source = request.source
    if is_splats(source):
        from ..render.render import render_layers

        splats = read_splats(source, log)
        layers = [PosedSplats(splats)]
        return _Subject(
            lambda view, _: render_layers(layers, view.camera, request.background, composer),
            (),
            lambda: np.median(splats.xyz, axis=0),
            playback_fps(None, request.fps),
        )
    if request.motion is not None:
        avatar = read_avatar(avatar_source.avatar_path(source))
        capture = avatar_source.open_avatar(request)[1] if request.cameras is None else None
        motion = avatar_source.open_avatar_motion(request, avatar, log)
        sequence = motion.sequence
        fps = request.fps or motion.fps or DEFAULT_FPS
        return _Subject(
            _pictured(request, avatar, lambda v: sequence_mesh(sequence, v.timestep), composer),
            tuple(sequence.timesteps),
            lambda: _middle(sequence_mesh(sequence, sequence.timesteps[0])),
            fps,
            () if capture is None else capture.all_views,
        )
    avatar, capture = avatar_source.open_avatar(request)
    if capture is None:
        raise StgaError(
            f"{source}: an avatar needs the meshes of a capture to follow; give --capture"
        )

    def mesh(view: View) -> np.ndarray:
        if view.timestep not in capture.timesteps:
            raise StgaError(
                f"{capture.root}: has no mesh for timestep {view.timestep}, which {view.name} "
                "asks for"
            )
        return capture.mesh(view.timestep)

    return _Subject(
        _pictured(request, avatar, mesh, composer),
        capture.timesteps,
        lambda: _middle(capture.mesh(capture.timesteps[0])),
        playback_fps(capture, request.fps),
        capture.all_views,
    )


def _pictured(
    request: Render, avatar: Avatar, mesh: Callable[[View], np.ndarray], composer: Composer
) -> Callable[[View, float], np.ndarray]:
    """The picture of an avatar on the mesh of a view, as recorded or under the asked light."""
    from ..render.render import posed_avatar, render_layers

    behind = list[PosedSplats]()
    if request.world:
        path = avatar_source.avatar_path(request.source).with_name(WORLD_FILE)
        if not path.is_file():
            raise StgaError(
                f"{path}: is missing; --world shows what a training with --effect world=on has "
                "written"
            )
        behind = [PosedSplats(read_splats(path))]
    colors = None if request.light is None else _lit_colors(request, request.light, avatar)

    def picture(view: View, fraction: float) -> np.ndarray:
        posed = mesh(view)
        lit = None if colors is None else colors(posed, view, fraction)
        layers = [posed_avatar(avatar, posed, lit), *behind]
        return render_layers(layers, view.camera, request.background, composer)

    return picture


def _lit_colors(
    request: Render, source: Path, avatar: Avatar
) -> Callable[[np.ndarray, View, float], np.ndarray]:
    """Mesh, view and fraction of the pictures -> colors (N, 3) under the asked light."""
    relighter = Relighter(avatar)
    lighting = read_lighting(source)

    def colors(mesh: np.ndarray, view: View, fraction: float) -> np.ndarray:
        light = lighting
        if request.light_turn:
            light = turned(lighting, _middle(mesh), request.light_turn * fraction)
        return relighter.colors(mesh, view.camera.position, light)

    return colors


def _middle(vertices: np.ndarray) -> np.ndarray:
    """(3,) center of the vertices' bounding box."""
    return (vertices.min(0) + vertices.max(0)) / 2


def unique_names(paths: list[str]) -> list[str]:
    """Names ending in .png; where entries share one, with their folders, then numbered."""
    pngs = [PurePosixPath(path).with_suffix(".png") for path in paths]
    names = [png.name for png in pngs]
    unique = dict[str, None]()
    if len(set(names)) < len(names):
        names = ["_".join(part for part in png.parts if part not in ("..", "/")) for png in pngs]
    for name in names:
        numbered = (f"{PurePosixPath(name).stem}_{n}.png" for n in itertools.count(2))
        unique[next(c for c in itertools.chain((name,), numbered) if c not in unique)] = None
    return list(unique)
