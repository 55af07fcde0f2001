"""glTF: against the specification, by trimesh, and by three.js's loader."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from avatar.conftest import random_splats, rendered, world_splats
from blender.zips import output_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from export.web.web_data import accessor, document_of
from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.splats import SH_C0
from stga_addon.export.formats import export_avatar

PREFIX = "KHR_gaussian_splatting:"
SHAPES = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR"}
FLOAT = 5126


def parsed(path):
    """The document and the only primitive's attributes; checks the container."""
    document, binary = document_of(path.read_bytes())
    assert len(binary) == document["buffers"][0]["byteLength"]
    places = [view["byteOffset"] for view in document["bufferViews"]]
    ends = [view["byteOffset"] + view["byteLength"] for view in document["bufferViews"]]
    assert [*places, len(binary)] == [0, *ends]
    assert not np.mod([*places, len(binary)], 4).any()
    attributes = document["meshes"][0]["primitives"][0]["attributes"].items()
    return document, {name: accessor(document, binary, index) for name, index in attributes}


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
        found = document["accessors"][primitive["attributes"][name]]
        assert (found["type"], found["componentType"], found["count"]) == (kind, FLOAT, 50)
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
    found = json.loads(output_of(["node", script, modules.absolute(), tmp_path / "a.glb"]))
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
