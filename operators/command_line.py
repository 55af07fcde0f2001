"""`blender --command stga …`: the same parser as `python -m stga_addon`."""

from typing import Any

import bpy

from . import ids

_commands: list[Any] = []


def _run(arguments: list[str]) -> int:
    from ..stga_addon.cli import main  # only here: enabling the extension loads nothing that a command needs

    return main(arguments)


def register() -> None:
    _commands.append(bpy.utils.register_cli_command(ids.CLI_COMMAND, _run))


def unregister() -> None:
    bpy.utils.unregister_cli_command(_commands.pop())
