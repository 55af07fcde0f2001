"""What a head was made from: capture, FLAME model, run and avatar, stored with the head.

Paths are absolute, or begin with "//" as long as there is nothing. With them is the .blend file
that they were stored in (`tags.STORED_IN`): where that was moved, they are found as they lay beside
it. A scene without a head that can be changed stores them itself.
"""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ..training.run.folder import MAX_FOLDERS_UP
from . import tags

PATH_TAGS = (tags.CAPTURE, tags.FLAME_MODEL, tags.RUN, tags.AVATAR, tags.WORLD)
"""Properties of a head, or of the world's splats, that are paths."""
SCENE_PATHS = ("training_run", "tracking_capture", "avatar_folder")
"""Properties of a scene's settings: what its last requests were about."""
COPIED = "copybuffer.blend"
"""The file through which Blender copies and pastes."""


def owner_of(scene: Any, head: Any) -> Any:
    """What stores the paths of the scene's head: the scene, where that is None or linked, or a
    library override, of which Blender saves no new properties."""
    if not tags.is_head(head):
        return scene
    return head if head.library is None and head.override_library is None else scene


def stored_path(owner: Any, tag: str) -> str:
    """A path of the head or scene, which may begin with "//" of the open file; "" for none."""
    value = str(owner.get(tag, ""))
    if owner.library is None or not value:
        return value
    file = _other_file(owner)
    return _found_for(tag, value, owner.get(tags.STORED_IN, file), file, moved_first=True)


def store_path(owner: Any, tag: str, value: str) -> None:
    owner[tag] = value
    if tags.STORED_IN not in owner:
        owner[tags.STORED_IN] = bpy.data.filepath


def displayed_path(value: str) -> str:
    """A path as panels show it: relative to the open file where it lies beside that or below."""
    if value and not value.startswith("//") and bpy.data.filepath:
        folder = Path(bpy.data.filepath).parent
        if Path(value).is_relative_to(folder):
            return f"//{Path(value).relative_to(folder).as_posix()}"
    return value


def capture_of(head: Any) -> Path:
    """The folder (or file) that a head was imported from."""
    return Path(stored_path(head, tags.CAPTURE))


def rebase(owners: Iterable[Any], file: str, moved_first: bool = True, source: str = "") -> None:
    """Store the paths of objects and scenes for the .blend file `file` ("": not saved).

    moved_first: whether a path is looked for beside `file` before where it was, as after loading.
    source: the file that they were appended from; "": the open one, which may have been moved.
    """
    pasted = os.path.basename(source) == COPIED
    for owner in owners:
        is_scene = owner.id_type == "SCENE"
        if other := _other_file(owner):  # here only, until the owner is made local
            if not is_scene:
                _rebase_stored(owner, owner.get(tags.STORED_IN, other), other, moved_first=True)
            continue
        before = owner.get(tags.STORED_IN, source or file)
        now = (before if pasted else source) or file
        _rebase_stored(owner, before, now, moved_first)
        for name in SCENE_PATHS if is_scene and hasattr(owner, "stga") else ():
            setattr(owner.stga, name, _found(getattr(owner.stga, name), before, now, moved_first))
        if is_scene or tags.STORED_IN in owner:
            owner[tags.STORED_IN] = file


def _other_file(owner: Any) -> str:
    """The file of what is linked or overridden; "" of what the open file has."""
    override = owner.override_library
    reference = owner if override is None else override.reference
    library = None if reference is None else reference.library
    return "" if library is None else os.path.normpath(bpy.path.abspath(library.filepath))


def _rebase_stored(owner: Any, before: str, now: str, moved_first: bool) -> None:
    stored = [tag for tag in PATH_TAGS if tag in owner]
    for tag in stored:
        owner[tag] = _found_for(tag, str(owner[tag]), before, now, moved_first)
    if stored:
        owner[tags.STORED_IN] = now


def rebase_file(file: str, moved_first: bool = False) -> None:
    """`rebase` all that the open file holds."""
    rebase([*bpy.data.objects, *bpy.data.scenes], file, moved_first)


def _found_for(tag: str, value: str, before: str, now: str, moved_first: bool) -> str:
    """`_found`; a capture, by which objects are found, without links of the file system."""
    found = _found(value, before, now, moved_first)
    is_capture = tag == tags.CAPTURE and os.path.exists(found)
    return os.path.realpath(found) if is_capture else found


def _found(value: str, before: str, now: str, moved_first: bool) -> str:
    """The path where it exists now: as it was, or as it lay beside the file before; else as it
    is."""
    if not value:
        return value
    places = [_absolute(value, before), *_beside(_absolute(value, before), before, now)]
    if moved_first:
        places.reverse()
    existing = (each for each in places if os.path.isabs(each) and os.path.exists(each))
    return next(existing, value)


def _absolute(value: str, file: str) -> str:
    if not value.startswith("//") or not file:
        return value
    return os.path.normpath(os.path.join(os.path.dirname(file), value[2:]))


def _beside(place: str, before: str, now: str) -> list[str]:
    """Where what lay beside one file, or at most `MAX_FOLDERS_UP` above it, lies beside another;
    also where only one of their paths goes through a link of the file system."""
    if not (before and now and os.path.isabs(place)) or before == now:
        return []
    found = list[str]()
    folder = os.path.dirname(before)
    for each in dict.fromkeys((folder, os.path.realpath(folder))):
        try:
            relative = os.path.relpath(place, each)
        except ValueError:  # on another drive
            continue
        if relative.split(os.sep).count(os.pardir) <= MAX_FOLDERS_UP:
            found.append(os.path.normpath(os.path.join(os.path.dirname(now), relative)))
    return found
