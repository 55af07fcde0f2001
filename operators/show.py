"""The Show step: avatars and splats of files, their display, and their light."""

import os
from math import radians
from typing import Any

import bpy

from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.errors import StgaError
from ..stga_addon.export.splat_files import READERS, read_splats
from ..stga_addon.jobs.finished_run import MakeExact as MakeExactRequest
from ..stga_addon.jobs.finished_run import Relight
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import compat, tags
from ..stga_addon.scene.avatar_scene import show_world
from ..stga_addon.scene.display import splat_object
from ..stga_addon.scene.display.splat_nodes import AS_TRAINED, LIMITS, NATIVE, POINTS, QUADS
from ..stga_addon.scene.light import throw_shadow, throws_shadow
from ..stga_addon.scene.objects import show_progress
from ..stga_addon.scene.render import film_set
from ..stga_addon.scene.render.scene_splats import forget_frame, relight_frame
from ..stga_addon.scene.render.viewport_display import ENGINE, is_displayed_as_trained
from ..stga_addon.scene.rig.head import LINKED
from . import common, options
from .common import Action, Edit, FileImport, file_path, head_of, is_run, need
from .options import ONCE
from .request import idle, start
from .results import check_replaceable, editable_splats
from .training_python import training_python

GRAY = ("WIREFRAME", "SOLID")
"""Kinds of shading that show colors of splats as trained only."""
OFFERED = [mode for mode in LIMITS if mode != NATIVE or compat.NATIVE_SPLATS]
"""Displays that this Blender has."""
SURFACES = ("MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME")
"""Types of objects that the engine STGA Splats leaves out."""
UP_ROTATION_DEG = {"Y": 90.0, "-Y": -90.0, "Z": 0.0}
"""Up axis of a file -> rotation about x that turns it to Blender's."""


class ShowAvatar(Edit, bpy.types.Operator, FileImport):
    """Show a trained avatar: splats that follow the animated head"""

    needs = (common.needs_head,)

    hide_head: options.boolean(
        "Hide Head",
        "Hide the head's mesh, which covers the splats; it still deforms them",
        default=True,
    )
    filter_glob: options.file_filter(".npz")

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "avatar")
        head = head_of(context)
        settings = context.scene.stga
        avatar = read_avatar(path)
        show_progress(0.3)
        before = editable_splats(context.scene, head)
        check_replaceable(context.scene, head, before)
        name = f"{head.name} {path.stem}"
        splats = splat_object.show_avatar(avatar, head, name, replaced=before)
        splats.hide_viewport = False
        if before is not None and context.view_layer.objects.get(splats.name) is splats:
            splats.hide_set(False)
        settings.splats = splats
        if self.hide_head:
            splat_object.hide_object(head, context.scene)
        show_world(path, head, context.scene)
        settings.avatar = self.filepath
        folder = os.path.dirname(self.filepath)
        if is_run(folder):
            settings.run_folder = folder
        if self.hide_head and head.library is not None:
            problem = "is linked, and covers the splats in renders; hide it in its file"
            self.warn(f"{head.name}: {problem}")
        self.inform(f"{len(avatar.splats)} splats")


class ImportPly(Edit, bpy.types.Operator, FileImport):
    """Import 3D Gaussians of a PLY, SPZ or .splat file"""

    bl_label = "Import Gaussian Splats"

    filter_glob: options.file_filter(*READERS)
    up: options.choice(
        "Up",
        "Axis of the file that points up",
        ("Y", "Y", "Captures tracked with FLAME, and what this add-on exports"),
        ("-Y", "-Y", "Scenes reconstructed with COLMAP"),
        ("Z", "Z", "Blender's up axis"),
    )

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "splat")
        splats = read_splats(path, self.warn)
        world_splats = context.scene.stga.splats = splat_object.show_world_splats(splats, path.stem)
        world_splats.rotation_euler = (radians(UP_ROTATION_DEG[self.up]), 0.0, 0.0)
        self.inform(f"{len(splats)} splats")


# Display


class ChooseDisplay(Edit, bpy.types.Operator):
    """Choose how the splats are displayed, in a shading that shows their colors"""

    bl_label = "Display"
    needs = (
        need(
            lambda context: getattr(context.scene.stga.splats, "library", "") is None,
            "Show an avatar first",
        ),
    )

    display: options.choice(
        "Display", "How splats are displayed", *((mode, mode, LIMITS[mode]) for mode in OFFERED)
    )

    def run(self, context: Any) -> None:
        splat_object.choose_display(context.scene.stga.splats, self.display)
        space = context.space_data
        is_viewport = getattr(space, "type", "") == "VIEW_3D"  # a script has none
        if is_viewport and self.display != AS_TRAINED and space.shading.type in GRAY:
            space.shading.type = "MATERIAL"


def leaves_out_set(scene: Any) -> bool:
    """Whether the engine STGA Splats leaves other objects out of the scene's images."""
    if scene.render.engine != ENGINE or film_set.shows_set(scene):
        return False
    others = (thing for thing in scene.objects if tags.KIND not in thing and not thing.hide_render)
    return any(thing.type in SURFACES for thing in others)


def _local_as_trained(context: Any) -> list[Any]:
    """The splat objects displayed as trained, whose display can be changed: no linked ones."""
    local = [thing for thing in context.view_layer.objects if thing.library is None]
    return [thing for thing in local if is_displayed_as_trained(thing)]


PREVIEW_SAMPLES = 4
"""EEVEE's samples of a viewport that shows splats as transparent quads: 16, its default, take
minutes where the processor draws."""


class ChooseSet(Edit, bpy.types.Operator):
    """Choose whether images of the engine STGA Splats show the scene's other objects: EEVEE renders
    them in the same press, as a scene of its own, and the compositor combines both by depth"""

    bl_label = "Set"

    shown: options.choice(
        "Set",
        "What images show beside splats",
        ("SHOWN", "Shown", "The other objects, in front of the splats and behind them"),
        ("LEFT_OUT", "Left Out", "Splats alone"),
    )

    def run(self, context: Any) -> None:
        change = film_set.show_set if self.shown == "SHOWN" else film_set.leave_out_set
        change(context.scene)


class PreviewImages(Edit, bpy.types.Operator):
    """Show all splats as images by EEVEE and Cycles show them: as Blender's own from 5.3 on, before
    through the scene's camera as quads that face it, without one as points"""

    bl_label = "Preview for EEVEE/Cycles"
    needs = (need(_local_as_trained, "No splats are displayed as trained"),)

    def run(self, context: Any) -> None:
        scene = context.scene
        space = context.space_data
        mode = QUADS if scene.camera is not None else POINTS
        mode = NATIVE if compat.NATIVE_SPLATS else mode
        for thing in _local_as_trained(context):
            splat_object.choose_display(thing, mode)
        splat_object.use_transparent_bounces(scene)
        if scene.render.engine != ENGINE:  # others show the set themselves
            film_set.leave_out_set(scene)
        if mode == QUADS:
            self._limit_samples(scene.eevee)
        if getattr(space, "type", "") == "VIEW_3D":  # none where a script calls it
            # Material Preview is EEVEE, whatever the scene's engine is.
            space.shading.type = "RENDERED" if splat_object.shows_nodes(scene) else "MATERIAL"
            if mode == QUADS:
                space.region_3d.view_perspective = "CAMERA"
        if hint := splat_object.view_transform_hint(scene):
            self.warn(hint)
        else:
            self.inform(f"{mode}: {LIMITS[mode]}")

    def _limit_samples(self, eevee: Any) -> None:
        """Let viewports take few samples; 0 is without end."""
        if not 0 < eevee.taa_samples <= PREVIEW_SAMPLES:
            eevee.taa_samples = PREVIEW_SAMPLES
            self.inform(f"EEVEE takes {PREVIEW_SAMPLES} samples in viewports; renders as before")


class StandardView(Edit, bpy.types.Operator):
    """Show colors as trained: set the scene's view transform to Standard"""

    bl_label = "Use Standard View"

    def run(self, context: Any) -> None:
        context.scene.view_settings.view_transform = "Standard"
        context.scene.view_settings.look = "None"


# Light


def _needs_splats(operator: Any, context: Any) -> bool:
    """Poll: whether there are splats that follow a head."""
    head = splat_object.followed_head(context.scene.stga.splats)
    return common.polled(operator, head is not None, "Show an avatar first")


def _needs_editable_splats(operator: Any, context: Any) -> bool:
    """Poll: whether there are splats that follow a head, and can be changed here, as it can."""
    if not _needs_splats(operator, context):
        return False
    splats = context.scene.stga.splats
    for thing in (splats, splats.data, splat_object.followed_head(splats)):
        if thing.library is not None:
            return common.polled(operator, False, f"{thing.name}: {LINKED}")
    try:
        splat_object.check_editable_data(splats)
    except StgaError as error:
        return common.polled(operator, False, str(error))
    return True


class RunAddition(Action):
    """Mixin of operators that start a request about the shown avatar's run."""

    request: type[Any]
    directory: options.path("Run Folder", "Folder of the avatar's run", "DIR_PATH")

    def run(self, context: Any) -> None:
        run = file_path(self.directory or context.scene.stga.run_folder, "run folder")
        request = self.request(run, flame=common.flame_model_path(context))
        start(context.scene, request, training_python(context))


class EstimateLight(RunAddition, bpy.types.Operator):
    """Find out the light of the capture that the avatar was trained on, so that the scene can light
    the avatar"""

    request = Relight
    needs = (idle(Kind.LIGHT), _needs_editable_splats)


class MakeExact(RunAddition, bpy.types.Operator):
    """Fit the avatar's colors to EEVEE and Cycles, which blend splats in linear light: takes
    seconds. The display As Trained stays the same"""

    bl_label = "Bake for Linear Blending"
    request = MakeExactRequest
    needs = (idle(Kind.EXACT), _needs_editable_splats)


class RelightFrame(Edit, bpy.types.Operator):
    """Give the splats the colors of the scene's light at this frame, for EEVEE and Cycles; other
    frames keep them"""

    needs = (_needs_editable_splats,)
    clear: options.boolean("Clear", "Show recorded colors again", options=ONCE)

    def run(self, context: Any) -> None:
        if self.clear:
            forget_frame(context.scene.stga.splats)
        else:
            relight_frame(context.scene.stga.splats, context.scene)


class HeadShadow(Edit, bpy.types.Operator):
    """Let the head's mesh throw shadows onto other objects in EEVEE and Cycles, without being seen;
    again: hide it"""

    needs = (_needs_editable_splats,)

    def run(self, context: Any) -> None:
        splats = context.scene.stga.splats
        is_on = not throws_shadow(splats)
        throw_shadow(splats, is_on)
        self.inform("The head throws shadows" if is_on else "The head throws no shadows")
