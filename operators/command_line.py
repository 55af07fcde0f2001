"""`blender --command stga …`: the same parser as `python -m stga_addon`, about the head of the file that is open."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.model import Capture
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import evaluated_vertices
from ..stga_addon.scene.groups import painted_selection
from ..stga_addon.scene.motion import performed_motion, played
from . import ids
from .common import file_path, is_head, settings

_commands: list[Any] = []


def _run(arguments: list[str]) -> int:
    from ..stga_addon.cli import OpenHead, main  # only here: enabling the extension loads nothing that a command needs

    head = settings(bpy.context).head
    if not is_head(head):
        return main(arguments)
    model, avatar = head.get(tags.FLAME_MODEL), settings(bpy.context).avatar
    return main(
        arguments,
        OpenHead(
            capture=Path(head[tags.CAPTURE]),
            flame=Path(model) if model else None,
            principal_point=head.get(tags.PRINCIPAL_POINT, "vhap"),
            avatar=file_path(avatar, "avatar") if avatar else None,
            selection=lambda: painted_selection(head),
            played=lambda capture: _played(head, capture),
        ),
    )


def _played(head: Any, capture: Capture) -> Capture:
    """The capture with the meshes of the scene's frames, whatever animates the head there."""
    scene = bpy.context.scene
    frames = range(scene.frame_start, scene.frame_end + 1)

    def mesh(frame: int) -> np.ndarray:
        (vertices,) = [evaluated_vertices(head) for _ in played((frame,))]
        return np.asarray(vertices, np.float64)

    flame = capture.flame and performed_motion(head, capture.flame, frames)
    return replace(capture, timesteps=tuple(frames), mesh=mesh, flame=flame)


def register() -> None:
    _commands.append(bpy.utils.register_cli_command(ids.CLI_COMMAND, _run))


def unregister() -> None:
    bpy.utils.unregister_cli_command(_commands.pop())
