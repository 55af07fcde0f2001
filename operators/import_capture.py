"""The Capture step: imports captures, FLAME motions and mesh sequences as animated heads, and opens
the capture of a generated person that the complete edition brings; files dropped into the 3D
viewport."""

import glob
import hashlib
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.capture.coverage import CaptureCoverage, capture_coverage
from ..stga_addon.capture.meshes import MESH_SUFFIXES
from ..stga_addon.capture.model import Capture
from ..stga_addon.capture.open import CAPTURE_MODELS, open_capture
from ..stga_addon.capture.transforms import (
    DEFAULT_PRINCIPAL_POINT,
    VIDEO_SUFFIXES,
    transforms_files,
)
from ..stga_addon.driving.demo_speech import SPEECH_FILE, demo_speech
from ..stga_addon.driving.inverse import write_performance
from ..stga_addon.driving.performers import READ_SUFFIXES
from ..stga_addon.errors import StgaError
from ..stga_addon.export.skinned_reader import (
    AVATAR_FILE,
    MODEL_FILE,
    MOTION_FILE,
    SkinnedSplats,
    read_skinned_splats,
    unpack_skinned_splats,
)
from ..stga_addon.export.splat_files import READERS
from ..stga_addon.files import is_file, read_bytes, read_npz
from ..stga_addon.flame.model import MASK_FILE
from ..stga_addon.flame.sequence import FIELD_ALIASES, FRAME_FIELDS
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import frame_head, hide_default_cube, place_beside
from ..stga_addon.scene.cameras import central, configure_scene, import_cameras
from ..stga_addon.scene.demo_shot import build_shot
from ..stga_addon.scene.objects import (
    COLLECTIONS,
    Warn,
    capture_root,
    is_rendering,
    leave_edit_mode,
    mover_of,
    remove,
    set_frames_per_second,
    show_kind,
    show_progress,
)
from ..stga_addon.scene.record import capture_of, store_path
from ..stga_addon.scene.rig.head import follow_moved_capture, import_head
from ..stga_addon.scene.rig.keyframes import has_shapes
from ..stga_addon.scene.rig.poses import bring_presets
from ..stga_addon.scene.tags import is_head
from ..stga_addon.tracking.folder import describe_focal_length, is_tracked
from ..stga_addon.training.run.folder import has_run, next_folder
from . import options
from .common import (
    Edit,
    FileImport,
    call,
    file_path,
    flame_model_path,
    head_of,
    need,
    needs_rig,
    package,
    recorded_motion,
)
from .kernels import begin_preparing
from .options import ONCE
from .pose import begin_sliders
from .windows import show_panel

FOLDERS_ABOVE_FILE = 3
"""Number of folders above an image, mask, mesh or parameter file in which its capture is looked
for."""
DEMO = Path(__file__).parents[1] / "demo_capture"
"""Demo of the complete edition; the other editions have none."""
DEMO_MINUTES = 1.0
"""Time that the panel proposes for the demo's training."""
SHOT_ITERATIONS = 1000
"""Iterations of the demo shot's training, so that it is as good on a busy machine as on an idle
one, where they take about a minute on two cores."""
USER_AVATARS = "stga_avatars"
"""Folder among Blender's user files for the parts of avatars from folders that are read-only."""
SOURCE_FILE = "source.sha256"
"""Digest of the file that a folder holds the parts of."""
UNPACKED = (AVATAR_FILE, MODEL_FILE, MOTION_FILE, SOURCE_FILE)
MOTION_FIELDS = {*FRAME_FIELDS, *FIELD_ALIASES, "pose"}


class HeadImport(Edit):
    """Mixin of operators that import a head.

    ignored_warning: of the capture, a word of that which says nothing here
    """

    ignored_warning = ""

    def bring_in(
        self: Any,
        context: Any,
        source: Path,
        flame: str = "",
        principal_point: str = DEFAULT_PRINCIPAL_POINT,
        set_up_scene: bool | None = False,
        correctives: str = "all",
    ) -> None:
        """Import what `open_capture` reads, and make it the scene's head. set_up_scene: None: where
        it has no head yet; another import of the same keeps the shot. Raises StgaError."""
        warn = self.warn
        scene = context.scene
        if is_rendering():
            raise StgaError("Blender renders, and would get other meshes; wait until it has ended")
        has_model = not flame and any((source / name).is_file() for name in CAPTURE_MODELS)
        model = None if has_model else flame_model_path(context, flame)
        capture = open_capture(source, flame=model, principal_point=principal_point)
        show_progress(0.5)
        heads = tags.heads_of(scene)
        follow_moved_capture(heads, capture, self.inform)
        others = [each for each in heads if capture_of(each) != capture.root.resolve()]
        is_new = len(heads) == len(others)
        had_sliders = any(has_shapes(each) for each in heads if each not in others)
        used = _used_actions()
        head = import_head(capture, warn=warn, correctives=correctives)
        bring_presets(head)
        if others and is_new:
            place_beside(head, others)
        if set_up_scene is None:
            set_up_scene = not heads
        show_progress(0.8)
        cameras = import_cameras(capture, capture_root(capture.root), warn=warn)
        _store_source(head, capture, principal_point)
        scene.stga.head = head
        if set_up_scene or not heads:
            scene.frame_start = capture.timesteps[0]
            scene.frame_end = capture.timesteps[-1]
            scene.frame_set(capture.timesteps[0])
        _select(head, context.view_layer.objects)
        if not heads:  # later on, the user shows it
            hide_default_cube(scene)
        remove(tags.find(tags.TRACKED_HEAD, capture.root))
        middle = central(cameras)
        for kind in COLLECTIONS:
            show_kind(head.parent, kind, context.view_layer, False)
        if context.window is not None and not bpy.app.background:
            frame_head(head, middle, [context.window.screen])
        if set_up_scene and cameras:
            configure_scene(scene, capture, middle, warn=warn)
        for sentence in filter(self.is_reported, capture.warnings):
            warn(sentence)
        _finish_replacing(head, used, had_sliders, warn)
        counted = {"timesteps": capture.timesteps, "triangles": capture.faces, "cameras": cameras}
        self.inform(", ".join(f"{len(all_)} {name}" for name, all_ in counted.items()))
        begin_sliders(head)
        show_panel()
        begin_preparing()

    def is_reported(self, warning: str) -> bool:
        return not self.ignored_warning or self.ignored_warning not in warning


def _store_source(head: Any, capture: Capture, principal_point: str) -> None:
    """Keep on the head how its capture is read, and what the panel says of it."""
    store_path(head, tags.FLAME_MODEL, str(capture.flame_file or ""))
    head[tags.PRINCIPAL_POINT] = principal_point
    head[tags.TRACKED] = is_tracked(capture.root)
    head[tags.FOCAL_LENGTH] = describe_focal_length(capture.root)
    _store_coverage(head, capture_coverage(capture))


def _used_actions() -> set[int]:
    """Session ids of the actions that animate something."""
    return {each.session_uid for each in bpy.data.actions if each.users > each.use_fake_user}


def _finish_replacing(head: Any, used: set[int], had_sliders: bool, warn: Warn) -> None:
    """Give a head back its face sliders, and name the actions, of those that were used before the
    import, that no longer play."""
    if had_sliders:
        call(bpy.ops.stga.add_arkit_controls)
    left = [each for each in bpy.data.actions if each.session_uid in used - _used_actions()]
    if names := ", ".join(each.name for each in left if each.use_fake_user):
        instead = "stay in the file as actions, and the capture's motion plays instead"
        warn(f"{head.name}: keyframes made by hand {instead}: {names}")


def _store_coverage(head: Any, found: CaptureCoverage) -> None:
    """Store what the panel draws of it; nothing of a capture without views."""
    head.pop(tags.OBSERVED_CELLS, None)
    if len(found.directions):
        head[tags.OBSERVED] = f"{found.text}\n{found.next_take}".strip()
        head[tags.OBSERVED_CELLS] = found.cells


def _select(head: Any, objects: Any) -> None:
    """Select the head and its mover alone, where the view layer has it."""
    leave_edit_mode()
    for thing in objects.selected:
        thing.select_set(False)
    if objects.get(head.name) is head:
        head.select_set(True)
        mover_of(head).select_set(True)
        objects.active = head


class ImportCapture(HeadImport, bpy.types.Operator, FileImport):
    """Import a multi-view capture: the tracked head, animated over its frames, and its cameras with
    images"""

    filepath: options.path("File", "Folder of the capture, or any file in it", options=ONCE)
    directory: options.path(
        "Capture",
        "Folder of the capture, with its transforms files or meshes; not needed where a file is "
        "given",
        "DIR_PATH",
        options=ONCE,
    )
    flame: options.flame()
    principal_point: options.choice(
        "Principal Point",
        "Meaning of cx and cy in the transforms files",
        ("vhap", "VHAP", "cy is counted from the bottom of the image, as VHAP's exporter does"),
        ("opencv", "OpenCV", "cx and cy are counted from the top left corner of the image"),
        ("center", "Image Center", "cx and cy are ignored, as GaussianAvatars does"),
        options=ONCE,
    )
    correctives: options.choice(
        "Correctives",
        "FLAME joints that get pose correctives: shape keys, with drivers, that correct the mesh",
        ("all", "All Joints", "Every bone can be posed by hand and gives FLAME's exact mesh"),
        ("moving", "Moving Joints", "Joints that move in this capture only: fewer shape keys"),
    )
    set_up_scene: options.boolean(
        "Set Up Scene",
        "Set the scene's resolution, camera and frame rate to those of the capture, "
        "and its view transform to Standard, which the splats' colors are trained for; unless "
        "asked for, with the scene's first head only",
        default=True,
        options=ONCE,
    )
    filter_glob: options.file_filter("")

    def run(self, context: Any) -> None:
        path = file_path(self.filepath or self.directory, "capture")
        inside = [] if path.is_dir() else path.parents[:FOLDERS_ABOVE_FILE]
        folder = next((parent for parent in inside if transforms_files(parent)), path)
        if folder.is_file():
            raise StgaError(f"{path}: is in no capture; choose a capture's folder, or a file in it")
        point = self.principal_point
        is_asked = self.properties.is_property_set("set_up_scene")
        set_up = self.set_up_scene if is_asked else None
        correctives = self.correctives
        self.bring_in(context, folder, self.flame, point, set_up, correctives)


class ImportMotion(HeadImport, bpy.types.Operator, FileImport):
    """Import FLAME parameters (VHAP, GaussianAvatars, plain expression and pose) as a rigged,
    animated head"""

    bl_label = "Import FLAME Motion"

    flame: options.flame()
    filter_glob: options.file_filter(".npz")

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "motion")
        if flame_model_path(context, self.flame) is None:
            remedy = "choose your FLAME model in the add-on's preferences"
            raise StgaError(f"{path}: holds FLAME parameters; {remedy}")
        self.bring_in(context, path, self.flame)


class ImportMeshes(HeadImport, bpy.types.Operator, FileImport):
    """Import a folder of meshes with the same triangles, one for each frame, as an animated head"""

    bl_label = "Import Mesh Sequence"

    filepath: options.path(
        "File", "Any mesh of the sequence; the whole folder is imported", options=ONCE
    )
    filter_glob: options.file_filter(*MESH_SUFFIXES)

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "mesh sequence")
        self.bring_in(context, path if path.is_dir() else path.parent)


class ImportAvatar(HeadImport, bpy.types.Operator, FileImport):
    """Import a head with bones, sliders, motion and splats from a file of the export format Skinned
    glTF; a new folder beside it gets its parts"""

    bl_label = "Import Avatar"

    filter_glob: options.file_filter(".glb")
    ignored_warning = MASK_FILE  # the file's model is no FLAME model, which masks are made for

    def run(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "avatar")
        folder, found = _unpacked(path)
        is_first = not tags.heads_of(context.scene)
        self.bring_in(context, folder / MOTION_FILE, str(folder / MODEL_FILE))
        if is_first:
            set_frames_per_second(context.scene, found.fps)
        return call(bpy.ops.stga.show_avatar, filepath=str(folder / AVATAR_FILE))


def _unpacked(path: Path) -> tuple[Path, SkinnedSplats]:
    """The folder with the parts of an avatar's file, and what that holds.

    It is the folder of an earlier import of the same file, or a new one: beside the file or, where
    that cannot be written, among Blender's user files. Raises StgaError.
    """
    digest = hashlib.sha256(read_bytes(path)).hexdigest()
    kept = Path(bpy.utils.user_resource("DATAFILES", path=USER_AVATARS))
    places = [parent / f"{path.stem}_avatar" for parent in (path.parent, kept)]
    for place in places:
        for folder in (place, *place.parent.glob(f"{glob.escape(place.name)}_*")):
            if _holds_parts(folder, digest):
                return folder, read_skinned_splats(path)
    for place in places:
        folder = next_folder(place) if os.path.lexists(place) else place
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            problem = f"{folder}: cannot be made ({error.strerror or error})"
            continue
        try:
            found = unpack_skinned_splats(path, folder)
            (folder / SOURCE_FILE).write_text(digest)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return folder, found
    raise StgaError(problem)


def _holds_parts(folder: Path, digest: str) -> bool:
    """Whether a folder has the parts of the avatar's file of this digest, none of them damaged."""
    if not all(is_file(folder / name) for name in UNPACKED):
        return False
    try:
        for name in (MODEL_FILE, MOTION_FILE):
            read_npz(folder / name)
        read_avatar(folder / AVATAR_FILE)
        return read_bytes(folder / SOURCE_FILE) == digest.encode()
    except StgaError:
        return False


class OpenDemo(HeadImport, bpy.types.Operator):
    """Open a small capture of a generated person, to try training in a minute"""

    bl_label = "Open Demo Capture"

    needs = (need(lambda _: DEMO.is_dir(), "Only the complete edition brings the demo capture"),)

    shot: options.boolean(
        "Shot",
        "Train it, and build a film scene around the avatar when it is trained",
        options=ONCE,
    )

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        if properties.shot:
            return (
                "Train the avatar of a generated person for a minute, then build a shot around it: "
                "a body, a room, lamps, a moving camera, speech"
            )
        return ""  # that of the class

    def run(self, context: Any) -> None:
        # in Blender's folder for user files, where an update of the add-on leaves it in place
        folder = (
            Path(bpy.utils.extension_path_user(package(), path="demo", create=True)) / "capture"
        )
        try:
            shutil.copytree(DEMO, folder, dirs_exist_ok=True)
        except (OSError, shutil.Error) as error:
            problem = getattr(error, "strerror", None) or error
            raise StgaError(f"{folder}: cannot be written ({problem})") from error
        self.bring_in(context, folder, set_up_scene=None)
        runs = Path.home() / "STGA Demo"
        names = ("run", *(f"run {number}" for number in range(2, 1000)))
        free = next(runs / name for name in names if not has_run(runs / name))
        settings = context.scene.stga
        settings.run_folder = str(free)
        settings.minutes = DEMO_MINUTES
        settings.shot_run = ""
        if self.shot:
            write_performance(folder.with_name(SPEECH_FILE), demo_speech())
            settings.shot_run = str(free.resolve())
            settings.show_result = True
            call(bpy.ops.stga.train, directory=str(free), iterations=SHOT_ITERATIONS)


class BuildDemoShot(Edit, bpy.types.Operator):
    """Build the demo's shot around its avatar"""

    bl_options = Edit.bl_options | {"INTERNAL"}

    needs = (needs_rig,)

    def run(self, context: Any) -> None:
        head = head_of(context)
        leave_edit_mode()
        build_shot(head, recorded_motion(head), capture_of(head).with_name(SPEECH_FILE))


# Files that are dropped


class OpenNpz(Edit, bpy.types.Operator):
    """Open an .npz file by its content: show an avatar, apply a FLAME motion to the head, or import
    it as a new one"""

    bl_label = "Open Avatar or Motion"
    bl_options = Edit.bl_options | {"INTERNAL"}

    filepath: options.path("File", "Avatar file or FLAME parameters (.npz)", options=ONCE)

    def run(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "avatar or motion")
        try:
            with zipfile.ZipFile(path) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
        except (OSError, zipfile.BadZipFile) as error:
            problem = getattr(error, "strerror", None) or error
            raise StgaError(f"{path}: cannot be read as an .npz file ({problem})") from error
        is_avatar = {"header", "xyz"} <= names
        if not is_avatar and not names & MOTION_FIELDS:
            neither = (
                f"an avatar (no header) nor a FLAME motion (none of {', '.join(FRAME_FIELDS)})"
            )
            raise StgaError(f"{path}: is neither {neither}")
        if is_avatar and not is_head(context.scene.stga.head):
            raise StgaError(f"{path}: is an avatar, which needs a head; import a capture first")
        applies = not is_avatar and bpy.ops.stga.apply_motion.poll()
        motion = bpy.ops.stga.apply_motion if applies else bpy.ops.stga.import_motion
        return call(bpy.ops.stga.show_avatar if is_avatar else motion, filepath=str(path))


def _handler(name: str, label: str, operator: str, *suffixes: str) -> type:
    """A file handler that gives files which are dropped into the 3D viewport to an operator."""

    def poll_drop(cls: type, context: Any) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"

    about: dict[str, Any] = {"bl_idname": f"STGA_FH_{name}", "bl_label": f"{label} (STGA)"}
    about |= {"bl_import_operator": f"stga.{operator}", "bl_file_extensions": ";".join(suffixes)}
    about |= {"poll_drop": classmethod(poll_drop), "__module__": __name__}
    return type(f"{name.title()}Drop", (bpy.types.FileHandler,), about)


# Blender asks which handler to use for .json files, which captures have too.
VideoDrop = _handler("video", "Avatar from Video", "avatar_from_video", *VIDEO_SUFFIXES)
CaptureDrop = _handler("capture", "Head Capture", "import_capture", ".json")
NpzDrop = _handler("npz", "Avatar or FLAME Motion", "open_npz", ".npz")
PlyDrop = _handler("ply", "Gaussian Splats", "import_ply", *READERS)
MotionDrop = _handler("performance", "Face Performance", "apply_motion", *READ_SUFFIXES)
