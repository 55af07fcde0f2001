"""glTF: against the specification, by trimesh, and by three.js's loader."""

import json
import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from avatar.conftest import random_splats, rendered, world_splats
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.splats import SH_C0
from stga_addon.export.formats import export_avatar

PREFIX = "KHR_gaussian_splatting:"
SHAPES = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR"}
FLOAT = 5126
UNSIGNED_BYTE = 5121
COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def parsed(path):
    """The document and the only primitive's attributes; checks the container."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    assert kind == b"BIN\0"
    assert binary_size % 4 == 0
    assert binary_size == document["buffers"][0]["byteLength"] == len(data) - 28 - size
    binary = data[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]
    attributes = primitive["attributes"].items()
    return document, {name: column(document, binary, index) for name, index in attributes}


def column(document, binary, index):
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = COMPONENTS[accessor["type"]]
    dtype = np.dtype({FLOAT: "<f4", UNSIGNED_BYTE: "u1"}[accessor["componentType"]])
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
    flat = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"])
    return flat.reshape(-1, width)


def harmonic_names(degree):
    return [f"SH_DEGREE_{n}_COEF_{i}" for n in range(degree + 1) for i in range(2 * n + 1)]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_keeps_the_specification(avatar, tmp_path, degree):
    """Catches missing fields, partial degrees, wrong types, and values out of range."""
    avatar.splats.__dict__.update(random_splats(1, 50, 30, degree).__dict__)
    path = tmp_path / "a.glb"
    assert export_avatar(path, avatar, "gltf", [(0, avatar.neutral)]) == [path]
    document, attributes = parsed(path)
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    # viewers show nothing where no scene is named
    assert document["scenes"][document["scene"]] == {"nodes": [0]}
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    coefficients = dict.fromkeys(harmonic_names(degree), "VEC3")
    expected = {PREFIX + name: kind for name, kind in (SHAPES | coefficients).items()}
    assert set(attributes) == {"POSITION", "COLOR_0", *expected}
    for name, kind in expected.items():
        accessor = document["accessors"][primitive["attributes"][name]]
        assert (accessor["type"], accessor["componentType"], accessor["count"]) == (kind, FLOAT, 50)
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert_array_equal(position["min"], attributes["POSITION"].min(axis=0))
    assert_array_equal(position["max"], attributes["POSITION"].max(axis=0))
    lengths = np.linalg.norm(attributes[PREFIX + "ROTATION"], axis=1)
    assert_allclose(lengths, 1, atol=1e-6)
    assert attributes[PREFIX + "SCALE"].min() >= 0
    assert 0 <= attributes[PREFIX + "OPACITY"].min() <= attributes[PREFIX + "OPACITY"].max() <= 1


def test_renders_equal(avatar, tmp_path):
    """Catches wrong quaternion order, activations, or coefficient order, a file that an ordinary
    reader of glTF refuses, and fallback colors that are not linear."""
    export_avatar(tmp_path / "a.glb", avatar, "gltf", [(0, avatar.neutral)])
    _, found = parsed(tmp_path / "a.glb")
    again = world_splats(
        found["POSITION"],
        found[PREFIX + "ROTATION"][:, [3, 0, 1, 2]],
        np.log(found[PREFIX + "SCALE"]),
        found[PREFIX + "OPACITY"][:, 0].astype(np.float64),
        np.stack([found[PREFIX + name] for name in harmonic_names(3)], axis=1),
    )
    expected = to_world(avatar.splats, avatar.frames(avatar.neutral))
    assert np.abs(rendered(again) - rendered(expected)).max() < 1e-4
    (cloud,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert_array_equal(cloud.vertices, expected.xyz)
    color = np.clip(0.5 + SH_C0 * expected.sh[:, 0], 0, 1)
    display = np.asarray(cloud.colors)[:, :3] / 255
    encoded = np.where(display <= 0.0031308, 12.92 * display, 1.055 * display ** (1 / 2.4) - 0.055)
    # 8 bits of linear light are coarse in the dark
    assert_allclose(encoded, color, atol=0.03)


LOAD = """
import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';
const three = pathToFileURL(process.argv[2] + '/three/examples/jsm/loaders/').href;
globalThis.self = globalThis;
const { GLTFLoader } = await import(three + 'GLTFLoader.js');
const name = 'GLTFGaussianSplatLoaderExtension';
const { [name]: GLTFGaussianSplatLoaderExtension } = await import(`${three}${name}.js`);
const loader = new GLTFLoader();
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const file = readFileSync(process.argv[3]);
const buffer = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const gltf = await loader.parseAsync(buffer, '');
const found = {};
gltf.scene.traverse((object) => {
  if (object.userData.gltfExtensions === undefined) return;
  found.extension = object.userData.gltfExtensions.KHR_gaussian_splatting;
  for (const [name, attribute] of Object.entries(object.splatGeometry.attributes))
    found[name] = Array.from(attribute.array);
});
console.log(JSON.stringify(found));
"""


@pytest.mark.needs("node")
def test_three_reads_it(avatar, tmp_path):
    """Catches a file that the loader of three.js refuses or understands otherwise."""
    modules = Path(os.environ.get("STGA_NODE_MODULES", "node_modules"))
    if not (modules / "three").is_dir():
        pytest.skip("three is missing: npm install three, and STGA_NODE_MODULES=…/node_modules")
    export_avatar(tmp_path / "a.glb", avatar, "gltf", [(0, avatar.neutral)])
    script = tmp_path / "load.mjs"
    script.write_text(LOAD)
    run = ["node", str(script), str(modules.absolute()), str(tmp_path / "a.glb")]
    done = subprocess.run(run, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    world = to_world(avatar.splats, avatar.frames(avatar.neutral))
    assert found["extension"]["kernel"] == "ellipse"
    assert_allclose(np.reshape(found["position"], (-1, 3)), world.xyz)
    rotations = Rotation.from_quat(world.unit_rotations(), scalar_first=True).as_matrix()
    axes = rotations * world.scales()[:, None]
    covariance = (axes @ axes.transpose(0, 2, 1))[:, *np.triu_indices(3)]
    assert_allclose(np.reshape(found["covariance"], (-1, 6)), covariance, atol=1e-7)
    alpha = np.reshape(found["color"], (-1, 4))[:, 3]
    assert_allclose(alpha, world.opacities() * 255, atol=0.51)
    assert "sphericalHarmonics3" in found
