"""Files made to break readers, beyond those of each reader's own tests: lies about size, impossible
values.

Every case either loads or raises StgaError, in under a second and 200 MB, executes nothing and
writes nothing.
"""

import json
import os
import pickle
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture import factory
from training.test_folder import make_checkpoint, make_run

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image
from stga_addon.capture.meshes import read_mesh, read_regions
from stga_addon.capture.model import View, summarize_capture
from stga_addon.capture.open import open_capture, read_face_ids, read_soup
from stga_addon.capture.transforms import read_transforms
from stga_addon.export.ply import read_ply
from stga_addon.files import read_json, read_npz
from stga_addon.flame.model import read_flame
from stga_addon.flame.unpickle import read_pickled_arrays
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import folder as run_folder
from stga_addon.training.run import metrics_log

from .limits import GIGA, behaves


def npy(descr: Any = "<f4", shape: Any = (GIGA,), data: bytes = b"", header: str = "") -> bytes:
    """A npy file that says what it likes about its content."""
    text = header or repr({"descr": descr, "fortran_order": False, "shape": shape})
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n" + data


def archive(path: Path, entries: dict[str, bytes], packing: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", packing) as out:
        for name, content in entries.items():
            out.writestr(name, content)
    return path


LYING_ARRAYS = {
    "gigabytes promised": npy(), "product wraps around": npy(shape=(2**32, 2**32)),
    "beyond 64 bits": npy(shape=(10**30,)), "negative": npy(shape=(-1, 3)), "true": npy(shape=(True,), data=bytes(4)),
    "no size": npy("|V0", (10**12,)), "one huge string": npy("<U1000000000", (1,)),
    "objects": npy("|O", (1,), pickle.dumps([1])), "nested type": npy([("a", "<f4", (10**6, 10**6))], (1,)),
    "type of itself": npy([("a", [("b", "O")])], (1,)), "half a header": b"\x93NUMPY\x01\x00\xff\xff{",
    "header of gigabytes": b"\x93NUMPY\x02\x00\xff\xff\xff\xff{",
    "header cut in a string": npy(header="{'descr': '''<f4"), "header of brackets": npy(header="[" * 5000),
    "header of minus signs": npy(header="-" * 9000 + "1"), "header of a number": npy(header="9" * 9000),
    "header runs code": npy(header="{'descr': __import__('os').system('touch witness')}"),
    "format 9": b"\x93NUMPY\x09\x00" + npy()[8:], "trailing bytes": npy(shape=(1,), data=bytes(8)),
}  # fmt: skip


@pytest.mark.parametrize("lie", LYING_ARRAYS)
def test_arrays_that_lie(tmp_path: Path, lie: str) -> None:
    """Catches memory allocated on the word of a header, and header parsers that fail with errors of
    their own."""
    path = archive(tmp_path / "a.npz", {"a.npy": LYING_ARRAYS[lie]})
    assert "a.npz: is not a readable npz" in behaves(lambda: read_npz(path), tmp_path)
    path = tmp_path / "a.npy"
    path.write_bytes(LYING_ARRAYS[lie])
    assert "a.npy: is not a readable npy" in behaves(lambda: read_face_ids(path, 5), tmp_path)


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
def test_damaged_packing(tmp_path: Path, packing: int) -> None:
    """Catches each decompressor's own exceptions."""
    path = archive(tmp_path / "a.npz", {"a.npy": npy(shape=(9,), data=bytes(range(36)))}, packing)
    whole = path.read_bytes()
    for position in range(30, 120):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        behaves(lambda: read_npz(path), tmp_path)


def test_names_that_lead_outside(tmp_path: Path) -> None:
    """Catches an archive unpacked to disk by the names that its entries have."""
    inner = tmp_path / "inner"
    inner.mkdir()
    path = archive(
        inner / "a.npz", {"../outside.npy": npy(shape=(1,), data=bytes(4)), "/tmp/x.npy": b""}
    )
    behaves(lambda: read_npz(path), inner)


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "json": ("a.json", read_json), "npz": ("a.npz", read_npz), "npy": ("a.npy", lambda path: read_face_ids(path, 5)),
    "transforms": ("transforms.json", read_transforms), "soup": ("a.json", read_soup),
    "regions": ("regions.json", lambda path: read_regions(path, np.zeros((1, 3), int), 3)),
    "obj": ("a.obj", read_mesh), "ply mesh": ("a.ply", read_mesh), "glb": ("a.glb", read_mesh),
    "splats": ("a.ply", read_ply), "avatar": ("a.npz", read_avatar), "flame pickle": ("a.pkl", read_flame),
    "flame npz": ("a.npz", read_flame), "masks": ("a.pkl", read_pickled_arrays),
    "run": ("run.json", lambda path: run_folder.read_run(path.parent)),
    "checkpoint": ("checkpoint.npz", lambda path: checkpoints.read_checkpoint(path.parent)),
    "selection": ("selection.npz", lambda path: checkpoints.read_selection(path.parent, 5)),
    "metrics": ("metrics.jsonl", lambda path: metrics_log.read_metrics(path.parent)),
    "image": ("a.png", lambda path: read_image(view_of(path, 4, 4))),
}  # fmt: skip


def view_of(path: Path, width: int, height: int) -> View:
    return View(0, 0, Camera(width, height, 10.0, 10.0, 2.0, 2.0, np.eye(4)), path.name, path)


@pytest.mark.skipif(
    sys.platform == "win32", reason="needs links, pipes and devices of a POSIX system"
)
@pytest.mark.parametrize("make", [link_to_itself, pipe, device, Path.mkdir])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file(tmp_path: Path, reader: str, make: Callable[[Path], None]) -> None:
    """Catches readers that wait for ever on a pipe, fill the memory from a device, or trip over a
    link to itself."""
    name, read = READERS[reader]
    make(tmp_path / name)
    message = behaves(lambda: read(tmp_path / name), tmp_path)
    assert message or (reader == "metrics" and make is link_to_itself)


@pytest.mark.parametrize(
    "reader",
    [name for name in READERS if name not in ("run", "checkpoint", "selection", "metrics")],
)
@pytest.mark.parametrize("stem", ["nul\0byte", "\ud800", "x" * 5000])
def test_names_no_file_can_have(tmp_path: Path, reader: str, stem: str) -> None:
    """Catches ValueError and UnicodeEncodeError from names that a capture's JSON may hold."""
    name, read = READERS[reader]
    assert behaves(lambda: read(tmp_path / (stem + name)), tmp_path)


JUNK = {
    "empty": b"", "zeros": bytes(10_000), "not utf-8": b'{"format": "\xff\xfe"}',
    "utf-16": '{"a": 1}'.encode("utf-16"), "byte order mark": b"\xef\xbb\xbf{}", "brackets": b"[" * 100_000,
    "objects": b'{"a":' * 100_000, "digits": b"9" * 100_000, "nan": b"NaN", "string": b'"text"',
    "zip": b"PK\x05\x06" + bytes(18),
    "zip of millions": b"PK\x05\x06" + struct.pack("<4H2LH", 0, 0, 65535, 65535, 2**31, 0, 0),
    "pickle": pickle.dumps({"a": 1}),
}  # fmt: skip


@pytest.mark.parametrize("junk", JUNK)
@pytest.mark.parametrize("reader", READERS)
def test_junk(tmp_path: Path, reader: str, junk: str) -> None:
    """Catches a reader that trusts a file because of its name."""
    name, read = READERS[reader]
    (tmp_path / name).write_bytes(JUNK[junk])
    behaves(lambda: read(tmp_path / name), tmp_path)


# Captures


def capture_with(root: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A mesh capture whose first training frame and top level were changed."""
    factory.write_mesh_capture(root, (0, 1), (0, 1))
    factory.edit(root / "transforms_train.json", change)
    return root


FRAME_VALUES: dict[str, Any] = {
    "path of nul": {"file_path": "a\0b.png"}, "path of half a character": {"mesh_path": "\ud800.obj"},
    "long path": {"file_path": "x" * 5000 + ".png"}, "deep path": {"mesh_path": "a/" * 5000 + "x.obj"},
    "path out": {"mesh_path": "../../../etc/passwd"},
    "path out by backslashes": {"file_path": "a\\..\\..\\..\\x.png"},
    "absolute path": {"fg_mask_path": "/etc/passwd"}, "home": {"fg_mask_path": "~/x.png"},
    "path of a folder": {"file_path": "."}, "drive": {"file_path": "C:\\x.png"},
    "huge focal length": {"fl_x": 10**400}, "huge size": {"w": 10**400},
    "size of gigapixels": {"w": 10**6, "h": 10**6}, "huge centre": {"cx": 10**400},
    "huge timestep": {"timestep_index": 10**400}, "far timestep": {"timestep_index": 10**15},
    "huge camera": {"camera_index": 10**400}, "huge matrix": {"transform_matrix": [[10**400] * 4] * 4},
    "matrix of lists": {"transform_matrix": [[[]] * 4] * 4}, "matrix of text": {"transform_matrix": [["1"] * 4] * 4},
    "number as text": {"fl_x": "200"}, "number as list": {"w": [40]}, "true": {"timestep_index": True},
    "camera of lists": {"camera_id": [[["x"]]], "camera_index": None},
}  # fmt: skip


@pytest.mark.parametrize("name", FRAME_VALUES)
def test_frames(tmp_path: Path, name: str) -> None:
    """Catches values that are valid JSON and nonsense: numbers beyond floats, paths beyond names,
    jumps in time."""
    root = capture_with(
        tmp_path / "capture", lambda document: document["frames"][0].update(FRAME_VALUES[name])
    )
    behaves(lambda: summarize_capture(open_capture(root)), tmp_path)


@pytest.mark.parametrize("key", ["canonical_mesh_path", "regions_path"])
@pytest.mark.parametrize(
    "value", ["a\0b", "\ud800.obj", "x" * 5000 + ".obj", "../..", "/etc/passwd", ".", 3, ["a"]]
)
def test_files_of_the_top_level(tmp_path: Path, key: str, value: Any) -> None:
    """Catches the same in the paths that are not a frame's."""
    root = capture_with(tmp_path / "capture", lambda document: document.update({key: value}))
    assert behaves(lambda: open_capture(root), tmp_path)


@pytest.mark.parametrize(
    "name", ["images/00000_00.png", "meshes/00000.obj", "meshes/neutral.obj", "regions.json"]
)
def test_pipes_in_a_capture(tmp_path: Path, name: str) -> None:
    """Catches a capture that is never opened because it waits for a pipe."""
    root = factory.write_mesh_capture(tmp_path / "capture", (0, 1), (0, 1))
    (root / name).unlink()
    pipe(root / name)
    assert name in behaves(lambda: open_capture(root), tmp_path)


def test_view_names_hold_no_backslashes(tmp_path: Path) -> None:
    """Catches a rendering, named after its view, written outside its folder on Windows, where these
    are paths."""
    change = {"file_path": "a\\..\\images\\00000_00.png"}
    root = capture_with(tmp_path / "capture", lambda document: document["frames"][0].update(change))
    assert "\\" not in open_capture(root).views["train"][0].name


# Splats


@pytest.mark.parametrize("count", ["1000000000", "9" * 30, "1e9", "-1", "1_0", "0"])
@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_splats_of_absurd_number(tmp_path: Path, count: str, layout: str) -> None:
    """Catches memory allocated for a billion splats that the file does not have."""
    path = tmp_path / "a.ply"
    path.write_text(
        f"ply\nformat {layout} 1.0\nelement vertex {count}\nproperty float x\nend_header\n0 0 0\n"
    )
    assert behaves(lambda: read_ply(path), tmp_path)


# Runs


META_VALUES: dict[str, Any] = {
    "iteration": ["5", -2, 1.5, None, 10**40, True], "visit": ["5", None], "last_timestep": ["5", 1.5, [1]],
    "elapsed_s": ["5", None, float("nan"), [], True], "best_difference": ["5", None, float("nan")],
    "losses": ["5", None, [None], ["a"], [float("nan")], {"a": 1}, 7], "evaluations": [None, "x"],
    "initial_count": [None, "x"],
}  # fmt: skip


@pytest.mark.parametrize("key", META_VALUES)
def test_checkpoints_of_wrong_kinds(tmp_path: Path, key: str) -> None:
    """Catches a checkpoint that loads and then fails, or trains for ever, in the middle of the
    resumed run."""
    checkpoints.write_checkpoint(tmp_path, make_checkpoint())
    arrays = read_npz(tmp_path / "checkpoint.npz")
    for value in META_VALUES[key]:
        meta = {**json.loads(arrays["meta"].tobytes()), key: value}
        np.savez(
            tmp_path / "checkpoint.npz",
            **{**arrays, "meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)},
        )
        message = behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)
        assert "checkpoint.npz: " in message, (key, value)


@pytest.mark.parametrize("text", ['"text"', "3", "[]", "[" * 100_000, "null"])
def test_meta_that_is_no_object(tmp_path: Path, text: str) -> None:
    """Catches AttributeError and RecursionError where the header of a checkpoint is other JSON than
    an object."""
    checkpoints.write_checkpoint(tmp_path, make_checkpoint())
    arrays = {
        **read_npz(tmp_path / "checkpoint.npz"),
        "meta": np.frombuffer(text.encode(), np.uint8),
    }
    np.savez(tmp_path / "checkpoint.npz", **arrays)
    assert "checkpoint.npz: " in behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["parameters", "first", "second"])
def test_checkpoints_that_are_not_finite(tmp_path: Path, part: str, value: float) -> None:
    """Catches a broken number that a resumed run would keep for ever."""
    checkpoint = make_checkpoint()
    getattr(checkpoint.state, part).opacity[3] = value
    checkpoints.write_checkpoint(tmp_path, checkpoint)
    assert f"{part}/opacity holds a value that is not finite" in behaves(
        lambda: checkpoints.read_checkpoint(tmp_path), tmp_path
    )


def test_a_checkpoint_of_an_odd_number_of_coefficients(tmp_path: Path) -> None:
    """Catches spherical harmonics of no degree, which the kernels would read past their end."""
    checkpoint = make_checkpoint()
    for part in ("parameters", "gradients", "first", "second"):
        old = getattr(checkpoint.state, part)
        setattr(
            checkpoint.state,
            part,
            old._replace(sh=np.zeros((len(checkpoint.state), 7, 3), np.float32)),
        )
    checkpoints.write_checkpoint(tmp_path, checkpoint)
    assert "7 coefficients" in behaves(lambda: checkpoints.read_checkpoint(tmp_path), tmp_path)


@pytest.mark.parametrize("name", ["²", "९", "-1", "9" * 5000, "", "1.5"])
def test_selections_of_odd_timesteps(tmp_path: Path, name: str) -> None:
    """Catches names that Python calls digits and cannot turn into a number."""
    np.savez(tmp_path / "selection.npz", **{name: np.ones(5, bool)})
    if name == "९":
        assert "९" in behaves(lambda: checkpoints.read_selection(tmp_path, 5), tmp_path)
    else:
        assert behaves(lambda: checkpoints.read_selection(tmp_path, 5), tmp_path)


@pytest.mark.parametrize(
    "change", [{"lattice": 10**9}, {"views_per_visit": -1}, {"sh_steps": [[]]}], ids=repr
)
def test_runs_with_impossible_settings(tmp_path: Path, change: dict[str, Any]) -> None:
    """Catches a run.json whose numbers would fill the memory, read past an array's end or train for
    ever."""
    run_folder.write_run(tmp_path, make_run())
    document = json.loads((tmp_path / "run.json").read_text())
    document["settings"].update(change)
    (tmp_path / "run.json").write_text(json.dumps(document))
    assert "run.json: " in behaves(lambda: run_folder.read_run(tmp_path), tmp_path)


METRICS = [b"\xff\xff\n", b"\0" * 100, b"[" * 100_000, b'{"iteration": 20, "sec']
LINE = {"seconds": 1.0, "splats": 80, "evaluation_s": 0.1, "wall_s": 1.0}


@pytest.mark.parametrize("damage", METRICS)
def test_metrics_after_a_power_cut(tmp_path: Path, damage: bytes) -> None:
    """Catches a run that cannot be resumed because of a line of its log: what was whole before it
    stays."""
    metrics_log.append_metrics(tmp_path, {"iteration": 10, **LINE})
    with (tmp_path / "metrics.jsonl").open("ab") as out:
        out.write(damage)
    assert not behaves(lambda: metrics_log.read_metrics(tmp_path), tmp_path)
    assert metrics_log.read_metrics(tmp_path) == [{"iteration": 10, **LINE}]
    metrics_log.cut_metrics(tmp_path, 20)
    metrics_log.append_metrics(tmp_path, {"iteration": 20, **LINE})
    assert [line["iteration"] for line in metrics_log.read_metrics(tmp_path)] == [10, 20]
