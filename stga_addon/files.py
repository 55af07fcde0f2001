"""Atomic file writes and bounded reads of JSON, TOML, tables and npz."""

import codecs
import csv
import ctypes
import errno
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
import stat
import time
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache, partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from .errors import StgaError, shorten
from .schema import MAX_NAME_BYTES

MAX_FILE_BYTES = 1 << 30
"""Largest file that is read where its reader sets no limit."""
MAX_JSON_BYTES = 256 << 20
"""Largest JSON file that is read."""
MAX_TOML_BYTES = 16 << 20
"""Largest TOML file that is read."""

MAX_TEXT_VALUES = 12_000_000
"""Values and lines of a JSON file or a table; one takes up to 100 bytes of memory."""
SEPARATORS = ",;\t\n\r[{"
"""Characters that stand before or behind each value."""

PROBED_BYTES = 1 << 10
"""Bytes at the beginning of a file that show a Git LFS pointer or a web page."""
DAMAGE_BYTES = 1 << 20
"""Bytes at the beginning of a file in which changed line ends are looked for."""
WEB_PAGE = re.compile(rb"(<\?xml[^>]*>|<!--.*?-->|\s)*<(!doctype html|html|head|body)\b", re.DOTALL)
"""Beginning of an HTML page, in lower case."""
CHANGED_LINE_ENDS = (
    "was carried over as text, which changed its line ends (CR LF); copy it again as binary"
)
"""What a message says of a binary file whose line ends were changed."""

MAX_ARRAYS_BYTES = 1 << 30
"""Largest sum of the arrays that are read from an npz: an avatar of four million splats."""
MAX_CHECKPOINT_BYTES = 4 << 30
"""The same for a checkpoint, which holds an avatar's arrays three times."""
MIN_UNPACKED_BYTES = 32 << 20
"""Bytes to which any file of packed splats may unpack."""
MAX_UNPACKED_RATIO = 16
"""Largest ratio of unpacked to packed size of larger files; splats reach 3, without harmonics
10."""
MIN_ARRAYS_BYTES = 384 << 20
"""Bytes to which any npz may unpack besides."""
MIN_NUMBER_BYTES = 4
"""Least number of bytes that a number of an npz counts for, because readers convert small ones to
floats."""
BLOCK_BYTES = 1 << 20
"""Bytes of an array that are looked at together."""
PARTIAL_NAME = re.compile(
    r"\..+\.(?P<host>[0-9a-f]{8})-(?P<process>\d{1,10})-[0-9a-f]{8}\.partial", re.DOTALL
)
"""Name of a temporary file: .NAME.HOST-PROCESS-RANDOM.partial"""
RENAME_PATIENCE_S = 5.0
"""Time for which a rename is retried on Windows while another program has the file open."""
RENAME_INTERVAL_S = 0.1
"""Interval of these attempts."""
WINDOWS_SHARING_ERRORS = (5, 32)
"""ERROR_ACCESS_DENIED and ERROR_SHARING_VIOLATION of an open file."""
NO_FILE = (errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL)
"""Errors of the system where no file has a name."""
NewFile = Callable[[Path], AbstractContextManager[Path]]
"""Called with a path, yields a temporary file that is renamed to it (`replacing`)."""
SEQUENCE_FILE = ".stga_sequence"
"""List of the numbered files in a folder (`NumberedFiles`)."""
BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",  # before UTF-16's, with whose mark it begins
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""First bytes of a text -> Python's name of its encoding."""
DELIMITERS = ",;\t"
"""Characters that separate the columns of tables."""
DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*", re.ASCII)
"""Number with a decimal comma, as in tables whose columns another character separates."""

LINES_BEFORE_COLUMNS = 5
"""Comments in which the row of a table's columns is searched."""
_HOST = f"{zlib.crc32(platform.node().encode()):08x}"
"""This computer: those that share a disk cannot see each other's processes."""


@contextmanager
def replacing(path: Path, patience_s: float = RENAME_PATIENCE_S) -> Iterator[Path]:
    """Yield an empty temporary file beside `path`; rename it over `path` when the block succeeds,
    else delete it.

    The first call for a folder also removes what killed processes left there (`remove_leftovers`).
    patience_s: how long the rename is tried again while another program has `path` open, on
    Windows. Raises StgaError where the folder cannot be written, or `path` is a folder or a device.
    """
    with replacing_together(patience_s) as new_file, new_file(path) as content:
        yield content


@contextmanager
def replacing_together(patience_s: float = RENAME_PATIENCE_S) -> Iterator[NewFile]:
    """Yield a function like `replacing` whose files are renamed together when this block succeeds,
    in the order in which they were begun, else all deleted.

    Where a rename fails, the files that were replaced before come back. A failure also removes the
    folders that were made for the files. Raises StgaError as `replacing` does.
    """
    partials: dict[Path, Path] = {}
    made_folders: list[Path] = []

    @contextmanager
    def new_file(path: Path) -> Iterator[Path]:
        if not path.name or (os.path.exists(path) and not os.path.isfile(path)):
            raise StgaError(f"{path}: cannot be written (is not a regular file)")
        with naming(path):
            try:
                if len(os.fsencode(path.name)) > MAX_NAME_BYTES:
                    raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
                partials[path] = path.with_name(temporary_name(path.name))
                missing = [each for each in path.parents if not each.is_dir()]
                for folder in reversed(missing):
                    folder.mkdir(exist_ok=True)
                    made_folders.append(folder)
                _remove_leftovers_once(path.parent)
                # O_EXCL follows no symbolic link
                os.close(os.open(partials[path], os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            except ValueError as error:  # a null character or a lone surrogate
                raise OSError(str(error)) from error
            yield partials[path]
            with partials[path].open("rb+") as written:
                os.fsync(written.fileno())

    try:
        yield new_file
        _confirm.get()()
        _rename_together(partials, patience_s)
    except BaseException:
        for content in partials.values():
            with suppress(OSError, ValueError):  # where it was never created, or is renamed
                content.unlink()
        for folder in reversed(made_folders):
            with suppress(OSError):  # others have written there
                folder.rmdir()
        raise


def _rename_together(partials: Mapping[Path, Path], patience_s: float) -> None:
    """Rename each content to its path; where one fails, what the others replaced comes back."""
    earlier: dict[Path, Path] = {}
    renamed: list[Path] = []
    try:
        for path in partials if len(partials) > 1 else ():
            with naming(path):
                if os.path.lexists(path):
                    earlier[path] = path.with_name(temporary_name(path.name))
                    _keep(path, earlier[path])
        for path, content in partials.items():
            with naming(path):
                _once_free(partial(os.replace, content, path), patience_s)
            renamed.append(path)
    except BaseException:
        for path in renamed:
            with suppress(OSError):
                if path in earlier:
                    os.replace(earlier[path], path)
                else:
                    path.unlink()
        raise
    finally:
        for kept in earlier.values():
            with suppress(OSError):  # it has its name again
                kept.unlink()


def _keep(path: Path, kept: Path) -> None:
    """Give a file a second name; a copy where the file system has no links."""
    try:
        os.link(path, kept)
    except OSError:
        shutil.copy2(path, kept, follow_symlinks=False)


def temporary_name(name: str) -> str:
    """A new name for what lies beside `name`, of which it has as much as fits; what a killed
    process leaves under it, `remove_leftovers` removes."""
    end = f".{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.partial"
    while len(os.fsencode(f".{name}{end}")) > MAX_NAME_BYTES:
        name = name[:-1]
    return f".{name}{end}"


@contextmanager
def temporary_folder(parent: Path, name: str) -> Iterator[Path]:
    """Yield an empty folder in `parent`, which is made, for what is there until the block ends;
    those of killed processes are removed. Raises StgaError where there can be none."""
    folder = parent / temporary_name(name)
    with naming(parent):
        folder.mkdir(parents=True)
    try:
        remove_leftovers(parent)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


_confirm: ContextVar[Callable[[], None]] = ContextVar("confirm", default=lambda: None)


@contextmanager
def confirming(confirm: Callable[[], None]) -> Iterator[None]:
    """Call `confirm` before files that this thread writes in the block get their names; where it
    raises, none is left."""
    token = _confirm.set(confirm)
    try:
        yield
    finally:
        _confirm.reset(token)


class NumberedFiles:
    """The numbered files of a folder, which replace those of an earlier sequence there, and nobody
    else's. SEQUENCE_FILE in the folder lists what was written: name, bytes and time of modification
    in nanoseconds, a line each; files with such a name that are not listed so are not touched."""

    def __init__(self, folder: Path, names: re.Pattern[str]) -> None:
        """Raises StgaError where the folder cannot be made, or holds one of these names that is not
        listed."""
        there = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
        if not there.is_dir():
            raise StgaError(f"{folder}: cannot be written ({there.name} is not a folder)")
        self.folder = folder
        self._names = names
        self._written = dict[str, str]()
        self._list = folder / SEQUENCE_FILE
        self._listed = ""
        if os.path.isfile(self._list):
            self._listed = read_bytes(self._list).decode("utf-8", "replace")
        listed = set(self._listed.splitlines())
        with naming(folder, "read"):
            found = self._found()
            self._earlier = [path for path in found if self._line(path.name, path) in listed]
            other = next((path.name for path in found if path not in self._earlier), None)
        if other is not None:
            problem = f"holds {other}, which was not written here; choose another folder"
            raise StgaError(f"{folder}: {problem}")

    def add(self, name: str, content: Path) -> None:
        """List a file before it gets its name; `content`: the whole file, under another one."""
        with naming(self._list), self._list.open("a") as stream:
            self._written[name] = self._line(name, content)
            stream.write(self._written[name] + "\n")

    @contextmanager
    def added_together(self) -> Iterator[NewFile]:
        """Yield a function like `replacing`, whose files get their names together when the block
        succeeds, as those of `replacing_together`, and are listed before; then `finish`."""
        with replacing_together() as new_file, new_file(self._list) as content:

            @contextmanager
            def add(path: Path) -> Iterator[Path]:
                with new_file(path) as partial:
                    yield partial
                    self._written[path.name] = self._line(path.name, partial)

            yield add
            lines = "".join(f"{line}\n" for line in self._written.values())
            content.write_text(self._listed + lines, encoding="utf-8")
        self.finish()

    def finish(self) -> None:
        """Remove the earlier sequence's files that none of the written ones replaced, if any was
        written. Raises StgaError where one stays."""
        if not self._written:
            return
        for path in self._earlier:
            if path.name not in self._written:
                with naming(path, "removed"):
                    _once_free(path.unlink, RENAME_PATIENCE_S)
        with replacing(self._list) as content:
            content.write_text("".join(f"{line}\n" for line in self._written.values()))

    def _found(self) -> list[Path]:
        names = sorted(os.listdir(self.folder)) if self.folder.is_dir() else []
        return [self.folder / name for name in names if self._names.fullmatch(name)]

    def _line(self, name: str, content: Path) -> str:
        status = content.stat()
        return f"{name} {status.st_size} {status.st_mtime_ns}"


@contextmanager
def naming(path: Path, done: str = "written") -> Iterator[None]:
    """Turn an OSError of the block into a StgaError that names the file: "cannot be written"."""
    try:
        yield
    except OSError as error:
        raise StgaError(f"{path}: cannot be {done} ({error.strerror or error})") from error


def _once_free(action: Callable[[], None], patience_s: float) -> None:
    """Call `action`, again for `patience_s` while Windows says that another program has it open."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return action()
        except PermissionError as error:
            is_open = os.name == "nt" or getattr(error, "winerror", None) in WINDOWS_SHARING_ERRORS
            if not is_open or time.monotonic() >= deadline:
                raise
            time.sleep(RENAME_INTERVAL_S)


def check_writable(path: Path) -> None:
    """Raise the StgaError of `replacing` before minutes of work, where the file could not be
    written; leaves nothing behind."""
    with suppress(_Checked), replacing(path):
        raise _Checked


class _Checked(Exception):
    pass


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders that killed processes of this computer left in the
    folder."""
    with suppress(OSError):
        for name in os.listdir(folder):
            match = PARTIAL_NAME.fullmatch(name)
            if match and match["host"] == _HOST and not _is_running(int(match["process"])):
                with suppress(OSError):
                    path = folder / name
                    remove = shutil.rmtree if path.is_dir() else os.unlink
                    remove(path)


_remove_leftovers_once = cache(remove_leftovers)


def _is_running(process: int) -> bool:
    if os.name == "nt":  # where os.kill(process, 0) would send Ctrl-C
        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
        handle = kernel.OpenProcess(0x1000, False, process)  # PROCESS_QUERY_LIMITED_INFORMATION
        return bool(handle and kernel.CloseHandle(handle))
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def is_file(path: Path) -> bool:
    """Whether there is a regular file. Raises StgaError where the system does not know."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: Path) -> bool:
    """Whether there is a folder. Raises StgaError where the system does not know."""
    return stat.S_ISDIR(_mode(path))


def matching(folder: Path, pattern: str) -> list[Path]:
    """What a folder holds under names like the pattern, sorted; nothing where there is no folder.
    Raises StgaError where it cannot be listed, which `Path.glob` passes over."""
    if not is_folder(folder):
        return []
    with naming(folder, "read"):
        names = sorted(os.listdir(folder))
    return [folder / name for name in names if fnmatch(name, pattern)]


def _mode(path: Path) -> int:
    """0 where there is nothing, or cannot be: pathlib raises for some of it, os.path for nothing
    at all."""
    try:
        return os.stat(path).st_mode
    except ValueError:  # a name that no file can have
        return 0
    except OSError as error:
        if error.errno in NO_FILE:
            return 0
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error


def file_size(path: Path) -> int:
    """Size in bytes. Raises StgaError for no regular file: a pipe or a device need never end."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise StgaError(f"{path}: {problem}") from error
    if not stat.S_ISREG(found.st_mode):
        raise StgaError(f"{path}: cannot be read (is not a regular file)")
    return found.st_size


def file_address(path: Path) -> str:
    """What FFmpeg takes for this file: the plain name `take12:30.mp4` is a protocol to it."""
    return f"file:{os.path.abspath(path)}"


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """What a file holds. Raises StgaError where it is no regular file or above the limit."""
    size = file_size(path)
    if size > limit:
        raise StgaError(f"{path}: has {size} bytes, more than the {limit} allowed")
    with naming(path, "read"):
        data = path.read_bytes()
    if unexpected := unexpected_content(data):
        raise StgaError(f"{path}: {unexpected}")
    return data


def unexpected_content(data: bytes) -> str | None:
    """What stands in the place of a file whose download or checkout went wrong, and what to do, to
    follow its name in a message; None where it is neither a Git LFS pointer nor a web page."""
    start = data[:PROBED_BYTES].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if start.startswith(b"version https://git-lfs.github.com/"):
        return "is a Git LFS pointer, not the file; fetch the file with git lfs pull"
    if WEB_PAGE.match(start):
        return "is a web page, not the file; log in and download the file again"
    return None


def line_ends_changed(data: bytes) -> bool:
    """Whether binary data were carried over as text, which turns each line feed into CR LF."""
    ends = data.count(b"\n")
    return ends > 0 and ends == data.count(b"\r\n")


def read_text(path: Path, limit: int = MAX_FILE_BYTES) -> str:
    """A file of UTF-8 text, or of UTF-16 or UTF-32 with a byte order mark. Raises StgaError."""
    try:
        return decoded_text(read_bytes(path, limit))
    except ValueError as error:
        raise StgaError(f"{path}: is not UTF-8 text ({error})") from error


class TooManyValuesError(ValueError):
    """A text would be parsed to more values than a large file has."""


def check_values(text: str) -> str:
    """The text. Raises TooManyValuesError."""
    values = sum(map(text.count, SEPARATORS))
    if values > MAX_TEXT_VALUES:
        problem = f"holds about {values} values, more than the {MAX_TEXT_VALUES} allowed"
        raise TooManyValuesError(problem)
    return text


def decoded_text(data: bytes, errors: str = "strict") -> str:
    """Text in UTF-8, or in what its byte order mark says. Raises ValueError, if errors are
    "strict"."""
    marked = (name for mark, name in BYTE_ORDER_MARKS.items() if data.startswith(mark))
    return data.decode(next(marked, "utf-8"), errors)


def read_table(path: Path, limit: int = MAX_FILE_BYTES) -> list[tuple[int, list[str]]]:
    """Rows of a CSV file as `table_rows` of its text. Raises StgaError."""
    return table_rows(str(path), read_text(path, limit))


def table_rows(where: str, text: str) -> list[tuple[int, list[str]]]:
    """Rows of a CSV file that are not empty: (number of the line, cells). Columns are separated by
    the one of `DELIMITERS` that the row of names has most of; decimal commas become points, as
    spreadsheets write them in many countries. Raises StgaError, beginning with `where`."""
    try:
        lines = check_values(text).splitlines()
    except TooManyValuesError as error:
        raise StgaError(f"{where}: {error}") from error
    if lines and lines[0].lower().startswith("sep="):  # of spreadsheets, which hide that line
        lines[0] = ""
    heads = lines[:LINES_BEFORE_COLUMNS]
    counts = [{mark: line.count(mark) for mark in DELIMITERS} for line in heads]
    named = next((count for count in counts if any(count.values())), {",": 0})
    cells = csv.reader(lines, delimiter=max(named, key=named.__getitem__))
    try:
        rows = [(cells.line_num, row) for row in cells if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise StgaError(f"{where}: line {cells.line_num}: is not readable CSV ({error})") from error
    return [(number, [_with_point(cell) for cell in row]) for number, row in rows]


def _with_point(cell: str) -> str:
    return cell.replace(",", ".") if "," in cell and DECIMAL_COMMA.fullmatch(cell) else cell


def read_json(path: Path) -> Any:
    """Parse a JSON file of up to 256 MiB. Raises StgaError naming the file."""
    return _parsed(path, "JSON", MAX_JSON_BYTES, parse_json)


def read_document(path: Path, kind: str, form: str, version: int) -> dict[str, Any]:
    """What `write_document` wrote. Raises StgaError for another format or version."""
    values = read_json(path)
    if not isinstance(values, dict) or values.pop("format", None) != form:
        raise StgaError(f"{path}: is not a {kind} of this add-on (format is not '{form}')")
    check_version(path, kind, values.pop("version", None), version)
    return values


def write_document(path: Path, form: str, version: int, values: Mapping[str, Any]) -> None:
    """Raises StgaError on a full disk."""
    write_json(path, {"format": form, "version": version, **values})


def file_digest(path: Path) -> str:
    """SHA-256 of a file. Raises StgaError where it cannot be read."""
    with naming(path, "read"), path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file of up to 16 MiB. Raises StgaError naming the file."""
    return _parsed(path, "TOML", MAX_TOML_BYTES, lambda data: tomllib.loads(data.decode("utf-8")))


def _parsed(path: Path, form: str, limit: int, parse: Callable[[bytes], Any]) -> Any:
    data = read_bytes(path, limit)
    try:
        return parse(data)
    except TooManyValuesError as error:
        raise StgaError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise StgaError(f"{path}: is not valid {form} ({error})") from error


def parse_json(data: bytes) -> Any:
    """Parse JSON, as `decoded_text`. Raises ValueError where it is malformed, or holds lone
    surrogates, or too many values (TooManyValuesError)."""
    text = check_values(decoded_text(data))
    value = json.loads(text)
    if "\\u" in text:  # the only way to write a lone surrogate
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    return value


def write_json(path: Path, value: Any, patience_s: float = RENAME_PATIENCE_S) -> None:
    """Write `value` as indented JSON, atomically; `patience_s` as in `replacing`."""
    with replacing(path, patience_s) as content:
        content.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def check_version(path: Path, kind: str, found: object, known: int) -> None:
    """Raise StgaError unless a file of this kind has the format version that is read; it says what
    to do with what an earlier or a later version of the add-on has written."""
    if type(found) is int and found == known:
        return
    problem = f"has {kind} format version {shorten(found)}, this add-on reads {known}"
    if type(found) is int:
        problem += "; train it again" if found < known else "; update the add-on"
    raise StgaError(f"{path}: {problem}")


def allowed_bytes(size: int) -> int:
    """Bytes to which a packed file of `size` bytes may unpack."""
    return MIN_UNPACKED_BYTES + MAX_UNPACKED_RATIO * size


def read_npz(
    path: Path, names: Collection[str] | None = None, limit: int = MAX_ARRAYS_BYTES
) -> dict[str, np.ndarray]:
    """Read the arrays of an npz that are among `names`, by default every one, without pickle.
    Raises StgaError where it is missing, truncated or holds objects, and, before anything is
    unpacked, where the arrays have more than `limit` bytes together."""
    with open_npz(path) as file:
        return file.arrays(names, limit)


@contextmanager
def open_npz(path: Path) -> Iterator["NpzFile"]:
    """An npz whose arrays are read one after another while it is open. Raises as `read_npz`."""
    file_size(path)  # refuses pipes, whose reading need never end
    with ExitStack() as opened:
        with _reading(path, "npz"):
            archive = opened.enter_context(zipfile.ZipFile(path))
            entries = {}
            for entry in archive.infolist():
                if not entry.filename.endswith(".npy"):
                    raise ValueError(f"entry '{entry.filename}' is no array")
                # LZMA's own header makes it allocate gigabytes
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError("is packed as no npz is")
                entries[entry.filename.removesuffix(".npy")] = entry
        yield NpzFile(path, archive, entries)


@dataclass(frozen=True)
class NpzFile:
    """An open npz: its archive, and the entry of each array by the array's name."""

    path: Path
    archive: zipfile.ZipFile
    entries: Mapping[str, zipfile.ZipInfo]

    def arrays(
        self,
        names: Collection[str] | None = None,
        limit: int = MAX_ARRAYS_BYTES,
        expected: int = 0,
    ) -> dict[str, np.ndarray]:
        """The arrays that are among `names`, by default every one, of at most `limit` bytes;
        `expected` of them are as many as they must be, however well they are packed."""
        wanted = {n: each for n, each in self.entries.items() if names is None or n in names}
        unpacked = sum(entry.file_size for entry in wanted.values())
        if unpacked > MIN_ARRAYS_BYTES // MIN_NUMBER_BYTES:
            packed = MAX_UNPACKED_RATIO * file_size(self.path)
            limit = min(limit, MIN_ARRAYS_BYTES + expected + packed)
            for _, (shape, dtype) in self._each(wanted, _read_outline):
                small = MIN_NUMBER_BYTES - dtype.itemsize if dtype.kind in "iuf" else 0
                unpacked += max(small, 0) * math.prod(shape)
        if unpacked > limit:
            problem = f"unpacks to {unpacked} bytes, more than the {limit} allowed"
            raise StgaError(f"{self.path}: {problem}")
        return dict(self._each(wanted, _read_array))

    def outlines(self) -> dict[str, np.ndarray]:
        """The arrays with their types and shapes, without contents, which take no memory: to look
        at before a small file is unpacked to gigabytes."""
        outlines = {}
        for name, (shape, dtype) in self._each(self.entries, _read_outline):
            outlines[name] = np.broadcast_to(np.zeros((), dtype), shape)
        return outlines

    def is_zero(self, name: str) -> bool:
        """Whether an array is all zero, found without unpacking it to memory."""
        entry = self.entries[name]
        with _reading(self.path, "npz"), self.archive.open(entry) as stream:
            _read_outline(stream, entry.file_size)
            blocks = iter(lambda: stream.read(BLOCK_BYTES), b"")
            return all(block.count(0) == len(block) for block in blocks)

    def digest(self) -> str:
        """SHA-256 of the whole file."""
        stream = self.archive.fp
        assert stream is not None
        with naming(self.path, "read"):
            stream.seek(0)
            return hashlib.file_digest(stream, "sha256").hexdigest()  # type: ignore[arg-type]

    def _each(
        self, entries: Mapping[str, zipfile.ZipInfo], read: Callable[[IO[bytes], int], Any]
    ) -> Iterator[tuple[str, Any]]:
        for name, entry in entries.items():
            with _reading(self.path, "npz"), self.archive.open(entry) as stream:
                found = read(stream, entry.file_size)
            yield name, found


def read_npy(path: Path) -> np.ndarray:
    """Read the array of a npy file without pickle. Raises StgaError as `read_npz` does."""
    size = file_size(path)
    with _reading(path, "npy"), path.open("rb") as stream:
        return _read_array(stream, size)


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[None]:
    """A damaged archive can make its decompressor or the parser of an array header raise nearly
    anything."""
    try:
        with naming(path, "read"):
            yield
    except StgaError:
        raise
    except Exception as error:
        problem = damage_of(path) or (
            f"is not a readable {kind} file ({error or type(error).__name__})"
        )
        raise StgaError(f"{path}: {problem}") from error


def converted(values: ArrayLike, dtype: DTypeLike) -> np.ndarray:
    """A copy of what a file holds in another dtype, without NumPy's warnings: any bits may stand
    there for a number (a signaling NaN), and text may be larger than the dtype. What does not fit
    is not finite afterwards, of a whole number anything; the caller checks."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(values, dtype)


def damage_of(path: Path) -> str | None:
    """What happened to a binary file that cannot be read, where its beginning shows it; to follow
    its name in a message. Raises StgaError where it cannot be opened."""
    if not os.path.isfile(path):  # a pipe need never end
        return None
    with naming(path, "read"), path.open("rb") as stream:
        start = stream.read(DAMAGE_BYTES)
    return unexpected_content(start) or (CHANGED_LINE_ENDS if line_ends_changed(start) else None)


def _read_array(stream: IO[bytes], size: int) -> np.ndarray:
    """The array of a npy stream of `size` bytes, which bounds what its header promises."""
    _read_outline(stream, size)
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)  # type: ignore[no-untyped-call]


def _read_outline(stream: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type in the header of a npy stream of `size` bytes. Raises ValueError where they do
    not make up its size."""
    version = np.lib.format.read_magic(stream)  # type: ignore[no-untyped-call]
    if version != (1, 0):  # newer ones are for headers of more than 64 kB, of many named columns
        raise ValueError(f"npy format {version} is not supported")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)  # type: ignore[no-untyped-call]
    promised = stream.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject or not dtype.itemsize or min(shape, default=0) < 0 or promised != size:
        raise ValueError(f"an array of {dtype} {shape} in {size} bytes")
    return shape, dtype


def write_npz(path: Path, arrays: dict[str, np.ndarray], compressed: bool = False) -> None:
    """Write arrays as npz, atomically."""
    with replacing(path) as content:
        save_npz(content, arrays, compressed)


def save_npz(path: Path, arrays: dict[str, np.ndarray], compressed: bool = False) -> None:
    """Write arrays as npz, not atomically. Raises OSError."""
    packing = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    # Not numpy's own savez: where the disk is full, it leaves an archive behind that complains when
    # it is collected.
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                np.lib.format.write_array(out, np.asanyarray(array), allow_pickle=False)  # type: ignore[no-untyped-call]
