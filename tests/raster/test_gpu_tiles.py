"""Sorting on WebGPU against numpy, at awkward sizes, and counts that are too large."""

from typing import Any

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import (
    COUNTS,
    HIDDEN,
    NEEDED,
    OVERFLOWED,
    VIEW,
    WORKGROUP,
)
from stga_addon.raster.gpu.rasterize import counts_buffer, sort_keys

pytestmark = pytest.mark.needs("adapter")


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


def view_of(device: Device, splats: int) -> Any:
    view = np.zeros((), VIEW)
    view["splats"], view["capacity"] = splats, 1 << 16
    return device.upload("view", view, "uniform")


@pytest.mark.parametrize("count", [1, 255, 257, 2048, 2049, 10_000])
@pytest.mark.parametrize("kind", ["random", "few", "equal", "reversed", "two digits"])
def test_sorted_keys_are_numpys(device: Device, count: int, kind: str) -> None:
    """Catches a key lost at a block's edge, a digit's carry, equal keys that change places, and the
    tiles of a large image, which need a second pass."""
    random = np.random.default_rng(count)
    keys = {
        "random": random.integers(0, 1 << 32, count),
        "few": random.integers(0, 3, count) << 11,
        "equal": np.full(count, HIDDEN),
        "reversed": 0xFFFFFF00 - np.arange(count),
        "two digits": random.integers(0, 130 * 70, count),
    }[kind].astype(np.uint32)
    bits = 14 if kind == "two digits" else 32
    with device.record() as work:
        found = sort_keys(work, device.upload("keys", keys), count, bits, view_of(device, count))
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(device.read(found[1], (count,), np.uint32), order)
    np.testing.assert_array_equal(device.read(found[0], (count,), np.uint32), keys[order])


def test_a_count_beyond_32_bits_is_too_many(device: Device) -> None:
    """Catches a sum that wraps around to a small number: of three workgroups with 2³¹ − 1 pairs
    each."""
    until = device.upload("pairs_until", np.full(3 * WORKGROUP + 3, 0x7FFFFFFF, np.uint32))
    tables = {
        "view": view_of(device, 3 * WORKGROUP),
        "counts": counts_buffer(device),
        "pairs_until": until,
    }
    with device.record() as work:
        work.dispatch("tiles.add_pairs", (1, 1, 1), tables)
    counts = device.read(counts_buffer(device), (COUNTS,), np.uint32)
    device.upload("counts", np.zeros(COUNTS, np.uint32))
    assert counts[NEEDED] == 0x7FFFFFFF
    assert counts[OVERFLOWED] == 1
