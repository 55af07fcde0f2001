"""How the result of each kind of request reaches the scene, and what the scene stores of it."""

import json
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.monitor_state import Displayed, RequestState, SliceBuilt
from ..stga_addon.jobs.perform import read_request, read_result
from ..stga_addon.jobs.table import TRAINS, Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, RUN_FOLDER
from ..stga_addon.scene import tags
from ..stga_addon.scene.arrays import triangle_mesh
from ..stga_addon.scene.avatar_scene import place_tracked, show_world
from ..stga_addon.scene.display import splat_nodes, splat_object
from ..stga_addon.scene.display.splat_attributes import SplatAttributes, avatar_attributes
from ..stga_addon.scene.objects import Identity, collections_of, mover_of
from ..stga_addon.scene.record import (
    capture_of,
    displayed_path,
    owner_of,
    store_path,
    stored_path,
)
from ..stga_addon.scene.rig.head import LINKED
from ..stga_addon.scene.tags import is_head
from ..stga_addon.tracking.folder import is_flame
from ..stga_addon.training.run.folder import AVATAR, TRACKING, read_run
from ..stga_addon.worker.status import WorkerState
from .common import capture_source, is_run

Answer = SliceBuilt | Displayed | None
"""Result of a function of `SHOW`; None: the result is still being read."""


def _operate(scene: Any, operator: Any, **options: Any) -> Displayed:
    """Call an operator, which reports in the window that shows the scene, if there is one; undo
    takes it back there."""
    windows = bpy.context.window_manager.windows
    window = next((each for each in windows if each.scene == scene), None)
    place = {"window": window} if window is not None else {"scene": scene}
    with bpy.context.temp_override(**place):
        operator("EXEC_DEFAULT", window is not None, **options)
    return Displayed()


# The head that a request is about


_heads: dict[tuple[int, Kind], Identity] = {}
"""Session id of a scene and kind of its request -> the head that it is about."""


def panel_head(scene: Any, kind: Kind) -> Any:
    """The head that a request of this kind is about as it begins; None: it has none, as yet."""
    head = scene.stga.head
    if kind == Kind.AVATAR:
        return None
    if kind in ADDS:
        head = splat_object.followed_head(scene.stga.splats)
    return head if is_head(head) else None


def record_head(scene: Any, kind: Kind, head: Any) -> None:
    """The scene's request of this kind is about the head, whatever the panel holds later; None:
    about none, as yet."""
    if head is None:
        _heads.pop((scene.session_uid, kind), None)
    else:
        _heads[scene.session_uid, kind] = Identity(head)
    store_head(scene, kind)


def store_head(scene: Any, kind: Kind) -> None:
    """Store the head with the file, also where an undo step has taken that back."""
    if kind in HEADS:
        setattr(scene.stga, HEADS[kind], _head_in_session(scene, kind))


def _head_in_session(scene: Any, kind: Kind) -> Any:
    head = _heads.get((scene.session_uid, kind))
    return None if head is None else head.find()


def request_head(scene: Any, state: RequestState) -> Any:
    """The head that the request is about, also where its capture was imported again; None where it
    is gone, or is still to be imported."""
    if state.kind == Kind.TRACKING:
        return _head_of_capture(scene, state.place)
    head = _head_in_session(scene, state.kind)
    if head is None and state.kind in HEADS:
        stored = getattr(scene.stga, HEADS[state.kind])
        head = stored if stored is not None and collections_of(stored) else None
        if head is None:
            with suppress(StgaError):  # has not begun
                head = _head_of_capture(scene, read_run(state.run).capture)
    return head


def _head_of_capture(scene: Any, capture: Path) -> Any:
    folder = str(capture.resolve())
    return next((each for each in tags.heads_of(scene) if str(capture_of(each)) == folder), None)


def forget_heads() -> None:
    """Forget the heads of the file before: its session ids are no longer valid; files store
    theirs."""
    _heads.clear()


# Avatars


MIN_ITERATIONS = 300
"""Below, new splats look like gray fog: neither previews nor a run that was cancelled replace
another avatar."""

_pool = ThreadPoolExecutor(1, "stga")
"""The thread that reads avatar files, so that Blender does not wait for them."""
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
    subject = state.subject_path
    return subject / RUN_FOLDER if state.kind == Kind.AVATAR else subject


def editable_splats(scene: Any, head: Any) -> Any:
    """The splat object that shows an avatar on the head and can be changed, the panel's where that
    does; None without one."""
    found = splat_object.splats_of(head, scene) if head is not None else []
    return scene.stga.splats if scene.stga.splats in found else next(iter(found), None)


def check_replaceable(scene: Any, head: Any, splats: Any) -> None:
    """Raise StgaError where an avatar cannot take the place of what `editable_splats` found, None:
    nothing that can be changed."""
    if splats is not None:
        splat_object.check_editable_data(splats)
    elif splat_object.splats_of(head, scene, linked=True):
        raise StgaError(f"{head.name}: shows an avatar already, and {LINKED}")


def follow_head(settings: Any) -> None:
    """Let the panel show the splats of the head that was chosen in it. A head without a run gets
    the scene's, or a new one beside that of another head."""
    scene = settings.id_data
    head = settings.head
    splats = editable_splats(scene, head)
    others = [thing for thing in tags.heads_of(scene) if thing != head]
    if splats is not None or (head is not None and others):
        settings.splats = splats
    if owner_of(scene, head) == head and tags.RUN not in head:
        _begin_record(scene, head, others)
    look_for_run(settings)


def _begin_record(scene: Any, head: Any, others: list[Any]) -> None:
    if not others:
        for tag in {tags.RUN, tags.AVATAR} & set(scene.keys()):
            store_path(head, tag, head.get(tag) or scene[tag])
        return
    runs = (stored_path(each, tags.RUN) for each in others)
    before = (next(filter(None, runs), "") or DEFAULT_RUN).rstrip("/\\")
    beside = before.removesuffix(os.path.basename(before))
    store_path(head, tags.RUN, f"{beside}{mover_of(head).name}_run")


DEFAULT_RUN = "//stga_run"


def panel_path(settings: Any, tag: str) -> str:
    """A path of the panel's head (`record`), or of the scene without one, as the panel shows it."""
    head = settings.head
    path = stored_path(owner_of(settings.id_data, head), tag)
    if not path and is_head(head):  # a linked one
        path = stored_path(head, tag)
    return displayed_path(path or (DEFAULT_RUN if tag == tags.RUN else ""))


def store_panel_path(settings: Any, tag: str, value: str) -> None:
    store_path(owner_of(settings.id_data, settings.head), tag, value)
    look_for_run(settings)


def look_for_run(settings: Any) -> None:
    """Note for panels, which read no files, whether the run folder holds a run."""
    settings.holds_run = is_run(panel_path(settings, tags.RUN))


def _is_immature(state: RequestState) -> bool:
    """Whether these are new splats that are hardly trained, but for a run that was meant to be so
    short."""
    is_whole = state.snapshot.state == WorkerState.FINISHED
    if is_whole or state.snapshot.status.figures.get("iteration", 0) >= MIN_ITERATIONS:
        return False
    with suppress(StgaError):  # a run that is damaged, or has not begun
        return read_run(state.run).continuation is None  # else it begins with a trained avatar
    return True


def store_avatar(scene: Any, state: RequestState, path: Path) -> None:
    """Name the avatar that was trained with its head; and the run that has continued the head's."""
    head = request_head(scene, state) or scene.stga.head
    owner = owner_of(scene, head)
    if Path(_absolute(owner, tags.AVATAR)).is_file() and _is_immature(state):
        return
    store_path(owner, tags.AVATAR, str(path))
    with suppress(StgaError):  # the request was removed
        parent = getattr(read_request(state.folder_path), "parent", None)
        if parent == Path(_absolute(owner, tags.RUN)).resolve():
            store_path(owner, tags.RUN, str(_run(state)))
    look_for_run(scene.stga)  # which was empty when the head of a video arrived


def _absolute(owner: Any, tag: str) -> str:
    return str(bpy.path.abspath(stored_path(owner, tag)))


def _show_avatar(scene: Any, state: RequestState) -> Answer:
    """Show the avatar that was loaded on the head that it was trained for, by the splat object that
    shows one there or by a new one, a slice at a time."""
    loading = _loading[scene.session_uid]
    run = _run(state)
    if not loading.done():
        return None
    head = request_head(scene, state)
    is_result = state.loading_path.name == AVATAR
    if head is None:
        gone = "the head that it was trained for is no longer in the scene"
        raise StgaError(f"{run}: {gone}; choose a head, then Show Avatar")
    splats = editable_splats(scene, head)
    worn = Path(_absolute(owner_of(scene, head), tags.AVATAR))
    is_other = splats is not None and worn.is_file() and worn.parent != run
    if is_other and _is_immature(state):
        if not is_result:
            return Displayed()
        count = f"{state.snapshot.status.figures.get('iteration', 0):.0f} iterations"
        shows = f"{head.name} keeps the avatar that it has; Show Avatar shows the new one"
        raise StgaError(f"{run}: was cancelled after {count}, so {shows}")
    check_replaceable(scene, head, splats)
    avatar, attributes = loading.result()
    splat_object.check_head(avatar, head)
    is_update = splats is not None and splat_object.can_update(splats, avatar)
    if not is_update and splat_object.build_next_node_group(avatar):
        return SliceBuilt()
    del _loading[scene.session_uid]
    if is_update:
        splat_object.update_splats(splats, attributes)
    else:
        is_new = splats is None
        name = f"{head.name} {run.name}"
        splats = splat_object.show_avatar(avatar, head, name, attributes, splats, scene)
        if is_new:
            splat_object.hide_object(head, scene)
    if is_result:
        store_path(owner_of(scene, head), tags.AVATAR, str(state.loading_path))
        is_first = head.get(tags.TRACKED) and not head.get(tags.UNSEEN_DISPLAYED)
        if is_first and splat_object.is_partly_observed(splats):
            head[tags.UNSEEN_DISPLAYED] = True
            splat_object.set_input(splats, splat_nodes.SHOW_UNSEEN, True)
    if scene.stga.head == head:
        scene.stga.splats = splats
    show_world(run / AVATAR, head, scene)
    return Displayed(undoable=not is_update)


def _show_trained(scene: Any, state: RequestState) -> Answer:
    """Show the avatar; around that of the demo's shot, the shot."""
    answer = _show_avatar(scene, state)
    is_result = state.loading_path.name == AVATAR
    if not (
        isinstance(answer, Displayed) and is_result and scene.stga.shot_run == str(_run(state))
    ):
        return answer
    scene.stga.shot_run = ""
    with _in_panel(scene, request_head(scene, state)):
        return _operate(scene, bpy.ops.stga.build_demo_shot)


def _show_made(scene: Any, state: RequestState) -> Answer:
    """Import the capture once it is tracked; then show the previews and the avatar, at last on the
    head that training refined."""
    if state.loading_path.name == CAPTURE_FOLDER:
        is_there = _head_of_capture(scene, state.loading_path) is not None
        imported = Displayed() if is_there else _import(scene, state)
        head = _head_of_capture(scene, state.loading_path)
        record_head(scene, state.kind, head)
        store_path(owner_of(scene, head), tags.RUN, str(_run(state)))
        look_for_run(scene.stga)
        return imported
    answer = _show_avatar(scene, state)
    is_refined = state.loading_path.name == AVATAR and state.files.tracking is not None
    if isinstance(answer, Displayed) and is_refined:
        head = request_head(scene, state)
        refined = str(state.run / TRACKING)
        how = {"own_offsets": True, "start": head[tags.TIMESTEPS][0]}
        with _in_panel(scene, head):
            _operate(scene, bpy.ops.stga.apply_motion, filepath=refined, **how)
    return answer


@contextmanager
def _in_panel(scene: Any, head: Any) -> Iterator[None]:
    """Let operators work on the head, whichever the panel holds."""
    settings = scene.stga
    before = scene.stga.head
    if before != head:
        settings.head = head
    try:
        yield
    finally:
        if before != head:
            settings.head = before


def _store_added(scene: Any, state: RequestState) -> Answer:
    """Give the scene's splats what is now in the avatar of the run."""
    splats = editable_splats(scene, request_head(scene, state))
    path = state.subject_path / AVATAR
    if splats is None or not ADDS[state.kind](splats, read_avatar(path)):
        problem = "its avatar is not the one that the scene shows; show it again"
        raise StgaError(f"{state.subject}: {problem}")
    return Displayed(undoable=True)


# Captures


def _import(scene: Any, state: RequestState) -> Displayed:
    """Import the capture with the model that it was tracked with, or that which lies in it."""
    request: Any = read_request(state.folder_path)
    capture = state.loading_path if state.kind == Kind.AVATAR else state.place
    model = getattr(getattr(request, "track", request), "model", None)
    flame = str(model) if model is not None and is_flame(capture) else ""
    return _operate(scene, bpy.ops.stga.import_capture, directory=str(capture), flame=flame)


CAPTURES = {
    Kind.TRACKING: lambda state: state.place,
    Kind.AVATAR: lambda state: state.place / CAPTURE_FOLDER,
}
"""Kind of request -> where it tracks a head."""


def show_tracked(scene: Any, capture: Path, picture: Mapping[str, np.ndarray]) -> None:
    """Show the mesh of a head that is being tracked, until its capture is imported."""
    busy = bpy.app.is_job_running("RENDER") or _head_of_capture(scene, capture) is not None
    if {"vertices", "faces"} <= picture.keys() and not busy:
        before = tags.find(tags.TRACKED_HEAD, capture)
        if before and before[0].mode == "EDIT":
            return
        mesh = triangle_mesh("Head, being tracked", picture["vertices"], picture["faces"])
        place_tracked(scene, capture, mesh, next(iter(before), None))


def _fill_effects(scene: Any, state: RequestState) -> Answer:
    settings = scene.stga
    found: Any = read_result(state.folder_path)
    if found.repaired:
        capture, model, point = capture_source(request_head(scene, state))
        source = {"directory": str(capture), "flame": str(model or ""), "principal_point": point}
        _operate(scene, bpy.ops.stga.import_capture, **source)
    settings.misfit = found.misfit
    settings.preset_timing = json.dumps(dict(found.seconds))
    settings.effects.clear()
    for decision in found.plan:
        row = settings.effects.add()
        row.name = decision.effect
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, getattr(decision, name))
    return Displayed()


def _apply_performance(scene: Any, state: RequestState) -> Answer:
    head = request_head(scene, state)
    if head is None or head != scene.stga.head:
        problem = "was written, but its head is no longer that of the scene"
        raise StgaError(f"{state.subject}: {problem}; Apply Motion applies it to a head")
    path = str(state.subject)
    first = scene.frame_start
    return _operate(scene, bpy.ops.stga.apply_motion, filepath=path, start=first)


ADDS = {Kind.LIGHT: splat_object.store_light, Kind.EXACT: splat_object.store_linear_base}
"""Kind of request -> function that stores what it adds to a run's avatar in the object that shows
it."""
SHOW = {
    Kind.TRAINING: _show_trained,
    Kind.TRACKING: _import,
    Kind.AVATAR: _show_made,
    Kind.ANALYSIS: _fill_effects,
    Kind.PERFORMANCE: _apply_performance,
    **dict.fromkeys(ADDS, _store_added),
}
"""Puts the result of a kind of request into the scene. Raises StgaError or RuntimeError."""


def changed_object(scene: Any, state: RequestState) -> Any:
    """The object that showing the result changes, which has to leave Edit Mode before; or None."""
    if state.kind in TRAINS:
        return editable_splats(scene, request_head(scene, state))
    return request_head(scene, state) if state.kind in CHANGES_HEAD else None


CHANGES_HEAD = (Kind.TRACKING, Kind.PERFORMANCE)
"""Kinds whose result changes the head itself."""
PLACES = {
    Kind.TRAINING: ("training_run", "result_shown"),
    Kind.TRACKING: ("tracking_capture", "tracking_shown"),
    Kind.AVATAR: ("avatar_folder", "avatar_shown"),
}
"""Properties of the scene's settings: the subject's path, and whether its result was shown."""
HEADS = {Kind.TRAINING: "training_head", Kind.AVATAR: "avatar_head"}
"""Properties of the scene's settings: the head that its avatar is trained for."""
