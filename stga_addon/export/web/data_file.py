"""Web data files: a rigged avatar, how it plays, and cameras (docs/formats.md)."""

import gzip
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...avatar.embedding import face_frames
from ...avatar.file import Avatar
from ...avatar.offsets import OFFSETS, POSITION
from ...avatar.splats import Splats
from ...light.relight import Relighter
from ..playback import Playback
from ..rig import Rig, RiggedAvatar, ShapeControls
from ..spz import smallest_three

MAGIC = b"STGA"
FORMAT = "stga-web"
VERSION = 4
MAX_PLANES = 4
MAX_STEPS = 1 << 31
"""Largest number of steps from zero: what four planes hold."""
GZIP_LEVEL = 7
"""Level 9 takes six times as long and makes the demo's page half a percent smaller."""


def pack(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], steps: Mapping[str, float]
) -> bytes:
    """A data file: `header` and `arrays`, by their names in fixed point as multiples of a step,
    with an error of at most half of it.

    Other integers are stored exactly, others in float32. Equal contents give equal bytes. Raises
    ValueError where a value is not finite, or too many steps from zero.
    """
    packed = {name: _entry(name, array, steps.get(name)) for name, array in arrays.items()}
    entries = {name: entry for name, (entry, _) in packed.items()}
    complete = {"format": FORMAT, "version": VERSION, **header, "arrays": entries}
    text = json.dumps(complete, ensure_ascii=False, allow_nan=False).encode("utf-8")
    begin = MAGIC + struct.pack("<II", VERSION, len(text))
    raw = b"".join((begin, text, *(block for _, block in packed.values())))
    return gzip.compress(raw, GZIP_LEVEL, mtime=0)


def _entry(name: str, array: np.ndarray, step: float | None) -> tuple[dict[str, Any], bytes]:
    """Header entry and stored bytes of an array."""
    if step is not None:
        steps = np.rint(np.asarray(array, np.float64) / step)
        if not (np.abs(steps) < MAX_STEPS).all():
            limit = MAX_STEPS * step
            raise ValueError(f"{name} holds a value that is not finite, or beyond {limit:g}")
        integers = steps.astype(np.int64)
        entry = {"type": "fixed", "step": step}
    elif array.dtype.kind in "iub":
        integers = array.astype(np.int64)
        entry = {"type": "integer"}
    else:
        floats = np.ascontiguousarray(array, "<f4")
        if not np.isfinite(floats).all():
            raise ValueError(f"{name} holds a value that is not finite")
        return {"type": "float32", "shape": list(array.shape)}, floats.tobytes()
    low = int(integers.min()) if integers.size else 0
    above = integers - low
    largest = int(above.max()) if above.size else 0
    count = max(1, (largest.bit_length() + 7) // 8)
    if count > MAX_PLANES:
        raise ValueError(f"values from {low} to {low + largest} do not fit {MAX_PLANES} bytes")
    # Byte planes of what is above the lowest, least significant first. Within a plane the last
    # axis varies slowest, so that equal quantities lie side by side: gzip gains a fifth.
    planes = ((above >> 8 * plane).astype(np.uint8) for plane in range(count))
    entry |= {"shape": list(integers.shape), "planes": count, "low": low}
    return entry, b"".join(np.moveaxis(plane, -1, 0).tobytes() for plane in planes)


POSITION_STEP_M = 4e-6
MOVED_STEP_M = 0.25e-6
"""Of splats, and of how far a driven offset moves them with a unit of its signal."""
OFFSET_STEP = 2.0**-12
"""Of other driven offsets. Signals are at most 2 in each of three components: half a step of each
changes a color by 0.19 / 255, a size by 0.07 %, and moves a splat by 0.75 µm along an axis."""
PLAYER_SIGNALS = ("smoothed_strain", "normal")
"""Those of `face_frames.js`."""
STEPS = {
    # The three smaller parts of a unit quaternion lie within ±0.7071: ten bits each.
    "rotation": 1 / 724,
    "log_scale": 0.015,
    "opacity": 1 / 255,
    # Of the constant SH coefficient, which a color has 0.28 times.
    "color": 0.004,
    "sh": 0.005,
    # Of the ends of a triangle's range: positions that follow strain by 2 mm err by 2 µm.
    "strain_range": 0.002,
    # Meters, so fine that no thin triangle becomes a line, or the reverse.
    "base": 2.0**-24,
    "neutral": 2.0**-24,
    "basis": 2e-6,
    "correctives": 2e-6,
    "weights": 1 / 65535,
    # Of irradiance over radiance, which is at most π.
    "light_transfer": 2.0**-12,
    "light_occlusion": 1 / 255,
    "light_roughness": 1 / 255,
}
"""Array -> step of its fixed-point values: half of one is the largest error. With POSITION_STEP_M
they leave a picture of large random splats 55 dB PSNR at least (tests/export/web/test_page.py)."""
IRRADIANCE_STEPS = 65535
"""Steps to the largest irradiance of the capture, whose level is any."""

MIN_SLIDER_RANGE = 1.0
SLIDER_HEADROOM = 1.5
"""Sliders reach beyond the motion by this factor, and to ±1 at least."""


MOVING = (
    "base",
    "basis",
    "correctives",
    "weights",
    "joint_rest",
    "joint_basis",
    "coefficients",
    "pose",
    "translation",
)
"""Arrays of the rig."""


def data_file(rigged: RiggedAvatar, playback: Playback, exact: bool = False) -> bytes:
    """The data file of an avatar; `exact`: float32 instead of fixed point.

    Raises ValueError where a value is not finite, or the player lacks a driven offset.
    """
    avatar = rigged.avatar
    rig = rigged.rig
    relighter = None if avatar.light is None else Relighter(avatar)
    surface = avatar.splats.face if relighter is None else relighter.face
    # equal triangles side by side, which gzip likes
    order = np.lexsort((surface, avatar.splats.face))
    splats = avatar.splats.rows(order)
    faces = len(avatar.faces)
    arrays = _splat_arrays(splats) | {
        "faces": avatar.faces,
        "neutral": avatar.neutral,
        "splats_per_face": np.bincount(splats.face, minlength=faces),
    }
    arrays |= {name: getattr(rig, name) for name in MOVING}
    # meters of a unit of the splats' local frames, where it is largest
    frames = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention)
    unit = float(frames.scale.max(initial=1e-6))
    steps = STEPS | {"xyz": POSITION_STEP_M / unit, "light_lash_corners": POSITION_STEP_M / unit}
    if avatar.follows_strain and avatar.strain_range is not None:
        arrays["strain_range"] = avatar.strain_range.reshape(faces, -1)
    header = _header(avatar, rig, playback)
    for name, coefficients in avatar.driven_offsets.items():
        offset = OFFSETS[name]
        if offset.signal not in PLAYER_SIGNALS:
            raise ValueError(f"the web player has no driven offset {name}")
        header["offsets"][name] = offset.signal, "light" if offset.of_light else offset.target
        arrays[name] = coefficients.reshape(faces, -1)
        steps[name] = MOVED_STEP_M / unit if offset.target == POSITION else OFFSET_STEP
    if rigged.controls is not None and rig.expressions:
        _add_controls(header, arrays, rigged.controls)
        if rig.expression_names:  # they are ARKit's shapes, whose sliders these are
            header["sliders"] = []
    if relighter is not None:
        # of most splats 0: their own
        moved = ((relighter.face - avatar.splats.face) % faces)[order]
        _add_light(header, arrays, relighter, moved)
        brightest = float(relighter.light.irradiance.max(initial=1e-6))
        steps["light_irradiance"] = brightest / IRRADIANCE_STEPS
    if playback.selection is not None:
        arrays["selection"] = np.packbits(np.stack(playback.selection), axis=1)
    return pack(header, arrays, {} if exact else steps)


def _splat_arrays(splats: Splats) -> dict[str, np.ndarray]:
    largest, smaller = smallest_three(splats.rotation)
    view = splats.sh[:, 1:].reshape(len(splats), -1)
    return {
        "xyz": splats.xyz,
        "rotation": smaller,
        "rotation_largest": largest,
        "log_scale": splats.log_scale,
        "opacity": splats.opacities(),
        "color": splats.sh[:, 0],
        **({"sh": view} if view.shape[1] else {}),
    }


def _add_controls(
    header: dict[str, Any], arrays: dict[str, np.ndarray], controls: ShapeControls
) -> None:
    arrays |= {"shape_linear": controls.linear, "shape_products": controls.products}
    header["shapes"] = {
        "names": list(controls.names),
        "opens": controls.opens,
        "limited": controls.limited,
    }


def _add_light(
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    relighter: Relighter,
    moved: np.ndarray,
) -> None:
    """moved (N,): from a splat's triangle to that which lights it, in the file's order."""
    light = relighter.light
    lashes = relighter.lashes
    by_vertex = "transfer", "occlusion", "irradiance", "roughness"
    arrays |= {f"light_{name}": getattr(light, name) for name in by_vertex}
    arrays["light_face"] = moved
    arrays["light_lash_face"] = lashes.face
    arrays["light_lash_corners"] = lashes.corners.reshape(-1, 12)
    header["light"] = {
        "damping": light.damping,
        "typical": relighter.typical_albedo.tolist(),
        "recorded": relighter.recorded_light.ravel().tolist(),
    }


def _header(avatar: Avatar, rig: Rig, playback: Playback) -> dict[str, Any]:
    """All but what tells of shapes, light and arrays."""
    # Sliders: every expression with its range, those that the motion uses most first.
    names = rig.shape_names
    used = rig.coefficients[:, : rig.expressions]
    reach = np.maximum(SLIDER_HEADROOM * np.abs(used).max(0, initial=0.0), MIN_SLIDER_RANGE)
    order = np.argsort(-used.std(0), kind="stable").tolist()
    return {
        "title": playback.title,
        "convention": avatar.convention,
        "antialiased": avatar.antialiased,
        "offsets": {},
        "background": [float(value) for value in avatar.background],
        "fps": playback.fps,
        "up": [float(value) for value in playback.up],
        "joints": list(rig.joint_names),
        "parents": list(rig.parents),
        "sliders": [
            {"name": names[k], "component": k, "reach": round(float(reach[k]), 2)} for k in order
        ],
        "views": [
            {
                "name": name,
                "size": [camera.width, camera.height],
                "focal": [camera.fl_x, camera.fl_y],
                "center": [camera.cx, camera.cy],
                "world_to_camera": camera.world_to_camera.ravel().tolist(),
            }
            for name, camera in playback.views.items()
        ],
    }
