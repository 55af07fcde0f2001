"""Rendering on a WebGPU device: splats and a camera to an image, and its gradient back to the
splats.

Three stages, a WGSL file each: `project` places and colors splats, `tiles` lists those of a tile,
`blend` draws them. They share tables, which are the device's buffers of the same names.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ..cpu.layout import PIXELS, PROJECTED, TILE, CameraFrames, Parameters
from ..cpu.rasterize import tile_grid
from . import layout
from .device import Device, Groups, Recording
from .layout import COUNTS, DIGIT_BITS, SEGMENT_PAIRS, SORT_BLOCK, WORKGROUP

INITIAL_PAIR_CAPACITY = 1 << 18
"""Pairs that a rasterizer has room for at first: 18 MB."""
DEPTH_BITS = 32
MAX_TILE_BITS = 22
Tables = dict[str, Any]


@dataclass(frozen=True)
class SplatTable:
    """N splats on the device.

    rows, face  tables of `layout.py`: (N, stride) and the triangle (N,) of each
    count, coefficients  N and K
    """

    rows: Any
    face: Any
    count: int
    coefficients: int

    @property
    def stride(self) -> int:
        """Words per row."""
        return layout.SH + 3 * self.coefficients


@dataclass(frozen=True)
class ViewOptions:
    """What a rendering depends on beside splats and frames; see `cpu.rasterize.render_forward`.

    focused: whether there is a focus.
    """

    camera: Camera
    degree: int
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
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
        self,
        work: Recording,
        splats: SplatTable,
        frames: Any,
        options: ViewOptions,
        view: Any,
        focus: Any = None,
    ) -> Tables:
        """Record a rendering; view: of `upload_view`; focus (N,): see `mark_focus`, if
        `options.focused`.

        Returns its tables, valid until the device's next rendering: the image (3, H, W) over the
        background and what `backward` needs.
        """
        tables = {"view": view, "splats": splats.rows, "face": splats.face, "frames": frames}
        make_projected(self.device, splats.count)
        work.dispatch("project.forward", splats.count, tables)
        return tables | self.draw(work, view, splats.count, options.camera, focus)

    def draw(
        self, work: Recording, view: Any, count: int, camera: Camera, focus: Any = None
    ) -> Tables:
        """Record the rendering of `count` projected splats.

        Splats are sorted by depth and write their (tile, splat) pairs in that order, which a stable
        sort by tile keeps. A splat has a pair with each rendered tile that its outline reaches; its
        bounding box would count more. How many pairs there are is known on the device only, so
        everything that follows is dispatched indirectly.
        """
        columns, rows = tile_grid(camera.width, camera.height)
        tiles = columns * rows
        room = self.capacity
        buffer = self.device.buffer
        counts = counts_buffer(self.device)
        words = {"touched": tiles, "rendered": tiles, "wanted": count, "slots": 2 * count}
        words |= {"tile_range": 2 * tiles, "slot_tile": room, "slot_splat": room}
        cuts = room // SEGMENT_PAIRS + 1
        words |= {"segments": 4 * PIXELS * cuts, "segment_tile": cuts}
        words["pairs_until"] = count + -(-count // WORKGROUP)
        tables = {name: buffer(name, each) for name, each in words.items()}
        tables |= {"view": view, "focus": buffer("rect", 0) if focus is None else focus}
        if focus is not None:
            work.clear(tables["touched"], tiles)
            work.dispatch("tiles.mark_touched", count, tables)
        work.dispatch("tiles.choose_rendered", tiles, tables)
        keys = buffer("depth_key", 0)
        _, tables["order"] = sort_keys(work, keys, count, DEPTH_BITS, view)
        work.dispatch("tiles.count_pairs", count, tables)
        work.dispatch("tiles.add_pairs", (1, 1, 1), tables)
        work.dispatch("tiles.fill_pairs", count, tables)
        keys = tables["slot_tile"]
        bits = tiles.bit_length()
        by_tile = sort_keys(work, keys, room, bits, view, of_pairs=True)
        tables["pair_tile"], tables["pair_slot"] = by_tile
        work.dispatch("tiles.find_ranges", (counts, 4 * layout.PAIR_GROUPS), tables)
        return blend(work, camera, tables)

    def backward(
        self,
        work: Recording,
        rendering: Tables,
        splats: SplatTable,
        camera: Camera,
        v_image: Any,
        gradients: Any,
        v_transmittance: Any = None,
    ) -> Any:
        """Record the gradient of a scalar with respect to the splats, from that with respect to the
        image.

        v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites the wanted rows of
        `gradients`. Returns `screen` (N,): for these rows, the length of the gradient with respect
        to the projected center in units of half the image.
        """
        given = {"gradients": gradients, "screen": self.device.buffer("screen", splats.count)}
        tables = self._blend_backward(work, rendering, camera, v_image, v_transmittance)
        work.dispatch("project.backward", splats.count, tables | given)
        return given["screen"]

    def blend_weights(
        self, work: Recording, rendering: Tables, splats: SplatTable, camera: Camera
    ) -> Any:
        """Record how many pixels each splat fills in a rendering of the whole image: the sums (N,)
        of its blend weights."""
        v_image = np.zeros((3, camera.height, camera.width), np.float32)
        v_image[0] = 1
        uploaded = self.device.upload("v_image", v_image)
        tables = self._blend_backward(work, rendering, camera, uploaded)
        weights = tables["blend_weights"] = self.device.buffer("blend_weights", splats.count)
        work.dispatch("project.sum_weights", splats.count, tables)
        return weights

    def _blend_backward(
        self,
        work: Recording,
        rendering: Tables,
        camera: Camera,
        v_image: Any,
        v_transmittance: Any = None,
    ) -> Tables:
        """Record the backward pass of blending, which writes the gradient of every pair of a splat
        and a tile; returns the tables of the rendering and of these gradients."""
        self.device.buffer("pair_gradients", PROJECTED * self.capacity)
        constants = {} if v_transmittance is None else {"HAS_V_TRANSMITTANCE": True}
        # The shader binds both; it does not read v_transmittance without the constant.
        tables = rendering | {"v_image": v_image, "v_transmittance": v_transmittance or v_image}
        columns, rows = tile_grid(camera.width, camera.height)
        groups = Device.groups_of(columns * rows + self.capacity // SEGMENT_PAIRS + 1)
        work.dispatch("blend.backward", groups, tables, **constants)
        return tables

    def pairs_fit(self) -> bool:
        """Wait for the submitted work; whether its pairs fitted. If not, room for them is made."""
        counts = self.device.read(counts_buffer(self.device), (COUNTS,), np.uint32)
        if counts[layout.OVERFLOWED]:
            self.make_room(int(counts[layout.NEEDED]))
        return not counts[layout.OVERFLOWED]

    def make_room(self, needed: int) -> None:
        """Hold at least so many pairs from now on, and an eighth to spare, and let renderings begin
        again."""
        self.capacity = max(self.capacity, needed + needed // 8)
        self.device.upload("counts", np.zeros(COUNTS, np.uint32), "indirect")

    def upload_view(
        self,
        splats: SplatTable,
        options: ViewOptions,
        to_world: np.ndarray | None = None,
        first: int = 0,
        name: str = "view",
    ) -> Any:
        """Send the uniform of that name for the next rendering.

        to_world (3, 3): from the camera to the space of the harmonics' directions, where that is
        not the world; first: row of the splats in the tables of projected ones.
        """
        camera = options.camera
        to_world = camera.rotation.T if to_world is None else to_world
        columns, rows = tile_grid(camera.width, camera.height)
        return self.device.uniform(
            "View",
            name,
            to_world=np.c_[to_world, np.zeros(3)],
            background=(*options.background, 0),
            fl_x=camera.fl_x,
            fl_y=camera.fl_y,
            cx=camera.cx,
            cy=camera.cy,
            width=camera.width,
            height=camera.height,
            tiles_x=columns,
            tiles_y=rows,
            splats=splats.count,
            coefficients=splats.coefficients,
            degree=options.degree,
            depth_as_color=options.depth_as_color,
            antialiased=options.antialiased,
            focused=options.focused,
            ring=-(-options.reach // TILE),
            capacity=self.capacity,
            first=first,
        )


def upload_splats(
    device: Device, splats: Parameters, face: np.ndarray, layer: str = ""
) -> SplatTable:
    """Numpy arrays of splats as a table on the device; layer: part of its name where there are
    several."""
    rows = layout.splat_rows(splats)
    table = device.upload(f"splats{layer}", rows)
    faces = device.upload(f"face{layer}", face.astype(np.uint32))
    return SplatTable(table, faces, len(rows), splats.sh.shape[1])


def upload_frames(device: Device, frames: CameraFrames, layer: str = "") -> Any:
    """Frames in camera space, computed on the CPU, as a table on the device; layer: as in
    `upload_splats`."""
    count = len(frames.origin)
    rows = np.zeros((count, layout.FRAME_STRIDE), np.float32)
    rows[:, : layout.FRAME_MATRIX] = frames.origin
    rows[:, layout.FRAME_MATRIX : layout.FRAME_COLOR] = frames.matrix.reshape(count, 9)
    if frames.color.shape[1]:
        rows[:, layout.FRAME_COLOR :] = frames.color
    return device.upload(f"frames{layer}", rows)


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


def make_projected(device: Device, count: int) -> None:
    """Make room for `count` projected splats."""
    for name, words in {"projected": PROJECTED, "depth_key": 1, "rect": 4}.items():
        device.buffer(name, count * words)


def sort_keys(
    work: Recording, keys: Any, room: int, bits: int, view: Any, *, of_pairs: bool = False
) -> tuple[Any, Any]:
    """Record sorting of the keys, of which the lowest `bits` count; equal keys keep their order.

    There are as many keys as splats, or as pairs, and room for so many. Returns buffers of the
    sorted keys and of their numbers before; `keys` may be overwritten.
    """
    counts = counts_buffer(work.device)
    buffer = work.device.buffer
    blocks = -(-room // SORT_BLOCK)
    groups: Groups = (counts, 4 * layout.SORT_GROUPS) if of_pairs else (blocks, 1, 1)
    buffer("block_digits", blocks << DIGIT_BITS)
    buffer("digit_totals", 1 << DIGIT_BITS)
    # the first pass reads no values
    name = "pair" if of_pairs else "splat"
    values = counts
    # The gradients of the pairs are written when the sorted tiles have been read.
    first = "pair_gradients" if of_pairs else "splat_keys"
    targets = [(buffer(first, room), buffer(f"{name}_numbers", room))]
    if bits > DIGIT_BITS:
        targets.append((keys, buffer(f"{name}_numbers 2", room)))
    for n, constants in enumerate(sort_passes(bits, of_pairs)):
        tables = {
            "view": view,
            "keys": keys,
            "values": values,
            "sorted_keys": targets[n % 2][0],
            "sorted_values": targets[n % 2][1],
        }
        work.dispatch("sort.count", groups, tables, **constants)
        work.dispatch("sort.place", 1 << DIGIT_BITS, tables, **constants)
        work.dispatch("sort.scatter", groups, tables, **constants)
        keys, values = targets[n % 2]
    return keys, values


def sort_passes(bits: int, of_pairs: bool) -> list[dict[str, Any]]:
    """The constants of sort.wgsl in each pass."""
    shifts = range(0, bits, DIGIT_BITS)
    return [{"SHIFT": shift, "FIRST": shift == 0, "OF_PAIRS": of_pairs} for shift in shifts]


def blend(work: Recording, camera: Camera, tables: Tables) -> Tables:
    """Record the blending of the rendered tiles; image and pixels, which are added to the tables,
    are undefined in others."""
    area = camera.width * camera.height
    (columns, rows) = tile_grid(camera.width, camera.height)
    buffer = work.device.buffer
    tables |= {"image": buffer("image", 3 * area), "pixels": buffer("pixels", 2 * area)}
    work.dispatch("blend.forward", Device.groups_of(columns * rows), tables)
    return tables
