"""Opening what a command names: captures, avatars and runs."""

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.model import Capture
from ..capture.open import open_capture
from ..errors import StgaError


def open_named_capture(options: Namespace) -> Capture:
    """The capture of CAPTURE, --flame and --principal-point."""
    return open_capture(options.capture, options.flame, options.principal_point or "vhap")


def open_avatar(source: Path, options: Namespace) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was trained on.

    Where Blender has a head open and no capture is named, the capture as that head plays it.
    Raises StgaError where the run's own capture has changed, or a given one has other triangles.
    """
    given, flame = getattr(options, "capture", None), getattr(options, "flame", None)
    avatar, capture = read_avatar(avatar_path(source)), None
    if source.is_dir():
        from ..training.optimize.tracking import with_refined_tracking
        from ..training.run.folder import read_run
        from ..training.run.open_run import open_run

        if given is None:
            capture = open_run(source, flame=flame).capture
        else:
            capture = open_capture(given, flame or read_run(source).flame, avatar.principal_point)
        capture = with_refined_tracking(capture, source)
    elif given is not None:
        capture = open_capture(given, flame, avatar.principal_point)
        if avatar.settings.get("tracking"):
            print(f"warning: {source}: was trained on refined meshes, which only its run's folder has", file=sys.stderr)
    if capture is None:
        return avatar, None
    check_topology(capture, avatar)
    return avatar, capture if options.head is None else options.head.played(capture)


def avatar_path(source: Path) -> Path:
    """The avatar file that a run folder or an avatar file names."""
    return source / "avatar.npz" if source.is_dir() else source


def check_topology(capture: Capture, avatar: Avatar) -> None:
    """Raise StgaError where the capture's mesh has other triangles than the avatar's."""
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
