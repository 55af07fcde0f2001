"""3DGS PLY files: what other programs wrote, what they will read, and what is broken."""

import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from avatar.conftest import random_splats
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.capture import ply
from stga_addon.export.ply import read_ply, write_ply
from stga_addon.export.splat_files import read_splats

TYPES = """i1 char int8, u1 uchar uint8, i2 short int16, u2 ushort uint16, i4 int int32,
u4 uint uint32, f4 float float32, f8 double float64"""
CODES = {name: code for code, *names in map(str.split, TYPES.split(",")) for name in names}
"""Scalar types of PLY by both of their names: Turk's description of the format, and those of newer
writers."""


def world_splats(count=20, sh_degree=3):
    splats = random_splats(0, count, 1, sh_degree)
    return replace(splats, unbound=np.zeros(count, bool))


def by_hand(kind, properties, rows, *before):
    """A PLY file made without the code under test; `before`: lines of an earlier element."""
    lines = ["ply", f"format {kind} 1.0", "comment made by hand, Zoë", *before]
    lines.append(f"element vertex {len(rows)}")
    lines += [*(f"property {t} {name}" for name, t in properties.items()), "end_header"]
    if kind == "ascii":
        texts = [" ".join(repr(float(row[name])) for name in properties) for row in rows]
        body = "".join(text + "\n" for text in texts).encode()
    else:
        order = "<" if "little" in kind else ">"
        dtype = np.dtype([(name, order + CODES[t]) for name, t in properties.items()])
        body = np.array([tuple(row[name] for name in properties) for row in rows], dtype).tobytes()
    return "\n".join([*lines, ""]).encode() + body


def layout(rest):
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def numbered_rows(names):
    return [{name: i + 100 * row for i, name in enumerate(names)} for row in range(2)]


@pytest.mark.parametrize(("count", "sh_degree"), [(20, 3), (20, 2), (20, 1), (20, 0), (0, 3)])
def test_round_trip_is_exact(tmp_path, count, sh_degree):
    """Catches any rounding, swap of columns or activation applied on the way, padding at the wrong
    place, which moves green and blue coefficients into red, and special cases of N = 0."""
    splats = world_splats(count, sh_degree)
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    padded = np.pad(splats.sh, ((0, 0), (0, 16 - splats.sh.shape[1]), (0, 0)))
    for name in ("xyz", "rotation", "log_scale", "opacity", "sh", "face", "unbound"):
        want = padded if name == "sh" else getattr(splats, name)
        assert getattr(back, name).dtype == want.dtype, name
        assert_array_equal(getattr(back, name), want, err_msg=name)


def test_file_is_the_standard_layout(tmp_path):
    """Catches column order and channel-major f_rest, read back by plain arithmetic on the bytes,
    and a header that only our own reader understands."""
    splats = world_splats(3)
    write_ply(tmp_path / "a.ply", splats)
    assert_array_equal(np.float32(trimesh.load(tmp_path / "a.ply").vertices), splats.xyz)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property float")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", *layout(45)[3:]]
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    column = dict(zip(names, np.frombuffer(body, "<f4").reshape(3, len(names)).T, strict=True))
    for c in range(3):
        assert_array_equal(column[f"f_dc_{c}"], splats.sh[:, 0, c])
        rest = [column[f"f_rest_{15 * c + k}"] for k in range(15)]
        assert_array_equal(rest, splats.sh[:, 1:, c].T)
    assert_array_equal(column["opacity"], splats.opacity)
    assert_array_equal(column["rot_0"], splats.rotation[:, 0])
    assert_array_equal(column["scale_2"], splats.log_scale[:, 2])
    assert not any(column[name].any() for name in ("nx", "ny", "nz"))


@pytest.mark.parametrize("rest", [0, 9, 24, 45])
@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_foreign_files_of_every_degree_and_kind(tmp_path, kind, rest):
    """Catches a wrong split of f_rest, byte order, and order of properties."""
    names = layout(rest)
    rows = numbered_rows(names)
    shuffled = np.random.default_rng(0).permutation([*names, "label", "red"]).tolist()
    others = {"red": "uchar", "label": "int", "x": "double"}
    kinds = {name: others.get(name, "float") for name in shuffled}
    content = by_hand(kind, kinds, [row | {"label": 7, "red": 255} for row in rows])
    (tmp_path / "a.ply").write_bytes(content)
    splats = read_ply(tmp_path / "a.ply")
    for i, row in enumerate(rows):
        assert splats.xyz[i].tolist() == [row["x"], row["y"], row["z"]]
        assert splats.rotation[i].tolist() == [row[f"rot_{k}"] for k in range(4)]
        assert splats.opacity[i] == row["opacity"]
        for channel in range(3):
            ks = range(channel * rest // 3, (channel + 1) * rest // 3)
            expected = [row[f"f_dc_{channel}"], *(row[f"f_rest_{k}"] for k in ks)]
            assert splats.sh[i, :, channel].tolist() == expected


@pytest.mark.parametrize("type_", CODES)
def test_numbers_of_every_type(tmp_path, type_):
    """Catches a type name that is unknown or mistaken: what follows is shifted."""
    names = layout(0)
    kinds = {"more": type_, **dict.fromkeys(names, "float"), "x": type_}
    rows = [row | {"more": 1} for row in numbered_rows(names)]
    (tmp_path / "a.ply").write_bytes(by_hand("binary_big_endian", kinds, rows))
    assert read_ply(tmp_path / "a.ply").xyz.tolist() == [[0, 1, 2], [100, 101, 102]]


def test_elements_before_and_after_the_vertices_and_windows_line_ends(tmp_path):
    """Catches reading vertices from the start of the data where another element comes first, and a
    data offset computed for \\n only."""
    kinds = dict.fromkeys(layout(0), "float")
    rows = numbered_rows(layout(0))
    before = "element camera 2", "property float a", "property uchar b"
    content = by_hand("binary_little_endian", kinds, rows, *before)
    head, mark, body = content.partition(b"end_header\n")
    head += b"element face 1\nproperty list uchar int vertex_indices\n"
    for ending in (b"\n", b"\r\n"):
        begin = (head + mark).replace(b"\n", ending)
        (tmp_path / "a.ply").write_bytes(begin + b"\xff" * 10 + body + b"\x03" + bytes(12))
        assert read_ply(tmp_path / "a.ply").xyz.tolist() == [[0, 1, 2], [100, 101, 102]]


@pytest.mark.parametrize("order", "<>")
def test_lists_of_different_lengths(tmp_path, monkeypatch, order):
    """Catches lists that are taken for those of another row, also empty ones and behind a block of
    rows, and minutes of work for millions of them."""
    monkeypatch.setattr(ply, "GATHERED_ROWS", 64)
    rng = np.random.default_rng(0)
    faces = [(n, rng.random(n % 4), rng.integers(0, 9, n % 5)) for n in rng.integers(0, 99, 300)]
    kinds = "property uchar n\nproperty list uchar double a\nproperty list int short b\n"
    endian = {"<": "little", ">": "big"}[order]
    start = (
        f"ply\nformat binary_{endian}_endian 1.0\nelement face 300\n{kinds}end_header\n".encode()
    )
    body = b"".join(
        struct.pack(f"{order}BB{len(a)}di{len(b)}h", n, len(a), *a, len(b), *b) for n, a, b in faces
    )
    rows = ply.ply_rows(tmp_path, start + body, ["face"])["face"]
    for name, column in (("a", 1), ("b", 2)):
        assert rows.lists[name].lengths.tolist() == [len(face[column]) for face in faces]
        assert_array_equal(
            rows.lists[name].values, np.concatenate([face[column] for face in faces])
        )
    assert rows.scalars["n"].tolist() == [n for n, _, _ in faces]
    with refusal("not a readable PLY"):
        ply.ply_rows(tmp_path, start + body[:-1], ["face"])
    monkeypatch.setattr(ply, "MAX_UNEVEN_ROWS", 299)
    with refusal("300 rows of 'face' hold lists of different lengths; expected at most 299"):
        ply.ply_rows(tmp_path, start + body, ["face"])
    empty = start.replace(b"300", b"20000000") + bytes(6 * 20_000_000)
    assert len(ply.ply_rows(tmp_path, empty, ["face"])["face"].scalars) == 20_000_000
    monkeypatch.setattr(ply, "MAX_LINES", 5)
    with refusal("has more than 5 lines"):
        ply.ply_rows(tmp_path, ascii_head("element vertex 0\n" + GOOD), ["vertex"])


def head(body):
    return f"ply\nformat binary_little_endian 1.0\n{body}end_header\n".encode()


GOOD = "".join(f"property float {name}\n" for name in layout(0))


def ascii_head(body):
    return head(body).replace(b"binary_little_endian", b"ascii")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, ""),
        (b"solid stl\nend_header\n", "not a PLY file"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n", "no complete header"),
        (head("element vertex 1\n" + GOOD) + bytes(55), "truncated"),
        (head("element vertex -1\n" + GOOD), "cannot be understood"),
        (head("element vertex 0\nproperty half x\n"), "cannot be understood"),
        (head("element vertex 0\nproperty float x\nproperty float x\n"), "cannot be understood"),
        (head("element vertex 1\nproperty list uchar int x\n") + bytes(1), "no vertices"),
        (head(""), "no vertices"),
        (head("element vertex 1\n" + GOOD.replace("opacity", "density")) + bytes(56), "'opacity'"),
        (head("element vertex 1\n" + GOOD + "property float f_rest_0\n") + bytes(60), "f_rest"),
        (head("element vertex 1\n" + GOOD) + b"\0\0\xc0\x7f" + bytes(52), "1 of 1 splats"),
        (head("element vertex 1\n" + GOOD + "property int binding_0\n") + bytes(60), "binding_0"),
        (head("element vertex 1\nproperty uint packed_position\n") + bytes(4), "compressed PLY"),
        (head("element vertex 1\nproperty float x\n") + bytes(4), "it has x"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS pointer"),
        (head("element vertex 1\n" + GOOD).replace(b"\n", b"\r\n"), "truncated"),
        (ascii_head("element vertex 1\n" + GOOD) + b"1 2 three\n" * 9, "three"),
        (ascii_head("element vertex 2\n" + GOOD) + b"1 1\n" * 14, "2 numbers a row"),
        (ascii_head("element vertex 90000000\n" + GOOD) + b"1 " * 14, "truncated"),
    ],
)
def test_broken_files_are_named(tmp_path, content, complaint):
    """Catches tracebacks, and memory allocated on the word of a header."""
    path = tmp_path / "broken.ply"
    if content is not None:
        path.write_bytes(content)
    with refusal("broken.ply.*" + complaint):
        read_splats(path)
