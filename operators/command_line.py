"""`blender --command stga …`: the commands of `python -m stga_addon`, by default about the open
file's head."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.open import open_capture
from ..stga_addon.errors import StgaError
from ..stga_addon.flame.sequence import motion_arrays
from ..stga_addon.jobs.avatar_source import FOLDER, OpenHead, Played, write_head
from ..stga_addon.scene import tags
from ..stga_addon.scene.arrays import head_vertices
from ..stga_addon.scene.objects import frames_per_second, iterate_frames
from ..stga_addon.scene.rig.motion import sample_motion
from ..stga_addon.scene.tags import is_head
from ..stga_addon.scene.vertex_groups import training_selection
from ..stga_addon.training.run.folder import TRACKING
from ..stga_addon.worker.launch import start_python
from .common import AtEnd, capture_source, file_path, scene_frames, stored_source
from .training_python import training_python

IN_BLENDER = ("select", "export", "demo")
"""Commands that need none of the packages that Blender's Python may lack, or need Blender itself;
all others run in the Python that trains, also where that is Blender's own: as `stga_addon`, whose
kernels are compiled."""


def _run(arguments: list[str]) -> int:
    # loaded when a command is given, not when Blender starts
    from ..stga_addon.cli.main import main, make_parser

    try:
        head = _open_head()
        options = make_parser(head).parse_args(arguments)
        if options.command in IN_BLENDER:
            return main(arguments, head)
        if options.command == "avatar":
            return _make_avatar(arguments, options)
        return _delegate(arguments, head, played=options.command == "render")
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2


def _open_head() -> OpenHead | None:
    head = bpy.context.scene.stga.head
    if not is_head(head):
        return None
    avatar = bpy.context.scene.stga.avatar
    return OpenHead(
        *stored_source(head),
        avatar=file_path(avatar, "avatar") if avatar else None,
        fps=frames_per_second(bpy.context.scene),
        selection=lambda: training_selection(head),
        played=lambda: _played(head),
    )


def _delegate(arguments: list[str], head: OpenHead | None, played: bool) -> int:
    """Run the command in the Python that trains; its exit code. Raises StgaError without one."""
    python = training_python(bpy.context)
    with TemporaryDirectory() as folder:
        environment = {}
        if head is not None:
            write_head(Path(folder), head, played)
            environment[FOLDER] = folder
        with start_python(python, ["stga_addon", *arguments], environment) as process:
            return process.wait()


def _make_avatar(arguments: list[str], options: Any) -> int:
    """Track and train in the Python for it, which needs no bpy, and write the .blend file here."""
    from ..stga_addon.cli.commands import write_blend
    from ..stga_addon.jobs.track import RUN_FOLDER

    code = _delegate([*arguments, "--no-blend"], None, played=False)
    if code or options.no_blend:
        return code
    refined = options.out / RUN_FOLDER / TRACKING

    def apply_refined(head: Any) -> None:
        bpy.context.scene.stga.head = head
        if refined.exists():  # PyTorch, which reads it into a capture, need not be here
            start = head[tags.TIMESTEPS][0]
            path = str(refined.resolve())
            bpy.ops.stga.apply_motion(filepath=path, own_offsets=True, start=start)

    print(f"blender: {write_blend(options.out, lambda capture: capture, apply_refined)}")
    return 0


def _played(head: Any) -> Played:
    """What the head plays in the scene's frames, however it is animated. Raises StgaError where its
    capture has moved, or a FLAME head has no rig."""
    frames = scene_frames(bpy.context.scene)
    meshes = {
        frame: np.asarray(head_vertices(head), np.float64)
        for frame in iterate_frames(frames, [head])
    }
    flame = open_capture(*capture_source(head)).flame
    motion = None if flame is None else motion_arrays(sample_motion(head, flame, frames))
    return Played(meshes, motion, training_selection(head))


def register(at_end: AtEnd) -> None:
    at_end(bpy.utils.unregister_cli_command, bpy.utils.register_cli_command("stga", _run))
