"""Web data files: an avatar, a linear rig that moves it, and cameras (docs/formats.md)."""

import gzip
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...avatar.embedding import face_frames
from ...avatar.file import Avatar
from ...avatar.splats import Splats
from ...capture.mesh_geometry import weighted_procrustes
from ...flame.forward import joint_positions
from ...flame.model import JOINTS
from ...flame.quaternions import from_matrices, to_axis_angle
from ...flame.sequence import FlameSequence, with_identity
from ...light.relight import Relighter
from ..playback import Playback
from ..spz import smallest_three

MAGIC = b"STGA"
FORMAT, VERSION = "stga-web", 2
MAX_PLANES = 4
MAX_STEPS = 1 << 31
"""Largest number of steps from zero: what four planes hold."""
GZIP_LEVEL = 7
"""Level 9 takes six times as long and makes the demo's page half a percent smaller."""


@dataclass(frozen=True)
class FixedPoint:
    """Real numbers to be stored as multiples of `step`, with an error of at most half of it."""

    values: np.ndarray
    step: float


def pack(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray | FixedPoint]) -> bytes:
    """A data file: `header` and `arrays`, which are integers, float32 or `FixedPoint`.

    Integers are stored exactly. Equal contents give equal bytes. Raises ValueError where a value is
    not finite, or too many steps from zero.
    """
    packed = {name: _entry(name, array) for name, array in arrays.items()}
    entries = {name: entry for name, (entry, _) in packed.items()}
    complete = {"format": FORMAT, "version": VERSION, **header, "arrays": entries}
    text = json.dumps(complete, ensure_ascii=False, allow_nan=False).encode("utf-8")
    begin = MAGIC + struct.pack("<II", VERSION, len(text))
    raw = b"".join((begin, text, *(block for _, block in packed.values())))
    return gzip.compress(raw, GZIP_LEVEL, mtime=0)


def _entry(name: str, array: np.ndarray | FixedPoint) -> tuple[dict[str, Any], bytes]:
    """Header entry and stored bytes of an array."""
    if isinstance(array, FixedPoint):
        steps = np.rint(np.asarray(array.values, np.float64) / array.step)
        if not (np.abs(steps) < MAX_STEPS).all():
            limit = MAX_STEPS * array.step
            raise ValueError(f"{name} holds a value that is not finite, or beyond {limit:g}")
        integers, entry = steps.astype(np.int64), {"type": "fixed", "step": array.step}
    elif array.dtype.kind in "iub":
        integers, entry = array.astype(np.int64), {"type": "integer"}
    else:
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds a value that is not finite")
        floats = np.ascontiguousarray(array, "<f4")
        return {"type": "float32", "shape": list(array.shape)}, floats.tobytes()
    # Byte planes of what is above the lowest, least significant first. Within a plane the last
    # axis varies slowest, so that equal quantities lie side by side: gzip gains a fifth.
    low = int(integers.min()) if integers.size else 0
    above = np.ascontiguousarray(np.moveaxis(integers - low, -1, 0)).ravel()
    largest = int(above.max()) if above.size else 0
    count = max(1, (largest.bit_length() + 7) // 8)
    if count > MAX_PLANES:
        raise ValueError(f"values from {low} to {low + largest} do not fit {MAX_PLANES} bytes")
    planes = [((above >> 8 * plane) & 255).astype(np.uint8).tobytes() for plane in range(count)]
    entry |= {"shape": list(integers.shape), "planes": count, "low": low}
    return entry, b"".join(planes)


BAKE_TOLERANCE_M = 5e-6
"""Largest distance of a vertex of a baked mesh from the mesh that was baked."""


@dataclass(frozen=True)
class WebRig:
    """Blend shapes, skeleton and motion: V vertices, R blend shapes, J joints, T frames; meters and
    radians.

    base         (V, 3) vertices before blend shapes
    basis        (R, V, 3); the first `expressions` are sliders, which have the
                 `expression_names` or, without any, numbers
    correctives  (9·(J − 1), V, 3), factors: the entries of the rotations of joints 1… minus
                 identity
    joints       (J, 3); they move with the blend shapes by joint_basis (R, J, 3)
    parents      of the joints, -1 for the root
    weights      (V, J) of linear blend skinning
    coefficients (T, R); pose (T, J, 3) axis-angle; translation (T, 3), added last
    """

    base: np.ndarray
    basis: np.ndarray
    correctives: np.ndarray
    joints: np.ndarray
    joint_basis: np.ndarray
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    weights: np.ndarray
    coefficients: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    expressions: int
    expression_names: tuple[str, ...] = ()


def flame_rig(sequence: FlameSequence) -> WebRig:
    """The FLAME model with the person's identity baked in; dynamic offsets become blend shapes."""
    person = with_identity(sequence)
    model = person.model
    frames = [person.frame(timestep) for timestep in person.timesteps]
    expressions = np.moveaxis(model.shapedirs, 2, 0)
    coefficients = np.stack([frame.expr for frame in frames])
    offsets = [frame.dynamic_offset for frame in frames]
    if any(offset is not None for offset in offsets):
        zero = np.zeros_like(model.v_template)
        moved = np.stack([zero if offset is None else offset for offset in offsets])
        shapes, factors = principal_shapes(moved)
        expressions = np.concatenate([expressions, shapes])
        coefficients = np.concatenate([coefficients, factors], axis=1)
    return WebRig(
        base=model.v_template,
        basis=expressions,
        correctives=np.moveaxis(model.posedirs, 2, 0),
        joints=joint_positions(model, model.v_template),
        joint_basis=np.einsum("jv,rvc->rjc", model.j_regressor, expressions),
        joint_names=JOINTS,
        parents=tuple(model.parents.tolist()),
        weights=model.weights,
        coefficients=coefficients,
        pose=np.stack([frame.pose for frame in frames]),
        translation=np.stack([frame.translation for frame in frames]),
        expressions=model.n_expression,
        expression_names=model.expression_names,
    )


def baked_rig(meshes: Sequence[np.ndarray]) -> WebRig:
    """Posed meshes (V, 3) as one rigid motion and the principal components of what is left: a rig
    without sliders.

    Raises ValueError where there is none.
    """
    if not len(meshes):
        raise ValueError("there is no posed mesh")
    stack = np.asarray(meshes, np.float64)
    weights, translations = np.ones(stack.shape[1]), stack.mean(1)
    rotations = np.stack([weighted_procrustes(stack[0], mesh, weights)[0] for mesh in stack])
    aligned = np.einsum("tba,tvb->tva", rotations, stack - translations[:, None])
    base = aligned.mean(0)
    basis, coefficients = principal_shapes(aligned - base)
    vertices = len(base)
    return WebRig(
        base=base,
        basis=basis,
        correctives=np.zeros((0, vertices, 3)),
        joints=np.zeros((1, 3)),
        joint_basis=np.zeros((len(basis), 1, 3)),
        joint_names=("root",),
        parents=(-1,),
        weights=np.ones((vertices, 1)),
        coefficients=coefficients,
        pose=to_axis_angle(from_matrices(rotations))[:, None],
        translation=translations,
        expressions=0,
    )


def principal_shapes(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (R, V, 3) and coefficients (T, R) in −1…1 with products near offsets (T, V, 3)."""
    flat = offsets.reshape(len(offsets), -1)
    _, directions = np.linalg.eigh(flat @ flat.T)
    directions = directions[:, ::-1]  # largest first
    shapes, rest = [], flat.copy()
    for column in directions.T:
        if np.linalg.norm(rest.reshape(-1, 3), axis=1).max() <= BAKE_TOLERANCE_M:
            break
        shapes.append(column @ flat)
        rest -= np.outer(column, shapes[-1])
    coefficients = directions[:, : len(shapes)]
    largest = np.abs(coefficients).max(0) if shapes else np.ones(0)
    basis = np.array(shapes).reshape(-1, *offsets.shape[1:]) * largest[:, None, None]
    return basis, coefficients / largest


Arrays = dict[str, np.ndarray | FixedPoint]

# Steps of fixed-point values: half of one is the largest error. Together they leave a picture of
# large random splats 55 dB PSNR at least (tests/export/web/test_page.py).
POSITION_STEP_M = 4e-6
ROTATION_STEP = 1 / 724
"""The three smaller parts of a unit quaternion lie within ±0.7071: ten bits each."""
LOG_SCALE_STEP = 0.015
OPACITY_STEP = 1 / 255
COLOR_STEP = 0.004
"""Of the constant SH coefficient, which a color has 0.28 times."""
SH_STEP = 0.005
STRAIN_COLOR_STEP = 0.008
STRAIN_RANGE_STEP = 0.002
"""Of the ends of a triangle's range of strain: positions that follow it by 2 mm err by 2 µm."""
OFFSET_STEPS_M = {"strain_position": POSITION_STEP_M / 16}
"""Driven offset that the player has a signal for (`player/face_frames.js`) -> step of its
coefficients.

Strain is at most MAX_STRAIN = 2 from rest in each of three components: half a step of each moves a
splat by 0.75 µm along an axis at most, where half of POSITION_STEP_M is 2 µm."""
TRANSFER_STEP = 2.0**-12
"""Of irradiance over radiance, which is at most π."""
SHARE_STEP = 1 / 255
"""Of ambient occlusion and roughness."""
IRRADIANCE_STEPS = 65535
"""Steps to the largest irradiance of the capture, whose level is any."""
VERTEX_STEP_M = 2.0**-24
"""Of base and neutral mesh: so fine that no thin triangle becomes a line, or the reverse."""
BASIS_STEP_M = 2e-6
WEIGHT_STEP = 1 / 65535

MIN_SLIDER_RANGE, SLIDER_HEADROOM = 1.0, 1.5
"""Sliders reach beyond the motion by this factor, and to ±1 at least."""


def data_file(avatar: Avatar, rig: WebRig, playback: Playback, exact: bool = False) -> bytes:
    """The data file of an avatar that `rig` moves; `exact`: float32 instead of fixed point.

    Raises ValueError where a value is not finite, or a driven offset is not in OFFSET_STEPS_M.
    """
    relighter = None if avatar.light is None else Relighter(avatar)
    surface = avatar.splats.face if relighter is None else relighter.face
    # equal triangles side by side, which gzip likes
    order = np.lexsort((surface, avatar.splats.face))
    splats = avatar.splats.rows(order)
    frames = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention)
    # meters of a unit of the splats' local frames, where it is largest
    unit = float(frames.scale.max(initial=1e-6))
    arrays = _splat_arrays(splats, unit) | {
        "faces": avatar.faces,
        "neutral": FixedPoint(avatar.neutral, VERTEX_STEP_M),
        "splats_per_face": np.bincount(splats.face, minlength=len(avatar.faces)),
        "base": FixedPoint(rig.base, VERTEX_STEP_M),
        "basis": FixedPoint(rig.basis, BASIS_STEP_M),
        "correctives": FixedPoint(rig.correctives, BASIS_STEP_M),
        "weights": FixedPoint(rig.weights, WEIGHT_STEP),
        "joint_rest": rig.joints.astype(np.float32),
        "joint_basis": rig.joint_basis.astype(np.float32),
        "coefficients": rig.coefficients.astype(np.float32),
        "pose": rig.pose.astype(np.float32),
        "translation": rig.translation.astype(np.float32),
    }
    rows = (len(avatar.faces), -1)
    if avatar.follows_strain and avatar.strain_range is not None:
        arrays["strain_range"] = FixedPoint(avatar.strain_range.reshape(rows), STRAIN_RANGE_STEP)
    for name, coefficients in avatar.driven_offsets.items():
        if name not in OFFSET_STEPS_M:
            raise ValueError(f"the web player has no driven offset {name}")
        arrays[name] = FixedPoint(coefficients.reshape(rows), OFFSET_STEPS_M[name] / unit)
    header: dict[str, Any] = {
        "title": playback.title,
        "convention": avatar.convention,
        "antialiased": avatar.antialiased,
        "background": [float(value) for value in avatar.background],
        "fps": playback.fps,
        "up": [float(value) for value in playback.up],
        "joints": list(rig.joint_names),
        "parents": list(rig.parents),
        "sliders": _sliders(rig),
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
    if playback.controls is not None and rig.expressions:
        controls = playback.controls
        arrays["shape_linear"] = controls.linear.astype(np.float32)
        arrays["shape_products"] = controls.products.astype(np.float32)
        header["shapes"] = {"names": list(controls.names)}
        header["shapes"] |= {"opens": controls.opens, "limited": controls.limited}
        if rig.expression_names:  # they are ARKit's shapes, whose sliders these are
            header["sliders"] = []
    if relighter is not None:
        arrays |= _light_arrays(relighter, order, unit)
        header["light"] = {
            "damping": relighter.light.damping,
            "typical": relighter.typical_albedo.tolist(),
            "recorded": relighter.recorded_light.ravel().tolist(),
        }
    if playback.selection is not None:
        arrays["selection"] = np.packbits(np.stack(playback.selection), axis=1)
    if exact:
        for name, array in arrays.items():
            if isinstance(array, FixedPoint):
                arrays[name] = array.values.astype(np.float32)
    return pack(header, arrays)


def _sliders(rig: WebRig) -> list[dict[str, Any]]:
    """Name, component and range of every expression, those that the motion uses most first."""
    names = rig.expression_names or [f"expr_{k:03d}" for k in range(rig.expressions)]
    used = rig.coefficients[:, : rig.expressions]
    reach = np.maximum(SLIDER_HEADROOM * np.abs(used).max(0, initial=0.0), MIN_SLIDER_RANGE)
    order = np.argsort(-used.std(0), kind="stable") if len(used) else np.arange(rig.expressions)
    return [
        {"name": names[k], "component": k, "reach": round(float(reach[k]), 2)}
        for k in order.tolist()
    ]


def _splat_arrays(splats: Splats, local_unit: float) -> Arrays:
    largest, smaller = smallest_three(splats.rotation)
    arrays: Arrays = {
        "xyz": FixedPoint(splats.xyz, POSITION_STEP_M / local_unit),
        "rotation": FixedPoint(smaller, ROTATION_STEP),
        "rotation_largest": largest,
        "log_scale": FixedPoint(splats.log_scale, LOG_SCALE_STEP),
        "opacity": FixedPoint(splats.opacities(), OPACITY_STEP),
        "color": FixedPoint(splats.sh[:, 0], COLOR_STEP),
    }
    if splats.sh.shape[1] > 1:
        arrays["sh"] = FixedPoint(splats.sh[:, 1:].reshape(len(splats), -1), SH_STEP)
    if splats.strain_color.shape[1]:
        strained = splats.strain_color.reshape(len(splats), -1)
        arrays["strain_color"] = FixedPoint(strained, STRAIN_COLOR_STEP)
    return arrays


def _light_arrays(relighter: Relighter, order: np.ndarray, local_unit: float) -> Arrays:
    """How vertices receive light, and did in the capture; triangles of splats; lashes."""
    light, lashes, faces = relighter.light, relighter.lashes, len(relighter.avatar.faces)
    largest, corner_step = float(light.irradiance.max(initial=1e-6)), POSITION_STEP_M / local_unit
    return {
        "light_transfer": FixedPoint(light.transfer, TRANSFER_STEP),
        "light_occlusion": FixedPoint(light.occlusion, SHARE_STEP),
        "light_irradiance": FixedPoint(light.irradiance, largest / IRRADIANCE_STEPS),
        "light_roughness": FixedPoint(light.roughness, SHARE_STEP),
        # of most splats 0: their own
        "light_face": ((relighter.face - relighter.avatar.splats.face) % faces)[order],
        "light_lash_face": lashes.face,
        "light_lash_corners": FixedPoint(lashes.corners.reshape(-1, 12), corner_step),
    }
