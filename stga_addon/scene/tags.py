"""Custom properties and names by which objects in a .blend file refer to their capture."""

from pathlib import Path
from typing import Any

import bpy

# Custom properties on objects.
KIND = "stga_kind"  # one of the kinds below
CAPTURE = "stga_capture"  # the capture's folder (or a motion's file); see `record`
FLAME_MODEL = "stga_flame_model"  # on the head: the file that the capture was opened with, or ""
PRINCIPAL_POINT = "stga_principal_point"  # on the head: how cx and cy of the capture were read
TIMESTEPS = "stga_timesteps"  # on the head: ints, ascending
KEY_REGIONS = "stga_key_regions"  # on the head: regions selected as a whole, one per line
TRACKED = "stga_tracked"  # on the head: `tracking.folder.is_tracked`
FOCAL_LENGTH = "stga_focal_length"  # on the head: `tracking.folder.FocalLength.description`, or ""
TRACKING_KEYS = "stga_tracking_keys"  # on the head: JSON, timestep -> parameters posed by hand
CAMERA_INDEX = "stga_camera_index"  # on a camera
IMAGE_SIZE = "stga_image_size"  # on a camera: width, height in pixels
PIXEL_ASPECT = "stga_pixel_aspect"  # on a camera: fl_x / fl_y, the height of a pixel over its width
CONVENTION = "stga_convention"  # on splats that follow a head: `Avatar.convention`
ANTIALIASED = "stga_antialiased"  # on splats that follow a head: `Avatar.antialiased`
# on splats that follow a head: `avatar.observed.observed_sides`; on the head: lines of
# `capture.coverage.CaptureCoverage`, its text and its next take
OBSERVED = "stga_filmed"
OBSERVED_CELLS = "stga_filmed_cells"  # on the head: `capture.coverage.CaptureCoverage.cells`
UNSEEN_DISPLAYED = "stga_shown_unseen"  # on the head: its first avatar has shown what is not filmed
REVISION = "stga_revision"  # on a splat object's mesh: changes whenever splats are written into it
RELIT_FRAME = "stga_relit_frame"  # on that mesh: the frame in whose light other engines show it
AVATAR = "stga_avatar"  # on the head: the file of the avatar that it wears
RUN = "stga_run_folder"  # on the head: folder of its run, which may not have begun
STORED_IN = "stga_stored_in"  # on owners of paths: the .blend file that these were stored in
WORLD = "stga_world"  # on splats of a run's world: their file
PERFORMANCE = "stga_performance"  # on an action: keyframes of another motion than the capture's
# on an action: digest of the keyframes that an import gave it; on a camera: where it placed it
IMPORTED = "stga_imported"
POSE = "stga_pose"  # on an action: a pose in the asset browser, `rig.poses`
HELD = "stga_held"  # on an action: the part of the capture's motion that is held outside of it

SET = "stga_set"  # on a scene: the scene that renders its set, `render.film_set`
# on a scene: its depth pass is on for its set alone; on splats: the shadow of their head is
ON_FOR_SET = "stga_on_for_set"
SCENE_RESOLUTION = "stga_own_resolution"  # on a scene, while a capture's camera is looked through

# Kinds of object.
ROOT = "root"
HEAD = "head"
RIG = "rig"
CAMERA = "camera"
SPLATS = "splats"
TRACKED_HEAD = "tracked head"  # a mesh without rig, until its capture is imported
NOTE = "note"  # in files: what is missing where the extension is not enabled

# Boolean face attributes of the head mesh, one per region.
REGION_PREFIX = "stga_region_"

# Vertex groups of the head, one per timestep.
GROUP_PREFIX = "stga_"


def group_name(timestep: int) -> str:
    """Vertex group of a timestep; unpadded, so that nodes can build the name."""
    return f"{GROUP_PREFIX}{timestep}"


def group_timestep(name: str) -> int | None:
    """The timestep whose selection the vertex group `name` holds; None for any other group."""
    digits = name.removeprefix(GROUP_PREFIX)
    # int() would also accept "007", "1_0" and other scripts' digits.
    is_selection = digits.isdecimal() and name == group_name(int(digits))
    return int(digits) if is_selection else None


def mark(obj: Any, kind: str, capture: Path) -> None:
    """Tag an object as `kind` of the capture in folder `capture`."""
    obj[KIND] = kind
    obj[CAPTURE] = str(capture.resolve())


def is_head(thing: Any) -> bool:
    """Whether an object (or None) is a head that was imported from a capture."""
    return thing is not None and thing.get(KIND) == HEAD


def heads_of(scene: Any) -> list[Any]:
    """The heads of a scene, also linked ones."""
    return [thing for thing in scene.objects if is_head(thing)]


def is_splats(thing: Any) -> bool:
    """Whether an object is one of splats that the add-on shows."""
    return bool(thing.get(KIND) == SPLATS)


def find(kind: str, capture: Path) -> list[Any]:
    """All objects of a kind in the current scene that were made from the capture in folder
    `capture`. Objects linked from other files are left out: they cannot be edited here."""
    folder = str(capture.resolve())
    return [
        obj
        for obj in bpy.context.scene.objects
        if obj.get(KIND) == kind and obj.get(CAPTURE) == folder and obj.library is None
    ]
