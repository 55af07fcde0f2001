"""Keyframes of a FLAME head, names and data paths of what they move, and ARKit's 52 shapes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import bpy
import numpy as np

from ...driving.head_map import PRODUCTS, HeadMap
from ...driving.performance import ARKIT_SHAPES, COLUMN, COUNT, Performance, arkit_name
from ...driving.shapes import JAW_OPEN
from ...errors import StgaError
from ...flame.forward import FlameFrame, flame_forward, joint_positions
from ...flame.model import JOINTS, FlameModel
from ...flame.quaternions import continuous, from_axis_angle
from ...flame.sequence import PARTS, FlameSequence
from .. import tags
from ..arrays import (
    add_driver,
    flat_floats,
    key_points,
    read_values,
    write_curves,
    write_triangle_curves,
)
from ..compat import (
    action_curves,
    assign_action,
    copy_action,
    push_down_action,
    slot_of,
    strip_curves,
)
from ..objects import Warn, log_warning

IDENTITY_SLIDERS = 10
"""Components of identity, the first ones, that have a shape key."""
EXPRESSION_KEY = "expr_"
"""Prefix of an expression's shape key, before the number of its component."""
IDENTITY_KEY = "identity_"
"""Prefix of an identity's shape key, before the number of its component."""
OFFSET_KEY = "offset_t"
"""Prefix of the shape key of tracked vertex offsets, before the timestep."""
EXPRESSION_NAMES = "stga_expressions"
"""Property of a head whose expressions have ARKit's names: these, separated by commas."""
# The joints that each part of a motion (`PARTS`) rotates.
EYES = ("left_eye", "right_eye")
PART_JOINTS = {"jaw": ("jaw",), "eyes": EYES, "neck": ("neck",), "head": ("root",)}
numbered_key = f"{EXPRESSION_KEY}{{:03d}}".format
offset_key = f"{OFFSET_KEY}{{:05d}}".format
# The hidden bones of a displaced joint: that moves its bone, and that its vertices follow.
parent_bone = "{}_joint".format
deform_bone = "{}_deform".format
# Properties of the rig: partial sums of a displacement by sliders, and that by tracked offsets.
sum_property = "stga_{}_sums".format
offset_property = "stga_{}_offset".format
# Data paths of a property, of bones, and of a shape key.
property_path = '["{}"]'.format
key_value_path = 'key_blocks["{}"].value'.format
rotation_path = 'pose.bones["{}"].rotation_quaternion'.format
location_path = 'pose.bones["{}"].location'.format


def expression_key(head: Any, component: int) -> str:
    """The name of the head's shape key of an expression component, which may have been removed."""
    named = head.get(EXPRESSION_NAMES)
    return named.split(",")[component] if named else numbered_key(component)


def posing_bone(head: Any) -> str:
    """The bone to turn first: the jaw, or the neck where a shape moves the jaw."""
    return "neck" if EXPRESSION_NAMES in head else "jaw"


def expression_keys(head: Any) -> dict[int, str]:
    """Component -> shape key, of the expression components that a head has a shape key of. By name:
    users move and remove shape keys."""
    names = set(head.data.shape_keys.key_blocks.keys())
    named = head.get(EXPRESSION_NAMES)
    if named:
        return {k: name for k, name in enumerate(named.split(",")) if name in names}
    numbers = [name.removeprefix(EXPRESSION_KEY) for name in names]
    components = sorted(int(number) for number in numbers if number.isdecimal())
    return {k: numbered_key(k) for k in components if numbered_key(k) in names}


def check_sliders(head: Any, values: np.ndarray) -> None:
    """Raise StgaError where a head lacks a slider that expressions (T, C) move."""
    sliders = expression_keys(head)
    for component in np.flatnonzero(values.any(axis=0)).tolist():
        if component not in sliders:
            name = expression_key(head, component)
            raise StgaError(f"{head.name}: has no slider {name}; import the head again to get all")


def check_ranges(head: Any, values: np.ndarray) -> None:
    """Raise StgaError where expressions (T, C) need wider sliders of a mesh that is overridden:
    Blender does not save these."""
    for component, name in expression_keys(head).items():
        key = head.data.shape_keys.key_blocks[name]
        wanted = values[:, component]
        if not np.array_equal(wanted, np.clip(wanted, key.slider_min, key.slider_max)):
            problem = f"{name} needs a wider range, which Blender would not save with an override"
            raise StgaError(f"{head.name}: {problem}; make the head's mesh local")


def slider_components(model: FlameModel) -> dict[str, int]:
    """Shape key -> component of `model.shapedirs`: expressions, and the first of identity."""
    numbered = map(numbered_key, range(model.n_expression))
    names = enumerate(model.expression_names or numbered, model.n_identity)
    identity = range(min(IDENTITY_SLIDERS, model.n_identity))
    return {name: k for k, name in names} | {f"{IDENTITY_KEY}{k:03d}": k for k in identity}


def offset_keys(head: Any) -> list[Any]:
    """The shape keys that hold tracked per-frame vertex offsets."""
    return [key for key in head.data.shape_keys.key_blocks if key.name.startswith(OFFSET_KEY)]


def is_of_parts(data_path: str, parts: Sequence[str]) -> bool:
    """Whether an f-curve of rig or shape keys animates one of the parts (`PARTS`)."""
    prefixes = [f'pose.bones["{bone}"].rotation_' for bone in bones_of(parts)]
    prefixes += [location_path("root")] if "head" in parts else []
    # The tracked per-frame offsets belong to the tracked expressions.
    if "expression" in parts:
        prefixes += [f'key_blocks["{EXPRESSION_KEY}', f'key_blocks["{OFFSET_KEY}', '["stga_']
        prefixes += [f'key_blocks["{name}"]' for name in ARKIT_SHAPES]
    return data_path.startswith(tuple(prefixes))


def bones_of(parts: Sequence[str]) -> list[str]:
    return [bone for part in parts for bone in PART_JOINTS.get(part, ())]


UNCHANGED = 1e-6
"""Change of a slider's value below which it is not keyframed."""
MAX_SLIDER = 10.0
"""The widest range that Blender allows a shape key's value: -10 to 10."""
COEFFICIENT_RANGE = (-3.0, 3.0)
"""Range of a slider of a component without a name: standard deviations, or near to them."""


def slider_range(name: str) -> tuple[float, float]:
    """The range that a slider begins with; `widen` makes room for motions beyond."""
    return (0.0, 1.0) if name in ARKIT_SHAPES else COEFFICIENT_RANGE


def widen(key: Any, low: float, high: float) -> None:
    """Let a shape key's range, at which Blender clamps its value, hold these two as well."""
    key.slider_min = min(key.slider_min, low)
    key.slider_max = max(key.slider_max, high)


def key_motion(
    head: Any,
    rig: Any,
    at: np.ndarray,
    frames: Sequence[FlameFrame],
    parts: Sequence[str] = tuple(PARTS),
    warn: Warn = log_warning,
) -> None:
    """Add keyframes of the parts of `frames` to the actions of rig and shape keys. at: the Blender
    frame of each, ascending. A slider that never moves gets one keyframe."""
    if "expression" in parts:
        values = np.stack([frame.expr for frame in frames])
        names = expression_keys(head).items()
        paths = {k: key_value_path(name) for k, name in names if k < values.shape[1]}
        key_values(head.data.shape_keys, paths, at, values)
        if np.abs(values).max(initial=0.0) > MAX_SLIDER:
            row, component = np.unravel_index(np.abs(values).argmax(), values.shape)
            warn(
                f"{head.name}: expression {component} is {values[row, component]:.1f} at frame "
                f"{at[row]}, but Blender limits shape keys to ±{MAX_SLIDER:g}; the mesh differs "
                "from the tracked one there"
            )
    for bone in bones_of(parts):
        turns = np.stack([frame.pose[JOINTS.index(bone)] for frame in frames])
        write_curves(rig, rotation_path(bone), at, continuous(from_axis_angle(turns)))
    if "head" in parts:
        translations = np.stack([frame.translation for frame in frames])
        write_curves(rig, location_path("root"), at, translations)


def choose_signs(rig: Any, below: Mapping[str, np.ndarray]) -> None:
    """Give keyframed quaternions the sign that is nearer to what is below a strip at its two ends,
    bone -> (2, 4): Blender blends the four numbers, and between q and -q the bone would spin."""
    curves = action_curves(rig)
    for bone, ends in below.items():
        four = [curves.find(rotation_path(bone), index=index) for index in range(4)]
        points = np.stack([read_values(curve.keyframe_points, "co", 2) for curve in four])
        if (points[:, [0, -1], 1].T * ends).sum() >= 0:
            continue
        points[:, :, 1] *= -1
        for curve, places in zip(four, points, strict=True):
            curve.keyframe_points.foreach_set("co", places.ravel())
            curve.update()


def key_values(owner: Any, paths: dict[int, str], at: np.ndarray, values: np.ndarray) -> None:
    """Keyframe columns of values (T, C) of shape keys at their paths; one that stays 0 once."""
    keys = {key_value_path(key.name): key for key in owner.key_blocks}
    for column, path in paths.items():
        if path in keys and len(values):
            widen(keys[path], values[:, column].min(), values[:, column].max())
        keyed = slice(None if values[:, column].any() else 1)
        write_curves(owner, path, at[keyed], values[keyed, column])


def check_keyable(owner: Any) -> None:
    """Raise StgaError where keyframes of `owner` would have no effect."""
    if owner.animation_data is not None and owner.animation_data.use_tweak_mode:
        raise StgaError(f"{owner.name}: is in tweak mode in the NLA editor; leave tweak mode first")


def check_keyable_action(owner: Any) -> None:
    """Raise StgaError where keyframes cannot be added to the action of `owner`."""
    check_keyable(owner)
    action = owner.animation_data.action if owner.animation_data is not None else None
    if owner.library is not None or (action is not None and action.library is not None):
        remedy = "Apply Motion gives it keyframes of this file"
        raise StgaError(f"{owner.name}: has its keyframes in another file; {remedy}")


class Placement(NamedTuple):
    """Where keyframes of a motion go. start: the first frame; name: of the motion, which new
    actions get; parts: of PARTS, those that are replaced; as_strip: into a strip of the NLA editor,
    with effect only where it lasts, instead of a copy of the action; blend: frames at both of its
    ends over which it passes into what is below, another strip or the head's own animation."""

    start: int
    name: str
    parts: Sequence[str] = tuple(PARTS)
    as_strip: bool = False
    blend: float = 0.0


def push_down_motion(owner: Any, blend: float = 0.0) -> None:
    """Turn the action of rig or shape keys into a strip with effect only where it lasts: beside it
    the face is neutral, and the head stays where it was. blend: frames in which the strip's ends
    pass into the neutral face. Those of a performance are within it, as `Placement` has them; the
    capture's own motion plays whole, and its first and last pose stay for as long."""
    animation = owner.animation_data
    if animation is None or animation.action is None:
        return
    curves = action_curves(owner)
    if owner.id_type == "KEY":
        hold_beside_strips(owner, {each.data_path: 0.0 for each in curves})
    elif not animation.nla_tracks and any(is_of_parts(each.data_path, ["head"]) for each in curves):
        action = animation.action
        slot = slot_of(animation)
        is_kept = action.use_fake_user
        held = copy_action(owner, f"{owner.name} place")
        action.use_fake_user = is_kept
        for curve in [each for each in held if not is_of_parts(each.data_path, ["head"])]:
            held.remove(curve)
        animation.action[tags.HELD] = True
        push_down_action(owner)
        assign_action(animation, action, slot)
    is_performance = tags.PERFORMANCE in animation.action
    push_down_action(owner, "NOTHING")
    strip = animation.nla_tracks[-1].strips[0]
    if not is_performance:
        _hold_ends(strip, blend)
    _blend_ends(strip, blend)


def _hold_ends(strip: Any, duration: float) -> None:
    """Let a strip begin `duration` frames earlier and end as many later: its first and its last
    pose are held there."""
    strip.action_frame_start -= duration
    strip.action_frame_end += duration
    strip.frame_start_raw = strip.action_frame_start
    strip.frame_end_raw = strip.action_frame_end


def _blend_ends(strip: Any, blend: float) -> None:
    """Both ends, also where the motion is too short for the two."""
    limited = min(blend, (strip.frame_end - strip.frame_start) / 2)
    strip.blend_in = limited
    strip.blend_out = limited


def hold_beside_strips(owner: Any, values: Mapping[str, float]) -> None:
    """Let shape keys have these values by data path where no strip animates them, unless they have
    some already: there, Blender's own are 1."""
    animation = owner.animation_data
    is_new = not animation.nla_tracks
    lowest = None if is_new else next(iter(animation.nla_tracks[0].strips), None)
    if not is_new and (lowest is None or not lowest.action or tags.HELD not in lowest.action):
        return  # of an older version
    action = animation.action
    slot = slot_of(animation)
    if is_new:
        animation.action = bpy.data.actions.new(f"{owner.name} place")
        animation.action[tags.HELD] = True
    curves = action_curves(owner) if is_new else strip_curves(lowest)
    for path, value in values.items():
        if curves.find(path) is None:
            curves.new(path).keyframe_points.insert(0, value)
    if is_new:
        push_down_action(owner)
        assign_action(animation, action, slot)


@contextmanager
def new_actions(
    owners: Sequence[Any], placement: Placement, replaces: Callable[[str], bool]
) -> Iterator[None]:
    """Keyframe `owners` in new actions: copies less the replaced curves, or strips on the old."""
    for owner in owners:
        title = f"{owner.name} {placement.name}"
        if placement.as_strip:
            push_down_motion(owner, placement.blend)
            animation = owner.animation_data_create()
            animation.action = bpy.data.actions.new(title)
            continue
        curves = copy_action(owner, title)
        for curve in [curve for curve in curves if replaces(curve.data_path)]:
            curves.remove(curve)
    yield
    for owner in owners:
        owner.animation_data.action.use_fake_user = True
        owner.animation_data.action[tags.PERFORMANCE] = True
        if placement.as_strip:
            if owner.id_type == "KEY":
                paths = [each.data_path for each in action_curves(owner)]
                hold_beside_strips(owner, {path: owner.path_resolve(path) for path in paths})
            push_down_action(owner, extrapolation="NOTHING")
            _blend_ends(owner.animation_data.nla_tracks[-1].strips[0], placement.blend)


def key_tracked_offsets(
    head: Any, rig: Any, sequence: FlameSequence, numbers: Sequence[float]
) -> None:
    """Keyframe the per-frame offsets of the sequence that the head was imported from; numbers: the
    Blender frame of each timestep, ascending."""
    frames = sequence.frames()
    paths = [key_value_path(offset_key(timestep)) for timestep in sequence.timesteps]
    write_triangle_curves(head.data.shape_keys, paths, numbers)
    displacement = np.zeros((len(frames), len(JOINTS), 3))
    for row, frame in enumerate(frames):
        if frame.dynamic_offset is not None:
            displacement[row] = joint_positions(sequence.model, frame.dynamic_offset)
    for joint, name in enumerate(JOINTS):
        path = property_path(offset_property(name))
        write_curves(rig, path, numbers, displacement[:, joint])


def key_current_pose(head: Any, rig: Any, frame: int) -> None:
    """Keyframe pose and expression as they are now, set by hand or not, at `frame` alone."""
    for bone in JOINTS:
        rig.pose.bones[bone].keyframe_insert("rotation_quaternion", frame=frame)
    rig.pose.bones["root"].keyframe_insert("location", frame=frame)
    for curve in action_curves(head.data.shape_keys):
        name = curve.data_path.partition('"')[2].partition('"')[0]
        key = head.data.shape_keys.key_blocks.get(name)  # removing one leaves its keyframes
        if key is None or not (name.startswith(EXPRESSION_KEY) or name in ARKIT_SHAPES):
            continue
        value = key.value
        before = curve.evaluate(frame)
        if abs(value - before) < UNCHANGED:
            continue
        if len(curve.keyframe_points) == 1:  # the motion never moves this slider
            for neighbor in (frame - 1, frame + 1):
                curve.keyframe_points.insert(neighbor, before)
        curve.keyframe_points.insert(frame, value)


ARKIT_MAP = "stga_arkit_map"
"""Property of a FLAME head that was given the shapes: parameters (expression, jaw, eyes) by
feature of their weights (`head_map.features`)."""
NEGLIGIBLE_M = 1e-5  # displacement of a product of two shapes that gets no shape key


def has_shapes(head: Any) -> bool:
    """Whether a FLAME head was given ARKit's shapes."""
    return ARKIT_MAP in head


def added_shapes(head: Any) -> set[str]:
    """Names of the shape keys that `add_shapes` may have given a head."""
    if not has_shapes(head):
        return set()
    return {*ARKIT_SHAPES, *(product_key(column) for column in PRODUCTS.tolist())}


def product_key(column: int) -> str:
    """The shape key of what a shape adds to an open jaw."""
    return f"{ARKIT_SHAPES[column]} * jawOpen"


def head_shapes(sequence: FlameSequence, found: HeadMap) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (52, V, 3) of a person's neutral mesh by each shape at 1, and (PRODUCTS, V, 3)
    by what each of PRODUCTS at 1 adds to jawOpen at 1, or takes from it; meters."""
    open_jaw = np.eye(COUNT)[JAW_OPEN]
    weights = np.concatenate([np.zeros((1, COUNT)), np.eye(COUNT), np.eye(COUNT)[PRODUCTS]])
    weights[1 + COUNT :] += open_jaw
    frames = found.frames(Performance(np.arange(len(weights)), weights, np.zeros(3), 1.0))
    person = partial(flame_forward, sequence.model, sequence.shape)
    meshes = np.stack([person(frame, sequence.static_offset) for frame in frames])
    alone = meshes[1 : 1 + COUNT] - meshes[0]
    pairs = meshes[1 + COUNT :] - meshes[0]
    pairs = pairs - alone[PRODUCTS] - alone[JAW_OPEN]
    pairs[PRODUCTS == JAW_OPEN] = 0
    return alone, pairs


def add_shapes(head: Any, found: HeadMap, alone: np.ndarray, pairs: np.ndarray) -> None:
    """Give a FLAME head the shape keys of `head_shapes`, beside its own animation; those of
    products are driven. Sliders that it has already keep their values and keyframes."""
    keys = head.data.shape_keys
    basis = key_points(keys.reference_key)
    named = list(zip(ARKIT_SHAPES, alone, strict=True))
    named += [
        (product_key(column), displacement)
        for column, displacement in zip(PRODUCTS.tolist(), pairs, strict=True)
        if np.abs(displacement).max() > NEGLIGIBLE_M
    ]
    for name, displacement in named:
        key = keys.key_blocks.get(name)
        if key is None:
            key = head.shape_key_add(name=name, from_mix=False)
            key.value = 0.0  # a key made from a script starts at 1
            factors = [(keys, key_value_path(factor)) for factor in name.split(" * ")]
            if len(factors) == 2:
                widen(key, -MAX_SLIDER, MAX_SLIDER)
                variables = dict(zip("ab", factors, strict=True))
                add_driver(keys, key_value_path(name), -1, "a*b", variables)
        key.points.foreach_set("co", flat_floats(basis + displacement))
    rows = np.zeros((len(found.expressions), found.expressions.shape[1] + 9))
    rows[:, :-9] = found.expressions
    rows[:COUNT, -9:] = np.concatenate([found.jaw, found.eyes], axis=1)
    head[ARKIT_MAP] = rows.ravel().tolist()


def shape_key_names(head: Any) -> dict[int, str]:
    """Column of the 52 -> shape key that has its name in any spelling."""
    keys = head.data.shape_keys if head.type == "MESH" else None
    blocks = [] if keys is None else [block.name for block in keys.key_blocks[1:]]
    return {COLUMN[name]: block for block in reversed(blocks) if (name := arkit_name(block))}


def apply_weights(
    owner: Any, paths: dict[int, str], weights: np.ndarray, placement: Placement
) -> None:
    """Animate the values at `paths` (column -> data path) of `owner` by weights (T, 52), a row per
    frame, and keep the previous animation as `motion.apply_motion` does. Raises StgaError as
    `check_keyable` does."""
    check_keyable(owner)
    with new_actions([owner], placement, set(paths.values()).__contains__):
        key_values(owner, paths, placement.start + np.arange(len(weights)), weights)


def checked_shape_keys(head: Any) -> dict[int, str]:
    """Column -> data path of the keys with ARKit names. Raises StgaError without any."""
    names = shape_key_names(head)
    if not names:
        raise StgaError(
            f"{head.name}: has neither a FLAME rig nor shape keys with ARKit's names (jawOpen)"
        )
    return {column: key_value_path(name) for column, name in names.items()}
