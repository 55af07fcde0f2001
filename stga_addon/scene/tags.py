"""The names under which a .blend remembers what came from which capture; the only place they are spelled."""

from pathlib import Path
from typing import Any

import bpy

# Custom properties on objects.
KIND = "stga_kind"  # one of the kinds below
CAPTURE = "stga_capture"  # the capture's folder (or a motion's file), absolute
FLAME_MODEL = "stga_flame_model"  # on the head: the FLAME model file the capture was opened with, or ""
PRINCIPAL_POINT = "stga_principal_point"  # on the head: how cx and cy of the capture were read
TIMESTEPS = "stga_timesteps"  # on the head: ints, ascending
KEY_REGIONS = "stga_key_regions"  # on the head: names, one a line, of what the selection takes as a whole
CAMERA_INDEX = "stga_camera_index"  # on a camera
IMAGE_SIZE = "stga_image_size"  # on a camera: width, height in pixels
CONVENTION = "stga_convention"  # on splats that follow a head: `Avatar.convention`
ANTIALIASED = "stga_antialiased"  # on the same: `Avatar.antialiased`
PIXEL_ASPECT = "stga_pixel_aspect"  # on a camera: fl_x / fl_y, the height of a pixel over its width
RUN = "stga_run"  # on splats that show a training: the run's folder

# Kinds of object.
ROOT, HEAD, RIG, CAMERA, SPLATS = "root", "head", "rig", "camera", "splats"

# Boolean face attributes of the head mesh, one a region.
REGION_PREFIX = "stga_region_"

# Vertex groups of the head, one a timestep; a vertex is selected from SELECTED_WEIGHT on.
GROUP_PREFIX = "stga_"
SELECTED_WEIGHT = 0.5


def group_name(timestep: int) -> str:
    """Vertex group that holds a timestep's selection; unpadded, so that nodes can build the name from the frame."""
    return f"{GROUP_PREFIX}{timestep}"


def group_timestep(name: str) -> int | None:
    """The timestep whose selection the vertex group `name` holds; None for any other group."""
    digits = name.removeprefix(GROUP_PREFIX)
    # Only the exact spelling: int() would also accept "007", "1_0" and other scripts' digits.
    is_ours = digits.isdecimal() and name == group_name(int(digits))
    return int(digits) if is_ours else None


def mark(thing: Any, kind: str, capture: Path) -> None:
    """Tag an object as `kind` of the capture in folder `capture`."""
    thing[KIND] = kind
    thing[CAPTURE] = str(capture.resolve())


def find(kind: str, capture: Path) -> list[Any]:
    """All objects of a kind in the current scene that were made from the capture in folder `capture`.

    Objects linked from other files are left out: nothing in them can be changed here.
    """
    folder = str(capture.resolve())
    return [
        thing
        for thing in bpy.context.scene.objects
        if thing.get(KIND) == kind and thing.get(CAPTURE) == folder and thing.library is None
    ]
