"""What operators share: their base, polls, paths, and the capture behind a head."""

import os
import re
import traceback
from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any

import bpy
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ..stga_addon.capture.open import open_capture
from ..stga_addon.capture.transforms import DEFAULT_PRINCIPAL_POINT
from ..stga_addon.errors import StgaError, telling_refusals
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.progress import Cancelled
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import mover_of
from ..stga_addon.scene.record import capture_of, stored_path
from ..stga_addon.scene.rig.head import check_editable, check_local, find_rig, usable_rig
from ..stga_addon.scene.rig.keyframes import shape_key_names
from ..stga_addon.scene.tags import is_head
from ..stga_addon.schema import alternatives, check_encodable, type_hints
from ..stga_addon.training.run.folder import has_run
from . import options
from .options import ONCE

TAB = "STGA"
"""Tab of the 3D viewport's sidebar."""
MAX_REPORT_CHARACTERS = 90
"""Length of what popup and status bar show of a report."""
UNSAVED = "has not been saved yet"
"""Part of messages that saving the file makes obsolete."""
PARENT_FOLDERS = re.compile(r"(?:[A-Za-z]:)?[\\/](?:[^\\/:;,()]+[\\/])+")
"""Folders in front of a file's name in a sentence."""
Poll = Callable[[Any, Any], bool]
"""Whether an operator can be called: takes its class and the context."""
AtEnd = Callable[..., Any]
"""`ExitStack.callback` of the extension: takes a function, with its arguments, that undoes what was
just registered."""


class Action:
    """Mixin of operators that `run(context)` where every poll of `needs` holds. Identifier and, if
    it has no other, label are the name of the class: `SolveAgain` is "stga.solve_again"."""

    bl_options = frozenset({"REGISTER"})
    bl_idname: str
    bl_label: str
    needs: tuple[Poll, ...] = ()
    run: Any

    def __init_subclass__(cls) -> None:
        words = re.findall("[A-Z][a-z]*", cls.__name__)
        cls.bl_idname = f"stga.{'_'.join(words).lower()}"
        if "bl_label" not in vars(cls):
            cls.bl_label = " ".join(words)

    @classmethod
    def poll(cls, context: Any) -> bool:
        return all(need(cls, context) for need in cls.needs)

    def execute(self, context: Any) -> set[str]:
        """A StgaError becomes an error report, without a traceback, and nothing that is returned
        FINISHED; the pointer says that Blender is busy, and how far it is (`show_progress`)."""
        manager = context.window_manager
        window = context.window
        manager.stga_message = ""
        manager.stga_failed = False
        if window is not None:
            manager.progress_begin(0, 1)
            window.cursor_modal_set("WAIT")
        try:
            with telling_refusals():
                return self.run(context) or {"FINISHED"}
        except StgaError as error:
            self.notify("ERROR", str(error))
            return {"CANCELLED"}
        except Cancelled as error:
            self.notify("WARNING", str(error) or "Cancelled")
            return {"CANCELLED"}
        finally:
            if window is not None:
                manager.progress_end()
                window.cursor_modal_restore()

    def inform(self: Any, sentence: str) -> None:
        self.report({"INFO"}, sentence)

    def warn(self, sentence: str) -> None:
        self.notify("WARNING", sentence)

    def notify(self: Any, kind: str, sentence: str) -> None:
        """Report "ERROR" or "WARNING": as a whole without a window, else briefly, and as a whole in
        the panel, there after the warnings of before."""
        brief = short_sentence(sentence)
        manager = bpy.context.window_manager
        self.report({kind}, sentence if bpy.app.background else brief)
        is_error = kind == "ERROR"
        messages = [] if is_error or manager.stga_failed else manager.stga_message.splitlines()
        # an operator that was called by another has said it at length
        if brief != short_sentence(manager.stga_message):
            manager.stga_message = "\n".join([*messages, sentence])
        manager.stga_failed = is_error


class Edit(Action):
    """Mixin of operators that change the file: a step to undo."""

    bl_options = frozenset({"REGISTER", "UNDO"})


StepGenerator = Generator[None, None, None]


class Steps:
    """Work beside the interface that lives across events: a generator, a step at each event of a
    timer. It keeps `Identity` and `SceneView`, never references, from one step to the next.

    However it ends, the generator ends once, with what it cleans up, and so does the timer: by its
    last step, an error, `close`, or where the extension ends.
    """

    def __init__(self, steps: StepGenerator, interval_s: float) -> None:
        self._steps = steps
        self._is_cancelled = False
        manager = bpy.context.window_manager
        self._timer = manager.event_timer_add(interval_s, window=bpy.context.window)
        _begun.append(self)

    def step(self, cancel: bool = False) -> bool:
        """Do a step; whether others follow. cancel: raise Cancelled in it, once; the steps that it
        still takes end what cannot end at once. Raises what the step raises."""
        throws = cancel and not self._is_cancelled
        self._is_cancelled |= cancel
        goes_on = False
        try:
            if throws:
                self._steps.throw(Cancelled())
            else:
                next(self._steps)
            goes_on = True
        except StopIteration:
            pass
        finally:
            if not goes_on:
                self.close()
        return goes_on

    def close(self) -> None:
        """End it now."""
        if self in _begun:
            _begun.remove(self)
            bpy.context.window_manager.event_timer_remove(self._timer)
            self._steps.close()


_begun: list[Steps] = []


def close_steps() -> None:
    """End all that is done in steps: Blender cancels no operator that it unregisters."""
    for steps in list(_begun):
        steps.close()


class Stepwise(Action):
    """Mixin of operators that work in steps beside the interface, until Esc or the window's end.

    others: what becomes of other events meanwhile
    """

    others = "RUNNING_MODAL"
    _steps: Steps | None = None

    def begin(self, context: Any, steps: StepGenerator, interval_s: float) -> set[str]:
        self._steps = Steps(steps, interval_s)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self: Any, context: Any, event: Any) -> set[str]:
        cancels = event.type == "ESC" and event.value == "PRESS"
        if not cancels and event.type != "TIMER":
            return {self.others}
        try:
            with telling_refusals():
                is_running = self._steps.step(cancels)
            return {"RUNNING_MODAL" if is_running else "FINISHED"}
        except Cancelled as error:
            if str(error):
                self.report({"WARNING"}, str(error))
        except StgaError as error:
            self.notify("ERROR", str(error))
        except Exception as error:
            self.notify("ERROR", f"Ended by an unexpected {describe(error)}")
        return {"CANCELLED"}

    def cancel(self, context: Any) -> None:
        if self._steps is not None:
            self._steps.close()


def describe(error: Exception) -> str:
    """Print the traceback of an error that is being handled; its description for a sentence."""
    traceback.print_exc()
    return f"error ({type(error).__name__}: {error}); see the console"


def call(operator: Any, *arguments: Any, **options: Any) -> set[str]:
    """Call another operator. Raises StgaError with what it reports as an error."""
    try:
        result: set[str] = operator(*arguments, **options)
    except RuntimeError as error:
        raise StgaError(str(error).strip().removeprefix("Error: ")) from error
    return result


def short_sentence(sentence: str) -> str:
    """At most MAX_REPORT_CHARACTERS: files without their folders, then the first of its clauses."""
    text = PARENT_FOLDERS.sub("", sentence)
    if len(text) <= MAX_REPORT_CHARACTERS:
        return text
    begin = text[: MAX_REPORT_CHARACTERS - 1]
    end = max(begin.rfind(mark) for mark in ("; ", ". ", ", ", " ("))
    return f"{begin[: end if end > MAX_REPORT_CHARACTERS / 3 else begin.rfind(' ')]}…"


def preferences(context: Any) -> Any:
    """The extension's preferences (`ui.properties`); None while it runs from a checkout."""
    addon = context.preferences.addons.get(package())
    return addon.preferences if addon else None


def package() -> str:
    """The extension's module name in Blender."""
    return str(__package__).rpartition(".")[0]


def scene_frames(scene: Any) -> range:
    return range(scene.frame_start, scene.frame_end + 1)


# The head


def head_of(context: Any) -> Any:
    """The scene's head. Raises StgaError where it has none."""
    head = context.scene.stga.head
    if not is_head(head):
        raise StgaError("No head in the scene; import a capture first")
    return head


def is_run(folder: str) -> bool:
    """Whether a path, which may begin with "//", is the folder of a run."""
    return bool(folder) and has_run(Path(bpy.path.abspath(folder)))


def rig_or_none(head: Any) -> Any:
    """The FLAME rig of a head that can be posed here; None where there is none."""
    try:
        return usable_rig(head) if is_head(head) else None
    except StgaError:
        return None


def rig_problem(head: Any) -> str:
    """Why a head's FLAME rig cannot be posed here; "" where it can, or there is none."""
    try:
        if is_head(head):
            rig_or_shapes(head)
    except StgaError as error:
        return str(error)
    return ""


def rig_or_shapes(head: Any) -> Any:
    """The FLAME rig of a head; None where it has none, but shape keys. Raises StgaError where the
    rig cannot be posed here."""
    return None if find_rig(head) is None else usable_rig(head)


def capture_source(head: Any) -> tuple[Path, Path | None, str]:
    """`stored_source` of a head. Raises StgaError where the capture is gone."""
    source = stored_source(head)
    if not source[0].exists():
        remedy = "Import Capture from where it is now gives it to this head"
        raise StgaError(f"{head.name}: its capture is no longer at {source[0]}; {remedy}")
    return source


def stored_source(head: Any) -> tuple[Path, Path | None, str]:
    """The capture that a head was imported from, its FLAME model and its convention of principal
    points, as `open_capture` takes them."""
    model = stored_path(head, tags.FLAME_MODEL)
    point = tags.PRINCIPAL_POINT
    model_file = Path(model) if model else None
    return capture_of(head), model_file, head.get(point, DEFAULT_PRINCIPAL_POINT)


def recorded_motion(head: Any) -> FlameSequence:
    """FLAME parameters of the capture that a head was imported from. Raises StgaError where it has
    none."""
    return open_capture(*capture_source(head)).flame_motion(head.name)


# Polls


def polled(operator: Any, is_possible: bool, message: str) -> bool:
    """Poll: whether an operator can be called; where not, Blender shows the message."""
    if not is_possible:
        operator.poll_message_set(message)
    return is_possible


def need(is_met: Callable[[Any], Any], message: str) -> Poll:
    """Poll: whether `is_met(context)`."""
    return lambda operator, context: polled(operator, bool(is_met(context)), message)


needs_head = need(lambda context: is_head(context.scene.stga.head), "Import a capture first")


def _head_that(check: Callable[[Any], object]) -> Poll:
    """Poll: whether there is a head on which `check` raises no StgaError."""

    def poll(operator: Any, context: Any) -> bool:
        if not needs_head(operator, context):
            return False
        try:
            check(context.scene.stga.head)
        except StgaError as error:
            return polled(operator, False, str(error))
        return True

    return poll


needs_editable_head = _head_that(check_editable)  # that can be changed here
needs_local_head = _head_that(check_local)  # that may be overridden
needs_rig = _head_that(usable_rig)  # with a FLAME rig that can be animated
needs_bones = _head_that(partial(usable_rig, with_sliders=False))  # that can be posed


def needs_rig_or_shapes(operator: Any, context: Any) -> bool:
    """Poll: whether there is a head with a FLAME rig or with shape keys of ARKit's names."""
    head = context.scene.stga.head
    has_shapes = is_head(head) and find_rig(head) is None and shape_key_names(head)
    return (needs_editable_head if has_shapes else needs_rig)(operator, context)


# Files


class FileImport(ImportHelper):
    """Mixin of operators that import a file: asks for it, unless it was dropped or is given."""

    filepath: options.path("File", "File to import", options=ONCE)

    def invoke(self: Any, context: Any, event: Any) -> set[str]:
        if self.filepath:
            return self.execute(context)
        beside = bpy.data.filepath
        head = context.scene.stga.head
        hidden = bpy.utils.resource_path("USER")  # where the demo lies
        if is_head(head) and not str(capture_of(head)).startswith(hidden):
            beside = str(capture_of(head))
        if beside:  # else Blender proposes the .blend file's own name
            self.filepath = os.path.join(os.path.dirname(beside), "")
        return super().invoke(context, event)


class FileExport(ExportHelper):
    """Mixin of operators that export a file: proposes the head's name beside its run, until the
    .blend file has a name."""

    def invoke(self: Any, context: Any, event: Any) -> set[str]:
        settings = context.scene.stga
        if not (self.filepath or bpy.data.filepath) and is_head(settings.head):
            run = bpy.path.abspath(settings.run_folder).rstrip("/\\")
            name = bpy.path.clean_name(mover_of(settings.head).name)
            self.filepath = os.path.join(os.path.dirname(run), name)
            self.check(context)  # which appends the suffix
        return super().invoke(context, event)


def flame_model_path(context: Any, given: str = "") -> Path | None:
    """The FLAME model file `given`, else that of the preferences, else None."""
    preferred = preferences(context)
    path = given or (preferred.flame_model if preferred else "")
    return file_path(path, "FLAME model") if path else None


def file_path(value: str, what: str) -> Path:
    """Absolute path of a property. Raises StgaError where it is empty, relative to no file, or no
    path that files and other programs can hold (`check_encodable`)."""
    if not value:
        raise StgaError(f"{what}: no path given")
    if value.startswith("//") and not bpy.data.filepath:
        raise StgaError(f"{what}: {value} is relative to the .blend file, which {UNSAVED}")
    path = Path(bpy.path.abspath(value))
    check_encodable(path)
    return path


def given_values(operator: Any, kind: Any, *names: str) -> dict[str, Any]:
    """Field -> value of an operator's properties, of those that are not left at None."""
    found = {}
    for name in names:
        value = getattr(operator, name)
        hints = alternatives(type_hints(kind)[name])
        if Path in hints and value:
            value = file_path(value, name.replace("_", " ")).resolve()
        if value or NoneType not in hints:
            found[name] = value
    return found


# Registration


def register_classes(classes: Iterable[type], at_end: AtEnd) -> None:
    for cls in classes:
        bpy.utils.register_class(cls)
        at_end(bpy.utils.unregister_class, cls)


def register_handlers(at_end: AtEnd, *handlers: tuple[list[Any], Callable[..., None]]) -> None:
    """handlers: lists of `bpy.app.handlers`, and what is called from each."""
    for called, handler in handlers:
        called.append(handler)
        at_end(called.remove, handler)
