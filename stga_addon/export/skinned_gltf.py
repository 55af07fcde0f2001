"""Skinned splats: a rigged avatar as glTF, a skinned and morphing mesh with the splats that are
bound to its triangles (docs/formats.md)."""

import gzip
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..avatar.embedding import face_frames
from ..avatar.file import Avatar
from ..avatar.offsets import OFFSETS, POSITION
from ..avatar.splats import Splats
from ..capture.glb import DTYPES, WIDTHS, glb_chunks
from ..errors import StgaError
from ..files import replacing
from ..light.relight import Relighter
from .gltf import GENERATOR, Arrays, Json, glb_bytes
from .playback import Playback
from .rig import Rig, RiggedAvatar, ShapeControls
from .skinned_mesh import BASE_STEP_M, SHAPE_STEP_M, skinned_mesh
from .spz import smallest_three

EXTRA = "stga_splats"
"""Key of the splats in the document's `extras`."""
VERSION = 1
"""Version of the splats in `extras`, the only one that is read."""

MAX_PLANES = 4
"""Bytes of a number at most, each in a plane of its own."""
MAX_STEPS = 1 << 31
"""Largest number of steps from zero: what four planes hold."""
GZIP_LEVEL = 9
"""Level of gzip's compression: the strongest."""

AXES = "_axes"
"""Suffix of the axes (n, n), columns, along which rows of an array of n numbers are stored."""
TURNED = ("color", "sh", "strain_color", "normal_color")
"""Arrays that are stored along their principal axes: red, green and blue go together, and what the
eye does not see becomes zeros."""
MIN_OPACITY = 1 / 255
"""Least opacity that any renderer draws."""


def pack(arrays: Mapping[str, np.ndarray], steps: Mapping[str, float]) -> tuple[Json, bytes]:
    """Entries of arrays in the header, and their values compressed: by their names in fixed point
    as multiples of a step, with an error of at most half of it (along the axes of TURNED).

    Other integers are stored exactly, others in float32. Equal contents give equal bytes. Raises
    ValueError where a value is not finite, or too many steps from zero.
    """
    entries = Json()
    blocks = list[bytes]()
    for name, array in _turned(arrays, steps).items():
        entries[name], block = _entry(name, array, steps.get(name))
        blocks.append(block)
    return entries, gzip.compress(b"".join(blocks), GZIP_LEVEL, mtime=0)


def _turned(arrays: Mapping[str, np.ndarray], steps: Mapping[str, float]) -> Arrays:
    """The arrays, those of TURNED along axes that follow them."""
    turned = dict(arrays)
    for name in TURNED:
        if name in arrays and name in steps and np.isfinite(arrays[name]).all():
            rows = np.asarray(arrays[name], np.float64)
            axes = np.linalg.eigh(rows.T @ rows)[1][:, ::-1].astype(np.float32)
            turned[name] = rows @ axes
            turned[name + AXES] = axes
    return turned


def _entry(name: str, array: np.ndarray, step: float | None) -> tuple[Json, bytes]:
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


POSITION_STEP_M = 2.5e-5
"""Step of splats' positions."""
MOVED_STEP_M = 4e-5
"""Step of how far a driven offset moves them with a unit of its signal."""
OFFSET_STEP = 2.0**-7
"""Quantization step of other driven offsets."""
PLAYER_SIGNALS = ("smoothed_strain", "normal")
"""Those of `face_frames.js`."""
STEPS = {
    # The three smaller parts of a unit quaternion lie within ±0.7071.
    "rotation": 1 / 128,
    "log_scale": 0.06,
    "opacity": 1 / 255,
    # Of the constant SH coefficient, which a color has 0.28 times.
    "color": 0.02,
    "sh": 0.03,
    # Of the ends of a triangle's range.
    "strain_range": 0.03,
    "neutral": BASE_STEP_M,
    "correctives": SHAPE_STEP_M,
    # Of irradiance over radiance, which is at most π.
    "light_transfer": 2.0**-7,
    "light_occlusion": 1 / 255,
    "light_roughness": 1 / 255,
}
"""Array -> step of its fixed-point values: half of one is the largest error. Of the demo's head,
each by itself leaves a picture 52 dB PSNR or more."""
IRRADIANCE_STEPS = 1023
"""Steps to the largest irradiance of the capture, whose level is any."""

MIN_SLIDER_RANGE = 1.0
"""Sliders reach ±this at least."""
SLIDER_HEADROOM = 1.5
"""Factor by which sliders also reach beyond the motion."""


def skinned_glb(rigged: RiggedAvatar, playback: Playback, exact: bool = False) -> bytes:
    """The .glb file of an avatar; `exact`: float32 instead of fixed point.

    Raises ValueError where a value is not finite, or the player lacks a driven offset.
    """
    header, arrays, steps = _splat_data(rigged, playback)
    entries, packed = pack(arrays, {} if exact else steps)
    document, accessors = skinned_mesh(rigged.rig, rigged.avatar.faces, playback.fps, exact)
    copyright = {"copyright": rigged.notice} if rigged.notice else {}
    mesh_bytes = accessors.binary
    place = {"byteOffset": len(mesh_bytes), "byteLength": len(packed)}
    binary = mesh_bytes + packed
    document |= {
        "asset": {"version": "2.0", "generator": GENERATOR} | copyright,
        "accessors": accessors.accessors,
        "bufferViews": accessors.views,
        "buffers": [{"byteLength": len(binary)}],
        "extras": {EXTRA: {"version": VERSION, **header, **place, "arrays": entries}},
    }
    return glb_bytes(document, binary)


def _splat_data(rigged: RiggedAvatar, playback: Playback) -> tuple[Json, Arrays, dict[str, float]]:
    """Header, arrays and the steps of these."""
    avatar = rigged.avatar
    rig = rigged.rig
    relighter = None if avatar.light is None else Relighter(avatar)
    surface = avatar.splats.face if relighter is None else relighter.face
    # equal triangles side by side, which gzip likes
    order = np.lexsort((surface, avatar.splats.face))
    order = order[avatar.splats.opacities()[order] >= MIN_OPACITY]
    splats = avatar.splats.rows(order)
    faces = len(avatar.faces)
    arrays = _splat_arrays(splats) | {
        "splats_per_face": np.bincount(splats.face, minlength=faces),
        "joint_basis": rig.joint_basis,
    }
    if len(rig.correctives) and np.abs(rig.correctives).max() > 0:
        arrays["correctives"] = rig.correctives
    at_rest = np.resize(rig.base, avatar.neutral.shape)
    if np.abs(avatar.neutral - at_rest).max() > BASE_STEP_M:
        arrays["neutral"] = avatar.neutral
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
    return header, arrays, steps


def write_skinned_gltf(path: Path, rigged: RiggedAvatar, playback: Playback) -> None:
    """Write an avatar as .glb, atomically. Raises StgaError where a value cannot be stored, or the
    file not be written."""
    with replacing(path) as partial:
        partial.write_bytes(glb_of(path, rigged, playback))


def glb_of(path: Path, rigged: RiggedAvatar, playback: Playback) -> bytes:
    """As `skinned_glb`; raises StgaError naming `path`."""
    try:
        return skinned_glb(rigged, playback)
    except ValueError as error:
        raise StgaError(f"{path}: the avatar cannot be exported ({error})") from error


def _splat_arrays(splats: Splats) -> Arrays:
    largest, smaller = smallest_three(splats.rotation)
    view = splats.sh[:, 1:].reshape(len(splats), -1)
    return {
        "xyz": splats.xyz,
        "rotation": smaller,
        "rotation_largest": largest,
        "log_scale": splats.log_scale,
        "opacity": splats.opacities(),
        "unbound": splats.unbound,
        "color": splats.sh[:, 0],
        **({"sh": view} if view.shape[1] else {}),
    }


def _add_controls(header: Json, arrays: Arrays, controls: ShapeControls) -> None:
    arrays |= {"shape_linear": controls.linear, "shape_products": controls.products}
    header["shapes"] = {
        "names": list(controls.names),
        "opens": controls.opens,
        "limited": controls.limited,
    }


def _add_light(
    header: Json,
    arrays: Arrays,
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
        "radiance": light.radiance.ravel().tolist(),
        "residual": light.residual,
        "source": light.source,
    }


def _header(avatar: Avatar, rig: Rig, playback: Playback) -> Json:
    """All fields but those of shapes, light and arrays."""
    # Sliders: every expression with its range, those that the motion uses most first.
    names = rig.shape_names
    used = rig.coefficients[:, : rig.expressions]
    reach = np.maximum(SLIDER_HEADROOM * np.abs(used).max(0, initial=0.0), MIN_SLIDER_RANGE)
    order = np.argsort(-used.std(0), kind="stable").tolist()
    return {
        "title": playback.title,
        "expressions": rig.expressions,
        "named": bool(rig.expression_names),
        "convention": avatar.convention,
        "antialiased": avatar.antialiased,
        "offsets": {},
        "background": [float(value) for value in avatar.background],
        "fps": playback.fps,
        "up": [float(value) for value in playback.up],
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


def in_planes(glb: bytes) -> bytes:
    """A .glb of this module as pages hold it, which compresses by a fifth more: of each accessor's
    buffer view one byte of all components after the other, and of integers without sign and floats
    the difference from the row before. Only the player reads it."""
    document, binary = glb_chunks(glb)
    document["extras"][EXTRA]["planes"] = True
    layouts = dict[int, tuple[int, str]]()
    for accessor in document["accessors"]:
        kind = accessor["componentType"]
        layouts[accessor.get("bufferView", -1)] = kind, accessor["type"]
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            indices = sparse["indices"]
            layouts[indices["bufferView"]] = indices["componentType"], "SCALAR"
            layouts[sparse["values"]["bufferView"]] = kind, accessor["type"]
    layouts.pop(-1, None)
    stored = bytearray(binary)
    for index, (kind, shape) in layouts.items():
        view = document["bufferViews"][index]
        place = slice(view["byteOffset"], view["byteOffset"] + view["byteLength"])
        dtype = np.dtype(DTYPES[kind])
        rows = np.frombuffer(binary[place], f"<u{dtype.itemsize}").reshape(-1, WIDTHS[shape])
        if dtype.kind != "i":
            rows = np.diff(rows, axis=0, prepend=rows[:1] * 0)
            rows[0] = np.frombuffer(binary[place], rows.dtype, WIDTHS[shape])
        stored[place] = rows.view(np.uint8).reshape(len(rows), -1).T.tobytes()
    return glb_bytes(document, bytes(stored))
