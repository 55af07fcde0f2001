"""Export of an avatar in another format."""

import numpy as np

from ..avatar.file import Avatar
from ..capture.model import Capture
from ..errors import StgaError
from ..export.formats import FORMATS, Meshes, check_free_space, export_avatar
from ..export.playback import playback_fps
from ..format import format_bytes
from ..light.relight import albedo_avatar
from ..progress import Report, Say, counted
from ..requests.results import Written
from ..requests.values import Export
from .export_web import capture_playback, still_playback
from .inputs import open_avatar, required_capture, timesteps_between
from .motion import motion_capture, open_avatar_motion


def export(request: Export, report: Report, say: Say) -> Written:
    """Write the file or the folder. Says how much room several frames take; raises StgaError."""
    avatar, capture = open_avatar(request)
    if request.albedo:
        avatar = albedo_avatar(avatar)
    if request.motion is not None:
        capture = motion_capture(request, open_avatar_motion(request, avatar, say), capture)
    fps = playback_fps(capture, request.fps, numbered=request.file_format == "usd")
    format, playback = FORMATS[request.file_format], None
    flame = None if capture is None else capture.flame
    meshes: Meshes = ()
    if format.is_page and capture is None and request.frames is None:
        _say_size(request, avatar, 1, say)
        playback = still_playback(request, avatar, fps, say)
        meshes = [(0, avatar.neutral)]
    elif format.source == "range":
        capture = required_capture(capture)
        timesteps = timesteps_between(capture, request.frames, say)
        _say_size(request, avatar, len(timesteps), say)
        if format.is_page:
            playback, flame = capture_playback(request, avatar, capture, timesteps, fps, say)
        posed = ((timestep, capture.mesh(timestep)) for timestep in timesteps)
        meshes = counted(posed, len(timesteps), report, "Exporting", "Frame")
    elif format.source == "frame":
        meshes = [_frame(avatar, capture, request.timestep)]
    export_avatar(request.output, avatar, request.file_format, meshes, flame, fps, playback)
    return Written(request.output)


def _frame(avatar: Avatar, capture: Capture | None, timestep: int | None) -> tuple[int, np.ndarray]:
    """The mesh of one timestep, or the neutral mesh."""
    if timestep is None:
        return 0, avatar.neutral
    capture = required_capture(capture)
    if timestep not in capture.timesteps:
        raise StgaError(f"{capture.root}: has no timestep {timestep}")
    return timestep, capture.mesh(timestep)


def _say_size(request: Export, avatar: Avatar, frames: int, say: Say) -> None:
    """Say how large the file will be. Raises StgaError where the disk has too little free space."""
    size = FORMATS[request.file_format].size(avatar, frames)
    check_free_space(request.output, size)
    plural = "" if frames == 1 else "s"
    say(f"{frames} frame{plural} of {len(avatar.splats)} splats: about {format_bytes(size)}")
