"""The open .blend file, its scene and frames, and the objects of captures in it."""

import logging
import re
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from math import radians
from pathlib import Path
from typing import Any

import bpy

from ..errors import StgaError
from ..format import format_name
from . import tags
from .evaluation import kept_evaluated
from .kept_animation import is_made_by_hand
from .record import rebase_file

Warn = Callable[[str], None]
"""Receives one sentence for the user; operators pass their own report."""
log_warning: Warn = logging.getLogger(__name__).warning
"""Logs the sentence, where no operator reports it."""


AVATAR_SUFFIX = re.compile(r" avatar(?=( \d+)?$)")
"""End of the name of a folder with a video's capture and run
(`operators.track.proposed_folder`)."""


IMPORTED_AVATAR = re.compile(r"(.+)_avatar(?:_\d+)?")
"""A folder for the parts of an avatar's file (`operators.import_capture`)."""


def capture_root(source: Path) -> Any:
    """The Empty that is the parent of all imported from the folder or file `source`, made where
    missing, in a collection of its own, both called like the source, or as what a "capture" is in,
    such as that of a video. It turns captures, y up, by +90° about X: its children keep the
    capture's coordinates."""
    existing = tags.find(tags.ROOT, source)
    if existing:
        return existing[0]
    name = format_name(source)
    if name == "capture":
        name = AVATAR_SUFFIX.sub("", source.resolve().parent.name) or name
    elif name == "motion":
        imported = IMPORTED_AVATAR.fullmatch(source.resolve().parent.name)
        name = imported[1] if imported else name
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


def collections_of(thing: Any) -> list[Any]:
    """The collections that an object is in, without those of sets, which follow their scenes."""
    return [each for each in thing.users_collection if each.get(tags.KIND) != tags.SET]


def objects_of_images(layer: Any) -> Iterator[Any]:
    """The objects of a layer collection and its children that final images show, but for those that
    are hidden themselves; one that is in several comes several times."""
    if layer.exclude or layer.collection.hide_render:
        return
    yield from layer.collection.objects
    for child in layer.children:
        yield from objects_of_images(child)


def collection_of(root: Any, kind: str) -> Any:
    """The collection of the root's objects of this kind; None where none was placed yet."""
    collection = collections_of(root)[0]
    if kind not in COLLECTIONS:
        return collection
    return next((child for child in collection.children if child.get(tags.KIND) == kind), None)


def show_kind(root: Any, kind: str, view_layer: Any, show: bool) -> None:
    """Show or hide the root's objects of this kind in viewports only."""
    for layer in layers_of(root, kind, view_layer):
        layer.hide_viewport = not show


def layers_of(root: Any, kind: str, view_layer: Any) -> list[Any]:
    """The layer collections of `collection_of`, which may be linked in several places."""
    return layers_with(collection_of(root, kind), view_layer)


def layers_with(collection: Any, view_layer: Any) -> list[Any]:
    """The layer collections of a collection; none of None."""
    waiting = [view_layer.layer_collection]
    found = list[Any]()
    while collection is not None and waiting:
        layer = waiting.pop()
        waiting += layer.children
        if layer.collection == collection:
            found.append(layer)
    return found


def place(root: Any, kind: str, name: str, data: Any, existing: Any = None) -> Any:
    """An object of this kind under `root`, with new `data`. One of an earlier import is kept, with
    modifiers, parents and constraints that refer to it; its old data, keyframes and drivers go."""
    obj = existing
    if obj is None:
        obj = bpy.data.objects.new(name, data)
        collection = collection_of(root, kind)
        if collection is None:
            collection = bpy.data.collections.new(f"{root.name} {COLLECTIONS[kind]}")
            collection[tags.KIND] = kind
            collections_of(root)[0].children.link(collection)
        collection.objects.link(obj)
        obj.parent = root
        if kind != tags.CAMERA:
            lock(obj)
    else:
        leave_edit_mode()
        old_data = obj.data
        old_action = _action(obj)
        obj.animation_data_clear()
        obj.data = data
        _purge([old_data], [old_action])
        data.name = name
    tags.mark(obj, kind, Path(root[tags.CAPTURE]))
    return obj


def mover_of(part: Any) -> Any:
    """What moves an object of a capture with all that belongs to it: the capture's Empty."""
    root = part.parent
    return root if root is not None and root.get(tags.KIND) == tags.ROOT else part


def lock(part: Any) -> None:
    """Let nobody move an object of a capture away from what it belongs to."""
    for field in ("lock_location", "lock_rotation", "lock_scale"):
        setattr(part, field, (True, True, True))
    part.lock_rotation_w = True


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
        data = obj.data
        action = _action(obj)
        bpy.data.objects.remove(obj)
        _purge([data], [action])


def _action(owner: Any) -> Any:
    return owner.animation_data.action if owner is not None and owner.animation_data else None


def _purge(datas: Iterable[Any], actions: Iterable[Any]) -> None:
    """Delete unused data-blocks, and the actions and background images that only they used; actions
    made by hand stay in the file."""
    left = list(actions)
    for data in datas:
        if data is None or data.users:
            continue
        left += [_action(data), _action(getattr(data, "shape_keys", None))]
        left += [background.image for background in getattr(data, "background_images", ())]
        bpy.data.batch_remove([data])
    for block in left:
        if isinstance(block, bpy.types.Action) and is_made_by_hand(block):
            block.use_fake_user = True
    bpy.data.batch_remove({block for block in left if block is not None and not block.users})


def empty_file() -> None:
    """Start from an empty file; preferences and add-ons stay."""
    bpy.ops.wm.read_homefile(use_empty=True)


def save_file(path: Path) -> None:
    """Save the open file. Raises StgaError where it cannot be written."""
    file = str(path.resolve())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        rebase_file(file)
        bpy.ops.wm.save_as_mainfile(filepath=file, compress=True)
    except (OSError, RuntimeError) as error:
        raise StgaError(f"{path}: cannot be saved ({error})") from error


def frames_per_second(scene: Any) -> float:
    """At which the scene plays."""
    return float(scene.render.fps / scene.render.fps_base)


def set_frames_per_second(scene: Any, rate: float) -> None:
    """Let the scene play at the rate, which Blender holds as an integer and a divisor."""
    whole = max(1, round(rate))
    scene.render.fps = whole
    scene.render.fps_base = whole / rate


def local_scenes() -> list[Any]:
    """The scenes of the open file that are not linked."""
    return [scene for scene in bpy.data.scenes if scene.library is None]


class Identity:
    """A scene or an object for what lives across events: it is looked up each time, as undo and a
    loaded file make references invalid, and it may be renamed or removed."""

    def __init__(self, block: Any) -> None:
        self.uid = block.session_uid
        self.name = block.name  # when it was last found
        self._is_scene = block.id_type == "SCENE"

    def find(self) -> Any:
        """The scene or object; None where it is gone, as an object that is in no collection."""
        blocks = bpy.data.scenes if self._is_scene else bpy.data.objects
        found = blocks.get(self.name)
        if found is None or found.session_uid != self.uid:
            found = next((each for each in blocks if each.session_uid == self.uid), None)
        # A deleted object stays in the file as long as a panel's property points to it.
        if found is None or not (self._is_scene or collections_of(found)):
            return None
        self.name = found.name
        return found

    def get(self) -> Any:
        """The scene or object. Raises StgaError where it is gone."""
        found = self.find()
        if found is None:
            raise StgaError(f"{self.name}: was removed meanwhile")
        return found


class SceneView:
    """A scene and its view layer for what lives across events."""

    def __init__(self, context: Any) -> None:
        self.scene = Identity(context.scene)
        self._layer = context.view_layer.name

    @contextmanager
    def in_context(self) -> Iterator[Any]:
        """The scene, which is that of `bpy.context` in the block, whatever the window shows. Raises
        StgaError where scene or view layer is gone."""
        scene = self.scene.get()
        layer = scene.view_layers.get(self._layer)
        if layer is None:
            raise StgaError(f"{scene.name}: its view layer {self._layer} was removed meanwhile")
        with bpy.context.temp_override(scene=scene, view_layer=layer):
            yield scene


RENDER_INTERVAL_S = 0.2
"""Time between two checks whether Blender still renders."""


def is_rendering() -> bool:
    """Whether Blender renders an image or an animation (F12, Ctrl+F12) beside its interface."""
    return bool(bpy.app.is_job_running("RENDER"))


def after_render(act: Callable[[], None]) -> None:
    """Call `act` now, or where Blender renders as soon as that has ended."""

    def tick() -> float | None:
        if is_rendering():
            return RENDER_INTERVAL_S
        act()
        return None

    if tick() is not None:
        bpy.app.timers.register(tick, first_interval=RENDER_INTERVAL_S, persistent=True)


@contextmanager
def frame_kept(scene: Identity) -> Iterator[None]:
    """Go back to the scene's frame after the block, unless the scene is gone. Raises StgaError
    while Blender renders: another frame would get into the images of an animation."""
    now = scene.get()
    if is_rendering():
        problem = "Blender renders, and would get other frames"
        raise StgaError(f"{now.name}: {problem}; wait until the render has ended, or cancel it")
    frame = now.frame_current
    subframe = now.frame_subframe

    def go_back() -> None:
        if (found := scene.find()) is not None:
            found.frame_set(frame, subframe=subframe)

    try:
        yield
    finally:
        after_render(go_back)


def go_to_frame(frame: int) -> None:
    """Move the open scene to a frame and evaluate it."""
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()


def show_progress(fraction: float) -> None:
    """At the mouse pointer, between `progress_begin(0, 1)` and `progress_end`. Nothing without a
    display, where Blender crashes once a file has brought a window."""
    if not bpy.app.background:
        bpy.context.window_manager.progress_update(fraction)


def iterate_frames(
    numbers: Iterable[int], things: Iterable[Any] = ()
) -> Generator[int, None, None]:
    """Set each frame in turn, with progress at the mouse pointer; restore the current one last.
    things: objects that are read in each."""
    scene = Identity(bpy.context.scene)
    numbers = list(numbers)
    bpy.context.window_manager.progress_begin(0, 1)
    with frame_kept(scene), kept_evaluated(things):
        try:
            for index, number in enumerate(numbers):
                scene.get().frame_set(number)
                show_progress(index / len(numbers))
                yield number
        finally:
            bpy.context.window_manager.progress_end()
