"""Exports an avatar to the files of other viewers and tools; what the head plays, the cameras and a
head model for tracking."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.avatar.observed import observed_part
from ..stga_addon.avatar.splats import Splats
from ..stga_addon.capture.camera import Camera, camera_from_gl
from ..stga_addon.driving.head_map import page_controls
from ..stga_addon.driving.inverse import captured_performance, write_performance
from ..stga_addon.errors import StgaError
from ..stga_addon.export import formats
from ..stga_addon.export.formats import FORMATS, SPLAT_FORMATS, Content, WorldContent
from ..stga_addon.export.playback import Playback
from ..stga_addon.export.ply import SplatFrames
from ..stga_addon.export.rig import Meshes
from ..stga_addon.export.usd import find_usd
from ..stga_addon.files import confirming
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.format import format_bytes
from ..stga_addon.jobs.export import Export
from ..stga_addon.progress import Cancelled
from ..stga_addon.scene import tags
from ..stga_addon.scene.arrays import Z_UP_TO_Y_UP, head_vertices
from ..stga_addon.scene.cameras import export_cameras, scene_camera
from ..stga_addon.scene.display.splat_nodes import NATIVE
from ..stga_addon.scene.display.splat_object import check_head, display_mode, later_modifiers
from ..stga_addon.scene.evaluation import kept_evaluated
from ..stga_addon.scene.objects import (
    Identity,
    SceneView,
    Warn,
    frames_per_second,
    is_rendering,
    iterate_frames,
)
from ..stga_addon.scene.render.scene_splats import SplatCache, evaluated_splats, with_heads
from ..stga_addon.scene.rig.head import find_rig, has_shape_keys, shape_key_model
from ..stga_addon.scene.rig.motion import sample_motion
from ..stga_addon.scene.vertex_groups import training_selection
from ..stga_addon.tracking.head_model import shape_arrays, write_linear_model
from ..stga_addon.worker.training_python import this_python
from . import common, options
from .common import (
    Action,
    FileExport,
    StepGenerator,
    Stepwise,
    file_path,
    head_of,
    need,
    needs_head,
    recorded_motion,
    scene_frames,
)
from .options import ONCE
from .training_python import training_python

Read = Callable[[], Any]
"""Function that reads the part of the open scene, at its frame, that is exported."""
Write = Callable[[Iterable[tuple[int, Any]]], Any]
STEP_INTERVAL_S = 0.005
MAX_WAITING_FRAMES = 2
SEPARATORS = ("/", os.sep)
SUFFIXES = tuple(suffix for format in FORMATS.values() for suffix in format.suffixes)


class SplatExport(Stepwise, FileExport):
    """Mixin of operators that export splats frame by frame, in one of the formats that they
    offer."""

    filter_glob: options.file_filter(*SUFFIXES)
    _is_invoked = False

    @property
    def filename_ext(self: Any) -> str:
        """What FileExport appends to the path."""
        return next(iter(FORMATS[self.format].suffixes), "")

    def check(self: Any, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath
        if not path.lower().endswith(FORMATS[self.format].suffixes or ("/",)):
            for suffix in SUFFIXES:
                path = path.removesuffix(suffix)
            path += self.filename_ext
        changed = path != self.filepath
        self.filepath = path
        return bool(changed)

    def invoke(self, context: Any, event: Any) -> set[str]:
        self._is_invoked = True
        return super().invoke(context, event)

    def target(self: Any) -> Path:
        """The path that was chosen. Raises StgaError where it is not one of the format."""
        path = file_path(self.filepath, "export")
        if self.filename_ext and (self.filepath.endswith(SEPARATORS) or path.is_dir()):
            raise StgaError(f"{path}: is a folder; expected the name of a file")
        if self.filename_ext and not path.suffix:
            path = path.with_suffix(self.filename_ext)
        formats.check_suffix(path, self.format)
        return path

    def write_frames(
        self: Any, context: Any, path: Path, read: Read, write: Write, things: Sequence[Any]
    ) -> Any:
        """Let `write` take what `read` finds in each frame that the format holds, with its number:
        in steps where a dialog has been shown. things: objects that are read."""
        scene = context.scene
        frames = scene_frames(scene)
        if FORMATS[self.format].source != "range":
            frames = range(scene.frame_current, scene.frame_current + 1)
        if self._is_invoked:
            view = SceneView(context)
            steps = _keeping(view, things, self.export(view, read, path, frames, write))
            return self.begin(context, steps, STEP_INTERVAL_S)
        write((frame, read()) for frame in iterate_frames(frames, things))
        self.inform(f"Exported to {path}")
        return None

    def export(
        self: Any, view: SceneView, read: Read, path: Path, frames: range, write: Write
    ) -> StepGenerator:
        """Read the scene, a frame a step, for `write`, which takes it in a thread; restore the
        scene's frame at the end, and say what has become of the export. Raises Cancelled, and
        StgaError as `read`."""
        writer = _Writer(write)
        done = 0
        was_named = False
        with ExitStack() as ends:
            ends.callback(_show_status, None)
            ends.callback(writer.stop)  # also where reading fails, or Blender closes the file
            posing = ends.enter_context(closing(iterate_frames(frames)))
            try:
                while not writer.has_ended:
                    while is_rendering():  # which sets frames itself, and would get ours
                        _show_status("Waiting for the render   Esc: Cancel")
                        yield
                    if writer.takes_frames:
                        with view.in_context():
                            frame = next(posing, None)
                            found = None if frame is None else read()
                        writer.give(frame, found)
                        done += frame is not None
                    posed = f" frame {done} of {len(frames)}" if len(frames) > 1 else ""
                    _show_status(f"Exporting{posed}   Esc: Cancel")
                    yield
            except Cancelled:
                was_named = not writer.stop()
                posing.close()
                self.others = "PASS_THROUGH"
                while not writer.has_ended:
                    _show_status("Finishing the export" if was_named else "Cancelling the export")
                    yield
            try:
                writer.result()
            except Cancelled as error:
                sentence = f"Export cancelled after {done} of {len(frames)} frames"
                raise Cancelled(sentence) from error
        late = "; it was complete when Esc was pressed" if was_named else ""
        self.inform(f"Exported to {path}{late}")


def _keeping(view: SceneView, things: Sequence[Any], steps: StepGenerator) -> StepGenerator:
    """Steps in which Blender evaluates these objects."""
    known = [Identity(thing) for thing in things if thing is not None]
    with ExitStack() as kept:
        with view.in_context():
            kept.enter_context(kept_evaluated(each.get() for each in known))
        yield from steps


class ExportAvatar(SplatExport, bpy.types.Operator):
    """Export a trained avatar, posed as the head in the scene, for other viewers of Gaussian
    splats"""

    needs = (needs_head,)

    filepath: options.path(
        "File or Folder",
        "A folder for PLY Sequence and GaussianAvatars, a file for the other formats",
        options=ONCE,
    )
    avatar: options.path("Avatar", "Avatar file (.npz); empty: the one shown", options=ONCE)
    format: options.choice(
        "Format",
        "File format",
        *((name, format.label, format.description) for name, format in FORMATS.items()),
    )
    motion_only: options.field(Export, "motion_only")
    filmed_only: options.field(Export, "filmed_only")

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        rigged = ("motion_only",) if FORMATS[self.format].has_rig else ()
        for name in ("format", "avatar", "filmed_only", *rigged):
            self.layout.prop(self, name)
        if FORMATS[self.format].source == "range":
            frames = scene_frames(context.scene)
            column = self.layout.column()
            column.label(text=f"Frames {frames[0]} to {frames[-1]} of the scene", icon="TIME")
            try:
                source = self._source(context)
                known = source, source.stat().st_mtime, self.filmed_only
                size = _size(*known, self.format, len(frames))
                text = f"About {format_bytes(size)}"
            except (StgaError, OSError) as error:
                text = str(error)
            column.label(text=text, icon="DISK_DRIVE")

    def _source(self, context: Any) -> Path:
        return file_path(self.avatar or context.scene.stga.avatar, "avatar")

    def run(self, context: Any) -> set[str] | None:
        head = head_of(context)
        scene = context.scene
        path = self.target()
        format = FORMATS[self.format]
        frames = scene_frames(scene)
        fps = frames_per_second(scene)
        source = self._source(context)
        avatar = _read(source, self.filmed_only)
        check_head(avatar, head)
        motion = None
        playback = Playback(fps=fps)
        if format.has_rig:
            motion = None if self.motion_only else exact_motion(head, frames, self.warn)
            playback = scene_playback(context, head, frames, self.motion_only)
            playback = replace(playback, controls=page_controls(motion))
        if format.source == "range":
            formats.check_free_space(path, format.size(Content(avatar), len(frames)))
        elif format.source == "motion":
            motion = sample_motion(head, recorded_motion(head), frames, self.warn)

        def write(meshes: Meshes) -> None:
            content = Content(avatar, meshes, motion, playback, python)
            formats.write_content(path, self.format, content)

        python = _usd_python(context, self.format)
        owner = Identity(head)
        return self.write_frames(context, path, lambda: head_vertices(owner.get()), write, [head])


class ExportSplats(SplatExport, bpy.types.Operator):
    """Export all splats that the scene shows: avatars, and native splats of Blender, also of
    others, instanced or deformed"""

    bl_label = "Export Gaussian Splats"

    filepath: options.path(
        "File or Folder", "A folder for PLY Sequence, a file for the other formats", options=ONCE
    )
    format: options.choice(
        "Format",
        "File format",
        *((name, format.label, format.description) for name, format in SPLAT_FORMATS.items()),
    )
    up: options.choice(
        "Up",
        "Axis that points up in PLY files; the other formats have their own",
        ("Z", "Z", "As in Blender, whose import of PLY does not turn"),
        ("Y", "Y", "As most viewers, and this add-on's import"),
    )

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "format")
        if self._is_ply:
            self.layout.prop(self, "up")

    @property
    def _is_ply(self) -> bool:
        return bool(self.format.startswith("ply"))

    def run(self, context: Any) -> set[str] | None:
        path = self.target()
        is_turned = self.up == "Y" or not self._is_ply
        to_file = Z_UP_TO_Y_UP if is_turned else np.eye(4)
        playback = Playback(fps=frames_per_second(context.scene))
        format = SPLAT_FORMATS[self.format]
        count = len(scene_frames(context.scene))
        for scene_object in context.scene.objects:
            is_rendered = tags.is_splats(scene_object) and not scene_object.hide_render
            if (
                is_rendered
                and display_mode(scene_object) != NATIVE
                and later_modifiers(scene_object)
            ):
                names = ", ".join(each.name for each in later_modifiers(scene_object))
                self.warn(
                    f"{scene_object.name}: exported without {names}; {NATIVE} are exported with it"
                )

        def read() -> Splats:
            depsgraph = bpy.context.evaluated_depsgraph_get()
            return evaluated_splats(depsgraph, SplatCache(self.format == "usd"), to_file)

        things = with_heads(context.scene)
        if format.source == "range":
            with kept_evaluated(things):
                content = SimpleNamespace(splats=read(), moving_color=False)
            formats.check_free_space(path, format.size(content, count))

        python = _usd_python(context, self.format)

        def write(frames: SplatFrames) -> None:
            formats.write_content(path, self.format, WorldContent(frames, playback, python))

        return self.write_frames(context, path, read, write, things)


def _usd_python(context: Any, format: str) -> str:
    """The interpreter that writes USD files where Blender's lacks USD; "" where none is needed, or
    none is chosen."""
    if format != "usd" or find_usd() is not None:
        return ""
    with suppress(StgaError):
        python = training_python(context)
        return "" if python == this_python() else python
    return ""


class _Writer:
    """A thread that writes a file of frames, which it is given one by one. Once stopped, it ends by
    itself and leaves nothing."""

    def __init__(self, write: Write) -> None:
        self._waiting: SimpleQueue[Any] = SimpleQueue()
        self._lock = Lock()
        self._has_all = self._is_stopped = self._is_named = False
        pool = ThreadPoolExecutor(1, "stga export")
        self._written = pool.submit(self._write, write)
        pool.shutdown(wait=False)

    @property
    def has_ended(self) -> bool:
        return self._written.done()

    @property
    def takes_frames(self) -> bool:
        return not self._has_all and self._waiting.qsize() < MAX_WAITING_FRAMES

    def give(self, frame: int | None, found: Any) -> None:
        """The next frame and its number; None: there are no more."""
        self._has_all = frame is None
        self._waiting.put(None if frame is None else (frame, found))

    def stop(self) -> bool:
        """Let the thread end without a file; False where the file has its name already."""
        with self._lock:
            self._is_stopped = not self._is_named
        self._waiting.put(None)
        return self._is_stopped

    def result(self) -> None:
        """Raises what `write` raised, and Cancelled where it was stopped."""
        self._written.result()

    def _write(self, write: Write) -> None:
        with confirming(self._confirm):
            write(self._frames())

    def _confirm(self) -> None:
        with self._lock:
            if self._is_stopped:
                raise Cancelled
            self._is_named = True

    def _frames(self) -> Iterator[tuple[int, Any]]:
        while True:
            item = self._waiting.get()
            if self._is_stopped:
                raise Cancelled
            if item is None:
                return
            yield item


def _show_status(text: str | None) -> None:
    """In the window's status bar; None: Blender's own again."""
    workspace = bpy.context.workspace
    if workspace is not None:
        workspace.status_text_set(text)


def _read(path: Path, filmed_only: bool) -> Avatar:
    avatar = read_avatar(path)
    return observed_part(path, avatar) if filmed_only else avatar


@lru_cache(maxsize=8)
def _size(path: Path, modified: float, filmed_only: bool, format: str, frames: int) -> int:
    """`Format.size` of an avatar file last modified at this time. Raises StgaError."""
    return FORMATS[format].size(Content(_read(path, filmed_only)), frames)


# What of the scene plays in a web page


def scene_playback(context: Any, head: Any, frames: range, motion_only: bool) -> Playback:
    """The scene's frame rate, camera, selection groups and upward direction, in the head's
    space; without a camera where it has no perspective one."""
    to_head = np.linalg.inv(np.array(head.matrix_world, np.float64))
    up = to_head[:3, :3] @ [0.0, 0.0, 1.0]
    up /= np.linalg.norm(up)
    views: dict[str, Camera] = {}
    with suppress(StgaError):
        found = scene_camera(context.evaluated_depsgraph_get())
        pose = to_head @ found.camera_to_world_gl
        pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
        size = (found.width, found.height)
        focal = (found.fl_x, found.fl_y)
        name = bpy.path.display_name(context.scene.camera.name, has_ext=False)
        views[name] = camera_from_gl(pose, size, focal, (found.cx, found.cy))
    selection = training_selection(head)
    everything = np.ones(len(head.data.polygons), bool)
    return Playback(
        title=head.name,
        fps=frames_per_second(context.scene),
        views=views,
        up=(float(up[0]), float(up[1]), float(up[2])),
        selection=[selection.get(frame, everything) for frame in frames] if selection else None,
        motion_only=motion_only,
    )


def exact_motion(head: Any, frames: range, warn: Warn) -> FlameSequence | None:
    """FLAME parameters of what the head plays; None without a rig, or, after saying why, where they
    would not give the scene's meshes."""
    if find_rig(head) is None:
        return None
    reasons: list[str] = []
    motion = None
    try:
        motion = sample_motion(head, recorded_motion(head), frames, reasons.append)
    except StgaError as error:
        reasons.append(str(error))
    if reasons:
        warn(f"No sliders in the page: {reasons[0]}")
    return None if reasons else motion


# Other files


class ExportPerformance(Action, bpy.types.Operator, FileExport):
    """Export expression, jaw, eyes and neck of the head in the scene's frame range as curves of
    ARKit's 52 shapes"""

    bl_label = "Export ARKit Curves"
    needs = (common.needs_rig,)

    filepath: options.path("File", "CSV file in Live Link Face's layout", options=ONCE)
    filename_ext = ".csv"
    filter_glob: options.file_filter(".csv")

    def run(self, context: Any) -> None:
        head = head_of(context)
        frames = scene_frames(context.scene)
        path = file_path(self.filepath, "curves").with_suffix(self.filename_ext)
        motion = sample_motion(head, recorded_motion(head), frames, self.warn)
        fps = frames_per_second(context.scene)
        write_performance(path, captured_performance(motion, head.name, fps))
        self.inform(f"Exported {len(frames)} frames to {path}")


class ExportCameras(Action, bpy.types.Operator, FileExport):
    """Export cameras at the current frame as calibration of footage: each has a folder, video or
    image of its name"""

    filename_ext = ".json"
    filepath: options.path("File", "transforms.json in the folder of the footage", options=ONCE)
    filter_glob: options.file_filter(".json")
    selected_only: options.boolean(
        "Selected Only", "Export selected cameras instead of all in the scene"
    )

    def run(self, context: Any) -> None:
        objects = context.selected_objects if self.selected_only else context.scene.objects
        cameras = [thing for thing in objects if thing.type == "CAMERA"]
        path = file_path(self.filepath, "export")
        with kept_evaluated(cameras):
            count = export_cameras(path, cameras, context.evaluated_depsgraph_get())
        self.inform(f"Exported {count} cameras to {path}")


class ExportHeadModel(Action, bpy.types.Operator, FileExport):
    """Export the active object's shape keys as a head model for tracking; keys named identity… make
    other persons"""

    filename_ext = ".npz"
    filter_glob: options.file_filter(".npz")

    needs = (
        need(
            lambda context: has_shape_keys(context.active_object), "Select a mesh with shape keys"
        ),
    )

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "head model")
        write_linear_model(path, shape_arrays(*shape_key_model(context.active_object)))
