"""Rendering on a WebGPU device: splats and a camera to an image, and its gradient back to the
splats.

Three stages, a WGSL file each: `project` places and colors splats, `tiles` lists those of a tile,
`blend` draws them. They share tables, by the names of `layout.py`; a function that records a stage
adds its own to those given.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ..cpu.layout import PROJECTED, TILE, CameraFrames, Parameters
from ..cpu.rasterize import tile_grid
from .device import Device, Groups, Recording
from .layout import (
    COUNTS,
    DIGIT_BITS,
    NEEDED,
    OVERFLOWED,
    PAIR_GROUPS,
    SH,
    SORT_BLOCK,
    SORT_GROUPS,
    VIEW,
    WORKGROUP,
    splat_rows,
)  # fmt: skip

INITIAL_PAIR_CAPACITY = 1 << 18
"""Pairs that a rasterizer has room for at first: 14 MB."""
DEPTH_BITS, MAX_TILE_BITS = 32, 22
Tables = dict[str, Any]


@dataclass(frozen=True)
class SplatTable:
    """N splats on the device.

    rows, face  tables of `layout.py`: (N, stride) and the triangle (N,) of each
    count, coefficients, strain_colors  N, K and S
    """

    rows: Any
    face: Any
    count: int
    coefficients: int
    strain_colors: int

    @property
    def stride(self) -> int:
        """Words per row."""
        return SH + 3 * (self.coefficients + self.strain_colors)


@dataclass(frozen=True)
class ViewOptions:
    """What a rendering depends on beside splats and frames; see `cpu.rasterize.render_forward`.

    strains: columns of strain in the table of frames; focused: whether there is a focus.
    """

    camera: Camera
    degree: int
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    strains: int = 0
    depth_as_color: bool = False
    antialiased: bool = False
    focused: bool = False
    reach: int = 0


class Rasterizer:
    """Renders on one device, forward and backward, with room for `capacity` pairs.

    Where the pairs do not fit, nothing is rendered and no splat is wanted, now and later, until
    `make_room`.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.capacity = INITIAL_PAIR_CAPACITY

    def forward(
        self, work: Recording, splats: SplatTable, frames: Any, options: ViewOptions, view: Any,
        focus: Any = None,
    ) -> Tables:  # fmt: skip
        """Record a rendering; view: of `upload_view`; focus (N,): see `mark_focus`, if
        `options.focused`.

        Returns its tables, valid until the device's next rendering: the image (3, H, W) over the
        background and those of `layout.py`.
        """
        tables = projected_tables(self.device, splats.count)
        tables |= {"view": view, "splats": splats.rows, "face": splats.face, "frames": frames}
        work.dispatch("project.forward", splats.count, tables)
        return self.draw(work, tables, splats.count, options.camera, focus)

    def draw(
        self, work: Recording, tables: Tables, count: int, camera: Camera, focus: Any = None
    ) -> Tables:
        """Record the rendering of `count` projected splats, with the view in `tables`.

        Splats are sorted by depth and write their (tile, splat) pairs in that order, which a stable
        sort by tile keeps. A splat has a pair with each rendered tile that its outline reaches; its
        bounding box would count more. How many pairs there are is known on the device only, so
        everything that follows is dispatched indirectly.
        """
        columns, rows = tile_grid(camera.width, camera.height)
        tiles, room, buffer = columns * rows, self.capacity, self.device.buffer
        words = {"touched": tiles, "rendered": tiles, "wanted": count, "slots": 2 * count}
        words |= dict.fromkeys(("slot_tile", "slot_splat"), room)
        words["pairs_until"] = count + -(-count // WORKGROUP)
        tables |= {name: buffer(name, each) for name, each in words.items()}
        tables["tile_range"] = buffer("ranges", 2 * tiles)
        tables["counts"] = counts_buffer(self.device)
        tables["focus"] = tables["rect"] if focus is None else focus
        if focus is not None:
            work.clear(tables["touched"], tiles)
            work.dispatch("tiles.mark_touched", count, tables)
        work.dispatch("tiles.choose_rendered", tiles, tables)
        view = tables["view"]
        _, tables["order"] = sort_keys(work, tables["depth_key"], count, DEPTH_BITS, view)
        work.dispatch("tiles.count_pairs", count, tables)
        work.dispatch("tiles.add_pairs", (1, 1, 1), tables)
        work.dispatch("tiles.fill_pairs", count, tables)
        keys, bits = tables["slot_tile"], tiles.bit_length()
        by_tile = sort_keys(work, keys, room, bits, view, of_pairs=True)
        tables["pair_tile"], tables["pair_slot"] = by_tile
        work.dispatch("tiles.find_ranges", (tables["counts"], 4 * PAIR_GROUPS), tables)
        blend(work, camera, tables)
        return tables

    def backward(
        self, work: Recording, rendering: Tables, splats: SplatTable, camera: Camera, v_image: Any,
        gradients: Any, v_transmittance: Any = None,
    ) -> Any:  # fmt: skip
        """Record the gradient of a scalar with respect to the splats, from that with respect to the
        image.

        v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites the wanted rows of
        `gradients`. Returns `screen` (N,): for these rows, the length of the gradient with respect
        to the projected center in units of half the image.
        """
        columns, rows = tile_grid(camera.width, camera.height)
        tables = {
            **rendering,
            "v_image": v_image,
            "v_transmittance": v_image if v_transmittance is None else v_transmittance,
            "pair_gradients": self.device.buffer("pair_gradients", PROJECTED * self.capacity),
            "gradients": gradients,
            "screen": self.device.buffer("screen", splats.count),
        }
        constants = {"HAS_V_TRANSMITTANCE": True} if v_transmittance is not None else {}
        work.dispatch("blend.backward", Device.groups_of(columns * rows), tables, **constants)
        work.dispatch("project.backward", splats.count, tables)
        return tables["screen"]

    def pairs_fit(self) -> bool:
        """Wait for the submitted work; whether its pairs fitted. If not, room for them is made."""
        counts = self.device.read(counts_buffer(self.device), (COUNTS,), np.uint32)
        if counts[OVERFLOWED]:
            self.make_room(int(counts[NEEDED]))
        return not counts[OVERFLOWED]

    def make_room(self, needed: int) -> None:
        """Hold at least so many pairs from now on, and an eighth to spare, and let renderings begin
        again."""
        self.capacity = max(self.capacity, needed + needed // 8)
        self.device.upload("counts", np.zeros(COUNTS, np.uint32), "indirect")

    def upload_view(
        self, splats: SplatTable, options: ViewOptions, to_world: np.ndarray | None = None,
        first: int = 0, name: str = "view",
    ) -> Any:  # fmt: skip
        """Send the uniform of that name for the next rendering.

        to_world (3, 3): from the camera to the space of the harmonics' directions, where that is
        not the world; first: row of the splats in the tables of projected ones.
        """
        camera, view = options.camera, np.zeros((), VIEW)
        to_world = camera.world_to_camera[:3, :3].T if to_world is None else to_world
        columns, rows = tile_grid(camera.width, camera.height)
        view[...] = (
            camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.width, camera.height, columns,
            rows, *to_world.ravel(), *options.background, splats.count, splats.coefficients,
            splats.strain_colors, options.degree, min(options.strains, splats.strain_colors),
            options.strains, options.depth_as_color, options.antialiased, options.focused,
            -(-options.reach // TILE), self.capacity, first,
        )  # fmt: skip
        return self.device.upload(name, view, "uniform")


def upload_splats(
    device: Device, splats: Parameters, face: np.ndarray, layer: str = ""
) -> SplatTable:
    """Numpy arrays of splats as a table on the device; layer: part of its name where there are
    several."""
    rows = splat_rows(splats)
    strain_colors = 0 if splats.strain_color is None else splats.strain_color.shape[1]
    table = device.upload(f"splats{layer}", rows)
    faces = device.upload(f"face{layer}", face.astype(np.uint32))
    return SplatTable(table, faces, len(rows), splats.sh.shape[1], strain_colors)


def upload_frames(device: Device, frames: CameraFrames, layer: str = "") -> Any:
    """Frames in camera space, computed on the CPU, as a table on the device; layer: as in
    `upload_splats`."""
    count = len(frames.origin)
    parts = (frames.origin, frames.matrix.reshape(count, 9), frames.strain)
    return device.upload(f"frames{layer}", np.concatenate(parts, axis=1, dtype=np.float32))


def counts_buffer(device: Device) -> Any:
    """The counts of pairs, see `layout.py`."""
    return device.buffer("counts", COUNTS, "indirect")


def mark_focus(work: Recording, splats: SplatTable, view: Any, selected: Any) -> Any:
    """Record which splats ride on a selected triangle: (N,) 0 or 1; selected (F,): uploaded as
    bytes."""
    focus = work.device.buffer("focus", splats.count)
    tables = {"view": view, "face": splats.face, "selected": selected, "focus": focus}
    work.dispatch("project.mark_focus", splats.count, tables)
    return focus


def projected_tables(device: Device, count: int) -> Tables:
    """Room for `count` projected splats."""
    words = {"projected": PROJECTED, "depth_key": 1, "rect": 4}
    return {name: device.buffer(name, count * each) for name, each in words.items()}


def sort_keys(
    work: Recording, keys: Any, room: int, bits: int, view: Any, *, of_pairs: bool = False
) -> tuple[Any, Any]:
    """Record sorting of the keys, of which the lowest `bits` count; equal keys keep their order.

    There are as many keys as splats, or as pairs, and room for so many. Returns buffers of the
    sorted keys and of their numbers before; `keys` may be overwritten.
    """
    counts, buffer, blocks = counts_buffer(work.device), work.device.buffer, -(-room // SORT_BLOCK)
    groups: Groups = (counts, 4 * SORT_GROUPS) if of_pairs else (blocks, 1, 1)
    name, values = "pair" if of_pairs else "splat", counts  # the first pass reads no values
    # The gradients of the pairs are written when the sorted tiles have been read.
    first = "pair_gradients" if of_pairs else "splat_keys"
    targets = [(buffer(first, room), buffer(f"{name}_numbers", room))]
    if bits > DIGIT_BITS:
        targets.append((keys, buffer(f"{name}_numbers 2", room)))
    for n, constants in enumerate(sort_passes(bits, of_pairs)):
        tables = {
            "view": view, "counts": counts, "keys": keys, "values": values,
            "sorted_keys": targets[n % 2][0], "sorted_values": targets[n % 2][1],
            "block_digits": buffer("block_digits", blocks << DIGIT_BITS),
            "digit_totals": buffer("digit_totals", 1 << DIGIT_BITS),
        }  # fmt: skip
        work.dispatch("sort.count", groups, tables, **constants)
        work.dispatch("sort.place", 1 << DIGIT_BITS, tables, **constants)
        work.dispatch("sort.scatter", groups, tables, **constants)
        keys, values = targets[n % 2]
    return keys, values


def sort_passes(bits: int, of_pairs: bool) -> list[dict[str, Any]]:
    """The constants of sort.wgsl in each pass."""
    shifts = range(0, bits, DIGIT_BITS)
    return [{"SHIFT": shift, "FIRST": shift == 0, "OF_PAIRS": of_pairs} for shift in shifts]


def blend(work: Recording, camera: Camera, tables: Tables) -> None:
    """Record the blending of the rendered tiles; image and pixels are undefined in others."""
    area, (columns, rows) = camera.width * camera.height, tile_grid(camera.width, camera.height)
    buffer = work.device.buffer
    tables |= {"image": buffer("image", 3 * area), "pixels": buffer("pixels", 2 * area)}
    work.dispatch("blend.forward", Device.groups_of(columns * rows), tables)
