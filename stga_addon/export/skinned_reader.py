"""Reading of skinned splats, and unpacking them into the files that the add-on opens."""

import struct
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.file import Avatar, AvatarLight, write_avatar
from ..avatar.offsets import OFFSETS
from ..avatar.splats import Splats, logits
from ..capture.glb import UNREADABLE, accessor_values, glb_chunks
from ..errors import StgaError
from ..files import read_bytes, write_npz
from ..flame.model import JOINTS
from ..flame.quaternions import to_axis_angle
from .rig import Rig
from .skinned_gltf import AXES, EXTRA, VERSION
from .spz import of_smallest_three

AVATAR_FILE = "avatar.npz"
MODEL_FILE = "flame_model.npz"
MOTION_FILE = "motion.npz"
MAX_VALUES = 1 << 28
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
        place = header["byteOffset"], header["byteOffset"] + header["byteLength"]
        if place[1] > len(binary):
            raise ValueError("it is cut off")
        arrays = _arrays(header["arrays"], binary[slice(*place)])
        rig, faces = _rig(document, binary, arrays, header)
        return SkinnedSplats(_avatar(header, arrays, rig, faces), rig, float(header["fps"]))
    except (*UNREADABLE, struct.error, zlib.error) as error:
        raise StgaError(f"{path}: is no file of skinned splats ({error})") from error


def unpack_skinned_splats(path: Path, folder: Path) -> SkinnedSplats:
    """Write what a file holds into a folder as avatar, FLAME-form model and motion. Raises
    StgaError where the rig has other joints than FLAME."""
    found = read_skinned_splats(path)
    rig = found.rig
    if rig.joint_names != JOINTS[: len(rig.joint_names)]:
        joints = ", ".join(rig.joint_names)
        raise StgaError(f"{path}: has the joints {joints}; expected {', '.join(JOINTS)}")
    folder.mkdir(parents=True, exist_ok=True)
    write_avatar(folder / AVATAR_FILE, found.avatar)
    write_npz(folder / MODEL_FILE, _model(rig, found.avatar.faces))
    write_npz(folder / MOTION_FILE, _motion(rig))
    return found


def _model(rig: Rig, faces: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of a FLAME model; of each joint that the rig lacks, one that moves nothing."""
    own = rig.basis[: rig.expressions]
    missing = len(JOINTS) - len(rig.parents)
    # the weights of vertices, of least norm, that give a joint's place and how shapes move it
    shaped = np.concatenate([rig.base[None], own])
    places = np.concatenate([rig.joint_rest[None], rig.joint_basis[: rig.expressions]])
    system = np.moveaxis(shaped, 2, 1).reshape(-1, len(rig.base))
    regressor = np.linalg.lstsq(
        system, np.moveaxis(places, 2, 1).reshape(len(system), -1), rcond=None
    )[0].T
    parents = [*rig.parents, *range(len(rig.parents) - 1, len(JOINTS) - 1)]
    arrays = {
        "v_template": rig.base,
        "shapedirs": np.moveaxis(own, 0, 2),
        "n_identity": np.array(0),
        "J_regressor": np.pad(regressor, ((0, missing), (0, 0))),
        "kintree_table": np.array([parents, range(len(JOINTS))], np.int64),
        "weights": np.pad(rig.weights, ((0, 0), (0, missing))),
        "f": faces,
    }
    if len(rig.correctives):
        arrays["posedirs"] = np.moveaxis(rig.correctives, 0, 2)
    if rig.expression_names:
        arrays["expression_names"] = np.array(rig.expression_names)
    return arrays


def _motion(rig: Rig) -> dict[str, np.ndarray]:
    frames = len(rig.pose)
    turns = np.zeros((frames, len(JOINTS), 3))
    turns[:, : len(rig.parents)] = rig.pose
    motion = {
        "expr": rig.coefficients[:, : rig.expressions],
        "rotation": turns[:, 0],
        "neck_pose": turns[:, 1],
        "jaw_pose": turns[:, 2],
        "eyes_pose": turns[:, 3:].reshape(frames, 6),
        "translation": rig.translation,
    }
    others = rig.coefficients[:, rig.expressions :]
    if others.size:
        moved = np.einsum("tr,rvc->tvc", others, rig.basis[rig.expressions :])
        motion["dynamic_offset"] = moved
    return motion


def _arrays(entries: dict[str, Any], packed: bytes) -> dict[str, np.ndarray]:
    """Arrays by their entries in the header; raises ValueError where they are not whole."""
    counts = {name: int(np.prod(entry["shape"])) for name, entry in entries.items()}
    planes = {n: 4 if e["type"] == "float32" else int(e["planes"]) for n, e in entries.items()}
    sizes = {name: planes[name] * count for name, count in counts.items()}
    if min(sizes.values(), default=0) < 0 or sum(sizes.values()) > MAX_VALUES:
        raise ValueError("its arrays are larger than any avatar's")
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    raw = stream.decompress(packed, sum(sizes.values()) + 1)
    if len(raw) != sum(sizes.values()):
        raise ValueError("its arrays are not whole")
    arrays = dict[str, np.ndarray]()
    at = 0
    for name, entry in entries.items():
        block = np.frombuffer(raw, np.uint8, sizes[name], at)
        at += sizes[name]
        shape = [int(size) for size in entry["shape"]]
        if entry["type"] == "float32":
            arrays[name] = block.view("<f4").reshape(shape).astype(np.float64)
            continue
        factors = 256 ** np.arange(planes[name], dtype=np.int64)
        integers = factors @ block.reshape(planes[name], -1).astype(np.int64) + int(entry["low"])
        values = np.moveaxis(integers.reshape([*shape[-1:], *shape[:-1]]), 0, -1)
        arrays[name] = values * float(entry["step"]) if entry["type"] == "fixed" else values
    for name in [name for name in arrays if name.endswith(AXES)]:
        axes = arrays.pop(name)
        arrays[name.removesuffix(AXES)] = arrays[name.removesuffix(AXES)] @ axes.T
    return arrays


def _rig(
    document: dict[str, Any], binary: bytes, arrays: dict[str, np.ndarray], header: dict[str, Any]
) -> tuple[Rig, np.ndarray]:
    """The rig, and the mesh's triangles (F, 3)."""
    values = partial(accessor_values, document, binary)
    skin = document["skins"][0]
    joints = skin["joints"]
    bind = values(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
    unit = bind[0, 0, 0]
    mesh = document["meshes"][0]
    primitive = mesh["primitives"][0]
    attributes = primitive["attributes"]
    base = unit * values(attributes["POSITION"])
    targets = [unit * values(each["POSITION"]) for each in primitive.get("targets", [])]
    weights = np.zeros((len(base), len(joints)))
    for number in range(sum(name.startswith("JOINTS") for name in attributes)):
        shares = values(attributes[f"WEIGHTS_{number}"])
        own = values(attributes[f"JOINTS_{number}"]).astype(int)
        for column in range(4):
            np.add.at(weights, (np.arange(len(base)), own[:, column]), shares[:, column])
    rest = -bind[:, 3, :3]
    outputs = dict[tuple[str, int], np.ndarray]()
    motion = document["animations"][0]
    for channel in motion["channels"]:
        target = channel["target"]
        sampler = motion["samplers"][channel["sampler"]]
        outputs[target["path"], target["node"]] = values(sampler["output"])
    turns = np.stack([outputs["rotation", joint] for joint in joints], axis=1)
    coefficients = np.zeros((len(turns), 0))
    for (path, _), output in outputs.items():
        if path == "weights":
            coefficients = output.reshape(len(turns), -1)
    nodes = document["nodes"]
    parents = [
        [p for p, j in enumerate(joints) if joint in nodes[j].get("children", [])]
        for joint in joints
    ]
    names = mesh.get("extras", {}).get("targetNames", [])
    expressions = int(header["expressions"])
    named = expressions if header["named"] else 0
    rig = Rig(
        base=base,
        basis=np.reshape(targets, (-1, *base.shape)),
        correctives=arrays.get("correctives", np.zeros((0, *base.shape))),
        joint_rest=rest,
        joint_basis=arrays["joint_basis"],
        joint_names=tuple(str(nodes[joint]["name"]) for joint in joints),
        parents=tuple(own[0] if own else -1 for own in parents),
        weights=weights,
        coefficients=coefficients,
        pose=to_axis_angle(turns[..., [3, 0, 1, 2]]),
        translation=outputs["translation", joints[0]] - rest[0],
        expressions=expressions,
        expression_names=tuple(str(name) for name in names[:named]),
    )
    return rig, values(primitive["indices"]).reshape(-1, 3).astype(np.int32)


def _avatar(
    header: dict[str, Any], arrays: dict[str, np.ndarray], rig: Rig, faces: np.ndarray
) -> Avatar:
    per_face = arrays["splats_per_face"]
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
        antialiased=bool(header["antialiased"]),
        strain_range=strain_range,
        driven_offsets={
            name: each.reshape(-1, 3, 3).astype(np.float32) for name, each in offsets.items()
        },
        light=_light(header, arrays),
    )


def _light(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> AvatarLight | None:
    if "light" not in header:
        return None
    own = header["light"]
    return AvatarLight(
        radiance=np.reshape(own["radiance"], (9, 3)).astype(np.float32),
        transfer=arrays["light_transfer"].astype(np.float32),
        occlusion=arrays["light_occlusion"].astype(np.float32),
        irradiance=arrays["light_irradiance"].astype(np.float32),
        roughness=arrays["light_roughness"].astype(np.float32),
        residual=float(own["residual"]),
        damping=float(own["damping"]),
        source=str(own["source"]),
    )
