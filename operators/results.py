"""How the result of each kind of request reaches the scene, and what the scene stores of it."""

import json
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.monitor_state import RequestState, Shown, SliceBuilt
from ..stga_addon.jobs.perform import read_request, read_result
from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, RUN_FOLDER
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import show_world
from ..stga_addon.scene.display import splat_object
from ..stga_addon.scene.display.splat_attributes import SplatAttributes, avatar_attributes
from ..stga_addon.scene.vertex_groups import write_selection
from ..stga_addon.tracking.folder import is_flame
from ..stga_addon.training.run.folder import AVATAR, TRACKING
from .common import is_head
from .select import count_selected

Answer = SliceBuilt | Shown | None
"""What a function of `SHOW` returns; None: the result is still being read."""


def _operate(scene: Any, operator: Any, **options: Any) -> Shown:
    """Call an operator, which reports in the window that shows the scene, if there is one; undo
    takes it back there."""
    windows = bpy.context.window_manager.windows
    window = next((each for each in windows if each.scene == scene), None)
    place = {"window": window} if window is not None else {"scene": scene}
    with bpy.context.temp_override(**place):
        operator("EXEC_DEFAULT", window is not None, **options)
    return Shown()


# Avatars


_pool = ThreadPoolExecutor(1, "stga")
_loading: dict[int, Future[tuple[Avatar, SplatAttributes]]] = {}
"""Session id of a scene -> the avatar file that a thread reads for it."""


def load_avatar(scene: Any, path: Path) -> None:
    """Read an avatar file in a thread, for `SHOW`."""
    _loading[scene.session_uid] = _pool.submit(_read, path)


def _read(path: Path) -> tuple[Avatar, SplatAttributes]:
    avatar = read_avatar(path)
    return avatar, avatar_attributes(avatar)


def stop_loading() -> None:
    for future in _loading.values():
        future.cancel()
    _loading.clear()


def _run(state: RequestState) -> Path:
    """The run that is trained, as the scene names it."""
    return state.subject / RUN_FOLDER if state.kind == Kind.AVATAR else state.subject


def _run_object(scene: Any, state: RequestState) -> Any:
    """The object that shows the run, or None."""
    return next((thing for thing in scene.objects if thing.get(tags.RUN) == str(_run(state))), None)


def _show_avatar(scene: Any, state: RequestState) -> Answer:
    """Show the avatar that was loaded, in the run's object or in a new one, a slice at a time."""
    loading = _loading[scene.session_uid]
    run = _run(state)
    if not loading.done():
        return None
    head = scene.stga.head
    shown = _run_object(scene, state)
    if not is_head(head):
        raise StgaError("No head in the scene to show the avatar on; import the capture")
    avatar, attributes = loading.result()
    splat_object.check_head(avatar, head)
    is_update = shown is not None and splat_object.can_update(shown, avatar)
    if not is_update and splat_object.build_next_node_group(avatar):
        return SliceBuilt()
    del _loading[scene.session_uid]
    if is_update:
        splat_object.update_splats(shown, attributes)
    else:
        if shown is not None:
            bpy.data.objects.remove(shown)
        shown = splat_object.show_avatar(avatar, head, f"{head.name} {run.name}", attributes)
        shown[tags.RUN] = str(run)
        splat_object.hide_object(head, scene)
        scene.stga.splats = shown
    show_world(run / AVATAR, head)
    return Shown(undoable=not is_update)


def _show_made(scene: Any, state: RequestState) -> Answer:
    """Import the capture once it is tracked; then show the previews and the avatar, at last on the
    head that training refined."""
    head = scene.stga.head
    if state.loading.name == CAPTURE_FOLDER:
        scene.stga.run_folder = str(_run(state))
        is_there = is_head(head) and Path(head[tags.CAPTURE]) == state.loading
        return Shown() if is_there else _import(scene, state)
    answer = _show_avatar(scene, state)
    is_refined = state.loading.name == AVATAR and state.files.tracking is not None
    if isinstance(answer, Shown) and is_refined:
        refined = str(state.run / TRACKING)
        first = head[tags.TIMESTEPS][0]
        _operate(scene, bpy.ops.stga.apply_motion, filepath=refined, own_offsets=True, start=first)
    return answer


def _store_light(scene: Any, state: RequestState) -> Answer:
    """Give the scene's splats the light that is now in the avatar of the run."""
    shown = scene.stga.splats
    if shown is None or not splat_object.store_light(shown, read_avatar(state.subject / AVATAR)):
        problem = "its avatar is not the one that the scene shows; show it again"
        raise StgaError(f"{state.subject}: {problem}")
    return Shown(undoable=True)


# Captures


def _import(scene: Any, state: RequestState) -> Shown:
    """Import the capture with the model that it was tracked with, or that which lies in it."""
    request: Any = read_request(state.folder)
    capture = state.loading if state.kind == Kind.AVATAR else state.place
    model = getattr(getattr(request, "track", request), "model", None)
    flame = str(model) if model is not None and is_flame(capture) else ""
    return _operate(scene, bpy.ops.stga.import_capture, directory=str(capture), flame=flame)


def _fill_effects(scene: Any, state: RequestState) -> Answer:
    settings = scene.stga
    found: Any = read_result(state.folder)
    settings.preset_timing = json.dumps(dict(found.seconds))
    settings.effects.clear()
    for decision in found.plan:
        row = settings.effects.add()
        row.name = decision.effect
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, getattr(decision, name))
    return Shown()


def _select_for_take(scene: Any, state: RequestState) -> Answer:
    """Select what extending the run by the head's take would train."""
    head = scene.stga.head
    found: Any = read_result(state.folder)
    if not is_head(head) or Path(head[tags.CAPTURE]) != state.subject:
        raise StgaError(f"{state.subject}: its head is no longer that of the scene")
    write_selection(head, dict(found.selection))
    count_selected(scene, head)
    return Shown(undoable=True)


def _apply_performance(scene: Any, state: RequestState) -> Answer:
    if not is_head(scene.stga.head):
        raise StgaError(f"{state.subject}: was written, but the scene has no head to apply it to")
    path = str(state.subject)
    first = scene.frame_start
    return _operate(scene, bpy.ops.stga.apply_motion, filepath=path, start=first)


SHOW = {
    Kind.TRAINING: _show_avatar,
    Kind.TRACKING: _import,
    Kind.AVATAR: _show_made,
    Kind.ANALYSIS: _fill_effects,
    Kind.SELECTION: _select_for_take,
    Kind.PERFORMANCE: _apply_performance,
    Kind.LIGHT: _store_light,
}
"""Puts the result of a kind of request into the scene. Raises StgaError or RuntimeError."""
CHANGED = dict.fromkeys((Kind.TRAINING, Kind.AVATAR), _run_object) | dict.fromkeys(
    (Kind.TRACKING, Kind.SELECTION, Kind.PERFORMANCE), lambda scene, state: scene.stga.head
)
"""The object that this changes, which has to leave Edit Mode before."""
PLACES = {
    Kind.TRAINING: ("training_run", "result_shown"),
    Kind.TRACKING: ("tracking_capture", "tracking_shown"),
    Kind.AVATAR: ("avatar_folder", "avatar_shown"),
}
"""Properties of the scene's settings: the subject's path, and whether its result was shown."""
