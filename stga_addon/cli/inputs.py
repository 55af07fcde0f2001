"""Opening what a command names: captures, avatars and runs."""

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.model import Capture
from ..capture.open import open_capture
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT
from ..errors import StgaError
from ..training.run.folder import AVATAR


def principal_point_of(options: Namespace) -> str:
    """The convention of --principal-point."""
    return options.principal_point or DEFAULT_PRINCIPAL_POINT


def open_named_capture(options: Namespace) -> Capture:
    """The capture of CAPTURE, --flame and --principal-point."""
    return open_capture(options.capture, options.flame, principal_point_of(options))


def open_avatar(source: Path, options: Namespace) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was trained on.

    Where Blender has a head open and no capture is named, the capture as that head plays it.
    Raises StgaError where the run's own capture has changed, or a given one has other triangles.
    """
    given, flame = getattr(options, "capture", None), getattr(options, "flame", None)
    capture = None
    if source.is_dir():
        capture = _run_capture(source, given, flame)
    avatar = read_avatar(avatar_path(source))
    if capture is None and given is not None:
        capture = open_capture(given, flame, avatar.principal_point)
        if avatar.settings.get("tracking"):
            print(f"warning: {source}: was trained on refined meshes, which only its run's folder has", file=sys.stderr)
    if capture is None:
        return avatar, None
    check_topology(capture, avatar)
    return avatar, capture if options.head is None else options.head.played(capture)


def required_capture(capture: Capture | None) -> Capture:
    """Raise StgaError where `open_avatar` found no capture."""
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    return capture


def timesteps_between(capture: Capture, span: tuple[int, int] | None) -> tuple[int, ...]:
    """The capture's timesteps from the first to the last of `span`, inclusive; None: all of them.

    Says so where the span reaches beyond them. Raises StgaError where there is none.
    """
    if span is None:
        return tuple(capture.timesteps)
    first, last = span
    timesteps = tuple(timestep for timestep in capture.timesteps if first <= timestep <= last)
    if not timesteps:
        raise StgaError(f"{capture.root}: has no timestep from {first} to {last}")
    own = min(capture.timesteps), max(capture.timesteps)
    if first < own[0] or last > own[1]:
        print(f"--frames {first}:{last}: the capture has timesteps {own[0]} to {own[1]}")
    return timesteps


def _run_capture(folder: Path, given: Path | None, flame: Path | None) -> Capture:
    """The capture of a run, or another one whose meshes are to drive its avatar; with the run's refined tracking."""
    from ..training.optimize.flame_refinement import with_refined_tracking
    from ..training.run.folder import read_run
    from ..training.run.open_run import open_run

    if given is None:
        return with_refined_tracking(open_run(folder, flame=flame).capture, folder)
    run = read_run(folder)
    return with_refined_tracking(open_capture(given, flame or run.flame, run.principal_point), folder)


def avatar_path(source: Path) -> Path:
    """The avatar file that a run folder or an avatar file names."""
    return source / AVATAR if source.is_dir() else source


def check_topology(capture: Capture, avatar: Avatar) -> None:
    """Raise StgaError where the capture's mesh has other triangles than the avatar's."""
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
