"""Writing of world-space splats in Niantic's compressed format SPZ."""

import gzip
import math
import struct
from pathlib import Path

import numpy as np

from ..avatar.splats import Splats
from ..files import replacing
from ..flame.quaternions import normalized

MAGIC = b"NGSP"
VERSION = 3
"""The last packed by gzip: version 4 needs Zstandard, which Blender's Python lacks."""
ANTIALIASED = 1
MAX_FRACTION_BITS = 16
"""Resolution of positions: 2⁻¹⁶ m = 15 µm, within ±128 m; coarser where splats are farther away."""
COORDINATE_BITS = 24
COLOR_SCALE = 0.15


def write_spz(path: Path, world: Splats, antialiased: bool = False) -> None:
    """Write world-space splats as .spz of version 3, atomically.

    Axes as in the splats: x right, y up, z back. Quantized: positions as MAX_FRACTION_BITS says,
    standard deviations from 45 µm in steps of 6 %, rotations 10 bits a component, opacity and color
    8 bits; coefficients above degree 0 are cut at ±1. antialiased as in `Avatar`. Source: Niantic's
    README and `load-spz.cc`.
    """
    # As many bits of a coordinate behind the point as the largest one leaves.
    largest = max(float(np.abs(world.xyz).max(initial=0)), 1.0)
    bits = max(min(MAX_FRACTION_BITS, COORDINATE_BITS - 2 - math.floor(math.log2(largest))), 0)
    limit = 1 << (COORDINATE_BITS - 1)
    whole = np.clip(np.round(world.xyz * 2.0**bits), -limit, limit - 1).astype("<i4")
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
        _byte((world.log_scale + 10) * 16),
        rotations,
        _byte(world.sh[:, 1:] * 128 + 128),
    )
    packed = gzip.compress(header + b"".join(column.tobytes() for column in columns), mtime=0)
    with replacing(path) as partial:
        partial.write_bytes(packed)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.round(values), 0, 255), np.uint8)


def smallest_three(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index (N,) of the part of largest magnitude of quaternions (N, 4), and the others (N, 3) in
    order, of the unit quaternion whose largest part is positive. A zero quaternion counts as the
    identity."""
    q = normalized(rotation)
    largest = np.abs(q).argmax(1)
    q *= np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    others = np.array([[k for k in range(4) if k != left_out] for left_out in range(4)])[largest]
    return largest.astype(np.uint8), np.take_along_axis(q, others, 1)
