"""Atomic file writes and bounded reads."""

import errno
import json
import os
import re
import stat
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon import files
from stga_addon.errors import StgaError
from stga_addon.files import (
    NumberedFiles,
    check_writable,
    read_json,
    read_npz,
    read_table,
    replacing,
    replacing_together,
    temporary_folder,
    write_json,
    write_npz,
)


def write_half(path):
    with replacing(path) as partial:
        partial.write_text("half of t")
        raise RuntimeError("mine")


def test_replacing_is_all_or_nothing(tmp_path):
    """Catches a half-written file under the final name, and temporary files left behind."""
    path = tmp_path / "new" / "file.txt"
    with replacing(path) as partial:
        partial.write_text("one")
        assert not path.exists()
    assert path.read_text() == "one"
    with pytest.raises(RuntimeError, match="mine"):
        write_half(path)
    assert path.read_text() == "one"
    assert os.listdir(path.parent) == ["file.txt"]
    with replacing(path) as partial:
        partial.write_text("two")
        assert path.read_text() == "one"
    assert path.read_text() == "two"
    assert os.listdir(path.parent) == ["file.txt"]


UNWRITABLE = (
    "file/a.json",
    "file/inner/a.json",
    "folder",
    "pipe",
    ".",
    "/",
    "x" * 256,
    "y" * 5000,
    "a\0",
    "\ud800",
)


@pytest.mark.parametrize("name", UNWRITABLE)
def test_unwritable_paths(tmp_path, name):
    """Catches a traceback, a device replaced by a file, and a path refused after the work."""
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder" / "inner").mkdir(parents=True)
    os.mkfifo(tmp_path / "pipe")
    path = Path(name) if name in ("/", ".") else tmp_path / name
    with refusal("cannot be written"):
        write_json(path, {})
    with refusal("cannot be written"):
        check_writable(path)
    for writable in ("new/inner/video.mp4", "video.mp4", "file", "x" * 255, "x" + "é" * 127):
        check_writable(tmp_path / writable)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder", "pipe"]
    assert (tmp_path / "file").read_text() == "x"


@pytest.mark.parametrize("content", [b"", b"hello", b"\xff\xfe{}", b"[" * 200_000, b'{"a": 1'])
def test_json(tmp_path, content):
    """Catches a traceback, a crash by deep nesting, a message that does not name the file, and an
    encoding that depends on the system."""
    value = {"name": "Grüße", "list": [1, 2.5, None, True], "nested": {"a": "b"}}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == value
    (tmp_path / "a.json").write_bytes(json.dumps(value, ensure_ascii=False).encode())
    assert read_json(tmp_path / "a.json") == value
    (tmp_path / "a.json").write_bytes(content)
    with refusal(r"a\.json: is not valid JSON"):
        read_json(tmp_path / "a.json")
    for read in (read_json, read_npz):
        with refusal(rf"{tmp_path / 'none'}: cannot be read"):
            read(tmp_path / "none")


@pytest.mark.parametrize(
    "text", ["[" + "[]," * 60 + "0]", "[" + '{"":0},' * 60 + "0]", "1,\n" * 60]
)
def test_more_values_than_any_file_holds(tmp_path, monkeypatch, text):
    """Catches gigabytes of lists, dictionaries or rows that a file of some megabytes is parsed
    to."""
    path = tmp_path / "a.json"
    path.write_text(text)
    read = read_table if "\n" in text else read_json
    assert read(path)
    monkeypatch.setattr(files, "MAX_TEXT_VALUES", 100)
    with refusal(r"a\.json: holds about \d+ values, more than the 100 allowed"):
        read(path)


@pytest.mark.parametrize("compressed", [False, True])
def test_npz_round_trip(tmp_path, compressed):
    """Catches a suffix that numpy adds, and arrays that change their type or shape."""
    arrays = {"a": np.arange(6, dtype=np.int32).reshape(2, 3), "b/c": np.array([True, False])}
    arrays["d"] = np.float64(3)
    write_npz(tmp_path / "file.part", arrays, compressed)
    again = read_npz(tmp_path / "file.part")
    assert os.listdir(tmp_path) == ["file.part"]
    assert set(again) == set(arrays)
    for name, array in arrays.items():
        assert_array_equal(again[name], array)
        assert again[name].dtype == np.asarray(array).dtype


def test_flipped_bits(tmp_path):
    """Catches damaged content that is read as if it were valid."""
    path = tmp_path / "a.npz"
    expected = np.random.default_rng(0).random(50)
    np.savez_compressed(path, a=expected)
    whole = path.read_bytes()
    refused = 0
    for position in np.random.default_rng(1).integers(0, len(whole), 60):
        damaged = bytearray(whole)
        damaged[position] ^= 0x55
        path.write_bytes(damaged)
        try:
            assert_array_equal(read_npz(path)["a"], expected)
        except (StgaError, KeyError):  # KeyError: the name itself was hit
            refused += 1
    assert refused > 30


def test_hostile_npz(tmp_path):
    """Catches a small archive of oversized arrays, arrays counted that are not read, and bytes that
    a reader would make numbers of eight bytes of."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(100_000), b=np.zeros(10))
    assert path.stat().st_size < 10_000
    with refusal(r"unpacks to \d+ bytes, more than the 100000 allowed"):
        read_npz(path, limit=100_000)
    assert list(read_npz(path, ("b",), limit=100_000)) == ["b"]
    np.savez_compressed(path, a=np.zeros(120 << 20, np.int8))
    with refusal("unpacks to"):
        read_npz(path)


KILLED = """
import os, signal, sys
from pathlib import Path
from stga_addon.files import replacing
with replacing(Path(sys.argv[1])) as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
WRITE = """
import sys; from pathlib import Path; from stga_addon.files import write_json
write_json(Path(sys.argv[1]), 1)
"""


def run(code, path):
    return subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_leftovers_of_killed_processes_are_removed(tmp_path):
    """Catches temporary files that stay after kill -9, and living processes' removed."""
    other_host = ".a.json.00000000-4194304-00000000.partial"
    kept = {".notes.partial", ".a.json.123.partial", other_host, "a.json.partial"}
    for name in kept:
        (tmp_path / name).touch()
    assert run(KILLED, tmp_path / "a.json") == -9
    (leftover,) = {path.name for path in tmp_path.iterdir()} - kept
    assert files.PARTIAL_NAME.fullmatch(leftover)
    with replacing(tmp_path / "b.json") as partial:
        partial.write_text("mine")
        assert run(WRITE, tmp_path / "a.json") == 0
        assert {path.name for path in tmp_path.iterdir()} == {*kept, "a.json", partial.name}
    assert {path.name for path in tmp_path.iterdir()} == {*kept, "a.json", "b.json"}
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    long_name = tmp_path / ("é" * 127)
    with temporary_folder(tmp_path / "out", "x") as own, replacing(long_name) as partial:
        for name in (own.name, partial.name):
            of_other = name.replace(f"-{os.getpid()}-", f"-{process.pid}-")
            left = tmp_path / "out" / of_other.replace("ééé", "é", 1)  # its number may be longer
            (left / "inner").mkdir(parents=True)
        with temporary_folder(tmp_path / "out", "x") as other:
            assert set((tmp_path / "out").iterdir()) == {own, other}
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.skipif(os.name == "nt", reason="symbolic links need privileges")
def test_temporary_name_is_new(tmp_path, monkeypatch):
    """Catches a predictable temporary name, a link under it that is followed, and lost rights."""
    names = set()
    for _ in range(2):
        with replacing(tmp_path / "a.json") as partial:
            names.add(partial.name)
    assert len(names) == 2
    monkeypatch.setattr(files.secrets, "token_hex", lambda size: "00000000")
    with replacing(tmp_path / "a.json") as partial:
        pass
    (tmp_path / "target").write_text("mine")
    partial.symlink_to(tmp_path / "target")
    with refusal(r"a\.json: cannot be written"):
        write_json(tmp_path / "a.json", {})
    assert (tmp_path / "target").read_text() == "mine"
    monkeypatch.undo()
    before = os.umask(0o027)
    try:
        write_json(tmp_path / "b.json", {})
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "b.json").stat().st_mode) == 0o640


def refused(times, winerror):
    """An os.replace that fails `times` times as Windows does (None: as POSIX does), and the number
    of its calls."""
    calls = []
    replace = os.replace

    def fake(source, target):
        calls.append(target)
        if len(calls) <= times:
            error = PermissionError(13, "Permission denied")
            if winerror is not None:
                error.winerror = winerror
            raise error
        replace(source, target)

    return fake, calls


@pytest.mark.parametrize(
    ("winerror", "times", "patience", "most_calls"),
    [
        (5, 3, (), 4),
        (32, 3, (), 4),
        (32, 10**6, (0.25,), 4),
        (32, 10**6, (0.0,), 1),
        (None, 10**6, (60.0,), 1),
    ],
)
def test_a_file_that_another_program_has_open(
    winerror, times, patience, most_calls, tmp_path, monkeypatch
):
    """Catches hours of training that end as a virus scanner reads the last avatar, a wait without
    end, one on a system where waiting does not help, and a traceback at its end."""
    write_json(tmp_path / "a.json", 1)
    fake, calls = refused(times, winerror)
    monkeypatch.setattr(files.os, "replace", fake)
    begin = time.monotonic()
    sentence = r"a\.json: cannot be written \(Permission denied\)"
    with refusal(sentence) if patience else nullcontext():
        write_json(tmp_path / "a.json", 2, *patience)
    assert time.monotonic() - begin < 10
    assert read_json(tmp_path / "a.json") == (1 if patience else 2)
    assert (1 if patience else 4) <= len(calls) <= most_calls
    assert os.listdir(tmp_path) == ["a.json"]


def write_half_a_pair(folder):
    with replacing_together() as new_file:
        with new_file(folder / "a.json") as partial:
            partial.write_text("2")
        with new_file(folder / "b.json"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_files_that_appear_together(tmp_path):
    """Catches one file of a pair without the other, the folder made for them that stays, and
    others' files gone."""
    (tmp_path / "old").mkdir()
    write_json(tmp_path / "old/a.json", 1)
    for folder in ("old", "new/inner"):
        with refusal(r"b\.json: cannot be written \(No space"):
            write_half_a_pair(tmp_path / folder)
        assert {path.name for path in tmp_path.rglob("*")} == {"old", "a.json"}
        assert read_json(tmp_path / "old/a.json") == 1
    with replacing_together() as new_file:
        for name in ("a.json", "b.json"):
            with new_file(tmp_path / "old" / name) as partial:
                partial.write_text("2")
        assert not (tmp_path / "old/b.json").exists()
    found = {path.name: read_json(path) for path in (tmp_path / "old").iterdir()}
    assert found == {"a.json": 2, "b.json": 2}


def write_together(folder, *names):
    with replacing_together() as new_file:
        for name in names:
            with new_file(folder / name) as content:
                content.write_text("2")


@pytest.mark.parametrize("links", [True, False])
def test_a_rename_that_fails_among_others(tmp_path, monkeypatch, links):
    """Catches files of two results side by side, earlier ones lost, and temporary files left."""
    for name in ("a.json", "b.json"):
        write_json(tmp_path / name, 1)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    replace = os.replace

    def fails_for_c(source, target):
        if Path(target).name == "c.json":
            raise PermissionError(13, "Permission denied")
        replace(source, target)

    def no_link(source, target):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(files.os, "replace", fails_for_c)
    if not links:  # as FAT and some network file systems say
        monkeypatch.setattr(files.os, "link", no_link)
    with refusal(r"c\.json: cannot be written"):
        write_together(tmp_path, "new/x.json", "a.json", "b.json", "c.json")
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    assert [read_json(tmp_path / name) for name in before] == [1, 1]


def test_a_numbered_file_that_somebody_painted_over(tmp_path):
    """Catches a picture lost that was changed in another program since, and has as many bytes as
    the one that was written."""
    names = re.compile(r"\d{4}\.bmp")
    numbered = NumberedFiles(tmp_path, names)
    for name in ("0001.bmp", "0002.bmp"):
        with replacing(tmp_path / name) as content:
            content.write_bytes(b"drawn")
            numbered.add(name, content)
    numbered.finish()
    NumberedFiles(tmp_path, names)  # as they were written, they are replaced
    path = tmp_path / "0002.bmp"
    written = path.stat()
    path.write_bytes(b"edits")
    os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns + 1_000_000_000))
    with refusal(r"holds 0002.bmp, which was not written here"):
        NumberedFiles(tmp_path, names)
    assert path.read_bytes() == b"edits"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32"])
def test_texts_with_a_byte_order_mark(tmp_path, encoding):
    """Catches text of Windows programs that is refused, or read with its mark as a character."""
    mark = "\ufeff" if encoding.endswith("-be") else ""
    (tmp_path / "a.json").write_bytes((mark + '{"ä": 1}').encode(encoding))
    assert read_json(tmp_path / "a.json") == {"ä": 1}
