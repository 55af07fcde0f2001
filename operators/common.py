"""Shared by the operators: error reports, polls, paths, and the capture behind a head."""

import os
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import bpy
from bpy_extras.io_utils import ImportHelper

from ..stga_addon.capture.model import Capture
from ..stga_addon.capture.open import open_capture
from ..stga_addon.capture.transforms import DEFAULT_PRINCIPAL_POINT
from ..stga_addon.errors import StgaError
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.rig.head import rig_of
from ..stga_addon.scene.rig.keyframes import shape_key_names
from . import ids

MAX_REPORT_CHARACTERS = 90
"""Of what popup and status bar show of a report."""
PARENT_FOLDERS = re.compile(r"(?:[A-Za-z]:)?[\\/](?:[^\\/:;,()]+[\\/])+")


def reporting(execute: Callable[[Any, Any], set[str]]) -> Callable[[Any, Any], set[str]]:
    """Decorator of `execute`: a StgaError becomes the operator's error report, without a
    traceback; the pointer says that Blender is busy."""

    def guarded(self: Any, context: Any) -> set[str]:
        setattr(context.window_manager, ids.MESSAGE, "")
        window = context.window
        if window is not None:
            window.cursor_modal_set("WAIT")
        try:
            return execute(self, context)
        except StgaError as error:
            tell(self, "ERROR", str(error))
            return {"CANCELLED"}
        finally:
            if window is not None:
                window.cursor_modal_restore()

    return guarded


def tell(operator: Any, kind: str, sentence: str) -> None:
    """Report "ERROR" or "WARNING": as a whole without a window, else briefly, and as a whole in the
    panel."""
    brief, manager = short_sentence(sentence), bpy.context.window_manager
    operator.report({kind}, sentence if bpy.app.background else brief)
    # an operator that was called by another has told it at length
    if brief != short_sentence(getattr(manager, ids.MESSAGE)):
        setattr(manager, ids.MESSAGE, sentence)


def short_sentence(sentence: str) -> str:
    """At most MAX_REPORT_CHARACTERS: files without their folders, then the first of its clauses."""
    text = PARENT_FOLDERS.sub("", sentence)
    if len(text) <= MAX_REPORT_CHARACTERS:
        return text
    begin = text[: MAX_REPORT_CHARACTERS - 1]
    ends = [begin.rfind(mark) for mark in ("; ", ". ", ", ", " (")]
    end = max(ends) if max(ends) > MAX_REPORT_CHARACTERS / 3 else begin.rfind(" ")
    return f"{begin[:end]}…"


def scene_settings(context: Any) -> Any:
    """The scene's property group (`ui.properties.SceneSettings`)."""
    return getattr(context.scene, ids.SETTINGS)


def preferences(context: Any) -> Any:
    """The extension's preferences (`ui.preferences.Preferences`); None while it runs from a
    checkout."""
    addon = context.preferences.addons.get(package())
    return addon.preferences if addon else None


def package() -> str:
    """The extension's module name in Blender."""
    return str(__package__).rpartition(".")[0]


def head_of(context: Any) -> Any:
    """The scene's head. Raises StgaError where it has none."""
    head = scene_settings(context).head
    if not is_head(head):
        raise StgaError("No head in the scene; import a capture first")
    return head


def is_head(thing: Any) -> bool:
    """Whether an object (or None) is a head that was imported from a capture."""
    return thing is not None and thing.get(tags.KIND) == tags.HEAD


def polled(operator: Any, is_possible: bool, message: str) -> bool:
    """Poll: whether an operator can be called; where not, Blender shows the message, which says
    what to do."""
    if not is_possible:
        operator.poll_message_set(message)
    return is_possible


def needs_head(operator: Any, context: Any) -> bool:
    """Poll: whether a capture was imported."""
    return polled(operator, is_head(scene_settings(context).head), "Import a capture first")


def needs_own_head(operator: Any, context: Any) -> bool:
    """Poll: whether there is a head that can be changed here."""
    if not needs_head(operator, context):
        return False
    head = scene_settings(context).head
    is_own = head.library is None and head.data.library is None
    return polled(
        operator,
        is_own,
        "The head is linked from another file: open that file, or make the head local",
    )


def needs_rig(operator: Any, context: Any) -> bool:
    """Poll: whether there is a head with a FLAME rig that can be animated."""
    if not needs_own_head(operator, context):
        return False
    try:
        rig_of(scene_settings(context).head)
    except StgaError as error:
        operator.poll_message_set(str(error))
        return False
    return True


def needs_rig_or_shapes(operator: Any, context: Any) -> bool:
    """Poll: whether there is a head with a FLAME rig or with shape keys of ARKit's names."""
    if not needs_own_head(operator, context):
        return False
    return bool(shape_key_names(scene_settings(context).head)) or needs_rig(operator, context)


def rig_or_none(head: Any) -> Any:
    """The FLAME rig of a head; None where it has none, or is no head."""
    try:
        return rig_of(head) if is_head(head) else None
    except StgaError:
        return None


def path_property(
    name: str,
    description: str,
    subtype: str = "FILE_PATH",
    options: Collection[str] = (),
    **more: Any,
) -> Any:
    """A path, which may begin with "//"."""
    return bpy.props.StringProperty(
        name=name,
        description=description,
        subtype=subtype,
        options={*PATH_OPTIONS, *options},
        **more,
    )


def file_filter(*suffixes: str) -> Any:
    """The files that a file browser shows."""
    return bpy.props.StringProperty(
        default=";".join(f"*{suffix}" for suffix in suffixes), options={"HIDDEN"}
    )


class FileImport(ImportHelper):
    """Mixin of operators that import a file: asks for it, unless called with one, as when a file is
    dropped."""

    filepath: path_property("File", "File to import", options={"SKIP_SAVE"})

    def invoke(self, context: Any, event: Any) -> set[str]:
        if self.filepath:
            result: set[str] = self.execute(context)  # type: ignore[attr-defined]
            return result
        if bpy.data.filepath:  # else Blender proposes the .blend file's own name
            self.filepath = os.path.join(os.path.dirname(bpy.data.filepath), "")
        return super().invoke(context, event)  # type: ignore[no-any-return]


def flame_property() -> Any:
    """FLAME model of an import operator."""
    return path_property(
        "FLAME Model",
        "FLAME model file (.pkl or .npz), for captures and motions tracked with FLAME; empty: "
        "that of the preferences",
        options={"SKIP_SAVE"},
    )


def flame_model_path(context: Any, given: str = "") -> Path | None:
    """The FLAME model file `given`, else that of the preferences, else None."""
    preferred = preferences(context)
    path = given or (preferred.flame_model if preferred else "")
    return file_path(path, "FLAME model") if path else None


def capture_source(head: Any) -> tuple[Path, Path | None, str]:
    """The capture that a head was imported from, its FLAME model and its convention of principal
    points, as `open_capture` takes them."""
    model, point = (
        head.get(tags.FLAME_MODEL),
        head.get(tags.PRINCIPAL_POINT, DEFAULT_PRINCIPAL_POINT),
    )
    return Path(head[tags.CAPTURE]), Path(model) if model else None, point


def capture_of(head: Any) -> Capture:
    """Open the capture that a head was imported from. Raises StgaError where it has moved or
    changed."""
    return open_capture(*capture_source(head))


def flame_of(capture: Capture, name: str) -> FlameSequence:
    """The FLAME parameters of a capture. Raises StgaError where it has none; `name` says whose."""
    if capture.flame is None:
        raise StgaError(
            f"{name}: was not tracked with FLAME, so it has no parameters of expression and pose"
        )
    return capture.flame


def file_path(value: str, what: str) -> Path:
    """Absolute path of a path property. Raises StgaError where it is empty, or relative to a file
    never saved."""
    if not value:
        raise StgaError(f"{what}: no path given")
    if value.startswith("//") and not bpy.data.filepath:
        raise StgaError(
            f"{what}: {value} is relative to the .blend file, which has not been saved yet"
        )
    return Path(bpy.path.abspath(value))


def register_classes(classes: tuple[type, ...]) -> None:
    """Register all classes or none."""
    done: list[type] = []
    try:
        for cls in classes:
            bpy.utils.register_class(cls)
            done.append(cls)
    except Exception:
        unregister_classes(tuple(done))
        raise


def unregister_classes(classes: tuple[type, ...]) -> None:
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)
