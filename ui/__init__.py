"""What a person sees."""

from . import panel, preferences, properties

PARTS = (properties, preferences, panel)


def register() -> None:
    for index, part in enumerate(PARTS):
        try:
            part.register()
        except Exception:
            _unregister(PARTS[:index])
            raise


def unregister() -> None:
    _unregister(PARTS)


def _unregister(parts: tuple) -> None:
    for part in reversed(parts):
        part.unregister()
