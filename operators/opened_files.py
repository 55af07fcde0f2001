"""What follows when a file is opened, saved, appended to, or changed: paths, and the head that the
panel works on."""

import os
from collections.abc import Iterable
from math import radians
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import APPENDED, SAVE_FAILED, stored_value
from ..stga_addon.scene.display.node_builder import Nodes, kept_material
from ..stga_addon.scene.display.splat_object import (
    followed_head,
    hide_covered,
    hide_in_layers,
    hide_object,
    replace_native_splats,
)
from ..stga_addon.scene.objects import collections_of, layers_with, local_scenes, mover_of, remove
from ..stga_addon.scene.record import owner_of, rebase, rebase_file, store_path, stored_path
from ..stga_addon.scene.render.viewport_display import is_displayed_as_trained
from ..stga_addon.scene.rig.head import bone_shapes
from ..stga_addon.scene.tags import is_head
from . import monitor
from .common import UNSAVED, AtEnd, is_run, register_handlers
from .results import HEADS, look_for_run
from .windows import redraw, show_panel


@persistent
def _before_save(path: str) -> None:
    rebase_file(path)
    if not bpy.app.is_job_running("RENDER"):
        _add_notes()


@persistent
def _after_save(path: str) -> None:
    """Also where saving has failed."""
    _remove_notes()
    if bpy.data.filepath != path:  # a copy was saved, or nothing
        rebase_file(bpy.data.filepath)
    manager = bpy.context.window_manager
    if bpy.data.filepath and UNSAVED in manager.stga_message:
        manager.stga_message = ""


NOTE = (
    "This avatar is drawn by the extension\nSTGA for Blender, which is not enabled.\n"
    "Enable it, or choose Camera Quads as\nDisplay of the splats' modifier."
)
NOTE_SIZE_M = 0.02


def _add_notes() -> None:
    """Let the file say what is missing where nobody draws its avatars; here it is gone again as
    soon as the file is written."""
    for scene in local_scenes():
        avatars = [each for each in scene.objects if is_displayed_as_trained(each)]
        for avatar in avatars[:1]:
            text = bpy.data.curves.new("STGA note", "FONT")
            text.body = NOTE
            text.size = NOTE_SIZE_M
            text.align_x = "CENTER"
            text.materials.append(kept_material("STGA note", _unlit, "DITHERED"))
            note = bpy.data.objects.new(text.name, text)
            note[tags.KIND] = tags.NOTE
            note.hide_render = True
            note.rotation_euler = (radians(90), 0, 0)
            note.location = avatar.matrix_world.translation
            scene.collection.objects.link(note)


def _unlit(nodes: Nodes) -> Any:
    return nodes.out("ShaderNodeEmission")


def _remove_notes() -> None:
    remove(each for each in bpy.data.objects if each.get(tags.KIND) == tags.NOTE)


@persistent
def _after_load(_: Any) -> None:
    monitor.forget_file()
    _remove_notes()
    rebase_file(bpy.data.filepath, moved_first=True)
    _read_older(bpy.data.objects)
    _choose_head()
    _log(replace_native_splats(bpy.data.objects))
    monitor.start_timer()


def _log(sentence: str) -> None:
    """Print a sentence, if it is not empty, and show it in the panel."""
    if sentence:
        print(f"STGA: {sentence}")
        bpy.context.window_manager.stga_message = sentence
        bpy.context.window_manager.stga_failed = False


@persistent
def _after_append(imported: Any) -> None:
    """Show what was appended or linked as its own file shows it, and let the panel find it."""
    scene = bpy.context.scene
    layer = bpy.context.view_layer
    appended = [item.id for item in imported.import_items if item.id is not None]
    _log(replace_native_splats(appended))
    for item in imported.import_items:
        thing = item.id
        if thing is None or tags.KIND not in thing:
            continue
        if isinstance(thing, bpy.types.Collection):  # of bones or cameras
            for layer_collection in layers_with(thing, layer):
                layer_collection.hide_viewport = True
        elif tags.WORLD in thing:
            hide_in_layers(thing, scene)
        elif tags.CONVENTION in thing:
            hide_covered(thing, scene)
        elif thing[tags.KIND] == tags.RIG:
            for shape in bone_shapes(thing):
                hide_object(shape, scene)
        if item.source_library is not None and not isinstance(thing, bpy.types.Collection):
            source = bpy.path.abspath(item.source_library.filepath)
            rebase([thing], bpy.data.filepath, source=source)
    _read_older(appended)
    _choose_head()


def _read_older(things: Iterable[Any]) -> None:
    """Move run and avatar from where older versions stored them, splats and scene, to the head."""
    for thing in things:
        if tags.CONVENTION not in thing or thing.library is not None:
            continue
        avatar = thing.pop(tags.AVATAR, "")
        thing.pop("stga_run", None)
        head = followed_head(thing)
        if avatar and head is not None and head.library is None and tags.AVATAR not in head:
            store_path(head, tags.AVATAR, avatar)
    for scene in local_scenes():
        owner = owner_of(scene, scene.stga.head)
        for name, tag in (("run_folder", tags.RUN), ("avatar", tags.AVATAR)):
            value = stored_value(scene.stga, name)
            if value:
                scene.stga.property_unset(name)
            if value and not owner.get(tag):
                store_path(owner, tag, value)


def _choose_head() -> None:
    """Let the panel work on the one head, and the splats, of a file that was made without it, as
    `stga demo` does, or into which an avatar was appended."""
    for scene in local_scenes():
        settings = scene.stga
        heads = tags.heads_of(scene)
        splats = list(filter(tags.is_splats, scene.objects))
        if settings.head is None and len(heads) == 1:
            settings.head = heads[0]
            show_panel()
            if settings.splats is None and len(splats) == 1:
                settings.splats = splats[0]
        for head in heads:
            avatar = stored_path(head, tags.AVATAR)
            folder = os.path.dirname(avatar)
            if (
                head.library is None
                and is_run(folder)
                and not is_run(stored_path(head, tags.RUN) or "//")
            ):
                store_path(head, tags.RUN, folder)
        look_for_run(settings)


_active: dict[int, int] = {}
"""Session id of a scene -> of the active object that the panel has followed."""


def _follow_active(scene: Any) -> None:
    """If the active object has changed, let the panel work on the head that it belongs to."""
    active = bpy.context.view_layer.objects.active if bpy.context.scene == scene else None
    followed = _active.get(scene.session_uid)
    if active is None or followed == active.session_uid:
        return
    _active[scene.session_uid] = active.session_uid
    if followed is None:  # first call for this scene: keep the saved head
        return
    family = (active, *mover_of(active).children)
    head = next((each for each in family if is_head(each)), scene.stga.head)
    if head != scene.stga.head:
        scene.stga.head = head
        redraw()


@persistent
def _after_update(scene: Any, *_: Any) -> None:
    """Let the panel follow the active object, and work on no head, and no splats, that were
    deleted: its pointers keep them."""
    _follow_active(scene)
    for name in ("head", "splats", *HEADS.values()):
        thing = getattr(scene.stga, name)
        if thing is not None and thing.name not in scene.objects and not collections_of(thing):
            setattr(scene.stga, name, None)


def register(at_end: AtEnd) -> None:
    handlers = bpy.app.handlers
    files = (handlers.load_post, _after_load), (APPENDED, _after_append)
    saving = (handlers.save_pre, _before_save), (handlers.save_post, _after_save)
    failed = (SAVE_FAILED, _after_save)
    register_handlers(
        at_end, *files, *saving, failed, (handlers.depsgraph_update_post, _after_update)
    )
