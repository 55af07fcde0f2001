"""Reading objects as Blender evaluates them, also those that a view layer leaves out.

Blender evaluates what its viewports show, and what that refers to. A head that its splats cover is
hidden, so it would stand still wherever the splats are hidden, too: by their monitor, a collection
that is unchecked, or a modifier that is switched off.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from ..errors import StgaError
from . import tags

HELPER = "STGA evaluation"
"""Name of the object that keeps others evaluated."""
_kept: list[int] = []
"""Session ids of the objects that `kept_evaluated` keeps now."""


@contextmanager
def kept_evaluated(things: Iterable[Any]) -> Iterator[None]:
    """Let Blender evaluate objects in the block, also meshes' shapes and armatures' poses, whatever
    hides them; nothing is shown."""
    hidden = [each for each in dict.fromkeys(things) if each is not None and not _is_kept(each)]
    if not hidden:
        yield
        return
    scene = bpy.context.scene
    before = bpy.context.evaluated_depsgraph_get()
    helper = bpy.data.objects.new(HELPER, bpy.data.meshes.new(HELPER))
    uid = helper.session_uid
    scene.collection.objects.link(helper)
    helper.hide_render = True
    helper[tags.KIND] = tags.NOTE  # which a file loses that was saved meanwhile
    for thing in hidden:
        if thing.type == "ARMATURE":
            helper.modifiers.new(thing.name, "ARMATURE").object = thing
        elif thing.type == "MESH":
            helper.modifiers.new(thing.name, "SHRINKWRAP").target = thing
        else:
            helper.constraints.new("COPY_TRANSFORMS").target = thing
        if not thing.evaluated_get(before).is_evaluated:
            thing.update_tag(refresh={"TIME"})  # keyframes that nobody has asked for yet
    uids = [each.session_uid for each in hidden]
    _kept.extend(uids)
    try:
        bpy.context.view_layer.update()
        yield
    finally:
        for each in uids:
            _kept.remove(each)
        # not by the reference: undo, or another file, may have made it invalid
        for left in [each for each in bpy.data.objects if each.session_uid == uid]:
            bpy.data.meshes.remove(left.data)


def _is_kept(thing: Any) -> bool:
    return thing.session_uid in _kept or thing.visible_get()


def evaluated(thing: Any, depsgraph: Any) -> Any:
    """The object as it is evaluated. Raises StgaError where it is not, and stands still."""
    found = thing.evaluated_get(depsgraph)
    if not found.is_evaluated:
        remedy = "switch on its collection in the Outliner"
        raise StgaError(f"{thing.name}: is hidden, so Blender does not move it; {remedy}")
    return found


def require_moved(head: Any, modifier: Any, depsgraph: Any) -> None:
    """Raise StgaError where a head that is hidden stands still in the depsgraph's images, because
    the evaluated modifier that refers to it is switched off there."""
    is_render = depsgraph.mode == "RENDER"
    is_on = modifier.show_render if is_render else modifier.show_viewport
    is_moved = not head.hide_render if is_render else _is_kept(head)
    if not is_on and not is_moved:
        icon = "camera" if is_render else "monitor"
        problem = f"its modifier {modifier.name} is switched off, so its splats stand still"
        raise StgaError(f"{modifier.id_data.name}: {problem}; switch on its {icon}")
