"""The table of driven offsets."""

from .offset import DrivenOffset
from .strain_position import STRAIN_POSITION

OFFSETS: dict[str, DrivenOffset] = {offset.name: offset for offset in (STRAIN_POSITION,)}
"""By name. Everything that trains, stores or poses avatars goes by this table."""
