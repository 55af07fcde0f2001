"""Poses of heads as actions in the asset browser: values of sliders and rotations of bones."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import bpy
from mathutils import Quaternion

from ...driving.performance import ARKIT_SHAPES, mirrored_name
from ...errors import StgaError
from ...flame.model import JOINTS
from .. import tags
from ..compat import all_curves, new_action_curves
from .head import TIMESTEP_KEY
from .keyframes import (
    EXPRESSION_NAMES,
    IDENTITY_KEY,
    OFFSET_KEY,
    UNCHANGED,
    has_shapes,
    shape_key_names,
)

PARTS = ("sliders", "bones")
"""What a pose may hold."""
POSED_JOINTS = JOINTS[1:]
"""Bones that a pose turns: not the root, which says where the head is."""
SPOKEN = (
    "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthStretchLeft",
    "mouthLowerDownLeft", "mouthUpperUpLeft", "mouthPressLeft",
)  # fmt: skip
"""Shapes that each pose of a spoken sound sets, so that it replaces the one before; of a left and a
right shape, the left one."""
SOUNDS = {
    "Ah": {"jawOpen": 0.6, "mouthLowerDownLeft": 0.3, "mouthUpperUpLeft": 0.1},
    "Ee": {"jawOpen": 0.15, "mouthStretchLeft": 0.4, "mouthLowerDownLeft": 0.3},
    "Mm": {"jawOpen": 0.05, "mouthClose": 0.05, "mouthPressLeft": 0.35},
    "Oh": {"jawOpen": 0.35, "mouthFunnel": 0.6, "mouthPucker": 0.2},
    "Oo": {"jawOpen": 0.1, "mouthFunnel": 0.2, "mouthPucker": 0.75},
}
"""Name of a pose of a spoken sound -> the shapes that it does not set to 0."""
FACES = {
    "Blink": {"eyeBlinkLeft": 1.0},
    "Frown": {"browDownLeft": 0.8, "mouthFrownLeft": 0.5, "noseSneerLeft": 0.2},
    "Neutral": dict.fromkeys(ARKIT_SHAPES, 0.0),
    "Smile": {"mouthSmileLeft": 0.7, "cheekSquintLeft": 0.4, "mouthDimpleLeft": 0.2},
    "Surprise": {"browInnerUp": 0.8, "browOuterUpLeft": 0.7, "eyeWideLeft": 0.6, "jawOpen": 0.25},
}
"""Name of another pose -> its shapes."""
PRESETS = FACES | {name: dict.fromkeys(SPOKEN, 0.0) | mouth for name, mouth in SOUNDS.items()}
"""Name of a pose that comes along with a head -> weights of ARKit's shapes; the right side is as
the left."""


PRESET = "preset"
"""Value of the property `tags.POSE` of a pose that came along."""
SAVED = "saved"
"""Its value of a pose that was saved."""


class Applied(NamedTuple):
    """What a pose was applied to: shape keys and pose bones; and data paths that the head lacks."""

    sliders: list[Any]
    bones: list[Any]
    missing: list[str]


def _sliders(head: Any) -> dict[str, Any]:
    """Data path of its value -> shape key, of those that express something and are not driven."""
    keys = head.data.shape_keys
    driven = {each.data_path for each in keys.animation_data.drivers} if keys.animation_data else ()
    others = (IDENTITY_KEY, OFFSET_KEY)
    named = [
        each
        for each in keys.key_blocks[1:]
        if not (each.name.startswith(others) or TIMESTEP_KEY.fullmatch(each.name))
    ]
    paths = {each.path_from_id("value"): each for each in named}
    return {path: each for path, each in paths.items() if path not in driven}


def _bones(rig: Any) -> dict[str, Any]:
    """Data path of its rotation -> pose bone."""
    bones = [] if rig is None else [rig.pose.bones[joint] for joint in POSED_JOINTS]
    return {bone.path_from_id("rotation_quaternion"): bone for bone in bones}


def save_pose(head: Any, rig: Any, name: str, parts: Collection[str] = PARTS) -> Any:
    """Store sliders that are not 0, and bones that are turned, as an action in the asset browser.
    rig: None for a head with sliders alone; parts: of PARTS. Raises StgaError where there are
    none."""
    sliders = _sliders(head) if "sliders" in parts else {}
    values = {path: key.value for path, key in sliders.items() if abs(key.value) > UNCHANGED}
    bones = _bones(rig) if "bones" in parts else {}
    turns = {
        path: bone.rotation_quaternion.normalized()
        for path, bone in bones.items()
        if bone.rotation_quaternion.normalized().angle > UNCHANGED
    }
    if not values and not turns:
        raise StgaError(f"{head.name}: is at rest; move sliders or turn bones, then save the pose")
    return _new_pose(name, values, turns)


def _new_pose(name: str, values: Mapping[str, float], turns: Mapping[str, Quaternion]) -> Any:
    action = bpy.data.actions.new(name)
    action[tags.POSE] = SAVED
    if turns:  # first: Blender's own pose library takes the first slot
        curves = new_action_curves(action, "OBJECT", "Bones")
        for path, turn in turns.items():
            for index, element in enumerate(turn):
                curves.new(path, index=index).keyframe_points.insert(1, element)
    if values:
        curves = new_action_curves(action, "KEY", "Sliders")
        for path, value in values.items():
            curves.new(path).keyframe_points.insert(1, value)
    action.asset_mark()
    action.asset_data.description = "Pose of a head (STGA)"
    return action


def apply_pose(head: Any, rig: Any, action: Any, strength: float) -> Applied:
    """Lead sliders and bones of a head from where they are to those of a pose, which are reached at
    strength 1. rig: as of `save_pose`. Raises StgaError where the head has none of them."""
    sliders = _sliders(head)
    bones = _bones(rig)
    elements: dict[str, dict[int, float]] = {}
    for curve in all_curves(action):
        value = curve.evaluate(action.frame_range[0])
        elements.setdefault(curve.data_path, {})[curve.array_index] = value
    applied = Applied([], [], [])
    for path, found in elements.items():
        if path in sliders:
            key = sliders[path]
            key.value += strength * (found[0] - key.value)
            applied.sliders.append(key)
        elif path in bones and len(found) == 4:
            _turn(bones[path], Quaternion([found[index] for index in range(4)]), strength)
            applied.bones.append(bones[path])
        else:
            applied.missing.append(path)
    if not applied.sliders and not applied.bones:
        raise StgaError(f"{head.name}: has none of the sliders and bones of the pose {action.name}")
    return applied


def _turn(bone: Any, target: Quaternion, strength: float) -> None:
    now = bone.rotation_quaternion.normalized()
    turned = now.slerp(target.normalized(), strength)
    bone.rotation_quaternion = turned if turned.dot(now) >= 0 else -turned  # no spin between keys


def poses() -> list[Any]:
    """The poses of the file, by name."""
    return [each for each in bpy.data.actions if tags.POSE in each and each.asset_data is not None]


def bring_presets(head: Any) -> None:
    """Bring `PRESETS` into the file of a head with ARKit's sliders, unless it has some."""
    is_there = any(each.get(tags.POSE) == PRESET for each in bpy.data.actions)
    has_sliders = EXPRESSION_NAMES in head or has_shapes(head) or shape_key_names(head)
    if is_there or not has_sliders:
        return
    for name, weights in PRESETS.items():
        both = weights | {mirrored_name(each): weight for each, weight in weights.items()}
        values = {f'key_blocks["{each}"].value': weight for each, weight in both.items()}
        _new_pose(name, values, {})[tags.POSE] = PRESET
