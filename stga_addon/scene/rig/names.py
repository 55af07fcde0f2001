"""Names of a FLAME rig's shape keys, bones and properties, and the data paths that animate them."""

from collections.abc import Sequence
from typing import Any

from ...driving.names import ARKIT_SHAPES
from ...flame.model import FlameModel

IDENTITY_SLIDERS = 10
# Prefixes of shape keys; the number after one is the component, or the timestep.
EXPRESSION_KEY, IDENTITY_KEY, OFFSET_KEY = "expr_", "identity_", "offset_t"
EXPRESSION_NAMES = "stga_expressions"
"""Property of a head whose expressions have ARKit's names: these, separated by commas."""
# The joints that each part of a motion (`flame.motion.PARTS`) rotates.
PART_JOINTS = {"jaw": ("jaw",), "eyes": ("left_eye", "right_eye"), "neck": ("neck",), "head": ("root",)}
ROOT_LOCATION = 'pose.bones["root"].location'


def expression_key(head: Any, component: int) -> str:
    """The head's shape key of an expression component."""
    named = head.get(EXPRESSION_NAMES)
    return named.split(",")[component] if named else f"{EXPRESSION_KEY}{component:03d}"


def is_expression_key(name: str) -> bool:
    """Whether a head with a FLAME rig has the shape key for one of its expression components."""
    return name.startswith(EXPRESSION_KEY) or name in ARKIT_SHAPES


def identity_key(component: int) -> str:
    return f"{IDENTITY_KEY}{component:03d}"


def offset_key(timestep: int) -> str:
    return f"{OFFSET_KEY}{timestep:05d}"


def slider_components(model: FlameModel) -> dict[str, int]:
    """Shape key -> component of `model.shapedirs`: every expression, and the first `IDENTITY_SLIDERS` of identity."""
    names = model.expression_names or [f"{EXPRESSION_KEY}{k:03d}" for k in range(model.n_expression)]
    expressions = {name: model.n_identity + k for k, name in enumerate(names)}
    return expressions | {identity_key(k): k for k in range(min(IDENTITY_SLIDERS, model.n_identity))}


def offset_keys(head: Any) -> list[Any]:
    """The shape keys that hold tracked per-frame vertex offsets."""
    return [key for key in head.data.shape_keys.key_blocks if key.name.startswith(OFFSET_KEY)]


def parent_bone(joint: str) -> str:
    """The hidden bone that moves the bone of a joint whose position depends on the sliders."""
    return f"{joint}_joint"


def deform_bone(joint: str) -> str:
    """The hidden bone that the vertices of such a joint follow."""
    return f"{joint}_deform"


def sum_property(joint: str) -> str:
    """Property of the rig: partial sums of the joint's displacement by the sliders."""
    return f"stga_{joint}_sums"


def offset_property(joint: str) -> str:
    """Property of the rig: the joint's displacement by the tracked per-frame vertex offsets."""
    return f"stga_{joint}_offset"


def property_path(name: str) -> str:
    return f'["{name}"]'


def rotation_path(bone: str) -> str:
    return f'pose.bones["{bone}"].rotation_quaternion'


def location_path(bone: str) -> str:
    return f'pose.bones["{bone}"].location'


def key_value_path(shape_key: str) -> str:
    return f'key_blocks["{shape_key}"].value'


def is_of_parts(data_path: str, parts: Sequence[str]) -> bool:
    """Whether an f-curve of the rig or the shape keys animates one of the parts (`flame.motion.PARTS`)."""
    prefixes = [f'pose.bones["{bone}"].rotation_' for part in parts for bone in PART_JOINTS.get(part, ())]
    prefixes += [ROOT_LOCATION] if "head" in parts else []
    # The tracked per-frame offsets belong to the tracked expressions.
    if "expression" in parts:
        prefixes += [f'key_blocks["{EXPRESSION_KEY}', f'key_blocks["{OFFSET_KEY}', '["stga_']
        prefixes += [f'key_blocks["{name}"]' for name in ARKIT_SHAPES]
    return data_path.startswith(tuple(prefixes))
