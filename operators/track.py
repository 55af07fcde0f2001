"""The Track step: tracking a head through footage in a worker process beside Blender, looking at
what it found, and solving it again around frames that were posed by hand; an avatar made from a
video, tracked and trained at once."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.transforms import VIDEO_SUFFIXES
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs import track as jobs
from ..stga_addon.jobs.perform import has_request, read_request, request_folder
from ..stga_addon.jobs.table import TRAINS, Kind
from ..stga_addon.jobs.track import CAPTURE_FOLDER, Track
from ..stga_addon.jobs.train import Train
from ..stga_addon.scene import tags
from ..stga_addon.scene.cameras import look_away, look_through
from ..stga_addon.scene.objects import show_kind
from ..stga_addon.scene.record import capture_of, stored_path
from ..stga_addon.scene.rig.head import usable_rig
from ..stga_addon.scene.rig.keyframes import key_current_pose
from ..stga_addon.scene.rig.motion import sample_pose
from ..stga_addon.scene.tags import is_head
from ..stga_addon.training.settings import TrainingSettings, make_settings
from . import common, options
from .common import Action, Edit, FileImport, file_path, head_of, need, needs_rig
from .options import ONCE
from .request import idle, start
from .training_python import training_python
from .windows import show_panel

XRAY_ALPHA = 0.4
"""Opacity of the head over the footage."""
TRACK_FIELDS = ("footage", "start", "step", "cameras", "model", "avatar", "landmarks", "stop")
"""Fields of the request, beside its focal length, that are properties of the operator as well."""
UNSEEN = {*ONCE, "HIDDEN"}
"""Options of properties that nobody sets by hand."""
TAKE_LABELS = {"auto": "Found Out", "around": "Around a Still Head", "talk": "Talk"}
"""Names of the choices of what was filmed."""
MAX_FOLDERS = 1000
"""Numbers that are tried for the name of a new folder."""
DIGITS = 3
"""Decimals of numbers that Blender keeps in single precision: later ones are its rounding."""


class TrackOptions:
    """What is tracked, and with what: of the operator, and of the panel that calls it."""

    footage: options.field(Track, "footage")
    cameras: options.field(Track, "cameras")
    model: options.field(Track, "model", "Head Model")
    avatar: options.field(Track, "avatar", subtype="DIR_PATH")
    directory: options.path("Capture", "Folder for the tracked capture", "DIR_PATH")
    focal: options.field(Track, "focal", "Focal Length")
    start: options.field(Track, "start")
    stop: options.field(Track, "stop")
    step: options.field(Track, "step")
    mattes: options.choice(
        "Mattes",
        "Masks that separate the person from the background",
        *((name, name.title(), text.capitalize()) for name, text in jobs.MATTES.items()),
        ("folder", "Folder", "Those of a folder, named as the images"),
    )
    matte_folder: options.path(
        "Matte Folder", "Folder of masks, named as the images of the footage", "DIR_PATH"
    )


class TrackFootage(Action, bpy.types.Operator, TrackOptions):
    """Track the head that the footage shows, in a process that continues when Blender is closed,
    and import it"""

    needs = (idle(Kind.TRACKING),)

    landmarks: options.field(Track, "landmarks", subtype="DIR_PATH", options=ONCE)
    python: options.python("tracks")

    def run(self, context: Any) -> None:
        given = {"model": None, **common.given_values(self, Track, *TRACK_FIELDS, "focal")}
        out = file_path(self.directory, "capture").resolve()
        mattes = self.mattes
        if mattes == "folder":
            mattes = str(file_path(self.matte_folder, "mattes").resolve())
        request = Track(**given, out=out, mattes=mattes)
        if start(context.scene, request, training_python(context, self.python)):
            self.inform(f"Tracked {out}")


class ViewFootage(Edit, bpy.types.Operator):
    """Look through the capture's cameras, at their images behind the see-through head; again: back
    to the free view"""

    bl_label = "Look Through Camera"
    needs = (
        need(
            lambda context: getattr(context.space_data, "type", "") == "VIEW_3D",
            "Needs a 3D viewport",
        ),
        common.needs_head,
    )

    step: options.integer(
        "Step", "1: the next camera, -1: the one before, 0: enter and leave", options=ONCE
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        space = context.space_data
        scene = context.scene
        cameras = tags.find(tags.CAMERA, capture_of(head))
        cameras = sorted(cameras, key=lambda camera: camera[tags.CAMERA_INDEX])
        if not cameras:
            raise StgaError("The capture has no cameras in this scene; import it again")
        leave = self.step == 0 and space.region_3d.view_perspective == "CAMERA"
        # a hidden camera shows no images
        show_kind(head.parent, tags.CAMERA, context.view_layer, not leave)
        if leave:
            space.region_3d.view_perspective = "PERSP"
            space.shading.show_xray = False
            look_away(scene)
            return
        row = cameras.index(scene.camera) if scene.camera in cameras else 0
        look_through(scene, cameras[(row + self.step) % len(cameras)])
        space.region_3d.view_perspective = "CAMERA"
        space.shading.type = "SOLID"
        space.shading.show_xray = True
        space.shading.xray_alpha = XRAY_ALPHA


class MarkKey(Edit, bpy.types.Operator):
    """Keep the pose and expression of this frame, set by hand, as a key for Solve Again; on a key:
    no longer"""

    bl_label = "Mark as Key"
    needs = (
        needs_rig,
        common.needs_editable_head,
        need(
            lambda context: context.scene.frame_current in context.scene.stga.head[tags.TIMESTEPS],
            "The capture has no timestep at this frame",
        ),
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        frame = context.scene.frame_current
        keys = tracking_keys(head)
        if frame in keys:
            del keys[frame]
        else:
            keys[frame] = sample_pose(head, common.recorded_motion(head).model).parameters
            key_current_pose(head, usable_rig(head), frame)
        stored = {str(timestep): keys[timestep].tolist() for timestep in sorted(keys)}
        head[tags.TRACKING_KEYS] = json.dumps(stored)


class SolveAgain(Action, bpy.types.Operator):
    """Solve the tracked capture again around the keys, in a process beside Blender, and import
    it"""

    needs = (
        needs_rig,
        idle(Kind.TRACKING),
        need(
            lambda context: context.scene.stga.head.get(tags.TRACKED),
            "This capture was not tracked here",
        ),
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        capture = capture_of(head)
        model = Path(stored_path(head, tags.FLAME_MODEL))
        request = jobs.SolveAgain(capture, model, tracking_keys(head))
        if start(context.scene, request, training_python(context)):
            self.inform(f"Tracked {capture}")


def tracking_keys(head: Any) -> dict[int, np.ndarray]:
    """Timestep -> parameters of the frames that are marked as keys."""
    stored = json.loads(head.get(tags.TRACKING_KEYS) or "{}") if is_head(head) else {}
    return {int(timestep): np.array(values, float) for timestep, values in stored.items()}


# An avatar from a video


class AvatarFromVideo(Action, bpy.types.Operator, FileImport):
    """Make an avatar from a video of a face, or from several of one person: track the head, train,
    and show the avatar on it. What was begun with the same videos is continued"""

    bl_label = "Avatar from Video"
    needs = (idle(*TRAINS),)

    filepath: options.path("Video", "Video of a face", options=ONCE)
    # Blender's file browser sets both
    directory: options.path("Directory", "That of the videos", "DIR_PATH", options=UNSEEN)
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options=UNSEEN)
    folder: options.path(
        "Folder",
        "Folder for capture and avatar; empty: one beside the .blend file, else beside the video",
        "DIR_PATH",
        options=ONCE,
    )
    minutes: options.number("Minutes", "Training time", default=5.0, min=0.01)
    quick: options.boolean(
        "Quick Look",
        f"At most {jobs.QUICK['most']} frames at half size and half a minute of training, in a "
        "folder of its own",
        options=ONCE,
    )
    focal: options.field(Track, "focal", "Focal Length", options=ONCE)
    take: options.field(Track, "take", labels=TAKE_LABELS, options=ONCE)
    python: options.python("tracks and trains", options=UNSEEN)
    filter_glob: options.file_filter(*VIDEO_SUFFIXES)

    def invoke(self, context: Any, event: Any) -> set[str]:
        if not (self.filepath or self.files):
            return self.execute(context) if self.folder else super().invoke(context, event)
        video, *takes = self._videos()  # dropped
        self.folder = str(proposed_folder(self._tracking(video, Path()), takes).parent)
        return context.window_manager.invoke_props_dialog(
            self, width=480, title=self.bl_label, confirm_text="Make"
        )

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        for name in ("quick", "folder", "minutes", "focal", "take"):
            column = self.layout.column()
            column.active = not (self.quick and name == "minutes")
            column.prop(self, name)

    def run(self, context: Any) -> None:
        settings = None
        takes = list[Path]()
        if self.folder and not (self.filepath or self.files):  # continues
            began_with = jobs.read_inputs(file_path(self.folder, "folder"))
            self.filepath = str(began_with.get("footage", ""))
            takes = [Path(take) for take in began_with.get("takes", ())]
            self.take = began_with.get("take", "auto")
            self.focal = began_with.get("focal") or 0.0
            self.quick = began_with.get("size") == jobs.QUICK["size"]
            settings = self._settings_before()
        video, *others = self._videos()
        takes = others or takes
        if not video.is_file():
            raise StgaError(f"{video}: is not a file; expected a video")
        python = training_python(context, self.python)
        if self.folder:
            capture = file_path(self.folder, "folder").resolve() / CAPTURE_FOLDER
        else:
            capture = proposed_folder(self._tracking(video, Path()), takes)
        if settings is None:
            seconds = jobs.QUICK_S if self.quick else round(60 * self.minutes, DIGITS)
            settings = make_settings("global", seconds=seconds, effects={})
        train = Train(capture.parent / jobs.RUN_FOLDER, capture, settings)
        request = jobs.MakeAvatar(self._tracking(video, capture), train, tuple(takes))
        show_panel()  # where it can be watched and cancelled, also after a drop
        if start(context.scene, request, python):
            self.inform(f"Made {request.out}")

    def _videos(self) -> list[Path]:
        """The files that are chosen or dropped, that of `filepath` first."""
        chosen = [Path(self.directory, file.name).resolve() for file in self.files if file.name]
        if self.filepath or not chosen:
            first = file_path(self.filepath, "video").resolve()
            chosen = [first, *(path for path in chosen if path != first)]
        return chosen

    def _settings_before(self) -> TrainingSettings | None:
        """Those that the request in the folder began with, such as its time; None where minutes are
        given, or the request was dismissed."""
        began = request_folder(file_path(self.folder, "folder"))
        if self.properties.is_property_set("minutes") or not has_request(began):
            return None
        request = read_request(began)
        return request.train.settings if isinstance(request, jobs.MakeAvatar) else None

    def _tracking(self, video: Path, capture: Path) -> Track:
        quick = jobs.QUICK if self.quick else {}
        focal = round(self.focal, DIGITS) or None
        return Track(video, None, capture, focal=focal, take=self.take, **quick)


def proposed_folder(track: Track, takes: Sequence[Path]) -> Path:
    """The folder of the capture in the first folder beside the .blend file, else beside the video,
    that is free or in which the avatar of these takes was begun."""
    beside = Path(bpy.data.filepath).parent if bpy.data.filepath else track.footage.parent
    name = f"{track.footage.stem} avatar"
    for each in (name, *(f"{name} {number}" for number in range(2, MAX_FOLDERS))):
        capture = beside / each / CAPTURE_FOLDER
        with suppress(StgaError):
            jobs.check_inputs(replace(track, out=capture), takes)
            return capture
    problem = f"holds {MAX_FOLDERS} avatars of {track.footage.name}; choose a folder"
    raise StgaError(f"{beside}: {problem}")
