"""Rendering on a Warp device: splats and a camera to an image, and its gradient back to the splats."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...capture.camera import Camera
from ..cpu.layout import PIXELS, TILE, Parameters
from ..cpu.rasterize import BLACK_BACKGROUND, tile_grid
from . import blend
from .buffers import DeviceBufferPool
from .project import DeviceCamera, Projected, project_backward, project_forward
from .tiles import count_pairs, dilate_tiles, fill_pairs, find_tiles, mark_tiles

INITIAL_PAIR_CAPACITY = 1 << 18
"""Pairs that a rasterizer has room for at first: 25 MB."""
PARAMETER_TYPES = Parameters(wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.vec3)
"""What the kernels see in a row of each parameter, or, of the last two, in a coefficient."""


@dataclass(frozen=True)
class DeviceFrames:
    """Camera-space frames and strain of the triangles, as in `CameraFrames`, with the camera and rendering options."""

    origin: wp.array
    matrix: wp.array
    strain: wp.array
    lens: DeviceCamera


@dataclass(frozen=True)
class DeviceRenderOutput:
    """An image and what its backward pass needs; valid until the rasterizer's next one.

    image (3, H, W) float32 over the background; transmittance (H, W) = 1 − alpha; undefined where no tile was rendered.
    wanted (N,) uint8: the splats of the focus that are visible, whose gradient the backward pass writes.
    touched, rendered (tiles,) uint8: tiles that a splat of the focus reaches, and those that were rendered.
    """

    image: wp.array
    transmittance: wp.array
    wanted: wp.array
    touched: wp.array
    rendered: wp.array
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


class Rasterizer:
    """Renders on one device, forward and backward, into buffers of its own.

    The host never waits for the device in `backward`, and in `forward` only with `wait`.
    """

    def __init__(self, device: str) -> None:
        self.device = wp.get_device(device)
        self.buffers = DeviceBufferPool(self.device)
        self._capacity = INITIAL_PAIR_CAPACITY
        self._pairs = wp.zeros(1, wp.int32, device="cpu", pinned=self.device.is_cuda)
        self._counted = wp.Event(self.device) if self.device.is_cuda else None

    def forward(
        self,
        splats: Parameters,
        face: wp.array,
        frames: DeviceFrames,
        background: np.ndarray = BLACK_BACKGROUND,
        focus: wp.array | None = None,
        reach: int = 0,
        wait: bool = True,
    ) -> DeviceRenderOutput:
        """Render N embedded splats over a background color (3,); Warp arrays of `PARAMETER_TYPES`.

        focus (N,) uint8 and reach: as the focus and reach of `raster.render.render_forward`.
        Without `wait`, the image may lack everything because the pairs did not fit; `pairs_fit` tells.
        """
        n, lens, array = face.size, frames.lens, self.buffers.get
        depth, order = array("depth", 2 * n), array("order", 2 * n, wp.int32)
        projected, rect = array("projected", n, Projected), array("rect", n, wp.vec4i)
        self.launch(
            project_forward, n,
            *splats, face, frames.origin, frames.matrix, frames.strain, lens, projected, depth, order, rect,
        )  # fmt: skip
        touched, rendered = self._tiles(rect, focus, lens, -(-reach // TILE))
        if focus is None:
            focus = array("everything", n, wp.uint8)
            focus.fill_(1)
        count, end = array("count", n, wp.int32), array("end", n, wp.int32)
        if n:
            wp.utils.radix_sort_pairs(depth, order, n)
            self.launch(count_pairs, n, order, rect, rendered, lens.tiles_x, count)
            wp.utils.array_scan(count, end, inclusive=True)
            wp.copy(self._pairs, end, src_offset=n - 1, count=1)
        else:
            self._pairs.zero_()
        if self._counted is not None:
            wp.get_stream(self.device).record_event(self._counted)
        if wait:
            self.pairs_fit()
        pairs = self._fill(order, rect, rendered, count, end, focus, lens)
        image = array("image", (3, lens.height, lens.width))
        transmittance = array("transmittance", (lens.height, lens.width))
        last = array("last", (lens.height, lens.width), wp.int32)
        rendering = DeviceRenderOutput(
            image, transmittance, touched=touched, rendered=rendered, projected=projected, rect=rect, last=last,
            background=wp.vec3(*(float(c) for c in background)), frames=frames, **pairs,
        )  # fmt: skip
        self.launch(
            blend.blend_forward, rendered.size * PIXELS,
            lens.tiles_x, rendered, rendering.first, rendering.past, rendering.pair_splat, projected,
            rendering.background, image, transmittance, last,
        )  # fmt: skip
        return rendering

    def pairs_fit(self) -> bool:
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
        wants and leaves all others unchanged. Returns screen (N,): for those rows, the length of the gradient with
        respect to the projected center in units of half the image.
        """
        array, lens = self.buffers.get, rendering.frames.lens
        rows = array("rows", rendering.pair_splat.size * blend.WARPS_PER_TILE, Projected)
        rows.zero_()
        if v_transmittance is None:
            v_transmittance = array("nothing", (0, 0))
        self.launch(
            blend.blend_backward, rendering.touched.size * blend.WARPS_PER_TILE * blend.WARP_LANES,
            lens.tiles_x, rendering.touched, rendering.first, rendering.pair_splat, rendering.pair_slot,
            rendering.wanted, rendering.projected, rendering.background, rendering.transmittance, rendering.last,
            v_image, v_transmittance, rows,
        )  # fmt: skip
        frames, screen = rendering.frames, array("screen", face.size)
        self.launch(
            project_backward, face.size,
            *splats, face, frames.origin, frames.matrix, frames.strain, lens, rendering.projected, rendering.wanted,
            rendering.slot_start, rendering.slot_count, blend.WARPS_PER_TILE, rows, *gradients, screen,
        )  # fmt: skip
        return screen

    def launch(self, kernel: wp.Kernel, threads: int | tuple[int, ...], *arguments: Any) -> None:
        """Launch a kernel on this device, in blocks of a tile's pixels."""
        wp.launch(kernel, threads, arguments, device=self.device, block_dim=PIXELS)

    def _tiles(
        self, rect: wp.array, focus: wp.array | None, lens: DeviceCamera, ring: int
    ) -> tuple[wp.array, wp.array]:
        """Tiles that the focus touches, and those at most `ring` tiles away; without focus, all."""
        tiles = lens.tiles_x * lens.tiles_y
        touched, rendered = self.buffers.get("touched", tiles, wp.uint8), self.buffers.get("rendered", tiles, wp.uint8)
        if focus is None:
            touched.fill_(1)
            rendered.fill_(1)
        else:
            touched.zero_()
            self.launch(mark_tiles, rect.size, rect, focus, lens.tiles_x, touched)
            self.launch(dilate_tiles, tiles, touched, lens.tiles_x, lens.tiles_y, ring, rendered)
        return touched, rendered

    def _fill(
        self, order: wp.array, rect: wp.array, rendered: wp.array, count: wp.array, end: wp.array, focus: wp.array,
        lens: DeviceCamera,
    ) -> dict[str, wp.array]:  # fmt: skip
        """Every rendered tile's list of splats; the fields of `DeviceRenderOutput` that come of it."""
        n, tiles, capacity, array = rect.size, rendered.size, self._capacity, self.buffers.get
        pair_tile, pair_slot = array("pair_tile", 2 * capacity, wp.int32), array("pair_slot", 2 * capacity, wp.int32)
        slot_splat, pair_splat = array("slot_splat", capacity, wp.int32), array("pair_splat", capacity, wp.int32)
        slot_start, slot_count = array("slot_start", n, wp.int32), array("slot_count", n, wp.int32)
        wanted = array("wanted", n, wp.uint8)
        first, past = array("first", tiles, wp.int32), array("past", tiles, wp.int32)
        first.zero_()
        past.zero_()
        pair_tile.fill_(tiles)
        self.launch(
            fill_pairs, n,
            order, rect, rendered, lens.tiles_x, count, end, focus, capacity, pair_tile, pair_slot, slot_splat,
            slot_start, slot_count, wanted,
        )  # fmt: skip
        wp.utils.radix_sort_pairs(pair_tile, pair_slot, capacity, 0, tiles.bit_length())
        self.launch(find_tiles, capacity, pair_tile, pair_slot, slot_splat, pair_splat, first, past)
        return {
            "wanted": wanted, "first": first, "past": past, "slot_start": slot_start, "slot_count": slot_count,
            "pair_splat": pair_splat, "pair_slot": pair_slot,
        }  # fmt: skip


def device_camera(
    camera: Camera, degree: int, strains: int, depth_as_color: bool = False, antialiased: bool = False
) -> DeviceCamera:
    """The camera as the kernels take it; strains: columns of strain that both frames and splats have."""
    lens = DeviceCamera()
    lens.fx, lens.fy, lens.cx, lens.cy = camera.fl_x, camera.fl_y, camera.cx, camera.cy
    lens.width, lens.height = camera.width, camera.height
    lens.tiles_x, lens.tiles_y = tile_grid(camera.width, camera.height)
    lens.to_world = wp.mat33(*camera.world_to_camera[:3, :3].T.ravel().tolist())
    lens.degree, lens.strains = degree, strains
    lens.depth_as_color, lens.antialiased = depth_as_color, antialiased
    return lens
