"""STGA for Blender: trains and shows selective-training Gaussian head avatars."""

from contextlib import ExitStack

_registered = ExitStack()


def register() -> None:
    """Register everything or nothing. Nothing is imported before Blender asks: this file also lies beside the tests."""
    from . import operators
    from .operators import command_line, render_engine
    from .ui import curve, panel, preferences, properties

    with ExitStack() as done:
        for part in (properties, preferences, operators, render_engine, curve, panel, command_line):
            part.register()
            done.callback(part.unregister)
        _registered.enter_context(done.pop_all())


def unregister() -> None:
    """Undo `register`, last first."""
    _registered.close()
