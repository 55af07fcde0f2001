"""Splats and a camera to an image, and its gradient back to the splats, on a Warp device."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...capture.camera import Camera
from ..cpu.layout import PIXELS, TILE
from ..cpu.rasterize import BLACK, Parameters, tile_grid
from . import blend
from . import tiles as bins
from .buffers import DeviceBufferPool
from .project import Lens, Projected, project_backward, project_forward

FIRST_CAPACITY = 1 << 18
"""Pairs that a rasteriser has room for at first: 25 MB."""
TYPES = Parameters(wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.vec3)
"""What the kernels see in a row of each parameter, or, of the last two, in a coefficient."""


@dataclass(frozen=True)
class DeviceFrames:
    """Camera-space frames and strain of the triangles, as in `CameraFrames`, with how to draw."""

    origin: wp.array
    matrix: wp.array
    strain: wp.array
    lens: Lens


@dataclass(frozen=True)
class DeviceRenderOutput:
    """An image and what its backward pass needs; valid until the rasteriser's next one.

    image (3, H, W) float32 over the background; transmittance (H, W) = 1 − alpha; undefined where no tile was drawn.
    wanted (N,) uint8: the splats of the focus that are seen, whose gradient the backward pass writes.
    touched, drawn (tiles,) uint8: tiles that a splat of the focus reaches, and those that were rendered.
    """

    image: wp.array
    transmittance: wp.array
    wanted: wp.array
    touched: wp.array
    drawn: wp.array
    projected: wp.array
    rect: wp.array
    last: wp.array
    first: wp.array
    past: wp.array
    slot_start: wp.array
    slot_count: wp.array
    pair_splat: wp.array
    pair_slot: wp.array
    background: wp.vec3
    frames: DeviceFrames


class Rasteriser:
    """Renders on one device, forward and backward, into buffers of its own.

    The host never waits for the device in `backward`, and in `forward` only if it is told to.
    """

    def __init__(self, device: str) -> None:
        self.device = wp.get_device(device)
        self.scratch = DeviceBufferPool(self.device)
        self._capacity = FIRST_CAPACITY
        self._pairs = wp.zeros(1, wp.int32, device="cpu", pinned=self.device.is_cuda)
        self._counted = wp.Event(self.device) if self.device.is_cuda else None

    def forward(
        self,
        splats: Parameters,
        face: wp.array,
        frames: DeviceFrames,
        background: np.ndarray = BLACK,
        focus: wp.array | None = None,
        reach: int = 0,
        wait: bool = True,
    ) -> DeviceRenderOutput:
        """Render N embedded splats over a background colour (3,); Warp arrays of `TYPES`.

        focus (N,) uint8 and reach: as the focus and reach of `raster.render.render_forward`.
        Without `wait`, the image may lack everything because the pairs did not fit; `complete` tells.
        """
        n, lens, take = face.size, frames.lens, self.scratch.take
        depth, order = take("depth", 2 * n), take("order", 2 * n, wp.int32)
        projected, rect = take("projected", n, Projected), take("rect", n, wp.vec4i)
        self.launch(
            project_forward, n,
            *splats, face, frames.origin, frames.matrix, frames.strain, lens, projected, depth, order, rect,
        )  # fmt: skip
        touched, drawn = self._tiles(rect, focus, lens, -(-reach // TILE))
        if focus is None:
            focus = take("everything", n, wp.uint8)
            focus.fill_(1)
        count, end = take("count", n, wp.int32), take("end", n, wp.int32)
        if n:
            wp.utils.radix_sort_pairs(depth, order, n)
            self.launch(bins.count_pairs, n, order, rect, drawn, lens.tiles_x, count)
            wp.utils.array_scan(count, end, inclusive=True)
            wp.copy(self._pairs, end, src_offset=n - 1, count=1)
        else:
            self._pairs.zero_()
        if self._counted is not None:
            wp.get_stream(self.device).record_event(self._counted)
        if wait:
            self.complete()
        pairs = self._fill(order, rect, drawn, count, end, focus, lens)
        image = take("image", (3, lens.height, lens.width))
        transmittance = take("transmittance", (lens.height, lens.width))
        last = take("last", (lens.height, lens.width), wp.int32)
        rendering = DeviceRenderOutput(
            image, transmittance, touched=touched, drawn=drawn, projected=projected, rect=rect, last=last,
            background=wp.vec3(*(float(c) for c in background)), frames=frames, **pairs,
        )  # fmt: skip
        self.launch(
            blend.blend_forward, drawn.size * PIXELS,
            lens.tiles_x, drawn, rendering.first, rendering.past, rendering.pair_splat, projected,
            rendering.background, image, transmittance, last,
        )  # fmt: skip
        return rendering

    def complete(self) -> bool:
        """Wait for the last rendering's number of pairs; whether they fitted. If not, make room for next time."""
        if self._counted is not None:
            wp.synchronize_event(self._counted)
        pairs = int(self._pairs.numpy()[0])
        if pairs < 0:
            raise MemoryError("more than 2³¹ pairs of a splat and a tile")
        if pairs <= self._capacity:
            return True
        self._capacity = pairs + pairs // 4
        return False

    def backward(
        self,
        rendering: DeviceRenderOutput,
        splats: Parameters,
        face: wp.array,
        v_image: wp.array,
        gradients: Parameters,
        v_transmittance: wp.array | None = None,
    ) -> wp.array:
        """Gradient of a scalar with respect to the splats, from its gradient with respect to the image.

        v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites the rows of `gradients` that the rendering
        wants and leaves all others as they are. Returns screen (N,): for those rows, the length of the gradient with
        respect to the projected centre in units of half the image.
        """
        take, lens = self.scratch.take, rendering.frames.lens
        rows = take("rows", rendering.pair_splat.size * blend.PARTS, Projected)
        rows.zero_()
        if v_transmittance is None:
            v_transmittance = take("nothing", (0, 0))
        self.launch(
            blend.blend_backward, rendering.touched.size * blend.PARTS * blend.LANES,
            lens.tiles_x, rendering.touched, rendering.first, rendering.pair_splat, rendering.pair_slot,
            rendering.wanted, rendering.projected, rendering.background, rendering.transmittance, rendering.last,
            v_image, v_transmittance, rows,
        )  # fmt: skip
        frames, screen = rendering.frames, take("screen", face.size)
        self.launch(
            project_backward, face.size,
            *splats, face, frames.origin, frames.matrix, frames.strain, lens, rendering.projected, rendering.wanted,
            rendering.slot_start, rendering.slot_count, blend.PARTS, rows, *gradients, screen,
        )  # fmt: skip
        return screen

    def launch(self, kernel: wp.Kernel, threads: int | tuple[int, ...], *arguments: Any) -> None:
        """Launch a kernel on this device, in blocks of a tile's pixels."""
        wp.launch(kernel, threads, arguments, device=self.device, block_dim=PIXELS)

    def _tiles(self, rect: wp.array, focus: wp.array | None, lens: Lens, ring: int) -> tuple[wp.array, wp.array]:
        """Tiles that the focus touches, and those at most `ring` tiles away; without focus, all."""
        tiles = lens.tiles_x * lens.tiles_y
        touched, drawn = self.scratch.take("touched", tiles, wp.uint8), self.scratch.take("drawn", tiles, wp.uint8)
        if focus is None:
            touched.fill_(1)
            drawn.fill_(1)
        else:
            touched.zero_()
            self.launch(bins.mark_tiles, rect.size, rect, focus, lens.tiles_x, touched)
            self.launch(bins.grow_tiles, tiles, touched, lens.tiles_x, lens.tiles_y, ring, drawn)
        return touched, drawn

    def _fill(
        self, order: wp.array, rect: wp.array, drawn: wp.array, count: wp.array, end: wp.array, focus: wp.array,
        lens: Lens,
    ) -> dict[str, wp.array]:  # fmt: skip
        """Every drawn tile's list of splats; the fields of `DeviceRenderOutput` that come of it."""
        n, tiles, capacity, take = rect.size, drawn.size, self._capacity, self.scratch.take
        pair_tile, pair_slot = take("pair_tile", 2 * capacity, wp.int32), take("pair_slot", 2 * capacity, wp.int32)
        slot_splat, pair_splat = take("slot_splat", capacity, wp.int32), take("pair_splat", capacity, wp.int32)
        slot_start, slot_count = take("slot_start", n, wp.int32), take("slot_count", n, wp.int32)
        wanted = take("wanted", n, wp.uint8)
        first, past = take("first", tiles, wp.int32), take("past", tiles, wp.int32)
        first.zero_()
        past.zero_()
        pair_tile.fill_(tiles)
        self.launch(
            bins.fill_pairs, n,
            order, rect, drawn, lens.tiles_x, count, end, focus, capacity, pair_tile, pair_slot, slot_splat, slot_start,
            slot_count, wanted,
        )  # fmt: skip
        wp.utils.radix_sort_pairs(pair_tile, pair_slot, capacity, 0, tiles.bit_length())
        self.launch(bins.find_tiles, capacity, pair_tile, pair_slot, slot_splat, pair_splat, first, past)
        return {
            "wanted": wanted, "first": first, "past": past, "slot_start": slot_start, "slot_count": slot_count,
            "pair_splat": pair_splat, "pair_slot": pair_slot,
        }  # fmt: skip


def lens_of(
    camera: Camera, degree: int, strains: int, depth_as_colour: bool = False, antialiased: bool = False
) -> Lens:
    """The camera as the kernels take it; strains: columns of strain that both frames and splats have."""
    lens = Lens()
    lens.fx, lens.fy, lens.cx, lens.cy = camera.fl_x, camera.fl_y, camera.cx, camera.cy
    lens.width, lens.height = camera.width, camera.height
    lens.tiles_x, lens.tiles_y = tile_grid(camera)
    lens.to_world = wp.mat33(*camera.world_to_camera[:3, :3].T.ravel().tolist())
    lens.degree, lens.strains = degree, strains
    lens.depth_as_colour, lens.antialiased = depth_as_colour, antialiased
    return lens
