"""Drivers that an artist gave a head, kept while its capture is imported again."""

import re
from typing import Any

import bpy

from ...driving.performance import ARKIT_SHAPES
from ...flame.model import JOINTS
from ..objects import Warn
from . import keyframes

KEEPER = "STGA drivers"
"""Name of the object, in no scene, that holds them meanwhile."""
IMPORTED_KEY = re.compile(r"pose_\w+_\d\d|.+ \* jawOpen")
"""Name of a shape key that the import, or ARKit's sliders, drive."""
KEY_PATH = re.compile(r'key_blocks\["(.+)"\]\.\w+')
"""Data path of a value of a shape key."""
IMPORTED_PATHS = {
    path
    for joint in JOINTS
    for path in (
        keyframes.property_path(keyframes.sum_property(joint)),
        keyframes.location_path(keyframes.parent_bone(joint)),
        keyframes.location_path(keyframes.deform_bone(joint)),
    )
}
"""Data paths of an armature that the import drives."""


def keep_drivers(owner: Any) -> Any:
    """An object with copies of the drivers of `owner` that no import made; None without any."""
    animation = owner.animation_data if owner is not None else None
    made = [each for each in (animation.drivers if animation else ()) if not _is_imported(each)]
    if not made:
        return None
    keeper = bpy.data.objects.new(KEEPER, None)
    for each in made:
        keeper.animation_data_create().drivers.from_existing(src_driver=each)
    return keeper


def give_drivers(owner: Any, keeper: Any, warn: Warn) -> None:
    """Give an owner what `keep_drivers` kept, and name drivers of what is no longer there."""
    if keeper is None:
        return
    lost = list[str]()
    animation = owner.animation_data_create()
    for each in keeper.animation_data.drivers:
        if _is_there(owner, each.data_path):
            animation.drivers.from_existing(src_driver=each)
        else:
            lost.append(each.data_path)
    bpy.data.objects.remove(keeper)
    if lost:
        paths = ", ".join(lost)
        warn(f"{owner.name}: drivers are gone, as what they drove is: {paths}")


def _is_imported(driver: Any) -> bool:
    key = KEY_PATH.fullmatch(driver.data_path)
    is_key = key is not None and IMPORTED_KEY.fullmatch(key[1]) is not None
    return is_key or driver.data_path in IMPORTED_PATHS


def _is_there(owner: Any, path: str) -> bool:
    key = KEY_PATH.fullmatch(path)
    if key is not None and key[1] in ARKIT_SHAPES:
        return True  # the head gets those sliders back afterwards
    try:
        owner.path_resolve(path)
    except ValueError:
        return False
    return True
