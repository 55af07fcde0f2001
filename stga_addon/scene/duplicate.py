"""Copies of an avatar: head, bones, splats and keyframes; and avatars on other armatures' bones."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import bpy

from ..errors import StgaError
from . import tags
from .avatar_scene import place_beside
from .compat import assign_action, slot_of
from .display.splat_object import splat_modifier
from .evaluation import kept_evaluated
from .objects import COLLECTIONS, collections_of, layers_of, mover_of

COPIED = (tags.HEAD, tags.RIG, tags.SPLATS)
"""Kinds of object below the Empty that a copy of an avatar has: no cameras."""
BLOCKS = ("objects", "meshes", "armatures", "actions", "node_groups", "materials", "images")
"""Kinds of data that come with them."""


def duplicate_avatar(head: Any, linked: bool) -> Any:
    """Copy the avatar of a head beside all heads, into a collection of its own; the new head.

    linked: whether both play the same keyframes. Raises StgaError where the head cannot be copied.
    """
    root = _local_root(head)
    scene = bpy.context.scene
    if scene.objects.get(head.name) is not head:
        raise StgaError(
            f"{head.name}: is not in the scene {scene.name}; go to the one that it is in"
        )
    family = [root, *(part for part in root.children if part.get(tags.KIND) in COPIED)]
    before = set(_blocks())
    copies = _written_and_read(family)
    for original, copy in zip(family, copies, strict=True):
        _reuse_data(original, copy, linked)
    _collect(family, copies)
    unused = {block for block in set(_blocks()) - before if not block.users}
    while unused:
        bpy.data.batch_remove(unused)
        unused = {block for block in set(_blocks()) - before if not block.users}
    new_head = copies[family.index(head)]
    heads = tags.heads_of(bpy.context.scene)
    place_beside(new_head, [each for each in heads if each != new_head])
    return new_head


def _local_root(head: Any) -> Any:
    """The Empty that holds an avatar's parts. Raises StgaError without one, or for a linked one."""
    root = mover_of(head)
    if root is head or root.library is not None:
        raise StgaError(f"{head.name}: is linked, or has lost the Empty that holds it")
    return root


def _blocks() -> Iterator[Any]:
    for kind in BLOCKS:
        yield from getattr(bpy.data, kind)


def _written_and_read(family: list[Any]) -> list[Any]:
    """Copies of objects that point to each other where the originals do, by a file."""
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "avatar.blend")
        data = {part.data for part in family if part.data is not None}
        bpy.data.libraries.write(path, data | set(family))
        libraries = set(bpy.data.libraries)
        with bpy.data.libraries.load(path) as (_, wanted):
            wanted.objects = [part.name for part in family]
        bpy.data.batch_remove(set(bpy.data.libraries) - libraries)
    return list(wanted.objects)


def _reuse_data(original: Any, copy: Any, linked: bool) -> None:
    """Let a copy have the original's node tree, materials and bones' shapes; and its actions."""
    with suppress(StgaError):  # no splats
        splat_modifier(copy).node_group = splat_modifier(original).node_group
    for number, material in enumerate(getattr(original.data, "materials", ())):
        copy.data.materials[number] = material
    if original.get(tags.KIND) == tags.RIG:
        for bone in original.pose.bones:
            copy.pose.bones[bone.name].custom_shape = bone.custom_shape
    if not linked:
        return
    for owner, other in zip(_animated(original), _animated(copy), strict=True):
        if owner is not None and owner.animation_data is not None:
            action = owner.animation_data.action
            if action is not None:
                assign_action(other.animation_data, action, slot_of(owner.animation_data))


def _animated(thing: Any) -> Iterable[Any]:
    return thing, thing.data, getattr(thing.data, "shape_keys", None)


def _collect(family: list[Any], copies: list[Any]) -> None:
    """Put copies into new collections beside those of their originals, shown as these are."""
    root = family[0]
    new_root = copies[0]
    layer = bpy.context.view_layer
    # which cannot be copied
    made = {scene.collection: scene.collection for scene in bpy.data.scenes}
    for original, copy in zip(family, copies, strict=True):
        for collection in collections_of(original):
            if collection not in made:
                kind = collection.get(tags.KIND)
                name = f"{new_root.name} {COLLECTIONS[kind]}" if kind else new_root.name
                made[collection] = new = bpy.data.collections.new(name)
                if kind:
                    new[tags.KIND] = kind
                parent = _parent_of(collection)
                made.get(parent, parent).children.link(new)
            made[collection].objects.link(copy)
    for kind in COLLECTIONS:
        pairs = zip(layers_of(root, kind, layer), layers_of(new_root, kind, layer), strict=False)
        for layer_collection, new in pairs:
            new.hide_viewport = layer_collection.hide_viewport


def _parent_of(collection: Any) -> Any:
    every = [*(scene.collection for scene in bpy.data.scenes), *bpy.data.collections]
    parents = (each for each in every if collection.name in each.children)
    return next(parents, bpy.context.scene.collection)


def attach_to_bone(head: Any, armature: Any, bone: str) -> None:
    """Let an avatar ride on a bone of another armature, from where it is now; it keeps its own
    neck. bone "": let it go where it is. Raises StgaError."""
    root = _local_root(head)
    with kept_evaluated([armature]):
        _attach(root, armature, bone)


def _attach(root: Any, armature: Any, bone: str) -> None:
    place = root.matrix_world.copy()
    if bone and (armature is None or bone not in armature.data.bones):
        raise StgaError(f"{bone}: is no bone of {getattr(armature, 'name', 'an armature')}")
    if bone and root in _above(armature):
        raise StgaError(f"{armature.name}: belongs to the avatar itself")
    root.parent = armature if bone else None
    root.parent_type = "BONE" if bone else "OBJECT"
    root.parent_bone = bone
    if not bone:
        root.matrix_world = place
        return
    root.matrix_parent_inverse.identity()
    bpy.context.view_layer.update()
    basis = root.matrix_basis
    # its own location and rotation, which may have keyframes, stay
    to_bone = basis @ root.matrix_world.inverted() @ place @ basis.inverted()
    root.matrix_parent_inverse = to_bone


def _above(thing: Any) -> Iterator[Any]:
    while thing is not None:
        yield thing
        thing = thing.parent
