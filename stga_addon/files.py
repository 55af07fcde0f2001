"""Reading without trust and writing without halves: JSON, npz and atomic replacement."""

import json
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from .errors import StgaError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; rename it over `path` when the block ends well, else delete it.

    Raises StgaError where the folder cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
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


def read_json(path: Path) -> Any:
    """Parse a UTF-8 JSON file. Raises StgaError naming the file where it is missing or malformed."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise StgaError(f"{path}: is not valid JSON ({error})") from error


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def read_npz(path: Path, max_bytes: int = 4 << 30) -> dict[str, np.ndarray]:
    """Read every array of an npz without pickle.

    `max_bytes` bounds the unpacked size, so that a small hostile file cannot fill the memory.
    Raises StgaError naming the file where it is missing, truncated, too large or holds objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > max_bytes:
            raise StgaError(f"{path}: unpacks to {unpacked} bytes, more than the {max_bytes} allowed")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        strangers = [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]
        if strangers:
            raise StgaError(f"{path}: is not a readable npz file (entry '{strangers[0]}' is no array)")
        return arrays
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, MemoryError) as error:
        # RuntimeError: encrypted entries and unknown compression; MemoryError: an array header that promises too much.
        raise StgaError(f"{path}: is not a readable npz file ({error})") from error


def write_npz(path: Path, arrays: dict[str, np.ndarray], compressed: bool = False) -> None:
    """Write arrays as npz, atomically."""
    save = np.savez_compressed if compressed else np.savez
    with replacing(path) as partial, partial.open("wb") as out:
        save(out, **arrays)
