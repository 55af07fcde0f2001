"""Sorting and tile lists on WebGPU against numpy, at awkward sizes."""

from typing import Any

import numpy as np
import pytest

from raster import gpu_device
from raster.test_outline import covariances
from stga_addon.raster.cpu.layout import PROJECTED, TILE
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import (
    COUNTS,
    HIDDEN,
    NEEDED,
    OVERFLOWED,
    PAIRS,
    VIEW,
    WANTED,
    WORKGROUP,
)
from stga_addon.raster.gpu.rasterize import choose_tiles, counts_buffer, list_pairs, sort_keys

pytestmark = pytest.mark.needs("adapter")

TILES_X, TILES_Y = 9, 7
CAPACITY = 1 << 16


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


def view_of(
    device: Device, splats: int, capacity: int = CAPACITY, focused: bool = False, ring: int = 0
) -> Any:
    view = np.zeros((), VIEW)
    view["splats"], view["capacity"], view["focused"], view["ring"] = (
        splats,
        capacity,
        focused,
        ring,
    )
    view["tiles_x"], view["tiles_y"] = TILES_X, TILES_Y
    return device.upload("view", view, "uniform")


@pytest.mark.parametrize("count", [1, 2, 255, 257, 2047, 2048, 2049, 10_000])
@pytest.mark.parametrize("kind", ["random", "few", "equal", "sorted", "reversed"])
def test_sorted_keys_are_numpys(device: Device, count: int, kind: str) -> None:
    """Catches a key lost at a block's edge, a digit's carry, and equal keys that change places."""
    random = np.random.default_rng(count)
    keys = {
        "random": random.integers(0, 1 << 32, count),
        "few": random.integers(0, 3, count) << 11,
        "equal": np.full(count, HIDDEN),
        "sorted": np.arange(count) * 400_000,
        "reversed": 0xFFFFFF00 - np.arange(count),
    }[kind].astype(np.uint32)
    with device.record() as work:
        found = sort_keys(work, device.upload("keys", keys), count, 32, view_of(device, count))
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(device.read(found[1], (count,), np.uint32), order)
    np.testing.assert_array_equal(device.read(found[0], (count,), np.uint32), keys[order])


def scene(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Depth keys with repetitions, and bounds of which some are empty, broken or the whole grid."""
    random = np.random.default_rng(seed)
    depth = np.float32(random.integers(1, 50, count) / 7)
    rect = np.zeros((count, 4), np.int32)
    rect[:, :2] = random.integers(0, (TILES_X, TILES_Y), (count, 2))
    rect[:, 2:] = np.minimum(rect[:, :2] + random.integers(1, 4, (count, 2)), (TILES_X, TILES_Y))
    rect[random.random(count) < 0.2] = 0
    rect[random.random(count) < 0.05] = -1
    rect[random.random(count) < 0.01] = (0, 0, TILES_X, TILES_Y)
    return np.where(rect[:, 2] > rect[:, 0], depth.view(np.uint32), np.uint32(HIDDEN)), rect


def listed(
    device: Device, depth_key: np.ndarray, rect: np.ndarray, capacity: int = CAPACITY,
    focus: np.ndarray | None = None, ring: int = 0, columns: np.ndarray | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Run the kernels; the tables by name. columns (N, PROJECTED): splats that fill their bounds by
    default."""
    count, tiles = len(rect), TILES_X * TILES_Y
    if columns is None:
        columns = np.tile(np.float32([0, 0, 1e-9, 0, 1e-9, 1, 0, 0, 0]), (count, 1))
    given = {
        "rect": rect,
        "depth_key": depth_key,
        "projected": columns,
        "focus": np.uint32(0 if focus is None else focus),
    }
    tables = {name: device.upload(name, np.atleast_1d(values)) for name, values in given.items()}
    tables["view"] = view_of(device, count, capacity, focus is not None, ring)
    with device.record() as work:
        choose_tiles(work, count, tiles, tables, focus is not None)
        list_pairs(work, count, tiles, capacity, tables)
    counts = device.read(counts_buffer(device), (COUNTS,), np.uint32)
    shapes = {"touched": (tiles,), "rendered": (tiles,), "tile_range": (tiles, 2)}
    shapes |= dict.fromkeys(("pair_slot", "slot_splat"), (int(counts[PAIRS]),))
    shapes |= {"slots": (count, 2), "wanted": (count,)}
    found = {name: device.read(tables[name], shape, np.uint32) for name, shape in shapes.items()}
    return found | {
        "counts": counts,
        "pair_splat": found["slot_splat"][found["pair_slot"]] & (WANTED - 1),
    }


def expected_lists(
    depth_key: np.ndarray, rect: np.ndarray, rendered: np.ndarray
) -> list[list[int]]:
    """The splats of every tile, near to far."""
    lists: list[list[int]] = [[] for _ in rendered]
    for i in np.argsort(depth_key, kind="stable"):
        for y in range(rect[i, 1], rect[i, 3]):
            for x in range(rect[i, 0], rect[i, 2]):
                if rendered[y * TILES_X + x]:
                    lists[y * TILES_X + x].append(int(i))
    return lists


@pytest.mark.parametrize("count", [1, 256, 257, 3000])
@pytest.mark.parametrize("focused", [False, True])
def test_every_tile_lists_its_splats_near_to_far(device: Device, count: int, focused: bool) -> None:
    """Catches pairs that are lost, counted twice, out of order, or whose slots are another
    splat's."""
    depth_key, rect = scene(count)
    focus = np.random.default_rng(1).random(count) < 3 / count if focused else None
    found = listed(device, depth_key, rect, focus=focus, ring=1)
    rendered, splat, slot = found["rendered"], found["pair_splat"], found["pair_slot"]
    if focused:
        grid = found["touched"].reshape(TILES_Y, TILES_X)
        padded = np.pad(grid, 1)
        near = [padded[y : y + TILES_Y, x : x + TILES_X] for y in range(3) for x in range(3)]
        np.testing.assert_array_equal(rendered, np.maximum.reduce(near).ravel())
        reached = expected_lists(depth_key, np.where(focus[:, None], rect, 0), np.ones(grid.size))
        np.testing.assert_array_equal(found["touched"], [len(members) > 0 for members in reached])
    else:
        assert rendered.all()
    for tile, members in enumerate(expected_lists(depth_key, rect, rendered)):
        first, past = found["tile_range"][tile]
        assert splat[first:past].tolist() == members, tile
    assert sorted(slot) == list(range(len(slot)))
    start, pairs = found["slots"].T
    np.testing.assert_array_equal(pairs, np.bincount(splat, minlength=count))
    assert ((slot >= start[splat]) & (slot < (start + pairs)[splat])).all()
    wanted = (pairs > 0) & (True if focus is None else focus)
    np.testing.assert_array_equal(found["wanted"], wanted)
    np.testing.assert_array_equal(found["slot_splat"][slot] >= WANTED, wanted[splat])


def test_more_tiles_than_a_digit_holds(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches large images, whose tiles need a second pass of the sort."""
    monkeypatch.setattr("raster.test_gpu_tiles.TILES_X", 130)
    monkeypatch.setattr("raster.test_gpu_tiles.TILES_Y", 70)
    depth_key, rect = scene(500)
    found = listed(device, depth_key, rect)
    for tile, members in enumerate(expected_lists(depth_key, rect, found["rendered"])):
        first, past = found["tile_range"][tile]
        assert found["pair_splat"][first:past].tolist() == members, tile


def test_pairs_that_do_not_fit_change_nothing_until_the_host_makes_room(device: Device) -> None:
    """Catches writes past the buffers, and an iteration that trains with half of its splats."""
    depth_key, rect = scene(1000)
    needed = int(np.clip(rect[:, 2:] - rect[:, :2], 0, None).prod(axis=1).sum())
    # the second would fit, but the first has not been repeated yet
    for capacity in (needed - 1, needed):
        found = listed(device, depth_key, rect, capacity)
        assert found["counts"][NEEDED] == needed
        assert found["counts"][OVERFLOWED] == 1
        assert not found["tile_range"].any()
        assert not found["wanted"].any()
        assert not found["slots"][:, 1].any()
    device.upload("counts", np.zeros(COUNTS, np.uint32))
    assert listed(device, depth_key, rect, needed)["counts"][PAIRS] == needed


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


def ellipses(kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Projected columns (count, PROJECTED) of splats on the grid and around it, and their bounds in
    tiles."""
    rng, size = np.random.default_rng(5), np.array([TILES_X, TILES_Y]) * TILE
    longest, shortest = {
        "round": (30, 2),
        "needles": (90, 0.6),
        "tiny": (0.7, 0.55),
        "huge": (3000, 200),
    }[kind]
    _, xx, xy, yy = covariances(rng, count, longest, shortest, kind == "needles")
    opacity = rng.uniform(0.005, 1, count)
    mean = rng.uniform((-20, -20), size + 20, (count, 2))
    columns = np.zeros((count, PROJECTED), np.float32)
    columns[:, :6] = np.stack([*mean.T, yy / (xx * yy - xy**2), xy / yy, 1 / yy, opacity], -1)
    extent = np.sqrt(2 * np.log(255 * opacity))[:, None] * np.sqrt(np.stack([xx, yy], -1))
    first = np.clip(np.floor((mean - extent) / TILE), 0, (TILES_X, TILES_Y))
    past = np.clip(np.ceil((mean + extent) / TILE), 0, (TILES_X, TILES_Y))
    rect = np.concatenate([first, past], 1).astype(np.int32)
    return columns, np.where((past > first).all(1)[:, None], rect, 0)


def reached(columns: np.ndarray, spare: float) -> np.ndarray:
    """(N, tiles) bool: whether a pixel of the tile has its center in the outline, made larger by a
    share `spare`."""
    x, y = (np.arange(side * TILE) + 0.5 for side in (TILES_X, TILES_Y))
    found = []
    for mean_x, mean_y, precision_x, shear, precision_y, opacity in columns[:, :6].astype(
        np.float64
    ):
        dy = (y - mean_y)[:, None]
        inside = precision_x * (x - mean_x - shear * dy) ** 2 + precision_y * dy**2 <= 2 * np.log(
            255 * opacity
        ) * (1 + spare)
        found.append(inside.reshape(TILES_Y, TILE, TILES_X, TILE).any(axis=(1, 3)).ravel())
    return np.array(found)


@pytest.mark.parametrize("kind", ["round", "needles", "tiny", "huge"])
def test_a_splat_is_listed_where_its_outline_reaches(device: Device, kind: str) -> None:
    """Catches a tile whose pixels lose a splat, and lists as long as those of bounding boxes."""
    columns, rect = ellipses(kind, 300)
    depth = np.random.default_rng(2).integers(1, 90, 300).astype(np.uint32)
    visible = rect[:, 2] > rect[:, 0]
    found = listed(device, np.where(visible, depth, np.uint32(HIDDEN)), rect, columns=columns)
    # as on the CPU, also where no pixel is reached
    np.testing.assert_array_equal(found["wanted"], visible)
    pairs = np.zeros((300, TILES_X * TILES_Y), bool)
    for tile, (first, past) in enumerate(found["tile_range"]):
        members = found["pair_splat"][first:past]
        assert (np.diff(depth[members].astype(int)) >= 0).all(), tile
        pairs[members, tile] = True
    assert not (reached(columns, -1e-5) & ~pairs).any()
    boxes = np.prod(rect[:, 2:] - rect[:, :2], axis=1).sum()
    assert pairs.sum() == found["counts"][PAIRS] <= boxes
    assert (pairs & ~reached(columns, 0.02)).sum() <= 0.02 * pairs.sum() + (
        60 if kind == "tiny" else 10
    )
    if kind == "needles":
        assert pairs.sum() < 0.5 * boxes
