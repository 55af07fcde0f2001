"""Skinned splats against an independent reader: what quantization may cost, and what is refused."""

import gzip
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.linalg import norm
from refusal import refusal
from scipy.spatial.transform import Rotation

from export import ten_splats
from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import read_avatar
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.avatar.splats import sh_color
from stga_addon.export import skinned_gltf
from stga_addon.export.formats import export_avatar
from stga_addon.export.gltf import glb_bytes
from stga_addon.export.playback import Playback
from stga_addon.export.rig import BAKE_TOLERANCE_M, baked_rig
from stga_addon.export.skinned_gltf import pack
from stga_addon.export.skinned_reader import (
    AVATAR_FILE,
    MODEL_FILE,
    MOTION_FILE,
    read_skinned_splats,
    unpack_skinned_splats,
)
from stga_addon.export.web import shared_constants
from stga_addon.export.web.page import ELEMENT, PAGE, PLAYER, element_script, modules
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import read_motion, sequence_mesh

from .conftest import make_head
from .web_data import document_of, planes, posed_mesh, read_web_data, splats_of


def test_fixed_point_errs_by_half_a_step():
    """Catches planes in the wrong order, a lost sign, and outliers that take the precision of the
    others."""
    values = np.random.default_rng(0).normal(size=(50, 3)) * [1, 1e3, 1e-3]
    whole = np.array([[-70000, 3], [4, 5]])
    entries, packed = pack({"a": values, "b": whole}, {"a": 1e-3})
    arrays = planes(entries, gzip.decompress(packed))
    assert np.abs(arrays["a"] - values).max() <= 0.5e-3 + 1e-4  # float32 of values near 3,000
    assert np.array_equal(arrays["b"], whole)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_values_that_no_step_holds(bad, head, tmp_path):
    """Catches a page that plays garbage, or half a file, where the avatar holds a value that cannot
    be stored."""
    splats = replace(head.avatar.splats, xyz=np.full_like(head.avatar.splats.xyz, bad))
    avatar = replace(head.avatar, splats=splats)
    with refusal("xyz"):
        export_avatar(tmp_path / "a.html", avatar, "web", sequence=head.sequence)
    assert not list(tmp_path.iterdir())


def test_splats_come_back_within_their_steps(head):
    """Catches a field that is quantized by another field's step, or splats that land on another
    triangle."""
    _, arrays = read_web_data(head.data())
    order = np.argsort(head.avatar.splats.face, kind="stable")
    original = head.avatar.splats.rows(order)
    found = splats_of(arrays)
    unit = original.rotation / norm(original.rotation, axis=1, keepdims=True)
    assert np.array_equal(found.face, original.face)
    assert np.abs(found.xyz - original.xyz).max() <= skinned_gltf.POSITION_STEP_M
    assert np.abs(np.abs((found.rotation * unit).sum(1)) - 1).max() < 1e-4
    for field, width in (("log_scale", 1), ("sh", 45)):  # harmonics along turned axes
        error = np.abs(getattr(found, field) - getattr(original, field)).max()
        assert error <= skinned_gltf.STEPS[field] / 2 * np.sqrt(width) + 1e-6, field
    selected = np.unpackbits(arrays["selection"].astype(np.uint8), axis=1)
    assert np.array_equal(selected[:, : len(head.avatar.faces)], head.selection)
    assert head.data() == head.data()  # no time, or order of a set, in the file


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
@pytest.mark.parametrize("offsets", [tuple(OFFSETS), ("strain_position",)])
def test_driven_offsets_err_by_less_than_what_they_change(convention, offsets):
    """Catches coefficients stored in another unit or order, an offset that comes with none, and a
    range that is left out where no color needs it."""
    head = make_head(convention, offsets=offsets)
    avatar = head.avatar
    _, arrays = read_web_data(head.data())
    assert set(OFFSETS) & set(arrays) == set(offsets)
    limits = arrays["strain_range"].reshape(-1, 2, 6)
    assert np.abs(limits - avatar.strain_range).max() <= skinned_gltf.STEPS["strain_range"]
    unit = avatar.frames(avatar.neutral).scale.max()
    found = {name: arrays[name].reshape(-1, 3, 3) for name in offsets}
    stored = replace(avatar, driven_offsets=found)
    for mesh in head.meshes:
        expected = avatar.frames(mesh)
        if len(offsets) > 1:
            assert np.abs(expected.color).max() > 0.1
            assert np.abs(stored.frames(mesh).color - expected.color).max() < 4 / 255
        still = replace(avatar, driven_offsets={}).frames(mesh).origin
        moved = norm(expected.origin - still, axis=1)
        error = np.abs(stored.frames(mesh).origin - expected.origin).max(1)
        error /= np.maximum(expected.scale / unit, 1)
        assert moved.max() > 100 * skinned_gltf.POSITION_STEP_M
        assert error.max() < 2 * skinned_gltf.MOVED_STEP_M


def test_baked_meshes_come_back(head):
    """Catches a lost mean, rotation or component of a baked sequence, and a baked rig that has
    sliders."""
    rig = baked_rig(list(head.meshes))
    turns = Rotation.from_rotvec(rig.pose[:, 0])
    assert turns.magnitude().max() < 1
    shaped = rig.base + np.einsum("tr,rvc->tvc", rig.coefficients, rig.basis)
    found = shaped @ turns.as_matrix().transpose(0, 2, 1) + rig.translation[:, None]
    assert np.abs(found - head.meshes).max() <= BAKE_TOLERANCE_M
    assert rig.expressions == 0
    assert np.abs(rig.coefficients).max() <= 1 + 1e-9


def test_motion_only_leaves_the_rig_out(head, tmp_path):
    """Catches FLAME's blend shapes in a file that was asked for without them, a page that keeps
    quiet about them, or about FLAME's triangles and meshes in it, one of any other head that names
    FLAME's licence, and a data file left behind by an export that fails at the player beside it."""
    path = tmp_path / "a.glb"
    meshes = list(enumerate(head.meshes))
    (tmp_path / ELEMENT).mkdir()
    with refusal(ELEMENT):
        export_avatar(path, head.avatar, "web", meshes)
    assert not path.exists()
    (tmp_path / ELEMENT).rmdir()
    alone = Playback(motion_only=True)
    export_avatar(path, head.avatar, "web", meshes, head.sequence, alone)
    header, arrays = read_web_data(path.read_bytes())
    assert header["sliders"] == []
    assert arrays["weights"].shape[1] == 1
    assert (tmp_path / ELEMENT).read_text(encoding="utf-8") == element_script()

    def notice(avatar, sequence, motion_only=True):
        path = tmp_path / "b.html"
        playback = Playback(motion_only=motion_only)
        export_avatar(path, avatar, "web", meshes, sequence, playback)
        return re.search(r'<p id="notice">(.*?)</p>', path.read_text(encoding="utf-8"))[1]

    assert "derived from a FLAME model" in notice(head.avatar, head.sequence, False)
    assert "posed meshes of a FLAME head" in notice(head.avatar, head.sequence)
    assert notice(head.avatar, None) == ""
    padding = np.zeros((5143 - len(head.avatar.neutral), 3))
    flame_sized = replace(head.avatar, neutral=np.concatenate([head.avatar.neutral, padding]))
    assert "FLAME&#x27;s licence (flame.is.tue.mpg.de) decides" in notice(flame_sized, None)


def test_the_players_constants_are_pythons():
    """Catches a constant that was changed on one side."""
    assert shared_constants.FILE.read_text(encoding="utf-8") == shared_constants.script()


def test_every_module_is_in_the_page():
    """Catches a module of the player that is not joined into the page, or an import that is left in
    it."""
    assert {path.name for path in PLAYER.glob("*.js")} == {*modules(), PAGE}
    assert "\nimport " not in element_script()
    assert "MIT" in element_script()[:100]


def test_ten_splats_are_where_the_page_says():
    """Catches a page whose rules, file or table do not agree with each other or with what the
    add-on reads and renders."""
    told = np.loadtxt(ten_splats.PLACED, delimiter=",", skiprows=1)
    data = ten_splats.FILE.read_bytes()
    assert np.abs(ten_splats.placed(data) - told).max() < 6e-5
    header, arrays = read_web_data(data)
    frame = ten_splats.FRAME
    mesh = posed_mesh(header, arrays, arrays["coefficients"][frame], arrays["pose"][frame], frame)
    avatar = read_skinned_splats(ten_splats.FILE).avatar
    world = to_world(avatar.splats, avatar.frames(mesh))
    direction = world.xyz - ten_splats.CAMERA
    direction /= norm(direction, axis=1, keepdims=True)
    turns = world.unit_rotations() * np.where(world.rotation[:, :1] < 0, -1, 1)
    color = np.maximum(sh_color(world.sh, direction), 0)
    found = np.column_stack([world.xyz, turns, world.scales(), color])
    assert np.abs(found - told).max() < 1e-4


BYTES = {"type": "integer", "planes": 1, "low": 0}
NAN = 99999
"""Stands for NaN, which JSON has not, though its readers take it."""


def set_bind(document, binary, matrix, column, row, value):
    """Change a number of an inverse bind matrix in place."""
    view = document["bufferViews"][document["accessors"][6]["bufferView"]]
    at = view.get("byteOffset", 0) + 4 * (16 * matrix + 4 * column + row)
    binary[at : at + 4] = np.float32(value).tobytes()


def set_frames(document, count):
    """Make a motion of so many frames of zeros, which need no data."""
    for sampler in document["animations"][0]["samplers"]:
        accessor = document["accessors"][sampler["output"]]
        accessor.pop("bufferView")
        accessor["count"] = count


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda d, _: d["skins"][0].update(joints=[0, 0]), "joints; expected 1 to 5 different"),
        (lambda d, _: d["skins"][0].update(joints=[0, 99]), "a joint that is no node"),
        (lambda d, _: d["skins"][0].update(joints=["a", 1]), "expected a whole number"),
        (lambda d, _: d["skins"][0].update(joints=[0]), "of another type or length"),
        (lambda d, _: d["skins"][0].update(inverseBindMatrices=2), "of another type or length"),
        (lambda d, _: d["nodes"][1].update(name="tail"), "has the joints 'root, tail'"),
        (lambda d, b: set_bind(d, b, 1, 0, 1, 0.5), "matrices that turn"),
        (lambda d, b: set_bind(d, b, 0, 0, 0, 0), "scale by 0 or less"),
        (lambda d, b: set_bind(d, b, 1, 3, 0, np.nan), "matrices that are not finite"),
        (lambda d, _: d["animations"][0]["channels"].pop(2), "does not turn joint 1"),
        (lambda d, _: d["animations"][0]["channels"].pop(1), "does not move the root"),
        (lambda d, _: set_frames(d, 90_000), "motion of 90000 frames is longer"),
        (lambda d, _: d.update(extras=["stga_splats"]), "a value of its JSON has another type"),
        (
            lambda d, _: d["meshes"][0]["primitives"][0].update(targets=[{"POSITION": 4}] * 999),
            "of another type or length",
        ),
    ],
)
def test_damaged_rigs_are_refused(damage, problem, tmp_path):
    """Catches an exception of numpy, half a head, and files in a folder, by a file whose rig does
    not fit."""
    document, binary = document_of(ten_splats.FILE.read_bytes())
    binary = bytearray(binary)
    damage(document, binary)
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, bytes(binary)))
    with refusal(f"a.glb: .*{problem}"):
        unpack_skinned_splats(tmp_path / "a.glb", tmp_path / "unpacked")
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]


def test_zeros_repeated_by_shapes_are_counted(tmp_path):
    """Catches gigabytes of shapes that a small file makes of one accessor without data."""
    document, binary = document_of(ten_splats.FILE.read_bytes())
    zeros = {"count": 300_000, "type": "VEC3", "componentType": 5126}
    document["accessors"].append(zeros)
    primitive = document["meshes"][0]["primitives"][0]
    own = {"POSITION": len(document["accessors"]) - 1}
    primitive["attributes"] |= own
    primitive["targets"] = [own] * 500
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, binary))
    with refusal("500 shapes of 300000 vertices are more than it can hold"):
        read_skinned_splats(tmp_path / "a.glb")


def test_a_rig_with_some_of_the_joints(tmp_path):
    """Catches the test vector refused, and a joint, its correctives or its motion given to another
    joint of FLAME."""
    found = unpack_skinned_splats(ten_splats.FILE, tmp_path / "unpacked")
    model = read_flame(tmp_path / "unpacked" / MODEL_FILE)
    motion = read_motion(tmp_path / "unpacked" / MOTION_FILE, model)
    header, arrays = read_web_data(ten_splats.FILE.read_bytes())
    for frame in motion.timesteps:
        pose = arrays["coefficients"][frame], arrays["pose"][frame], frame
        posed = sequence_mesh(motion, frame)
        assert np.abs(posed - posed_mesh(header, arrays, *pose)).max() < 2e-4
    assert found.rig.joint_names == ("root", "jaw")
    assert read_avatar(tmp_path / "unpacked" / AVATAR_FILE).splats.xyz.shape == (10, 3)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"version": 9}, "version 9; known is 1"),
        ({"byteLength": 50}, "not whole"),
        ({"arrays": {}}, "not whole"),
        ({"arrays": {"xyz": {"type": "float32", "shape": [1 << 40, 3]}}}, "larger than any"),
        ({"arrays": {"xyz": {**BYTES, "shape": [1], "planes": 1 << 26}}}, "expected 1 to 8"),
        ({"arrays": {"page": {**BYTES, "shape": [1 << 29]}}}, "larger than any"),
        ({"arrays": {"xyz": {**BYTES, "shape": [1 << 25]}}}, "larger than any"),
        *(({"fps": fps}, "fps is") for fps in (NAN, 0, 1e300, -10, True, "25", [25])),
        ({"fps": 10**400}, "is no file of skinned splats"),
        ({"antialiased": "no"}, "antialiased is"),
        (
            {"arrays": {f"xyz{end}": {**BYTES, "shape": [9, 1]} for end in ("", "_axes")}},
            "not one row a column",
        ),
        ({"expressions": 3}, "3 expressions"),
        ({"background": [2, 0, 0]}, "background"),
    ],
)
def test_damaged_splats_are_refused(changes, problem, tmp_path):
    """Catches an exception of numpy or zlib, or memory taken, by a file of another kind."""
    document, binary = document_of(ten_splats.FILE.read_bytes())
    header = document["extras"]["stga_splats"]
    header |= changes
    if len(header["arrays"]) == 2:  # whose bytes are to be whole
        packed = gzip.compress(bytes(18))
        binary += packed
        header |= {"byteOffset": len(binary) - len(packed), "byteLength": len(packed)}
    data = glb_bytes(document, binary).replace(str(NAN).encode(), b"  NaN")
    (tmp_path / "a.glb").write_bytes(data)
    with refusal(problem):
        read_skinned_splats(tmp_path / "a.glb")


VALIDATE = """
import validator from 'gltf-validator';
import { readFileSync } from 'node:fs';
for (const file of process.argv.slice(2)) {
  const { issues } = await validator.validateBytes(new Uint8Array(readFileSync(file)));
  console.log(JSON.stringify(issues.messages));
}
"""


@pytest.mark.needs("node")
def test_khronos_validator_has_nothing_to_say(head, tmp_path):
    """Catches what other programs may refuse in files of both kinds of rig."""
    modules_folder = Path(os.environ.get("STGA_NODE_MODULES", "node_modules"))
    if not (modules_folder / "gltf-validator").is_dir():
        pytest.skip("npm install gltf-validator, and STGA_NODE_MODULES=…/node_modules")
    (tmp_path / "node_modules").symlink_to(modules_folder.absolute())
    (tmp_path / "a.mjs").write_text(VALIDATE)
    files = [tmp_path / "a.glb", tmp_path / "b.glb", tmp_path / "c.glb"]
    files[0].write_bytes(head.data())
    files[1].write_bytes(head.data(baked_rig(list(head.meshes))))
    files[2].write_bytes(head.data(exact=True))
    done = subprocess.run(["node", tmp_path / "a.mjs", *files], capture_output=True, timeout=120)
    assert done.stdout.decode().split() == ["[]"] * len(files), done.stderr
