"""The player's numerics in Node against numpy: pose, frames, signals, order, and damaged files."""

import functools
import gzip
import json
import operator
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatar.conftest import random_splats

from stga_addon.avatar.embedding import points_to_world
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.offsets import COLOR, OFFSETS
from stga_addon.avatar.strain import trained_range
from stga_addon.export.playback import Playback
from stga_addon.export.rig import RiggedAvatar, baked_rig
from stga_addon.export.skinned_gltf import skinned_glb
from stga_addon.export.web.page import PLAYER

from .conftest import make_head
from .web_data import document_of

pytestmark = pytest.mark.needs("node")

COLORS = {name for name, offset in OFFSETS.items() if offset.target == COLOR}


def evaluated(folder, *files):
    """What evaluate.mjs makes of data files, in one process."""
    paths = [folder / f"{number}.glb" for number in range(len(files))]
    for path, data in zip(paths, files, strict=True):
        path.write_bytes(data)
    command = ["node", Path(__file__).with_name("evaluate.mjs"), PLAYER, *paths]
    done = subprocess.run(command, capture_output=True, timeout=120)
    assert not done.stderr, done.stderr.decode()
    return [dict(json.loads(line)) for line in done.stdout.splitlines()]


def colors(result):
    """Change of each triangle's color (F, 3), and what of it is the light of the capture."""
    texels = np.reshape(result["texels"], (-1, 5, 4))
    return texels[:, 3, :3], texels[:, 4, :3]


@pytest.mark.parametrize("baked", [False, True])
def test_pose_is_flames(head, baked, tmp_path):
    """Catches a joint, corrective, offset or rotation of the player that is not FLAME's, and splats
    blended in the wrong order, left out or drawn twice."""
    rig = baked_rig(list(head.meshes)) if baked else head.rig
    results = evaluated(tmp_path, head.data(rig, exact=True))[0]["results"]
    for mesh, result in zip(head.meshes, results, strict=True):
        assert np.abs(np.reshape(result["vertices"], (-1, 3)) - mesh).max() < 6e-6
        splats = head.avatar.splats.rows(np.argsort(head.avatar.splats.face, kind="stable"))
        world = points_to_world(splats.xyz, head.avatar.frames(mesh), splats.face)
        depth = head.camera.project(world)[1][result["order"]]
        assert sorted(result["order"]) == list(range(len(splats)))
        assert np.diff(depth).max() <= 2 * np.ptp(depth) / 65535


def test_a_head_at_rest_stays_where_it_is(tmp_path):
    """Catches strain of rest that is not taken off, and a single frame that is refused."""
    for offsets in (tuple(OFFSETS), ()):
        head = make_head(sh_degree=0, offsets=offsets)
        neutral = head.avatar.neutral
        faces = head.avatar.faces
        avatar = replace(head.avatar, strain_range=trained_range(len(faces)))
        data = skinned_glb(RiggedAvatar(avatar, baked_rig([neutral])), Playback(), exact=True)
        [result] = evaluated(tmp_path, data)[0]["results"]
        assert np.abs(colors(result)).max() < 1e-5
        assert np.abs(np.reshape(result["vertices"], (-1, 3)) - neutral).max() < 1e-6
        origin = np.reshape(result["frames"], (-1, 3, 4))[..., 3]
        assert np.abs(origin - neutral[faces].mean(1)).max() < 1e-6


@pytest.mark.parametrize("offsets", [tuple(OFFSETS), ("strain_position",), ("normal_color",)])
@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_frames_and_signals_are_the_embedding(convention, offsets, tmp_path):
    """Catches another axis, scale, sliver rule, strain or light than splats were trained with."""
    head = make_head(convention, offsets=offsets)
    results = evaluated(tmp_path, head.data(exact=True))[0]["results"]
    for mesh, result in zip(head.meshes, results, strict=True):
        expected = head.avatar.frames(mesh)
        found = np.reshape(result["frames"], (-1, 3, 4))
        axes = expected.rotation * expected.scale[:, None, None]
        # The mesh is that of float32 blend shapes: a thin triangle's axes turn with the last digit.
        error = np.abs(found[..., :3] - axes).max((1, 2)) / np.abs(axes).max()
        assert np.quantile(error, 0.99) < 1e-3
        assert np.abs(found[..., 3] - expected.origin).max() < 1e-6
        still = replace(head.avatar, driven_offsets={}).frames(mesh).origin
        assert (np.abs(expected.origin - still).max() > 1e-3) == ("strain_position" in offsets)
        free = replace(head.avatar, strain_range=None).frames(mesh).deformation
        # the range
        assert (np.abs(free - expected.deformation) > 0.01).mean(0).min() > 0.05
        whole, light = colors(result)
        for avatar, color in ((head.avatar, whole), (head.avatar.without_light, whole - light)):
            driven = avatar.frames(mesh).color if set(avatar.driven_offsets) & COLORS else color * 0
            assert np.quantile(np.abs(color - driven), 0.99) < 1e-3
        assert (np.abs(light).max() > 0.1) == ("normal_color" in offsets)


def test_smoothed_strain_where_edges_have_any_number_of_triangles(tmp_path):
    """Catches neighbors lost or counted twice, and normals of triangles without area."""
    rng = np.random.default_rng(0)
    neutral = rng.normal(0, 0.1, (9, 3)).astype(np.float32)
    neutral[8] = neutral[7]
    faces = np.stack([rng.permutation(9)[:3] for _ in range(40)]).astype(np.int32)
    faces[30:33], faces[33], faces[34] = faces[:3], faces[0, ::-1], [7, 8, 0]
    faces[35:] = [[3, 3, 4], [3, 4, 4], [5, 6, 5], [7, 7, 7], [4, 3, 8]]
    driven = {n: rng.normal(0, 0.01, (40, 3, 3)).astype(np.float32) for n in OFFSETS}
    avatar = Avatar(random_splats(1, 60, 40, 0), "stga", neutral, faces)
    avatar = replace(avatar, driven_offsets=driven)
    meshes = [neutral, neutral * [0.9, 1.0, 1.1], neutral + rng.normal(0, 0.01, neutral.shape)]
    meshes.append(0 * neutral)
    data = skinned_glb(RiggedAvatar(avatar, baked_rig(meshes)), Playback(), exact=True)
    for mesh, result in zip(meshes, evaluated(tmp_path, data)[0]["results"], strict=True):
        origin = np.reshape(result["frames"], (-1, 3, 4))[..., 3]
        frames = avatar.frames(mesh)
        assert np.abs(origin - frames.origin).max() < 1e-5 or not mesh.any()
        assert np.abs(colors(result)[0] - frames.color).max() < 1e-5


def with_header(whole, *keys, value):
    """A .glb file with one value of its document, or of the header of the splats, replaced."""
    document, binary = document_of(whole)
    root = document if keys[0] in document else document["extras"]["stga_splats"]
    *outer, last = keys
    functools.reduce(operator.getitem, outer, root)[last] = value
    text = json.dumps(document).replace("Infinity", "1e999").encode()
    text += b" " * (-len(text) % 4)
    sizes = 28 + len(text) + len(binary), len(text), len(binary)
    begin = struct.pack("<4sIII4s", b"glTF", 2, *sizes[:2], b"JSON")
    return begin + text + struct.pack("<I4s", sizes[2], b"BIN\0") + binary


LIGHT = {"damping": 0.5, "recorded": [1] * 27, "typical": [1] * 3}


def test_damaged_files_are_refused_in_one_sentence(head, tmp_path):
    """Catches a player that hangs, or draws garbage, on a file that was cut off, altered or made by
    a later version."""
    whole = head.data()
    packed = functools.partial(gzip.compress, compresslevel=1)
    altered = [
        (whole[: len(whole) // 2], "is cut off."),
        (b"PK" + whole, "not an avatar data file."),
        (packed(whole)[:-999], "is damaged."),
        (with_header(whole, "version", value=9), "format version 9"),
        (with_header(whole, "byteLength", value=99), "is damaged."),
        (whole[:12] + b"\xff\xff\xff\x7f" + whole[16:], "document is missing or malformed."),
    ]
    for field, *keys, value in [
        ("sliders", "sliders", 0, "component", 0.5),
        ("sliders", "sliders", 0, "component", 10**6),
        ("sliders", "sliders", 0, "reach", float("inf")),
        ("sliders", "sliders", 0, None),
        ("joints", "nodes", 0, "name", None),
        ("mesh", "meshes", []),
        ("mesh", "accessors", 0, "count", 10**9),
        ("document", "buffers", 0, "byteLength", 10**9),
        ("views", "views", 0, "size", [0.5, 120]),
        ("views", "views", 0, "size", [1e300, 120]),
        ("views", "views", 0, "focal", "12"),
        ("parents", "nodes", 4, "children", [0]),
        ("fps", "fps", 1e300),
        ("fps", "fps", -20),
        ("fps", "fps", True),
        ("title", "title", 5),
        ("light", "light", {**LIGHT, "damping": 2}),
        ("light_transfer", "light", LIGHT),
        ("offsets.normal_color", "offsets", "normal_color", ["wind", "color"]),
        ("offsets.normal_color", "offsets", "normal_color", ["normal", "valueOf"]),
        ("offsets.normal_color", "offsets", "normal_color", None),
        ("gone", "offsets", {"gone": ["normal", "color"]}),
        ("xyz.planes", "arrays", "xyz", "planes", 9),
    ]:
        sentence = f"damaged: {field} is missing or malformed."
        altered.append((with_header(whole, *keys, value=value), sentence))
    results = evaluated(tmp_path, *(data for data, _ in altered))
    for result, (_, sentence) in zip(results, altered, strict=True):
        error = result.get("error", "")
        assert error.startswith("DataError: ")
        assert sentence in error
        assert error.endswith(".")
