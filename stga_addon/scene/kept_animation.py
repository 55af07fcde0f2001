"""Keyframes and NLA strips that an import keeps: what an artist, or a performance, gave a head."""

import hashlib
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import bpy
import numpy as np

from ..driving.performance import ARKIT_SHAPES
from ..flame.model import JOINTS
from . import tags
from .compat import action_curves, all_curves, assign_action, curves_of_slot, slot_of, strip_curves

IMPORTED_CURVE = re.compile(
    rf'pose\.bones\["({"|".join(JOINTS)})"\]\.(rotation_quaternion|location)'
    rf'|key_blocks\["(t\d+|(expr_|identity_|offset_t)\d+|{"|".join(ARKIT_SHAPES)})"\]\.value'
    r'|\["stga_\w+"\]'
)
"""Data path of what an import, or a performance, keyframes; others are an artist's."""


def _is_added(curve: Any) -> bool:
    """Whether an f-curve of a rig or of shape keys moves what an artist added to them."""
    return IMPORTED_CURVE.fullmatch(curve.data_path) is None


def mark_imported(owner: Any) -> None:
    """Mark the action of `owner` as what an import has made."""
    animation = owner.animation_data
    if animation is not None and animation.action is not None:
        animation.action[tags.IMPORTED] = _digest(animation.action)


def is_made_by_hand(action: Any) -> bool:
    """Whether an action has other keyframes than an import gave it of what that moves, and other
    work is in them."""
    is_ours = tags.HELD in action or tags.PERFORMANCE in action
    return not is_ours and action.get(tags.IMPORTED) != _digest(action)


def _digest(action: Any) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for curve in all_curves(action):
        if _is_added(curve):
            continue
        places = np.empty(2 * len(curve.keyframe_points), np.float32)
        curve.keyframe_points.foreach_get("co", places)
        digest.update(f"{curve.data_path} {curve.array_index}".encode() + places.tobytes())
    return digest.hexdigest()


STRIP_FIELDS = (
    "action_frame_start",
    "action_frame_end",
    "scale",
    "repeat",
    "frame_start_raw",
    "frame_end_raw",
    "blend_type",
    "extrapolation",
    "use_auto_blend",
    "blend_in",
    "blend_out",
    "use_reverse",
    "use_animated_influence",
    "influence",
    "mute",
)
"""Fields of an NLA strip that `keep_animation` keeps, in an order in which they can be set."""


TRACK_FIELDS = ("name", "mute", "is_solo", "lock")
"""Fields of an NLA track that are kept."""
ACTION_FIELDS = ("action_blend_type", "action_extrapolation", "action_influence")
"""Kept fields that say how an owner's action acts on the strips below."""
STRIP_CURVES = ("influence", "strip_time")
"""Values of a strip that may have keyframes of their own."""
POINT_FIELDS = (
    "interpolation",
    "easing",
    "amplitude",
    "period",
    "back",
    "handle_left_type",
    "handle_right_type",
    "handle_left",
    "handle_right",
)
"""Fields of a keyframe beside its place, in an order in which they can be set."""
KeptPoint = tuple[tuple[float, float], dict[str, Any]]
"""A keyframe of a strip: place and fields."""


class KeptAnimation(NamedTuple):
    """What performances, and keyframes made by hand, gave an owner: NLA tracks, as fields and
    strips; values that shape keys have beside them, by data path; how its action acts; names of
    strips that scripts cannot make; the action in place of its own, with the slot's identifier,
    None for its own; the blend of the import's own strip; and a copy of its own action, with the
    slot's identifier, where that moves what an artist added."""

    tracks: list[tuple[dict[str, Any], list[tuple[Any, ...]]]]
    held: Mapping[str, float]
    fields: Mapping[str, Any]
    lost: list[str]
    action: Any = None
    slot: str | None = None
    blend: float = 0.0
    added: tuple[Any, str | None] | None = None


def keep_animation(owner: Any) -> KeptAnimation:
    """The animation of performances and made by hand, not the strips at the bottom, which that of
    the last import was pushed down to; nothing of None. An action of that import that was changed
    by hand stays in the file."""
    animation = owner.animation_data if owner is not None else None
    if animation is not None:
        animation.use_tweak_mode = False  # in which a strip's action is the owner's
    tracks = animation.nla_tracks if animation else ()
    lowest = [strip for strip in tracks[0].strips if strip.action] if tracks else []
    holding = [strip for strip in lowest if tags.HELD in strip.action]
    held = dict[str, float]()
    for strip in holding if holding and owner.id_type == "KEY" else ():
        held |= {each.data_path: each.evaluate(0) for each in strip_curves(strip)}
    imported_rows = 1 + bool(holding)
    kept = []
    lost = list[str]()
    blend = 0.0
    added = None
    for row, track in enumerate(tracks):
        strips = []
        for strip in _clips(track.strips, lost):
            is_imported = row < imported_rows and _is_of_import(strip.action, owner)
            if not is_imported or is_made_by_hand(strip.action):
                strip.action.use_fake_user = True
            if is_imported:
                blend = max(blend, strip.blend_out)
                added = added or _copy_if_added(strip.action, slot_of(strip))
                continue
            fields = {name: getattr(strip, name) for name in STRIP_FIELDS}
            found = ((path, strip.fcurves.find(path)) for path in STRIP_CURVES)
            points = {
                path: [_kept_point(each) for each in curve.keyframe_points]
                for path, curve in found
                if curve is not None
            }
            strips.append((strip.name, strip.action, slot_of(strip), fields, points))
        if strips:
            kept.append(({name: getattr(track, name) for name in TRACK_FIELDS}, strips))
    how = {name: getattr(animation, name) for name in ACTION_FIELDS if animation}
    action = animation.action if animation else None
    if action is None or (tags.PERFORMANCE not in action and _is_of_import(action, owner)):
        if action is not None:
            added = _copy_if_added(action, slot_of(animation))
        return KeptAnimation(kept, held, how, lost, blend=blend, added=added)
    action.use_fake_user = True
    return KeptAnimation(kept, held, how, lost, action, slot_of(animation), blend, added)


def _copy_if_added(action: Any, slot: str | None) -> tuple[Any, str | None] | None:
    """A copy of an action of an import, with the identifier of its slot, if that moves what an
    artist added."""
    if tags.HELD in action or not any(map(_is_added, curves_of_slot(action, slot))):
        return None
    return action.copy(), slot


def give_added_curves(owner: Any, kept: KeptAnimation) -> None:
    """Let the new action of an owner also move what an artist added, as the one before did."""
    if kept.added is None:
        return
    before, slot = kept.added
    curves = action_curves(owner)
    for curve in filter(_is_added, curves_of_slot(before, slot)):
        try:
            owner.path_resolve(curve.data_path)
        except ValueError:  # what it moved is gone
            continue
        _copy_curve(curve, curves.new(curve.data_path, index=curve.array_index))
    bpy.data.actions.remove(before)


def _copy_curve(curve: Any, copy: Any) -> None:
    """Give an empty f-curve keyframes, modifiers and fields of another one."""
    kept = [_kept_point(each) for each in curve.keyframe_points]
    for place, _ in kept:
        copy.keyframe_points.insert(*place)
    for point, (_, fields) in zip(copy.keyframe_points, kept, strict=True):
        for field, value in fields.items():
            setattr(point, field, value)
    for field in ("extrapolation", "mute"):
        setattr(copy, field, getattr(curve, field))
    for each in curve.modifiers:
        made = copy.modifiers.new(each.type)
        for field in each.bl_rna.properties:
            if not field.is_readonly:
                setattr(made, field.identifier, getattr(each, field.identifier))
    copy.update()


def _is_of_import(action: Any, owner: Any) -> bool:
    """Whether an import made the action for its owner: for shape keys and rigs. An object that is
    keyframed by hand shares the action of its shape keys from Blender 4.4 on."""
    is_made = tags.IMPORTED in action or tags.HELD in action
    is_made |= action.name.startswith((f"{owner.name} action", f"{owner.name} place"))
    return is_made and (owner.id_type == "KEY" or owner.type == "ARMATURE")


def _clips(strips: Any, lost: list[str]) -> Iterator[Any]:
    """Strips with actions, also those within meta strips; the names of others are added to
    `lost`."""
    for strip in strips:
        if strip.type == "META":
            yield from _clips(strip.strips, lost)
        elif strip.type == "CLIP" and strip.action is not None:
            yield strip
        if strip.type != "CLIP":
            lost.append(strip.name)


def _kept_point(point: Any) -> KeptPoint:
    fields = {name: getattr(point, name) for name in POINT_FIELDS}
    for side in ("handle_left", "handle_right"):
        fields[side] = tuple(fields[side])
    return tuple(point.co), fields


def give_animation(owner: Any, kept: KeptAnimation) -> None:
    """Give an owner kept tracks above those that it has, and the kept action in place of its
    own, which stays in the file, once."""
    if not kept.fields:
        return
    animation = owner.animation_data_create()
    for name, value in kept.fields.items():
        setattr(animation, name, value)
    for track_fields, strips in kept.tracks:
        track = animation.nla_tracks.new()
        for title, action, slot, fields, points in strips:
            strip = track.strips.new(title, int(fields["frame_start_raw"]), action)
            if slot is not None:
                strip.action_slot = action.slots[slot]
            for field, value in fields.items():
                setattr(strip, field, value)
            for path, places in points.items():
                curve = strip.fcurves.find(path)
                for place, fields in places if curve is not None else ():
                    point = curve.keyframe_points.insert(*place)
                    for field, value in fields.items():
                        setattr(point, field, value)
        for field, value in track_fields.items():
            setattr(track, field, value)
    if kept.action is not None:
        replaced = animation.action
        assign_action(animation, kept.action, kept.slot)
        if replaced is not None:
            _keep_once(replaced)


def _keep_once(action: Any) -> None:
    """Keep an import's action that nothing plays in the file, unless an earlier one is equal."""
    digest = action.get(tags.IMPORTED)
    others = [each for each in bpy.data.actions if each != action and is_unused_import(each)]
    if digest is not None and any(each.get(tags.IMPORTED) == digest for each in others):
        bpy.data.actions.remove(action)
    else:
        action.use_fake_user = True


def is_unused_import(action: Any) -> bool:
    """Whether an import made the action, as it is, and nothing plays it."""
    is_ours = tags.IMPORTED in action or tags.HELD in action
    return is_ours and action.users == action.use_fake_user and not is_made_by_hand(action)
