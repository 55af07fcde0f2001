"""The small mesh with splats of `tests/avatar`."""

from avatar.conftest import *  # noqa: F403
