"""Files of splats as other programs write them: what is read, repaired, and refused by name."""

import gzip
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.capture.camera import look_at
from stga_addon.export.splat_files import READERS, UNREAD_SUFFIXES, is_splats, read_splats
from stga_addon.files import write_json
from stga_addon.jobs.render import Render, camera_views, render

from .test_ply import by_hand, layout, numbered_rows

KIND = "binary_little_endian"
C0 = 0.28209479177387814


def read(path, content):
    said = []
    path.write_bytes(content)
    return read_splats(path, said.append), said


def test_rows_that_are_not_finite_are_left_out(tmp_path):
    """Catches a file refused for a few rows of NaN, which trainers leave, or a row of them drawn;
    and opacities and scales of exactly 1 and 0, which are infinite before activation, left out."""
    names = layout(9)
    rows = [dict.fromkeys(names, 0.5) for _ in range(7)]
    rows[1]["x"] = rows[3]["f_rest_4"] = np.nan
    rows[4]["rot_2"] = np.inf
    rows[5].update(opacity=np.inf, scale_1=-np.inf)
    rows[6].update(opacity=-np.inf)
    kinds = dict.fromkeys(names, "float")
    splats, said = read(tmp_path / "a.ply", by_hand(KIND, kinds, rows))
    assert said == [
        f"{tmp_path}/a.ply: left out splats: 3 of 7 splats hold values that are not finite"
    ]
    assert len(splats) == 4
    assert_allclose(splats.opacities()[2:], [1, 0], atol=1e-6)
    assert_allclose(splats.scales()[2], [np.exp(0.5), 0, np.exp(0.5)], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "names", "white"),
    [
        ("uchar", ("red", "green", "blue"), 255),
        ("ushort", ("red", "green", "blue"), 65535),
        ("float", ("r", "g", "b"), 1.0),
        ("float", ("red", "green", "blue"), 255.0),
    ],
)
def test_plain_colors(tmp_path, kind, names, white):
    """Catches a PLY without harmonics refused, or of a color that is not the file's."""
    others = [name for name in layout(0) if not name.startswith("f_dc")]
    rows = [dict.fromkeys(others, 0.1) | dict(zip(names, (0, white, white), strict=True))] * 2
    kinds = dict.fromkeys(others, "float") | dict.fromkeys(names, kind)
    splats, _ = read(tmp_path / "a.ply", by_hand(KIND, kinds, rows))
    assert_allclose(0.5 + C0 * splats.sh[:, 0], [[0, 1, 1]] * 2, atol=1e-6)


def test_other_layouts_of_trainers(tmp_path):
    """Catches flat splats (2D Gaussian Splatting) and harmonics of degree 4 refused, or mixed up
    channels where the highest are cut."""
    names = layout(72)
    names.remove("scale_2")
    rows = numbered_rows(names)
    content = by_hand(KIND, dict.fromkeys(names, "float"), rows)
    splats, said = read(tmp_path / "a.ply", content)
    assert splats.sh_degree == 3
    for channel in range(3):
        expected = [rows[1][f"f_rest_{24 * channel + k}"] for k in range(15)]
        assert splats.sh[1, 1:, channel].tolist() == expected
    assert splats.log_scale[0].tolist() == [rows[0]["scale_0"], rows[0]["scale_1"], -20]
    assert ["degree 4" in line for line in said] == [True, False]
    assert "no scale_2" in said[1]


def test_splat_by_its_bytes(tmp_path):
    """Catches linear scales, opacity of a byte, or the order of the quaternion misread."""
    row = struct.pack("<6f8B", 1, -2, 3, 0.5, 0.25, 1, 255, 0, 51, 102, 0, 255, 128, 128)
    opaque = struct.pack("<6f8B", 0, 0, 0, 0, 1, 1, 0, 0, 0, 255, 255, 128, 128, 128)
    splats, said = read(tmp_path / "a.splat", row + opaque)
    assert said == []
    assert splats.xyz[0].tolist() == [1, -2, 3]
    assert_allclose(splats.scales(), [[0.5, 0.25, 1], [0, 1, 1]], atol=1e-6)
    assert_allclose(splats.opacities(), [0.4, 1], atol=1e-6)
    assert_allclose(0.5 + C0 * splats.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    assert_allclose(splats.rotation[0], [-1, 127 / 128, 0, 0])
    with refusal("no rows of 32"):
        read(tmp_path / "a.splat", row[:-1])


def packed(version, degree=1):
    """An SPZ of one splat by Niantic's README: a quarter turn about z."""
    half = struct.pack("<3e", 1.5, -2, 0.25)
    turn = bytes([128, 128, round(127.5 * (0.5**0.5 + 1))])
    place = half
    if version > 1:
        place = b"".join(int(x * 4096).to_bytes(3, "little", signed=True) for x in (1.5, -2, 0.25))
    if version == 3:  # w is left out; z is the last of three parts of 10 bits
        turn = struct.pack("<I", 3 << 30 | 511)
    count = (degree + 1) ** 2 - 1
    antialiased = version == 3
    head = struct.pack("<4sIIBBBB", b"NGSP", version, 1, degree, 12, antialiased, 0)
    rest = bytes([192, 64, 128] * count)
    body = head + place + b"\x33" + bytes([128, 255, 0]) + bytes([160] * 3) + turn + rest
    return gzip.compress(body, mtime=0)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_by_its_bytes(tmp_path, version):
    """Catches an older version refused or misread: places of 16 bits, quaternions without w."""
    splats, said = read(tmp_path / "a.spz", packed(version))
    assert ["antialiased" in line for line in said] == [True] * (version == 3)
    assert_allclose(splats.xyz, [[1.5, -2, 0.25]])
    assert_allclose(splats.rotation, [[0.5**0.5, 0, 0, 0.5**0.5]], atol=5e-3)
    assert_allclose(splats.log_scale, [[0, 0, 0]])
    assert_allclose(splats.opacities(), [0.2], atol=1e-6)
    assert_allclose(splats.sh[0, 0], (np.array([128, 255, 0]) / 255 - 0.5) / 0.15, 1e-4)
    assert_allclose(splats.sh[0, 1:], [[0.5, -0.5, 0]] * 3)


def bomb():
    """A million equal splats of degree 3, which gzip packs a thousand times."""
    return b"NGSP\3\0\0\0" + struct.pack("<I", 1_000_000) + b"\3\0\0\0" + bytes(65_000_000)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"hello\n", "is not a readable SPZ file"),
        (packed(3)[:-20], "is not a readable SPZ file"),
        (b"NGSP\5\0\0\0\1" + bytes(40), "version 5; read are 1 to 4"),
        (gzip.compress(b"NGSP\3\0\0\0\xff\xff\xff\xff" + bytes(4), mtime=0), "4294967295 splats"),
        (gzip.compress(b"NGSP\3\0\0\0\xa0\x86\1" + bytes(14), mtime=0), "9 bytes of 100000"),
        (packed(2).replace(b"\x00", b"\r\n"), "SPZ file"),
        (gzip.compress(bomb(), mtime=0), "1000000 splats in 63... bytes"),
    ],
    ids=["text", "truncated", "version 5", "without end", "too few bytes", "as text", "bomb"],
)
def test_broken_spz(tmp_path, content, sentence):
    """Catches a traceback, and memory allocated on the word of a header."""
    with refusal(f"a.spz: .*{sentence}.*, or splats .*spz"):
        read(tmp_path / "a.spz", content)


@pytest.mark.parametrize("suffix", [*UNREAD_SUFFIXES, ".foo"])
def test_families_that_are_not_read(tmp_path, suffix):
    """Catches a file of another family told as a broken archive, by the command and the reader."""
    source = tmp_path / f"head{suffix}"
    cameras = tmp_path / "cameras.json"
    source.write_bytes(b"PK\3\4")
    cameras.write_text('{"frames": []}')
    request = Render(source=source, output=tmp_path / "out", cameras=cameras, device="cpu")
    with refusal(rf"head\{suffix}: .*expected .*{'.*'.join(READERS)}"):
        render(request, lambda _: False, print)
    with refusal(rf"head\{suffix}: .*not read"):
        read_splats(source)


def test_names_of_cloudcompare(tmp_path):
    """Catches splats that went through CloudCompare refused: all but places have a prefix."""
    names = layout(9)
    prefixed = {name: name if name in "xyz" else f"scalar_{name}" for name in names}
    rows = numbered_rows(names)
    plain, _ = read(tmp_path / "a.ply", by_hand(KIND, dict.fromkeys(names, "float"), rows))
    renamed = [{prefixed[name]: value for name, value in row.items()} for row in rows]
    kinds = dict.fromkeys(prefixed.values(), "float")
    splats, _ = read(tmp_path / "b.ply", by_hand(KIND, kinds, renamed))
    assert_allclose(splats.sh, plain.sh)
    assert_allclose(splats.rotation, plain.rotation)


def test_output_of_3d_gaussian_splatting(tmp_path):
    """Catches its folder taken for a run, an earlier iteration, and cameras that look the other
    way or from another place, or whose principal point is on the other side."""
    names = layout(0)
    for iteration in (7000, 30000):
        folder = tmp_path / f"model/point_cloud/iteration_{iteration}"
        folder.mkdir(parents=True)
        rows = [dict.fromkeys(names, 0.25)] * (iteration // 1000)
        content = by_hand(KIND, dict.fromkeys(names, "float"), rows)
        (folder / "point_cloud.ply").write_bytes(content)
    said = []
    assert is_splats(tmp_path / "model")
    assert len(read_splats(tmp_path / "model", said.append)) == 30
    assert said == [f"{tmp_path}/model: point_cloud/iteration_30000/point_cloud.ply is used"]
    gl = look_at((0.3, 0.2, 2.0), (0, 0.1, 0), 32, 24, 40.0)
    pose = np.linalg.inv(gl.world_to_camera)
    lens = {"width": 32, "height": 24, "fx": 40.0, "fy": 40.0}
    place = {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
    cameras = tmp_path / "model/cameras.json"
    write_json(cameras, [{"id": 0, "img_name": "a", **lens, **place}])
    request = Render(tmp_path / "model", tmp_path / "out", cameras=cameras)
    (view,) = camera_views(request, cameras, print)
    assert_allclose(view.camera.world_to_camera, gl.world_to_camera, atol=1e-9)
    assert (view.camera.fl_x, view.camera.cx, view.camera.cy) == (40, 16, 12)
    frame = {"file_path": "a.png", "transform_matrix": gl.camera_to_world_gl.tolist()}
    lens = {"w": 32, "h": 24, "fl_x": 40.0, "cx": 16.0, "cy": 7.0}
    for key, cy in (("transforms", 7), ("vhap", 17)):
        timed = {"timestep_index": 0} if key == "vhap" else {}
        write_json(tmp_path / f"{key}.json", {**lens, "frames": [{**frame, **timed}]})
        (view,) = camera_views(request, tmp_path / f"{key}.json", print)
        assert view.camera.cy == cy
