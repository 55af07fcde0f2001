"""World-space splats in Niantic's compressed format SPZ."""

import gzip
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from ..avatar.splats import MAX_SH_DEGREE, Splats, in_world, logits
from ..errors import StgaError
from ..files import CHANGED_LINE_ENDS, allowed_bytes, line_ends_changed, read_bytes, replacing
from ..flame.quaternions import normalized
from ..progress import Log, warn
from .ply import READ_FILES

MAGIC = b"NGSP"
"""First bytes of the header, in all versions."""

VERSION = 3
"""The last packed by gzip: version 4 needs Zstandard, a package that may be missing."""
READ_VERSIONS = 1, 2, 3, 4
"""Versions that are read."""

STREAM_VERSION = 4
"""First version of streams that Zstandard packs, behind a table of their sizes."""
HEADER_BYTES = 16
"""Bytes of the header of versions 1 to 3, with whose fields that of version 4 begins."""

STREAM_HEADER = struct.Struct("<4sIIBBBBI12x")
"""Header of version 4: as before, with the number of streams, and where their table begins."""
STREAMS = 6
"""Streams of version 4: positions, opacities, colors, scales, rotations, harmonics."""
GZIP_MAGIC = b"\x1f\x8b"
"""First bytes of data that gzip has packed (RFC 1952): versions 1 to 3."""
MAX_SPZ_BYTES = 2 << 30
"""Largest file, the format's limit."""
MAX_SPZ_SPLATS = 10_000_000
"""Most splats, the format's limit."""
MAX_SPZ_DEGREE = 4
"""Highest degree of harmonics, the format's limit."""
ANTIALIASED = 1
"""Flag of splats that were trained with antialiasing."""

HAS_EXTENSIONS = 2
"""Flag of files with more behind the splats, such as a safe orbit for a viewer's camera."""

MAX_FRACTION_BITS = 16
"""Resolution of positions: 2⁻¹⁶ m = 15 µm, within ±128 m; coarser where splats are farther away."""
COORDINATE_BITS = 24
"""Bits of a coordinate, a signed number in fixed point."""

MAX_COORDINATE = (1 << (COORDINATE_BITS - 1)) - 1
"""Largest coordinate in units of its resolution."""
MIN_LOG_SCALE = -10.0
"""Least logarithm of a standard deviation, 45 µm; smaller ones are as large."""
SCALE_STEPS = 16
"""Steps of that logarithm in 1."""
MAX_LOG_SCALE = MIN_LOG_SCALE + 255 / SCALE_STEPS
"""Largest one that a byte holds."""
COLOR_SCALE = 0.15
"""Scale of the constant coefficient in a byte."""
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Part of a quaternion -> the other three."""


def write_spz(path: Path, world: Splats, antialiased: bool = False) -> None:
    """Write world-space splats as .spz of version 3, atomically.

    Axes as in the splats: x right, y up, z back. Quantized: positions as MAX_FRACTION_BITS defines,
    standard deviations from 45 µm in steps of 6 %, rotations 10 bits a component, opacity and color
    8 bits; coefficients above degree 0 are cut at ±1. antialiased as in `Avatar`. Raises StgaError
    for values that are not finite, positions beyond MAX_COORDINATE and larger splats than
    MAX_LOG_SCALE. Source: Niantic's README and `load-spz.cc`.
    """
    for each in fields(world):
        if not np.isfinite(getattr(world, each.name)).all():
            raise StgaError(f"{path}: {each.name} holds a value that is not finite")
    largest = float(np.abs(world.xyz).max(initial=0))
    if largest > MAX_COORDINATE:
        limit = f"positions from -{MAX_COORDINATE} to {MAX_COORDINATE}"
        raise StgaError(f"{path}: .spz holds {limit}, but a splat is at {largest:g}")
    largest_scale = float(world.log_scale.max(initial=MIN_LOG_SCALE))
    if largest_scale > MAX_LOG_SCALE:
        limit = f"standard deviations to {math.exp(MAX_LOG_SCALE):.0f}"
        problem = f"a splat has one of e^{largest_scale:.4g}"
        raise StgaError(f"{path}: .spz holds {limit}, but {problem}")
    # As many bits of a coordinate behind the point as the largest one leaves.
    bits = COORDINATE_BITS - 2 - math.floor(math.log2(max(largest, 1.0)))
    bits = max(min(MAX_FRACTION_BITS, bits), 0)
    whole = np.minimum(np.round(world.xyz * 2.0**bits), MAX_COORDINATE).astype("<i4")
    flags = ANTIALIASED if antialiased else 0
    header = MAGIC + struct.pack("<IIBBBB", VERSION, len(world), world.sh_degree, bits, flags, 0)
    # Of a unit quaternion xyzw the index of the largest part; of the others a sign bit, and nine
    # bits of magnitude in units of sqrt(½) / 511.
    index, others = smallest_three(world.unit_rotations()[:, [1, 2, 3, 0]])
    magnitude = np.clip(np.round(np.abs(others) * (511 * math.sqrt(2))), 0, 511)
    rotations = index.astype("<u4")
    for part in (magnitude + 512 * (others < 0)).T:
        rotations = (rotations << 10) | part.astype("<u4")
    columns = (
        # two's complement, least significant byte first
        whole.view(np.uint8).reshape(-1, 3, 4)[..., :3],
        _byte(world.opacities() * 255),
        _byte((world.sh[:, 0] * COLOR_SCALE + 0.5) * 255),
        _byte((world.log_scale - MIN_LOG_SCALE) * SCALE_STEPS),
        rotations,
        _byte(world.sh[:, 1:] * 128 + 128),
    )
    packed = gzip.compress(header + b"".join(column.tobytes() for column in columns), mtime=0)
    with replacing(path) as partial:
        partial.write_bytes(packed)


def read_spz(path: Path, log: Log = warn) -> Splats:
    """World-space splats of an .spz of version 1 to 4, in the axes of the file; of harmonics above
    degree 3 and of antialiasing, `log` gets a sentence. Raises StgaError naming the file."""
    data = read_bytes(path, MAX_SPZ_BYTES)
    try:
        return _unpacked(path, data, log)
    except (ValueError, struct.error, zlib.error, EOFError) as error:
        reason = "it ends within its header" if isinstance(error, struct.error) else error
        problem = CHANGED_LINE_ENDS if line_ends_changed(data) else f"({reason})"
        raise StgaError(
            f"{path}: is not a readable SPZ file {problem}; expected {READ_FILES}"
        ) from error


def _unpacked(path: Path, data: bytes, log: Log) -> Splats:
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    header = data[:HEADER_BYTES]
    if data[:2] == GZIP_MAGIC:
        header = stream.decompress(data, HEADER_BYTES)
    magic, version, count, degree, bits, flags, _ = struct.unpack("<4sIIBBBB", header)
    if magic != MAGIC:
        raise ValueError("it does not begin as one")
    is_packed = data[:2] == GZIP_MAGIC
    if version not in READ_VERSIONS or is_packed != (version < STREAM_VERSION):
        raise ValueError(f"version {version}; read are 1 to 4; save it as .ply")
    others = (degree + 1) ** 2 - 1
    parts = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * others)
    needed = count * sum(parts)
    if count > MAX_SPZ_SPLATS or degree > MAX_SPZ_DEGREE:
        raise ValueError(f"{count} splats of degree {degree}")
    if needed > allowed_bytes(len(data)):
        raise ValueError(f"{count} splats in {len(data)} bytes")
    if version >= STREAM_VERSION:
        body = _streams(path, data, [count * size for size in parts])
    else:
        body = stream.decompress(stream.unconsumed_tail, needed + 1)
    if flags & HAS_EXTENSIONS:
        log(f"{path}: has extensions, which are not read")
        body = body[:needed]
    if len(body) != needed:
        raise ValueError(f"{len(body)} bytes of {count} splats, expected {needed}")
    edges = np.cumsum([0, *(count * size for size in parts)])
    places, alpha, color, scale, turn, rest = (
        np.frombuffer(body, np.uint8, size * count, start).reshape(count, size)
        for size, start in zip(parts, edges.tolist(), strict=False)
    )
    if flags & ANTIALIASED:
        log(f"{path}: is marked as antialiased; splats of files are drawn without")
    if degree > MAX_SH_DEGREE:
        log(f"{path}: harmonics of degree {degree} are cut at {MAX_SH_DEGREE}")
    harmonics = (rest.reshape(count, others, 3).astype(np.float32) - 128) / 128
    base = (color.astype(np.float32) / 255 - 0.5) / COLOR_SCALE
    sh = np.concatenate([base[:, None], harmonics[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]], axis=1)
    rotation = _smallest_three(turn) if version >= 3 else _three(turn)
    xyz = places.view("<f2") if version == 1 else _fixed(places) / 2.0**bits
    return in_world(
        xyz,
        rotation,
        scale.astype(np.float32) / SCALE_STEPS + MIN_LOG_SCALE,
        logits(alpha[:, 0] / 255),
        sh,
    )


def _streams(path: Path, data: bytes, sizes: Sequence[int]) -> bytes:
    """The streams of version 4, one after the other. Raises StgaError without a decoder, ValueError
    or struct.error for others than those sizes."""
    *_, count, begin = STREAM_HEADER.unpack_from(data)
    if count < sum(size > 0 for size in sizes) or count > STREAMS:
        raise ValueError(f"{count} streams, expected {STREAMS}")
    table = np.array(struct.unpack_from(f"<{2 * count}Q", data, begin), object).reshape(-1, 2)
    at = begin + 16 * count
    parts = []
    for (packed, size), expected in zip(table, sizes, strict=False):
        if size != expected or at + packed > len(data):
            raise ValueError(f"a stream of {size} bytes, expected {expected}")
        parts.append(_unzstd(path, data[at : at + packed], expected))
        at += packed
    return b"".join(parts)


def _unzstd(path: Path, data: bytes, size: int) -> bytes:
    """What Zstandard packed into `data`, of `size` bytes. Raises StgaError, ValueError."""
    if not size:
        return b""
    try:
        import zstandard
    except ImportError:
        raise StgaError(
            f"{path}: is SPZ of version 4, which needs the package zstandard; install it, or save "
            "the splats as .ply or as version 3"
        ) from None
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def _fixed(places: np.ndarray) -> np.ndarray:
    """(N, 3) whole numbers of 24 bits in two's complement, from bytes (N, 9)."""
    wide = np.zeros((len(places), 3, 4), np.uint8)
    wide[..., 1:] = places.reshape(-1, 3, 3)
    return wide.view("<i4")[..., 0] >> 8


def _three(turn: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) wxyz of x, y and z as bytes; w is positive."""
    xyz = turn.astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(turn: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) wxyz of what `write_spz` packs into 4 bytes."""
    packed = turn.copy().view("<u4")
    parts = packed >> np.array([20, 10, 0], "<u4")
    others = (parts & 511) * np.where(parts & 512, -1, 1) / (511 * math.sqrt(2))
    return of_smallest_three(packed[:, 0] >> 30, others)[:, [3, 0, 1, 2]]


def _byte(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.round(values), 0, 255), np.uint8)


def smallest_three(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index (N,) of the part of largest magnitude of quaternions (N, 4), and the others (N, 3) in
    order, of the unit quaternion whose largest part is positive. A zero quaternion counts as the
    identity."""
    q = normalized(rotation)
    largest = np.abs(q).argmax(1)
    q *= np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    return largest.astype(np.uint8), np.take_along_axis(q, OTHERS[largest], 1)


def of_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The unit quaternions (N, 4) of what `smallest_three` gives."""
    found = np.zeros((len(others), 4))
    np.put_along_axis(found, OTHERS[largest], others, 1)
    found[np.arange(len(found)), largest] = np.sqrt(np.maximum(0, 1 - (found**2).sum(axis=1)))
    return found
