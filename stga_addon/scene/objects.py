"""Creating, replacing and removing the objects of a capture."""

import logging
from collections.abc import Callable, Iterable
from math import radians
from pathlib import Path
from typing import Any

import bpy

from . import tags

# Receives one sentence for the user; operators pass their own report.
Warn = Callable[[str], None]
log_warning: Warn = logging.getLogger(__name__).warning


def capture_root(source: Path) -> Any:
    """The Empty that is the parent of all imported from the folder or file `source`; created where
    there is none.

    Captures are y-up and Blender is z-up: the Empty is rotated by +90° about X, so that its
    children keep the capture's own coordinates. It is in a collection of its own; both are called
    like the source.
    """
    existing = tags.find(tags.ROOT, source)
    if existing:
        return existing[0]
    name = source.resolve().stem
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new(name, None)
    root.empty_display_size = 0.1
    root.rotation_euler = (radians(90), 0, 0)
    collection.objects.link(root)
    tags.mark(root, tags.ROOT, source)
    return root


COLLECTIONS = {tags.RIG: "bones", tags.CAMERA: "cameras"}
"""Kinds of object that have a collection of their own, so that they can be hidden together."""


def collection_of(root: Any, kind: str) -> Any:
    """The collection of the root's objects of this kind; None where none was placed yet."""
    collection = root.users_collection[0]
    if kind not in COLLECTIONS:
        return collection
    return next((child for child in collection.children if child.get(tags.KIND) == kind), None)


def show_kind(root: Any, kind: str, view_layer: Any, show: bool) -> None:
    """Show or hide the root's objects of this kind in viewports only."""
    for layer in layers_of(root, kind, view_layer):
        layer.hide_viewport = not show


def layers_of(root: Any, kind: str, view_layer: Any) -> list[Any]:
    """The layer collections of `collection_of`, which may be linked in several places."""
    collection, waiting, found = collection_of(root, kind), [view_layer.layer_collection], []
    while collection is not None and waiting:
        layer = waiting.pop()
        waiting += layer.children
        if layer.collection == collection:
            found.append(layer)
    return found


def place(root: Any, kind: str, name: str, data: Any, existing: Any = None) -> Any:
    """An object of this kind under `root`, with new `data`; returns it.

    An object that exists from an earlier import is kept and given the new data, so that modifiers,
    parents and constraints which refer to it go on working; its old data, keyframes and drivers are
    removed.
    """
    obj = existing
    if obj is None:
        obj, collection = bpy.data.objects.new(name, data), collection_of(root, kind)
        if collection is None:
            collection = bpy.data.collections.new(f"{root.name} {COLLECTIONS[kind]}")
            collection[tags.KIND] = kind
            root.users_collection[0].children.link(collection)
        collection.objects.link(obj)
        obj.parent = root
    else:
        leave_edit_mode()
        old_data, old_action = obj.data, _action(obj)
        obj.animation_data_clear()
        obj.data = data
        _purge([old_data], [old_action])
        data.name = name
    tags.mark(obj, kind, Path(root[tags.CAPTURE]))
    return obj


def reset(obj: Any) -> None:
    """Remove keyframes, drivers and shape keys of a mesh object from an earlier import."""
    leave_edit_mode()
    actions = [_action(obj), _action(obj.data.shape_keys)]
    obj.animation_data_clear()
    if obj.data.shape_keys is not None:
        obj.shape_key_clear()
    _purge([], actions)


def leave_edit_mode() -> None:
    """Put the active object into object mode: data cannot be exchanged while it is edited."""
    active = bpy.context.view_layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def remove(objects: Iterable[Any]) -> None:
    """Delete objects with their data and actions."""
    for obj in list(objects):
        data, action = obj.data, _action(obj)
        bpy.data.objects.remove(obj)
        _purge([data], [action])


def _action(owner: Any) -> Any:
    return owner.animation_data.action if owner is not None and owner.animation_data else None


def _purge(datas: Iterable[Any], actions: Iterable[Any]) -> None:
    """Delete unused data-blocks, and the actions and background images that only they used."""
    left = list(actions)
    for data in datas:
        if data is None or data.users:
            continue
        left += [_action(data), _action(getattr(data, "shape_keys", None))]
        left += [background.image for background in getattr(data, "background_images", ())]
        bpy.data.batch_remove([data])
    bpy.data.batch_remove({block for block in left if block is not None and not block.users})
