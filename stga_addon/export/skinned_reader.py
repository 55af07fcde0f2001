"""Reading of skinned splats, and unpacking them into the files that the add-on opens."""

import math
import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar, AvatarLight, check_avatar, write_avatar
from ..avatar.offsets import OFFSETS
from ..avatar.splats import Splats, logits
from ..capture.glb import UNREADABLE, accessor_values, glb_chunks
from ..errors import StgaError, shorten
from ..files import read_bytes, write_npz
from ..flame.model import JOINTS, POSE_FEATURES, model_of
from ..flame.quaternions import to_axis_angle
from ..flame.sequence import motion_of
from .gltf import Arrays, Json
from .playback import MAX_FPS, MIN_FPS
from .rig import Rig
from .skinned_gltf import AXES, EXTRA, VERSION
from .spz import of_smallest_three

AVATAR_FILE = "avatar.npz"
"""Name of the unpacked avatar."""
MODEL_FILE = "flame_model.npz"
"""Name of the unpacked head model, in FLAME's form."""
MOTION_FILE = "motion.npz"
"""Name of the unpacked motion."""

KNOWN_ARRAYS = (
    *("splats_per_face", "unbound", "xyz", "log_scale", "opacity", "rotation", "rotation_largest"),
    *("color", "sh", "neutral", "joint_basis", "correctives", "strain_range", *OFFSETS),
    *("light_transfer", "light_occlusion", "light_irradiance", "light_roughness"),
)
"""Arrays that are unpacked; a page alone needs the others."""
MIN_NUMBERS = 1 << 24
"""Numbers that any file may unpack to: FLAME's shapes and correctives have two million."""
MAX_NUMBERS_PER_BYTE = 8
"""How many a byte of a larger file; splats reach 4."""
MAX_SKIPPED_BYTES = 1 << 28
"""Bytes of all arrays before they are unpacked, also of those that are not read."""
BLOCK_BYTES = 1 << 20
"""Bytes of an array that is not read which are unpacked at a time."""
MAX_PLANES = 8
"""Bytes of a number at most."""
MAX_MOVED_NUMBERS = 1 << 27
"""Coordinates that shapes without a name move in all frames: half a gigabyte."""
BIND_TOLERANCE = 1e-6
MAX_OPACITY = 1 - 1e-6


@dataclass(frozen=True)
class SkinnedSplats:
    """What a file of skinned splats holds: the avatar, its rig, and poses per second."""

    avatar: Avatar
    rig: Rig
    fps: float


def read_skinned_splats(path: Path) -> SkinnedSplats:
    """Raises StgaError naming the file where it is none."""
    data = read_bytes(path)
    try:
        document, binary = glb_chunks(data)
        header = document.get("extras", {}).get(EXTRA)
        if header is None:
            raise ValueError(f"it has no {EXTRA}; such files come from the format skinned-gltf")
        if header["version"] != VERSION:
            raise ValueError(f"version {header['version']}; known is {VERSION}")
        fps = _number(header, "fps")
        if not MIN_FPS <= fps <= MAX_FPS:
            raise ValueError(f"fps is {fps:g}; expected from {MIN_FPS:g} to {MAX_FPS:g}")
        start = _whole(header["byteOffset"])
        end = start + _whole(header["byteLength"])
        if end > len(binary):
            raise ValueError("it is cut off")
        with np.errstate(all="ignore"):  # `check_avatar` refuses what is not finite
            arrays = _arrays(header["arrays"], binary[start:end])
            rig, faces = _rig(document, binary, arrays, header)
            avatar = _avatar(header, arrays, rig, faces)
    except (*UNREADABLE, struct.error, zlib.error) as error:
        is_otherwise = isinstance(error, AttributeError | TypeError)
        reason = "a value of its JSON has another type" if is_otherwise else error
        raise StgaError(f"{path}: is no file of skinned splats ({reason})") from error
    check_avatar(path, avatar)
    return SkinnedSplats(avatar, rig, fps)


def unpack_skinned_splats(path: Path, folder: Path) -> SkinnedSplats:
    """Write what a file holds into a folder as avatar, FLAME-form model and motion. Raises
    StgaError, before anything is written, where one of them would not be read back, or the rig has
    other joints than FLAME."""
    found = read_skinned_splats(path)
    model = _model(path, found.rig, found.avatar.faces)
    motion = _motion(path, found.rig)
    motion_of(path, motion, model_of(path, model))
    write_avatar(folder / AVATAR_FILE, found.avatar)
    write_npz(folder / MODEL_FILE, model)
    write_npz(folder / MOTION_FILE, motion)
    return found


def _flame_joints(path: Path, rig: Rig) -> list[int]:
    """Number in JOINTS of each joint of the rig. Raises StgaError where FLAME lacks one, or has
    them in another order."""
    if set(rig.joint_names) <= set(JOINTS):
        places = [JOINTS.index(name) for name in rig.joint_names]
        if places == sorted(set(places)) and places[0] == 0:
            return places
    joints = shorten(", ".join(rig.joint_names))
    raise StgaError(f"{path}: has the joints {joints}; expected of {', '.join(JOINTS)}")


def _model(path: Path, rig: Rig, faces: np.ndarray) -> Arrays:
    """Arrays of a FLAME model. A joint that the rig lacks moves nothing; a rig without expressions
    gets one that moves nothing. Raises StgaError as `_flame_joints`."""
    expressions = rig.basis[: rig.expressions]
    joints = _flame_joints(path, rig)
    # the weights of vertices, of least norm, that give a joint's place and how shapes move it
    shaped = np.concatenate([rig.base[None], expressions])
    places = np.concatenate([rig.joint_rest[None], rig.joint_basis[: rig.expressions]])
    system = np.moveaxis(shaped, 2, 1).reshape(-1, len(rig.base))
    regressor = np.linalg.lstsq(
        system, np.moveaxis(places, 2, 1).reshape(len(system), -1), rcond=None
    )[0].T
    parents = np.zeros(len(JOINTS), np.int64)
    parents[joints] = [-1 if parent < 0 else joints[parent] for parent in rig.parents]
    vertices = len(rig.base)
    joint_regressor = np.zeros((len(JOINTS), vertices))
    joint_regressor[joints] = regressor
    weights = np.zeros((vertices, len(JOINTS)))
    weights[:, joints] = rig.weights
    arrays = {
        "v_template": rig.base,
        "shapedirs": np.moveaxis(
            expressions if len(expressions) else np.zeros((1, *rig.base.shape)), 0, 2
        ),
        "n_identity": np.array(0),
        "J_regressor": joint_regressor,
        "kintree_table": np.array([parents, range(len(JOINTS))], np.int64),
        "weights": weights,
        "f": faces,
    }
    correctives = np.zeros((len(JOINTS) - 1, 9, vertices, 3))
    if len(rig.correctives):
        correctives[np.array(joints[1:]) - 1] = rig.correctives.reshape(-1, 9, vertices, 3)
    arrays["posedirs"] = np.moveaxis(correctives.reshape(POSE_FEATURES, vertices, 3), 0, 2)
    if rig.expression_names:
        arrays["expression_names"] = np.array(rig.expression_names)
    return arrays


def _motion(path: Path, rig: Rig) -> Arrays:
    """Arrays of a FLAME motion. Raises StgaError as `_flame_joints`, and where it is too large."""
    frames = len(rig.pose)
    turns = np.zeros((frames, len(JOINTS), 3))
    turns[:, _flame_joints(path, rig)] = rig.pose
    expressions = rig.coefficients[:, : rig.expressions]
    motion = {
        "expr": expressions if rig.expressions else np.zeros((frames, 1)),
        "rotation": turns[:, 0],
        "neck_pose": turns[:, 1],
        "jaw_pose": turns[:, 2],
        "eyes_pose": turns[:, 3:].reshape(frames, 6),
        "translation": rig.translation,
    }
    others = rig.coefficients[:, rig.expressions :]
    if others.size:
        if frames * rig.base.size > MAX_MOVED_NUMBERS:
            problem = f"moves {len(rig.base)} vertices without sliders in {frames} frames"
            raise StgaError(f"{path}: {problem}; expected up to {MAX_MOVED_NUMBERS} coordinates")
        moved = np.empty((frames, *rig.base.shape), np.float32)
        for frame, coefficients in enumerate(others):
            moved[frame] = np.einsum("r,rvc->vc", coefficients, rig.basis[rig.expressions :])
        motion["dynamic_offset"] = moved
    return motion


def _whole(value: object, least: int = 0) -> int:
    """Raises ValueError unless it is a whole number from `least` on."""
    if type(value) is not int or value < least:
        raise ValueError(f"{shorten(value)}; expected a whole number from {least}")
    return value


def _number(values: Json, name: str) -> float:
    """Raises ValueError unless it is a number, as true is not."""
    if type(values[name]) not in (int, float):
        raise ValueError(f"{name} is {shorten(values[name])}; expected a number")
    return float(values[name])


def _arrays(entries: Json, packed: bytes) -> Arrays:
    """Those of KNOWN_ARRAYS by their entries in the header. Raises ValueError where they are not
    whole, or, before they are unpacked, too large."""
    shapes = {name: [_whole(n) for n in entry["shape"]] for name, entry in entries.items()}
    planes = {name: _planes(entry) for name, entry in entries.items()}
    sizes = {name: planes[name] * math.prod(shape) for name, shape in shapes.items()}
    known = {name for name in entries if name.removesuffix(AXES) in KNOWN_ARRAYS}
    numbers = sum(math.prod(shapes[name]) for name in known)
    allowed = MIN_NUMBERS + MAX_NUMBERS_PER_BYTE * len(packed)
    if numbers > allowed or sum(sizes.values()) > MAX_SKIPPED_BYTES:
        raise ValueError("its arrays are larger than any avatar's")
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    rest = packed
    arrays = Arrays()
    for name, entry in entries.items():
        raw = b""
        missing = sizes[name]
        while missing:
            block = stream.decompress(rest, missing if name in known else min(missing, BLOCK_BYTES))
            rest = stream.unconsumed_tail
            if not block:
                raise ValueError("its arrays are not whole")
            missing -= len(block)
            raw += block if name in known else b""
        if name in known:
            arrays[name] = _array(entry, shapes[name], planes[name], raw)
    if stream.decompress(rest, 1):
        raise ValueError("its arrays are not whole")
    for name in [name for name in arrays if name.endswith(AXES)]:
        axes = arrays.pop(name)
        stem = name.removesuffix(AXES)
        if axes.shape != 2 * arrays[stem].shape[-1:]:
            raise ValueError(f"{name} of shape {axes.shape}, not one row a column")
        arrays[stem] = arrays[stem] @ axes.T
    return arrays


def _planes(entry: Json) -> int:
    """Bytes of a number of an array. Raises ValueError."""
    if entry["type"] == "float32":
        return np.dtype(np.float32).itemsize
    planes = _whole(entry["planes"], 1)
    if planes > MAX_PLANES:
        raise ValueError(f"an array of {planes} planes; expected 1 to {MAX_PLANES}")
    return planes


def _array(entry: Json, shape: list[int], planes: int, raw: bytes) -> np.ndarray:
    """An array by its entry and its bytes. Raises ValueError."""
    block = np.frombuffer(raw, np.uint8)
    if entry["type"] == "float32":
        return block.view("<f4").reshape(shape).astype(np.float64)
    integers = np.zeros(math.prod(shape), np.int64)
    for plane, plane_bytes in enumerate(block.reshape(planes, -1)):
        integers |= plane_bytes.astype(np.int64) << 8 * plane
    if (integers < 0).any():
        raise ValueError("an array holds numbers of more than 63 bits")
    integers += _whole(entry["low"], -(2**62))
    values = np.moveaxis(integers.reshape([*shape[-1:], *shape[:-1]]), 0, -1)
    return values * _number(entry, "step") if entry["type"] == "fixed" else values


def _joints(document: Json) -> list[int]:
    """Nodes of the skin's joints. Raises ValueError where they are malformed."""
    joints = [_whole(joint) for joint in document["skins"][0]["joints"]]
    if len(set(joints)) != len(joints) or not 0 < len(joints) <= len(JOINTS):
        raise ValueError(f"{len(joints)} joints; expected 1 to {len(JOINTS)} different nodes")
    if max(joints) >= len(document["nodes"]):
        raise ValueError("a joint that is no node")
    return joints


def _bind(matrices: np.ndarray) -> tuple[float, np.ndarray]:
    """Unit, and places (J, 3) of the joints at rest, of inverse bind matrices (J, 16), column by
    column. Raises ValueError unless each is a translation times the unit."""
    columns = matrices.reshape(-1, 4, 4)
    unit = float(columns[0, 0, 0])
    expected = np.tile(np.diag([unit, unit, unit, 1.0]), (len(columns), 1, 1))
    expected[:, 3, :3] = columns[:, 3, :3]
    if not (np.isfinite(columns).all() and unit > 0):
        raise ValueError("inverse bind matrices that are not finite, or scale by 0 or less")
    if np.abs(columns - expected).max() > BIND_TOLERANCE * max(unit, 1):
        raise ValueError("inverse bind matrices that turn; expected a translation times a unit")
    return unit, -columns[:, 3, :3]


def _mesh(
    document: Json, binary: bytes, joints: int, unit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base (V, 3), shapes (R, V, 3) and skinning weights (V, J). Raises ValueError where they are
    together larger than the file can hold."""
    values = partial(accessor_values, document, binary)
    primitive = document["meshes"][0]["primitives"][0]
    attributes = primitive["attributes"]
    base = unit * values(attributes["POSITION"], width=3)
    count = len(base)
    targets = primitive.get("targets", [])
    if base.size * (1 + len(targets)) > MIN_NUMBERS + MAX_NUMBERS_PER_BYTE * len(binary):
        raise ValueError(f"{len(targets)} shapes of {count} vertices are more than it can hold")
    basis = np.empty((len(targets), count, 3))
    for number, target in enumerate(targets):
        basis[number] = unit * values(target["POSITION"], count, 3)
    weights = np.zeros((count, joints))
    for number in range(sum(name.startswith("JOINTS") for name in attributes)):
        fractions = values(attributes[f"WEIGHTS_{number}"], count, 4)
        indices = values(attributes[f"JOINTS_{number}"], count, 4).astype(int)
        for column in range(4):
            np.add.at(weights, (np.arange(count), indices[:, column]), fractions[:, column])
    for name, array in (("POSITION", base), ("targets", basis), ("WEIGHTS", weights)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds values that are not finite")
    return base, basis, weights


def _animated(
    document: Json, binary: bytes, joints: list[int], shapes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (T, J, 4) xyzw, translation (T, 3) of the root and weights (T, R) of the motion."""
    motion = document["animations"][0]
    outputs = dict[tuple[str, int], int]()
    for channel in motion["channels"]:
        target = channel["target"]
        sampler = motion["samplers"][_whole(channel["sampler"])]
        node = -1 if target["path"] == "weights" else target["node"]
        outputs[target["path"], node] = sampler["output"]
    values = partial(accessor_values, document, binary)
    for joint in joints:
        if ("rotation", joint) not in outputs:
            raise ValueError(f"its motion does not turn joint {joint}")
    frames = len(values(outputs["rotation", joints[0]]))
    if frames > len(binary):
        raise ValueError(f"its motion of {frames} frames is longer than the file can hold")
    turns = np.stack([values(outputs["rotation", joint], frames, 4) for joint in joints], axis=1)
    if ("translation", joints[0]) not in outputs:
        raise ValueError("its motion does not move the root")
    coefficients = np.zeros((frames, 0))
    if ("weights", -1) in outputs:
        rows = frames * shapes
        coefficients = values(outputs["weights", -1], rows, 1).reshape(frames, shapes)
    return turns, values(outputs["translation", joints[0]], frames, 3), coefficients


def _rig(document: Json, binary: bytes, arrays: Arrays, header: Json) -> tuple[Rig, np.ndarray]:
    """The rig, and the mesh's triangles (F, 3). Raises one of UNREADABLE."""
    values = partial(accessor_values, document, binary)
    joints = _joints(document)
    bind = document["skins"][0]["inverseBindMatrices"]
    unit, rest = _bind(values(bind, len(joints), 16))
    base, basis, weights = _mesh(document, binary, len(joints), unit)
    turns, translation, coefficients = _animated(document, binary, joints, len(basis))
    nodes = document["nodes"]
    parents = [
        [p for p, j in enumerate(joints) if joint in nodes[j].get("children", [])]
        for joint in joints
    ]
    mesh = document["meshes"][0]
    names = mesh.get("extras", {}).get("targetNames", [])
    expressions = _whole(header["expressions"])
    named = expressions if header["named"] else 0
    correctives = arrays.get("correctives", np.zeros((0, *base.shape)))
    moved = arrays["joint_basis"]
    if expressions > len(basis) or moved.shape != (len(basis), len(joints), 3):
        raise ValueError(f"{expressions} expressions, joint_basis {moved.shape}: of other shapes")
    if len(correctives) and correctives.shape != (9 * (len(joints) - 1), *base.shape):
        raise ValueError(f"correctives {correctives.shape}, not those of its mesh and joints")
    rig = Rig(
        base=base,
        basis=basis,
        correctives=correctives,
        joint_rest=rest,
        joint_basis=moved,
        joint_names=tuple(str(nodes[joint]["name"]) for joint in joints),
        parents=tuple(parent[0] if parent else -1 for parent in parents),
        weights=weights,
        coefficients=coefficients,
        pose=to_axis_angle(turns[..., [3, 0, 1, 2]]),
        translation=translation - rest[0],
        expressions=expressions,
        expression_names=tuple(str(name) for name in names[:named]),
    )
    return rig, values(mesh["primitives"][0]["indices"], width=1).reshape(-1, 3).astype(np.int32)


def _avatar(header: Json, arrays: Arrays, rig: Rig, faces: np.ndarray) -> Avatar:
    per_face = arrays["splats_per_face"]
    count = len(arrays["xyz"])
    if len(per_face) != len(faces) or per_face.min() < 0 or per_face.sum() != count:
        raise ValueError(f"splats_per_face does not count its {count} splats")
    if not isinstance(header["antialiased"], bool):
        raise ValueError(f"antialiased is {shorten(header['antialiased'])}; expected true or false")
    rotation = of_smallest_three(arrays["rotation_largest"], arrays["rotation"])
    opacity = np.clip(arrays["opacity"], 1 - MAX_OPACITY, MAX_OPACITY)
    rest = arrays.get("sh", np.zeros((len(rotation), 0))).reshape(len(rotation), -1, 3)
    sh = np.concatenate([arrays["color"][:, None], rest], axis=1)
    splats = Splats(
        xyz=arrays["xyz"].astype(np.float32),
        rotation=rotation.astype(np.float32),
        log_scale=arrays["log_scale"].astype(np.float32),
        opacity=logits(opacity),
        sh=sh.astype(np.float32),
        face=np.repeat(np.arange(len(per_face), dtype=np.int32), per_face),
        unbound=arrays["unbound"].astype(bool),
    )
    offsets = {name: arrays[name] for name in OFFSETS if name in arrays}
    strain_range = arrays.get("strain_range")
    if strain_range is not None:
        strain_range = strain_range.reshape(-1, 2, 6).astype(np.float32)
    return Avatar(
        splats,
        header["convention"],
        np.asarray(arrays.get("neutral", rig.base), np.float32),
        faces,
        background=tuple(header["background"]),
        antialiased=header["antialiased"],
        strain_range=strain_range,
        driven_offsets={
            name: each.reshape(-1, 3, 3).astype(np.float32) for name, each in offsets.items()
        },
        light=_light(header, arrays),
    )


def _light(header: Json, arrays: Arrays) -> AvatarLight | None:
    if "light" not in header:
        return None
    light = header["light"]
    return AvatarLight(
        radiance=np.reshape(light["radiance"], (9, 3)).astype(np.float32),
        transfer=arrays["light_transfer"].astype(np.float32),
        occlusion=arrays["light_occlusion"].astype(np.float32),
        irradiance=arrays["light_irradiance"].astype(np.float32),
        roughness=arrays["light_roughness"].astype(np.float32),
        residual=_number(light, "residual"),
        damping=_number(light, "damping"),
        source=str(light["source"]),
    )
