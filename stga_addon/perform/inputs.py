"""Opening what a request names: an avatar, and the capture whose meshes drive it."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.model import Capture
from ..capture.open import open_capture
from ..errors import StgaError
from ..flame.sequence import motion_of
from ..progress import Say
from ..requests.values import Export, Played, Render
from ..training.run.folder import AVATAR, read_run
from ..training.run.open_run import open_refined
from ..training.run.tracking_file import with_refined_tracking


def open_avatar(request: Render | Export) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was trained on, as an open
    .blend file's head plays it where the request says so.

    Raises StgaError where the run's own capture has changed, or a given one has other triangles.
    """
    source = request.source
    capture = _run_capture(source, request.capture, request.flame) if source.is_dir() else None
    avatar = read_avatar(avatar_path(source))
    if capture is None and request.capture is not None:
        capture = open_capture(request.capture, request.flame, avatar.principal_point)
        if avatar.settings.get("tracking"):
            what = "was trained on refined meshes, which only its run's folder has"
            logging.getLogger(__name__).warning("warning: %s: %s", source, what)
    if capture is None:
        return avatar, None
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
    return avatar, capture if request.played is None else _as_played(capture, request.played)


def required_capture(capture: Capture | None) -> Capture:
    """Raise StgaError where `open_avatar` found no capture."""
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    return capture


def timesteps_between(capture: Capture, span: tuple[int, int] | None, say: Say) -> tuple[int, ...]:
    """The capture's timesteps from the first to the last of `span`, inclusive; None: all of them.

    Says so where the span reaches beyond them. Raises StgaError where there is none.
    """
    if span is None:
        return tuple(capture.timesteps)
    first, last = span
    timesteps = tuple(timestep for timestep in capture.timesteps if first <= timestep <= last)
    if not timesteps:
        raise StgaError(f"{capture.root}: has no timestep from {first} to {last}")
    begin, end = min(capture.timesteps), max(capture.timesteps)
    if first < begin or last > end:
        say(f"--frames {first}:{last}: the capture has timesteps {begin} to {end}")
    return timesteps


def avatar_path(source: Path) -> Path:
    """The avatar file that a run folder or an avatar file names."""
    return source / AVATAR if source.is_dir() else source


def _run_capture(folder: Path, given: Path | None, flame: Path | None) -> Capture:
    """The capture of a run, or another one whose meshes are to drive its avatar; with the run's refined tracking."""
    if given is None:
        return open_refined(folder, flame=flame)
    run = read_run(folder)
    return with_refined_tracking(open_capture(given, flame or run.flame, run.principal_point), folder)


def _as_played(capture: Capture, played: Played) -> Capture:
    """The capture with the frames of an open .blend file. Raises StgaError for arrays of another head."""
    for name, arrays, shape, kind in (
        ("frame", played.meshes, capture.neutral.shape, "f"),
        ("selection of frame", played.selection or {}, capture.faces.shape[:1], "b"),
    ):
        for frame, array in arrays.items():
            if array.dtype.kind != kind or array.shape != shape or not np.isfinite(array).all():
                expected = f"{'finite numbers' if kind == 'f' else 'bool'} {shape}"
                raise StgaError(f"played: {name} {frame}: expected {expected}, got {array.dtype} {array.shape}")
    flame = None
    if capture.flame is not None and played.motion is not None:
        flame = motion_of(Path("played"), played.motion, capture.flame.model)
        if len(flame.timesteps) != len(played.meshes):
            raise StgaError(f"played: motion: expected {len(played.meshes)} frames, got {len(flame.timesteps)}")
    meshes = dict(sorted(played.meshes.items()))
    return replace(capture, timesteps=tuple(meshes), mesh=meshes.__getitem__, flame=flame)
