"""Reading without trust and writing without halves: JSON, npz and atomic replacement."""

import json
import math
import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from .errors import StgaError

MAX_JSON_BYTES = 256 << 20
MAX_PACKING = 16
"""Unpacked bytes that a byte of an npz may stand for; Deflate's best is 1030, arrays of numbers reach 5."""
FREE_BYTES = 128 << 20
"""What any npz may unpack to, however small it is."""
MAX_HEADER_BYTES = 1 << 16


def partial_name(name: str, process: int | str) -> str:
    """The temporary name that a process writes the file `name` under."""
    return f".{name}.{process}.partial"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; rename it over `path` when the block ends well, else delete it.

    Raises StgaError where the folder cannot be written.
    """
    partial = path.with_name(partial_name(path.name, os.getpid()))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        with partial.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise StgaError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):  # where the folder is the problem, that was said above
            partial.unlink()


def file_size(path: Path) -> int:
    """Size in bytes. Raises StgaError where there is no regular file: reading a pipe or a device need never end."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise StgaError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(found.st_mode):
        raise StgaError(f"{path}: cannot be read (is not a regular file)")
    return found.st_size


def read_json(path: Path) -> Any:
    """Parse a UTF-8 JSON file. Raises StgaError naming the file where it is missing, malformed or above 256 MiB."""
    size = file_size(path)
    if size > MAX_JSON_BYTES:
        raise StgaError(f"{path}: has {size} bytes, more than the {MAX_JSON_BYTES} allowed")
    try:
        return parse_json(path.read_bytes())
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise StgaError(f"{path}: is not valid JSON ({error})") from error


def parse_json(data: bytes) -> Any:
    """Parse UTF-8 JSON. Raises ValueError where it is malformed, or holds text that nothing can print."""
    value = json.loads(data.decode("utf-8"))
    if b"\\u" in data:  # the only way to write a lone surrogate
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    return value


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def read_npz(path: Path, max_bytes: int | None = None, max_packing: int = MAX_PACKING) -> dict[str, np.ndarray]:
    """Read every array of an npz without pickle.

    `max_bytes` bounds the unpacked size, so that a small hostile file cannot fill the memory; by default 128 MiB and
    `max_packing` times the file's own size.
    Raises StgaError naming the file where it is missing, truncated, too large or holds objects.
    """
    size = file_size(path)
    allowed = FREE_BYTES + max_packing * size if max_bytes is None else max_bytes
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > allowed:
                raise StgaError(f"{path}: unpacks to {unpacked} bytes, more than the {allowed} allowed")
            return {entry.filename.removesuffix(".npy"): _read_entry(archive, entry) for entry in archive.infolist()}
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except StgaError:
        raise
    except Exception as error:
        # A damaged archive can make its decompressor or the parser of an array header raise nearly anything.
        raise StgaError(f"{path}: is not a readable npz file ({error or type(error).__name__})") from error


def read_npy(path: Path) -> np.ndarray:
    """Read the array of a npy file without pickle. Raises StgaError naming the file, as `read_npz` does."""
    size = file_size(path)
    try:
        with path.open("rb") as stream:
            return _read_array(stream, size)
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # as above
        raise StgaError(f"{path}: is not a readable npy file ({error or type(error).__name__})") from error


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    if not entry.filename.endswith(".npy"):
        raise ValueError(f"entry '{entry.filename}' is no array")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("is packed as no npz is")  # LZMA's own header makes it allocate gigabytes
    with archive.open(entry) as stream:
        return _read_array(stream, entry.file_size)


def _read_array(stream: IO[bytes], size: int) -> np.ndarray:
    """The array of a npy stream of `size` bytes; numpy alone would allocate whatever the header promises."""
    start = stream.read(12).ljust(12, b"\0")
    length = struct.unpack("<H" if start[6] == 1 else "<L", start[8 : 10 if start[6] == 1 else 12])[0]
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"an array header of {length} bytes")
    stream.seek(0)
    version = np.lib.format.read_magic(stream)  # type: ignore[no-untyped-call]
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"npy format {version} is not supported")
    shape, _, dtype = readers[version](stream)  # type: ignore[no-untyped-call]
    promised = stream.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject or not dtype.itemsize or min(shape, default=0) < 0 or promised != size:
        raise ValueError(f"an array of {dtype} {shape} in {size} bytes")
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))  # type: ignore[no-untyped-call]


def write_npz(path: Path, arrays: dict[str, np.ndarray], compressed: bool = False) -> None:
    """Write arrays as npz, atomically."""
    packing = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    # Not numpy's own savez: where the disk is full, it leaves an archive behind that complains when it is collected.
    with replacing(path) as partial, zipfile.ZipFile(partial, "w", packing) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                np.lib.format.write_array(out, np.asanyarray(array), allow_pickle=False)  # type: ignore[no-untyped-call]
