"""An independent reader of web data files, written from docs/formats.md."""

import gzip
import json
import struct
from typing import Any

import numpy as np
from avatar.conftest import world_splats
from scipy.spatial.transform import Rotation

from stga_addon.avatar.splats import Splats


def read_web_data(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays (float32 or int64) of a data file."""
    raw = gzip.decompress(data)
    magic, version, length = struct.unpack_from("<4sII", raw)
    assert magic == b"STGA"
    assert version == 4
    header = json.loads(raw[12 : 12 + length])
    at = 12 + length
    arrays = {}
    for name, entry in header["arrays"].items():
        shape = entry["shape"]
        count = int(np.prod(entry["shape"]))
        if entry["type"] == "float32":
            arrays[name] = np.frombuffer(raw, "<f4", count, at).reshape(shape)
            at += 4 * count
            continue
        planes = np.frombuffer(raw, np.uint8, entry["planes"] * count, at).astype(np.int64)
        at += planes.size
        factors = 256 ** np.arange(entry["planes"])
        integers = factors @ planes.reshape(entry["planes"], count) + entry["low"]
        integers = np.moveaxis(np.reshape(integers, [*shape[-1:], *shape[:-1]]), 0, -1)
        arrays[name] = integers
        if entry["type"] == "fixed":
            arrays[name] = (integers * entry["step"]).astype(np.float32)
    assert at == len(raw)
    return header, arrays


def splats_of(arrays: dict[str, np.ndarray]) -> Splats:
    """The splats of a data file, sorted by triangle."""
    count = len(arrays["xyz"])
    largest = arrays["rotation_largest"]
    smaller = arrays["rotation"].astype(np.float64)
    rotation = np.empty((count, 4))
    for row in range(4):
        chosen = largest == row
        rotation[chosen, row] = np.sqrt(1 - np.minimum(1, (smaller[chosen] ** 2).sum(1)))
        rotation[np.ix_(chosen, [k for k in range(4) if k != row])] = smaller[chosen]
    opacity = np.clip(arrays["opacity"].astype(np.float64), 1e-6, 1 - 1e-6)
    rest = arrays.get("sh", np.zeros((count, 0))).reshape(count, -1, 3)
    per_face = arrays["splats_per_face"]
    sh = np.concatenate([arrays["color"][:, None], rest], axis=1)
    splats = world_splats(arrays["xyz"], rotation, arrays["log_scale"], opacity, sh)
    splats.face[:] = np.repeat(np.arange(len(per_face)), per_face)
    return splats


def posed_mesh(header, arrays, coefficients, pose, frame):
    """Vertices (V, 3) of coefficients (R,), pose (J, 3) axis-angle and the translation of a
    frame."""
    local = Rotation.from_rotvec(pose).as_matrix()
    features = (local[1:] - np.eye(3)).ravel()
    shaped = arrays["base"] + np.einsum("r,rvc->vc", coefficients, arrays["basis"])
    shaped = shaped + np.einsum("p,pvc->vc", features, arrays["correctives"])
    joints = arrays["joint_rest"] + np.einsum("r,rjc->jc", coefficients, arrays["joint_basis"])
    world = []
    for joint, parent in enumerate(header["parents"]):
        own = np.eye(4)
        own[:3, :3] = local[joint]
        own[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(own if parent < 0 else world[parent] @ own)
    skinned = np.zeros_like(shaped, dtype=float)
    for joint, matrix in enumerate(world):
        moved = (shaped - joints[joint]) @ matrix[:3, :3].T + matrix[:3, 3]
        skinned += arrays["weights"][:, joint, None] * moved
    return skinned + arrays["translation"][frame]
