"""The objects of one capture in the scene: an Empty that turns y-up into z-up, and everything under it."""

import logging
from collections.abc import Callable, Iterable
from math import radians
from pathlib import Path
from typing import Any

import bpy

from . import tags

# Receives one sentence for a person to read; operators pass their own report.
Warn = Callable[[str], None]
log_warning: Warn = logging.getLogger(__name__).warning


def capture_root(source: Path, name: str | None = None) -> Any:
    """The Empty everything imported from the folder or file `source` hangs under; makes it where there is none.

    Captures are y-up and Blender is z-up: the Empty is rotated by +90° about X, so that what lies under it keeps the
    capture's own coordinates. It lives in a collection of its own; both are called `name` (default: source's name).
    """
    found = tags.find(tags.ROOT, source)
    if found:
        return found[0]
    name = name or source.resolve().stem
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new(name, None)
    root.empty_display_size = 0.1
    root.rotation_euler = (radians(90), 0, 0)
    collection.objects.link(root)
    tags.mark(root, tags.ROOT, source)
    return root


def place(root: Any, kind: str, name: str, data: Any, existing: Any = None) -> Any:
    """Put new `data` into the scene as an object of this kind under `root`.

    Where the object exists from an earlier import it stays and only its data is exchanged, so that modifiers, parents
    and constraints which point to it go on working; its old data, keyframes and drivers are removed.
    """
    thing = existing
    if thing is None:
        thing = bpy.data.objects.new(name, data)
        root.users_collection[0].objects.link(thing)
        thing.parent = root
    else:
        leave_edit_mode()
        old_data, old_action = thing.data, _action(thing)
        thing.animation_data_clear()
        thing.data = data
        _purge([old_data], [old_action])
        data.name = name
    tags.mark(thing, kind, Path(root[tags.CAPTURE]))
    return thing


def reset(thing: Any) -> None:
    """Take a mesh object of an earlier import back to its bare mesh: without keyframes, drivers and shape keys."""
    leave_edit_mode()
    actions = [_action(thing), _action(thing.data.shape_keys)]
    thing.animation_data_clear()
    if thing.data.shape_keys is not None:
        thing.shape_key_clear()
    _purge([], actions)


def leave_edit_mode() -> None:
    """Back to object mode, whichever mode the active object is in: what is being edited cannot be exchanged."""
    active = bpy.context.view_layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def remove(things: Iterable[Any]) -> None:
    """Delete objects with their data and actions."""
    for thing in list(things):
        data, action = thing.data, _action(thing)
        bpy.data.objects.remove(thing)
        _purge([data], [action])


def _action(owner: Any) -> Any:
    return owner.animation_data.action if owner is not None and owner.animation_data else None


def _purge(datas: Iterable[Any], actions: Iterable[Any]) -> None:
    """Delete data-blocks that nothing uses any more, and the actions and background images they leave behind."""
    left = [action for action in actions if action is not None]
    for data in datas:
        if data is None or data.users:
            continue
        left += [action for action in (_action(data), _action(getattr(data, "shape_keys", None))) if action]
        left += [background.image for background in getattr(data, "background_images", ()) if background.image]
        bpy.data.batch_remove([data])
    bpy.data.batch_remove({block for block in left if not block.users})
