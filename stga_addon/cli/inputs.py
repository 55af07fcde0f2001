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
    """
    capture, flame = getattr(options, "capture", None), getattr(options, "flame", None)
    if source.is_dir():
        from ..training.optimize.tracking import with_refined_tracking
        from ..training.run.folder import read_run

        run = read_run(source)
        avatar, principal_point = read_avatar(source / "avatar.npz"), run.principal_point
        capture, flame = capture or run.capture, flame or run.flame
    else:
        avatar, principal_point = read_avatar(source), "vhap"
        if capture is not None and avatar.settings.get("tracking"):
            print(f"warning: {source}: was trained on refined meshes, which only its run's folder has", file=sys.stderr)
    opened = None if capture is None else open_capture(capture, flame, principal_point)
    if opened is not None and source.is_dir():
        opened = with_refined_tracking(opened, source)
    return avatar, opened if opened is None or options.head is None else options.head.played(opened)


def check_topology(capture: Capture, avatar: Avatar) -> Capture:
    """`capture`. Raises StgaError where its mesh has other triangles than the avatar's."""
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
    return capture
