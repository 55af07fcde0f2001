"""STGA for Blender: trains Gaussian head avatars and shows them in Blender."""

from contextlib import ExitStack

_registered = ExitStack()


def register() -> None:
    """Register everything or nothing. Imports are local because tests import this file without
    Blender, too."""
    from . import operators
    from .operators import command_line
    from .ui import panel, properties

    with ExitStack() as done:
        for part in (properties, operators, panel, command_line):
            part.register(done.callback)
        _registered.enter_context(done.pop_all())


def unregister() -> None:
    """Unregister everything, last first."""
    _registered.close()
