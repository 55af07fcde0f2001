"""The panel's options as those of the operators that its buttons call."""

from typing import Any


def set_options(button: Any, settings: Any, options: type) -> None:
    """Give an operator's button the settings' values of the properties that both take from the
    class `options`."""
    for base in options.__mro__[:-1]:
        for name in base.__annotations__:
            setattr(button, name, getattr(settings, name))
