"""Web pages on the command line: what of a capture and its run plays in the page."""

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..avatar.file import Avatar
from ..capture.camera import Camera
from ..capture.model import Capture
from ..export.formats import export_avatar
from ..export.playback import MAX_VIEWS, Playback
from ..export.web.write import flame_notice
from ..selection import SelectionOptions, select_capture
from ..training.run.folder import AVATAR
from .inputs import required_capture, timesteps_between
from .outputs import announce_size

SPLITS = ("val", "train", "test")


def export_web(avatar: Avatar, capture: Capture | None, options: Namespace) -> None:
    """Write the page of --out with the capture's timesteps (--frames), or the neutral mesh without a capture."""
    if capture is None and options.frames is None:
        announce_size(options.out, avatar, "web", 1)
        playback = Playback(title=_title(options), fps=options.fps, motion_only=True)
        _announce_licence(flame_notice(avatar, None, motion_only=True))
        export_avatar(options.out, avatar, "web", [(0, avatar.neutral)], playback=playback)
        return
    capture = required_capture(capture)
    timesteps = timesteps_between(capture, options.frames)
    announce_size(options.out, avatar, "web", len(timesteps))
    playback = Playback(
        title=_title(options),
        fps=options.fps,
        views=capture_views(capture),
        up=_up(capture),
        selection=_selection(capture, timesteps, options),
        motion_only=options.motion_only,
    )
    sequence = None if capture.flame is None else replace(capture.flame, timesteps=_flame_timesteps(capture, timesteps))
    notice = flame_notice(avatar, sequence, options.motion_only)
    has_rig = sequence is not None and not options.motion_only
    _announce_licence(f"{notice} --motion-only leaves them out, but not the meshes of the take." if has_rig else notice)
    export_avatar(options.out, avatar, "web", _meshes(capture, timesteps), sequence, playback=playback)


def _announce_licence(notice: str) -> None:
    if notice:
        print(notice)


def _title(options: Namespace) -> str:
    path = options.avatar.resolve()
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


def _selection(capture: Capture, timesteps: tuple[int, ...], options: Namespace) -> list[np.ndarray] | None:
    """What each timestep trains: the open head's or the run's selection, else by the rule."""
    from ..training.run.checkpoint import read_selection
    from ..training.run.folder import SELECTION

    chosen = None
    if options.head is not None:
        chosen = options.head.selection()
    elif (options.avatar / SELECTION).exists():
        chosen = read_selection(options.avatar, len(capture.faces))
    if not chosen and options.head is None:
        chosen = select_capture(capture, SelectionOptions())
    everything = np.ones(len(capture.faces), bool)
    return [chosen.get(timestep, everything) for timestep in timesteps] if chosen else None


def _flame_timesteps(capture: Capture, timesteps: tuple[int, ...]) -> tuple[int, ...]:
    """The timesteps of `capture.flame` for those of the capture, which an open head numbers by the scene's frames."""
    assert capture.flame is not None
    numbered = dict(zip(capture.timesteps, capture.flame.timesteps, strict=True))
    return tuple(numbered[timestep] for timestep in timesteps)


def _meshes(capture: Capture, timesteps: tuple[int, ...]) -> Iterator[tuple[int, np.ndarray]]:
    for timestep in timesteps:
        yield timestep, capture.mesh(timestep)
