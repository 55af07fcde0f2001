"""Painted scenes shared by several tests."""

import pytest

from .scenes import Scene, photograph


@pytest.fixture(scope="session")
def painted(tmp_path_factory):
    """Changes to `Scene` -> the capture that it is painted as."""
    made = {}

    def paint(**changes):
        key = repr(sorted(changes.items(), key=lambda item: item[0]))
        if key not in made:
            made[key] = photograph(tmp_path_factory.mktemp("scene"), Scene(**changes))
        return made[key]

    return paint
