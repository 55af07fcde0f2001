"""Shadows of heads onto a scene that EEVEE or Cycles renders."""

from typing import Any

from ..display import splat_nodes
from ..display.splat_object import get_input

HIDDEN_RAYS = ("camera", "diffuse", "glossy", "transmission", "volume_scatter")
"""Rays that do not see a head which only throws shadows."""


def throws_shadow(splat_object: Any) -> bool:
    """Whether the head of a splat object is set up to throw its shadow, and nothing else, in images."""
    head = get_input(splat_object, splat_nodes.HEAD)
    return head is not None and not head.hide_render and not head.visible_camera and bool(head.visible_shadow)


def throw_shadow(splat_object: Any, is_on: bool) -> None:
    """Let the head's mesh throw its shadow onto the scene without being seen, or hide it from images again."""
    head = get_input(splat_object, splat_nodes.HEAD)
    head.hide_render = not is_on
    head.visible_shadow = True
    for ray in HIDDEN_RAYS:
        setattr(head, f"visible_{ray}", not is_on)
