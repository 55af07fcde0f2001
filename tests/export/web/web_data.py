"""An independent reader of skinned splats, written from docs/formats.md."""

import gzip
import json
import struct

import numpy as np
from avatar.conftest import world_splats
from scipy.spatial.transform import Rotation

COMPONENTS = {5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read_web_data(data):
    """Header and arrays (floats or int64) of a .glb."""
    document, binary = document_of(data)
    splats = document["extras"]["stga_splats"]
    assert splats["version"] == 1
    packed = binary[splats["byteOffset"] :][: splats["byteLength"]]
    nodes = [document["nodes"][joint] for joint in document["skins"][0]["joints"]]
    children = [node.get("children", []) for node in nodes]
    parents = [
        next((n for n, own in enumerate(children) if joint in own), -1)
        for joint in document["skins"][0]["joints"]
    ]
    header = {**splats, "joints": [node["name"] for node in nodes], "parents": parents}
    arrays = skin(document, binary) | planes(splats["arrays"], gzip.decompress(packed))
    arrays.setdefault("neutral", arrays["base"])
    features = 9 * (len(nodes) - 1)
    arrays.setdefault("correctives", np.zeros((features, *arrays["base"].shape)))
    return header, arrays


def document_of(data):
    """Document and binary chunk of a .glb."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    assert struct.unpack_from("<I4s", data, 20 + size) == (len(data) - 28 - size, b"BIN\0")
    assert size % 4 == 0
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def accessor(document, binary, index):
    """Values of an accessor (count, width)."""

    def block(kind, count, width, view, offset=0):
        at = document["bufferViews"][view]["byteOffset"] + offset
        flat = np.frombuffer(binary, COMPONENTS[kind], count * width, at)
        return flat.reshape(count, width)

    entry = document["accessors"][index]
    kind = entry["componentType"]
    width = WIDTHS[entry["type"]]
    values = np.zeros((entry["count"], width), COMPONENTS[kind])
    if "bufferView" in entry:
        values = block(kind, entry["count"], width, entry["bufferView"])
    if sparse := entry.get("sparse"):
        places = sparse["indices"]
        count = sparse["count"]
        moved = block(places["componentType"], count, 1, places["bufferView"], places["byteOffset"])
        place = sparse["values"]
        values[moved[:, 0]] = block(kind, count, width, place["bufferView"], place["byteOffset"])
    if entry.get("normalized"):
        return values / float(np.iinfo(values.dtype).max)
    return values


def skin(document, binary):
    """Mesh, rig and motion of the standard part, in meters and radians."""
    [owner] = document["skins"]
    primitive = document["meshes"][0]["primitives"][0]
    attributes = primitive["attributes"]
    bind = accessor(document, binary, owner["inverseBindMatrices"]).reshape(-1, 4, 4)
    unit = float(bind[0, 0, 0])
    base = unit * accessor(document, binary, attributes["POSITION"])
    targets = [target["POSITION"] for target in primitive.get("targets", [])]
    basis = [unit * accessor(document, binary, target) for target in targets]
    weights = np.zeros((len(base), len(bind)))
    for number in range(len([name for name in attributes if name.startswith("JOINTS")])):
        joints = accessor(document, binary, attributes[f"JOINTS_{number}"])
        shares = accessor(document, binary, attributes[f"WEIGHTS_{number}"])
        for column in range(4):
            np.add.at(weights, (np.arange(len(base)), joints[:, column]), shares[:, column])
    rest = -bind[:, 3, :3]
    [motion] = document["animations"]
    found = {}
    for channel in motion["channels"]:
        target = channel["target"]
        output = motion["samplers"][channel["sampler"]]["output"]
        found[target["path"], target["node"]] = accessor(document, binary, output)
    turns = [found["rotation", joint] for joint in owner["joints"]]
    weighted = [values for (path, _), values in found.items() if path == "weights"]
    frames = len(turns[0])
    return {
        "base": base,
        "basis": np.reshape(basis, (-1, *base.shape)),
        "faces": accessor(document, binary, primitive["indices"]).reshape(-1, 3).astype(int),
        "weights": weights,
        "joint_rest": rest,
        "pose": np.stack([Rotation.from_quat(turn).as_rotvec() for turn in turns], axis=1),
        "translation": found["translation", owner["joints"][0]] - rest[0],
        "coefficients": weighted[0].reshape(frames, -1) if weighted else np.zeros((frames, 0)),
    }


def planes(entries, raw):
    """Arrays of a header's entries, which lie one after the other."""
    at = 0
    arrays = {}
    for name, entry in entries.items():
        shape = entry["shape"]
        count = int(np.prod(entry["shape"]))
        if entry["type"] == "float32":
            arrays[name] = np.frombuffer(raw, "<f4", count, at).reshape(shape)
            at += 4 * count
            continue
        bytes_of = np.frombuffer(raw, np.uint8, entry["planes"] * count, at).astype(np.int64)
        at += bytes_of.size
        factors = 256 ** np.arange(entry["planes"])
        integers = factors @ bytes_of.reshape(entry["planes"], count) + entry["low"]
        integers = np.moveaxis(np.reshape(integers, [*shape[-1:], *shape[:-1]]), 0, -1)
        arrays[name] = integers
        if entry["type"] == "fixed":
            arrays[name] = (integers * entry["step"]).astype(np.float32)
    assert at == len(raw)
    for name in [name for name in arrays if name.endswith("_axes")]:
        axes = arrays.pop(name)
        own = name.removesuffix("_axes")
        arrays[own] = arrays[own] @ axes.T
    return arrays


def splats_of(arrays):
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
