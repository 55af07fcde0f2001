"""Projected splats to tiles: the tiles to be rendered, and every tile's list of pairs, near to far.

The splats are sorted by depth, write their (tile, splat) pairs in that order, and a stable sort by tile alone keeps it.
A splat has a pair with each rendered tile that its outline reaches; its bounding box would count more.
How many pairs there are is known on the device only, so everything that follows is dispatched indirectly.
"""

from typing import Any, NamedTuple

from .device import Device, Groups, Recording
from .layout import COUNTS, DIGIT_BITS, PAIR_GROUPS, SORT_BLOCK, SORT_GROUPS, WORKGROUP

DEPTH_BITS, MAX_TILE_BITS = 32, 22
INCLUDE = ("numbers", "outline")


class Tiles(NamedTuple):
    """Which of the tiles are touched by the focus and rendered; tables as in `layout.py`."""

    touched: Any
    rendered: Any
    tile_range: Any


class PairLists(NamedTuple):
    """The (tile, splat) pairs, by tile and by splat; tables as in `layout.py`."""

    pair_slot: Any
    slot_splat: Any
    slots: Any
    wanted: Any


def counts_buffer(device: Device) -> Any:
    """The counts of pairs, see `layout.py`."""
    return device.buffer("counts", COUNTS, "indirect")


def choose_tiles(work: Recording, count: int, tiles: int, *, view: Any, rect: Any, focus: Any | None) -> Tiles:
    """Record which of `tiles` tiles are rendered of `count` splats; focus (N,): see `mark_focus`, None for all."""
    device = work.device
    tile_table = Tiles(
        device.buffer("touched", tiles), device.buffer("rendered", tiles), device.buffer("ranges", 2 * tiles)
    )
    given = {"view": view, "rect": rect, "focus": rect if focus is None else focus}
    if focus is not None:
        work.clear(tile_table.touched, tiles)
        work.dispatch(device.kernel("tiles", "mark"), device.groups(count), **given, **tile_table._asdict())
    work.dispatch(device.kernel("tiles", "choose"), device.groups(tiles), **given, **tile_table._asdict())
    return tile_table


def list_pairs(
    work: Recording, count: int, tiles: int, capacity: int, *, view: Any, depth_key: Any, rect: Any, projected: Any,
    tile_table: Tiles, focus: Any | None,
) -> PairLists:  # fmt: skip
    """Record the lists of the rendered tiles, with room for `capacity` pairs, and fill `tile_table.tile_range`."""
    device, counts, groups = work.device, counts_buffer(work.device), work.device.groups(count)
    kernel, buffer = device.kernel, device.buffer
    _, order = sort_keys(work, depth_key, count, DEPTH_BITS, view=view)
    wanted, slots = buffer("wanted", count), buffer("slots", 2 * count)
    counted = {
        "view": view, "order": order, "rect": rect, "projected": projected, "rendered": tile_table.rendered,
        "counts": counts, "pairs_until": buffer("pairs_until", count + -(-count // WORKGROUP)), "wanted": wanted,
    }  # fmt: skip
    given = {**counted, "focus": rect if focus is None else focus}
    work.dispatch(kernel("count_pairs", "count", INCLUDE), groups, **given)
    work.dispatch(kernel("count_pairs", "total", INCLUDE), (1, 1, 1), **given)
    slot_tile, slot_splat = buffer("slot_tile", capacity), buffer("slot_splat", capacity)
    work.dispatch(
        kernel("fill_pairs", include=INCLUDE), groups, **counted, slots=slots, slot_tile=slot_tile,
        slot_splat=slot_splat,
    )  # fmt: skip
    pair_tile, pair_slot = sort_keys(work, slot_tile, capacity, tiles.bit_length(), view=view, of_pairs=True)
    work.dispatch(
        kernel("tile_lists"), (counts, 4 * PAIR_GROUPS), counts=counts, pair_tile=pair_tile,
        tile_range=tile_table.tile_range,
    )  # fmt: skip
    return PairLists(pair_slot, slot_splat, slots, wanted)


def sort_keys(
    work: Recording, keys: Any, room: int, bits: int, *, view: Any, of_pairs: bool = False
) -> tuple[Any, Any]:
    """Record sorting of the keys, of which the lowest `bits` count; equal keys keep their order.

    There are as many keys as splats, or as pairs, and room for so many. Returns buffers of the sorted keys and of
    their numbers before; `keys` may be overwritten.
    """
    device, counts = work.device, counts_buffer(work.device)
    buffer, kernel, blocks = device.buffer, device.kernel, -(-room // SORT_BLOCK)
    groups: Groups = (counts, 4 * SORT_GROUPS) if of_pairs else (blocks, 1, 1)
    name, values = "pair" if of_pairs else "splat", counts  # the first pass reads no values
    # The gradients of the pairs are written when the sorted tiles have been read.
    first = "pair_gradients" if of_pairs else "splat_keys"
    targets = [(buffer(first, room), buffer(f"{name}_numbers", room))]
    if bits > DIGIT_BITS:
        targets.append((keys, buffer(f"{name}_numbers 2", room)))
    for n, constants in enumerate(_passes(bits, of_pairs)):
        buffers = {
            "view": view, "counts": counts, "keys": keys, "values": values, "sorted_keys": targets[n % 2][0],
            "sorted_values": targets[n % 2][1], "block_digits": buffer("block_digits", blocks << DIGIT_BITS),
            "digit_totals": buffer("digit_totals", 1 << DIGIT_BITS),
        }  # fmt: skip
        work.dispatch(kernel("sort", "count", **constants), groups, **buffers)
        work.dispatch(kernel("sort", "place", **constants), device.groups(1 << DIGIT_BITS), **buffers)
        work.dispatch(kernel("sort", "scatter", **constants), groups, **buffers)
        keys, values = targets[n % 2]
    return keys, values


def _passes(bits: int, of_pairs: bool) -> list[dict[str, Any]]:
    """The constants of sort.wgsl in each pass."""
    return [{"SHIFT": shift, "FIRST": shift == 0, "OF_PAIRS": of_pairs} for shift in range(0, bits, DIGIT_BITS)]


def compile_kernels(device: Device) -> None:
    """Compile what this module dispatches, for images of up to 2²² tiles."""
    for entry in ("mark", "choose"):
        device.kernel("tiles", entry)
    for entry in ("count", "total"):
        device.kernel("count_pairs", entry, INCLUDE)
    device.kernel("fill_pairs", include=INCLUDE)
    device.kernel("tile_lists")
    for constants in (*_passes(DEPTH_BITS, False), *_passes(MAX_TILE_BITS, True)):
        for entry in ("count", "place", "scatter"):
            device.kernel("sort", entry, **constants)
