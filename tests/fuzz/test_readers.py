"""Files that are not for their readers: damaged at random, made to break them, or wrong in one
field. Every reader of `readers.TARGETS` loads them or raises StgaError in one sentence, in little
time and memory; it executes nothing and writes nothing.

Quick in the normal suite; `STGA_FUZZ_SECONDS=600 pytest tests/fuzz` shares that time among the
targets.
"""

import itertools
import json
import os
import pickle
import random
import re
import struct
import sys
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from flame.conftest import random_arrays
from refusal import refusal
from tracking import test_calibrations
from tracking.scenes import rewrite
from tracking.test_head_model import glb as head_glb
from tracking.test_head_model import simple
from training.test_folder import make_checkpoint

from stga_addon.capture.meshes import read_mesh
from stga_addon.capture.model import summarize_capture
from stga_addon.capture.open import open_capture, read_face_ids
from stga_addon.errors import StgaError
from stga_addon.export.ply import PROPERTIES
from stga_addon.export.splat_files import read_splats
from stga_addon.files import read_json, read_npz
from stga_addon.flame import unpickle
from stga_addon.flame.model import read_flame
from stga_addon.flame.unpickle import read_pickled_arrays
from stga_addon.tracking.head_model import read_head_model
from stga_addon.training.run import checkpoint as checkpoints

from .damages import damage_content
from .readers import TARGETS

MAX_READ_S = 10.0
MAX_READ_BYTES = 200e6
GIGA = 10**9
"""As many values as a malformed file says it holds."""
SECONDS = float(os.environ.get("STGA_FUZZ_SECONDS", 0))
EXAMPLES = 40  # Damages of each reader's file, the same every time; more until SECONDS are over


def behaves(read, folder):
    """The error's message, or "" where `read` loads. Fails on anything else, on a reader that takes
    too long or too much memory, and on one that adds files to `folder` or beside it, or removes
    some."""

    def listing():
        walk = os.walk(folder)
        inside = [os.path.join(base, name) for base, a, b in walk for name in (*a, *b)]
        return sorted([*inside, *os.listdir(folder.parent)])

    before = listing()
    message = ""
    begin = time.process_time()  # of this process: other programs may keep it waiting
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # NumPy's, for unchecked numbers
            read()
    except StgaError as error:
        message = str(error) or "an error without a message"
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert time.process_time() - begin < MAX_READ_S, message
    assert peak < MAX_READ_BYTES, message
    assert listing() == before
    assert "\n" not in message[:80]
    assert message != "an error without a message"
    return message


JUNK = {
    "empty": b"",
    "zeros": bytes(10_000),
    "not utf-8": b'{"format": "\xff\xfe"}',
    "utf-16": '{"a": 1}'.encode("utf-16"),
    "byte order mark": b"\xef\xbb\xbf{}",
    "brackets": b"[" * 100_000,
    "objects": b'{"a":' * 100_000,
    "digits": b"9" * 100_000,
    "nan": b"NaN",
    "string": b'"text"',
    "zip": b"PK\x05\x06" + bytes(18),
    "pickle": pickle.dumps({"a": 1}),
    "zip of millions": b"PK\x05\x06" + struct.pack("<4H2LH", 0, 0, 65535, 65535, 2**31, 0, 0),
}
IN_PLACE = {
    "link to itself": lambda path: path.symlink_to(path.name),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
}
"""What is no file, in the place of one."""
NAMES = ("nul\0byte", "\ud800", "x" * 5000)
"""That no file can have, and a capture's JSON may hold."""
OF_A_FOLDER = ("run", "checkpoint", "selection", "metrics", "colmap")
"""Beginnings of targets whose readers take the folder of their file."""


@pytest.mark.parametrize("name", TARGETS)
def test_reader(tmp_path, name):
    """Catches a reader that neither loads a damaged file nor raises StgaError."""
    target = TARGETS[name]
    path = tmp_path / "good" / target.name
    broken = tmp_path / "broken" / target.name
    path.parent.mkdir()
    broken.parent.mkdir()
    target.write(path)
    target.read(path)
    for content in JUNK.values():
        broken.write_bytes(content)
        behaves(lambda: target.read(broken), broken.parent)
    whole = path.read_bytes()
    end = time.monotonic() + SECONDS / len(TARGETS)
    for example in itertools.count():
        if example >= EXAMPLES and time.monotonic() > end:
            return
        rng = random.Random(example if example < EXAMPLES else time.monotonic_ns())
        broken.write_bytes(whole)
        done = [damage_content(rng, broken) for _ in range(rng.choice([1, 1, 2, 4]))]
        try:
            behaves(lambda: target.read(broken), broken.parent)
        except BaseException as error:
            error.add_note(f"{done}: {broken.read_bytes()[:1000]!r}")
            raise


@pytest.mark.skipif(
    sys.platform == "win32", reason="needs links, pipes and devices of a POSIX system"
)
@pytest.mark.parametrize("reader", [name for name in TARGETS if not name.startswith("colmap")])
def test_what_is_no_file(tmp_path, reader):
    """Catches readers that wait on a pipe, read a device, or trip over a link to itself."""
    target = TARGETS[reader]
    for kind, make in IN_PLACE.items():
        (tmp_path / kind).mkdir()
        path = tmp_path / kind / target.name
        make(path)
        message = behaves(lambda path=path: target.read(path), path.parent)
        assert message or (reader, kind) == ("metrics", "link to itself"), kind
    for stem in NAMES if not reader.startswith(OF_A_FOLDER) else ():
        path = tmp_path / (stem + target.name)
        assert behaves(lambda path=path: target.read(path), tmp_path), stem


# Arrays and archives that lie


def npy(descr="<f4", shape=(GIGA,), data=b"", header=""):
    """A npy file that says what it likes about its content."""
    text = header or repr({"descr": descr, "fortran_order": False, "shape": shape})
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n" + data


def archive(path, entries, packing=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", packing) as out:
        for name, content in entries.items():
            out.writestr(name, content)
    return path


LYING_ARRAYS = {
    "gigabytes promised": npy(),
    "product wraps around": npy(shape=(2**32, 2**32)),
    "beyond 64 bits": npy(shape=(10**30,)),
    "negative": npy(shape=(-1, 3)),
    "true": npy(shape=(True,), data=bytes(4)),
    "no size": npy("|V0", (10**12,)),
    "one huge string": npy("<U1000000000", (1,)),
    "objects": npy("|O", (1,), pickle.dumps([1])),
    "nested type": npy([("a", "<f4", (10**6, 10**6))], (1,)),
    "type of itself": npy([("a", [("b", "O")])], (1,)),
    "half a header": b"\x93NUMPY\x01\x00\xff\xff{",
    "header of gigabytes": b"\x93NUMPY\x02\x00\xff\xff\xff\xff{",
    "header cut in a string": npy(header="{'descr': '''<f4"),
    "brackets": npy(header="[" * 5000),
    "minus signs": npy(header="-" * 9000 + "1"),
    "header of a number": npy(header="9" * 9000),
    "header runs code": npy(header="{'descr': __import__('os').system('touch witness')}"),
    "format 9": b"\x93NUMPY\x09\x00" + npy()[8:],
    "trailing bytes": npy(shape=(1,), data=bytes(8)),
}


@pytest.mark.parametrize("lie", LYING_ARRAYS)
def test_arrays_that_lie(tmp_path, lie):
    """Catches memory allocated on the word of a header, and header parsers that fail with errors of
    their own."""
    path = archive(tmp_path / "a.npz", {"a.npy": LYING_ARRAYS[lie]})
    assert "a.npz: is not a readable npz" in behaves(lambda: read_npz(path), tmp_path)
    path = tmp_path / "a.npy"
    path.write_bytes(LYING_ARRAYS[lie])
    assert "a.npy: is not a readable npy" in behaves(lambda: read_face_ids(path, 5), tmp_path)


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
def test_damaged_packing(tmp_path, packing):
    """Catches each decompressor's own exceptions, and an archive unpacked by its entries' names."""
    array = npy(shape=(9,), data=bytes(range(36)))
    path = archive(tmp_path / "a.npz", {"../a.npy": array, "/tmp/x.npy": array}, packing)
    whole = path.read_bytes()
    for position in range(30, 120):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        behaves(lambda: read_npz(path), tmp_path)


SIGNALING_NAN = {"f4": 0x7F841000, "f8": 0x7FF0000010000001}
"""Bits of a NaN that NumPy warns of where it is made a number of another size."""
FLOATING_POINT_TARGETS = [
    "landmarks",
    "places",
    "head model npz",
    "avatar",
    "flame npz",
    "flame frame",
    "flame motion",
]


@pytest.mark.parametrize("name", FLOATING_POINT_TARGETS)
def test_bits_that_are_no_number(tmp_path, name):
    """Catches a warning of NumPy in place of an answer for bits that are rarely met."""
    target = TARGETS[name]
    path = tmp_path / target.name
    target.write(path)
    whole = read_npz(path)
    kinds = {key: array for key, array in whole.items() if array.dtype.kind == "f" and array.size}
    assert kinds
    for (key, array), (size, bits) in itertools.product(kinds.items(), SIGNALING_NAN.items()):
        changed = array.astype(size)
        changed.reshape(-1).view(f"u{size[1:]}")[0] = bits
        np.savez(path, **{**whole, key: changed})
        behaves(lambda: target.read(path), tmp_path)


# Meshes


PRIMITIVE = {"attributes": {"POSITION": 0}, "indices": 1}


def gltf(**changes):
    """One triangle; `changes` replace parts of the document."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [PRIMITIVE]}],
        "accessors": accessors(),
        "bufferViews": views,
        "buffers": [{"byteLength": 48}],
    }
    return head_glb({**document, **changes}, points + np.array([0, 1, 2], "<u4").tobytes())


def accessors(**changes):
    first = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **changes}
    kept = {key: value for key, value in first.items() if value is not None}
    return [kept, {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}]


PLY_LIST = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
LONG = PLY_LIST.replace("uchar", "uint").format(2).encode() + bytes(36) + b"\xff\xff\xff\x7f"
FLOAT_LIST = PLY_LIST.replace(" int ", " float ").format(1).encode()
CORNERS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
SIGNAL = struct.pack("<I", SIGNALING_NAN["f4"])
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def ply(vertices, rest, kind="binary_little_endian"):
    coordinates = "property float x\nproperty float y\nproperty float z\n"
    return f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n{coordinates}".encode() + rest


ZEROS = accessors(count=20_000, bufferView=None)
MESHES = {
    "whole.glb": gltf(),
    "twice.glb": gltf(nodes=[{"mesh": 0}] * 2, scenes=[{"nodes": [0, 1]}]),
    "huge matrices.glb": gltf(nodes=[{"mesh": 0, "matrix": [1e308] * 16}]),
    "includes.obj": b"mtllib /etc/passwd\ncall x.obj\n" + OBJ,
    "one polygon.obj": OBJ + b"f " + b"1 " * 150_000 + b"\n",
}
"""That load."""
BROKEN_MESHES = {
    "billion points.glb": gltf(accessors=accessors(count=GIGA)),
    "billion points without data.glb": gltf(accessors=accessors(count=GIGA, bufferView=None)),
    "negative counts.glb": gltf(accessors=accessors(count=-3)),
    "count as text.glb": gltf(accessors=accessors(count="3")),
    "points as matrices.glb": gltf(accessors=accessors(type="MAT4")),
    "ring.glb": gltf(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
    "own child.glb": gltf(nodes=[{"mesh": 0, "children": [0]}]),
    "doubles.glb": gltf(nodes=[*({"children": [n + 1, n + 1]} for n in range(30)), {"mesh": 0}]),
    "thousands of nodes.glb": gltf(
        accessors=ZEROS, nodes=[{"mesh": 0}] * 2000, scenes=[{"nodes": [*range(2000)]}]
    ),
    "thousands of parts.glb": gltf(accessors=ZEROS, meshes=[{"primitives": [PRIMITIVE] * 2000}]),
    "distant buffer.glb": gltf(buffers=[{"byteLength": 48, "uri": "../../etc/passwd"}]),
    "server.glb": gltf(buffers=[{"byteLength": 48, "uri": "http://127.0.0.1:9/x"}]),
    "few numbers.glb": gltf(nodes=[{"mesh": 0, "matrix": [1] * 3}]),
    "huge chunk.glb": struct.pack("<5L", 0x46546C67, 2, 100, 2**32 - 1, 0x4E4F534A),
    "billion vertices.ply": ply(GIGA, b"end_header\n" + bytes(36)),
    "billion lines.ply": ply(GIGA, PLY_LIST.format(GIGA).encode() + b"0 0 0\n" * 3, "ascii"),
    "billion faces.ply": ply(3, PLY_LIST.format(GIGA).encode() + bytes(36) + b"\x03" + bytes(12)),
    "long polygons.ply": ply(3, LONG),
    "signaling corner.ply": ply(3, FLOAT_LIST + CORNERS + b"\x03" + bytes(8) + SIGNAL),
    "corner beyond numbers.ply": ply(3, FLOAT_LIST + b"0 0 0\n" * 3 + b"3 0 1 1e39\n", "ascii"),
    "signaling vertex.ply": ply(1, FLOAT_LIST + bytes(8) + SIGNAL + b"\x03" + bytes(12)),
    "vertex beyond numbers.ply": ply(1, FLOAT_LIST + b"0 0 1e39\n3 0 0 0\n", "ascii"),
    "billion triangles.stl": bytes(80) + struct.pack("<L", GIGA) + bytes(50),
    "text.stl": b"solid x\n" + b"facet normal 0 0 1\nouter loop\n" * 1000,
    "huge indices.obj": OBJ + b"f 1 2 " + b"9" * 5000 + b"\n",
    "huge numbers.obj": OBJ.replace(b"v 0 0 0", b"v 0 0 1e400"),
    "lines.obj": b"\n" * 1_000_000,
    "empty.obj": b"",
    "text.obj": b"hello",
    "no face.obj": OBJ[:-8],
    "no vertex.obj": b"f 1 2 3\n",
    **{
        f"face {words}.obj": OBJ[:-8] + f"f {words}\n".encode()
        for words in ("1 2", "1 2 4", "0 1 2", "1 2 -4", "a b c", "1 2 99999999999999999999")
    },
    **{
        f"vertex {words}.obj": OBJ.replace(b"0 0 0", words.encode())
        for words in ("0 0", "0 0 x", "0 0 nan", "0 0 inf")
    },
    "flat.obj": b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
}


@pytest.mark.parametrize("name", [*MESHES, *BROKEN_MESHES])
def test_meshes(tmp_path, name):
    """Catches memory allocated on a header's word, files read or servers asked because a mesh names
    them, and parsers that do not end."""
    path = tmp_path / name
    path.write_bytes((MESHES | BROKEN_MESHES)[name])
    message = behaves(lambda: read_mesh(path), tmp_path)
    assert message == "" if name in MESHES else message.startswith(f"{path}: ")
    if name == "twice.glb":
        assert len(read_mesh(path)[0]) == 6


def test_splats_beyond_their_numbers(tmp_path):
    """Catches a warning of NumPy, and splats lost, where doubles or text hold what is no float."""
    path = tmp_path / "a.ply"
    columns = "".join(f"property double {name}\n" for name in PROPERTIES)
    header = f"ply\nformat {{}} 1.0\nelement vertex 2\n{columns}end_header\n"
    rows = np.zeros((2, len(PROPERTIES)))
    rows[:, PROPERTIES.index("rot_0")] = 1.0
    rows[1].view(np.uint64)[:] = SIGNALING_NAN["f8"]
    path.write_bytes(header.format("binary_little_endian").encode() + rows.tobytes())
    assert behaves(lambda: read_splats(path), tmp_path) == ""
    rows[1] = 1e39
    text = "\n".join(" ".join(f"{value:g}" for value in row) for row in rows)
    path.write_text(header.format("ascii").replace("double", "float") + text)
    assert behaves(lambda: read_splats(path), tmp_path) == ""


def primitives(count, targets):
    """A mesh of equal primitives with targets of names of their own."""
    part = {"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}] * targets}
    return [{"primitives": [part] * count}]


def zeros(count, **more):
    """Accessors of zeros, which need no data."""
    return [{"componentType": 5126, "count": count, "type": "VEC3", **more}] * 2


DRACO = ["KHR_draco_mesh_compression"]
MANY = zeros(100_000)
FAR = [{"buffer": 0, "byteOffset": 60, "byteLength": 36}] * 2
HUGE = {"mesh": 0, "scale": [1e308] * 3, "rotation": [1e308] * 4}
REPEATED = {"nodes": [{"mesh": 0}] * 999, "scenes": [{"nodes": [*range(999)]}]}
HEADS = [
    (b"", "is not a readable GLB"),
    (b"glTF" + bytes(40), "is not a readable GLB"),
    (simple(meshes=primitives(1, 0)), "neither identity nor expression"),
    (simple(extensionsRequired=DRACO), "export it without compression"),
    (simple(buffers=[{"uri": "../../etc/passwd", "byteLength": 72}]), "refers to other files"),
    (simple(scenes=[{"nodes": []}]), "no triangle mesh"),
    (simple(nodes=[{"children": [0]}]), "no triangle mesh"),
    (simple(nodes=[{"mesh": 9}]), "is not a readable GLB"),
    (simple(nodes=[{"mesh": 0, "scale": [99, 99, 99]}]), "measures"),
    (simple(accessors=zeros(1 << 40)), "more than the"),
    (simple(bufferViews=FAR), "beyond the file"),
    (simple(accessors=zeros(np.inf)), "not a readable GLB"),
    (simple(nodes=[HUGE]), ""),
    (simple(nodes=[{"mesh": 0, "matrix": [1e308] * 16}]), ""),
    (simple(nodes=[{"mesh": 0, "translation": [1e308, 0, np.nan]}]), "values that are not finite"),
    (simple(meshes=primitives(400, 2), accessors=MANY), "its meshes hold .* numbers, more than"),
    (simple(meshes=primitives(2, 400), accessors=MANY), "its meshes hold .* numbers, more than"),
    (simple(**REPEATED, accessors=zeros(9_000)), "more than"),
    (simple(accessors=zeros(3_000_000)), "its meshes hold .* numbers, more than"),
    (simple(accessors=zeros(100_000, bufferView=0), bufferViews=[{"byteStride": 0}]), "readable"),
]


@pytest.mark.parametrize(("data", "expected"), HEADS)
def test_head_models(tmp_path, data, expected):
    """Catches a traceback, a hang or gigabytes of memory for a GLB that is damaged or hostile."""
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    assert re.search(f"a.glb: .*{expected}", behaves(lambda: read_head_model(path), tmp_path))


# Pickles


def pickled(value, key=b"v_template"):
    return b"\x80\x02}U" + bytes([len(key)]) + key + value + b"s."


RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
SET_OF_OBJECT = b"c__builtin__\nset\nc__builtin__\nobject\n"
PICKLES = {
    "list of itself": pickled(b"]q\x01h\x01a"),
    "extension registry": pickled(b"\x82\x01"),
    "changes a function": pickled(b"c_codecs\nencode\nN}U\x0c__defaults__K\x05\x85s\x86b"),
    "bytes of gigabytes": pickled(b"\x8e" + struct.pack("<Q", 10**15)),
    "array of gigabytes": pickled(b"\x96" + struct.pack("<Q", 10**12)),
    "frame of gigabytes": b"\x80\x04\x95" + struct.pack("<Q", 10**15) + b"N.",
    "number of megabytes": pickled(b"\x8b" + struct.pack("<L", 2_000_000) + b"\x7f" * 2_000_000),
    "number as text": pickled(b"L" + b"9" * 1_000_000 + b"L\n"),
    "runs a command": pickled(b"cos\nsystem\nU\x0dtouch witness\x85R"),
    "runs a command by another name": pickled(RECONSTRUCT[:-1] + b".__globals__\n"),
    "runs by inheritance": pickled(b"cposix\nsystem\nU\x0dtouch witness\x85\x81"),
    "list": pickle.dumps([1, 2]),
    "text": b"hello there",
    "persistent": b"\x80\x02P1\n.",
    "memo of 16 GB": b"\x80\x02Nr\xff\xff\xff\x7f.",
    "array's shape": b"\x80\x02" + RECONSTRUCT + b"(cnumpy\nndarray\n(J\xff\xff\xff\x7ft",
    "lists that hold the list before twice": pickled(
        b"]q\x00K\x01a0" + b"".join(b"](h%ch%ceq%c0" % (n, n, n + 1) for n in range(29)) + b"h\x1d"
    ),
    "selections of themselves": pickled(
        b"N"
        + b"".join(
            b"0cchumpy.reordering\nSelect\n)\x81q\x01}(U\x01ah\x00U\x04idxsh\x00ubq\x00"
            for _ in range(40)
        ).replace(b"h\x00", b"N", 2)
    ),
    "tuple in tuples": b"\x80\x02})" + b"\x85" * 150_000 + b"Ns.",
    "tuples that hold the tuple before twice": b"\x80\x02})" + b"2\x86" * 40 + b"Ns.",
    "rebuilds a set": b"\x80\x02ccopy_reg\n_reconstructor\n(" + SET_OF_OBJECT + b"NtR.",
}


@pytest.mark.parametrize("name", PICKLES)
def test_pickles(tmp_path, name):
    """Catches pickles whose size is a lie, that run what they name, that change how later files are
    read, or that never end."""
    path = tmp_path / "a.pkl"
    good = tmp_path / "good.pkl"
    good.write_bytes(pickle.dumps(random_arrays(), 2))
    before = read_flame(good).v_template
    path.write_bytes(PICKLES[name])
    assert behaves(lambda: read_flame(path), tmp_path).startswith(f"{path}: ")
    behaves(lambda: read_pickled_arrays(path), tmp_path)
    assert not Path("witness").exists()
    np.testing.assert_array_equal(read_flame(good).v_template, before)


@pytest.mark.parametrize("opcode", [b"\x8f", b"]", b"}", b"(", b"N\x94"])
def test_opcodes_of_pickles_are_counted(tmp_path, monkeypatch, opcode):
    """Catches gigabytes of empty sets, lists or memo slots, each of which is a byte of the file."""
    monkeypatch.setattr(unpickle._Counted, "left", 1000)
    path = tmp_path / "a.pkl"
    path.write_bytes(b"\x80\x04" + opcode * 2000 + b".")
    with refusal(r"a\.pkl: .*more than \d+ opcodes"):
        read_pickled_arrays(path)


class Sparse:
    """Pickles as a scipy.sparse matrix of whatever state."""

    __module__ = "scipy.sparse._csc"
    __qualname__ = "csc_matrix"

    def __init__(self, **state):
        self.__dict__.update(state)


@pytest.mark.parametrize("shape", [(10**5, 10**5), (20_000, 10_000), (5, 10**18), (10**4, -1)])
def test_sparse_matrices_that_would_be_large(tmp_path, monkeypatch, shape):
    """Catches a matrix of a few entries filled in to gigabytes."""
    import scipy.sparse

    monkeypatch.setattr(scipy.sparse._csc, "csc_matrix", Sparse)
    empty = np.zeros(0, np.int32)
    path = tmp_path / "a.pkl"
    matrix = Sparse(_shape=shape, data=empty, indices=empty, indptr=np.zeros(1, np.int32))
    path.write_bytes(pickle.dumps({"v_template": matrix}, 4))
    assert "v_template" in behaves(lambda: read_pickled_arrays(path, ("v_template",)), tmp_path)


@pytest.mark.parametrize("shape", [(-1, -6), ("a",), (10**400,), (2, 3, None), (1,) * 70])
def test_shapes_that_are_none(tmp_path, shape):
    """Catches arithmetic on shapes that are not numbers, not positive or of too many axes."""
    path = tmp_path / "a.pkl"
    code = pickle.dumps({"v_template": np.arange(6.0)}, 2)
    path.write_bytes(code.replace(pickle.dumps((6,), 2)[2:-1], pickle.dumps(shape, 2)[2:-1]))
    behaves(lambda: read_flame(path), tmp_path)


# Captures


def capture_with(root, change):
    """A mesh capture whose first training frame and top level were changed."""
    factory.write_mesh_capture(root, (0, 1), (0, 1))
    factory.edit(root / "transforms_train.json", change)
    return root


FRAME_VALUES = {
    "path of nul": {"file_path": "a\0b.png"},
    "half a character": {"mesh_path": "\ud800.obj"},
    "long path": {"file_path": "x" * 5000 + ".png"},
    "deep path": {"mesh_path": "a/" * 5000},
    "home": {"fg_mask_path": "~/x.png"},
    "path of a folder": {"file_path": "."},
    "path of paths": {"file_path": ["x" * 700_000]},
    "huge focal length": {"fl_x": 10**400},
    "far focal length": {"fl_x": 1e30},
    "no focal length": {"fl_x": 1e-30},
    "no angle": {"fl_x": None, "camera_angle_x": 5e-324},
    "size of gigapixels": {"w": 10**6, "h": 10**6},
    "far centre": {"cy": -1e30},
    "huge timestep": {"timestep_index": 10**400},
    "far timestep": {"timestep_index": 10**15},
    "huge matrix": {"transform_matrix": [[10**400] * 4] * 4},
    "matrix of lists": {"transform_matrix": [[[]] * 4] * 4},
    "camera of lists": {"camera_id": [[["x"]]], "camera_index": None},
}


@pytest.mark.parametrize("name", FRAME_VALUES)
def test_frames(tmp_path, name):
    """Catches valid JSON that is nonsense: numbers beyond floats, paths beyond names."""
    change = FRAME_VALUES[name]
    root = capture_with(tmp_path / "capture", lambda document: document["frames"][0].update(change))
    message = behaves(lambda: summarize_capture(open_capture(root)), tmp_path)
    assert name in ("far timestep", "camera of lists") or "transforms_train.json: " in message


@pytest.mark.parametrize("key", ["canonical_mesh_path", "regions_path"])
@pytest.mark.parametrize(
    "value", ["a\0b", "\ud800.obj", "x" * 5000 + ".obj", "../..", "/etc/passwd", ["a"]]
)
def test_files_of_the_top_level(tmp_path, key, value):
    """Catches the same in the paths that are not a frame's."""
    root = capture_with(tmp_path / "capture", lambda document: document.update({key: value}))
    assert behaves(lambda: open_capture(root), tmp_path)


def test_view_names_hold_no_backslashes(tmp_path):
    """Catches a rendering, named after its view, written outside its folder on Windows, where these
    are paths."""
    change = {"file_path": "a\\..\\images\\00000_00.png"}
    root = capture_with(tmp_path / "capture", lambda document: document["frames"][0].update(change))
    assert "\\" not in open_capture(root).views["train"][0].name


# Wrong in one field, which the message names


def rewritten(path, change):
    """change: (old, new) text; new values of an npz's arrays, None removes one; of a JSON object,
    or of the second of its frames."""
    if isinstance(change, tuple):
        rewrite(path, change)
    elif path.suffix == ".json":
        document = read_json(path)
        document["frames"][1].update(change)
        path.write_text(json.dumps(document))
    else:
        arrays = {**np.load(path, allow_pickle=True), **change}
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})


WRONG_ARRAYS = r"""
# landmarks
points: 0.0 in 4 × 3
    points has shape \(4, 3\), expected \(4, any, 2\)
points: "x" in 4 × 6 × 2
    points holds <U1, expected floating-point numbers
points: 1e300 in 4 × 6 × 2
    points: expected pixels of at most 100000
points: NaN in 4 × 6 × 2
    points: expected finite pixels where confidence is not 0
points: 0.0 in 4 × 7 × 2
    confidence has shape \(4, 6\), expected \(4, 7\)
timesteps: [0, 1, 2, 99]
    timesteps: expected timesteps of camera cam0
confidence: -1.0 in 4 × 6
    confidence: expected numbers from 0 to 1e\+06
confidence: "high" in 4 × 6
    confidence holds <U4, expected numbers
# places
face: -1 in 6
    face: uses 0 landmarks, expected at least 4
face: "x" in 6
    face: expected triangles from 0 to
barycentric: "x" in 6 × 3
    barycentric holds <U1, expected numbers
barycentric: 1.0 in 7 × 3
    barycentric has shape \(7, 3\), expected \(6, 3\)
barycentric: NaN in 6 × 3
    barycentric: expected finite numbers
barycentric: -1.0 in 6 × 3
    barycentric: expected numbers from 0 up
barycentric: 0.5 in 6 × 3
    barycentric: expected rows that add up to 1
# head model npz
identity, expression: none
    neither identity nor expression
faces: [[0, 1, 9]]
    names vertices
mean: [[30, 0, 0], [0, 30, 0], [0, 0, 30], [0, 0, 0]]
    meters
identity: 1.0 in 5 × 3 × 1
    identity has shape
mean: "x" in 4 × 3
    mean holds <U1, expected numbers
mean: [[1e308, 0, 0], [0, -1e308, 0], [0, 0, 1e308], [0, 0, 0]]
    mean reaches 1e\+308
faces: "x" in 1 × 3
    faces is <U1
identity: 1e300 in 4 × 3 × 1
    identity reaches 1e\+300, expected at most 100
expression: NaN in 4 × 3 × 1
    expression holds values that are not finite
weights: -1e300 in 4 × 5
    weights reaches 1e\+300
# flame frame
expr: none
    has no expr
shape: none
    has no shape
rotation: 0.0
    rotation has shape
jaw_pose: 0.0 in 1 × 4
    jaw_pose has shape \(1, 4\), expected \(3,\)
expr: 0.0 in 1 × 5
    expr has shape \(1, 5\), expected \(3,\)
expr: 0.0 in 2 × 3
    expr has shape \(2, 3\)
eyes_pose: Infinity in 1 × 6
    eyes_pose holds values that are not finite
static_offset: 0.0 in 1 × 39 × 3
    static_offset .* expected \(40, 3\)
static_offset: 0.0 in 2 × 40 × 3
    static_offset has shape
shape: "a" in 9
    shape holds
# flame motion
jaw_pose: 0.0 in 2 × 3
    jaw_pose has shape \(2, 3\), expected 4 timesteps first
expr: 0.0 in 3
    expr has shape
eyes_pose: 0.0 in 4 × 5
    eyes_pose has
rotation: NaN in 4 × 3
    rotation holds values that are not finite
shape: Infinity in 9
    shape holds values that are not finite
pose: 0.0 in 4 × 9
    pose .* expected \(timesteps, 6\) or \(timesteps, 15\)
pose: 0.0 in 6
    pose has shape
timesteps: [0, 1]
    timesteps: expected 4 whole numbers
timesteps: [0, 2, 2, 3]
    timesteps: expected 4 whole numbers
timesteps: [0.0, 1.0, 2.0, 3.0]
    timesteps: expected 4 whole numbers
# flame npz
v_template: none
    has no v_template
kintree_table: none
    has no kintree_table
v_template: 0.0 in 6 × 2
    v_template has shape \(6, 2\), expected \(any, 3\)
shapedirs: 0.0 in 5 × 3 × 12
    shapedirs .*expected \(6, 3, any\)
posedirs: 0.0 in 6 × 3 × 27
    posedirs .*expected \(6, 3, 36\)
J_regressor: 0.0 in 4 × 6
    J_regressor .*expected \(5, 6\)
weights: NaN in 6 × 5
    weights holds values that are not finite
masks/nose: [40]
    mask nose
f: 40 in 3 × 3
    f names vertices 40 to 40, expected 0 to 5
f: 0.5 in 3 × 3
    f holds float64, expected whole numbers
kintree_table: [[0, 4, 1, 1, 1], [0, 1, 2, 3, 4]]
    kintree_table names the parents
n_identity: 13
    n_identity is 13, expected one number from 0 to 12
"""
"""Reader; an array of its file, and what is there then: a value in this shape, values, or none;
what is said of it."""


def wrong_arrays(text):
    """The arrays of a row of WRONG_ARRAYS by name."""
    names, given = text.split(": ")
    value, _, shape = given.partition(" in ")
    array = None if value == "none" else np.array(json.loads(value))
    if shape:
        array = np.full([int(size) for size in shape.split(" × ")], array)
    return dict.fromkeys(names.split(", "), array)


FOLDS = "the distortion of its lens folds the image"
WRONG_TEXTS = r"""
# colmap cameras.txt
PINHOLE → EQUIRECTANGULAR
    camera 1: model 'EQUIRECTANGULAR' is not one of
PINHOLE → OPENCV
    camera 1: expected 8 parameters of OPENCV, not 4
50.0 → nan
    line 2: expected finite numbers
1 PINH → {digits} PINH
    {count}
# colmap images.txt
 2 cam1.png →  7 cam1.png
    image 'cam1.png': names camera 7, which .*cameras.txt
 1 cam0.png →
    line 2: expected number, quaternion, translation, camera and name
 1 cam0.png →  {digits} cam0.png
    line 2: {count}
# metashape
</document> →
    is not valid XML
<document → <!DOCTYPE a [<!ENTITY b 'c'>]><document
    declares a document type
<k1> → <k1>1e308</k1><k1>
    {folds}
<b1> → <b1>1e308</b1><b1>
    {folds}
{focal} →
    sensor '0': has no calibration with f
{focal} → <f>wide</f>
    sensor '0': f: expected 1 finite number, not 'wide'
{focal} → <f>0</f>
    sensor '0': f: {wide}
type="frame" → type="spherical"
    sensor '0': type 'spherical' is not one of frame
sensor_id="0" component → sensor_id="3" component
    sensor_id '3' is no sensor of
<p1> → <p3>0.1</p3><p1>
    sensor '0': p3 and p4 are not supported
<transform> → <transform>-
    expected a rotation without|its axes are mirrored
</transform> →  1</transform>
    transform: expected 16 finite numbers, not
# realitycapture csv
{csv} → a.png,1,2
    line 2: expected 16 columns, not 11
{csv} → a.png,1,2,3,0,0,west,18
    line 2: roll: expected 1 finite number, not 'west'
{csv} → a.png,1e308,-1e308,1e308,9,9,9,18
    line 2: expected a camera within 1e\+12
0.1,0.02 → 1e308,-1e308
    line 2: {folds}
{csv} → {long}
    line 2: is not readable CSV
heading → direction
    has no column heading; expected internal and external
# realitycapture xmp
"brown4t2" → "division"
    xcr:DistortionModel 'division' is not one of perspective
</xcr:Rotation> →  1</xcr:Rotation>
    xcr:Rotation: expected 9 finite numbers, not
xcr:FocalLength35mm="24.3765359225552" →
    xcr:FocalLength35mm is missing
24.3765359225552 → long
    xcr:FocalLength35mm: expected 1 finite number, not 'long'
</x:xmpmeta> →
    is not valid XML
24.3765359225552 → 1e-320
    {wide}
24.3765359225552 → 1e308
    {wide}
AspectRatio="1" → AspectRatio="1e308"
    {wide}
-0.0046 → -1e308
    expected a principal point within 1e\+07 pixels
{xmp} → 1e308 -1e308
    {folds}
# regions
[0, 1, 2] → 3
    nose: expected a list of vertex indices from 0 to 11
[0, 1, 2] → ["a"]
    nose: expected a list of vertex indices from 0 to 11
[0, 1, 2] → [-1]
    nose: expected a list of vertex indices from 0 to 11
[0, 1, 2] → [12]
    nose: expected a list of vertex indices from 0 to 11
[0, 1, 2] → [1.5]
    nose: expected a list of vertex indices from 0 to 11
# run
"lattice": null → "lattice": 1000000000
    settings.lattice: expected
"views_per_visit":  → "views_per_visit": -
    settings.views_per_visit: expected
"""
"""Reader; what stands in its file and what is written there; what is said of it."""
NAMES_OF_TEXTS = {
    "digits": "9" * 5000,
    "long": "a" * 200_000,
    "csv": "cam0.png,1,2,3,10,20,30,24.3",
    "xmp": test_calibrations.XMP_COEFFICIENTS,
    "focal": f"<f>{test_calibrations.INTRINSICS['f']}</f>",
    "folds": FOLDS,
    "wide": "expected a focal length of 1 to 1e7",
    "count": "expected a whole number, not '999",
}
WRONG = {
    "nerfstudio": [
        ({"k1": "much"}, r"frames\[1\].k1: expected a finite number, not 'much'"),
        ({"camera_model": "WIDE"}, r"frames\[1\].camera_model: 'WIDE' is not one of"),
        ({"k1": -40.0}, FOLDS),
        ({"k1": 1e308, "k2": -1e308}, FOLDS),
        ({"cx": 1e6}, FOLDS),
        ({"k1": 10**400}, r"frames\[1\].k1: expected a finite number"),
        ({"mask_path": "../../x"}, r"frames\[1\].mask_path: '../../x' leads outside"),
    ],
    "head model npz": [
        ({"identity": np.full((4, 3, 1), np.longdouble("1e4000"))}, "identity holds .* not finite")
    ],
}
for reader, rows in re.findall(r"# (.*)\n([^#]*)", WRONG_TEXTS):
    for row in re.findall(r"^(.*) →(?: (.*))?\n    (.*)$", rows, re.MULTILINE):
        old, new, message = (part.format(**NAMES_OF_TEXTS) for part in row)
        WRONG.setdefault(reader, []).append(((old, new), message))
for reader, rows in re.findall(r"# (.*)\n([^#]*)", WRONG_ARRAYS):
    for array, message in re.findall(r"^(\S.*)\n    (.*)$", rows, re.MULTILINE):
        WRONG.setdefault(reader, []).append((wrong_arrays(array), message))


@pytest.mark.parametrize(
    ("reader", "change", "message"),
    [(reader, *row) for reader, rows in WRONG.items() for row in rows],
)
def test_wrong_fields_are_named(tmp_path, reader, change, message):
    """Catches a file that is read as something else, and a message without file and field."""
    target = TARGETS[reader]
    path = tmp_path / target.name
    target.write(path)
    rewritten(path, change)
    found = behaves(lambda: target.read(path), tmp_path)
    assert re.search(f"{path.name}: .*({message})", found), found


# Runs


META_VALUES = """
iteration -2, 1.5, 10000000000000000000000000000000000000000, true
visit "5"
last_timestep 1.5, [1]
elapsed_s null, NaN, true
lines -1, 1.5
tracking_gain 1, []
evaluations null
losses [null], [NaN], {"a": 1}, 7
initial_count "x"
"""
"""Count or other value of a checkpoint, and what it cannot be."""


def test_checkpoints_of_wrong_kinds(tmp_path):
    """Catches a checkpoint that loads and then fails, or trains for ever, in the middle of the
    resumed run."""
    checkpoints.write_checkpoint(tmp_path, make_checkpoint())
    arrays = read_npz(tmp_path / "checkpoint.npz")
    meta = json.loads(arrays["meta"].tobytes())
    texts = ['"text"', "3", "[]", "[" * 100_000, "null"]
    for key, values in re.findall(r"(\w+) (.*)", META_VALUES):
        texts += [json.dumps({**meta, key: value}) for value in json.loads(f"[{values}]")]
    assert len(texts) > 20
    for text in texts:
        changed = {**arrays, "meta": np.frombuffer(text.encode(), np.uint8)}
        np.savez(tmp_path / "checkpoint.npz", **changed)
        message = behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)
        assert "checkpoint.npz: " in message, text


@pytest.mark.parametrize("part", ["parameters", "first", "second"])
def test_checkpoints_whose_values_train_nothing(tmp_path, part):
    """Catches a broken number that a resumed run would keep for ever, and spherical harmonics of no
    degree, which the kernels would read past their end."""
    for value in (float("nan"), float("inf")):
        checkpoint = make_checkpoint()
        getattr(checkpoint.state, part).opacity[3] = value
        checkpoints.write_checkpoint(tmp_path, checkpoint)
        message = behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)
        assert f"{part}/opacity holds a value that is not finite" in message
    checkpoint = make_checkpoint()
    sh = np.zeros((len(checkpoint.state), 7, 3), np.float32)
    for each in ("parameters", "gradients", "first", "second"):
        setattr(checkpoint.state, each, getattr(checkpoint.state, each)._replace(sh=sh))
    checkpoints.write_checkpoint(tmp_path, checkpoint)
    assert "7 coefficients" in behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)


@pytest.mark.parametrize("name", ["²", "९", "-1", "9" * 5000, "", "1.5"])
def test_selections_of_odd_timesteps(tmp_path, name):
    """Catches names that Python calls digits and cannot turn into a number."""
    np.savez(tmp_path / "selection.npz", **{name: np.ones(5, bool)})
    message = behaves(lambda: checkpoints.read_selection(tmp_path, 5), tmp_path)
    assert "९" in message if name == "९" else message
