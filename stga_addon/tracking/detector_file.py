"""Download of the network file that newer versions of MediaPipe need."""

import hashlib
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

from ..errors import StgaError
from ..files import replacing

TASK_URL = (
    "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/float16/1/face_landmarker.task"
)
TASK_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TASK_BYTES = 3_758_596
TIMEOUT_S = 30


def download_task(path: Path) -> None:
    """Download Google's face_landmarker.task (Apache-2.0) to `path`, unless that file exists.

    Raises StgaError where it cannot be read from TASK_URL, or has another digest than TASK_SHA256; nothing is written
    then.
    """
    if path.exists():
        return
    try:
        with urlopen(TASK_URL, timeout=TIMEOUT_S) as reply:
            data = reply.read(TASK_BYTES + 1)
    except (OSError, HTTPException) as error:  # urllib's URLError is an OSError
        reason = getattr(error, "reason", None) or error
        raise StgaError(f"{path}: cannot be downloaded from {TASK_URL} ({reason!s:.200})") from error
    found = hashlib.sha256(data).hexdigest()
    if found != TASK_SHA256:
        raise StgaError(f"{path}: {TASK_URL} has SHA-256 {found}, expected {TASK_SHA256}; nothing was written")
    with replacing(path) as partial:
        partial.write_bytes(data)
