"""The demo's capture, which `make_capture.py` made."""

import shutil
from pathlib import Path
from zipfile import ZipFile

from ...capture.open import BUNDLED_MODEL
from ...errors import StgaError
from ...flame.model import BUNDLED_HEAD

CAPTURE = Path(__file__).with_name("head_capture.zip")


def unpack_capture(folder: Path) -> None:
    """Write the demo's capture, with its head model, into `folder`. Raises StgaError where it
    cannot be written."""
    try:
        with ZipFile(CAPTURE) as archive:
            archive.extractall(folder)
        shutil.copyfile(BUNDLED_HEAD, folder / BUNDLED_MODEL)
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written ({error.strerror})") from error
