"""How the result of each kind of request reaches the scene, and what the scene stores of it."""

import json
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.monitor_state import RequestState, Shown, SliceBuilt
from ..stga_addon.jobs.perform import read_request, read_result
from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, RUN_FOLDER, MakeAvatar
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import show_world
from ..stga_addon.scene.display.splat_attributes import SplatAttributes, avatar_attributes
from ..stga_addon.scene.display.splat_object import (
    build_next_node_group,
    can_update,
    check_head,
    store_light,
    update_splats,
)
from ..stga_addon.scene.vertex_groups import write_selection
from ..stga_addon.tracking.folder import is_flame
from ..stga_addon.training.run.folder import AVATAR, TRACKING
from . import ids
from .common import is_head
from .select import count_selected
from .show import show

Answer = SliceBuilt | Shown | None


@dataclass(frozen=True)
class InScene:
    """What a kind of request is in the scene.

    show     puts what was loaded into the scene; None: it is still being read. Raises StgaError or
             RuntimeError
    changed  the object that `show` changes, which has to leave Edit Mode before
    stored   properties of the scene's settings: the subject's path, and whether its result was
             shown
    """

    show: Callable[[Any, RequestState], Answer] = lambda scene, state: Shown()
    changed: Callable[[Any, RequestState], Any] = lambda scene, state: None
    stored: tuple[str, str] | None = None


def _head(scene: Any, state: RequestState) -> Any:
    return getattr(scene, ids.SETTINGS).head


def _operate(scene: Any, operator: Any, **options: Any) -> Shown:
    """Call an operator, which reports in the window that shows the scene, if there is one; undo
    takes it back there."""
    window = next(
        (each for each in bpy.context.window_manager.windows if each.scene == scene), None
    )
    with bpy.context.temp_override(
        **({"window": window} if window is not None else {"scene": scene})
    ):
        operator("EXEC_DEFAULT", window is not None, **options)
    return Shown()


# Training


def _run(state: RequestState) -> Path:
    """The run that is trained, as the scene names it."""
    assert state.subject is not None
    return state.subject / RUN_FOLDER if state.kind == Kind.AVATAR else state.subject


def _run_object(scene: Any, state: RequestState) -> Any:
    """The object that shows the run, or None."""
    if state.subject is None:
        return None
    return next((thing for thing in scene.objects if thing.get(tags.RUN) == str(_run(state))), None)


def _show_avatar(scene: Any, state: RequestState) -> Answer:
    """Show the avatar that was loaded, in the object that shows this run or in a new one, a slice
    at a time."""
    loaded = loader.result(scene)
    if loaded is None:
        return None
    with ExitStack() as ended:
        ended.callback(loader.discard, scene)
        answer = _present(scene, state, *loaded)
        if isinstance(answer, SliceBuilt):
            ended.pop_all()
        elif state.subject is not None:
            show_world(_run(state) / AVATAR, _head(scene, state))
    return answer


def _present(
    scene: Any, state: RequestState, avatar: Avatar, attributes: SplatAttributes
) -> Answer:
    head, shown = _head(scene, state), _run_object(scene, state)
    if not is_head(head):
        raise StgaError("No head in the scene to show the avatar on; import the capture")
    check_head(avatar, head)
    if shown is not None and can_update(shown, avatar):
        update_splats(shown, attributes)
        return Shown()
    if build_next_node_group(avatar):
        return SliceBuilt()
    if shown is not None:
        bpy.data.objects.remove(shown)
    run = _run(state)
    shown = show(scene, avatar, head, f"{head.name} {run.name}", attributes=attributes)
    shown[tags.RUN] = str(run)
    return Shown(undoable=True)


class _Loader:
    """Reads avatar files in a thread, one for each scene."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[tuple[Avatar, SplatAttributes]]] = {}

    def load(self, scene: Any, path: Path) -> None:
        self._pool = self._pool or ThreadPoolExecutor(1, "stga")
        self._loading[scene.session_uid] = self._pool.submit(_load, path)

    def result(self, scene: Any) -> tuple[Avatar, SplatAttributes] | None:
        """The file's content; None while it is being read. Raises StgaError where it cannot be
        read."""
        future = self._loading[scene.session_uid]
        return future.result() if future.done() else None

    def discard(self, scene: Any) -> None:
        self._loading.pop(scene.session_uid, None)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool, self._loading = None, {}


loader = _Loader()


def _load(path: Path) -> tuple[Avatar, SplatAttributes]:
    avatar = read_avatar(path)
    return avatar, avatar_attributes(avatar)


# Tracking


def _import_tracked(scene: Any, state: RequestState) -> Answer:
    """Import the tracked capture."""
    assert state.folder is not None
    return _import(scene, state.place, getattr(read_request(state.folder), "model", None))


def _import(scene: Any, capture: Path, model: Path | None) -> Shown:
    """model: what it was tracked with; None: what lies in the capture."""
    flame = str(model) if model is not None and is_flame(capture) else ""
    return _operate(scene, bpy.ops.stga.import_capture, directory=str(capture), flame=flame)


# Avatars from footage


def _show_made(scene: Any, state: RequestState) -> Answer:
    """Import the capture once it is tracked; then show the previews and the avatar, at last on the
    head that training refined."""
    assert state.folder is not None
    assert state.loading is not None
    head, settings = _head(scene, state), getattr(scene, ids.SETTINGS)
    if state.loading.name == CAPTURE_FOLDER:
        settings.run_folder = str(_run(state))
        if is_head(head) and Path(head[tags.CAPTURE]) == state.loading:
            return Shown()
        request = read_request(state.folder)
        assert isinstance(request, MakeAvatar)
        return _import(scene, state.loading, request.track.model)
    answer = _show_avatar(scene, state)
    if (
        isinstance(answer, Shown)
        and state.loading.name == AVATAR
        and state.files.tracking is not None
    ):
        first = head[tags.TIMESTEPS][0]
        _operate(
            scene,
            bpy.ops.stga.apply_motion,
            filepath=str(state.run / TRACKING),
            own_offsets=True,
            start=first,
        )
    return answer


# Analysis and selection


def _fill_effects(scene: Any, state: RequestState) -> Answer:
    """Fill the scene's table of effects."""
    assert state.folder is not None
    settings = getattr(scene, ids.SETTINGS)
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
    assert state.folder is not None
    head = _head(scene, state)
    found: Any = read_result(state.folder)
    if not is_head(head) or Path(head[tags.CAPTURE]) != state.subject:
        raise StgaError(f"{state.subject}: its head is no longer that of the scene")
    write_selection(head, dict(found.selection))
    count_selected(scene, head)
    return Shown(undoable=True)


# Performances of videos


def _apply_performance(scene: Any, state: RequestState) -> Answer:
    """Apply the performance that was written to the scene's head."""
    head = _head(scene, state)
    if not is_head(head):
        raise StgaError(f"{state.subject}: was written, but the scene has no head to apply it to")
    return _operate(
        scene, bpy.ops.stga.apply_motion, filepath=str(state.subject), start=scene.frame_start
    )


def _store_light(scene: Any, state: RequestState) -> Answer:
    """Give the scene's splats the light that is now in the avatar of the run."""
    assert state.subject is not None
    shown = getattr(scene, ids.SETTINGS).splats
    avatar = read_avatar(state.subject / AVATAR)
    if shown is None or not store_light(shown, avatar):
        raise StgaError(
            f"{state.subject}: its avatar is not the one that the scene shows; show it again"
        )
    return Shown(undoable=True)


IN_SCENE = {
    Kind.TRAINING: InScene(_show_avatar, _run_object, ("training_run", "result_shown")),
    Kind.TRACKING: InScene(_import_tracked, _head, ("tracking_capture", "tracking_shown")),
    Kind.AVATAR: InScene(_show_made, _run_object, ("avatar_folder", "avatar_shown")),
    Kind.ANALYSIS: InScene(_fill_effects),
    Kind.SELECTION: InScene(_select_for_take, _head),
    Kind.PERFORMANCE: InScene(_apply_performance, _head),
    Kind.LIGHT: InScene(_store_light),
    Kind.VIDEO: InScene(),
}
