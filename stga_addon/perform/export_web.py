"""Web pages of an avatar: what of a capture and its run plays in the page."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..avatar.file import Avatar
from ..capture.camera import Camera
from ..capture.model import Capture
from ..driving.head_map import page_controls
from ..export.playback import MAX_VIEWS, Playback
from ..export.web.page import flame_notice
from ..flame.sequence import FlameSequence
from ..progress import Say
from ..requests.values import Export
from ..selection import SelectionOptions, select_capture
from ..training.run.folder import AVATAR, SELECTION

SPLITS = ("val", "train", "test")


def still_playback(request: Export, avatar: Avatar, fps: float, say: Say) -> Playback:
    """What a page of the neutral mesh alone shows. Says what it holds of a FLAME model."""
    _say_licence(flame_notice(avatar, None, motion_only=True), say)
    return Playback(title=_title(request), fps=fps, motion_only=True)


def capture_playback(
    request: Export, avatar: Avatar, capture: Capture, timesteps: tuple[int, ...], fps: float, say: Say
) -> tuple[Playback, FlameSequence | None]:
    """What a page of the capture's timesteps shows, and its FLAME motion. Says what it holds of a FLAME model."""
    playback = Playback(
        title=_title(request),
        fps=fps,
        views=capture_views(capture),
        up=_up(capture),
        selection=_selection(request, capture, timesteps),
        motion_only=request.motion_only,
        controls=None if request.motion_only else page_controls(capture.flame),
    )
    sequence = None if capture.flame is None else replace(capture.flame, timesteps=_flame_timesteps(capture, timesteps))
    notice = flame_notice(avatar, sequence, request.motion_only)
    has_rig = sequence is not None and not request.motion_only
    _say_licence(f"{notice} --motion-only leaves them out, but not the meshes of the take." if has_rig else notice, say)
    return playback, sequence


def _say_licence(notice: str, say: Say) -> None:
    if notice:
        say(notice)


def _title(request: Export) -> str:
    path = request.source.resolve()
    return str(path.parent.name if path.name == AVATAR else path.stem)


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
    cameras = [view.camera for views in capture.views.values() for view in views]
    if not cameras:
        return (0.0, 1.0, 0.0)
    mean = -np.stack([camera.world_to_camera[1, :3] for camera in cameras]).mean(0)
    axis = np.zeros(3)
    axis[np.abs(mean).argmax()] = np.sign(mean[np.abs(mean).argmax()])
    return (float(axis[0]), float(axis[1]), float(axis[2]))


def _selection(request: Export, capture: Capture, timesteps: tuple[int, ...]) -> list[np.ndarray] | None:
    """What each timestep trains: the open file's or the run's selection, else by the rule."""
    chosen: Mapping[int, np.ndarray] | None = None
    if request.played is not None:
        chosen = request.played.selection
    elif (request.source / SELECTION).exists():
        from ..training.run.checkpoint import read_selection  # imports torch, which Blender may lack

        chosen = read_selection(request.source, len(capture.faces))
    if not chosen and request.played is None:
        chosen = select_capture(capture, SelectionOptions())
    everything = np.ones(len(capture.faces), bool)
    return [chosen.get(timestep, everything) for timestep in timesteps] if chosen else None


def _flame_timesteps(capture: Capture, timesteps: tuple[int, ...]) -> tuple[int, ...]:
    """The timesteps of `capture.flame` for those of the capture, which an open head numbers by the scene's frames."""
    assert capture.flame is not None
    numbered = dict(zip(capture.timesteps, capture.flame.timesteps, strict=True))
    return tuple(numbered[timestep] for timestep in timesteps)
