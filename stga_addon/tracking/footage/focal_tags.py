"""Metadata of recordings: focal lengths from photos' EXIF and from tracks of QuickTime and MP4, and
their clean aperture."""

import mmap
import re
import struct
from collections.abc import Iterator
from itertools import islice
from math import hypot
from pathlib import Path

from PIL import Image

from ...capture.images import FORMATS

FULL_FRAME_DIAGONAL_MM = 43.27
"""Diagonal of 36 x 24 mm; equivalent lengths have one angle of view over the diagonal (CIPA
DCG-001)."""
MIN_EQUIVALENT_MM = 5.0
"""Least focal length for 35 mm film that is plausible."""
MAX_EQUIVALENT_MM = 2000.0
"""Largest focal length for 35 mm film that is plausible."""
EXIF = 0x8769
"""Tag of the directory of EXIF 2.32."""
EQUIVALENT = 0xA405
"""Tag of FocalLengthIn35mmFilm."""
FOCAL = 0x920A
"""Tag of FocalLength."""
PER_UNIT = 0xA20E
"""Tag of FocalPlaneXResolution."""
UNIT = 0xA210
"""Tag of FocalPlaneResolutionUnit."""
WIDTH = 0xA002
"""Tag of the picture's width as taken."""
HEIGHT = 0xA003
"""Tag of the picture's height as taken."""
UNITS_MM = {2: 25.4, 3: 10.0}
"""FocalPlaneResolutionUnit -> millimeters."""
MAX_ASPECT_DIFFERENCE = 0.01
"""Relative difference of the aspect beyond which a photo has been cropped: its tags are those of
the whole picture."""
EQUIVALENT_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
"""Key of the focal length for 35 mm film in QuickTime's metadata."""
VALUE_FORMATS = {21: ">i", 22: ">I", 23: ">f", 24: ">d", 67: ">i", 77: ">I"}
"""Well-known types of QuickTime's metadata, but for text -> format of `struct`."""
MAX_BOXES = 1000
MAX_MOVIE_BYTES = 1 << 26
# Bytes before the entries, and of a picture's before its boxes
STSD_HEAD = 8
SAMPLE_HEAD = 78


def photo_focal(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels of an image of that size, from its EXIF; None without."""
    try:
        with Image.open(path, formats=FORMATS) as image:
            tags = image.getexif().get_ifd(EXIF)
        equivalent = float(tags.get(EQUIVALENT) or 0)
        focal = float(tags.get(FOCAL) or 0)
        taken = sorted((float(tags.get(WIDTH) or width), float(tags.get(HEIGHT) or height)))
        sides = sorted((float(width), float(height)))
        if abs(taken[0] * sides[1] / (taken[1] * sides[0]) - 1) > MAX_ASPECT_DIFFERENCE:
            return None
        if not equivalent and focal and tags.get(PER_UNIT):
            pixels = focal * float(tags[PER_UNIT]) / UNITS_MM[tags.get(UNIT, 2)]
            equivalent = pixels / hypot(*taken) * FULL_FRAME_DIAGONAL_MM
    except Exception:  # damaged metadata does not concern the pixels
        return None
    return _pixels(equivalent, width, height)


def video_focal(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels of a video of that size, from its metadata; None without. Phones write
    it into the video's track, where FFmpeg does not look."""
    try:
        movie = _movie(path)
        tracks = [movie[first:end] for kind, first, end in _boxes(movie) if kind == b"trak"]
        found = [value for part in (*tracks, movie) if (value := _equivalent(part)) is not None]
    except (OSError, ValueError, struct.error):  # ValueError: of an empty file
        return None
    return _pixels(found[0], width, height) if found else None


def clean_aperture(path: Path) -> tuple[int, int] | None:
    """Width and height of the part of the stored picture that players show, as the first track of
    QuickTime and MP4 states it with a `clap`; None without."""
    try:
        movie = _movie(path)
        for kind, first, end in _boxes(movie):
            entry = movie[first:end] if kind == b"trak" else b""
            for inner in (b"mdia", b"minf", b"stbl", b"stsd"):
                entry = next((entry[f:e] for name, f, e in _boxes(entry) if name == inner), b"")
            for _, begin, stop in islice(_boxes(entry, STSD_HEAD), 1):
                sample = entry[begin + SAMPLE_HEAD : stop]
                for name, f, _ in _boxes(sample):
                    if name == b"clap":
                        wide, of_wide, high, of_high = struct.unpack_from(">4I", sample, f)
                        return round(wide / of_wide), round(high / of_high)
    except (OSError, ValueError, struct.error, ZeroDivisionError):
        return None
    return None


def _movie(path: Path) -> bytes:
    """The box `moov`, empty without one. Raises OSError, ValueError for an empty file."""
    with (
        path.open("rb") as stream,
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        boxes = islice(_boxes(data), MAX_BOXES)
        first, end = next(((first, end) for kind, first, end in boxes if kind == b"moov"), (0, 0))
        return bytes(data[first : min(end, first + MAX_MOVIE_BYTES)])


def _pixels(equivalent_mm: float, width: int, height: int) -> float | None:
    plausible = MIN_EQUIVALENT_MM <= equivalent_mm <= MAX_EQUIVALENT_MM
    return equivalent_mm / FULL_FRAME_DIAGONAL_MM * hypot(width, height) if plausible else None


def _boxes(data: bytes | mmap.mmap, start: int = 0) -> Iterator[tuple[bytes, int, int]]:
    """(kind, first byte of the content, end) of the boxes one after another from `start` on."""
    while start + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:  # a long one
            (size,) = struct.unpack_from(">Q", data, start + 8)
            head = 16
        if size < head:
            return
        yield kind, start + head, start + size
        start += size


def _equivalent(data: bytes) -> float | None:
    """Millimeters in the metadata of a movie or track."""
    for kind, first, end in _boxes(data):
        if kind != b"meta":
            continue
        meta = data[first:end]
        # MP4's has a version
        parts = {k: meta[f:e] for k, f, e in _boxes(meta, 0 if meta[4:8] == b"hdlr" else 4)}
        keys = [parts.get(b"keys", b"")[f:e] for _, f, e in _boxes(parts.get(b"keys", b""), 8)]
        if EQUIVALENT_KEY in keys:
            number = struct.pack(">I", keys.index(EQUIVALENT_KEY) + 1)
            entries = parts.get(b"ilst", b"")
            for item in (entries[f:e] for k, f, e in _boxes(entries) if k == number):
                # of its box "data"
                form = struct.unpack_from(">I", item, 8)[0]
                value = item[16:]
                if form in VALUE_FORMATS:
                    return float(struct.unpack_from(VALUE_FORMATS[form], value)[0])
                text = re.match(rb"[0-9.]+", value)
                is_number = text and text[0].count(b".") < 2 and text[0] != b"."
                return float(text[0]) if text and is_number else None
    return None
