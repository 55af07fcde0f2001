"""The demo's capture and takes, which `make_capture.py` and `make_takes.py` made."""

import shutil
from pathlib import Path
from zipfile import ZipFile

from ...capture.open import BUNDLED_MODEL
from ...errors import StgaError
from ...flame.model import BUNDLED_HEAD

CAPTURE = Path(__file__).with_name("head_capture.zip")
TAKES = Path(__file__).with_name("phone_takes.zip")


def unpack_takes(folder: Path) -> list[Path]:
    """Write the demo's videos of a phone into `folder`, around the head and a talk; returns their
    paths. Raises StgaError where it cannot be written."""
    _unpack(TAKES, folder)
    return [folder / "around.mp4", folder / "talk.mp4"]


def unpack_capture(folder: Path) -> None:
    """Write the demo's capture, with its head model, into `folder`. Raises StgaError where it
    cannot be written."""
    _unpack(CAPTURE, folder)
    try:
        shutil.copyfile(BUNDLED_HEAD, folder / BUNDLED_MODEL)
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written ({error.strerror})") from error


def _unpack(path: Path, folder: Path) -> None:
    try:
        with ZipFile(path) as archive:
            archive.extractall(folder)
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written ({error.strerror})") from error
