"""STGA for Blender: trains and shows selective-training Gaussian head avatars."""

from contextlib import ExitStack

_registered = ExitStack()


def register() -> None:
    """Register everything or nothing. Nothing is imported before Blender asks: this file also lies beside the tests."""
    from . import operators, ui
    from .operators import command_line

    with ExitStack() as done:
        for part in (operators, ui, command_line):
            part.register()
            done.callback(part.unregister)
        _registered.push(done.pop_all().__exit__)


def unregister() -> None:
    _registered.close()
