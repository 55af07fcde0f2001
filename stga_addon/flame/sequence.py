"""Tracked FLAME sequences: files, meshes; retargeting to another person, speed or strength."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from ..errors import StgaError
from ..files import converted, open_npz, read_npz
from .forward import (
    RIGID_SIZE,
    FlameFrame,
    axis_angle_matrices,
    change_between,
    changed_by,
    flame_forward,
    frame_of,
    joint_positions,
    neutral_frame,
    parameters_at,
    shaped_vertices,
)
from .model import JOINTS, MIN_TORSO_WEIGHT, Arrays, FlameModel
from .parts import ADDED_VERTICES
from .quaternions import from_matrices, to_axis_angle, unit

Identity = tuple[np.ndarray, np.ndarray | None]
"""Shape and static offset."""
ZERO_POSES = {
    "head": "head rotation, translation and neck; jaw and eyes count as expression",
    "all": "head motion, jaw and eyes",
}
"""Choice of the motion that does not count as expression -> what it is (`expression_mesh`)."""
FRAME_FIELDS = ("expr", "rotation", "neck_pose", "jaw_pose", "translation", "eyes_pose")
"""Fields that change with the timestep, as VHAP names them."""
FIELD_ALIASES = {
    "exp": "expr",
    "expression": "expr",
    "global_orient": "rotation",
    "transl": "translation",
    "jaw": "jaw_pose",
    "neck": "neck_pose",
    "eyes": "eyes_pose",
    "eye_pose": "eyes_pose",
    "betas": "shape",
    "R": "rotation",
    "t": "translation",
    "pose_params": "rotation",
    "expression_params": "expr",
    "jaw_params": "jaw_pose",
    "shape_params": "shape",
    "expressions": "expr",
    "expcode": "expr",
    "posecode": "pose",
    "shapecode": "shape",
}
"""Field as other programs name it -> as it is read."""
JOINT_COUNTS = {"rotation": 1, "neck_pose": 1, "jaw_pose": 1, "eyes_pose": 2}
"""Fields that are rotations -> how many of them."""
ROWS_OF_SIX = 6
"""Numbers of a rotation that is given as two rows of its matrix."""
MATRIX_SIZE = 9
"""Numbers of a rotation that is given as a matrix."""
MATRIX_TOLERANCE = 1e-3
"""Largest difference between R·Rᵀ and the identity, for exports with a few decimals."""
UNREAD_PARTS = ("eyelids", "eyelid_params")
"""Parameters of models that extend FLAME, which are not read."""
POSE_LAYOUTS = {6: ("rotation", "jaw_pose"), 15: ("rotation", "neck_pose", "jaw_pose", "eyes_pose")}
"""Numbers of a `pose` that holds several joints -> the fields they are, three columns a joint."""

BODY_POSE_SIZE = 165
"""Numbers of SMPL-X's pose, as BEAT2 has it in `poses`."""
BODY_POSE_PARTS = {"neck_pose": (45, 48), "jaw_pose": (66, 69), "eyes_pose": (69, 75)}
"""Field -> its columns there; the neck is moved as SMPL-X's head."""
MIN_JOINT_ANGLE_DEG = 0.5
"""Least angle of a joint that moves."""

MAX_OFFSET_BYTES = 256 << 20
"""Offsets of a motion, above which they are left out where they are zero."""
MAX_ZERO_BYTES = 16 << 30
"""Most that is looked through for that, in a minute."""
TORSO_SHIFT = "torso_shift"
SHIFT_SIZE = 3
MAX_PARAMETER = 1e6  # Largest coefficient, angle or position; beyond it, vertices would overflow
MAX_TIMESTEP = 1 << 20  # Blender's last frame


@dataclass(frozen=True)
class FlameSequence:
    """One person's motion.

    model          including teeth where they are used
    shape          (I,) identity coefficients
    static_offset  (V, 3) meters or None
    timesteps      ascending
    frame          timestep -> its parameters, read on demand
    warnings       one sentence each: what of a file was guessed or not read
    """

    model: FlameModel
    shape: np.ndarray
    static_offset: np.ndarray | None
    timesteps: tuple[int, ...]
    frame: Callable[[int], FlameFrame]
    warnings: tuple[str, ...] = ()

    def frames(self) -> list[FlameFrame]:
        """The parameters of all timesteps."""
        return [self.frame(timestep) for timestep in self.timesteps]

    def mesh(self, frame: FlameFrame) -> np.ndarray:
        """The person's mesh (V, 3) in meters with a frame's parameters."""
        return flame_forward(self.model, self.shape, frame, self.static_offset)


def sequence_mesh(sequence: FlameSequence, timestep: int) -> np.ndarray:
    """The tracked mesh of a timestep in world space: (V, 3) meters."""
    return sequence.mesh(sequence.frame(timestep))


def expression_mesh(sequence: FlameSequence, timestep: int, zero_pose: str) -> np.ndarray:
    """The mesh (V, 3) with the head's motion removed (STGA, selective training). zero_pose "head"
    zeroes rotation, translation and neck, so that jaw and eyes count as expression; "all" zeroes
    jaw and eyes too. Raises StgaError for any other value."""
    if zero_pose not in ZERO_POSES:
        raise StgaError(f"zero_pose is {zero_pose!r}, expected one of {', '.join(ZERO_POSES)}")
    zero = np.zeros(3)
    frame = replace(sequence.frame(timestep), rotation=zero, translation=zero, neck_pose=zero)
    if zero_pose == "all":
        frame = replace(frame, jaw_pose=zero, eyes_pose=np.zeros(6))
    return sequence.mesh(frame)


def neutral_mesh(sequence: FlameSequence) -> np.ndarray:
    """The canonical mesh (V, 3): the person's shape and static offset, everything else zero."""
    return sequence.mesh(neutral_frame(sequence.model))


def below_neck(sequence: FlameSequence, timestep: int, points: np.ndarray) -> np.ndarray:
    """(N,) bool: world points (N, 3) that lie lower than the root joint, at the base of the neck,
    seen by the torso. The joint is that of the model without offsets, which may draw the torso over
    clothes, and the joint with it."""
    model = sequence.model
    frame = sequence.frame(timestep)
    shaped = shaped_vertices(model, sequence.shape, frame.expr)
    root = joint_positions(model, shaped)[JOINTS.index("root")] + frame.translation
    up = axis_angle_matrices(frame.rotation[None])[0][:, 1]
    return (points - root) @ up < 0


def with_identity(sequence: FlameSequence) -> FlameSequence:
    """The motion with the identity in the template: a mesh needs a quarter of the blend shapes."""
    model = sequence.model
    shapes = model.shapedirs[:, :, model.n_identity :]
    none = np.zeros(shapes.shape[2])
    offset = sequence.static_offset
    template = shaped_vertices(model, sequence.shape, none, offset)
    shapes = np.ascontiguousarray(shapes)
    person = replace(model, v_template=template, shapedirs=shapes, n_identity=0)
    return replace(sequence, model=person, shape=np.zeros(0), static_offset=None)


def joint_angles(frames: Sequence[FlameFrame]) -> np.ndarray:
    """Largest angle (5,) in degrees by which the frames turn each of `JOINTS`."""
    angles = np.linalg.norm([frame.pose for frame in frames], axis=2)
    return np.degrees(angles.max(axis=0))


def read_frame(path: Path, model: FlameModel, arrays: Arrays | None = None) -> FlameFrame:
    """Read one timestep's `flame_param/*.npz` (VHAP and GaussianAvatars captures), with or without
    a leading 1. Neck, jaw, eyes and dynamic offset may be missing (zero); fewer expression
    coefficients than the model has, and offsets without the parts' vertices, are filled up with
    zeros. Raises StgaError naming the file and the field.

    arrays: of the file, where they were read already.
    """
    arrays = read_npz(path) if arrays is None else arrays
    for name in ("expr", "rotation", "translation"):
        if name not in arrays:
            raise StgaError(f"{path}: has no {name}, which a FLAME frame needs")
    return _frame(path, arrays, model)


def read_identity(path: Path, model: FlameModel, arrays: Arrays | None = None) -> Identity:
    """Shape (I,) and static offset (V, 3) or None of a file. Arguments and errors as in
    `read_frame`."""
    return _identity(path, read_npz(path) if arrays is None else arrays, model)


def torso_shapes(model: FlameModel) -> np.ndarray:
    """(V, 3, 3) vertex offsets by which the torso is shifted along x, y and z, in its axes."""
    fraction = np.minimum(model.weights[:, JOINTS.index("root")] / MIN_TORSO_WEIGHT, 1)
    return fraction[:, None, None] * np.eye(SHIFT_SIZE)


def torso_offset(
    shapes: np.ndarray, shift: np.ndarray, offset: np.ndarray | None
) -> np.ndarray | None:
    """(V, 3) a timestep's vertex offsets, None being none, with the torso shifted."""
    return shapes @ shift + (0 if offset is None else offset) if shift.any() else offset


def read_motion(path: Path, model: FlameModel) -> FlameSequence:
    """Read a whole motion from one file: arrays with a leading time axis, of which any but one may
    be missing (zero).

    VHAP's `tracked_flame_params_*.npz` and `flame_param/*.npz`, the `flame_param.npz` of a
    GaussianAvatars avatar, and plain files of expression and pose, whose fields may have the names
    in `FIELD_ALIASES` too. Rotations are axis-angle, two rows of a matrix, or the matrix. `pose`
    holds the joints of `POSE_LAYOUTS`, TORSO_SHIFT a shift of the torso (`torso_shapes`).
    Timesteps count from 0, unless `timesteps` (T,) names them. Raises StgaError naming the file
    and the field.
    """
    with open_npz(path) as file:
        names = set(file.entries)
        offsets = file.outlines().get("dynamic_offset")
        expected = 0
        if offsets is not None and offsets.ndim == 3 and offsets.shape[2] == 3:
            fits = _rows_fit(offsets.shape[1], len(model.v_template))
            expected = offsets.nbytes if fits else 0
        if MAX_OFFSET_BYTES < expected < MAX_ZERO_BYTES and file.is_zero("dynamic_offset"):
            names.remove("dynamic_offset")
            expected = 0
        arrays = file.arrays(names, expected=expected)
    return motion_of(path, arrays, model)


def motion_of(path: Path, arrays: Arrays, model: FlameModel) -> FlameSequence:
    """The motion in the arrays of a file, as `read_motion` reads it; errors name `path`."""
    spelled = {
        FIELD_ALIASES[name]: values for name, values in arrays.items() if name in FIELD_ALIASES
    }
    warnings = _guesses(path, arrays)
    arrays = spelled | dict(arrays)
    body = arrays.get("poses")
    if body is not None and body.ndim == 2 and body.shape[1] == BODY_POSE_SIZE:
        parts = {name: body[:, start:end] for name, (start, end) in BODY_POSE_PARTS.items()}
        arrays = parts | arrays
        about = "poses are those of a body (SMPL-X): its head, jaw and eyes move this head"
        warnings = (*warnings, f"{path}: {about}")
    pose = arrays.pop("pose", None)
    if pose is not None:
        if pose.ndim < 2 or not len(pose) or pose[0].size not in POSE_LAYOUTS:
            sizes = " or ".join(f"(timesteps, {size})" for size in POSE_LAYOUTS)
            raise StgaError(f"{path}: pose has shape {pose.shape}, expected {sizes}")
        fields = POSE_LAYOUTS[pose[0].size]
        columns = pose.reshape(len(pose), -1)
        turns = np.split(columns, range(3, 3 * len(fields), 3), axis=1)
        arrays = dict(zip(fields, turns, strict=True)) | arrays
    moving = {name: arrays[name] for name in (*FRAME_FIELDS, "dynamic_offset") if name in arrays}
    if not moving:
        none = f"has none of {', '.join(FRAME_FIELDS)}"
        raise StgaError(f"{path}: {none}, which a FLAME motion is made of")
    count = next((len(array) for array in moving.values() if array.ndim), 0)
    if count > MAX_TIMESTEP:
        raise StgaError(f"{path}: has {count} timesteps, expected up to {MAX_TIMESTEP}")
    for name, array in moving.items():
        if array.ndim < 2 or len(array) != count or not count:
            other = array.ndim > 1 and count
            expected = f"{count} timesteps first" if other else "(timesteps, coefficients)"
            raise StgaError(f"{path}: {name} has shape {array.shape}, expected {expected}")
    if "shape" in arrays and arrays["shape"].ndim == 2:
        arrays["shape"] = arrays["shape"][0]  # one per timestep, all of the same person
    shape, static_offset = _identity(path, {"shape": np.zeros(0), **arrays}, model)
    found = arrays.get("timesteps", np.arange(count))
    named = found.dtype.kind in "iu" and found.shape == (count,)
    if not named or found[0] < 0 or (found[1:] <= found[:-1]).any() or found[-1] > MAX_TIMESTEP:
        limits = f"from 0 to {MAX_TIMESTEP}, each more than the one before"
        raise StgaError(f"{path}: timesteps: expected {count} whole numbers {limits}")
    timesteps = tuple(found.tolist())
    row = {timestep: number for number, timestep in enumerate(timesteps)}
    shift = arrays.get(TORSO_SHIFT, np.zeros((count, SHIFT_SIZE)))
    torso = torso_shapes(model)
    if shift.shape != (count, SHIFT_SIZE) or not (np.abs(shift) < MAX_PARAMETER).all():
        raise StgaError(f"{path}: {TORSO_SHIFT}: expected finite numbers ({count}, {SHIFT_SIZE})")

    def frame(timestep: int) -> FlameFrame:
        at = row[timestep]
        found = _frame(path, {name: array[at] for name, array in moving.items()}, model)
        offset = torso_offset(torso, shift[at], found.dynamic_offset)
        return replace(found, dynamic_offset=offset)

    for timestep in timesteps:
        frame(timestep)  # report a wrong value when the file is opened, not minutes later
    return FlameSequence(model, shape, static_offset, timesteps, frame, warnings)


def _guesses(path: Path, arrays: Arrays) -> tuple[str, ...]:
    """Sentences about fields of a motion that other programs may mean otherwise, or lack here."""
    sizes = {name: array[0].size for name, array in arrays.items() if array.ndim > 1 and len(array)}
    joints = {name: JOINT_COUNTS.get(FIELD_ALIASES.get(name, name), 0) for name in sizes}
    six = [name for name, count in joints.items() if count and sizes[name] == count * ROWS_OF_SIX]
    sentences = []
    if six:
        rows = "rotations of six numbers are read as the first two rows of a matrix"
        sentences.append(f"{path}: {', '.join(six)}: {rows}")
    if "R" in sizes and "rotation" not in arrays:
        meaning = "the head's rotation and translation (R x + t)"
        sentences.append(f"{path}: R and t are read as {meaning}, not as a camera's")
    unread = [name for name in UNREAD_PARTS if name in arrays and np.any(arrays[name])]
    sentences += [f"{path}: {name} is not read: FLAME has no such shapes" for name in unread]
    return tuple(sentences)


def motion_arrays(sequence: FlameSequence, dtype: DTypeLike = np.float64) -> dict[str, np.ndarray]:
    """The motion as arrays that `motion_of` takes, and as flame_param.npz of a GaussianAvatars
    avatar holds in float32. shape (I,), expr (T, E), rotation, neck_pose, jaw_pose and translation
    (T, 3), eyes_pose (T, 6), static_offset (V, 3), dynamic_offset (T, V, 3), zero where the
    sequence has none; 300 and 100 for I and E with a published FLAME."""
    frames = sequence.frames()
    none = np.zeros_like(sequence.model.v_template)
    static = sequence.static_offset
    offsets = [none if frame.dynamic_offset is None else frame.dynamic_offset for frame in frames]
    moving = {name: [getattr(frame, name) for frame in frames] for name in FRAME_FIELDS}
    return {
        **{name: np.stack(rows, dtype=dtype) for name, rows in moving.items()},
        "shape": sequence.shape.astype(dtype),
        "static_offset": (none if static is None else static).astype(dtype),
        "dynamic_offset": np.stack(offsets, dtype=dtype),
    }


def _frame(path: Path, arrays: Arrays, model: FlameModel) -> FlameFrame:
    sizes = dict.fromkeys(FRAME_FIELDS, 3) | {"expr": model.n_expression, "eyes_pose": 6}
    turns = {name: arrays[name] for name in JOINT_COUNTS if name in arrays}
    plain = dict(arrays) | {name: _axis_angles(path, name, turn) for name, turn in turns.items()}
    values = {name: _vector(path, plain, name, size) for name, size in sizes.items()}
    offset = _offset(path, arrays, "dynamic_offset", len(model.v_template))
    return FlameFrame(**values, dynamic_offset=offset)


def _identity(path: Path, arrays: Arrays, model: FlameModel) -> Identity:
    if "shape" not in arrays:
        raise StgaError(f"{path}: has no shape, the person's identity coefficients")
    shape = _vector(path, arrays, "shape", model.n_identity)
    return shape, _offset(path, arrays, "static_offset", len(model.v_template))


def _finite(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "iuf":
        raise StgaError(f"{path}: {name} holds {array.dtype}, expected numbers")
    array = converted(array, np.float64)
    if not (np.abs(array) <= MAX_PARAMETER).all():
        beyond = f"that are not finite, or beyond {MAX_PARAMETER:g}"
        raise StgaError(f"{path}: {name} holds values {beyond}")
    return array


def _axis_angles(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    """A timestep's rotations (3n,) as axis-angle, of n joints, from two rows of each one's matrix,
    (6n,) as PyTorch3D has them, or from matrices (n, 3, 3); others as they are, also with a leading
    1. Raises StgaError for what is no rotation."""
    joints = JOINT_COUNTS[name]
    if array.size not in (joints * ROWS_OF_SIX, joints * MATRIX_SIZE):
        return array
    rows = _finite(path, name, array).reshape(joints, -1, 3)
    if rows.shape[1] == 2:
        x = unit(rows[:, 0])
        y = unit(rows[:, 1] - (x * rows[:, 1]).sum(axis=1, keepdims=True) * x)
        rows = np.stack([x, y, np.cross(x, y)], axis=1)
    off = np.abs(rows @ rows.swapaxes(1, 2) - np.eye(3)).max()
    if not off < MATRIX_TOLERANCE or (np.linalg.det(rows) < 0).any():
        raise StgaError(f"{path}: {name} has shape {array.shape}, but holds no rotations")
    return to_axis_angle(from_matrices(rows)).reshape(-1)


def _vector(path: Path, arrays: Arrays, name: str, size: int) -> np.ndarray:
    """(size,) float64 from (size,) or (1, size); absent fields are zero, short ones padded."""
    vector = np.zeros(size)
    if name not in arrays:
        return vector
    array = arrays[name]
    given = array[0] if array.ndim == 2 and len(array) == 1 else array
    fits = given.size == size or (name in ("expr", "shape") and given.size < size)
    if given.ndim != 1 or not fits:
        expected = f"expected ({size},) or (1, {size})"
        raise StgaError(f"{path}: {name} has shape {array.shape}, {expected}")
    vector[: given.size] = _finite(path, name, given)
    return vector


def _rows_fit(rows: int, vertices: int) -> bool:
    """Whether offsets have a row for each vertex, with or without those of the parts."""
    return rows - vertices in [
        mine - theirs for mine in ADDED_VERTICES for theirs in ADDED_VERTICES
    ]


def _offset(path: Path, arrays: Arrays, name: str, vertices: int) -> np.ndarray | None:
    """(V, 3) float64, None where absent or all zero; the parts' rows are added or dropped."""
    if name not in arrays:
        return None
    array = arrays[name]
    rows = array.shape[-2] if array.ndim >= 2 else 0
    if array.ndim not in (2, 3) or not _rows_fit(rows, vertices) or array.size != rows * 3:
        expected = f"({vertices}, 3) or (1, {vertices}, 3)"
        raise StgaError(f"{path}: {name} has shape {array.shape}, expected {expected}")
    offset = np.zeros((vertices, 3))
    kept = min(rows, vertices)
    offset[:kept] = _finite(path, name, array).reshape(rows, 3)[:kept]
    return offset if offset.any() else None


# Part of a motion that can be transferred -> fields of a frame.
PARTS = {
    "expression": ("expr",),
    "jaw": ("jaw_pose",),
    "eyes": ("eyes_pose",),
    "neck": ("neck_pose",),
    "head": ("rotation", "translation"),
}
TIME_TOLERANCE = 1e-6  # Tolerance in timesteps: rounding must not drop the last frame


def retimed(sequence: FlameSequence, step: float = 1.0) -> list[FlameFrame]:
    """The frames at the first timestep and every `step` timesteps after it, up to the last.
    Coefficients and translation are interpolated linearly, rotations on the shortest arc (slerp).
    Dynamic offsets, which belong to the tracked person, are left out."""
    times = np.asarray(sequence.timesteps, np.float64)
    wanted = np.arange(times[0], times[-1] + TIME_TOLERANCE, step)
    tracked = np.stack([sequence.frame(timestep).parameters for timestep in sequence.timesteps])
    return [frame_of(values) for values in parameters_at(wanted, times, tracked)]


def strengthened(frames: Sequence[FlameFrame], strength: float) -> list[FlameFrame]:
    """The frames with their motion scaled by `strength`: expression, jaw, eyes and neck about the
    neutral face. Rotation and translation of the head are scaled about the first frame's."""
    first = frames[0]
    values = np.stack([frame.parameters for frame in frames])
    start = np.zeros_like(first.parameters)
    start[[*range(-RIGID_SIZE, 3 - RIGID_SIZE), -3, -2, -1]] = *first.rotation, *first.translation
    scaled = changed_by(start, strength * change_between(start, values))
    rows = zip(scaled, frames, strict=True)
    return [frame_of(parameters, frame.dynamic_offset) for parameters, frame in rows]


def transferred_motion(motion: FlameSequence, neutral: np.ndarray) -> FlameSequence:
    """The motion on the person whose neutral mesh is `neutral` (V, 3), of the same model. FLAME
    adds shape and static offset to the template before posing, so the difference between neutral
    mesh and template replaces both. Dynamic offsets, which belong to the tracked person, are left
    out."""
    return replace(
        motion,
        shape=np.zeros_like(motion.shape),
        static_offset=neutral - motion.model.v_template,
        frame=lambda timestep: replace(motion.frame(timestep), dynamic_offset=None),
    )
