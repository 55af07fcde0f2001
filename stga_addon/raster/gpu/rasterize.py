"""Rendering on a WebGPU device: splats and a camera to an image, and its gradient back to the splats."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ..cpu.layout import TILE, CameraFrames, Parameters
from ..cpu.rasterize import tile_grid
from . import blend, tiles
from . import project as projection
from .blend import blend_backward, blend_forward
from .device import Device, Recording
from .layout import COUNTS, NEEDED, OVERFLOWED, SH, VIEW, splat_rows
from .project import ProjectedSplats, project, project_backward, projected_tables
from .tiles import PairLists, Tiles, choose_tiles, counts_buffer, list_pairs

INITIAL_PAIR_CAPACITY = 1 << 18
"""Pairs that a rasterizer has room for at first: 14 MB."""


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


@dataclass(frozen=True)
class Rendering:
    """An image and what its backward pass needs, tables of `layout.py`; valid until the device's next one.

    image (3, H, W) over the background; pixels (H, W, 2) with the transmittance; undefined where nothing is rendered.
    """

    image: Any
    pixels: Any
    projected: Any
    tile_table: Tiles
    lists: PairLists
    view: Any
    frames: Any
    tiles: int


class Rasterizer:
    """Renders on one device, forward and backward, with room for `capacity` pairs.

    Where the pairs do not fit, nothing is rendered and no splat is wanted, now and later, until `make_room`.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.capacity = INITIAL_PAIR_CAPACITY

    def forward(
        self, work: Recording, splats: SplatTable, frames: Any, options: ViewOptions, view: Any,
        focus: Any | None = None,
    ) -> Rendering:  # fmt: skip
        """Record a rendering; view: of `upload_view`; focus (N,): see `mark_focus`, if `options.focused`."""
        seen = projected_tables(self.device, splats.count)
        project(work, splats.count, seen, view=view, splats=splats.rows, face=splats.face, frames=frames)
        return self.draw(work, seen, splats.count, options.camera, view, frames, focus)

    def draw(
        self, work: Recording, seen: ProjectedSplats, count: int, camera: Camera, view: Any, frames: Any = None,
        focus: Any | None = None,
    ) -> Rendering:  # fmt: skip
        """Record the rendering of `count` projected splats; frames: kept for the backward pass."""
        columns, rows = tile_grid(camera.width, camera.height)
        tiles = columns * rows
        tile_table = choose_tiles(work, count, tiles, rect=seen.rect, view=view, focus=focus)
        lists = list_pairs(
            work, count, tiles, self.capacity, tile_table=tile_table, focus=focus, view=view, **seen._asdict()
        )
        image, pixels = blend_forward(
            work, camera.width * camera.height, tiles, view=view, rendered=tile_table.rendered,
            tile_range=tile_table.tile_range, pair_slot=lists.pair_slot, slot_splat=lists.slot_splat,
            projected=seen.projected,
        )  # fmt: skip
        return Rendering(image, pixels, seen.projected, tile_table, lists, view, frames, tiles)

    def backward(
        self, work: Recording, rendering: Rendering, splats: SplatTable, v_image: Any, gradients: Any,
        v_transmittance: Any | None = None,
    ) -> Any:  # fmt: skip
        """Record the gradient of a scalar with respect to the splats, from that with respect to the image.

        v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites the wanted rows of `gradients`. Returns
        `screen`, see `project_backward`.
        """
        lists, tile_table = rendering.lists, rendering.tile_table
        shared = {"view": rendering.view, "projected": rendering.projected}
        pair_gradients = blend_backward(
            work, self.capacity, rendering.tiles, v_image=v_image, v_transmittance=v_transmittance,
            touched=tile_table.touched, tile_range=tile_table.tile_range, pair_slot=lists.pair_slot,
            slot_splat=lists.slot_splat, pixels=rendering.pixels, **shared,
        )  # fmt: skip
        return project_backward(
            work, splats.count, splats=splats.rows, face=splats.face, frames=rendering.frames, wanted=lists.wanted,
            slots=lists.slots, pair_gradients=pair_gradients, gradients=gradients, **shared,
        )  # fmt: skip

    def pairs_fit(self) -> bool:
        """Wait for the submitted work; whether its pairs fitted. If not, room for them is made."""
        counts = self.device.read(counts_buffer(self.device), (COUNTS,), np.uint32)
        if counts[OVERFLOWED]:
            self.make_room(int(counts[NEEDED]))
        return not counts[OVERFLOWED]

    def make_room(self, needed: int) -> None:
        """Hold at least so many pairs from now on, and an eighth to spare, and let renderings begin again."""
        self.capacity = max(self.capacity, needed + needed // 8)
        self.device.upload("counts", np.zeros(COUNTS, np.uint32), "indirect")

    def upload_view(
        self, splats: SplatTable, options: ViewOptions, to_world: np.ndarray | None = None, first: int = 0,
        name: str = "view",
    ) -> Any:  # fmt: skip
        """Send the uniform of that name for the next rendering.

        to_world (3, 3): from the camera to the space of the harmonics' directions, where that is not the world; first:
        row of the splats in the tables of projected ones.
        """
        camera, view = options.camera, np.zeros((), VIEW)
        to_world = camera.world_to_camera[:3, :3].T if to_world is None else to_world
        columns, rows = tile_grid(camera.width, camera.height)
        values = (
            *(camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.width, camera.height, columns, rows),
            *to_world.ravel(),
            *options.background,
            splats.count,
            splats.coefficients,
            splats.strain_colors,
            options.degree,
            min(options.strains, splats.strain_colors),
            options.strains,
            options.depth_as_color,
            options.antialiased,
            options.focused,
            -(-options.reach // TILE),
            self.capacity,
            first,
        )
        view[...] = values
        return self.device.upload(name, view, "uniform")


def upload_splats(device: Device, splats: Parameters, face: np.ndarray, layer: str = "") -> SplatTable:
    """Numpy arrays of splats as a table on the device; layer: part of its name where there are several."""
    rows = splat_rows(splats)
    strain_colors = 0 if splats.strain_color is None else splats.strain_color.shape[1]
    return SplatTable(
        device.upload(f"splats{layer}", rows), device.upload(f"face{layer}", face.astype(np.uint32)), len(rows),
        splats.sh.shape[1], strain_colors,
    )  # fmt: skip


def upload_frames(device: Device, frames: CameraFrames, layer: str = "") -> Any:
    """Frames in camera space, computed on the CPU, as a table on the device; layer: as in `upload_splats`."""
    count = len(frames.origin)
    parts = (frames.origin, frames.matrix.reshape(count, 9), frames.strain)
    return device.upload(f"frames{layer}", np.concatenate(parts, axis=1, dtype=np.float32))


def compile_kernels(device: Device) -> None:
    """Compile what a `Rasterizer` dispatches in training."""
    for stage in (projection, tiles, blend):
        stage.compile_kernels(device)
