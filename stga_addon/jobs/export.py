"""Export of an avatar: one frame, a range of frames, or splats with their FLAME motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.file import Avatar
from ..avatar.observed import observed_part
from ..capture.camera import Camera
from ..capture.model import Capture
from ..capture.selection import SelectionOptions, select_capture
from ..driving.head_map import page_controls
from ..driving.open_motion import MotionOptions
from ..driving.performers import is_performance
from ..errors import StgaError
from ..export.formats import (
    FORMATS,
    Content,
    Format,
    check_free_space,
    check_suffix,
    export_avatar,
)
from ..export.playback import DEFAULT_FPS, MAX_VIEWS, Playback, playback_fps
from ..export.rig import Meshes, flame_notice
from ..files import is_folder
from ..flame.sequence import FlameSequence
from ..format import format_bytes, format_name
from ..light.relight import albedo_avatar
from ..options import When, like, option
from ..progress import Log, Report, Written, counted
from ..training.run.folder import AVATAR, SELECTION
from . import avatar_source
from .train import Train

RATED = " and ".join(name for name, format in FORMATS.items() if format.has_rate)
"""Names of the formats with a frame rate, for help."""
RIGGED = " and ".join(name for name, format in FORMATS.items() if format.has_rig)
"""Names of the formats with a rig, for help."""


def _formats(test: Callable[[Format], bool]) -> When:
    """The formats that pass a test."""
    names = [name for name, format in FORMATS.items() if test(format)]
    otherwise = f"with --format {{file_format}}, only with {', '.join(names)}"
    return When(lambda value: value.file_format in names, otherwise)


def _is_posed(value: Any) -> bool:
    return FORMATS[value.file_format].source != "frame" or value.timestep is not None


POSED = When(_is_posed, "with --format {file_format} without --timestep")
OPENED = When(
    lambda value: _is_posed(value) or value.source is None or is_folder(value.source),
    "with --format {file_format} without --timestep",
)
RATE = When(
    lambda value: (
        FORMATS[value.file_format].has_rate or (value.motion and is_performance(value.motion))
    ),
    f"with --format {{file_format}}, only with {RATED}, or a face performance as --motion",
)


@dataclass(frozen=True)
class Export:
    """Write an avatar in another format, for other viewers.

    others    as of `avatar_source.Posed`
    """

    source: Path = option("folder of a run, or avatar file", flag="RUN|AVATAR")
    output: Path = option("the file, or the folder of a format of several", flag="--out")
    file_format: str = option(
        "file format",
        flag="--format",
        choices={name: format.description for name, format in FORMATS.items()},
    )
    capture: Path | None = option(
        "whose frames to bake (default: the run's)", None, needs=(OPENED,)
    )
    flame: Path | None = like(
        Train, "flame", help="FLAME model file of that capture, or of the motion", needs=(OPENED,)
    )
    played: avatar_source.Played | None = None
    timestep: int | None = option(
        "of a format that holds one frame (default: the neutral mesh)",
        None,
        0,
        needs=(_formats(lambda format: format.source == "frame"),),
    )
    frames: tuple[int, int] | None = option(
        "of a format that holds several (default: all)",
        None,
        metavar="FIRST:LAST",
        needs=(_formats(lambda format: format.source == "range"),),
    )
    fps: float | None = option(
        f"frames per second of {RATED} (default: the scene's or the capture's, else "
        f"{DEFAULT_FPS:g})",
        None,
        above=0,
        needs=(RATE,),
    )
    motion_only: bool = option(
        f"{RIGGED}: leave out the blend shapes and skeleton of the FLAME file; the "
        "meshes of the take stay in the page, and FLAME's licence decides who may receive it "
        "either way",
        False,
        needs=(_formats(lambda format: format.has_rig),),
    )
    motion: Path | None = avatar_source.motion_field(POSED)
    motion_options: MotionOptions = avatar_source.motion_options_field("motion")
    albedo: bool = option(
        "leave out the capture's light: colors are the albedo (docs/light.md)", False
    )
    filmed_only: bool = option(
        "leave out what is plausible only: splats that no camera saw, off-axis colors", False
    )

    def check(self) -> None:
        """Raise StgaError if the output's suffix does not fit the format."""
        check_suffix(self.output, self.file_format)


def export(request: Export, report: Report, log: Log) -> Written:
    """Write the file or the folder. Says how much room several frames take; raises StgaError."""
    avatar, capture = avatar_source.open_avatar(request)
    if request.filmed_only:
        avatar = observed_part(avatar_source.avatar_path(request.source), avatar)
    if request.albedo:
        avatar = albedo_avatar(avatar)
    if request.motion is not None:
        capture = avatar_source.motion_capture(request, avatar, capture, log)
    fps = playback_fps(capture, request.fps, numbered=request.file_format == "usd")
    format = FORMATS[request.file_format]
    timestep = request.timestep
    playback = Playback(fps=fps)
    flame = None if capture is None else capture.flame
    meshes: Meshes = [(0, avatar.neutral)]
    if format.has_rig and capture is None and request.frames is None:
        _log_size(request, avatar, 1, log)
        playback = Playback(title=_title(request), fps=fps, motion_only=True)
        _log_licence(flame_notice(avatar, None, motion_only=True), log)
    elif format.source == "range":
        capture = avatar_source.required_capture(capture)
        timesteps = avatar_source.timesteps_between(capture, request.frames, log)
        _log_size(request, avatar, len(timesteps), log)
        if format.has_rig:
            playback, flame = capture_playback(request, avatar, capture, timesteps, fps, log)
        posed = ((timestep, capture.mesh(timestep)) for timestep in timesteps)
        meshes = counted(posed, len(timesteps), report, "Exporting", "Frame")
    elif format.source == "frame" and timestep is not None:
        capture = avatar_source.required_capture(capture)
        if timestep not in capture.timesteps:
            raise StgaError(f"{capture.root}: has no timestep {timestep}")
        meshes = [(timestep, capture.mesh(timestep))]
    export_avatar(request.output, avatar, request.file_format, meshes, flame, playback)
    return Written(request.output)


def _log_size(request: Export, avatar: Avatar, frames: int, log: Log) -> None:
    """Log how large the file will be. Raises StgaError where the disk has too little free space."""
    size = FORMATS[request.file_format].size(Content(avatar), frames)
    check_free_space(request.output, size)
    log(
        f"{frames} frame{'' if frames == 1 else 's'} of {len(avatar.splats)} splats: about "
        f"{format_bytes(size)}"
    )


# Web pages

SPLITS = ("val", "train", "test")


def capture_playback(
    request: Export,
    avatar: Avatar,
    capture: Capture,
    timesteps: tuple[int, ...],
    fps: float,
    log: Log,
) -> tuple[Playback, FlameSequence | None]:
    """What a page shows of timesteps, and its FLAME motion. Logs what of FLAME it holds."""
    # what each timestep trains: the open file's or the run's selection, else by the rule
    chosen: Mapping[int, np.ndarray] | None = None
    if request.played is not None:
        chosen = request.played.selection
    elif (request.source / SELECTION).exists():
        # imports torch, which Blender may lack
        from ..training.run.checkpoint import read_selection

        chosen = read_selection(request.source, len(capture.faces))
    if not chosen and request.played is None:
        chosen = select_capture(capture, SelectionOptions())
    everything = np.ones(len(capture.faces), bool)
    motion_only = request.motion_only
    sequence = capture.flame
    playback = Playback(
        title=_title(request),
        fps=fps,
        views=capture_views(capture),
        up=_up(capture),
        selection=[chosen.get(t, everything) for t in timesteps] if chosen else None,
        motion_only=motion_only,
        controls=None if motion_only else page_controls(sequence),
    )
    if sequence is not None:  # an open head numbers the capture's timesteps by the scene's frames
        numbered = dict(zip(capture.timesteps, sequence.timesteps, strict=True))
        sequence = replace(sequence, timesteps=tuple(numbered[t] for t in timesteps))
    notice = flame_notice(avatar, sequence, motion_only)
    if sequence is not None and not motion_only:
        notice += " --motion-only leaves them out, but not the meshes of the take."
    _log_licence(notice, log)
    return playback, sequence


def _log_licence(notice: str, log: Log) -> None:
    if notice:
        log(notice)


def _title(request: Export) -> str:
    path = request.source.resolve()
    return format_name(path.parent if path.name == AVATAR else path)


def capture_views(capture: Capture) -> dict[str, Camera]:
    """The first pose of each camera, a held-out one first."""
    cameras: dict[int, Camera] = {}
    for split in SPLITS:
        for view in capture.views.get(split, ()):
            cameras.setdefault(view.camera_index, view.camera)
    held_out = [view.camera_index for view in capture.views.get("val", ())][:1]
    order = [*held_out, *(index for index in sorted(cameras) if index not in held_out)]
    return {f"Camera {index}": cameras[index] for index in order[:MAX_VIEWS]}


def _up(capture: Capture) -> tuple[float, float, float]:
    """The axis of the capture that its cameras hold upright; y without cameras."""
    cameras = [view.camera for view in capture.all_views]
    if not cameras:
        return (0.0, 1.0, 0.0)
    mean = -np.stack([camera.world_to_camera[1, :3] for camera in cameras]).mean(0)
    axis = np.zeros(3)
    axis[np.abs(mean).argmax()] = np.sign(mean[np.abs(mean).argmax()])
    return (float(axis[0]), float(axis[1]), float(axis[2]))
